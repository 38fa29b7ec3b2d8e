"""Rows of a channel as the page needs them: the last ones, torn where frames are missing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.web.quantities import QUANTITIES

__all__ = ["last_rows", "torn"]

_SAMPLE = 256  # rows from which it is judged how many come in a second
_SPARE = 1.2


def last_rows(recent: Any, seconds: float) -> tuple[NDArray[Any], int]:
    """Rows of the last seconds, and the index to continue from.

    Taking rows keeps the thread that adds them waiting, so no more are taken than needed.
    """
    rows, following = recent.since(max(0, recent.count - _SAMPLE))
    if len(rows) < 2:
        return rows, following
    span_s = float(rows["received_s"][-1] - rows["received_s"][0])
    if span_s < seconds:
        rate_hz = len(rows) / max(span_s, 1e-3)
        wanted = int(min(_SPARE * rate_hz * seconds + _SAMPLE, np.iinfo(np.int32).max))
        rows, following = recent.since(max(0, following - wanted))
    return rows[rows["received_s"] >= rows["received_s"][-1] - seconds], following


def torn(rows: NDArray[Any], before: int | None) -> NDArray[Any]:
    """Rows, with an empty one wherever numbers are left out: no line is drawn across.

    Parameters
    ----------
    rows : structured array
        As in `Channel.recent`.
    before : int or None
        Number of the frame before the first of these rows, if there was one.
    """
    numbers = rows["frame"]
    steps = np.diff(numbers, prepend=numbers[:1] - 1 if before is None else before)
    gaps = np.flatnonzero(steps > 1)
    if not len(gaps):
        return rows
    blank = rows[gaps]
    for quantity in QUANTITIES:
        blank[quantity.column] = np.nan
    return np.insert(rows, gaps, blank)
