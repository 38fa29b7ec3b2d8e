"""A column of a track as an even series in which what is missing stays missing.

Spectra are sums over frames at equal intervals. Frames that never arrived or have no position are
NaN in the series, and nothing is put in their place: windows that would hold one are left out
(`runs`). Times that are not even are refused; see `rasnik.characterisation.irregular`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.tracking.track import TRACK_COLUMNS, Track

__all__ = ["COLUMNS", "IrregularTimesError", "Series", "aligned", "column_values", "even_series"]

#: Columns that have a spectrum, and the unit that they are stored in.
COLUMNS = {c.name: c.unit for c in TRACK_COLUMNS if c.name not in ("frame", "time_s", "flags")}

#: A frame may be this far from its place, as a fraction of the time between two.
TOLERANCE = 0.05

_UM_TO_NM = 1e3


class IrregularTimesError(ValueError):
    """Times that do not lie on an even grid."""


@dataclass(frozen=True, eq=False)
class Series:
    """Evenly sampled values.

    Attributes
    ----------
    values : ndarray, shape (n,)
        NaN where a frame is missing or has no position.
    rate_hz : float
        Places in a second.
    name, unit : str
        Of the column; lengths are in nm.
    start_s : float
        Time of the first place.
    """

    values: NDArray[np.float64]
    rate_hz: float
    name: str = "x_um"
    unit: str = "nm"
    start_s: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise ValueError(f"the rate must be a number of hertz above 0, not {self.rate_hz}")
        if np.ndim(self.values) != 1:
            raise ValueError(f"a series has one axis, not {np.ndim(self.values)}")

    def __len__(self) -> int:
        return len(self.values)

    @property
    def valid(self) -> int:
        """Places that have a value."""
        return int(np.isfinite(self.values).sum())

    @property
    def missing(self) -> int:
        """Places that have none."""
        return len(self) - self.valid

    def runs(self) -> list[NDArray[np.float64]]:
        """The stretches without anything missing, in their order."""
        edges = np.flatnonzero(np.diff(np.isfinite(self.values), prepend=False, append=False))
        return [self.values[a:b] for a, b in edges.reshape(-1, 2)]


def column_values(track: Track, column: str) -> tuple[NDArray[np.float64], str]:
    """(values, unit) of a column; lengths in nm, NaN where a frame has no position.

    Raises
    ------
    ValueError
        If there is no such column.
    """
    if column not in COLUMNS:
        raise ValueError(f"{column!r} is not one of the columns {', '.join(COLUMNS)}")
    values = np.where(track.ok, getattr(track, column), np.nan)
    unit = COLUMNS[column]
    return (values * _UM_TO_NM, "nm") if unit == "um" else (values, unit)


def even_series(
    track: Track,
    column: str = "x_um",
    *,
    rate_hz: float | None = None,
    tolerance: float = TOLERANCE,
) -> Series:
    """A column of a track on an even grid of times.

    Parameters
    ----------
    track : Track
        Frames that are left out of its numbers or its times are missing in the series.
    column : str
        Any column of numbers, such as ``"y_um"``.
    rate_hz : float, optional
        Frames in a second, for tracks without times: frames lie by their numbers then. By
        default what the metadata say (``frame_rate_hz``). With times it must not be given.
    tolerance : float
        How far a frame may be from its place, as a fraction of the time between two.

    Raises
    ------
    IrregularTimesError
        If the times are not regular.
    ValueError
        If there is no such column, times and rate are both unknown or both given, the rate is not
        above 0, or there are fewer than two frames.
    """
    values, unit = column_values(track, column)
    timed = np.isfinite(track.time_s)
    if not timed.any():
        place, rate = _by_number(track, rate_hz)
        start_s = int(track.frame[0]) / (rate_hz or _stated_rate(track))
        timed = np.ones(len(track), dtype=bool)
    elif rate_hz is not None:
        raise ValueError("the frames have times; a rate cannot be given as well")
    else:
        if (track.ok & ~timed).any():
            raise ValueError("some frames with a position have no time; take a part where all have")
        place, start_s, rate = _by_time(track, timed, tolerance)
    grid = np.full(int(place[-1]) + 1, np.nan)
    grid[place] = values[timed]
    return Series(grid, rate, column, unit, start_s)


def aligned(one: Series, other: Series) -> tuple[Series, Series]:
    """The stretch of time that two series share, with a value in one only where both have one.

    Raises
    ------
    ValueError
        If they have different rates, do not overlap, or their frames fall between each other.
    """
    length = max(len(one), len(other))
    if abs(one.rate_hz / other.rate_hz - 1) * length > TOLERANCE:
        raise ValueError(
            f"the rates differ ({one.rate_hz:.9g} and {other.rate_hz:.9g} Hz): frames do not stay "
            "beside each other"
        )
    shift = (other.start_s - one.start_s) * one.rate_hz
    whole = round(shift)
    if abs(shift - whole) > TOLERANCE:
        raise ValueError(
            f"the frames of one lie {shift - whole:+.2f} of an interval beside those of the other; "
            "a coherence needs frames taken at the same times"
        )
    a, b = max(whole, 0), max(-whole, 0)
    n = min(len(one) - a, len(other) - b)
    if n < 1:
        raise ValueError("the two have no time in common")
    first, second = one.values[a : a + n], other.values[b : b + n]
    both = np.isfinite(first) & np.isfinite(second)
    start_s = one.start_s + a / one.rate_hz
    return (
        Series(np.where(both, first, np.nan), one.rate_hz, one.name, one.unit, start_s),
        Series(np.where(both, second, np.nan), one.rate_hz, other.name, other.unit, start_s),
    )


# ------------------------------------------------------------------------ grids


def _stated_rate(track: Track) -> float:
    try:
        return float(track.metadata.get("frame_rate_hz", "nan"))
    except ValueError:
        return math.nan


def _by_number(track: Track, rate_hz: float | None) -> tuple[NDArray[np.int64], float]:
    """(places, places in a second) from numbers of frames."""
    rate = _stated_rate(track) if rate_hz is None else rate_hz
    if rate_hz is not None and not (math.isfinite(rate_hz) and rate_hz > 0):
        raise ValueError(f"the frame rate must be a number of hertz above 0, not {rate_hz:g}")
    if not rate > 0:
        raise ValueError("neither times nor a frame rate are known; give the rate")
    if len(track) < 2:
        raise ValueError("an even series needs more than one frame")
    steps = np.diff(track.frame)
    if (steps < 1).any():
        raise ValueError("the numbers of the frames must increase")
    stride = int(np.gcd.reduce(steps))  # every second frame, say
    return (track.frame - track.frame[0]) // stride, rate / stride


def _by_time(
    track: Track, timed: NDArray[np.bool_], tolerance: float
) -> tuple[NDArray[np.int64], float, float]:
    """(places, time of the first in s, places in a second) from times."""
    if np.count_nonzero(timed) < 2:
        raise ValueError("an even series needs more than one frame with a time")
    first_s = float(track.time_s[timed][0])
    time_s = track.time_s[timed] - first_s
    steps_s = np.diff(time_s)
    remedy = "take a part without the irregularity"
    if (steps_s <= 0).any():
        raise IrregularTimesError(f"the times go back or stand still; {remedy}")
    successive = np.diff(track.frame[timed]) == 1
    step_s = float(np.median(steps_s[successive] if successive.any() else steps_s))
    place = np.zeros(len(time_s), dtype=np.int64)
    place[1:] = np.cumsum(np.rint(steps_s / step_s))
    doubled = (np.diff(place) < 1).any()
    if not doubled:
        step_s, offset_s = (float(value) for value in np.polyfit(place, time_s, 1))
        off = float(np.abs(time_s - offset_s - place * step_s).max() / step_s)
    if doubled or off > tolerance:
        how = "two frames share one" if doubled else f"one is {off:.2g} of an interval beside it"
        raise IrregularTimesError(
            f"the times are not regular: each frame should have its place every {step_s:.4g} s, "
            f"but {how}; {remedy}"
        )
    return place, first_s + offset_s, _short(1 / step_s, int(place[-1]))


def _short(rate_hz: float, places: int) -> float:
    """A rate with as few digits as tell every place: 860 Hz, not 860.0000000001."""
    for digits in range(1, 17):
        rounded = float(f"{rate_hz:.{digits}g}")
        if abs(rounded / rate_hz - 1) * places < 1e-6:
            return rounded
    return rate_hz
