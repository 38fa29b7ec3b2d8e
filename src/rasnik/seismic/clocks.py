"""Series of several stations brought to one clock: as they are, or resampled knowingly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rasnik.characterisation.gaps import Series, aligned

__all__ = ["on_one_clock", "resampled"]

#: Neighbours on each side that a resampled value is made of, in intervals of the slower grid.
_REACH = 24
_KAISER = 10.0
#: Values made at a time, which bounds the memory.
_PIECE = 4096


def on_one_clock(stations: Sequence[Series], *, resample_hz: float | None = None) -> list[Series]:
    """The stretch of time that all stations share, with a value only where every one has it.

    Parameters
    ----------
    stations : sequence of Series
    resample_hz : float, optional
        Rate to bring all to, see `resampled`. By default different rates, or frames that fall
        between each other, are refused.

    Returns
    -------
    list of Series
        Of one length, rate and start.

    Raises
    ------
    ValueError
        If there are less than two stations, they share no time, or their frames do not lie
        beside each other and no rate is given.
    """
    series = list(stations)
    if len(series) < 2:
        raise ValueError(f"a network has two stations at least, not {len(series)}")
    if resample_hz is not None:
        start_s = max(one.start_s for one in series)
        series = [resampled(one, resample_hz, start_s) for one in series]
    else:
        for other in series[1:]:
            try:
                aligned(series[0], other)
            except ValueError as error:
                raise ValueError(
                    f"{series[0].name} and {other.name}: {error}; give a rate to resample to"
                ) from None
    first = series[0]
    shifts = [round((one.start_s - first.start_s) * first.rate_hz) for one in series]
    begin = max(shifts)
    length = min(shift + len(one) for shift, one in zip(shifts, series, strict=True)) - begin
    if length < 1:
        raise ValueError("the stations have no time in common")
    parts = np.array(
        [one.values[begin - k : begin - k + length] for k, one in zip(shifts, series, strict=True)]
    )
    parts[:, ~np.isfinite(parts).all(axis=0)] = np.nan
    start_s = first.start_s + begin / first.rate_hz
    return [
        replace(one, values=values, rate_hz=first.rate_hz, start_s=start_s)
        for one, values in zip(series, parts, strict=True)
    ]


def resampled(series: Series, rate_hz: float, start_s: float | None = None) -> Series:
    """A series at another rate, or at times between its own.

    Every value is a weighted mean of the neighbours (a sinc in a window of Kaiser), below half of
    the slower rate: right to 1e-4 up to 0.4 of it, and nothing left from 0.6 of it on. A value is
    missing where a neighbour is.

    Parameters
    ----------
    series : Series
    rate_hz : float
    start_s : float, optional
        Time of the first value; by default that of the series.

    Raises
    ------
    ValueError
        If the rate is not above 0, or nothing of the series is left.
    """
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise ValueError(f"the rate must be a number of hertz above 0, not {rate_hz}")
    start_s = series.start_s if start_s is None else start_s
    ratio = series.rate_hz / rate_hz
    offset = (start_s - series.start_s) * series.rate_hz
    count = math.floor((len(series) - 1 - offset) / ratio + 1e-6) + 1
    if count < 1:
        raise ValueError(f"{series.name} has ended at the time from which it is resampled")
    # Below 1: the new grid is the slower one, and the filter that much narrower.
    width = min(1.0, 1 / ratio)
    reach = math.ceil(_REACH / width)
    place = offset + ratio * np.arange(count)
    nearest = np.rint(place).astype(np.int64)
    k = np.arange(-reach, reach + 1)
    padded = np.pad(series.values, reach, constant_values=np.nan)
    values = np.full(count, np.nan)
    inside = (nearest >= 0) & (nearest < len(series))
    for first in range(0, count, _PIECE):
        own = first + np.flatnonzero(inside[first : first + _PIECE])
        distance = k - (place[own] - nearest[own])[:, None]
        window = np.i0(_KAISER * np.sqrt(np.clip(1 - (distance / (reach + 1)) ** 2, 0, None)))
        weight = np.sinc(width * distance) * window
        weight /= weight.sum(axis=1, keepdims=True)
        values[own] = np.einsum("nk,nk->n", weight, padded[nearest[own, None] + k + reach])
    return replace(series, values=values, rate_hz=float(rate_hz), start_s=float(start_s))
