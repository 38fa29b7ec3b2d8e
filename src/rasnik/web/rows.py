"""The last rows of a channel, without copying all that is held."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["last_rows"]

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
