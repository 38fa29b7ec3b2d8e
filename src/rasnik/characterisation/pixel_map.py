"""What is wrong with single pixels, and what stays the same from frame to frame.

A scene is not a uniform field: levels of neighbours can only be compared where it is flat. There
a second difference in both directions sees neither slopes nor straight edges along the axes.

Source of the mask of second differences and its norm: J. Immerkaer, "Fast noise variance
estimation", Computer Vision and Image Understanding 64 (1996) 300.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats

from rasnik.characterisation.temporal_noise import TemporalNoise

__all__ = [
    "Defect",
    "FixedPattern",
    "fixed_pattern",
    "flat_parts",
    "has_scene",
    "noise_defects",
    "slope_of",
    "value_defects",
]

Image = NDArray[np.float64]
Law = Callable[[Any], Any]

_CHANCE = 0.01  # of one pixel in the whole image being called a defect wrongly
_STEEP_SHARE = 0.1  # of the greatest slope
_FLAT_SHARE, _MOST_FLAT = 0.05, 0.15  # of the range of levels, across a neighbourhood
_CALM = 2.5
_REACH = 2  # pixels from a flat one that belong to its neighbourhood
_SCENE_SHARE = 0.05  # rms over mean of the levels, above which they show a scene
_OUTLYING = 8.0  # standard deviations of the neighbours' scatter
_OUTLYING_SHARE = 0.05  # of the level range, least deviation of a hot or dead pixel
_LEAST = 200  # pixels for a figure of the fixed pattern
_SECOND = np.array([1.0, -2.0, 1.0])
_NORM_2D, _NORM_1D = 36.0, 6.0


@dataclass(frozen=True)
class Defect:
    """A pixel that does not behave as the others.

    Attributes
    ----------
    row, column : int
    kind : str
        ``noisy`` and ``quiet``: variance too large or too small for its level. ``hot`` and
        ``dead``: level far above or below its neighbours'. ``stuck``: one grey level always.
    level, variance : float
        Grey level and its variance in time.
    """

    row: int
    column: int
    kind: Literal["noisy", "quiet", "stuck", "hot", "dead"]
    level: float
    variance: float

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class FixedPattern:
    """Differences between pixels that stay; variances are without the noise of the mean image.

    Attributes
    ----------
    pixels : int
        In flat parts; 0 if there are too few, and all else NaN.
    variance, sigma_variance : float
        Of single pixels, grey^2, rows and columns taken away.
    row_variance, sigma_row_variance, column_variance, sigma_column_variance : float
        Of rows and columns as a whole, grey^2.
    offset, gain : float
        Parts of it: variance = offset^2 + (gain * level)^2; grey, relative. NaN if there are
        not two levels to tell them by.
    """

    pixels: int
    variance: float
    sigma_variance: float
    row_variance: float
    sigma_row_variance: float
    column_variance: float
    sigma_column_variance: float
    offset: float
    gain: float

    def as_dict(self) -> dict[str, Any]:
        return {f"fixed_pattern_{name}": value for name, value in asdict(self).items()}


def slope_of(mean: Image, variance: Image, frames: int) -> NDArray[np.bool_]:
    """Where the scene is steep: where motion would show. None in a flat field."""
    size = np.hypot(*np.gradient(mean))
    finite = size[np.isfinite(size)]
    steepest = float(np.quantile(finite, 0.99)) if finite.size else 0.0
    if steepest < 10 * math.sqrt(float(np.nanmedian(variance)) / frames) or steepest == 0:
        return np.zeros(mean.shape, bool)
    return np.asarray(size > max(_STEEP_SHARE * steepest, 0.0))


def has_scene(mean: Image) -> bool:
    """Whether there is anything to be seen, other than a field of uniform light."""
    return bool(np.nanstd(mean) > _SCENE_SHARE * max(abs(float(np.nanmean(mean))), 1e-12))


def _range(mean: Image) -> float:
    low, high = np.nanquantile(mean, [0.02, 0.98])
    return float(high - low)


def flat_parts(mean: Image, frames_variance: float) -> NDArray[np.bool_]:
    """Pixels around which the scene, its single pixels smoothed out, does not change.

    Parameters
    ----------
    mean : ndarray, shape (H, W)
    frames_variance : float
        Variance of the mean image's noise, grey^2.
    """
    smooth = ndimage.median_filter(np.nan_to_num(mean), size=3)
    size = 2 * _REACH + 1
    span = ndimage.maximum_filter(smooth, size) - ndimage.minimum_filter(smooth, size)
    # The calmest tenth tells what scatter of the pixels alone does to the span.
    limit = _CALM * float(np.quantile(span[_REACH:-_REACH, _REACH:-_REACH], 0.1))
    limit = max(limit, 6 * math.sqrt(frames_variance))
    if has_scene(mean):
        contrast = _range(mean)
        if limit > _MOST_FLAT * contrast:  # not even a tenth is flat
            return np.zeros(mean.shape, bool)
        limit = max(limit, _FLAT_SHARE * contrast)
    return np.asarray((span <= limit) & np.isfinite(mean))


def noise_defects(noise: TemporalNoise, usable: NDArray[np.bool_], law: Law) -> tuple[Defect, ...]:
    """Pixels whose variance chance does not explain.

    Parameters
    ----------
    noise : TemporalNoise
    usable : ndarray of bool, shape (H, W)
    law : callable
        Expected variance at a grey level, rounding included.
    """
    level, variance, dof = noise.mean, noise.variance, noise.dof
    chance = _CHANCE / (2 * max(int(usable.sum()), 1))
    expected = np.maximum(law(level), 1e-12)
    with np.errstate(invalid="ignore"):
        noisy = usable & (variance > expected * (stats.chi2.isf(chance, dof) / dof))
        quiet = usable & (variance < expected * (stats.chi2.ppf(chance, dof) / dof))
        stuck = usable & (variance <= 1e-9 * expected)
    found = []
    for row, column in np.argwhere(noisy | quiet | stuck).tolist():
        kind: Literal["noisy", "quiet", "stuck"] = "noisy" if noisy[row, column] else "quiet"
        if stuck[row, column]:
            kind = "stuck"
        found.append(
            Defect(row, column, kind, float(level[row, column]), float(variance[row, column]))
        )
    return tuple(found)


def _noise_of_mean(noise: TemporalNoise, law: Law) -> Image:
    return np.asarray(np.maximum(law(noise.mean), 0.0) / noise.frames)


def value_defects(noise: TemporalNoise) -> tuple[Defect, ...]:
    """Hot and dead pixels: far above or below all their neighbours but one.

    On an edge, or at the corner of a field, a pixel lies between its neighbours; so pixels are
    judged in all parts of the scene, unless its structures are as small as a pixel.
    """
    level = np.where(np.isfinite(noise.mean), noise.mean, np.nanmedian(noise.mean))
    ring = np.ones((5, 5), bool)
    ring[2, 2] = False
    # One of the neighbours may be a defect itself.
    low, high = (ndimage.rank_filter(level, rank, footprint=ring) for rank in (1, -2))
    beyond = level - np.clip(level, low, high)
    scatter = 1.4826 * float(np.median(np.abs(_twice(level)))) / math.sqrt(_NORM_2D)
    limit = max(
        _OUTLYING * scatter,
        _OUTLYING_SHARE * max(_range(noise.mean), float(np.nanmedian(np.abs(level)))),
    )
    return tuple(
        Defect(
            row,
            column,
            "hot" if beyond[row, column] > 0 else "dead",
            float(level[row, column]),
            float(noise.variance[row, column]),
        )
        for row, column in np.argwhere(np.abs(beyond) > limit).tolist()
    )


# ---------------------------------------------------------------- fixed pattern


def _twice(level: Image) -> Image:
    """Second difference in both directions."""
    return np.asarray(ndimage.correlate1d(ndimage.correlate1d(level, _SECOND, 0), _SECOND, 1))


def _trimmed(values: Image, norm: float) -> Image:
    """Squares of second differences over their norm, without those of defects."""
    scale = 1.4826 * float(np.median(np.abs(values)))
    kept = np.abs(values) <= _OUTLYING * scale
    return np.asarray(values[kept] ** 2 / norm)


def fixed_pattern(noise: TemporalNoise, whole: NDArray[np.bool_], law: Law) -> FixedPattern:
    """Pattern of the pixels, rows and columns in the flat parts of the scene."""
    mean, of_mean = noise.mean, _noise_of_mean(noise, law)
    flat = whole & flat_parts(mean, float(np.nanmedian(of_mean)))
    inner = ndimage.binary_erosion(flat, np.ones((3, 3), bool))
    if np.count_nonzero(inner) < _LEAST:
        return FixedPattern(int(inner.sum()), *[math.nan] * 8)
    level = np.where(np.isfinite(mean), mean, 0.0)
    twice = _twice(level)
    variance, sigma = _excess(twice[inner], of_mean[inner], _NORM_2D)
    single = max(variance, 0.0)
    rows = _line_variance(level, inner, of_mean + single, axis=0)
    columns = _line_variance(level, inner, of_mean + single, axis=1)
    offset, gain = _offset_and_gain(level, twice, inner, of_mean)
    return FixedPattern(int(inner.sum()), variance, sigma, *rows, *columns, offset, gain)


def _excess(values: Image, of_mean: Image, norm: float) -> tuple[float, float]:
    """Variance beyond the noise of the mean image; neighbours overlap, which its error counts."""
    squares = _trimmed(values, norm)
    # Squares of this difference are correlated over 5 x 5 pixels; their sum of squared
    # correlations is (1 + 2 (4/6)^2 + 2 (1/6)^2)^2.
    overlap = 1 + 2 * (4 / 6) ** 2 + 2 * (1 / 6) ** 2
    sigma = squares.std() * overlap / math.sqrt(len(squares))
    return float(squares.mean() - of_mean.mean()), float(sigma)


def _line_variance(
    level: Image, inner: NDArray[np.bool_], single: Image, axis: int
) -> tuple[float, float]:
    """Variance of whole rows (axis 0) or columns (axis 1) beyond that of their pixels."""
    across = ndimage.correlate1d(level, _SECOND, axis)
    count = inner.sum(axis=1 - axis)
    lines = count >= 10
    if lines.sum() < 10:
        return math.nan, math.nan
    sums = np.where(inner, across, 0.0).sum(axis=1 - axis)[lines] / count[lines]
    chance = np.where(inner, single, 0.0).sum(axis=1 - axis)[lines] / count[lines] ** 2
    squares = sums**2 / _NORM_1D - chance
    overlap = math.sqrt(1 + 2 * (4 / 6) ** 2 + 2 * (1 / 6) ** 2)
    return float(squares.mean()), float(squares.std() * overlap / math.sqrt(len(squares)))


def _offset_and_gain(
    level: Image, twice: Image, inner: NDArray[np.bool_], of_mean: Image
) -> tuple[float, float]:
    """Parts of the pattern that do not and that do grow with the light."""
    middle = 0.5 * (float(level[inner].min()) + float(level[inner].max()))
    low, high = inner & (level < middle), inner & (level >= middle)
    if min(low.sum(), high.sum()) < _LEAST:
        return math.nan, math.nan
    dark, light = (float((level[part] ** 2).mean()) for part in (low, high))
    if light < 1.5 * dark:
        return math.nan, math.nan
    below, above = (_excess(twice[part], of_mean[part], _NORM_2D)[0] for part in (low, high))
    gain2 = (above - below) / (light - dark)
    offset2 = below - gain2 * dark
    return math.sqrt(max(offset2, 0.0)), math.sqrt(max(gain2, 0.0))
