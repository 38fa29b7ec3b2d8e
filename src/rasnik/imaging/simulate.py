"""Simulated frames together with the truth they were made from.

A frame is made in three steps: the pose of each frame is laid down (`Truth`), the expected
image of that pose is computed (a *path*, see `PATHS`), and the sensor adds its noise. Frames
of the same pose share the expected image. Every frame has a random generator of its own, so
frame k of a simulation is the same whether it is made alone, in order, or by several threads.
"""

from __future__ import annotations

import difflib
import math
import operator
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.imaging.levels import LevelMap
from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.noise import ReadOut, Statistics, frame_dtype, quantise_levels
from rasnik.imaging.projection import Projection
from rasnik.instrument import System, load_system

__all__ = ["PATHS", "Simulation", "Truth", "simulate"]

#: Ways to compute the expected image, by name:
#: (system, projection, light_map=..., dark_map=...) -> float64 (H, W).
PATHS: dict[str, Callable[..., NDArray[np.float64]]] = {"exact": exact_image}

# A mask seen through one lens is turned by 180 degrees.
_USUAL_ORIENTATION = 4
_POSE_NAMES = ("x_um", "y_um", "theta_rad", "scale", "orientation")
# Keys of the random streams drawn from one seed.
_POSITIONS, _FRAMES = 0, 1


@dataclass(frozen=True, eq=False)
class Truth:
    """The pose a frame was made with; conventions as for an analysed pose.

    For a pose given as an affine or projective `Projection`, scale, rotation and orientation
    are those of the nearest similarity.
    """

    x_um: float
    y_um: float
    scale: float
    theta_rad: float
    orientation: int
    projection: Projection = field(repr=False)

    def as_dict(self) -> dict[str, float | int]:
        """The five numbers of the pose by name."""
        return {
            "x_um": self.x_um,
            "y_um": self.y_um,
            "scale": self.scale,
            "theta_rad": self.theta_rad,
            "orientation": self.orientation,
        }


@dataclass(frozen=True)
class _Settings:
    noise: bool
    quantise: bool
    statistics: Statistics
    path: str
    light_map: LevelMap | float | None
    dark_map: LevelMap | float | None


@dataclass(frozen=True, eq=False)
class Simulation:
    """Frames and truth of one simulation.

    Frames are made when asked for. ``for frame, truth in simulation`` and ``simulation[k]``
    keep none of them, however many there are; `frames` makes them all and keeps them.

    Attributes
    ----------
    system : System
    truth : tuple of Truth
        One per frame.
    seed : int
        Makes the same simulation again.
    """

    system: System
    truth: tuple[Truth, ...]
    seed: int
    settings: _Settings = field(repr=False)

    @cached_property
    def frames(self) -> NDArray[Any]:
        """All frames, shape (n, H, W), made by one thread per processor core."""
        out = np.empty((len(self), *self.system.shape), self.dtype)
        runs = list(self._runs())

        def fill(render: Callable[[int], NDArray[Any]], k: int) -> None:
            out[k] = render(k)

        def fill_run(run: range) -> None:
            render = self._renderer(self.truth[run[0]])
            for k in run:
                fill(render, k)

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            if len(runs) == 1:
                render = self._renderer(self.truth[0])
                list(pool.map(lambda k: fill(render, k), runs[0]))
            else:
                list(pool.map(fill_run, runs))
        return out

    @property
    def dtype(self) -> np.dtype[Any]:
        """Data type of the frames."""
        return frame_dtype(self.system) if self.settings.quantise else np.dtype(np.float64)

    def expected(self, k: int) -> NDArray[np.float64]:
        """Expected image of frame k: without noise, range and rounding; shape (H, W)."""
        return self._expected(self.truth[k])

    def __len__(self) -> int:
        return len(self.truth)

    def __getitem__(self, k: int) -> tuple[NDArray[Any], Truth]:
        truth = self.truth[operator.index(k)]
        return self._renderer(truth)(k % len(self)), truth

    def __iter__(self) -> Iterator[tuple[NDArray[Any], Truth]]:
        for run in self._runs():
            render = self._renderer(self.truth[run[0]])
            for k in run:
                yield render(k), self.truth[k]

    def _runs(self) -> Iterator[range]:
        """Ranges of consecutive frames of the same pose."""
        for _, group in groupby(range(len(self)), key=lambda k: id(self.truth[k])):
            first, *rest = group
            yield range(first, first + 1 + len(rest))

    def _expected(self, truth: Truth) -> NDArray[np.float64]:
        s = self.settings
        return PATHS[s.path](
            self.system, truth.projection, light_map=s.light_map, dark_map=s.dark_map
        )

    def _renderer(self, truth: Truth) -> Callable[[int], NDArray[Any]]:
        """Function that makes frame k, for frames of this pose."""
        expected, s = self._expected(truth), self.settings
        if s.noise:
            readout = ReadOut(expected, self.system, s.statistics)
            return lambda k: readout.frame(_stream(self.seed, _FRAMES, k), quantise=s.quantise)
        if s.quantise:
            expected = quantise_levels(expected, self.system)
        return lambda k: expected.copy()


