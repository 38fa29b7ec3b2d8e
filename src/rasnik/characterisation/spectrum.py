"""Welch spectra of tracks: amplitude spectral density, integrated rms, coherence.

All spectral densities are one-sided: the integral over the frequencies above zero is the
variance. White noise of sigma per frame at f frames a second has the amplitude spectral density
sigma sqrt(2 / f). The paper quotes sigma / sqrt(f), smaller by sqrt(2).

Windows are Hann's with an overlap of one half, as in the paper. Each is computed by
`scipy.signal.welch`; where frames are missing, each stretch without a gap is, and the windows of
all are averaged.

Source: P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70, also for what the overlap of
the windows does to the variance of their mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.gaps import Series, aligned

__all__ = ["Coherence", "Spectrum", "coherence", "logarithmic", "welch", "window_length"]

#: Windows that a series is divided into if nothing else is asked.
WINDOWS = 100
#: Shortest window; fewer frames have no spectrum to speak of.
LEAST_WINDOW = 16


@dataclass(frozen=True, eq=False)
class Spectrum:
    """A one-sided spectrum.

    Attributes
    ----------
    frequency_hz, psd : ndarray, shape (m,)
        One-sided power spectral density, in unit^2 / Hz.
    name, unit : str
        Of the column.
    rate_hz : float
    window : int
        Frames in a window; 0 where it is not one number.
    segments : int
        Windows that were averaged.
    pairs : int
        How many of them overlap with the next.
    left_out : int
        Windows that the series would have without gaps, less those it has.
    frames, missing, unused : int
        Frames with a value; places without; frames that lie in no window.
    method : str
        ``welch`` or ``lomb-scargle``.
    """

    frequency_hz: NDArray[np.float64]
    psd: NDArray[np.float64]
    name: str
    unit: str
    rate_hz: float
    window: int
    segments: int
    pairs: int
    left_out: int
    frames: int
    missing: int
    unused: int
    method: str = "welch"

    @property
    def asd(self) -> NDArray[np.float64]:
        """One-sided amplitude spectral density, unit / sqrt(Hz)."""
        return np.sqrt(self.psd)

    @property
    def resolution_hz(self) -> float:
        """Distance of two bins."""
        return float(self.frequency_hz[1] - self.frequency_hz[0])

    @property
    def averages(self) -> float:
        """Effective number of averages: independent windows that would scatter as much."""
        overlap = self.correlation[1, 0] / self.correlation[0, 0]
        return self.segments / (1 + 2 * self.pairs / self.segments * overlap)

    @property
    def relative_error(self) -> float:
        """Standard deviation of a bin of the PSD, as a fraction of it."""
        return 1 / math.sqrt(self.averages)

    @cached_property
    def correlation(self) -> NDArray[np.float64]:
        """Covariance of periodograms of white noise, shape (2, window).

        Of two bins of one window (row 0) and of a window and the next (row 1), by the
        distance of the bins, for periodograms of mean 1.
        """
        hann = hann_window(self.window)
        half = self.window - self.window // 2
        power = float(np.sum(hann**2))
        own = np.abs(np.fft.fft(hann**2)) ** 2 / power**2
        next_ = np.zeros(self.window)
        next_[half:] = hann[half:] * hann[: self.window - half]
        return np.array([own, np.abs(np.fft.fft(next_)) ** 2 / power**2])

    @property
    def bin_correlation(self) -> NDArray[np.float64]:
        """Correlation of averaged bins by their distance, shape (window,)."""
        covariance = self.correlation[0] + 2 * self.pairs / self.segments * self.correlation[1]
        return np.asarray(covariance / covariance[0])

    @cached_property
    def cumulative_rms(self) -> NDArray[np.float64]:
        """Root mean square of all above each frequency, shape (m,), in the unit."""
        power = self.psd * self.resolution_hz
        return np.sqrt(np.cumsum(power[::-1])[::-1])

    def rms(self, low_hz: float = 0.0, high_hz: float = math.inf) -> float:
        """Root mean square within a band, in the unit."""
        inside = (self.frequency_hz >= low_hz) & (self.frequency_hz <= high_hz)
        return math.sqrt(float(self.psd[inside].sum()) * self.resolution_hz)

    def as_dict(self) -> dict[str, Any]:
        """For JSON, without the curve."""
        return {
            "method": self.method,
            "convention": "one-sided",
            "rate_hz": self.rate_hz,
            "window": "hann",
            "overlap": 0.5,
            "window_frames": self.window,
            "resolution_hz": self.resolution_hz,
            "windows": self.segments,
            "windows_left_out": self.left_out,
            "effective_averages": self.averages,
            "frames": self.frames,
            "frames_missing": self.missing,
            "frames_unused": self.unused,
        }


@dataclass(frozen=True, eq=False)
class Coherence:
    """Magnitude-squared coherence of two series.

    Attributes
    ----------
    frequency_hz, coherence : ndarray, shape (m,)
    names : tuple of str
    averages : float
        Effective number of averages.
    """

    frequency_hz: NDArray[np.float64]
    coherence: NDArray[np.float64]
    names: tuple[str, str]
    averages: float

    def threshold(self, chance: float = 0.01) -> float:
        """What two independent series exceed in a bin with this probability.

        Source: G. C. Carter, Proc. IEEE 75 (1987) 236.
        """
        if self.averages <= 1:
            return 1.0
        return float(1 - chance ** (1 / (self.averages - 1)))


def hann_window(length: int) -> NDArray[np.float64]:
    """Hann's window as `scipy.signal.welch` takes it."""
    return np.asarray(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length))


