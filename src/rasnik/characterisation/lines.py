"""Peaks in a spectrum: what stands above its surroundings by more than chance allows.

Mains lines are named, also where they are aliases: a frame rate of 275 Hz shows the fifth and
the sixth harmonic of 50 Hz at 25 Hz.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.spectrum import Spectrum

__all__ = [
    "MAINS_HZ",
    "Line",
    "background",
    "find_lines",
    "mains_name",
    "median_of_average",
    "median_variance",
]

#: Frequencies of the mains in the world.
MAINS_HZ = (50.0, 60.0)
#: Probability that a spectrum of noise alone shows a peak anywhere.
CHANCE = 1e-3

_HARMONICS = 10
_MAINS_TOLERANCE = 1e-3  # grids are seldom more than 0.05 Hz away from 50
_MOST_HALF, _LEAST_HALF = 25, 5  # bins on either side that a bin is compared with
_NARROW = 3  # bins above half of the peak that a line without a width can have
_SKIRT = 2  # bins on either side of a peak that belong to it


@dataclass(frozen=True)
class Line:
    """A peak.

    Attributes
    ----------
    frequency_hz : float
    rms, rms_error : float
        Of the oscillation, the surroundings taken away, in the unit of the spectrum. The error is
        that of a steady line in white noise.
    significance : float
        Its power in standard deviations of that of the surroundings.
    ratio : float
        Highest PSD over that of the surroundings.
    width_hz : float
        At half of its height; 0 if the windows do not resolve it.
    low_hz, high_hz : float
        First and last bin that stand out.
    name : str
        Of the mains line that it may be; empty if it is none.
    """

    frequency_hz: float
    rms: float
    rms_error: float
    significance: float
    ratio: float
    width_hz: float
    low_hz: float
    high_hz: float
    name: str = ""

    def as_dict(self, unit: str = "") -> dict[str, Any]:
        """For JSON, the unit in the names."""
        end = f"_{unit}" if unit else ""
        values = asdict(self)
        return {f"{k}{end}" if k.startswith("rms") else k: v for k, v in values.items()}


def find_lines(
    spectrum: Spectrum, *, mains_hz: Sequence[float] = MAINS_HZ, chance: float = CHANCE
) -> tuple[Line, ...]:
    """All peaks, by frequency.

    A bin stands out if it exceeds the median of those around it by more than noise does once in
    1 / `chance` spectra. The few lowest bins have nothing below to compare with and are not looked
    at; peaks wider than about 20 bins are not seen as such.

    Parameters
    ----------
    spectrum : Spectrum
    mains_hz : sequence of float
        Frequencies of which harmonics are named.
    chance : float
    """
    from scipy.stats import f as f_distribution

    around, counts = background(spectrum)
    inside = counts > 0
    ratio = np.divide(spectrum.psd, around, out=np.zeros_like(around), where=around > 0)
    # The surroundings are uncertain themselves.
    error = median_variance(spectrum) / np.maximum(counts, 1)
    tail = f_distribution.sf(ratio, 2 * spectrum.averages, 2 / error)
    out = inside & (tail < chance / max(1, int(inside.sum())))
    found = []
    for first, last in _groups(np.flatnonzero(out)):
        found.append(_line(spectrum, around, first, last, mains_hz))
    return tuple(found)


def background(spectrum: Spectrum) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(PSD around each bin, bins it is from); 0 bins where it is not known.

    The median of as many bins below as above, which a slope does not disturb.
    """
    psd = spectrum.psd
    m = len(psd)
    around, counts = np.zeros(m), np.zeros(m, dtype=np.int64)
    place = np.arange(m)
    # Bin 0 and the last are of other distributions.
    half = np.minimum(np.minimum(place - 1, m - 2 - place), _MOST_HALF)
    for size in range(_LEAST_HALF, _MOST_HALF + 1):
        own = np.flatnonzero(half == size)
        if len(own):
            windows = psd[own[:, None] + np.arange(-size, size + 1)]
            around[own] = np.median(windows, axis=1)
            counts[own] = 2 * size + 1
    return around / median_of_average(spectrum), counts


