"""What precedes the spectrum: leave out dark borders, remove the light, tame outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
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
    window_u, window_v : ndarray of float32, shapes (w,) and (h,)
        Hann windows over the picture.
    weight : ndarray of float32, shape (h, w), or None
        Another factor of the window: 0 where pixels are not usable or don't show the mask.
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
    window_u: Floats
    window_v: Floats
    weight: Floats | None
    bounds_px: tuple[int, int, int, int]
    centroid_px: tuple[float, float]
    u_px: Array
    v_px: Array
    total: float
    variance: Array
    noise_moments: Array

    @property
    def window(self) -> Floats:
        """The whole window, shape (h, w)."""
        product: Floats = np.outer(self.window_v, self.window_u)
        return product if self.weight is None else product * self.weight


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
    picture = image[inside]
    weight = None if region is None else region[inside]
    if valid is not None:
        usable = valid[inside].astype(np.float32)
        weight = usable if weight is None else usable * weight
    surface = _smooth_light(picture, weight)
    low, high = _clip_limits(picture, weight, surface)
    height, width = picture.shape
    window_u, window_v = _hann(width), _hann(height)
    windowed = np.empty((height, width), np.float32)
    _apply(picture, surface, low, high, window_u, window_v, windowed)
    if weight is not None:
        windowed *= weight
    return _with_moments(windowed, window_u, window_v, weight, bounds)


def _extent(region: Floats) -> tuple[int, int, int, int]:
    rows, columns = np.nonzero((region > 0).any(axis=1))[0], np.nonzero((region > 0).any(axis=0))[0]
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def _hann(count: int) -> Floats:
    """Hann window, zero half a pixel outside the first and last."""
    phase = 2 * np.pi * (np.arange(count) + 0.5) / count
    return (0.5 - 0.5 * np.cos(phase)).astype(np.float32)


@njit(cache=True, fastmath=True)
def _apply(  # type: ignore[no-untyped-def]  # pragma: no cover
    picture, surface, low, high, window_u, window_v, windowed
):
    """(picture - surface), clipped to [low, high], times the window."""
    height, width = picture.shape
    for row in range(height):
        v = np.float32(2 * row / (height - 1) - 1)
        c0 = surface[0] + v * (surface[1] + v * surface[2])
        c1 = surface[3] + v * surface[4]
        c2 = surface[5]
        for column in range(width):
            u = np.float32(2) * np.float32(column) / np.float32(width - 1) - np.float32(1)
            value = picture[row, column] - (c0 + u * (c1 + u * c2))
            value = min(max(value, low), high)
            windowed[row, column] = value * window_u[column] * window_v[row]


def _clip_limits(
    picture: Floats, weight: Floats | None, surface: Floats
) -> tuple[np.float32, np.float32]:
    """Median residual -+ some median deviations, from a part of the pixels."""
    step = 5 if weight is None else 3
    height, width = picture.shape
    u, v = np.linspace(-1, 1, width)[::step], np.linspace(-1, 1, height)[::step]
    light = np.add.outer(
        surface[0] + v * (surface[1] + v * surface[2]), u * (surface[3] + u * surface[5])
    ) + np.outer(v, u * surface[4])
    residual = picture[::step, ::step] - light
    sample = residual.ravel() if weight is None else residual[weight[::step, ::step] > 0.5]
    if sample.size == 0:
        return np.float32(-np.inf), np.float32(np.inf)
    centre = np.median(sample)
    limit = _CLIP * np.median(np.abs(sample - centre))
    return np.float32(centre - limit), np.float32(centre + limit)


# ------------------------------------------------------------------------- moments


@njit(cache=True, fastmath=True)
def _row_moments(values, most, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Sums of values x u^k, k = 0 .. most <= 4, along each row; u runs from -1 to 1."""
    height, width = values.shape
    for row in range(height):
        s0 = s1 = s2 = s3 = s4 = np.float32(0)
        for column in range(width):
            u = np.float32(2) * np.float32(column) / np.float32(width - 1) - np.float32(1)
            value = values[row, column]
            s0 += value
            s1 += value * u
            s2 += value * u * u
            if most > 2:
                s3 += value * u * u * u
                s4 += value * u * u * u * u
        out[row, 0], out[row, 1], out[row, 2] = s0, s1, s2
        if most > 2:
            out[row, 3], out[row, 4] = s3, s4


