"""Where in the image the mask is seen: its edge or a stop may lie within the view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter, zoom

from rasnik.analysis.sampling import FieldSamples

__all__ = ["Coverage", "coverage", "region_of"]

Array = NDArray[np.float64]

# In any square of a coded mask of one period (9 x 9 fields for 8 bits) two thirds or more of the
# fields are plain and stand out of their neighbours; where the mean over such a square
# is lower than this, the mask is not there.
_NEIGHBOURHOOD = 9
_LEAST_MEAN = 0.2
# Range of grey levels in a 3 x 3 block, in units of a typical contrast, below which it is blank.
_LEAST_RANGE = 0.25
_STEP_PX = 4


@dataclass(frozen=True, eq=False)
class Coverage:
    """How well the fields of a lattice agree with a chessboard, and where.

    Attributes
    ----------
    fields : ndarray of bool, shape (nj, ni)
        Fields in view whose surroundings look like a chessboard.
    fraction : float
        Their part of the fields in view.
    agreement : float
        Part of these fields that are brighter or darker than their neighbours as the chessboard
        demands; 0.5 by chance.
    judged : int
        Number of these fields.
    """

    fields: NDArray[np.bool_]
    fraction: float
    agreement: float
    judged: int


def coverage(samples: FieldSamples) -> Coverage:
    """Compare every field with the mean of its four neighbours.

    Slow changes of the light and of the contrast don't matter.
    """
    grey, there = samples.grey, samples.present
    whole = np.zeros_like(there)
    whole[1:-1, 1:-1] = (
        there[1:-1, 1:-1] & there[:-2, 1:-1] & there[2:, 1:-1] & there[1:-1, :-2] & there[1:-1, 2:]
    )
    if whole.sum() < 9:
        return Coverage(there & False, 0.0, 0.0, 0)
    contrast = np.zeros_like(grey)
    around = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]
    contrast[1:-1, 1:-1] = (grey[1:-1, 1:-1] - around / 4) * samples.chess[1:-1, 1:-1]
    contrast = np.where(whole, contrast, 0.0)
    counts = _box_sum(whole.astype(float), _NEIGHBOURHOOD)
    fields = whole
    for _ in range(2):  # what contrast is typical, the covered part itself must say
        size = np.abs(contrast[fields & whole])
        typical = max(float(np.percentile(size, 75)), 1e-12) if size.size else np.inf
        sums = _box_sum(np.clip(contrast / typical, -1, 1), _NEIGHBOURHOOD)
        fields = there & (sums > _LEAST_MEAN * counts) & (counts > 0)
    fields &= _away_from_blank(grey, there, _LEAST_RANGE * typical)
    judged = fields & whole
    count = int(judged.sum())
    agreement = float((contrast[judged] > 0).mean()) if count else 0.0
    return Coverage(
        fields=fields,
        fraction=float(fields.sum() / there.sum()),
        agreement=agreement,
        judged=count,
    )


def _away_from_blank(grey: Array, there: NDArray[np.bool_], least: float) -> NDArray[np.bool_]:
    """Fields with no 3 x 3 block of a single colour about them or about a neighbour.

    A coded mask has none, whatever the code; beyond its edge there is nothing else.
    """
    high = maximum_filter(np.where(there, grey, -np.inf), 3, mode="constant", cval=-np.inf)
    low = minimum_filter(np.where(there, grey, np.inf), 3, mode="constant", cval=np.inf)
    blank = there & ~(high - low > least)
    near: NDArray[np.bool_] = maximum_filter(blank, 3, mode="constant", cval=0)
    return ~near


def _box_sum(values: Array, side: int) -> Array:
    """Sum over a square of side x side elements about each element."""
    reach = side // 2
    padded = np.pad(values, reach + 1)[:-1, :-1]
    total = padded.cumsum(axis=0).cumsum(axis=1)
    summed: Array = total[side:, side:] - total[:-side, side:] - total[side:, :-side]
    return summed + total[:-side, :-side]


def region_of(
    fields: NDArray[np.bool_],
    first_i: int,
    first_j: int,
    pixel_matrix: Array,
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Smooth weight, 1 well inside the covered fields and 0 outside, for every pixel.

    Parameters
    ----------
    fields : ndarray of bool, shape (nj, ni)
        Covered fields; element [0, 0] is field (first_i, first_j).
    pixel_matrix : ndarray, shape (2, 3)
        Field coordinates = pixel_matrix @ (column, row, 1).
    shape : tuple of int
        (height, width) of the image.
    """
    height, width = shape
    column = np.arange(0, width + _STEP_PX, _STEP_PX)
    row = np.arange(0, height + _STEP_PX, _STEP_PX)[:, None]
    p, q = (m[0] * column + m[1] * row + m[2] for m in pixel_matrix)
    padded = np.pad(fields, 1)
    i = np.clip(np.floor(p).astype(int) - first_i + 1, 0, padded.shape[1] - 1)
    j = np.clip(np.floor(q).astype(int) - first_j + 1, 0, padded.shape[0] - 1)
    side_px = 1 / math.sqrt(abs(np.linalg.det(pixel_matrix[:, :2])))
    smooth = gaussian_filter(
        padded[j, i].astype(np.float32), 1.5 * side_px / _STEP_PX, mode="nearest"
    )
    inner = np.clip(2 * smooth - 1, 0, 1)  # half of the blurred step lies outside
    fine = zoom(inner, _STEP_PX, order=1, grid_mode=False)[:height, :width]
    return np.ascontiguousarray(fine, dtype=np.float32)
