"""The law variance = A + B * level, fitted to the variances of many pixels.

Source of the law: van der Graaf et al., section 3 "Quantum fluctuations: shot noise".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.pixel_map import Defect, noise_defects
from rasnik.characterisation.temporal_noise import StillSceneError, TemporalNoise

__all__ = [
    "BINS",
    "LEAST_IN_BIN",
    "NoiseLaw",
    "bend_level",
    "binned",
    "curvature",
    "fit_law",
    "robust_law",
    "rough_law",
]

Image = NDArray[np.float64]

BINS = 48
LEAST_IN_BIN = 20
_BENT = 0.9  # of the law: a variance below it tells of a full well
_SURE = 4.0  # standard deviations


@dataclass(frozen=True)
class NoiseLaw:
    """Variance = A + B * grey level, before rounding.

    Attributes
    ----------
    A, B : float
        grey^2, grey.
    covariance : ndarray, shape (2, 2)
        Of A and B, with the scatter of the pixels about the law where it exceeds chance.
    chi2_ndf : float
        Scatter of the pixels' variances about the law in units of chance, squared.
    rounding : float
        Variance of the rounding that is not counted in A, grey^2; the measured variance is
        A + B * level + rounding.
    """

    A: float
    B: float
    covariance: Image
    chi2_ndf: float
    rounding: float

    @property
    def sigma_A(self) -> float:
        return float(math.sqrt(self.covariance[0, 0]))

    @property
    def sigma_B(self) -> float:
        return float(math.sqrt(self.covariance[1, 1]))

    def measured(self, level: Any) -> Any:
        """Variance to be measured at a grey level, rounding included."""
        return self.A + self.rounding + self.B * level


def fit_law(level: Image, variance: Image, dof: float, rounding: float = 0.0) -> NoiseLaw:
    """Fit variance = A + B * level to the variances of many pixels.

    Each variance is distributed as chi-square about the law, so its own error is proportional to
    the law, not to the value found: weights made from the values would favour the small ones.

    Parameters
    ----------
    level, variance : ndarray, shape (n,)
        Mean and variance (rounding included) of each pixel.
    dof : float
        Degrees of freedom of each variance.
    rounding : float
        Part of the variance that is not to be counted in A.

    Returns
    -------
    NoiseLaw

    Raises
    ------
    StillSceneError
        If all pixels have the same level.
    """
    if len(level) < 3 or not np.ptp(level) > 0:
        raise StillSceneError("the pixels all have one grey level: a range of levels is needed")
    centre = float(level.mean())
    shifted = level - centre
    floor = 0.05 * float(variance.mean())
    expected = np.full(level.shape, float(variance.mean()))
    for _ in range(8):
        weight = 1 / expected**2
        normal = np.array(
            [
                [weight.sum(), weight @ shifted],
                [weight @ shifted, weight @ shifted**2],
            ]
        )
        inverse = np.linalg.inv(normal)
        found = inverse @ [weight @ variance, (weight * shifted) @ variance]
        expected = np.maximum(found[0] + found[1] * shifted, floor)
    chi2_ndf = float(dof / 2 * ((variance / expected - 1) ** 2).sum() / (len(level) - 2))
    # Enlarged only where chance cannot explain the scatter; the square of a chi-square variable
    # has the variance 8 + 48 / dof in these units, of which 2 is the Gaussian part.
    chance = math.sqrt((2 + 12 / dof) / len(level))
    enlarged = chi2_ndf if chi2_ndf > 1 + 3 * chance else 1.0
    to_zero = np.array([[1, -centre], [0, 1]])
    covariance = to_zero @ (inverse * (2 / dof * enlarged)) @ to_zero.T
    A, B = to_zero @ found
    return NoiseLaw(float(A) - rounding, float(B), covariance, chi2_ndf, rounding)


def rough_law(noise: TemporalNoise, use: NDArray[np.bool_], rounding: float) -> NoiseLaw:
    """A law from the medians of bins, which a few odd pixels do not bend."""
    bins = binned(noise, use, None, middle=True)
    if len(bins) < 2:
        value = float(np.median(noise.variance[use]))
        return NoiseLaw(value - rounding, 0.0, np.zeros((2, 2)), 1.0, rounding)
    weight = np.sqrt(bins[:, 3]) / bins[:, 1].clip(0.1 * bins[:, 1].max())
    slope, offset = np.polyfit(bins[:, 0], bins[:, 1], 1, w=weight)
    return NoiseLaw(float(offset) - rounding, float(slope), np.zeros((2, 2)), 1.0, rounding)


def robust_law(
    noise: TemporalNoise, usable: NDArray[np.bool_], rounding: float
) -> tuple[NoiseLaw, NDArray[np.bool_], tuple[Defect, ...]]:
    """The fit without pixels that chance cannot explain; these are returned as defects."""
    law = rough_law(noise, usable, rounding)
    used = usable
    defects: tuple[Defect, ...] = ()
    for _ in range(3):
        defects = noise_defects(noise, usable, law.measured)
        before, used = used, usable.copy()
        for defect in defects:
            used[defect.row, defect.column] = False
        law = fit_law(noise.mean[used], noise.variance[used], noise.dof, rounding)
        if np.array_equal(before, used):
            break
    return law, used, defects


def binned(
    noise: TemporalNoise, use: NDArray[np.bool_], law: NoiseLaw | None, *, middle: bool = False
) -> Image:
    """(level, variance, sigma, pixels) of bins of equal width; for plots and rough laws."""
    level, variance = noise.mean[use], noise.variance[use]
    low, high = float(level.min()), float(level.max())
    place = np.minimum((BINS * (level - low) / max(high - low, 1e-300)).astype(int), BINS - 1)
    order = np.argsort(place, kind="stable")
    ends = np.cumsum(np.bincount(place, minlength=BINS))
    least = min(LEAST_IN_BIN, len(level) // 2)
    # The median of chi-square over its mean (Wilson and Hilferty).
    to_mean = (1 - 2 / (9 * noise.dof)) ** -3
    rows = []
    for start, end in zip(np.concatenate([[0], ends[:-1]]), ends, strict=True):
        if end - start < max(least, 1):
            continue
        chosen = order[start:end]
        value = to_mean * float(np.median(variance[chosen])) if middle else variance[chosen].mean()
        at = float(level[chosen].mean())
        sigma = (law.measured(at) if law else value) * math.sqrt(2 / noise.dof / (end - start))
        rows.append((at, float(value), float(sigma), float(end - start)))
    return np.array(rows).reshape(-1, 4)


def bend_level(bins: Image) -> float | None:
    """Level at which the variance falls behind what the lower levels make expect."""
    bend = None
    for k in range(len(bins) - 1, 4, -1):
        below = bins[:k]
        slope, offset = np.polyfit(below[:, 0], below[:, 1], 1, w=1 / below[:, 2])
        expected = offset + slope * bins[k, 0]
        if bins[k, 1] > _BENT * expected - _SURE * bins[k, 2]:
            break
        bend = float((bins[k, 0] + bins[k - 1, 0]) / 2)
    return bend


def curvature(noise: TemporalNoise, used: NDArray[np.bool_], law: NoiseLaw) -> tuple[float, float]:
    """C of variance = A + B Q + C Q^2, and its error."""
    level, variance = noise.mean[used], noise.variance[used]
    scale = float(np.abs(level).max())
    expected = np.maximum(law.measured(level), 0.05 * float(variance.mean()))
    columns = np.stack([np.ones(level.size), level / scale, (level / scale) ** 2]) / expected
    normal = columns @ columns.T
    if np.linalg.cond(normal) > 1e10:
        return math.nan, math.nan
    inverse = np.linalg.inv(normal)
    found = inverse @ (columns @ (variance / expected))
    sigma = math.sqrt(2 / noise.dof * max(law.chi2_ndf, 1.0) * inverse[2, 2])
    return float(found[2]) / scale**2, sigma / scale**2
