"""Resolution from a track of a scene that stands still, or nearly: the method of differences.

Differences between successive frames hold their noise, but little of what drifts. The p-th
difference of independent errors of standard deviation sigma has the variance C(2p, p) sigma^2,
so each order gives an estimate of sigma, and each is blind to more motion than the one before:
the first to an offset, the second to a steady drift, the third to a drift that grows. The first
is also the Allan deviation at the interval of the frames. Where estimates differ by more than
chance allows, the scene moved.

Source: the difference estimators of variance, J. von Neumann, Ann. Math. Stat. 12 (1941) 367,
and Gasser, Sroka and Jennen-Steinmetz, Biometrika 73 (1986) 625.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import binom
from scipy.stats import median_abs_deviation

from rasnik.instrument import System
from rasnik.performance.bound import Bound, bound
from rasnik.tracking.track import Track

__all__ = ["MOST_ORDER", "Resolution", "Scatter", "difference_scatter", "resolution"]

#: Highest order of the differences a resolution is taken from; one more is looked at.
MOST_ORDER = 3

_LEAST = 10  # differences; with fewer the estimate says little
_CUT = 6.0  # robust standard deviations beyond which a difference is of an outlier
_SIGNIFICANT = 4.5  # standard deviations; few frames make more large deviations than Gauss
_COLUMNS = {"x": "x_um", "y": "y_um", "scale": "scale", "theta": "theta_rad"}
_FACTORS = {"x": 1e3, "y": 1e3, "scale": 1.0, "theta": 1.0}  # to nm
_UNITS = {"x": "nm", "y": "nm", "scale": "", "theta": "rad"}


@dataclass(frozen=True)
class Scatter:
    """Scatter of one coordinate from frame to frame, and what it is to be compared with.

    All in nm for x and y, rad for theta, a ratio for scale.

    Attributes
    ----------
    name, unit : str
        x, y, scale or theta.
    sigma, sigma_error : float
        Standard deviation of one frame, and that of this figure. Right for errors that are
        independent from frame to frame.
    order : int
        Of the differences it is from: the lowest that the motion leaves undisturbed.
    by_order : tuple of float
        Estimates from differences of order 0 (the scatter about the mean) to `MOST_ORDER` + 1.
    by_order_error : tuple of float
    frames : int
        Differences of that order.
    outliers : int
        Differences of that order that were left out.
    motion : float
        Scatter about the mean that the noise does not explain: rms motion of the scene.
    moved : bool
        Whether that is more than chance.
    drift_left : bool
        Whether the highest order still sees motion: then `sigma` is too large.
    fast_motion : bool
        Whether estimates grow with the order: motion near half the frame rate, or errors that
        alternate; then `sigma` holds it.
    stated : float
        Root mean square of the errors stated with the poses.
    bound : float
        Cramer-Rao bound with rounding; NaN without a system.
    """

    name: str
    unit: str
    sigma: float
    sigma_error: float
    order: int
    by_order: tuple[float, ...]
    by_order_error: tuple[float, ...]
    frames: int
    outliers: int
    motion: float
    moved: bool
    drift_left: bool
    fast_motion: bool
    stated: float = math.nan
    bound: float = math.nan

    def as_dict(self) -> dict[str, Any]:
        """For JSON: unit in the names, None where there is no number."""
        end = f"_{self.unit}" if self.unit else ""
        values = {
            f"sigma{end}": self.sigma,
            f"sigma_error{end}": self.sigma_error,
            f"stated{end}": self.stated,
            f"bound{end}": self.bound,
            f"motion_rms{end}": self.motion,
            "ratio_to_stated": self.sigma / self.stated,
            "ratio_to_bound": self.sigma / self.bound,
        }
        return {name: v if math.isfinite(v) else None for name, v in values.items()} | {
            "order": self.order,
            f"by_order{end}": list(self.by_order),
            f"by_order_error{end}": list(self.by_order_error),
            "differences": self.frames,
            "outliers": self.outliers,
            "moved": self.moved,
            "drift_left": self.drift_left,
            "fast_motion": self.fast_motion,
        }


@dataclass(frozen=True)
class Resolution:
    """Resolution per frame of x, y, scale and rotation.

    Attributes
    ----------
    frames : int
        Frames with a position.
    scatters : dict of str to Scatter
        By name: x, y, scale, theta.
    """

    frames: int
    scatters: dict[str, Scatter]

    def __getitem__(self, name: str) -> Scatter:
        return self.scatters[name]

    @property
    def remarks(self) -> list[str]:
        """What the figures do not say by themselves, in sentences."""
        said = []
        for one in self.scatters.values():
            if one.moved:
                said.append(
                    f"the scene moved: {_amount(one.motion, one.unit)} rms of what is seen in "
                    f"{one.name} is motion; differences of order {one.order} leave it out"
                )
            if one.drift_left:
                said.append(
                    f"{one.name} moves so fast that differences of order {one.order} still see "
                    "it: the figure is an upper limit"
                )
            if one.fast_motion:
                said.append(
                    f"{one.name} scatters more at the highest frequencies: vibration near half "
                    "the frame rate cannot be told from noise"
                )
            if one.outliers:
                said.append(f"{one.outliers} differences of {one.name} left out as outliers")
        return said

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "frames": self.frames,
            **{name: one.as_dict() for name, one in self.scatters.items()},
            "remarks": self.remarks,
        }


def resolution(track: Track, system: System | None = None) -> Resolution:
    """Scatter of a single frame, from the differences between successive frames.

    Parameters
    ----------
    track : Track
        Of repeated images of one scene, in the order in which they were taken. Frames without
        a position, and gaps in the numbers, interrupt it.
    system : System, optional
        For the bound at the median pose; it must state its noise.

    Returns
    -------
    Resolution

    Raises
    ------
    ValueError
        If there are too few successive frames with a position.
    """
    ok = track.ok
    limits = _limits(track, system)
    found = {}
    for name, column in _COLUMNS.items():
        factor = _FACTORS[name]
        values = np.where(ok, getattr(track, column), np.nan) * factor
        stated = getattr(track, f"sigma_{column}")[ok] * factor
        found[name] = difference_scatter(
            values,
            track.frame,
            name=name,
            stated=float(np.sqrt(np.mean(stated**2))) if ok.any() else math.nan,
            limit=limits[name],
        )
    return Resolution(int(ok.sum()), found)


def _limits(track: Track, system: System | None) -> dict[str, float]:
    if system is None or system.noise_law is None or not track.ok.any():
        return dict.fromkeys(_COLUMNS, math.nan)
    here = track[track.ok]
    pose = (np.median(here.x_um), np.median(here.y_um), np.median(here.theta_rad))
    least: Bound = bound(system, tuple(float(v) for v in pose), rounding=True)
    return {
        "x": least.sigma_x_nm,
        "y": least.sigma_y_nm,
        "scale": least.sigma_scale,
        "theta": least.sigma_theta_rad,
    }


def difference_scatter(
    values: NDArray[np.float64],
    frame: NDArray[np.int64],
    *,
    name: str = "x",
    stated: float = math.nan,
    limit: float = math.nan,
) -> Scatter:
    """Scatter of one series.

    Parameters
    ----------
    values : ndarray, shape (n,)
        NaN where there is none.
    frame : ndarray, shape (n,)
        Numbers of the frames; only those that follow each other at the usual step are compared.
    name : str
        Which coordinate it is.
    stated, limit : float
        What the result is to be compared with.

    Raises
    ------
    ValueError
        If there are too few successive values.
    """
    stride = int(np.median(np.diff(frame))) if len(frame) > 1 else 1
    pieces = [_differences(values, frame, order, stride) for order in range(MOST_ORDER + 2)]
    kept = [_without_outliers(piece) for piece in pieces]
    if len(kept[-1]) < _LEAST:
        raise ValueError(
            f"there are only {len(kept[-1])} runs of {MOST_ORDER + 2} successive frames with a "
            f"position; {_LEAST} are needed"
        )
    variances = [float(np.mean(piece**2)) / binom(2 * p, p) for p, piece in enumerate(kept)]
    counts = [len(piece) for piece in kept]
    order = 1
    while order < MOST_ORDER and _excess(variances, counts, order, order + 1) > _SIGNIFICANT:
        order += 1
    errors = [
        math.sqrt(v * _covariance(p, p) / (2 * n))
        for p, (v, n) in enumerate(zip(variances, counts, strict=True))
    ]
    left = _excess(variances, counts, order, order + 1)
    return Scatter(
        name=name,
        unit=_UNITS[name],
        sigma=math.sqrt(variances[order]),
        sigma_error=errors[order],
        order=order,
        by_order=tuple(math.sqrt(v) for v in variances),
        by_order_error=tuple(errors),
        frames=counts[order],
        outliers=len(pieces[order]) - counts[order],
        motion=math.sqrt(max(0.0, variances[0] - variances[order])),
        moved=_excess(variances, counts, 0, order) > _SIGNIFICANT,
        drift_left=order == MOST_ORDER and left > _SIGNIFICANT,
        fast_motion=_excess(variances, counts, 1, 2) < -_SIGNIFICANT,
        stated=stated,
        bound=limit,
    )


def _differences(
    values: NDArray[np.float64], frame: NDArray[np.int64], order: int, stride: int
) -> NDArray[np.float64]:
    """Differences of an order between frames that follow each other; order 0: from the mean."""
    if order == 0:
        finite = values[np.isfinite(values)]
        return finite - finite.mean() if len(finite) else finite
    steps = np.diff(values, order)
    steps = steps[frame[order:] - frame[:-order] == order * stride]
    return steps[np.isfinite(steps)]


def _without_outliers(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without what Gaussian noise has less than once in 10^8 values.

    The cut is found robustly, and the rest taken with full efficiency.
    """
    if not len(values):
        return values
    scale = median_abs_deviation(values, scale="normal")
    return values[np.abs(values - np.median(values)) <= _CUT * scale] if scale > 0 else values


