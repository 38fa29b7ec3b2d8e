"""What of a frame is not the mask: borders, dust, glints; and how noisy the rest is.

Judged by the residuals against the model. Where the edges are not quite as modelled the
residuals grow with the local slope of the image, so their expected spread is

    s^2 = (noise)^2 + (k slope)^2

with both terms measured robustly on the frame itself; a wrong edge profile then enlarges
k and does not make all edges outliers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from rasnik.analysis.parameters import State
from rasnik.imaging.appearance import Camera
from rasnik.imaging.kernels import LEVEL
from rasnik.imaging.model import expected_signals
from rasnik.mask import ChessField

__all__ = ["estimate_noise", "find_outliers"]

_MAD = 1.4826
_PATCH = 5  # pixels; side of the patch over which residuals are averaged


def _residual(
    image: NDArray[np.float32], state: State, mask: ChessField, camera: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Residual, expected level, and slope (grey per field) of every pixel."""
    level, by_x, by_y = expected_signals(
        mask, state.projection, state.appearance, camera, (LEVEL, 0, 1)
    )
    return image - level, level, np.abs(by_x) + np.abs(by_y)


def _spread(values: NDArray[np.float32]) -> float:
    return float(_MAD * np.median(np.abs(values)))


def _clipped_variance(values: NDArray[np.float32]) -> float:
    """Variance without what is beyond 4 sigma (medians fail on noise of a grey level)."""
    for _ in range(4):
        centre, sigma = float(values.mean()), float(values.std())
        values = values[np.abs(values - centre) <= 4 * sigma]
    return float(values.var())


def find_outliers(
    image: NDArray[np.float32],
    valid: NDArray[np.uint8],
    state: State,
    mask: ChessField,
    camera: Camera,
    noise: tuple[float, float] | None,
    threshold: float = 6.0,
) -> NDArray[np.uint8]:
    """Which pixels can be used.

    A pixel is left out if it, or the mean over the 5 x 5 pixels around any pixel within
    3 pixels of it, is more than `threshold` sigma from the model.

    Parameters
    ----------
    image : ndarray of float32, shape (H, W)
    valid : ndarray of uint8, shape (H, W)
        Pixels that may be used at all.
    noise : tuple of float or None
        A and B of the pixel variance; measured on the frame if None.
    """
    residual, level, slope = _residual(image, state, mask, camera)
    usable = valid > 0
    flat = usable & (slope <= np.quantile(slope[usable][::7], 0.3))
    floor = _spread(residual[flat][::3])
    if noise is not None:
        variance = np.maximum(noise[0] + noise[1] * level, 1e-12)
        # uneven light or dirt everywhere: not less than what the flat pixels show
        variance *= max(1.0, float(np.median(floor**2 / variance[flat][::3])))
    else:
        variance = np.full_like(level, max(floor**2, 1e-12))
    steep = usable & (slope >= np.quantile(slope[usable][::7], 0.7))
    excess = np.maximum(residual[steep] ** 2 / variance[steep] * _MAD**2 - 1.0, 0.0)
    k2 = float(np.median(excess)) / float(np.median(slope[steep] ** 2 / variance[steep]) or 1.0)
    standard = residual / np.sqrt(variance + k2 * slope**2)
    standard[~usable] = 0.0
    # local mean of independent pixels, in units of its own sigma
    weight = ndimage.uniform_filter(usable.astype(np.float32), _PATCH, mode="constant")
    mean = ndimage.uniform_filter(standard, _PATCH, mode="constant")
    patch = _PATCH * mean / np.sqrt(np.maximum(weight, 1e-3))
    # correlated residuals (dirt, a wrong profile) widen the distribution of the means
    patch /= max(1.0, _spread(patch[usable][::5]))
    bad = np.abs(patch) > threshold
    single = np.abs(standard) > threshold + 1.0
    if bad.any():
        bad = ndimage.binary_dilation(bad, iterations=3)
    bad |= single
    return (usable & ~bad).astype(np.uint8)


def estimate_noise(
    image: NDArray[np.float32],
    valid: NDArray[np.uint8],
    state: State,
    mask: ChessField,
    camera: Camera,
) -> tuple[float, float]:
    """Noise law of a frame from its residuals where the image is flat.

    Returns
    -------
    a, b : float
        Of the variance A + B g (grey^2, grey); both are not negative.
    """
    residual, level, slope = _residual(image, state, mask, camera)
    usable = valid > 0
    flat = usable & (slope <= np.quantile(slope[usable], 0.5))
    r, g = residual[flat], level[flat]
    edges = np.quantile(g, np.linspace(0, 1, 9))
    bins = np.clip(np.searchsorted(edges, g) - 1, 0, 7)
    points = [
        (float(g[bins == k].mean()), _clipped_variance(r[bins == k]))
        for k in range(8)
        if np.count_nonzero(bins == k) > 30
    ]
    if len(points) < 2:
        return max(_clipped_variance(r), 1e-6), 0.0
    levels, variances = np.array(points).T
    levels = np.maximum(levels, 0.0)
    (a, b), _ = optimize.nnls(np.stack([np.ones_like(levels), levels], axis=1), variances)
    return max(float(a), 1e-3 * float(variances.mean()), 1e-6), float(b)
