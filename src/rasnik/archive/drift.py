"""Drift over a long time: a line through what scatters, jumps and wanders.

Positions over days do not scatter independently of each other: temperature, settling and air
move them for hours. The error of the line therefore counts only as many independent points as
the correlation of neighbours leaves.

1. The time is divided into equal bins; the median of each is taken, so that single wrong
   positions do not count.
2. The slope is the median of the slopes between all pairs of bins (H. Theil, Proc. Kon. Ned.
   Akad. Wet. 53 (1950) 386; P. K. Sen, J. Am. Stat. Assoc. 63 (1968) 1379).
3. Its error is that of a least-squares line through n_e points, n_e = n (1 - r)/(1 + r), where
   r is the correlation of residuals in neighbouring bins (B. D. Santer et al., Int. J. Climatol.
   28 (2008) 1703), freed of the bias that the fit of a line gives it. It is taken for several
   widths of the bins, and the largest error counts, which makes it about 13 % too large where
   the correlation is short (measured with autoregressive scatter). What wanders on all time
   scales is still correlated in the widest bins; that is said, as no error of a line covers it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

__all__ = ["Drift", "drift"]

DAY_S = 86400.0

_BINS = 192
_COARSEST = 24
_LEAST_BINS = 8
_LEAST_EFFECTIVE = 4.0  # with fewer, an error says nothing
_LONG_MEMORY = 2.0  # correlation of the coarsest bins, in units of its error without memory
_CUT = 6.0  # robust standard deviations at which residuals are cut off
_EFFICIENCY = 3.0 / math.pi  # of the median of slopes, for Gaussian errors (Sen 1968)


@dataclass(frozen=True)
class Drift:
    """A line, or the reason why there is none.

    Attributes
    ----------
    slope, sigma : float
        Units of the values per day; NaN where not measured.
    correlation : float
        Of the residuals in neighbouring bins, for the width that sets the error.
    bins : int
        Bins of that width.
    effective : float
        Number of independent points that the correlation leaves.
    remark : str
        Why there is no slope, or no error of it; or that the error is a lower limit.
    """

    slope: float = math.nan
    sigma: float = math.nan
    correlation: float = math.nan
    bins: int = 0
    effective: float = math.nan
    remark: str = ""

    def as_dict(self) -> dict[str, Any]:
        """For JSON; None where not measured."""
        numbers = ("slope", "sigma", "correlation", "effective")
        values = {name: getattr(self, name) for name in numbers}
        known = {k: v if math.isfinite(v) else None for k, v in values.items()}
        return known | {"bins": self.bins, "remark": self.remark}


def drift(time_s: NDArray[np.float64], values: NDArray[np.float64]) -> Drift:
    """Slope of values over time, with an error that holds for scatter that is not white.

    Parameters
    ----------
    time_s, values : ndarray, shape (n,)
        In any order; what is not finite is left out.
    """
    known = np.isfinite(time_s) & np.isfinite(values)
    time_s, values = time_s[known], values[known]
    if not len(values):
        return Drift(remark="no position has a time")
    t, y = _medians((time_s - time_s.min()) / DAY_S, values)
    if len(t) < _LEAST_BINS:
        return Drift(remark=f"positions at {len(t)} times only; {_LEAST_BINS} are needed")
    lines = [_line(t, y)]
    while len(t) // 2 >= _COARSEST:
        t, y = _in_pairs(t), _in_pairs(y)
        lines.append(_line(t, y))
    return _judged(lines)


def _judged(lines: list[Drift]) -> Drift:
    """The slope of the finest bins with the largest error of all."""
    unsure = [line for line in lines if not math.isfinite(line.sigma)]
    line = unsure[0] if unsure else max(lines, key=lambda one: one.sigma)
    remark = line.remark
    coarsest = lines[-1]
    if not unsure and coarsest.correlation > _LONG_MEMORY / math.sqrt(coarsest.bins):
        remark = "it wanders on all time scales; the error is a lower limit"
    return replace(line, slope=lines[0].slope, remark=remark)


def _medians(
    days: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean time and median value of every bin that is not empty."""
    span = float(days.max())
    if not span > 0:
        return days[:1], values[:1]
    which = np.minimum((days / span * _BINS).astype(np.int64), _BINS - 1)
    order = np.lexsort((values, which))
    which = which[order]
    starts = np.flatnonzero(np.diff(which, prepend=-1))
    counts = np.diff(starts, append=len(which))
    middle = values[order[starts + (counts - 1) // 2]] + values[order[starts + counts // 2]]
    return np.add.reduceat(days[order], starts) / counts, middle / 2


def _in_pairs(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means of neighbours; an odd one at the end is left out."""
    return values[: len(values) // 2 * 2].reshape(-1, 2).mean(axis=1)


@lru_cache
def _pairs(n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of all pairs."""
    i, j = np.triu_indices(n, 1)
    return i, j


def _line(t: NDArray[np.float64], y: NDArray[np.float64]) -> Drift:
    i, j = _pairs(len(t))
    slope = float(np.median((y[j] - y[i]) / (t[j] - t[i])))
    residuals = y - slope * t
    residuals -= np.median(residuals)
    scale = float(median_abs_deviation(residuals, scale="normal"))
    if scale > 0:
        residuals = np.clip(residuals, -_CUT * scale, _CUT * scale)
    residuals -= residuals.mean()
    total = float(residuals @ residuals)
    n = len(t)
    if not total > 0:  # a line without any scatter
        return Drift(slope, 0.0, 0.0, n, float(n))
    measured = float(residuals[1:] @ residuals[:-1]) / total
    # Fitting a mean lowers it by (1 + 4 r)/n (M. G. Kendall, Biometrika 41 (1954) 403); a slope,
    # by about 1/n more.
    correlation = min(max((n * measured + 2) / (n - 4), 0.0), 1.0)
    effective = n * (1 - correlation) / (1 + correlation)
    if effective < _LEAST_EFFECTIVE:
        remark = "it wanders so slowly that the error of a line cannot be told"
        return Drift(slope, math.nan, correlation, n, effective, remark)
    spread = float(np.sum((t - t.mean()) ** 2))
    sigma = math.sqrt(total / (effective - 2) / spread / _EFFICIENCY)
    return Drift(slope, sigma, correlation, n, effective)
