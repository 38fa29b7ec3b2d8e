"""What precedes the spectrum: leave out dark borders, remove the light, tame outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Picture", "hann", "picture_bounds", "prepare"]

Floats = NDArray[np.float32]

# A border shows less than this fraction of the typical variation along its line.
_BORDER_VARIATION = 0.3
# Glints and dust are clipped at this many median deviations from the local light.
_CLIP = 3.0


@dataclass(frozen=True, eq=False)
class Picture:
    """The part of an image that shows the mask, ready for a Fourier transform.

    Attributes
    ----------
    residual : ndarray of float32, shape (h, w)
        Grey level minus the smooth light, clipped; zero where pixels are not usable.
    window_u, window_v : ndarray of float32, shapes (w,) and (h,)
        Hann windows over the picture.
    u_px, v_px : ndarray, shapes (w,) and (h,)
        Pixel coordinates from the centre of the picture.
    bounds_px : tuple of int
        (left, top, right, bottom) in the image, right and bottom exclusive.
    spread : float
        Median absolute deviation from the smooth light, grey levels.
    """

    residual: Floats
    window_u: Floats
    window_v: Floats
    u_px: NDArray[np.float64]
    v_px: NDArray[np.float64]
    bounds_px: tuple[int, int, int, int]
    spread: float


def picture_bounds(image: Floats) -> tuple[int, int, int, int]:
    """Bounds (left, top, right, bottom) of the picture without dark, featureless borders.

    Image sensors often have covered rows and columns at the edges. They are found by their lack
    of variation along the line, at most a third of the image from each side.
    """
    height, width = image.shape
    step_v, step_u = max(1, height // 180), max(1, width // 180)
    # the outermost lines may be borders or hold a file header: they don't count
    left, right = _edges(_variation(image[2:-2:step_v]))
    top, bottom = _edges(_variation(image[:, left:right:step_u].T))
    return left, top, right, bottom


def _variation(lines: Floats) -> Floats:
    """Mean absolute deviation of each column."""
    deviation: Floats = np.abs(lines - lines.mean(axis=0)).mean(axis=0)
    return deviation


def _edges(variation: Floats) -> tuple[int, int]:
    lively = variation > _BORDER_VARIATION * np.median(variation)
    third = len(lively) // 3
    first = int(np.argmax(lively[:third])) if lively[:third].any() else 0
    tail = lively[::-1][:third]
    last = int(np.argmax(tail)) if tail.any() else 0
    return first, len(lively) - last


def prepare(image: Floats, valid: NDArray[np.bool_] | None = None) -> Picture:
    """Crop to the picture, subtract the light (second order), clip outliers.

    Parameters
    ----------
    image : ndarray of float32, shape (height, width)
        Finite where `valid`.
    valid : ndarray of bool, optional
        Usable pixels.
    """
    bounds = picture_bounds(image)
    left, top, right, bottom = bounds
    picture = np.ascontiguousarray(image[top:bottom, left:right])
    height, width = picture.shape
    residual = picture - _smooth_light(picture)
    usable = None if valid is None else valid[top:bottom, left:right]
    sample = residual[::5, ::5] if usable is None else residual[::5, ::5][usable[::5, ::5]]
    centre, spread = _centre_and_spread(sample)
    limit = np.float32(_CLIP * spread)
    np.clip(residual, centre - limit, centre + limit, out=residual)
    if usable is not None:
        residual *= usable
    return Picture(
        residual=residual,
        window_u=hann(width),
        window_v=hann(height),
        u_px=np.arange(width) - (width - 1) / 2,
        v_px=np.arange(height) - (height - 1) / 2,
        bounds_px=bounds,
        spread=spread,
    )


def _centre_and_spread(sample: Floats) -> tuple[np.float32, float]:
    if sample.size == 0:
        return np.float32(0.0), 0.0
    centre = np.median(sample)
    return np.float32(centre), float(np.median(np.abs(sample - centre)))


def hann(count: int) -> Floats:
    """Hann window over `count` pixels, zero half a pixel outside the first and last."""
    phase = 2 * np.pi * (np.arange(count) + 0.5) / count
    return (0.5 - 0.5 * np.cos(phase)).astype(np.float32)


def _smooth_light(picture: Floats) -> Floats:
    """Least-squares second-order surface of the grey levels, evaluated at every pixel."""
    powers = [
        np.vander(np.linspace(-1, 1, count), 3, increasing=True) for count in picture.shape[::-1]
    ]
    along_u, along_v = powers
    moments = along_v.T @ (picture @ along_u.astype(np.float32))  # [power of v, power of u]
    terms = [(i, j) for i in range(3) for j in range(3 - i)]  # powers of (u, v), i + j <= 2
    gram_u, gram_v = along_u.T @ along_u, along_v.T @ along_v
    gram = np.array([[gram_u[i, k] * gram_v[j, m] for k, m in terms] for i, j in terms])
    solution = np.linalg.solve(gram, np.array([moments[j, i] for i, j in terms]))
    coefficients = np.zeros((3, 3))
    for (i, j), value in zip(terms, solution, strict=True):
        coefficients[j, i] = value
    surface: Floats = (along_v @ coefficients).astype(np.float32) @ along_u.T.astype(np.float32)
    return surface
