"""What precedes the spectrum: leave out dark borders, remove the light, tame outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Picture", "picture_bounds", "prepare"]

Array = NDArray[np.float64]
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
    windowed : ndarray of float32, shape (h, w)
        (Grey level minus the smooth light, clipped) x window.
    window : ndarray of float32, shape (h, w)
        Hann window over the picture, times the region; zero where pixels are not usable.
    bounds_px : tuple of int
        (left, top, right, bottom) in the image, right and bottom exclusive.
    centroid_px : tuple of float
        (column, row) of the window's centroid in the image.
    u_px, v_px : ndarray, shapes (w,) and (h,)
        Pixel coordinates from the centroid.
    total : float
        Sum of the window.
    variance : ndarray, shape (2, 2)
        Second moments of the window about its centroid.
    noise_moments : ndarray, shape (3, 3)
        Sum of window^2 x x^T with x = (u, v, 1).
    """

    windowed: Floats
    window: Floats
    bounds_px: tuple[int, int, int, int]
    centroid_px: tuple[float, float]
    u_px: Array
    v_px: Array
    total: float
    variance: Array
    noise_moments: Array


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


def prepare(
    image: Floats,
    valid: NDArray[np.bool_] | None = None,
    region: Floats | None = None,
) -> Picture:
    """Crop to the picture, subtract the light (second order), clip outliers, apply a window.

    Parameters
    ----------
    image : ndarray of float32, shape (height, width)
        Finite everywhere.
    valid : ndarray of bool, shape (height, width), optional
        Usable pixels.
    region : ndarray of float32, shape (height, width), optional
        Weight from 0 to 1 of the part that shows the mask; by default all within borders.
    """
    bounds = picture_bounds(image) if region is None else _extent(region)
    left, top, right, bottom = bounds
    inside = np.s_[top:bottom, left:right]
    picture = np.ascontiguousarray(image[inside])
    height, width = picture.shape
    window = np.outer(_hann(height), _hann(width))
    weight = None if region is None else region[inside]
    if valid is not None:
        usable = valid[inside].astype(np.float32)
        weight = usable if weight is None else usable * weight
    if weight is None:
        residual = picture - _smooth_light(picture)
        sample = residual[::5, ::5].ravel()
    else:
        window *= weight
        residual = picture - _smooth_light_within(picture, weight)
        sample = residual[::3, ::3][weight[::3, ::3] > 0.5]
    if sample.size:
        centre = np.median(sample)
        limit = np.float32(_CLIP) * np.median(np.abs(sample - centre))
        np.clip(residual, centre - limit, centre + limit, out=residual)
    residual *= window
    return _with_moments(residual, window, bounds)


def _extent(region: Floats) -> tuple[int, int, int, int]:
    rows, columns = np.nonzero((region > 0).any(axis=1))[0], np.nonzero((region > 0).any(axis=0))[0]
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def _hann(count: int) -> Floats:
    """Hann window, zero half a pixel outside the first and last."""
    phase = 2 * np.pi * (np.arange(count) + 0.5) / count
    return (0.5 - 0.5 * np.cos(phase)).astype(np.float32)


def _with_moments(windowed: Floats, window: Floats, bounds: tuple[int, int, int, int]) -> Picture:
    height, width = window.shape
    left, top, _, _ = bounds
    middle_u, middle_v = (width - 1) / 2, (height - 1) / 2
    u, v = np.arange(width) - middle_u, np.arange(height) - middle_v
    moments = _moments(window, u, v)
    total = max(float(moments[2, 2]), 1e-12)
    shift = moments[:2, 2] / total
    # moments about the centroid: change of variables x -> (u - shift_u, v - shift_v, 1)
    to_centroid = np.array([[1.0, 0.0, -shift[0]], [0.0, 1.0, -shift[1]], [0.0, 0.0, 1.0]])
    centred = to_centroid @ moments @ to_centroid.T
    noise = to_centroid @ _moments(window * window, u, v) @ to_centroid.T
    return Picture(
        windowed=windowed,
        window=window,
        bounds_px=bounds,
        centroid_px=(left + middle_u + shift[0], top + middle_v + shift[1]),
        u_px=u - shift[0],
        v_px=v - shift[1],
        total=total,
        variance=centred[:2, :2] / total,
        noise_moments=noise,
    )


def _moments(weight: Floats, u: Array, v: Array) -> Array:
    """Sum of weight x x^T with x = (u, v, 1), shape (3, 3)."""
    along_u = np.stack([np.ones_like(u), u, u * u], axis=1)
    along_v = np.stack([np.ones_like(v), v, v * v], axis=1)
    powers = along_v.T @ (weight @ along_u.astype(np.float32))  # [power of v, power of u]
    return np.array(
        [
            [powers[0, 2], powers[1, 1], powers[0, 1]],
            [powers[1, 1], powers[2, 0], powers[1, 0]],
            [powers[0, 1], powers[1, 0], powers[0, 0]],
        ],
        dtype=float,
    )


# ------------------------------------------------------------------- smooth light

_TERMS = [(i, j) for i in range(3) for j in range(3 - i)]  # powers of (u, v), i + j <= 2


def _powers(count: int, most: int) -> Array:
    return np.vander(np.linspace(-1, 1, count), most + 1, increasing=True)


def _smooth_light(picture: Floats) -> Floats:
    """Least-squares second-order surface of the grey levels, evaluated at every pixel."""
    along_u, along_v = _powers(picture.shape[1], 2), _powers(picture.shape[0], 2)
    moments = along_v.T @ (picture @ along_u.astype(np.float32))  # [power of v, power of u]
    gram_u, gram_v = along_u.T @ along_u, along_v.T @ along_v
    gram = np.array([[gram_u[i, k] * gram_v[j, m] for k, m in _TERMS] for i, j in _TERMS])
    return _surface(gram, moments, along_u, along_v)


def _smooth_light_within(picture: Floats, weight: Floats) -> Floats:
    """The same with a weight per pixel."""
    along_u, along_v = _powers(picture.shape[1], 4), _powers(picture.shape[0], 4)
    moments = along_v.T @ ((picture * weight) @ along_u.astype(np.float32))
    weights = along_v.T @ (weight @ along_u.astype(np.float32))
    gram = np.array([[weights[j + m, i + k] for k, m in _TERMS] for i, j in _TERMS])
    return _surface(gram, moments, along_u[:, :3], along_v[:, :3])


def _surface(gram: Array, moments: Array, along_u: Array, along_v: Array) -> Floats:
    target = np.array([moments[j, i] for i, j in _TERMS], dtype=float)
    solution = np.linalg.lstsq(gram, target, rcond=1e-9)[0]
    coefficients = np.zeros((3, 3))
    for (i, j), value in zip(_TERMS, solution, strict=True):
        coefficients[j, i] = value
    surface: Floats = (along_v @ coefficients).astype(np.float32) @ along_u.T.astype(np.float32)
    return surface
