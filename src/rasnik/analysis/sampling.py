"""Grey levels at the centres of chess fields."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rasnik.analysis.lattice import FieldSamples

__all__ = ["sample_fields"]

Array = NDArray[np.float64]

# Part of a field's side over which its grey level is averaged.
_CENTRAL_PART = 0.4
_MOST_POINTS = 8  # per direction
_MOST_FIELDS = 4_000_000


@njit(cache=True)
def _weights(t: float, cubic: bool) -> tuple[float, float, float, float]:  # pragma: no cover
    """Interpolation weights of the samples at -1, 0, 1, 2 for a point at t in [0, 1]."""
    if not cubic:
        return 0.0, 1.0 - t, t, 0.0
    return (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@njit(cache=True)
def _sample(  # type: ignore[no-untyped-def]  # pragma: no cover
    image, valid, to_pixel, first_i, first_j, points, bounds, grey, present, u, v
):
    left, top, right, bottom = bounds
    height, width = image.shape
    rows, columns = grey.shape
    cubic = points == 1
    reach = 1 if cubic else 0
    for row in range(rows):
        for column in range(columns):
            total = 0.0
            count = 0
            inside = True
            for k in range(points * points):
                a = (k % points + 0.5) / points - 0.5
                b = (k // points + 0.5) / points - 0.5
                p = first_i + column + 0.5 + a * _CENTRAL_PART
                q = first_j + row + 0.5 + b * _CENTRAL_PART
                w = to_pixel[2, 0] * p + to_pixel[2, 1] * q + to_pixel[2, 2]
                x = (to_pixel[0, 0] * p + to_pixel[0, 1] * q + to_pixel[0, 2]) / w
                y = (to_pixel[1, 0] * p + to_pixel[1, 1] * q + to_pixel[1, 2]) / w
                if not (
                    x >= left + reach
                    and y >= top + reach
                    and x <= right - 1 - reach
                    and y <= bottom - 1 - reach
                ):
                    inside = False
                    break
                x0 = min(int(math.floor(x)), width - 2 - reach)
                y0 = min(int(math.floor(y)), height - 2 - reach)
                wx = _weights(x - x0, cubic)
                wy = _weights(y - y0, cubic)
                value = 0.0
                good = True
                for dy in range(-reach, 2 + reach):
                    for dx in range(-reach, 2 + reach):
                        if not valid[0, 0] and not valid[1 + y0 + dy, x0 + dx]:
                            good = False
                        value += wy[dy + 1] * wx[dx + 1] * image[y0 + dy, x0 + dx]
                if good:
                    total += value
                    count += 1
            p = first_i + column + 0.5
            q = first_j + row + 0.5
            w = to_pixel[2, 0] * p + to_pixel[2, 1] * q + to_pixel[2, 2]
            u[row, column] = (to_pixel[0, 0] * p + to_pixel[0, 1] * q + to_pixel[0, 2]) / w
            v[row, column] = (to_pixel[1, 0] * p + to_pixel[1, 1] * q + to_pixel[1, 2]) / w
            if inside and 2 * count >= points * points:
                grey[row, column] = total / count
                present[row, column] = True


def sample_fields(
    image: NDArray[np.float32],
    matrix: Array,
    bounds_px: tuple[int, int, int, int],
    valid: NDArray[np.bool_] | None = None,
    *,
    margin_fields: int = 0,
) -> FieldSamples:
    """Mean grey level of the central part of every field in view.

    Parameters
    ----------
    image : ndarray of float32, shape (height, width)
    matrix : ndarray, shape (3, 3) or (2, 3)
        Map from pixel coordinates (column, row, 1) to field coordinates; projective if 3 x 3.
    bounds_px : tuple of int
        (left, top, right, bottom) of the usable picture, right and bottom exclusive.
    valid : ndarray of bool, optional
        Usable pixels.

    Returns
    -------
    FieldSamples
    """
    full = np.vstack([matrix, [0.0, 0.0, 1.0]]) if matrix.shape[0] == 2 else matrix
    left, top, right, bottom = bounds_px
    corners = full @ np.array(
        [[left, right, left, right], [top, top, bottom, bottom], [1.0, 1.0, 1.0, 1.0]]
    )
    corners = corners[:2] / corners[2]
    first = np.floor(corners.min(axis=1)).astype(int) - margin_fields
    last = np.ceil(corners.max(axis=1)).astype(int) + margin_fields
    columns, rows = (int(n) for n in last - first)
    if columns * rows > _MOST_FIELDS:
        raise ValueError(f"{columns} x {rows} fields in view: the lattice is too fine")
    inverse = np.linalg.inv(full)
    centre = full @ np.array([(left + right) / 2, (top + bottom) / 2, 1.0])
    # sign such that w > 0 in view, whatever the scale of the matrix
    inverse = inverse / (inverse[2] @ (centre / centre[2]))
    jacobian = full[:2, :2] / centre[2] - np.outer(centre[:2], full[2, :2]) / centre[2] ** 2
    side_px = 1.0 / np.sqrt(abs(np.linalg.det(jacobian)))
    points = int(np.clip(np.ceil(_CENTRAL_PART * side_px), 1, _MOST_POINTS))
    if side_px < 6:
        points = 1

    grey = np.full((rows, columns), np.nan)
    present = np.zeros((rows, columns), dtype=bool)
    u, v = np.empty_like(grey), np.empty_like(grey)
    # row 0 of the mask handed to the kernel says whether every pixel is valid
    mask = np.ones((1, 1), dtype=bool)
    if valid is not None and not valid.all():
        mask = np.vstack([np.zeros((1, valid.shape[1]), dtype=bool), valid])
    _sample(
        image, mask, inverse, int(first[0]), int(first[1]), points, bounds_px, grey, present, u, v
    )
    height, width = image.shape
    return FieldSamples(
        first_i=int(first[0]),
        first_j=int(first[1]),
        grey=grey,
        present=present,
        u=(u - (width - 1) / 2) * 2 / width,
        v=(v - (height - 1) / 2) * 2 / height,
    )