@lru_cache
def _filter(order: int) -> NDArray[np.float64]:
    """Weights of a difference, normalised so that white noise keeps its variance."""
    weights = np.array([(-1) ** k * binom(order, k) for k in range(order + 1)])
    return np.asarray(weights / math.sqrt(binom(2 * order, order)))


def _covariance(p: int, q: int) -> float:
    """Covariance of two estimates of a variance, in units of 2 sigma^4 / n.

    For Gaussian noise it is the sum of the squared correlations of the two differences.
    """
    return float(np.sum(np.correlate(_filter(p), _filter(q), "full") ** 2))


def _difference_variance(p: int, q: int) -> float:
    """Variance of the difference of two estimates, in the same units."""
    return _covariance(p, p) + _covariance(q, q) - 2 * _covariance(p, q)


def _excess(variances: list[float], counts: list[int], lower: int, higher: int) -> float:
    """By how many standard deviations an order sees more than a higher one.

    Of the logarithms: their errors are nearest to Gaussian, and do not depend on the scatter.
    """
    if not (variances[lower] > 0 and variances[higher] > 0):
        return 0.0
    spread = math.sqrt(2 * _difference_variance(lower, higher) / counts[higher])
    return math.log(variances[lower] / variances[higher]) / spread


def _amount(value: float, unit: str) -> str:
    if unit == "nm":
        if value >= 1e4:
            return f"{1e-3 * value:.4g} µm" if value < 1e7 else f"{1e-6 * value:.4g} mm"
        return f"{value:.3g} nm" if value >= 0.1 else f"{1e3 * value:.3g} pm"
    return f"{1e6 * value:.3g} {'µrad' if unit else '1e-6'}"