def median_of_average(spectrum: Spectrum) -> float:
    """Median over mean of a bin of a spectrum of noise.

    A mean of K independent periodograms is distributed as chi-square of 2 K degrees of freedom.
    """
    from scipy.stats import chi2

    freedom = 2 * spectrum.averages
    return float(chi2.median(freedom) / freedom)


def mains_name(
    frequency_hz: float, rate_hz: float, resolution_hz: float, mains_hz: Sequence[float] = MAINS_HZ
) -> str:
    """What line of the mains a frequency may be, as ``alias of 5 x 50 Hz``; or nothing."""
    names = []
    for aliased in (False, True):
        for mains in mains_hz:
            for n in range(1, _HARMONICS + 1):
                true_hz = n * mains
                seen_hz = abs((true_hz + rate_hz / 2) % rate_hz - rate_hz / 2)
                near = resolution_hz + _MAINS_TOLERANCE * true_hz
                if seen_hz <= near:  # drift cannot be told from it
                    continue
                if (true_hz > rate_hz / 2) == aliased and abs(seen_hz - frequency_hz) <= near:
                    shown = f"{n} x {mains:g} Hz" if n > 1 else f"{mains:g} Hz"
                    names.append(f"alias of {shown}" if aliased else f"mains, {shown}")
                    break
        if names:  # the plain explanation first
            break
    return " or ".join(names)


def median_variance(spectrum: Spectrum) -> float:
    """Relative variance of the median of many bins, times their number.

    Medians of correlated Gaussian values have the covariance arcsin(rho), in units of the variance
    of one (J. Gastwirth and H. Rubin, Ann. Stat. 3 (1975) 1070).
    """
    return float(np.arcsin(np.minimum(spectrum.bin_correlation, 1)).sum() / spectrum.averages)


def _groups(bins: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First and last of those that lie together."""
    if not len(bins):
        return []
    parts = np.split(bins, np.flatnonzero(np.diff(bins) > _SKIRT + 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]


def _line(
    spectrum: Spectrum,
    around: NDArray[np.float64],
    first: int,
    last: int,
    mains_hz: Sequence[float],
) -> Line:
    step, psd = spectrum.resolution_hz, spectrum.psd
    own = np.arange(max(first - _SKIRT, 1), min(last + _SKIRT, len(psd) - 2) + 1)
    # Beside a wide peak the median rises along with it; that at its feet does not.
    level = min(float(around[own].max()), 0.5 * float(around[own[0]] + around[own[-1]]))
    excess = psd[own] - level
    power = max(float(excess.sum()) * step, 0.0)
    noise = level * step
    # Hann windows: a sum of bins scatters more than were they independent.
    spread = float(spectrum.correlation[0].sum())
    alone = noise * math.sqrt(spread * len(own) / spectrum.averages)
    error = math.sqrt(2 * spread * power * noise / spectrum.averages + alone**2)
    rms = math.sqrt(power)
    peak = int(own[np.argmax(excess)])
    wide = int(np.count_nonzero(excess > 0.5 * excess.max()))
    weight = np.maximum(excess, 0.0)
    frequency_hz = float(np.average(spectrum.frequency_hz[own], weights=weight))
    narrow = wide <= _NARROW
    return Line(
        frequency_hz=frequency_hz,
        rms=rms,
        rms_error=error / (2 * rms) if rms else math.sqrt(error),
        significance=power / alone,
        ratio=float(psd[peak] / level),
        width_hz=0.0 if narrow else wide * step,
        low_hz=float(spectrum.frequency_hz[first]),
        high_hz=float(spectrum.frequency_hz[last]),
        name=mains_name(frequency_hz, spectrum.rate_hz, step, mains_hz) if narrow else "",
    )
