"""Noise floor of a spectrum: the level where it is flat, and how well that is known.

Lines are left out. The rest is divided into bands, of which each gives a median, corrected for
that of a mean of periodograms. The bands that agree with the lowest are the flat part; those next
to bands that do not agree are left out too. Into the flat part a floor is fitted, and along with
it a remainder that falls as 1 / f^2 and 1 / f^4, which is how drift and resonances end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.lines import Line, median_of_average, median_variance
from rasnik.characterisation.spectrum import Spectrum

__all__ = ["NoiseFloor", "noise_floor"]

_BANDS = 60
_LEAST_SIGMAS = 3  # of the squared floor; what is less certain is none
_LEAST_BINS = 24  # in a band
_LEAST_BANDS = 3  # that agree, for a floor to be one
_SLOPE_BANDS = 8  # from which a remainder can be fitted too
_QUANTILE = 0.2  # of the bands, from where the flat part is looked for
_BANDS_PER_MARGIN = 24  # one band is left out beside those that do not agree for so many
_CUT = 3.0  # standard deviations by which a band may differ


@dataclass(frozen=True)
class NoiseFloor:
    """Level of the flat part of a spectrum.

    Attributes
    ----------
    asd, sigma : float
        One-sided amplitude spectral density and its standard deviation, unit / sqrt(Hz).
    low_hz, high_hz : float
        Where the flat part begins and ends.
    share : float
        Share of the bins in between that were used.
    chi2_ndf : float
        Of the bands about the fit; where it exceeds what chance allows, `sigma` is enlarged by
        its root.
    rate_hz : float
    unit : str
    """

    asd: float
    sigma: float
    low_hz: float
    high_hz: float
    share: float
    chi2_ndf: float
    rate_hz: float
    unit: str

    @property
    def as_paper(self) -> float:
        """The same as the paper quotes it: sigma / sqrt(f), smaller by sqrt(2)."""
        return self.asd / math.sqrt(2)

    @property
    def per_frame(self) -> float:
        """Standard deviation of one frame, if the noise is white."""
        return self.asd * math.sqrt(self.rate_hz / 2)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        end = f"_{self.unit}" if self.unit else ""
        return {
            f"asd{end}_rthz": self.asd,
            f"asd_sigma{end}_rthz": self.sigma,
            f"sigma_over_sqrt_f{end}_rthz": self.as_paper,
            f"sigma_per_frame{end}": self.per_frame,
            "low_hz": self.low_hz,
            "high_hz": self.high_hz,
            "share_of_bins": self.share,
            "chi2_ndf": self.chi2_ndf,
        }


def noise_floor(
    spectrum: Spectrum,
    lines: Sequence[Line] = (),
    *,
    range_hz: tuple[float, float] | None = None,
) -> NoiseFloor:
    """The noise floor.

    Parameters
    ----------
    spectrum : Spectrum
    lines : sequence of Line
        Left out, with their skirts.
    range_hz : tuple of float, optional
        Where the floor is, if it is known: then nothing but the lines is left out there, and no
        remainder fitted.

    Raises
    ------
    ValueError
        If there are too few bins, or no flat part, or one that cannot be told from the rest.
    """
    bins = _free_bins(spectrum, lines, range_hz)
    if len(bins) < _LEAST_BINS:
        raise ValueError(
            f"only {len(bins)} bins of the spectrum are free of lines there, and a noise floor "
            f"needs {_LEAST_BINS}; take longer windows or a wider range"
        )
    bands = np.array_split(bins, int(np.clip(len(bins) // _LEAST_BINS, 1, _BANDS)))
    counts = np.array([len(band) for band in bands])
    levels = np.array([np.median(spectrum.psd[band]) for band in bands])
    levels /= median_of_average(spectrum)
    relative = np.sqrt(median_variance(spectrum) / counts)
    if (levels <= 0).any():
        raise ValueError("the spectrum is zero in places; there is no noise to see a floor of")
    flat = np.ones(len(bands), dtype=bool)
    if range_hz is None and len(bands) >= _LEAST_BANDS:
        flat = _flat(levels, relative)
    if flat.sum() < min(_LEAST_BANDS, len(bands)):
        raise ValueError("the spectrum has no flat part; name the range of the floor")
    middle = np.array([spectrum.frequency_hz[band].mean() for band in bands])
    psd, error, chi2_ndf = _fit(middle[flat], levels[flat], relative[flat], slope=range_hz is None)
    if not psd > _LEAST_SIGMAS * error:
        raise ValueError(
            "the noise floor does not stand out from what falls with frequency; "
            "name its range, or take a longer track"
        )
    used = np.concatenate([band for band, taken in zip(bands, flat, strict=True) if taken])
    asd = math.sqrt(psd)
    return NoiseFloor(
        asd=asd,
        sigma=error / (2 * asd),
        low_hz=float(spectrum.frequency_hz[used[0]]),
        high_hz=float(spectrum.frequency_hz[used[-1]]),
        share=len(used) / int(used[-1] - used[0] + 1),
        chi2_ndf=chi2_ndf,
        rate_hz=spectrum.rate_hz,
        unit=spectrum.unit,
    )


def _free_bins(
    spectrum: Spectrum, lines: Sequence[Line], range_hz: tuple[float, float] | None
) -> NDArray[np.int64]:
    """Bins of one distribution, within the range, that no line reaches."""
    frequency_hz = spectrum.frequency_hz
    free = np.ones(len(frequency_hz), dtype=bool)
    free[:2] = free[-1] = False
    if range_hz is not None:
        low_hz, high_hz = range_hz
        if not 0 <= low_hz < high_hz:
            raise ValueError(f"{low_hz:g} to {high_hz:g} Hz is no range of frequencies")
        free &= (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
    for line in lines:
        # The side lobes of Hann's window fall as the sixth power; here to a percent of the floor.
        reach_hz = (3 + math.ceil((10 * line.ratio) ** (1 / 6))) * spectrum.resolution_hz
        free &= (frequency_hz < line.low_hz - reach_hz) | (frequency_hz > line.high_hz + reach_hz)
    return np.flatnonzero(free)


def _flat(levels: NDArray[np.float64], relative: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which bands agree with a common lowest level, and have neighbours that do."""
    level = float(np.quantile(levels, _QUANTILE))
    agree = np.zeros(len(levels), dtype=bool)
    for _ in range(50):
        before, agree = agree, np.abs(levels / level - 1) < _CUT * relative
        if not agree.any() or (agree == before).all():
            break
        level = float(np.average(levels[agree], weights=relative[agree] ** -2))
    margin = len(levels) // _BANDS_PER_MARGIN
    padded = np.pad(agree, margin, constant_values=True)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * margin + 1).all(1))


def _fit(
    frequency_hz: NDArray[np.float64],
    levels: NDArray[np.float64],
    relative: NDArray[np.float64],
    *,
    slope: bool,
) -> tuple[float, float, float]:
    """(floor, its standard deviation, chi-square per degree of freedom)."""
    shapes = [np.ones(len(levels))]
    if slope and len(levels) >= _SLOPE_BANDS:
        shapes += [(frequency_hz[0] / frequency_hz) ** power for power in (2, 4)]
    design = np.array(shapes).T
    level = float(np.average(levels, weights=relative**-2))
    weight = 1 / (relative * level)
    covariance = np.linalg.inv((design * weight[:, None] ** 2).T @ design)
    found = covariance @ ((design * weight[:, None] ** 2).T @ levels)
    freedom = len(levels) - len(shapes)
    error = math.sqrt(covariance[0, 0])
    if freedom < 1:
        return float(found[0]), error, math.nan
    chi2_ndf = float(np.sum(((levels - design @ found) * weight) ** 2)) / freedom
    if chi2_ndf > 1 + _CUT * math.sqrt(2 / freedom):
        error *= math.sqrt(chi2_ndf)
    return float(found[0]), error, chi2_ndf
