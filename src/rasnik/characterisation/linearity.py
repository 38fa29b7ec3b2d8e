"""Linearity by simulation: a mask moved in known steps, and what each method makes of it.

Frames are free of noise, so what is left is the error of generator and analysis together.
`rasnik.imaging.montecarlo` makes them exactly; `rasnik.imaging.paper` as the paper did, whose
sampling of the blur is itself an error of some nanometres.

Source: van der Graaf et al., section 4, "The linearity of the response": x is moved in steps
at fixed y, over 50 nm at theta_z of 0 and 20 mrad, and over 2 um at 2 mrad.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.analyse import analyse
from rasnik.analysis.pose import Pose
from rasnik.imaging.simulate import simulate
from rasnik.instrument import System
from rasnik.performance.bound import reference_pose
from rasnik.tracking.tracker import Tracker

__all__ = ["METHODS", "PAPER_SCANS", "Linearity", "MethodError", "Scan", "linearity"]

#: Ways from a frame to a position.
METHODS = ("likelihood", "fourier", "tracker")

Axis = Literal["x", "y"]


@dataclass(frozen=True)
class Scan:
    """A motion in equal steps along one axis of the mask.

    Attributes
    ----------
    theta_rad : float
        Rotation of the mask in the image.
    range_um : float
        Length of the motion.
    positions : int
        Places, both ends included.
    axis : str
        x or y.
    """

    theta_rad: float
    range_um: float
    positions: int = 51
    axis: Axis = "x"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.range_um) and self.range_um > 0):
            raise ValueError(f"the range of a scan must be positive, not {self.range_um!r} um")
        if self.positions < 2:
            raise ValueError(f"a scan has at least 2 positions, not {self.positions!r}")
        if self.axis not in ("x", "y"):
            raise ValueError(f"a scan goes along x or y, not {self.axis!r}")

    @property
    def offsets_um(self) -> NDArray[np.float64]:
        """Distance from the start, shape (positions,)."""
        return np.linspace(0.0, self.range_um, self.positions)


#: The scans of the paper's figure: 0 and 20 mrad over 50 nm, 2 mrad over 2 um.
PAPER_SCANS = (Scan(0.0, 0.05), Scan(0.02, 0.05), Scan(0.002, 2.0))


@dataclass(frozen=True, eq=False)
class MethodError:
    """Error of one method along a scan: found minus true.

    Attributes
    ----------
    scan : Scan
    method : str
    error_nm : ndarray, shape (positions, 2)
        Of x and y; NaN where no position was found.
    """

    scan: Scan
    method: str
    error_nm: NDArray[np.float64] = field(repr=False)

    @property
    def along_nm(self) -> NDArray[np.float64]:
        """Error in the direction of the motion, shape (positions,)."""
        return np.asarray(self.error_nm[:, "xy".index(self.scan.axis)])

    @property
    def failed(self) -> int:
        """Frames without a position."""
        return int(np.isnan(self.error_nm[:, 0]).sum())

    @property
    def figures(self) -> dict[str, float]:
        """Along the motion, without failed frames; NaN if all failed.

        ``mean_nm``, ``peak_to_peak_nm``, ``rms_nm`` about the mean, ``largest_nm`` from zero, and
        ``slope``: the largest deviation of the local slope d(found) / d(true) from 1.
        """
        kept = np.isfinite(self.along_nm)
        error, at = self.along_nm[kept], 1e3 * self.scan.offsets_um[kept]
        if not len(error):
            names = ("mean_nm", "peak_to_peak_nm", "rms_nm", "largest_nm", "slope")
            return dict.fromkeys(names, math.nan)
        slope = np.abs(np.diff(error) / np.diff(at)).max() if len(error) > 1 else math.nan
        return {
            "mean_nm": float(error.mean()),
            "peak_to_peak_nm": float(np.ptp(error)),
            "rms_nm": float(error.std()),
            "largest_nm": float(np.abs(error).max()),
            "slope": float(slope),
        }

    def as_dict(self) -> dict[str, Any]:
        """For JSON: None where there is no number."""
        return {
            "theta_rad": self.scan.theta_rad,
            "range_um": self.scan.range_um,
            "axis": self.scan.axis,
            "method": self.method,
            "failed": self.failed,
            **{name: _number(value) for name, value in self.figures.items()},
            "offset_um": self.scan.offsets_um.tolist(),
            "error_x_nm": [_number(value) for value in self.error_nm[:, 0]],
            "error_y_nm": [_number(value) for value in self.error_nm[:, 1]],
        }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class Linearity:
    """Errors of all scans and methods, and how the frames were made.

    Attributes
    ----------
    system : System
    path : str
        Generator, ``"exact"`` or ``"paper"``.
    rounded : bool
        Whether grey levels were rounded to whole numbers, as a file of images has them.
    start_um : tuple of float
        Where on the mask the scans begin.
    effects : dict
        Sources of error that were simulated.
    errors : tuple of MethodError
    """

    system: System
    path: str
    rounded: bool
    start_um: tuple[float, float]
    effects: dict[str, Any]
    errors: tuple[MethodError, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "system": self.system.name,
            "path": self.path,
            "rounded": self.rounded,
            "start_um": list(self.start_um),
            "effects": self.effects,
            "scans": [one.as_dict() for one in self.errors],
        }


def linearity(
    system: System,
    scans: Iterable[Scan] = PAPER_SCANS,
    *,
    methods: Iterable[str] = METHODS,
    path: str = "exact",
    rounded: bool = False,
    start_um: tuple[float, float] | None = None,
    effects: Any = None,
    progress: Callable[[int], object] | None = None,
) -> Linearity:
    """Move a simulated mask in known steps and compare what each method finds.

    A frame of SolidRas takes about 0.3 s of one core to simulate exactly; as many are made at
    a time as there are cores.

    Parameters
    ----------
    system : System
    scans : iterable of Scan
    methods : iterable of str
        Of `METHODS`. ``tracker`` follows the scan as a sequence of frames.
    path : str
        Generator of the frames, of `rasnik.imaging.simulate.PATHS`.
    rounded : bool
        Round grey levels to whole numbers, as the paper's files have them. Without noise all
        pixels along a contour are rounded alike where the mask is not rotated.
    start_um : tuple of float, optional
        Where on the mask to begin; by default the paper's (4000, 5000) um or the same fields of
        another mask.
    effects : optional
        Sources of error, as for `rasnik.simulate`. The truth is where the mask stands.
    progress : callable, optional
        Called with the number of frames done since the last call.

    Returns
    -------
    Linearity

    Raises
    ------
    ValueError
        If a method, path or effect is not known, or the scan leaves the mask.
    """
    scans, methods = list(scans), list(methods)
    for method in methods:
        if method not in METHODS:
            raise ValueError(f"a method is one of {', '.join(METHODS)}, not {method!r}")
    start = reference_pose(system) if start_um is None else start_um
    found: list[MethodError] = []
    described: dict[str, Any] = {}
    for scan in scans:
        simulation = simulate(
            system,
            [_pose(scan, start, offset) for offset in scan.offsets_um.tolist()],
            seed=0,
            noise=False,
            quantise=rounded,
            path=path,
            effects=effects,
        )
        described = simulation.described["effects"]
        errors = np.full((len(methods), scan.positions, 2), np.nan)
        tracker = Tracker(system)
        for k, (frame, truth) in enumerate(simulation):
            for row, method in enumerate(methods):
                pose = _analysed(frame, system, method, tracker, k, truth.orientation)
                if pose.ok:
                    errors[row, k] = 1e3 * (pose.x_um - truth.x_um), 1e3 * (pose.y_um - truth.y_um)
            if progress is not None:
                progress(1)
        found += [MethodError(scan, m, errors[row]) for row, m in enumerate(methods)]
    return Linearity(system, path, rounded, start, described, tuple(found))


def _pose(scan: Scan, start: tuple[float, float], offset: float) -> tuple[float, float, float]:
    x, y = start
    if scan.axis == "x":
        return x + offset, y, scan.theta_rad
    return x, y + offset, scan.theta_rad


def _analysed(
    frame: NDArray[Any], system: System, method: str, tracker: Tracker, k: int, orientation: int
) -> Pose:
    if method == "tracker":
        return tracker.update(frame, number=k)
    return analyse(frame, system, method=method, orientation=orientation)  # type: ignore[arg-type]