def simulate(
    system: System | str | os.PathLike[str],
    poses: Any = None,
    *,
    n: int = 1,
    seed: int | None = None,
    noise: bool = True,
    quantise: bool | None = None,
    statistics: Statistics = "gaussian",
    light_map: LevelMap | float | None = None,
    dark_map: LevelMap | float | None = None,
    path: str = "exact",
) -> Simulation:
    """Simulate frames of a mask at given or random poses.

    Parameters
    ----------
    system : System, str or path
        The instrument, or its name or file.
    poses : optional
        One pose or a sequence of poses. A pose is ``(x_um, y_um[, theta_rad[, scale[,
        orientation]]])``, a mapping with these keys, anything with these attributes (a
        `Truth`, an analysed pose) or a `Projection`. What is left out, or None, is the
        system's; the orientation is 4 where the system leaves it open. By default every frame
        has a random position, at which the view is filled by the mask if it can be.
    n : int
        Frames of each pose given; without poses, number of random positions.
    seed : int, optional
        Seed of positions and noise; random by default, to be read from the result.
    noise : bool
        Whether the sensor adds noise.
    quantise : bool, optional
        Whether levels are limited to the sensor's range and rounded; by default if there is
        noise. Frames are then uint8 or uint16, otherwise float64.
    statistics : {"gaussian", "poisson"}
        Distribution of the shot noise.
    light_map, dark_map : callable or float, optional
        Grey levels of white and black over the sensor, see `exact_image`; by default the
        system's levels.
    path : str
        How the expected image is computed: ``"exact"``.

    Returns
    -------
    Simulation

    Raises
    ------
    ValueError
        If a pose is incomplete or impossible or its (x_um, y_um) is not on the mask (the view
        may reach beyond the mask, which is opaque there), if `n` is below 1, an option is
        unknown, or noise is wanted and the system does not state it.
    SystemConfigError
        If the system cannot be read.
    TypeError
        If a pose, `n` or `seed` is of a wrong type.
    """
    system = load_system(system)
    n, seed = _count(n), _seed(seed)
    if path not in PATHS:
        raise ValueError(f"path must be one of {', '.join(PATHS)}, not {path!r}")
    if statistics not in ("gaussian", "poisson"):
        raise ValueError(f"statistics must be 'gaussian' or 'poisson', not {statistics!r}")
    if noise and system.noise_law is None:
        raise ValueError(
            f"the noise of system {system.name} is not known: give sensor.noise_a and "
            "sensor.noise_b, or simulate without noise"
        )
    settings = _Settings(
        noise, noise if quantise is None else quantise, statistics, path, light_map, dark_map
    )
    if poses is None:
        positions = _random_positions(system, n, seed)
        truth = [_truth(system, position, "pose") for position in positions]
    else:
        truth = [t for t in _truths(system, poses) for _ in range(n)]
    return Simulation(system, tuple(truth), seed, settings)


# ------------------------------------------------------------------------- randomness


def _stream(seed: int, purpose: int, index: int = 0) -> np.random.Generator:
    """The random stream of one purpose and frame: independent of all others of this seed."""
    return np.random.Generator(
        np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(purpose, index)))
    )


def _random_positions(system: System, n: int, seed: int) -> NDArray[np.float64]:
    """n points (x, y), uniform over the mask; off its edge by half a view where it is large."""
    height, width = system.shape
    view = math.hypot(height, width) * system.pitch_um / system.optics.scale
    x0, x1, y0, y1 = system.mask.bounds_um
    low, high = np.array([x0, y0]), np.array([x1, y1])
    inset = np.where(high - low > view, view / 2, 0.0)
    return _stream(seed, _POSITIONS).uniform(low + inset, high - inset, (n, 2))


def _count(n: int) -> int:
    try:
        count = operator.index(n)
    except TypeError:
        raise TypeError(f"n, the number of frames, must be a whole number, not {n!r}") from None
    if count < 1:
        raise ValueError(f"n, the number of frames, must be at least 1, not {count}")
    return count


