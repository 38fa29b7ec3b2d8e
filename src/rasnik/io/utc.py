"""Seconds since 1970 UTC as times of day, and other seconds told apart from them."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

__all__ = ["EARLIEST_S", "utc_time"]

_ZERO = datetime(1970, 1, 1, tzinfo=UTC)
#: Times before this are not counted from 1970: no Rasnik had a digital camera then.
EARLIEST_S = datetime(1980, 1, 1, tzinfo=UTC).timestamp()


def utc_time(time_s: float) -> datetime | None:
    """The time of seconds since 1970, to a microsecond.

    None if it is not known or its zero cannot be 1970, as that of a camera's clock.
    """
    if not math.isfinite(time_s) or time_s < EARLIEST_S:
        return None
    try:
        return _ZERO + timedelta(seconds=time_s)
    except OverflowError:
        return None
