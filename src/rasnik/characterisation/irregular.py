"""Spectra of frames at irregular times, by the periodogram of Lomb and Scargle.

A sinusoid is fitted at each frequency, so no value is invented between the frames; but what is
faster than half of the mean rate is folded in as in an even series, only blurred; and a strong line
raises all around it, by as much as the times are irregular. Windows are
those of Welch's method, Hann's and half overlapping in time; on even times the result is that of
`rasnik.characterisation.spectrum.welch`.

Source: J. D. Scargle, Astrophys. J. 263 (1982) 835.
"""

from __future__ import annotations

import numpy as np

from rasnik.characterisation.gaps import column_values
from rasnik.characterisation.spectrum import LEAST_WINDOW, Spectrum
from rasnik.tracking.track import Track

__all__ = ["lomb_scargle"]

#: Longest window that is taken unasked: the time it takes grows as its square.
_LONGEST = 1024
_WINDOWS = 100
_LEAST_FILLED = 0.5  # of the frames that a window should hold


def lomb_scargle(
    track: Track,
    column: str = "x_um",
    *,
    windows: int | None = None,
    length_s: float | None = None,
) -> Spectrum:
    """One-sided power spectral density from the times that the frames have.

    Parameters
    ----------
    track : Track
        With times that increase.
    column : str
    windows, length_s : optional
        As for `welch`; by default 100 windows or more, of 1024 frames at most. Windows with less
        than half of the usual number of frames are left out.

    Raises
    ------
    ValueError
        If times are unknown or do not increase, there is no such column, or windows are too short.
    """
    from scipy.signal import lombscargle

    if windows is not None and length_s is not None:
        raise ValueError("the number of windows and their length cannot both be given")
    values, unit = column_values(track, column)
    known = np.isfinite(values)
    if not np.isfinite(track.time_s[known]).all():
        raise ValueError("the periodogram needs the time of every frame with a position")
    values, time_s = values[known], track.time_s[known]
    if len(values) < LEAST_WINDOW:
        raise ValueError(f"there are only {len(values)} frames with a position")
    steps_s = np.diff(time_s)
    if (steps_s <= 0).any():
        raise ValueError("the times go back or stand still")
    rate_hz = 1 / float(np.mean(steps_s[steps_s < 3 * np.median(steps_s)]))
    if length_s is not None:
        length = round(length_s * rate_hz)
    else:
        length = int(2 * len(values) / ((windows or _WINDOWS) + 1))
        if windows is None:
            length = min(max(length, min(256, len(values) // 4)), _LONGEST)
    length -= length % 2
    if not LEAST_WINDOW <= length <= len(values):
        raise ValueError(
            f"windows of {length} frames do not suit a track of {len(values)}; "
            f"{LEAST_WINDOW} frames are the least"
        )
    span_s = length / rate_hz
    frequency_hz = np.arange(1, length // 2 + 1) / span_s
    # A whole number of half windows; the last frame closes its interval.
    count = max(1, int(np.floor(2 * ((time_s[-1] - time_s[0]) * rate_hz + 1.001) / length)) - 1)
    starts_s = time_s[0] + np.arange(count) * span_s / 2
    total, kept, pairs, before = np.zeros(len(frequency_hz)), 0, 0, False
    for start_s in starts_s:
        first, last = np.searchsorted(time_s, [start_s, start_s + span_s - 1e-3 / rate_hz])
        filled = last - first >= _LEAST_FILLED * length
        if filled:
            own_s = time_s[first:last] - start_s
            hann = 0.5 - 0.5 * np.cos(2 * np.pi * own_s / span_s)
            shown = (values[first:last] - values[first:last].mean()) * hann
            power = lombscargle(own_s, shown, 2 * np.pi * frequency_hz)
            total += 2 * len(own_s) * power / (rate_hz * np.sum(hann**2))
            kept += 1
            pairs += before
        before = filled
    if not kept:
        raise ValueError("no window holds enough frames; take longer ones")
    psd = total / kept
    psd[-1] /= 2  # half the rate has no partner at negative frequencies
    return Spectrum(
        frequency_hz, psd, column, unit, rate_hz, length, kept, int(pairs), count - kept,
        len(values), int((~known).sum()), 0, method="lomb-scargle",
    )  # fmt: skip
