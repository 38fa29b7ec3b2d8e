"""Compiled inner loops of tracking.

A linearisation holds, for every pixel, the signals of the image model times their noise
weight, as 8-bit integers with one scale for each tile and signal: rounding adds 1e-4 to the
variance of a pose and halves the time, which goes into fetching them from memory. One pass
over a frame then sums its residuals with every signal, tile by tile; the rest are small
matrices.

Tiles are TILE rows high and several times TILE wide: long rows are read quickly, and about
nine tiles across the image keep 99 % of the information on scale and rotation.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rasnik.imaging.kernels import LEVEL, ROOT, STRIDE, TILE, WORK_ROWS, signals

__all__ = ["N_STATISTICS", "estimate", "store", "sum_frame"]

# What `estimate` tells beside the step.
CHI2, EXPECTED, WORST_TILE, MOTION, CONTRAST, POSE_ENERGY, SURPRISE = range(7)
N_STATISTICS = 7

MASK_X, MASK_Y, DARK, LIGHT, BLUR_VARIANCE = range(5)
_N_MODEL = 7
_N_MONOMIALS = 6
_PASSES = 4
_FEW = 64.0  # pixels; tiles with fewer are not judged

_compiled = njit(cache=True, fastmath=True, error_model="numpy", nogil=True)
# frames may hold NaN, which must not be optimised away
_careful = njit(
    cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy", nogil=True
)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_LARGEST = np.float32(127.0)
_ALL_BUT_SIGN = np.int32(0x7FFFFFFF)
_GOLDEN = np.float32(0.6180339887)  # its multiples are spread evenly between whole numbers


@_compiled
def store(
    first, last, parts, valid, scene, noise, level, weights, scales, products, rounding, counts
):
    """Work out the model for some tiles and keep what `estimate` needs of it.

    Parameters
    ----------
    first, last : int
        Tiles to work on, row by row.
    parts : int
        Width of a tile in units of TILE.
    valid : uint8, shape (H, W)
        1 where a pixel may be used.
    scene : Scene
    noise : float64, shape (3,)
        A and B of the variance A + B g, and its lower limit.
    level : float32, shape (H, W)
        Receives the expected grey levels.
    weights : int8, shape (tiles, signals + 1, TILE * TILE * parts)
        Receives signal / variance, and 1 / variance last.
    scales : float32, shape (tiles, signals + 1)
        Receives the value of one unit of `weights`.
    products : float64, shape (tiles, parts, 28)
        Receives the upper triangle of the products of signals over variance.
    rounding : float64, shape (tiles, signals, signals)
        Receives what rounding the weights (rows) adds to their products with the signals.
    counts : float64, shape (tiles, 3)
        Receives the number of pixels, and the sums of dark and light signal over variance.
    """
    height, width = valid.shape
    kept = weights.shape[1] - 1
    wide = TILE * parts
    across = -(-width // wide)
    a, b, floor = np.float32(noise[0]), np.float32(noise[1]), np.float32(noise[2])
    work = np.zeros((WORK_ROWS, STRIDE), dtype=np.float32)
    index = np.zeros((3, TILE * TILE), dtype=np.int32)
    weighted = np.zeros((kept + 1, TILE * wide), dtype=np.float32)
    plain = np.zeros((kept, TILE * wide), dtype=np.float32)
    for t in range(first, last):
        row0 = (t // across) * TILE
        rows = min(TILE, height - row0)
        weighted[:] = _ZERO
        counts[t] = 0.0
        for part in range(parts):
            column0 = (t % across) * wide + part * TILE
            if column0 >= width:
                break
            columns = min(TILE, width - column0)
            signals(work, index, scene, row0, column0, rows, columns)
            for lane in range(TILE * TILE):
                work[ROOT, lane] = _ZERO
            for row in range(rows):
                counts[t, 0] += _begin_row(
                    work[ROOT], work[LEVEL], np.uint32(row * TILE),
                    valid[row0 + row], level[row0 + row], np.uint32(column0), columns,
                )  # fmt: skip
            for s in range(kept):
                _to_tile(work[s], plain[s], part * TILE, wide)
            for lane in range(TILE * TILE):
                work[ROOT, lane] /= np.sqrt(max(a + b * work[LEVEL, lane], floor))
            for s in range(_N_MODEL):
                for lane in range(TILE * TILE):
                    work[s, lane] *= work[ROOT, lane]
            k = 0
            for s in range(_N_MODEL):
                for other in range(s, _N_MODEL):
                    products[t, part, k] = _dot_rows(work[s], work[other], TILE * TILE)
                    k += 1
            for s in range(kept):
                for lane in range(TILE * TILE):
                    work[s, lane] *= work[ROOT, lane]
                _to_tile(work[s], weighted[s], part * TILE, wide)
            for lane in range(TILE * TILE):
                work[ROOT, lane] *= work[ROOT, lane]
            _to_tile(work[ROOT], weighted[kept], part * TILE, wide)
        counts[t, 1] = _total(weighted[DARK])
        counts[t, 2] = _total(weighted[LIGHT])
        scales[t, kept] = _quantise_evenly(weighted[kept], weights[t, kept])
        for s in range(kept):
            scales[t, s] = _quantise(weighted[s], weights[t, s])
            for other in range(kept):
                rounding[t, s, other] = scales[t, s] * _dot(
                    plain[other], weights[t, s], np.uint32(0), TILE * wide
                )
        k = 0
        for s in range(_N_MODEL):
            for other in range(s, _N_MODEL):
                if other < kept:
                    exact = 0.0
                    for part in range(parts):
                        exact += products[t, part, k]
                    rounding[t, s, other] -= exact
                    if other != s:
                        rounding[t, other, s] -= exact
                k += 1


@_compiled
def _begin_row(used, expected, first, valid, level, column0, columns):
    """Which pixels of a row are used, and their expected grey level; how many there are."""
    count = 0
    for column in range(columns):
        lane, at = first + np.uint32(column), column0 + np.uint32(column)
        used[lane] = np.float32(valid[at])
        count += valid[at]
        level[at] = expected[lane]
    return count


@_compiled
def _to_tile(lanes, tile, first, wide):
    """Copy TILE x TILE lanes to where they belong in a wider tile."""
    for row in range(TILE):
        for column in range(TILE):
            tile[np.uint32(row * wide + first + column)] = lanes[np.uint32(row * TILE + column)]


@_careful
def _dot(values, weights, start, size):
    total = _ZERO
    for k in range(size):
        total += values[k] * np.float32(weights[start + np.uint32(k)])
    return total


@_compiled
def _dot_rows(first, second, size):
    total = _ZERO
    for k in range(size):
        total += first[np.uint32(k)] * second[np.uint32(k)]
    return total


@_compiled
def _largest(values):
    """Largest absolute value. Numbers and their bits, read as integers, have the same order;
    for integers the loop is compiled to vector instructions."""
    bits = values.view(np.int32)
    largest = np.zeros(1, dtype=np.int32)
    found = largest[0]
    for k in range(bits.size):
        size = bits[k] & _ALL_BUT_SIGN
        found = size if size > found else found
    largest[0] = found
    return largest.view(np.float32)[0]


@_compiled
def _total(values):
    total = _ZERO
    for k in range(values.size):
        total += values[np.uint32(k)]
    return total


@_compiled
def _quantise(values, integers):
    """Round to 8-bit integers; returns the value of one unit."""
    unit = _largest(values) / _LARGEST
    factor = _ONE / unit if unit > _ZERO else _ZERO
    for k in range(values.size):
        integers[k] = np.int8(np.rint(values[k] * factor))
    return unit


@_compiled
def _quantise_evenly(values, integers):
    """The same for values that hardly differ: as often up as down, so that their sum stays."""
    unit = _largest(values) / (_LARGEST - _ONE)
    factor = _ONE / unit if unit > _ZERO else _ZERO
    for k in range(values.size):
        turn = np.float32(k) * _GOLDEN
        wanted = values[k] * factor
        threshold = turn - np.floor(turn) if wanted > _ZERO else _ZERO
        integers[k] = np.int8(np.floor(wanted + threshold))
    return unit


@_careful
def _residuals(pixels, start, level, at, residual, to, count):
    for k in range(count):
        j = np.uint32(k)
        residual[to + j] = np.float32(pixels[start + j]) - level[at + j]


@_careful
def _energy(residual, weights, start, size):
    total = _ZERO
    for k in range(size):
        total += residual[k] * residual[k] * np.float32(weights[start + np.uint32(k)])
    return total


@_careful
def sum_frame(pixels, width, parts, level, weights, scales, sums, energies):
    """Residuals times signals, and their weighted squares, summed over each tile.

    It stands apart from `estimate` because it is compiled for every type of grey levels.

    Parameters
    ----------
    pixels : shape (H * W,)
        Grey levels of any type.
    width, parts : int
        W, and the width of a tile in units of TILE.
    level, weights, scales
        As made by `store`, the first two in one dimension.
    sums : float64, shape (tiles * signals,)
    energies : float64, shape (tiles,)
    """
    height = pixels.size // width
    kept = scales.shape[1]
    wide = TILE * parts
    size = TILE * wide
    across = -(-width // wide)
    residual = np.zeros(size, dtype=np.float32)
    for t in range(scales.shape[0]):
        row0 = (t // across) * TILE
        column0 = (t % across) * wide
        rows = min(TILE, height - row0)
        columns = min(wide, width - column0)
        if rows < TILE or columns < wide:
            residual[:] = _ZERO
        for row in range(rows):
            at = np.uint32((row0 + row) * width + column0)
            _residuals(pixels, at, level, at, residual, np.uint32(row * wide), columns)
        start = t * kept * size
        for s in range(kept - 1):
            sums[t * (kept - 1) + s] = scales[t, s] * _dot(
                residual, weights, np.uint32(start + s * size), size
            )
        last = np.uint32(start + (kept - 1) * size)
        energies[t] = scales[t, kept - 1] * _energy(residual, weights, last, size)


@_careful
def _apply(matrix, sums, result):
    """matrix (K, tiles * signals) times sums (tiles * signals)."""
    for k in range(matrix.shape[0]):
        row = matrix[k]
        total = 0.0
        for j in range(sums.size):
            total += row[j] * sums[j]
        result[k] = total


@_careful
def _amplitudes(t, step, n_pose, lever, basis, contrast, units, curvature, amplitude, excess):
    """How much of each signal a step puts into a tile, and how much of that is not linear.

    A contrast or a blur that differs from the reference scales the motion; the motion enters
    with a cubic term; and its square looks like blur. Returns the motion (fields) and the
    contrast.
    """
    dx = 0.0
    dy = 0.0
    for k in range(n_pose):
        dx += lever[t, 0, k] * step[k]
        dy += lever[t, 1, k] * step[k]
    dark = 0.0
    light = 0.0
    for m in range(_N_MONOMIALS):
        dark += basis[t, m] * step[n_pose + m]
        light += basis[t, m] * step[n_pose + _N_MONOMIALS + m]
    ratio = 1.0 + (light - dark) / contrast[t]
    xx = dx * dx
    yy = dy * dy
    shape = n_pose + 2 * _N_MONOMIALS - BLUR_VARIANCE
    bx = xx + step[shape + BLUR_VARIANCE] / (2.0 * curvature[2, 0])
    by = yy + step[shape + BLUR_VARIANCE] / (2.0 * curvature[2, 1])
    amplitude[MASK_X] = (
        ratio * dx * (1.0 + curvature[0, 0] * (3.0 * bx - 2.0 * xx) + curvature[0, 1] * by)
    )
    amplitude[MASK_Y] = (
        ratio * dy * (1.0 + curvature[1, 0] * bx + curvature[1, 1] * (3.0 * by - 2.0 * yy))
    )
    amplitude[DARK] = dark
    amplitude[LIGHT] = light
    excess[MASK_X] = amplitude[MASK_X] - dx
    excess[MASK_Y] = amplitude[MASK_Y] - dy
    for s in range(BLUR_VARIANCE, amplitude.size):
        linear = units[s - BLUR_VARIANCE] * step[shape + s]
        amplitude[s] = ratio * linear
        excess[s] = amplitude[s] - linear
    smear = ratio * (curvature[2, 0] * xx + curvature[2, 1] * yy)
    amplitude[BLUR_VARIANCE] += smear
    excess[BLUR_VARIANCE] += smear
    return np.sqrt(xx + yy), ratio


@_careful
def _refine(
    step,
    matrix,
    n_pose,
    lever,
    basis,
    contrast,
    units,
    curvature,
    grams,
    negligible,
    beyond,
    amplitude,
    excess,
):
    """Take out of a step what the linear estimator makes of terms that are not linear."""
    tiles, kept = grams.shape[0], grams.shape[1]
    first = step.copy()
    change = np.zeros(step.size)
    for _ in range(_PASSES):
        for t in range(tiles):
            _amplitudes(
                t, step, n_pose, lever, basis, contrast, units, curvature, amplitude, excess
            )
            for s in range(kept):
                total = 0.0
                for other in range(kept):
                    total += grams[t, s, other] * excess[other]
                beyond[t * kept + s] = total
        _apply(matrix, beyond, change)
        moved = 0.0
        for k in range(step.size):
            new = first[k] - change[k]
            if k < 2:
                moved = max(moved, abs(new - step[k]))
            step[k] = new
        if moved < negligible:
            break


@_careful
def estimate(
    sums, energies, matrix, n_pose, lever, basis, contrast, units, curvature, grams, within,
    counts, noise_slope, limits, negligible, step, statistics,
):  # fmt: skip
    """The step from the reference to a frame, and how well that explains it.

    Parameters
    ----------
    sums, energies
        As made by `sum_frame`.
    matrix : float32, shape (parameters + extra, tiles * signals)
        From sums over tiles to the step; the extra rows yield what other parameters would
        explain, in sigma.
    n_pose : int
    lever : float64, shape (tiles, 2, n_pose)
        Motion of the mask along X and Y, in fields, by each pose parameter.
    basis : float64, shape (tiles, 6)
    contrast : float64, shape (tiles,)
        Light less dark level of the reference.
    units : float64, shape (signals - 4,)
        What one unit of blur variance, edge shift and kurtosis puts into their signals.
    curvature : float64, shape (3, 2)
        What the square of a motion along X and Y (fields^2) adds to a motion along X and along Y,
        relative to it, and to the blur variance (um^2).
    grams : float64, shape (tiles, signals, signals)
        Products of the signals.
    within : float64, shape (n_pose, n_pose)
        Information on the pose that lies within the tiles.
    counts
        As made by `store`.
    noise_slope : float
        B of the variance A + B g.
    limits : float64, shape (tiles,)
        Chi-square per expected chi-square above which a tile does not fit.
    negligible : float
        A change of x and y too small to matter, um.
    step, statistics : float64
        Receive the step with the extra rows, and the N_STATISTICS figures: chi-square; what is
        expected of it at this light; the largest of chi-square over limit among the tiles; the
        largest motion of a tile (fields); contrast relative to the reference's; decrease of
        chi-square by the pose; what the extra rows yield, squared and summed.
    """
    tiles, kept = grams.shape[0], grams.shape[1]
    beyond = np.empty(tiles * kept)
    amplitude = np.zeros(kept)
    excess = np.zeros(kept)
    _apply(matrix, sums, step)
    _refine(
        step, matrix, n_pose, lever, basis, contrast, units, curvature, grams, negligible,
        beyond, amplitude, excess,
    )  # fmt: skip
    statistics[:] = 0.0
    for t in range(tiles):
        motion, ratio = _amplitudes(
            t, step, n_pose, lever, basis, contrast, units, curvature, amplitude, excess
        )
        explained = 0.0
        for s in range(kept):
            total = 0.0
            for other in range(kept):
                total += grams[t, s, other] * amplitude[other]
            explained += amplitude[s] * (2.0 * sums[t * kept + s] - total)
            if s < DARK:
                statistics[POSE_ENERGY] += amplitude[s] * total
        chi2 = energies[t] - explained
        brighter = counts[t, 1] * amplitude[DARK] + counts[t, 2] * amplitude[LIGHT]
        expected = counts[t, 0] + noise_slope * brighter
        statistics[CHI2] += chi2
        statistics[EXPECTED] += expected
        statistics[MOTION] = max(statistics[MOTION], motion)
        statistics[CONTRAST] += ratio / tiles
        if counts[t, 0] >= _FEW:
            worst = chi2 / (limits[t] * max(expected, 1.0))
            statistics[WORST_TILE] = max(statistics[WORST_TILE], worst)
    for k in range(n_pose):
        for other in range(n_pose):
            statistics[CHI2] -= step[k] * within[k, other] * step[other]
    for k in range(n_pose + 2 * _N_MONOMIALS + kept - BLUR_VARIANCE, step.size):
        statistics[SURPRISE] += step[k] * step[k]
