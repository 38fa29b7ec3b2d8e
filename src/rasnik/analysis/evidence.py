"""What a fit is worth: is it clean, how sure is it, does it need more parameters?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.frame import Frame
from rasnik.analysis.gauss_newton import SINGULAR, Solution, invert, scaled_eigenvalues, solve
from rasnik.analysis.moments import all_tiles
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
    "makes_sense",
    "pose_covariance",
    "shears_needed",
]

#: Decrease of chi-square for which parameters are added to the fit of a clean image.
DEMANDED_GAIN = 20.0

#: Fewer pixels say nothing: ten for each of the parameters there can be.
LEAST_PIXELS = 250

_CLUSTER_TILES = 3


def shears_needed(solution: Solution) -> bool:
    """Whether the affine fit differs from a similarity by more than it can by chance."""
    covariance = invert(solution.normal)[4:6, 4:6] * max(1.0, solution.chi2_ndf)
    jacobian = solution.state.projection.jacobian
    gram = jacobian.T @ jacobian / np.trace(jacobian.T @ jacobian)
    shear = np.array([gram[0, 0] - gram[1, 1], 2 * gram[0, 1]]) / 2
    return float(shear @ np.linalg.solve(covariance, shear)) > DEMANDED_GAIN


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
    growth = _scatter_growth(trial, invert(trial.normal), camera)
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


def pose_covariance(solution: Solution, enlarge: bool, camera: Camera) -> NDArray[np.float64]:
    """Covariance of x, y, S, theta_z from the information, and from the scatter if asked.

    The scatter between clusters of tiles (48 x 48 pixels) counts what the noise law does
    not: a wrong profile, dirt, distortion. The larger of both is taken per parameter.
    """
    inverse = invert(solution.normal)
    covariance = inverse[:4, :4].copy()
    if enlarge:
        growth = np.maximum(
            np.sqrt(max(1.0, solution.chi2_ndf)), _scatter_growth(solution, inverse, camera)
        )
        covariance *= np.outer(growth, growth)
    scale = solution.state.projection.similarity()[0]
    unit = np.diag([1.0, 1.0, scale, 1.0])
    result: NDArray[np.float64] = unit @ covariance @ unit
    return result


def _scatter_growth(
    solution: Solution, inverse: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
    """Scatter of the pose between clusters of tiles, relative to what the noise explains.

    Returns
    -------
    ndarray, shape (4,)
    """
    cluster = all_tiles(camera.shape) // _CLUSTER_TILES
    label = cluster[:, 0] * (cluster[:, 1].max() + 1) + cluster[:, 1]
    gradient = solution.moments.per_tile @ solution.design.T
    gradient -= gradient.mean(axis=0)
    sums = np.zeros((label.max() + 1, gradient.shape[1]))
    np.add.at(sums, label, gradient)
    scatter = (inverse @ (sums.T @ sums) @ inverse)[:4, :4]
    growth: NDArray[np.float64] = np.sqrt(np.diag(scatter) / np.diag(inverse)[:4])
    return growth


def explained(frame: Frame, noise: tuple[float, float], chi2_ndf: float) -> float:
    """Fraction of the variance over the used pixels, apart from their noise, that is modelled."""
    if chi2_ndf <= 1.0:
        return 1.0
    used = frame.image[::3, ::3][frame.valid[::3, ::3] > 0]
    variance = noise[0] + noise[1] * max(float(used.mean()), 0.0)
    return 1.0 - (chi2_ndf - 1.0) * variance / max(float(used.var()), 1e-12)