def _power_moments(values: Floats, most: int = 2) -> Array:
    """Sums of values x v^j u^k over the picture, [j, k]; u and v run from -1 to 1."""
    by_row = np.empty((values.shape[0], most + 1))
    _row_moments(values, most, by_row)
    return _powers(values.shape[0], most).T @ by_row


def _powers(count: int, most: int) -> Array:
    return np.vander(np.linspace(-1, 1, count), most + 1, increasing=True)


def _with_moments(
    windowed: Floats,
    window_u: Floats,
    window_v: Floats,
    weight: Floats | None,
    bounds: tuple[int, int, int, int],
) -> Picture:
    height, width = windowed.shape
    if weight is None:
        powers_u, powers_v = _powers(width, 2), _powers(height, 2)
        first = np.outer(powers_v.T @ window_v, powers_u.T @ window_u)
        second = np.outer(powers_v.T @ window_v**2, powers_u.T @ window_u**2)
    else:
        window = np.outer(window_v, window_u) * weight
        first, second = _power_moments(window), _power_moments(window * window)
    half_u, half_v = (width - 1) / 2, (height - 1) / 2
    moments, noise = _as_matrix(first, half_u, half_v), _as_matrix(second, half_u, half_v)
    total = max(float(moments[2, 2]), 1e-12)
    shift = moments[:2, 2] / total
    to_centroid = np.array([[1.0, 0.0, -shift[0]], [0.0, 1.0, -shift[1]], [0.0, 0.0, 1.0]])
    centred = to_centroid @ moments @ to_centroid.T
    left, top, _, _ = bounds
    return Picture(
        windowed=windowed,
        window_u=window_u,
        window_v=window_v,
        weight=weight,
        bounds_px=bounds,
        centroid_px=(left + half_u + float(shift[0]), top + half_v + float(shift[1])),
        u_px=np.arange(width) - half_u - shift[0],
        v_px=np.arange(height) - half_v - shift[1],
        total=total,
        variance=centred[:2, :2] / total,
        noise_moments=to_centroid @ noise @ to_centroid.T,
    )


def _as_matrix(powers: Array, half_u: float, half_v: float) -> Array:
    """Sum of weight x x^T with x = (u, v, 1) in pixels, from `_power_moments`."""
    uu, uv, vv = powers[0, 2] * half_u**2, powers[1, 1] * half_u * half_v, powers[2, 0] * half_v**2
    u, v = powers[0, 1] * half_u, powers[1, 0] * half_v
    return np.array([[uu, uv, u], [uv, vv, v], [u, v, powers[0, 0]]])


# Powers (of u, of v) of the smooth light, in the order of the kernel's coefficients.
_TERMS = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0)]


def _smooth_light(picture: Floats, weight: Floats | None) -> Floats:
    """Least-squares second-order surface of the grey levels: coefficients of `_TERMS`."""
    if weight is None:
        height, width = picture.shape
        powers_u, powers_v = _powers(width, 4).sum(axis=0), _powers(height, 4).sum(axis=0)
        weights = np.outer(powers_v, powers_u)
        moments = _power_moments(picture)
    else:
        weights = _power_moments(weight, 4)
        moments = _power_moments(picture * weight)
    gram = np.array([[weights[j + m, i + k] for k, m in _TERMS] for i, j in _TERMS])
    target = np.array([moments[j, i] for i, j in _TERMS])
    return np.linalg.lstsq(gram, target, rcond=1e-9)[0].astype(np.float32)