def _seed(seed: int | None) -> int:
    if seed is None:
        return int(np.random.SeedSequence().generate_state(1, np.uint64)[0])
    try:
        value = operator.index(seed)
    except TypeError:
        raise TypeError(f"seed must be a whole number, not {seed!r}") from None
    if value < 0:
        raise ValueError(f"seed must not be negative, it is {value}")
    return value


# ------------------------------------------------------------------------------ poses


def _truths(system: System, poses: Any) -> list[Truth]:
    if _is_one_pose(poses):
        return [_truth(system, poses, "pose")]
    if isinstance(poses, str) or not isinstance(poses, Iterable):
        raise TypeError(f"poses must be a pose or a sequence of poses, not {poses!r}")
    truths = [_truth(system, pose, f"pose {k}") for k, pose in enumerate(poses)]
    if not truths:
        raise ValueError("poses is empty: give at least one pose, or None for random positions")
    return truths


def _is_one_pose(poses: Any) -> bool:
    if isinstance(poses, Projection | Mapping) or hasattr(poses, "x_um"):
        return True
    if isinstance(poses, np.ndarray):
        return poses.ndim == 1 and poses.dtype != object
    return (
        isinstance(poses, list | tuple)
        and len(poses) > 0
        and all(value is None or isinstance(value, Real) for value in poses)
    )


def _truth(system: System, pose: Any, label: str) -> Truth:
    """The pose in full; `label` names it in messages."""
    # A `Truth` and an analysed pose may hold more than a similarity.
    projection = pose if isinstance(pose, Projection) else getattr(pose, "projection", None)
    if isinstance(projection, Projection):
        known = getattr(pose, "orientation", None) or None
        x_um, y_um = projection.x_um, projection.y_um
        truth = Truth(x_um, y_um, *projection.similarity(known), projection)
    else:
        truth = _similarity_truth(system, _pose_values(pose, label), label)
    x0, x1, y0, y1 = system.mask.bounds_um
    if not (x0 <= truth.x_um <= x1 and y0 <= truth.y_um <= y1):
        raise ValueError(
            f"{label}: ({truth.x_um:g}, {truth.y_um:g}) um is not on the mask, which covers "
            f"x {x0:g}..{x1:g} um and y {y0:g}..{y1:g} um"
        )
    return truth


def _pose_values(pose: Any, label: str) -> dict[str, Any]:
    """The values given, by name; None where left out."""
    if isinstance(pose, Mapping):
        for key in pose:
            if key not in _POSE_NAMES:
                near = difflib.get_close_matches(str(key), _POSE_NAMES, n=1)
                hint = f"; did you mean {near[0]}?" if near else ""
                raise ValueError(
                    f"{label}: unknown key {key!r}, a pose has {', '.join(_POSE_NAMES)}{hint}"
                )
        given = dict(pose)
    elif hasattr(pose, "x_um"):
        given = {name: getattr(pose, name, None) for name in _POSE_NAMES}
    else:
        try:
            values = list(pose)
        except TypeError:
            raise TypeError(f"{label}: {pose!r} is not a pose (x_um, y_um, ...)") from None
        if not 2 <= len(values) <= len(_POSE_NAMES):
            raise ValueError(
                f"{label}: a pose has 2 to {len(_POSE_NAMES)} values, {', '.join(_POSE_NAMES)}, "
                f"not {len(values)}"
            )
        given = dict(zip(_POSE_NAMES, values, strict=False))
    values_by_name = {name: given.get(name) for name in _POSE_NAMES}
    for name in ("x_um", "y_um"):
        if values_by_name[name] is None:
            raise ValueError(f"{label}: {name} is missing")
    return values_by_name


def _similarity_truth(system: System, values: Mapping[str, Any], label: str) -> Truth:
    optics = system.optics
    defaults = {
        "theta_rad": optics.theta_rad,
        "scale": optics.scale,
        "orientation": optics.orientation or _USUAL_ORIENTATION,
    }
    number: dict[str, float] = {}
    for name in _POSE_NAMES:
        value = defaults[name] if values[name] is None else values[name]
        try:
            number[name] = float(value)
        except (TypeError, ValueError):
            raise TypeError(f"{label}: {name} must be a number, not {value!r}") from None
        if not math.isfinite(number[name]):
            raise ValueError(f"{label}: {name} must be finite, not {number[name]}")
    if number["scale"] <= 0:
        raise ValueError(f"{label}: scale must be positive, not {number['scale']:g}")
    if number["orientation"] not in (1, 2, 3, 4):
        raise ValueError(f"{label}: orientation must be 1, 2, 3 or 4, not {values['orientation']}")
    pose = (number["x_um"], number["y_um"], number["scale"], number["theta_rad"])
    orientation = int(number["orientation"])
    return Truth(*pose, orientation, Projection.from_pose(*pose, orientation))
