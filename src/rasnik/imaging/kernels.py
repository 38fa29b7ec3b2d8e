"""Compiled inner loops of the image model.

The mask is a sum of fields, each the product of two blurred edges per axis:

    M(X, Y) = sum_ij t_ij wx_i(X) wy_j(Y),   wx_i = E(X - i) - E(X - i - 1),

where only the ``reach`` fields on either side of the nearest lattice corner matter. The
profile E already holds the pixel's projection on that axis; what the product of two
projections lacks of the true, rotated pixel (and of an oblique affine map) are the cross
cumulants, added as derivatives of M (see `rasnik.imaging.model`).

Pixels are worked on in tiles of TILE x TILE. Every step is a short loop over the pixels of a
tile without branches, which the compiler turns into vector instructions (longer ones it
gives up on); the intermediate values are rows of one small array that stays in the cache.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = [
    "LEVEL",
    "MAX_REACH",
    "N_PRODUCTS",
    "N_SIGNALS",
    "RESIDUAL",
    "TILE",
    "Scene",
    "gram",
    "render",
]

TILE = 16
LANES = TILE * TILE
STRIDE = LANES + 16  # rows 4096 bytes apart would stall each other's loads and stores
MAX_REACH = 4

# Per-pixel signals: derivatives of the expected grey level by mask X, mask Y (per field),
# dark level, light level, blur variance, edge shift, kurtosis; and the residual.
N_SIGNALS = 8
RESIDUAL = 7
N_PRODUCTS = N_SIGNALS * (N_SIGNALS + 1) // 2

# Rows of the work array, for the largest reach: the signals (with the grey level and the
# square root of the weight); distance to the corner; five orders of the profile at each
# edge; M and its derivatives (Mab: a times by X, b times by Y); scratch; then, if more than one
# corner is felt, five orders of the weight of each field, the fields' colours, and their
# sums along x.
LEVEL, ROOT = N_SIGNALS, N_SIGNALS + 1
DX, DY = N_SIGNALS + 2, N_SIGNALS + 3
EX = N_SIGNALS + 4
EY = EX + 5 * (2 * MAX_REACH - 1)
M00 = EY + 5 * (2 * MAX_REACH - 1)
M10, M01, M20, M02, M11 = M00 + 1, M00 + 2, M00 + 3, M00 + 4, M00 + 5
M31, M13, M22, M21, M12 = M00 + 6, M00 + 7, M00 + 8, M00 + 9, M00 + 10
M32, M23, M30, M03, M40, M04 = M00 + 11, M00 + 12, M00 + 13, M00 + 14, M00 + 15, M00 + 16
DENSITY, DENSITY_X, DENSITY_Y = M00 + 17, M00 + 18, M00 + 19
# orders of the derivatives in the rows from M00 on
ORDERS = np.array(
    [
        *([0, 0], [1, 0], [0, 1], [2, 0], [0, 2], [1, 1], [3, 1], [1, 3], [2, 2]),
        *([2, 1], [1, 2], [3, 2], [2, 3], [3, 0], [0, 3], [4, 0], [0, 4]),
    ]
)
DERIVATIVES = np.array([3, 15, 17])  # how many of them for 3, 4, 5 orders
SCRATCH = M00 + 20
WX = SCRATCH + 7
WY = WX + 5 * 2 * MAX_REACH
TT = WY + 5 * 2 * MAX_REACH
SUMS = TT + (2 * MAX_REACH) ** 2
WORK_ROWS = SUMS + 5 * 2 * MAX_REACH

_compiled = njit(cache=True, fastmath=True, error_model="numpy")
_HALF = np.float32(0.5)
_SIXTH = np.float32(1.0 / 6.0)
_ONE = np.float32(1.0)


class Scene(NamedTuple):
    """Everything that the expected image depends on.

    Attributes
    ----------
    map : float64, shape (3, 3)
        Sensor (um) to mask (fields).
    pixel_um : float
    axes : float64, shape (4,)
        u of column 0, v of row 0, and the half sizes that normalise u and v, um.
    photometry : float64, shape (2, 6)
        Dark and light level: coefficients of 1, u, v, u^2, uv, v^2 (normalised).
    shape : float64, shape (11,)
        Coefficients of M11, M31, M13, M22 in the expected pattern; of M20, M02, M11 in its
        derivative by blur variance; of M40, M22, M04 in that by kurtosis; the edge shift.
    subpixels : int
        Every pixel is the mean over subpixels x subpixels parts.
    table_x, limit_x, step_x, table_y, limit_y, step_y
        Edge profiles along mask X and Y (`rasnik.imaging.profile.EdgeTable`).
    fields : float32, shape (rows, columns)
        1 for white fields; i0, j0 is the index of the first.
    corners : int32, shape (rows, columns)
        The colours of the four fields that meet at the lower left corner of each field: bits
        0..3 for those below left, below, left, and the field itself.
    reach : int
        Number of fields felt on either side of a corner.
    orders : int
        Derivatives of the profile that are worked out: 3 for position and light alone (with
        neither corrections nor the signals of blur and edge shift), 4 for all but the
        kurtosis, 5 for all. Signals that are not worked out are zero.
    """

    map: NDArray[np.float64]
    pixel_um: float
    axes: NDArray[np.float64]
    photometry: NDArray[np.float64]
    shape: NDArray[np.float64]
    subpixels: int
    table_x: NDArray[np.float32]
    limit_x: float
    step_x: float
    table_y: NDArray[np.float32]
    limit_y: float
    step_y: float
    fields: NDArray[np.float32]
    corners: NDArray[np.int32]
    i0: int
    j0: int
    reach: int
    orders: int


@_compiled
def locate(work, index, h, u0, v0, pixel, columns, rows):
    """Nearest lattice corner of every pixel of a tile and the distance to it, in fields.

    The subtraction is done in double precision: positions are known to 1e-10 of a field.
    Beyond the last column and row of the image the last pixel is repeated.
    """
    affine = h[2, 0] == 0.0 and h[2, 1] == 0.0
    for row in range(TILE):
        v = v0 + min(row, rows - 1) * pixel
        xv = h[0, 1] * v + h[0, 2]
        yv = h[1, 1] * v + h[1, 2]
        wv = h[2, 1] * v + 1.0
        lane = row * TILE
        for column in range(TILE):
            u = u0 + min(column, columns - 1) * pixel
            w = 1.0 if affine else 1.0 / (h[2, 0] * u + wv)
            x = (h[0, 0] * u + xv) * w
            y = (h[1, 0] * u + yv) * w
            corner_x = np.floor(x + 0.5)
            corner_y = np.floor(y + 0.5)
            work[DX, lane + column] = x - corner_x
            work[DY, lane + column] = y - corner_y
            index[0, lane + column] = np.int32(corner_x)
            index[1, lane + column] = np.int32(corner_y)


@_compiled
def profiles(work, index, distance, out, table, limit, step, reach, orders):
    """E and its derivatives at every edge within reach: nearest entry plus Taylor."""
    edges = 2 * reach - 1
    last = np.float32(table.shape[0] - 1)
    inverse = np.float32(1.0 / step)
    spacing = np.float32(step)
    for edge in range(edges):
        offset = np.float32(limit - (edge - (reach - 1)))
        for lane in range(LANES):
            position = (work[distance, lane] + offset) * inverse
            position = min(max(position, np.float32(0.0)), last)
            nearest = np.floor(position + _HALF)
            index[2, lane] = np.int32(nearest)
            # borrowed for the offset from the table entry, in fields
            work[out + edge, lane] = (position - nearest) * spacing
        # reading by index cannot be made a vector instruction; it stands alone therefore
        for lane in range(LANES):
            i = np.uint32(index[2, lane])
            work[SCRATCH, lane] = table[i, 0]
            work[SCRATCH + 1, lane] = table[i, 1]
            work[SCRATCH + 2, lane] = table[i, 2]
        if orders == 3:
            for lane in range(LANES):
                t = work[out + edge, lane]
                e1 = work[SCRATCH + 1, lane]
                e2 = work[SCRATCH + 2, lane]
                work[out + edge, lane] = work[SCRATCH, lane] + t * (e1 + t * _HALF * e2)
                work[out + edges + edge, lane] = e1 + t * e2
            continue
        for lane in range(LANES):
            work[SCRATCH + 3, lane] = table[np.uint32(index[2, lane]), 3]
        for lane in range(LANES):
            t = work[out + edge, lane]
            e1 = work[SCRATCH + 1, lane]
            e2 = work[SCRATCH + 2, lane]
            e3 = work[SCRATCH + 3, lane]
            work[out + edge, lane] = work[SCRATCH, lane] + t * (
                e1 + t * (_HALF * e2 + t * _SIXTH * e3)
            )
            work[out + edges + edge, lane] = e1 + t * (e2 + t * _HALF * e3)
            work[out + 2 * edges + edge, lane] = e2 + t * e3
            work[out + 3 * edges + edge, lane] = e3
        if orders == 5:
            for lane in range(LANES):
                work[out + 4 * edges + edge, lane] = table[np.uint32(index[2, lane]), 4]


@_compiled
def one_corner(work, index, corners, width, origin, orders):
    """M and its derivatives where a pixel feels the four fields of one corner."""
    for lane in range(LANES):
        k = index[1, lane] * width + index[0, lane] - origin
        index[2, lane] = corners[np.uint32(k)]
    for lane in range(LANES):
        colours = index[2, lane]
        t00 = np.float32(colours & 1)
        below = np.float32((colours >> 1) & 1) - t00
        left = np.float32((colours >> 2) & 1) - t00
        twist = np.float32((colours >> 3) & 1) - t00 - below - left
        x0 = work[EX, lane]
        y0 = work[EY, lane]
        along_x = below + twist * y0
        work[M00, lane] = t00 + left * y0 + x0 * along_x
        work[SCRATCH, lane] = twist
        work[SCRATCH + 1, lane] = along_x
        work[SCRATCH + 2, lane] = left + twist * x0
        work[SCRATCH + 3, lane] = abs(below) * (_ONE - y0) + abs(below + twist) * y0
        work[SCRATCH + 4, lane] = abs(left) * (_ONE - x0) + abs(left + twist) * x0
        work[SCRATCH + 5, lane] = abs(below + twist) - abs(below)
        work[SCRATCH + 6, lane] = abs(left + twist) - abs(left)
    for lane in range(LANES):
        work[M10, lane] = work[EX + 1, lane] * work[SCRATCH + 1, lane]
        work[M01, lane] = work[EY + 1, lane] * work[SCRATCH + 2, lane]
    if orders == 3:
        return
    for lane in range(LANES):
        along_x = work[SCRATCH + 1, lane]
        along_y = work[SCRATCH + 2, lane]
        x1 = work[EX + 1, lane]
        y1 = work[EY + 1, lane]
        work[M20, lane] = work[EX + 2, lane] * along_x
        work[M02, lane] = work[EY + 2, lane] * along_y
        y2 = work[EY + 2, lane]
        x2 = work[EX + 2, lane]
        contour_x = work[SCRATCH + 3, lane]  # how much of the contours across x is felt
        contour_y = work[SCRATCH + 4, lane]
        work[DENSITY, lane] = x1 * contour_x + y1 * contour_y
        work[DENSITY_X, lane] = x2 * contour_x + y1 * x1 * work[SCRATCH + 6, lane]
        work[DENSITY_Y, lane] = y2 * contour_y + x1 * y1 * work[SCRATCH + 5, lane]
    for lane in range(LANES):
        twist = work[SCRATCH, lane]
        x1 = work[EX + 1, lane]
        y1 = work[EY + 1, lane]
        work[M11, lane] = twist * x1 * y1
        x2 = twist * work[EX + 2, lane]
        y2 = work[EY + 2, lane]
        x3 = twist * work[EX + 3, lane]
        y3 = work[EY + 3, lane]
        work[M31, lane] = x3 * y1
        work[M13, lane] = twist * x1 * y3
        work[M22, lane] = x2 * y2
        work[M21, lane] = x2 * y1
        work[M12, lane] = twist * x1 * y2
        work[M32, lane] = x3 * y2
        work[M23, lane] = x2 * y3
        work[M30, lane] = work[EX + 3, lane] * work[SCRATCH + 1, lane]
        work[M03, lane] = y3 * work[SCRATCH + 2, lane]
    if orders == 5:
        for lane in range(LANES):
            work[M40, lane] = work[EX + 4, lane] * work[SCRATCH + 1, lane]
            work[M04, lane] = work[EY + 4, lane] * work[SCRATCH + 2, lane]


@_compiled
def many_corners(work, index, flat, width, origin, reach, orders):
    """The same where a pixel feels several corners: sums over the fields within reach."""
    sides = 2 * reach
    for axis in range(2):
        weights(work, EX + axis * (EY - EX), WX + axis * (WY - WX), reach, orders)
    for sy in range(sides):
        for sx in range(sides):
            for lane in range(LANES):
                k = (index[1, lane] + sy - reach) * width + index[0, lane] - origin + sx - reach
                work[TT + sy * sides + sx, lane] = flat[np.uint32(k)]
    wanted = 2 if orders == 3 else orders  # E and its first derivative alone
    for order in range(wanted):
        for sy in range(sides):
            multiply_add(
                work, SUMS + order * sides + sy, TT + sy * sides, WX + order * sides, sides
            )
    for k in range(DERIVATIVES[orders - 3]):
        of_x, of_y = ORDERS[k]
        multiply_add(work, M00 + k, SUMS + of_x * sides, WY + of_y * sides, sides)
    if orders > 3:
        edge_densities(work, reach)


@_compiled
def multiply_add(work, out, first, second, count):
    """One row as the sum of `count` products of rows."""
    for lane in range(LANES):
        work[out, lane] = work[first, lane] * work[second, lane]
    for k in range(1, count):
        for lane in range(LANES):
            work[out, lane] += work[first + k, lane] * work[second + k, lane]


@_compiled
def weights(work, profile, weight, reach, orders):
    """Weights of the fields and their derivatives from the edges between them."""
    sides = 2 * reach
    edges = sides - 1
    for order in range(2 if orders == 3 else orders):
        first = profile + order * edges
        to = weight + order * sides
        for lane in range(LANES):
            start = _ONE if order == 0 else np.float32(0.0)
            work[to, lane] = start - work[first, lane]
            work[to + sides - 1, lane] = work[first + edges - 1, lane]
        for side in range(1, sides - 1):
            for lane in range(LANES):
                work[to + side, lane] = work[first + side - 1, lane] - work[first + side, lane]


@_compiled
def edge_densities(work, reach):
    """Length of black-white edge per pixel, folded with the profile's slope.

    This is minus the change of M when every black field grows by a small distance; its
    derivatives along X and Y are worked out too.
    """
    sides = 2 * reach
    edges = sides - 1
    for lane in range(LANES):
        work[DENSITY, lane] = np.float32(0.0)
        work[DENSITY_X, lane] = np.float32(0.0)
        work[DENSITY_Y, lane] = np.float32(0.0)
    for edge in range(edges):
        for side in range(sides):
            here = TT + side * sides + edge
            e1, w = EX + edges + edge, WY + side
            for lane in range(LANES):
                step = abs(work[here + 1, lane] - work[here, lane])
                work[DENSITY, lane] += step * work[e1, lane] * work[w, lane]
                work[DENSITY_X, lane] += step * work[e1 + edges, lane] * work[w, lane]
                work[DENSITY_Y, lane] += step * work[e1, lane] * work[w + sides, lane]
            here = TT + edge * sides + side
            e1, w = EY + edges + edge, WX + side
            for lane in range(LANES):
                step = abs(work[here + sides, lane] - work[here, lane])
                work[DENSITY, lane] += step * work[e1, lane] * work[w, lane]
                work[DENSITY_X, lane] += step * work[e1, lane] * work[w + sides, lane]
                work[DENSITY_Y, lane] += step * work[e1 + edges, lane] * work[w, lane]


@_compiled
def signals(work, index, scene, row0, column0, rows, columns):
    """Expected grey level and its derivatives for a tile of rows x columns pixels."""
    reach, orders, subpixels, pixel = scene.reach, scene.orders, scene.subpixels, scene.pixel_um
    width = np.int32(scene.fields.shape[1])
    origin = np.int32(scene.j0 * scene.fields.shape[1] + scene.i0)
    for a in range(N_SIGNALS + 1):
        for lane in range(LANES):
            work[a, lane] = np.float32(0.0)
    u_first = scene.axes[0] + column0 * pixel
    v_first = scene.axes[1] + row0 * pixel
    for part_v in range(subpixels):
        v = v_first + ((part_v + 0.5) / subpixels - 0.5) * pixel
        for part_u in range(subpixels):
            u = u_first + ((part_u + 0.5) / subpixels - 0.5) * pixel
            locate(work, index, scene.map, u, v, pixel, columns, rows)
            # one call for both axes: for a constant argument a function is compiled by itself
            for axis in range(2):
                table = scene.table_x if axis == 0 else scene.table_y
                limit = scene.limit_x if axis == 0 else scene.limit_y
                step = scene.step_x if axis == 0 else scene.step_y
                to = EX + axis * (EY - EX)
                profiles(work, index, DX + axis, to, table, limit, step, reach, orders)
            if reach == 1:
                one_corner(work, index, scene.corners.ravel(), width, origin, orders)
            else:
                many_corners(work, index, scene.fields.ravel(), width, origin, reach, orders)
            add_part(work, scene.shape, np.float32(1.0 / (subpixels * subpixels)), orders)
    for row in range(TILE):
        v = v_first + row * pixel
        grey_levels(work, scene.photometry, scene.axes, pixel, u_first, v, row * TILE)


@_compiled
def add_part(work, shape, share, orders):
    """Add one part of the pixel: the cumulant series and what the signals are made of."""
    c11, c31 = share * np.float32(shape[0]), share * np.float32(shape[1])
    c13, c22 = share * np.float32(shape[2]), share * np.float32(shape[3])
    b20, b02 = share * np.float32(shape[4]), share * np.float32(shape[5])
    b11 = share * np.float32(shape[6])
    k40, k22 = share * np.float32(shape[7]), share * np.float32(shape[8])
    k04 = share * np.float32(shape[9])
    shift = np.float32(shape[10])
    shared_shift = share * shift
    half_shift = _HALF * shift
    if orders == 3:
        for lane in range(LANES):
            work[0, lane] += share * work[M10, lane]
            work[1, lane] += share * work[M01, lane]
            work[3, lane] += share * work[M00, lane]
        return
    for lane in range(LANES):
        q11 = work[M11, lane]
        q22 = work[M22, lane]
        q20 = work[M20, lane]
        q02 = work[M02, lane]
        density = work[DENSITY, lane]
        curvature = shift * (q20 + q02)
        work[0, lane] += (
            share * work[M10, lane]
            + c11 * work[M21, lane]
            + c22 * work[M32, lane]
            + shared_shift
            * (half_shift * (work[M30, lane] + work[M12, lane]) - work[DENSITY_X, lane])
        )
        work[1, lane] += (
            share * work[M01, lane]
            + c11 * work[M12, lane]
            + c22 * work[M23, lane]
            + shared_shift
            * (half_shift * (work[M03, lane] + work[M21, lane]) - work[DENSITY_Y, lane])
        )
        work[3, lane] += (
            share * work[M00, lane]
            + c11 * q11
            + c31 * work[M31, lane]
            + c13 * work[M13, lane]
            + c22 * q22
            + shared_shift * (_HALF * curvature - density)
        )
        work[4, lane] += b20 * q20 + b02 * q02 + b11 * q11
        work[5, lane] += share * (curvature - density)
    if orders == 5:
        for lane in range(LANES):
            work[6, lane] += k40 * work[M40, lane] + k22 * work[M22, lane] + k04 * work[M04, lane]


@_compiled
def grey_levels(work, photometry, axes, pixel, u_first, v, first):
    """From the pattern to grey levels: second-order surfaces, a parabola along the row."""
    nv = v / axes[3]
    d0 = np.float32(photometry[0, 0] + nv * (photometry[0, 2] + nv * photometry[0, 5]))
    d1 = np.float32(photometry[0, 1] + nv * photometry[0, 4])
    d2 = np.float32(photometry[0, 3])
    l0 = np.float32(photometry[1, 0] + nv * (photometry[1, 2] + nv * photometry[1, 5]))
    l1 = np.float32(photometry[1, 1] + nv * photometry[1, 4])
    l2 = np.float32(photometry[1, 3])
    n0 = np.float32(u_first / axes[2])
    dn = np.float32(pixel / axes[2])
    for column in range(TILE):
        lane = first + column
        nu = n0 + np.float32(column) * dn
        dark = d0 + nu * (d1 + nu * d2)
        step = l0 + nu * (l1 + nu * l2) - dark
        white = work[3, lane]
        work[LEVEL, lane] = dark + step * white
        work[2, lane] = _ONE - white
        work[0, lane] *= step
        work[1, lane] *= step
        work[4, lane] *= step
        work[5, lane] *= step
        work[6, lane] *= step


@_compiled
def is_worked_out(signal, orders):
    """Whether a signal is not just zero."""
    if orders == 5:
        return True
    if orders == 4:
        return signal != 6
    return signal < 4 or signal == RESIDUAL


@_compiled
def weigh(work, image, valid, row0, column0, rows, columns, noise, orders):
    """The residual, and all signals times the square root of their weight; returns the count."""
    a, b, floor = np.float32(noise[0]), np.float32(noise[1]), np.float32(noise[2])
    for lane in range(LANES):
        work[ROOT, lane] = np.float32(0.0)
        work[RESIDUAL, lane] = np.float32(0.0)
    count = 0
    for row in range(rows):
        lane = row * TILE
        for column in range(columns):
            good = valid[row0 + row, column0 + column]
            count += good
            work[ROOT, lane + column] = np.float32(good)
            work[RESIDUAL, lane + column] = (
                image[row0 + row, column0 + column] - work[LEVEL, lane + column]
            )
    for lane in range(LANES):
        work[ROOT, lane] /= np.sqrt(max(a + b * work[LEVEL, lane], floor))
    for signal in range(N_SIGNALS):
        if is_worked_out(signal, orders):
            for lane in range(LANES):
                work[signal, lane] *= work[ROOT, lane]
    return count


@_compiled
def gram(image, valid, tiles, noise, scene):
    """Weighted products of the signals, summed over each tile.

    Parameters
    ----------
    image, valid : float32 and uint8, shape (H, W)
    tiles : int32, shape (n, 2)
        (row, column) of the tiles to sum.
    noise : float64, shape (3,)
        A and B of the variance A + B g, and its lower limit.
    scene : Scene

    Returns
    -------
    ndarray, shape (n, N_PRODUCTS + 1)
        Upper triangle of the products, row by row, and the number of pixels.
    """
    out = np.zeros((tiles.shape[0], N_PRODUCTS + 1))
    work = np.zeros((WORK_ROWS, STRIDE), dtype=np.float32)
    index = np.zeros((3, LANES), dtype=np.int32)
    for n in range(tiles.shape[0]):
        row0 = tiles[n, 0] * TILE
        column0 = tiles[n, 1] * TILE
        rows = min(TILE, image.shape[0] - row0)
        columns = min(TILE, image.shape[1] - column0)
        signals(work, index, scene, row0, column0, rows, columns)
        out[n, N_PRODUCTS] = weigh(
            work, image, valid, row0, column0, rows, columns, noise, scene.orders
        )
        k = 0
        for a in range(N_SIGNALS):
            for b in range(a, N_SIGNALS):
                if is_worked_out(a, scene.orders) and is_worked_out(b, scene.orders):
                    total = np.float32(0.0)
                    for lane in range(LANES):
                        total += work[a, lane] * work[b, lane]
                    out[n, k] = total
                k += 1
    return out


@_compiled
def render(height, width, scene, rows_wanted):
    """Some of the signals for every pixel.

    Parameters
    ----------
    height, width : int
    scene : Scene
    rows_wanted : int64, shape (n,)
        Which signals: 0..6, or LEVEL for the expected grey level.

    Returns
    -------
    ndarray of float32, shape (n, height, width)
    """
    out = np.empty((rows_wanted.size, height, width), dtype=np.float32)
    work = np.zeros((WORK_ROWS, STRIDE), dtype=np.float32)
    index = np.zeros((3, LANES), dtype=np.int32)
    for row0 in range(0, height, TILE):
        rows = min(TILE, height - row0)
        for column0 in range(0, width, TILE):
            columns = min(TILE, width - column0)
            signals(work, index, scene, row0, column0, rows, columns)
            for a in range(rows_wanted.size):
                source = rows_wanted[a]
                for row in range(rows):
                    for column in range(columns):
                        out[a, row0 + row, column0 + column] = work[source, row * TILE + column]
    return out
