"""What a fit is worth: is it clean, how sure is it, does it need more parameters?"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.frame import Frame
from rasnik.analysis.gauss_newton import SINGULAR, Solution, scaled_eigenvalues, solve
from rasnik.analysis.moments import N_MONOMIALS, all_tiles
from rasnik.analysis.parameters import KURTOSIS_RANGE, Model, design
from rasnik.imaging.appearance import Camera

__all__ = [
    "DEMANDED_GAIN",
    "LEAST_PIXELS",
    "demanded",
    "explained",
    "gain",
    "is_clean",
    "is_determined",
    "is_needless",
    "makes_sense",
    "pose_covariance",
    "scatter",
    "shears_needed",
]

#: Decrease of chi-square for which parameters are added to the fit of a clean image.
DEMANDED_GAIN = 20.0

#: Fewer pixels say nothing: ten for each of the parameters there can be.
LEAST_PIXELS = 250

_CLUSTER_TILES = 3
_CHANCE_SIGMAS = 6.0


def shears_needed(solution: Solution) -> bool:
    """Whether the affine fit differs from a similarity by more than it can by chance."""
    return _shear_evidence(solution, solution.inverse) > DEMANDED_GAIN


def is_needless(solution: Solution, model: Model, kurtosis: bool) -> bool:
    """Whether the image would hardly be described worse without the parameters added last.

    Half of what it took to add them, so that they do not come and go from frame to frame.
    """
    inverse, state = solution.inverse, solution.state
    evidence = [np.inf]
    if model == "affine":
        evidence.append(_shear_evidence(solution, inverse))
    if model == "projective":
        evidence.append(_evidence(state.projection.matrix[2, :2], solution, inverse[6:8, 6:8]))
    if kurtosis:
        cumulant = state.appearance.kurtosis * state.appearance.blur_um**4
        evidence.append(_evidence(np.array([cumulant]), solution, inverse[-1:, -1:]))
    return min(evidence) < DEMANDED_GAIN / 2


def _shear_evidence(solution: Solution, inverse: NDArray[np.float64]) -> float:
    jacobian = solution.state.projection.jacobian
    gram = jacobian.T @ jacobian / np.trace(jacobian.T @ jacobian)
    shear = np.array([gram[0, 0] - gram[1, 1], 2 * gram[0, 1]]) / 2
    return _evidence(shear, solution, inverse[4:6, 4:6])


def _evidence(
    values: NDArray[np.float64], solution: Solution, inverse: NDArray[np.float64]
) -> float:
    """Chi-square of parameters against zero."""
    covariance = inverse * max(1.0, solution.chi2_ndf)
    return float(values @ np.linalg.solve(covariance, values))


def is_clean(solution: Solution) -> bool:
    """No tile's chi-square stands out: 6 sigma above the noise, or above the median tile.

    Without a tile that is seen there is nothing to say so: not clean.
    """
    counts = solution.moments.counts
    full = counts >= 32
    if not full.any():
        return False
    ratio = solution.moments.chi2_per_tile[full] / counts[full]
    limit = max(1.0, float(np.median(ratio))) * (1 + 6 * np.sqrt(2 / counts[full]))
    return bool((ratio < limit).all())


def is_determined(solution: Solution) -> bool:
    """Whether there are enough pixels, and in the right places, for every parameter."""
    values = scaled_eigenvalues(solution.normal)
    return bool(solution.moments.n_pixels >= LEAST_PIXELS and values[0] > SINGULAR * values[-1])


def demanded(trial: Solution, camera: Camera) -> float:
    """By how much chi-square must fall for more parameters to be believed.

    Dirt and distortion that are still there make it fall for no reason, the more so the more
    they scatter the parts of the image.
    """
    growth = scatter(trial, camera)[0]
    inflation = max(trial.chi2_ndf, float((growth**2).max()))
    return DEMANDED_GAIN + 3 * DEMANDED_GAIN * max(0.0, inflation - 1.5)


def makes_sense(before: Solution, after: Solution) -> bool:
    """Whether a richer model still describes one edge, seen less than half as sharp."""
    old, new = before.state.appearance, after.state.appearance
    low, high = KURTOSIS_RANGE
    return (
        after.converged
        and after.chi2 < before.chi2
        and low < new.kurtosis < high
        and new.blur_um < 1.5 * old.blur_um
    )


def gain(
    frame: Frame, solution: Solution, model: Model, kurtosis: bool, *, fixed_shape: bool = False
) -> float:
    """By how much chi-square would fall with the parameters of another model."""
    rows = design(
        solution.state,
        frame.camera,
        frame.mask.field_um,
        model,
        kurtosis,
        fixed_shape=fixed_shape,
    )
    moments = solution.moments
    gradient = rows @ moments.vector
    total = gradient @ solve(rows @ moments.matrix @ rows.T, gradient)
    return float(total - (moments.chi2 - solution.chi2))


def pose_covariance(
    solution: Solution, growth: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Covariance of x, y, S, theta_z from the information, and from the scatter if given.

    The scatter between clusters of tiles counts what the noise law does not: a wrong
    profile, dirt, distortion. The larger of it and of chi-square is taken per parameter.
    """
    covariance = solution.inverse[:4, :4].copy()
    if growth is not None:
        growth = np.maximum(np.sqrt(max(1.0, solution.chi2_ndf)), growth)
        with np.errstate(over="ignore"):  # where there is no pattern, nothing is known
            covariance *= np.outer(growth, growth)
    scale = solution.state.projection.similarity()[0]
    unit = np.array([1.0, 1.0, scale, 1.0])
    result: NDArray[np.float64] = covariance * np.outer(unit, unit)
    return result


