"""The exact image: what every pixel is expected to hold, without discretisation.

The hard-edged mask, blurred by the optics and integrated over square pixels, is band-limited
where the optics transfer no detail. A window of fields somewhat larger than the view, taken
as periodic, is then a finite Fourier series whose coefficients are known in closed form:

    sum over fields (sinc sinc, with its phase) x optics (OTF) x pixel (sinc sinc),

the last two at the frequency that the harmonic has on the sensor, hence right under any
rotation or affine map. Summing the series at the pixel centres gives the image to `ACCURACY`
of the step from black to white. Nothing here is shared with the image model of the fit, so
that each can be tested against the other.

Source: van der Graaf et al., section 4, "Image simulations", whose generator (points sampled
within the pixel, blur spread over 11 x 11 pixels) this one replaces by its exact limit.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rasnik.imaging.levels import LevelMap, level_at
from rasnik.imaging.nufft import (
    GUARD,
    OVERSAMPLING,
    evaluate_series,
    grid_lengths,
    kernel_transform,
)
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.imaging.transfer import GaussianTransfer, OpticalTransfer
from rasnik.instrument import System
from rasnik.mask import ChessField

__all__ = ["ACCURACY", "exact_image", "exact_pattern"]

#: Largest error of the pattern, in units of the step from black to white (affine maps).
ACCURACY = 1e-7

# Fine grid points of one tile: at most, which bounds the memory to some 100 MB; and as many
# as the processor's cache holds, above which a point takes about 1.3 times as long.
_TILE_POINTS = 2**22
_CACHED_POINTS = 2**20
# Change of the local magnification from the middle to the corner of a tile of a projective
# map; the blur of a tile is that of its middle.
_TILE_CHANGE = 4e-4
# Transferred detail up to which the work stays bearable: a blur of 1/20 pixel.
_MAX_CYCLES_PER_PIXEL = 16.8
_SPLITS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)


def exact_image(
    system: System,
    projection: Projection,
    *,
    light_map: LevelMap | float | None = None,
    dark_map: LevelMap | float | None = None,
    shape: tuple[int, int] | None = None,
    transfer: OpticalTransfer | None = None,
    workers: int = 1,
) -> NDArray[np.float64]:
    """Expected grey level of every pixel: ``dark + (light - dark) * pattern``.

    Parameters
    ----------
    system : System
        Gives mask, pixel pitch (with binning), blur, and dark and light level.
    projection : Projection
        From the sensor to the mask, about the middle of the image.
    light_map, dark_map : callable or float, optional
        Grey level of a wide white or black area as a function of (u_um, v_um), e.g. a
        `QuadraticLevel`; taken at the pixel's centre. By default the system's levels.
    shape : tuple of int, optional
        (height, width); by default that of the system's read-out image.
    transfer : OpticalTransfer, optional
        Blur of the optics; by default Gaussian with the system's ``optics.blur_um``.
    workers : int
        Threads.

    Returns
    -------
    ndarray of float64, shape (height, width)
        Not rounded, not limited to the range of the sensor, without noise.

    Raises
    ------
    ValueError
        If the system has no blur (a hard edge has no finite Fourier series), or as
        `exact_pattern`.
    """
    shape = system.shape if shape is None else shape
    if transfer is None:
        transfer = GaussianTransfer(system.optics.blur_um)
    pattern = exact_pattern(
        system.mask, projection, shape, system.pitch_um, transfer, workers=workers
    )
    u, v = sensor_grid_um(shape, system.pitch_um)
    dark = level_at("dark_map", dark_map, system.sensor.dark_level, u, v[:, None])
    light = level_at("light_map", light_map, system.sensor.light_level, u, v[:, None])
    pattern *= light - dark
    pattern += dark
    return pattern


def exact_pattern(
    mask: ChessField,
    projection: Projection,
    shape: tuple[int, int],
    pitch_um: float,
    transfer: OpticalTransfer,
    *,
    workers: int = 1,
) -> NDArray[np.float64]:
    """Share of the light of a wide white area that every pixel receives.

    Parameters
    ----------
    mask : ChessField
        Opaque beyond its extent.
    projection : Projection
        From the sensor to the mask, about the middle of the image. For an affine map the
        result is exact to `ACCURACY`. For a projective one pixel centres are mapped
        exactly, while blur and outline of the pixel are those in the middle of the
        tile of the image that is computed at once; tiles are made so small that this
        changes no pixel by more than 1e-4.
    shape : tuple of int
        (height, width) in pixels.
    pitch_um : float
        Side of the square pixels, which leave no gap.
    transfer : OpticalTransfer
        Blur of the optics.
    workers : int
        Threads.

    Returns
    -------
    ndarray of float64, shape (height, width)
        0 for black, 1 for white.

    Raises
    ------
    ValueError
        If the shape is not positive, the blur is below 1/20 of a pixel, or the map is
        singular or sends points of the sensor to infinity.
    """
    if min(shape) < 1:
        raise ValueError(f"the image must have pixels, its shape cannot be {shape}")
    if transfer.cutoff_per_um * pitch_um > _MAX_CYCLES_PER_PIXEL:
        raise ValueError(
            f"the blur is too small against the {pitch_um:g} um pixel for the exact image, which "
            "needs a Gaussian sigma of 1/20 pixel at least: raise optics.blur_um"
        )
    scene = _Scene(mask, projection, shape, pitch_um, transfer)
    scene.check()
    image = np.empty(shape)
    tiles = scene.tiles()

    def fill(tile: _Tile) -> None:
        image[tile.row : tile.row + tile.height, tile.column : tile.column + tile.width] = (
            scene.render(tile)
        )

    if workers > 1 and len(tiles) > 1:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(fill, tiles))
    else:
        for tile in tiles:
            fill(tile)
    return image


@dataclass(frozen=True)
class _Tile:
    row: int
    column: int
    height: int
    width: int


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

    def field_series(self, field_um: float, k: NDArray[np.int64]) -> NDArray[np.complex128]:
        """Harmonics k of each field (the part of it in the span), shape (k.size, fields)."""
        first, end = self.fields(field_um)
        edges = (np.arange(first, end + 1) * field_um - self.low_um) / self.length_um
        edges = np.clip(edges, 0, 1)
        width, middle = np.diff(edges), (edges[:-1] + edges[1:]) / 2
        k = k[:, None]
        return np.asarray(width * np.sinc(k * width) * np.exp(-2j * np.pi * k * middle))


@dataclass(frozen=True)
class _Window:
    x: _Span
    y: _Span
    jacobian: NDArray[np.float64]

    @property
    def lengths(self) -> tuple[int, int]:
        """Fine grid (rows, columns)."""
        return grid_lengths((self.y.highest, self.x.highest))


@dataclass(frozen=True)
class _Scene:
    mask: ChessField
    projection: Projection
    shape: tuple[int, int]
    pitch_um: float
    transfer: OpticalTransfer

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

    def tiles(self) -> list[_Tile]:
        """The cheapest cut of the image: small ones overlap more, large ones hold more
        fields that a rotated view does not see."""
        best: tuple[float, list[_Tile]] | None = None
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

    def _cut(self, split: int) -> list[_Tile]:
        rows, columns = (
            np.unique(np.linspace(0, side, split + 1).astype(int)) for side in self.shape
        )
        return [
            _Tile(r0, c0, r1 - r0, c1 - c0)
            for r0, r1 in zip(rows[:-1], rows[1:], strict=True)
            for c0, c1 in zip(columns[:-1], columns[1:], strict=True)
        ]

    def _change(self, tile: _Tile) -> float:
        """Relative change of the magnification from the middle of a tile to its corner."""
        radius = np.hypot(tile.width, tile.height) * self.pitch_um / 2
        return float(2 * np.hypot(*self.projection.matrix[2, :2]) * radius)

    def _window(self, tile: _Tile) -> _Window:
        u, v = sensor_grid_um(self.shape, self.pitch_um)
        u = u[[tile.column, tile.column + tile.width - 1]]
        v = v[[tile.row, tile.row + tile.height - 1]]
        jacobian = _local_jacobian(self.projection, float(u.mean()), float(v.mean()))
        corners = self.projection.to_mask(u, v[:, None])
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

    def render(self, tile: _Tile) -> NDArray[np.float64]:
        window = self._window(tile)
        (rows, columns), x, y = window.lengths, window.x, window.y
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
        along_x = x.field_series(field_um, k) / kernel_transform(k / columns)[:, None]
        along_y = y.field_series(field_um, m) / kernel_transform(m / rows)[:, None]
        fields = self.mask.fields(*x.fields(field_um), *y.fields(field_um))
        # Summed by a loop of our own: a threaded BLAS spends more time on waking its threads
        # than on matrices as narrow as these.
        lines = np.einsum("ji,ki->jk", fields, along_x)
        # Frequency on the sensor, in cycles per pixel, as sums of a column's and a row's part.
        (a, b), (c, d) = window.jacobian * self.pitch_um
        u_x, v_x = a * k / x.length_um, b * k / x.length_um
        u_y, v_y = c * m / y.length_um, d * m / y.length_um
        pixel = _sinc_of_sum(u_x, u_y)
        pixel *= _sinc_of_sum(v_x, v_y)
        p = self.pitch_um
        response = pixel * self.transfer(u_x / p + u_y[:, None] / p, v_x / p + v_y[:, None] / p)
        coefficients = np.empty(response.shape, np.complex128)
        _sum_lines(along_y, lines, response, coefficients)
        return coefficients


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


def _local_jacobian(projection: Projection, u: float, v: float) -> NDArray[np.float64]:
    """d(X, Y) / d(u, v) at a point of the sensor."""
    m = projection.matrix
    w = m[2, 0] * u + m[2, 1] * v + 1
    x, y = projection.to_mask(u, v)
    return (m[:2, :2] - np.outer([float(x), float(y)], m[2, :2])) / w
