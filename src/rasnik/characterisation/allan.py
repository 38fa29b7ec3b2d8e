"""Allan deviation: how far means over a time differ from those over the next.

The position itself is averaged, as one does to know it better: its deviation at an averaging time
tau falls as tau^-1/2 while the noise is white, and rises where drift sets in. (For clocks this is
the deviation of the frequency, with the position in the place of the frequency.)

Source: W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), equations 11
and (degrees of freedom, white noise) table 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.gaps import Series

__all__ = ["Allan", "allan"]

_LEAST = 3  # differences that a deviation is taken from


@dataclass(frozen=True, eq=False)
class Allan:
    """Overlapping Allan deviation.

    Attributes
    ----------
    tau_s : ndarray, shape (m,)
        Averaging times.
    deviation, error : ndarray, shape (m,)
        In the unit of the series; the error is right for white noise.
    differences : ndarray of int, shape (m,)
        Differences of successive means that each is from.
    unit : str
    """

    tau_s: NDArray[np.float64]
    deviation: NDArray[np.float64]
    error: NDArray[np.float64]
    differences: NDArray[np.int64]
    unit: str

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        end = f"_{self.unit}" if self.unit else ""
        return {
            "tau_s": self.tau_s.tolist(),
            f"deviation{end}": self.deviation.tolist(),
            f"error{end}": self.error.tolist(),
            "differences": self.differences.tolist(),
        }


def allan(series: Series, frames: NDArray[np.int64] | None = None) -> Allan:
    """Overlapping Allan deviation of a series.

    Parameters
    ----------
    series : Series
        Where a frame is missing, the differences that would hold it are left out.
    frames : ndarray of int, optional
        Numbers of frames that are averaged; by default five for each factor of ten.

    Raises
    ------
    ValueError
        If a number of frames is below 1, or no averaging time leaves enough differences.
    """
    n = len(series)
    if frames is None:
        most = max(n // 2, 1)
        frames = np.unique(np.rint(np.geomspace(1, most, 5 * len(str(most)) + 1)).astype(int))
    frames = np.asarray(frames, dtype=np.int64)
    if (frames < 1).any():
        raise ValueError("means are taken over one frame at least")
    ok = np.isfinite(series.values)
    offset = np.mean(series.values[ok]) if ok.any() else 0.0  # for the digits of the sums
    sums = np.concatenate([[0.0], np.cumsum(np.where(ok, series.values - offset, 0.0))])
    gaps = np.concatenate([[0], np.cumsum(~ok)])
    rows = []
    for m in frames[frames <= n // 2].tolist():
        whole = gaps[2 * m :] == gaps[: -2 * m]
        steps = (sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m])[whole] / m
        if len(steps) >= _LEAST:
            deviation = float(np.sqrt(np.mean(steps**2) / 2))
            freedom = _freedom(len(steps) + 2 * m - 1, m)
            rows.append((m, deviation, deviation / np.sqrt(2 * freedom), len(steps)))
    if not rows:
        raise ValueError("there are too few successive frames for an Allan deviation")
    taken, deviations, errors, counts = (np.array(column) for column in zip(*rows, strict=True))
    return Allan(taken / series.rate_hz, deviations, errors, counts, series.unit)


def _freedom(frames: int, m: int) -> float:
    """Degrees of freedom of the variance, for white noise."""
    points = frames + 1
    ratio = 3 * (points - 1) / (2 * m) - 2 * (points - 2) / points
    return max(1.0, ratio * 4 * m**2 / (4 * m**2 + 5))