def window_length(
    series: Series, *, windows: int | None = None, length_s: float | None = None
) -> int:
    """Frames in a window.

    Parameters
    ----------
    series : Series
    windows : int, optional
        Number of windows, half overlapping, that frames without gaps are divided into; as near
        as windows of an even number of frames come to it.
    length_s : float, optional
        Length of a window instead. By default there are `WINDOWS` windows, or more if gaps do
        not leave half of the frames in unbroken stretches of that length.

    Raises
    ------
    ValueError
        If both are given, or no unbroken stretch of frames is as long.
    """
    if windows is not None and length_s is not None:
        raise ValueError("the number of windows and their length cannot both be given")
    lengths = np.sort([len(run) for run in series.runs()])[::-1]
    longest = int(lengths[0]) if len(lengths) else 0
    if length_s is not None:
        if not (math.isfinite(length_s) and length_s > 0):
            raise ValueError(f"the length of a window must be above 0 s, not {length_s}")
        length = round(length_s * series.rate_hz)
    else:
        if windows is not None and windows < 1:
            raise ValueError(f"there must be one window at least, not {windows}")
        length = int(2 * series.valid / ((windows or WINDOWS) + 1))
    if windows is None and length_s is None:
        held = np.searchsorted(np.cumsum(lengths), series.valid / 2)
        typical = int(lengths[held]) if len(lengths) else 0
        length = min(max(length, min(256, series.valid // 4)), typical)
    length -= length % 2 if length > 2 else 0
    if length < LEAST_WINDOW:
        raise ValueError(
            f"windows of {length} frames are too short for a spectrum ({LEAST_WINDOW} are needed); "
            "take fewer or longer windows, or more frames"
        )
    if length > longest:
        raise ValueError(
            f"a window of {length} frames finds no place: the longest stretch without a missing "
            f"frame has {longest}; take shorter windows"
        )
    return length


def welch(series: Series, *, windows: int | None = None, length_s: float | None = None) -> Spectrum:
    """One-sided power spectral density by Welch's method, Hann windows, half overlapping.

    Without gaps it is ``scipy.signal.welch(values, rate, "hann", window)`` to the last bit.

    Parameters
    ----------
    series : Series
        Windows with a missing frame are left out; stretches too short for one are not used.
    windows, length_s : optional
        As in `window_length`.

    Raises
    ------
    ValueError
        As `window_length`.
    """
    from scipy import signal

    length = window_length(series, windows=windows, length_s=length_s)

    def one(run: NDArray[np.float64]) -> Any:
        return signal.welch(run, series.rate_hz, "hann", length)

    frequency_hz, psd, segments, pairs = _over_runs(one, series.runs(), length)
    step = length - length // 2
    whole = _count(len(series), length)
    used = sum(length + step * (_count(len(r), length) - 1) for r in _usable(series, length))
    return Spectrum(
        frequency_hz, psd, series.name, series.unit, series.rate_hz, length, segments, pairs,
        max(0, whole - segments), series.valid, series.missing, series.valid - used,
    )  # fmt: skip


def coherence(
    one: Series,
    other: Series,
    *,
    windows: int | None = None,
    length_s: float | None = None,
) -> Coherence:
    """Magnitude-squared coherence of two series over the time that they share.

    Without gaps it is that of `scipy.signal.coherence`.

    Raises
    ------
    ValueError
        As `aligned` and `window_length`; and if there are less than two windows, of which the
        coherence is 1 whatever they hold.
    """
    from scipy import signal

    first, second = aligned(one, other)
    length = window_length(first, windows=windows, length_s=length_s)
    joint = [a + 1j * b for a, b in zip(first.runs(), second.runs(), strict=True)]

    def densities(run: NDArray[np.complex128]) -> Any:
        options = (first.rate_hz, "hann", length)
        frequency_hz, cross = signal.csd(run.real, run.imag, *options)
        own = [signal.welch(part, *options)[1] for part in (run.real, run.imag)]
        return frequency_hz, np.array([cross, *own])

    frequency_hz, (cross, xx, yy), segments, pairs = _over_runs(densities, joint, length)
    if segments < 2:
        raise ValueError("a coherence needs two windows at least; take more or shorter ones")
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = np.abs(cross) ** 2 / (xx.real * yy.real)
    like = Spectrum(
        frequency_hz, xx.real, one.name, one.unit, first.rate_hz, length,
        segments, pairs, 0, 0, 0, 0,
    )  # fmt: skip
    return Coherence(frequency_hz, squared, (one.name, other.name), like.averages)


def logarithmic(series: Series, points: int = 500) -> tuple[NDArray[np.float64], Any]:
    """One-sided PSD at frequencies evenly spaced in their logarithm.

    Long windows at low frequencies, short ones at high; by speckit, with Hann windows half
    overlapping. Needs ``pip install "rasnik[spectrum]"``.

    Parameters
    ----------
    series : Series
        Without anything missing.
    points : int
        Frequencies wanted; there are about as many.

    Returns
    -------
    frequency_hz, psd : ndarray, shape (m,)

    Raises
    ------
    ValueError
        If frames are missing.
    ImportError
        If speckit is not installed.

    References
    ----------
    M. Troebs and G. Heinzel, Measurement 39 (2006) 120.
    """
    import os

    if series.missing:
        raise ValueError(
            f"a logarithmic spectrum needs a series without gaps, and {series.missing} frames are "
            "missing; take a part of the track, or Welch's spectrum"
        )
    before = dict(os.environ)
    try:
        import speckit
    except ImportError as error:
        raise ImportError(
            'a logarithmic spectrum needs speckit; install it with: pip install "rasnik[spectrum]"'
        ) from error
    finally:  # speckit sets the number of threads for the whole program
        for name in set(os.environ) - set(before):
            del os.environ[name]
    found = speckit.compute_spectrum(
        series.values, fs=series.rate_hz, win="hann", olap=0.5, Jdes=points, bmin=3.0
    )
    return np.asarray(found.f), np.asarray(found.psd)


# ------------------------------------------------------------------------ windows over gaps


def _count(frames: int, length: int) -> int:
    """Windows that fit into a stretch."""
    return 1 + (frames - length) // (length - length // 2) if frames >= length else 0


def _usable(series: Series, length: int) -> list[NDArray[np.float64]]:
    return [run for run in series.runs() if len(run) >= length]


def _over_runs(
    estimate: Callable[[Any], Any], runs: list[Any], length: int
) -> tuple[NDArray[np.float64], Any, int, int]:
    """(frequencies, mean over all windows, windows, pairs that overlap)."""
    usable = [run for run in runs if len(run) >= length]
    counts = [_count(len(run), length) for run in usable]
    total = sum(counts)
    if len(usable) == 1:
        frequency_hz, mean = estimate(usable[0])
    else:
        mean = 0.0
        for run, count in zip(usable, counts, strict=True):
            frequency_hz, psd = estimate(run)
            mean = mean + psd * (count / total)
    return frequency_hz, mean, total, total - len(usable)