def scatter(solution: Solution, camera: Camera) -> tuple[NDArray[np.float64], float]:
    """Scatter of the pose between clusters of tiles, relative to what the noise explains.

    Clusters of 48 x 48 pixels. Unlike chi-square it tells a noise law that is a little off
    from parts of the image that show different positions.

    Returns
    -------
    growth : ndarray, shape (4,)
    by_chance : float
        What it does not exceed by chance: of n clusters of normal noise its standard deviation is
        1 / sqrt(2 n), a quarter more for scale and rotation, which the corners determine.
    """
    moments, inverse = solution.moments, solution.inverse
    label = _clusters(camera.shape)
    weights = (inverse[:4] @ solution.design).reshape(-1, N_MONOMIALS)
    by_signal = (weights @ moments.basis.T).reshape(4, -1, len(label))
    left = moments.projections_after(solution.step @ solution.design)
    influence = (by_signal * left.T).sum(axis=1)
    influence -= influence.mean(axis=1, keepdims=True)
    sums = np.stack([np.bincount(label, row) for row in influence])
    variance = np.maximum(np.diag(inverse)[:4], 1e-300)  # zero where not determined
    growth: NDArray[np.float64] = np.sqrt((sums**2).sum(axis=1) / variance)
    pixels = np.bincount(label, moments.counts)
    clusters = pixels.sum() ** 2 / (pixels**2).sum()
    return growth, float(1 + _CHANCE_SIGMAS / np.sqrt(2 * clusters))


@lru_cache(maxsize=8)
def _clusters(shape: tuple[int, int]) -> NDArray[np.intp]:
    """Number of the cluster that every tile belongs to."""
    row, column = (all_tiles(shape) // _CLUSTER_TILES).T.astype(np.intp)
    label: NDArray[np.intp] = row * (column.max() + 1) + column
    return label


def explained(frame: Frame, noise: tuple[float, float], chi2_ndf: float) -> float:
    """Fraction of the variance over the used pixels, apart from their noise, that is modelled."""
    if chi2_ndf <= 1.0:
        return 1.0
    used = frame.image[::3, ::3][frame.valid[::3, ::3] > 0]
    variance = noise[0] + noise[1] * max(float(used.mean()), 0.0)
    return 1.0 - (chi2_ndf - 1.0) * variance / max(float(used.var()), 1e-12)
