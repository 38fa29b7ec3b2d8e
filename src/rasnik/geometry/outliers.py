"""Data snooping: which reading is wrong, which could not be told to be, and how wrong it must be.

With residuals v over their standard deviations, and the matrix R that makes residuals of errors,
w_i = v_i / sqrt(R_ii) of every right reading has a standard normal distribution. R_ii is the
redundancy of a reading: 1 if all others foretell it, 0 if none does. An error of a reading shows
to the part R_ii in its own residual; where that is 0, nothing can check the reading.

Source: Baarda, "A testing procedure for use in geodetic networks", Netherlands Geodetic
Commission, Publications on Geodesy 2 (5), Delft 1968.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["FALSE_ALARM", "POWER", "UNCHECKED", "Snooping", "snoop"]

Array = NDArray[np.float64]

#: Chance that any reading at all is named although all are right.
FALSE_ALARM = 0.01

#: Chance that an error of the detectable size is named.
POWER = 0.8

#: Redundancy below which nothing checks a reading: an error must exceed a thousand standard
#: deviations to leave one in its own residual.
UNCHECKED = 1e-3

# Two readings that explain the same misfit are told apart by odds of 100 to 1.
_ODDS = 2 * np.log(100.0)
_SAME_MISFIT = 0.5


@dataclass(frozen=True, eq=False)
class Snooping:
    """Tests of all rows of a fit.

    Attributes
    ----------
    redundancy : ndarray, shape (rows,)
        0..1.
    w : ndarray, shape (rows,)
        Normalised residuals, observed minus computed; NaN where nothing checks the row.
    detectable : ndarray, shape (rows,)
        Smallest error, in standard deviations of the reading, that is named with the chance
        `POWER`; infinite where nothing checks the row.
    limit : float
        Of ``|w|``, beyond which a row is wrong.
    worst : int or None
        The row that is most likely wrong.
    alternatives : tuple of int
        Rows that may be wrong in its place: the odds are less than 100 to 1.
    """

    redundancy: Array
    w: Array
    detectable: Array
    limit: float
    worst: int | None
    alternatives: tuple[int, ...]


def snoop(span: Array, residuals: Array, tested: NDArray[np.bool_]) -> Snooping:
    """Test the rows of a weighted fit.

    Parameters
    ----------
    span : ndarray, shape (rows, n)
        Orthonormal basis of what the parameters can do to the rows.
    residuals : ndarray, shape (rows,)
        Observed minus computed, over standard deviations; NaN if nothing was observed.
    tested : ndarray of bool, shape (rows,)
        Rows that can be wrong.

    Returns
    -------
    Snooping
    """
    from scipy.stats import norm

    redundancy = np.clip(1 - np.sum(span**2, axis=1), 0.0, 1.0)
    redundancy[redundancy < UNCHECKED] = 0.0
    checked = tested & (redundancy > 0)
    root = np.sqrt(np.where(checked, redundancy, np.nan))
    limit = float(norm.isf(FALSE_ALARM / max(2 * checked.sum(), 1)))
    w = residuals / root
    detectable = np.where(checked, (limit + norm.ppf(POWER)) / root, np.inf)
    if not np.isfinite(w).any() or np.nanmax(np.abs(w)) <= limit:
        return Snooping(redundancy, w, detectable, limit, None, ())
    worst = int(np.nanargmax(np.abs(w)))
    shared = -span @ span[worst]
    likeness = np.abs(shared) / (root * root[worst])
    rivals = (likeness > _SAME_MISFIT) & (w[worst] ** 2 - w**2 < _ODDS)
    rivals[worst] = False
    return Snooping(
        redundancy, w, detectable, limit, worst, tuple(int(k) for k in np.flatnonzero(rivals))
    )
