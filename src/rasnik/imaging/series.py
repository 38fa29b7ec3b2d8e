"""The Fourier series of a view of the mask, coefficient by coefficient in closed form.

A window of fields somewhat larger than a tile of the image, taken as periodic, is a finite
Fourier series; see `rasnik.imaging.montecarlo` for what is made of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rasnik.imaging.deviations import EdgeErrors
from rasnik.imaging.nufft import (
    GUARD,
    OVERSAMPLING,
    evaluate_series,
    evaluate_series_at,
    grid_lengths,
    kernel_transform,
)
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.imaging.transfer import OpticalTransfer
from rasnik.mask import ChessField

__all__ = ["Scene", "Tile"]

# Fine grid points of one tile: at most, which bounds the memory to some 100 MB; and as many
# as the processor's cache holds, above which a point takes about 1.3 times as long.
_TILE_POINTS = 2**22
_CACHED_POINTS = 2**20
# Change of the local magnification from the middle to the corner of a tile of a projective
# map; the blur of a tile is that of its middle.
_TILE_CHANGE = 4e-4
_SPLITS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)


@dataclass(frozen=True)
class Tile:
    """A part of the image that is computed at once."""

    row: int
    column: int
    height: int
    width: int

    @property
    def rows(self) -> slice:
        return slice(self.row, self.row + self.height)

    @property
    def columns(self) -> slice:
        return slice(self.column, self.column + self.width)


@dataclass(frozen=True)
class _Span:
    """What a tile sees along one axis of the mask, taken as one period."""

    low_um: float
    length_um: float
    highest: int  # harmonic

    def fields(self, field_um: float) -> tuple[int, int]:
        """First field in the span, and the one after the last."""
        high_um = self.low_um + self.length_um
        return math.floor(self.low_um / field_um), math.ceil(high_um / field_um)

    def box_series(
        self, edges_um: NDArray[np.floating[Any]], k: NDArray[np.int64]
    ) -> NDArray[np.complex128]:
        """Harmonics k of each box from one edge to the next (the part of it in the span).

        Shape (k.size, edges - 1).
        """
        edges = np.clip((edges_um - self.low_um) / self.length_um, 0, 1)
        width, middle = np.diff(edges), (edges[:-1] + edges[1:]) / 2
        k = k[:, None]
        return np.asarray(width * np.sinc(k * width) * np.exp(-2j * np.pi * k * middle))

    def line_series(
        self, at_um: NDArray[np.floating[Any]], k: NDArray[np.int64]
    ) -> NDArray[np.complex128]:
        """Harmonics k of an infinitely narrow line of 1 um at each place; (k.size, places)."""
        phase = -2j * np.pi * (at_um - self.low_um) / self.length_um
        return np.asarray(np.exp(k[:, None] * phase) / self.length_um)

    def slope(self, k: NDArray[np.int64]) -> NDArray[np.complex128]:
        """Factor on harmonics k that makes the derivative against a shift, (k.size, 1)."""
        return np.asarray(-2j * np.pi * k[:, None] / self.length_um)


@dataclass(frozen=True)
class _Window:
    x: _Span
    y: _Span
    jacobian: NDArray[np.float64]

    @property
    def lengths(self) -> tuple[int, int]:
        """Fine grid (rows, columns)."""
        return grid_lengths((self.y.highest, self.x.highest))


@dataclass(frozen=True, eq=False)
class Scene:
    """What is seen, and by which pixels.

    Attributes
    ----------
    mask, projection, shape, pitch_um, transfer
        As for `rasnik.imaging.montecarlo.exact_pattern`.
    active_um : float
        Side of the square that a pixel takes its light from; 0 for a point.
    points_um : tuple of ndarray, optional
        (u, v) of shape (height, width): where the pixel centres lie, if not on their grid.
    edges : EdgeErrors, optional
        Errors of the printed contours.
    """

    mask: ChessField
    projection: Projection
    shape: tuple[int, int]
    pitch_um: float
    transfer: OpticalTransfer
    active_um: float
    points_um: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    edges: EdgeErrors | None = None

    @cached_property
    def _on_mask(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        return None if self.points_um is None else self.projection.to_mask(*self.points_um)

    def check(self) -> None:
        matrix = self.projection.matrix
        u, v = (side * self.pitch_um / 2 for side in self.shape[::-1])
        if 1 - abs(matrix[2, 0]) * u - abs(matrix[2, 1]) * v <= 0:
            raise ValueError("the projection sends points of the sensor to infinity")
        if np.linalg.cond(self.projection.jacobian) > 1e6:
            raise ValueError("the projection is singular: it maps the sensor onto a line")

    def pixel_to_sensor(self) -> NDArray[np.float64]:
        """Matrix from (column, row, 1) to (u, v, 1)."""
        u, v = sensor_grid_um(self.shape, self.pitch_um)
        return np.array([[self.pitch_um, 0, u[0]], [0, self.pitch_um, v[0]], [0, 0, 1.0]])

    def tiles(self) -> list[Tile]:
        """The cheapest cut of the image: small ones overlap more, large ones hold more
        fields that a rotated view does not see."""
        best: tuple[float, list[Tile]] | None = None
        for split in _SPLITS:
            tiles = self._cut(split)
            middle = tiles[len(tiles) // 2]
            points = float(np.prod(self._window(middle).lengths))
            cost = len(tiles) * points * (1.0 if points <= _CACHED_POINTS else 1.3)
            if points > _TILE_POINTS or self._change(middle) > _TILE_CHANGE:
                continue
            if best is not None and cost > 1.5 * best[0]:
                break
            if best is None or cost < best[0]:
                best = cost, tiles
        if best is None:
            raise ValueError(
                "the image is too large, or the projection too strong, to compute it exactly"
            )
        return best[1]

    def _cut(self, split: int) -> list[Tile]:
        rows, columns = (
            np.unique(np.linspace(0, side, split + 1).astype(int)) for side in self.shape
        )
        return [
            Tile(r0, c0, r1 - r0, c1 - c0)
            for r0, r1 in zip(rows[:-1], rows[1:], strict=True)
            for c0, c1 in zip(columns[:-1], columns[1:], strict=True)
        ]

    def _change(self, tile: Tile) -> float:
        """Relative change of the magnification from the middle of a tile to its corner."""
        radius = np.hypot(tile.width, tile.height) * self.pitch_um / 2
        return float(2 * np.hypot(*self.projection.matrix[2, :2]) * radius)

    def _window(self, tile: Tile) -> _Window:
        u, v = sensor_grid_um(self.shape, self.pitch_um)
        u = u[[tile.column, tile.column + tile.width - 1]]
        v = v[[tile.row, tile.row + tile.height - 1]]
        jacobian = self.projection.jacobian_at(float(u.mean()), float(v.mean()))
        corners = self.projection.to_mask(u, v[:, None])
        if self._on_mask is not None:
            corners = tuple(part[tile.rows, tile.columns] for part in self._on_mask)  # type: ignore[assignment]
        reach = self.transfer.reach_um + self.pitch_um / np.sqrt(2)
        inverse = np.linalg.inv(jacobian)
        spans = []
        for axis in (0, 1):
            cutoff = self.transfer.cutoff_per_um * np.hypot(*inverse[:, axis])
            margin = max(
                reach * np.hypot(*jacobian[axis]) * (1 + _TILE_CHANGE),
                GUARD / (2 * OVERSAMPLING * cutoff),
            )
            low, high = corners[axis].min() - margin, corners[axis].max() + margin
            spans.append(_Span(low, high - low, math.ceil(cutoff * (high - low))))
        return _Window(spans[0], spans[1], jacobian)

    def render(self, tile: Tile) -> NDArray[np.float64]:
        """The pixels of a tile, shape (height, width)."""
        window = self._window(tile)
        (rows, columns), x, y = window.lengths, window.x, window.y
        if self._on_mask is not None:
            on_x, on_y = (part[tile.rows, tile.columns] for part in self._on_mask)
            return evaluate_series_at(
                self._coefficients(window),
                (rows, columns),
                (on_x - x.low_um) * (columns / x.length_um),
                (on_y - y.low_um) * (rows / y.length_um),
            )
        # From pixels of this tile to fine grid steps of its window. The origin of the window
        # is taken off first: on a large mask it is where the digits would be lost.
        shift = np.array([[1, 0, -x.low_um], [0, 1, -y.low_um], [0, 0, 1]])
        steps = np.diag([columns / x.length_um, rows / y.length_um, 1])
        to_tile = np.array([[1, 0, tile.column], [0, 1, tile.row], [0, 0, 1.0]])
        matrix = steps @ (shift @ self.projection.matrix) @ self.pixel_to_sensor() @ to_tile
        return evaluate_series(
            self._coefficients(window), (rows, columns), matrix, (tile.height, tile.width)
        )

    def _coefficients(self, window: _Window) -> NDArray[np.complex128]:
        x, y, field_um = window.x, window.y, self.mask.field_um
        rows, columns = window.lengths
        k = np.arange(x.highest + 1)
        m = np.r_[0 : y.highest + 1, -y.highest : 0]
        i0, i1 = x.fields(field_um)
        j0, j1 = y.fields(field_um)
        kernel_x = kernel_transform(k / columns)[:, None]
        kernel_y = kernel_transform(m / rows)[:, None]
        along_x = x.box_series(np.arange(i0, i1 + 1) * field_um, k) / kernel_x
        along_y = y.box_series(np.arange(j0, j1 + 1) * field_um, m) / kernel_y
        fields = self.mask.fields(i0, i1, j0, j1)
        # Summed by a loop of our own: a threaded BLAS spends more time on waking its threads
        # than on matrices as narrow as these.
        lines = np.einsum("ji,ki->jk", fields, along_x)
        if self.edges is not None:
            more_y, more_lines = self._edge_terms(self.edges, window, k, m, fields)
            along_y = np.hstack([along_y, more_y / kernel_y])
            lines = np.vstack([lines, more_lines / kernel_x[:, 0]])
        # Frequency on the sensor, in cycles per um, as sums of a column's and a row's part.
        (a, b), (c, d) = window.jacobian
        u_x, v_x = a * k / x.length_um, b * k / x.length_um
        u_y, v_y = c * m / y.length_um, d * m / y.length_um
        p = self.active_um
        response = self.transfer(u_x + u_y[:, None], v_x + v_y[:, None])
        if p > 0:
            response = response * _sinc_of_sum(p * u_x, p * u_y)
            response *= _sinc_of_sum(p * v_x, p * v_y)
        coefficients = np.empty(response.shape, np.complex128)
        _sum_lines(np.ascontiguousarray(along_y), lines, response, coefficients)
        return coefficients

    def _edge_terms(
        self,
        edges: EdgeErrors,
        window: _Window,
        k: NDArray[np.int64],
        m: NDArray[np.int64],
        fields: NDArray[np.float32],
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """What displaced contours add: factors of y (harmonics, terms) and of x (terms, k).

        A contour displaced by d adds a strip of width d along its old place: to second order
        d times a line there and d^2 / 2 times the line's derivative.
        """
        x, y, a, parts = window.x, window.y, self.mask.field_um, edges.segments
        (i0, i1), (j0, j1) = x.fields(a), y.fields(a)
        i, j = np.arange(i0 + 1, i1), np.arange(j0 + 1, j1)
        fine_i, fine_j = np.arange(i0 * parts, i1 * parts), np.arange(j0 * parts, j1 * parts)
        # Contours along y, displaced in x.
        step = np.repeat(fields[:, :-1] - fields[:, 1:], parts, axis=0)
        d = edges.vertical_um(i, fine_j[:, None])
        line = x.line_series(i * a, k).T
        lines_x = (step * d) @ line + (step * d**2 / 2) @ (line * x.slope(k).T)
        boxes_y = y.box_series(np.append(fine_j, j1 * parts) * (a / parts), m)
        # Contours along x, displaced in y.
        step = np.repeat(fields[:-1] - fields[1:], parts, axis=1)
        d = edges.horizontal_um(fine_i, j[:, None])
        boxes_x = x.box_series(np.append(fine_i, i1 * parts) * (a / parts), k).T
        lines_y = y.line_series(j * a, m)
        return (
            np.hstack([boxes_y, lines_y, lines_y * y.slope(m)]),
            np.vstack([lines_x, (step * d) @ boxes_x, (step * d**2 / 2) @ boxes_x]),
        )


@njit(cache=True, fastmath=True, nogil=True)
def _sum_lines(weight, lines, factor, out):  # type: ignore[no-untyped-def]
    """``out[m, k] = factor[m, k] * sum_j weight[m, j] * lines[j, k]``."""
    # Real and imaginary parts apart, so that the inner loop becomes vector instructions.
    lines_re, lines_im = lines.real.copy(), lines.imag.copy()
    re, im = np.empty(out.shape[1]), np.empty(out.shape[1])
    for m in range(out.shape[0]):
        re[:] = 0.0
        im[:] = 0.0
        for j in range(lines.shape[0]):
            a, b = weight[m, j].real, weight[m, j].imag
            for k in range(re.size):
                re[k] += a * lines_re[j, k] - b * lines_im[j, k]
                im[k] += a * lines_im[j, k] + b * lines_re[j, k]
        for k in range(re.size):
            out[m, k] = factor[m, k] * complex(re[k], im[k])


def _sinc_of_sum(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """sinc(x + y), shape (y.size, x.size), with sines of the one-dimensional parts only."""
    x, y = np.pi * x, np.pi * y[:, None]
    total = x + y
    sine = np.sin(x) * np.cos(y)
    sine += np.cos(x) * np.sin(y)
    zero = np.abs(total) < 1e-7  # where sinc is 1 to rounding error
    sine[zero] = total[zero] = 1.0
    sine /= total
    return sine
