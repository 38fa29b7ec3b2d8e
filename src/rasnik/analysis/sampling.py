"""Grey levels at the centres of chess fields."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["FieldSamples", "sample_fields"]

Array = NDArray[np.float64]

# Part of a field's side over which its grey level is averaged.
_CENTRAL_PART = 0.4
_MOST_POINTS = 8  # per direction
# Smaller fields are sampled at their centre alone, by cubic interpolation.
_LEAST_AVERAGED_PX = 6.0
_MOST_FIELDS = 4_000_000


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """Grey levels at the field centres of a lattice.

    Attributes
    ----------
    first_i, first_j : int
        Lattice indices of element [0, 0].
    grey : ndarray, shape (nj, ni), float64
        Mean grey level of the central part of field (first_i + column, first_j + row).
    present : ndarray of bool, shape (nj, ni)
        Whether the central part of the field is in view.
    u, v : ndarray, shape (nj, ni)
        Field centre on the sensor in units of half the image width and height.
    """

    first_i: int
    first_j: int
    grey: Array
    present: NDArray[np.bool_]
    u: Array
    v: Array

    @property
    def chess(self) -> Array:
        """+1 where the chessboard is bright (i + j even), -1 where it is dark."""
        rows, columns = self.grey.shape
        parity = np.add.outer(np.arange(rows) + self.first_j, np.arange(columns) + self.first_i)
        return 1.0 - 2.0 * (parity % 2)


@njit(cache=True)
def _bilinear(image, x, y):  # type: ignore[no-untyped-def]  # pragma: no cover
    x0 = min(int(x), image.shape[1] - 2)
    y0 = min(int(y), image.shape[0] - 2)
    fx, fy = np.float32(x - x0), np.float32(y - y0)
    upper = image[y0, x0] + fx * (image[y0, x0 + 1] - image[y0, x0])
    lower = image[y0 + 1, x0] + fx * (image[y0 + 1, x0 + 1] - image[y0 + 1, x0])
    return upper + fy * (lower - upper)


@njit(cache=True)
def _cubic_weights(t):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Weights of the samples at -1, 0, 1, 2 for a point at t in [0, 1] (Catmull-Rom)."""
    return (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@njit(cache=True)
def _bicubic(image, x, y):  # type: ignore[no-untyped-def]  # pragma: no cover
    x0 = max(1, min(int(x), image.shape[1] - 3))
    y0 = max(1, min(int(y), image.shape[0] - 3))
    wx, wy = _cubic_weights(x - x0), _cubic_weights(y - y0)
    total = 0.0
    for k in range(4):
        row = y0 - 1 + k
        total += wy[k] * (
            wx[0] * image[row, x0 - 1]
            + wx[1] * image[row, x0]
            + wx[2] * image[row, x0 + 1]
            + wx[3] * image[row, x0 + 2]
        )
    return total


@njit(cache=True)
def _sample(  # type: ignore[no-untyped-def]  # pragma: no cover
    image, all_valid, valid, to_pixel, first_i, first_j, points, bounds, grey, present, px, py
):
    """Fill the grey level, presence and position (pixels) of each field."""
    left, top, right, bottom = bounds
    rows, columns = grey.shape
    step = _CENTRAL_PART / points
    start = -0.5 * _CENTRAL_PART + 0.5 * step
    for row in range(rows):
        for column in range(columns):
            p = first_i + column + 0.5
            q = first_j + row + 0.5
            w = 1.0 / (to_pixel[2, 0] * p + to_pixel[2, 1] * q + to_pixel[2, 2])
            x = w * (to_pixel[0, 0] * p + to_pixel[0, 1] * q + to_pixel[0, 2])
            y = w * (to_pixel[1, 0] * p + to_pixel[1, 1] * q + to_pixel[1, 2])
            px[row, column], py[row, column] = x, y
            # local steps of the map; reach of the central part along columns and rows
            xp = w * (to_pixel[0, 0] - x * to_pixel[2, 0])
            xq = w * (to_pixel[0, 1] - x * to_pixel[2, 1])
            yp = w * (to_pixel[1, 0] - y * to_pixel[2, 0])
            yq = w * (to_pixel[1, 1] - y * to_pixel[2, 1])
            reach_x = -start * (abs(xp) + abs(xq))
            reach_y = -start * (abs(yp) + abs(yq))
            if not (
                w > 0
                and x - reach_x >= left
                and x + reach_x <= right - 1
                and y - reach_y >= top
                and y + reach_y <= bottom - 1
            ):
                continue
            total = 0.0
            count = 0
            for b in range(points):
                for a in range(points):
                    da, db = start + a * step, start + b * step
                    sx, sy = x + da * xp + db * xq, y + da * yp + db * yq
                    if not all_valid and not (
                        valid[int(sy), int(sx)]
                        and valid[min(int(sy) + 1, bottom - 1), min(int(sx) + 1, right - 1)]
                    ):
                        continue
                    total += _bicubic(image, sx, sy) if points == 1 else _bilinear(image, sx, sy)
                    count += 1
            if 2 * count >= points * points:
                grey[row, column] = total / count
                present[row, column] = True


def sample_fields(
    image: NDArray[np.float32],
    matrix: Array,
    bounds_px: tuple[int, int, int, int],
    valid: NDArray[np.bool_] | None = None,
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

    Raises
    ------
    ValueError
        If the map is degenerate within the picture or its fields are far below a pixel.
    """
    full = np.vstack([matrix, [0.0, 0.0, 1.0]]) if matrix.shape[0] == 2 else matrix
    left, top, right, bottom = bounds_px
    u_px, v_px = np.array([left, right, left, right]), np.array([top, top, bottom, bottom])
    corners = full @ np.stack([u_px, v_px, np.ones(4)])
    if not (corners[2] * corners[2, 0] > 0).all():
        raise ValueError("the map from pixels to fields has its horizon inside the picture")
    p, q = corners[:2] / corners[2]
    first_i, first_j = math.floor(p.min()), math.floor(q.min())
    columns, rows = math.ceil(p.max()) - first_i, math.ceil(q.max()) - first_j
    if columns * rows > _MOST_FIELDS:
        raise ValueError(f"{columns} x {rows} fields in view: the lattice is too fine")
    points = _points((right - left) * (bottom - top), p, q)
    inverse = np.linalg.inv(full)
    if inverse[2] @ [p[0], q[0], 1.0] < 0:
        inverse = -inverse

    grey, present = np.full((rows, columns), np.nan), np.zeros((rows, columns), dtype=bool)
    px, py = np.empty_like(grey), np.empty_like(grey)
    mask = np.ones((1, 1), dtype=bool) if valid is None else valid
    _sample(
        image, valid is None, mask, inverse, first_i, first_j, points, bounds_px,
        grey, present, px, py,
    )  # fmt: skip
    height, width = image.shape
    return FieldSamples(
        first_i=first_i,
        first_j=first_j,
        grey=grey,
        present=present,
        u=(px - (width - 1) / 2) * 2 / width,
        v=(py - (height - 1) / 2) * 2 / height,
    )


def _points(area_px: float, p: Array, q: Array) -> int:
    """Sample points per direction, from the area in pixels and the corners in fields."""
    across = abs((p[3] - p[0]) * (q[2] - q[1]) - (p[2] - p[1]) * (q[3] - q[0])) / 2
    side_px = math.sqrt(area_px / max(across, 1e-9))
    if side_px < _LEAST_AVERAGED_PX:
        return 1
    return min(math.ceil(_CENTRAL_PART * side_px), _MOST_POINTS)
