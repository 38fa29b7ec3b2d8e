"""The demonstration: images of a simulated Rasnik, analysed, compared with their truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.analyse import analyse
from rasnik.analysis.pose import Pose
from rasnik.imaging.projection import wrap_angle
from rasnik.imaging.simulate import Simulation, Truth, simulate
from rasnik.instrument import System, load_system

__all__ = ["PARAMETERS", "Demo", "Parameter", "run_demo", "save_plots"]

_MOST_THETA_RAD = 0.02
_SCALE_SPREAD = 0.005


@dataclass(frozen=True)
class Parameter:
    """A parameter of the pose as the demonstration shows it."""

    name: str
    symbol: str
    unit: str
    factor: float
    """Of the unit in terms of that of the pose."""


PARAMETERS = (
    Parameter("x_um", "x", "nm", 1e3),
    Parameter("y_um", "y", "nm", 1e3),
    Parameter("scale", "S", "ppm", 1e6),
    Parameter("theta_rad", "theta", "µrad", 1e6),
)


@dataclass(frozen=True, eq=False)
class Demo:
    """What the demonstration found.

    Attributes
    ----------
    simulation : Simulation
    poses : tuple of Pose
        One for each frame of the simulation.
    """

    simulation: Simulation
    poses: tuple[Pose, ...]

    @property
    def system(self) -> System:
        return self.simulation.system

    @property
    def found(self) -> NDArray[np.bool_]:
        """Which frames gave a position, in the right orientation."""
        return np.array(
            [
                pose.ok and pose.orientation == truth.orientation
                for pose, truth in zip(self.poses, self.simulation.truth, strict=True)
            ]
        )

    def errors(self, name: str) -> NDArray[np.float64]:
        """Found minus truth of one parameter, NaN where nothing was found; shape (n,)."""
        pairs = zip(self.poses, self.simulation.truth, self.found, strict=True)
        return np.array(
            [_difference(pose, truth, name) if ok else np.nan for pose, truth, ok in pairs]
        )

    def sigmas(self, name: str) -> NDArray[np.float64]:
        """Standard deviations predicted for one parameter; shape (n,)."""
        return np.array([getattr(pose, f"sigma_{name}") for pose in self.poses])

    def rms(self, name: str) -> float:
        """Root mean square error of one parameter."""
        return math.sqrt(float(np.nanmean(self.errors(name) ** 2)))

    def bound(self, name: str) -> float:
        """The Cramer-Rao bound: root mean square of the predicted standard deviations."""
        return math.sqrt(float(np.nanmean(self.sigmas(name) ** 2)))


def _difference(pose: Pose, truth: Truth, name: str) -> float:
    difference = float(getattr(pose, name)) - float(getattr(truth, name))
    return wrap_angle(difference) if name == "theta_rad" else difference


def random_poses(system: System, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Poses anywhere on the mask, turned and scaled a little, in any orientation.

    Returns
    -------
    ndarray, shape (count, 5)
        x_um, y_um, theta_rad, scale, orientation.
    """
    view = math.hypot(*system.shape) * system.pitch_um / system.optics.scale
    x0, x1, y0, y1 = system.mask.bounds_um
    orientation = system.optics.orientation
    return np.column_stack(
        [
            rng.uniform(x0 + view / 2, x1 - view / 2, count),
            rng.uniform(y0 + view / 2, y1 - view / 2, count),
            rng.uniform(-_MOST_THETA_RAD, _MOST_THETA_RAD, count),
            system.optics.scale * (1 + rng.uniform(-_SCALE_SPREAD, _SCALE_SPREAD, count)),
            np.full(count, orientation) if orientation else rng.integers(1, 5, count),
        ]
    )


def run_demo(
    system: System | str = "solidras",
    count: int = 30,
    seed: int = 1,
    advance: Callable[[], Any] = lambda: None,
) -> Demo:
    """Simulate frames at random poses and find those poses again, each from nothing.

    Parameters
    ----------
    system : System or str
    count : int
        Number of frames.
    seed : int
    advance : callable
        Called after each frame.
    """
    system = load_system(system)
    poses = random_poses(system, count, np.random.default_rng(seed))
    simulation = simulate(system, poses, seed=seed)
    found = []
    for frame, _ in simulation:
        found.append(analyse(frame, system))
        advance()
    return Demo(simulation, tuple(found))


# ------------------------------------------------------------------------ plots


def save_plots(demo: Demo, folder: Path) -> list[Path]:
    """Save an image, its overlay, and the errors in units of their predicted sigma.

    Returns
    -------
    list of Path
        The files written.
    """
    from PIL import Image

    from rasnik.report.overlay import draw_overlay

    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in ("image.png", "overlay.png", "errors.png")]
    frame, _ = demo.simulation[0]
    Image.fromarray(frame).save(paths[0])
    draw_overlay(frame, demo.poses[0], demo.system, paths[1], title="image.png, simulated")
    _error_figure(demo).savefig(paths[2])
    return paths


def _error_figure(demo: Demo) -> Any:
    """Histograms of error over sigma, with the unit Gaussian they should follow."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    edges = np.linspace(-4, 4, 17)
    pulls = np.linspace(-4, 4, 200)
    count = int(demo.found.sum())
    gauss = np.exp(-(pulls**2) / 2) / math.sqrt(2 * math.pi) * count * (edges[1] - edges[0])
    for axes, parameter in zip(figure.subplots(2, 2).flat, PARAMETERS, strict=True):
        values = demo.errors(parameter.name) / demo.sigmas(parameter.name)
        axes.hist(np.clip(values[demo.found], -4, 4), bins=edges, color="#7fb2e5", ec="white")
        axes.plot(pulls, gauss, color="#c0392b", label="expected (unit Gaussian)")
        rms = demo.rms(parameter.name) * parameter.factor
        bound = demo.bound(parameter.name) * parameter.factor
        axes.set_title(
            f"{parameter.symbol}: rms error {rms:.2g} {parameter.unit}, "
            f"bound {bound:.2g} {parameter.unit}"
        )
        axes.set(xlabel="error / predicted sigma", ylabel="images")
    figure.axes[0].legend(fontsize=9)
    figure.suptitle(f"{demo.system.name}: {count} simulated images, each analysed from nothing")
    return figure
