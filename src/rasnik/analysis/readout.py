"""Which fields are inverted: the likelihood of each, from its grey level and its neighbours'."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.lattice import FieldSamples, Lattice, quadratic_basis

__all__ = ["Levels", "Readout", "fit_levels", "read_fields"]

Array = NDArray[np.float64]

# A field's log-likelihood ratio is bounded by this: dust, hairs and glints lie with any size.
LLR_BOUND = 4.0
# Scatter of the grey levels below this part of the black-white step is not believed:
# the model of blur by nearest neighbours is no better.
_LEAST_SCATTER = 0.15
_MOST_FIELDS_FITTED = 4000
_PASSES = 4


@dataclass(frozen=True, eq=False)
class Levels:
    """Grey levels of the fields: g = middle + half x (own s0 + side s4 + diagonal d4).

    s0 is the field's colour (+1 bright, -1 dark), s4 and d4 the sums over its four side and four
    diagonal neighbours; own + 4 side + 4 diagonal = 1.

    Attributes
    ----------
    middle, half : ndarray, shape (6,)
        Coefficients of `quadratic_basis`.
    own, side, diagonal : float
        Part of a field's light that comes from itself and from each neighbour.
    scatter : float
        Robust rms of the grey levels about this model.
    colour : ndarray, shape (nj, ni)
        Colour of every field as judged, +1 or -1; the chessboard's where none was sampled.
    """

    middle: Array
    half: Array
    own: float
    side: float
    diagonal: float
    scatter: float
    colour: Array


def _neighbours(colour: Array, chess: Array) -> tuple[Array, Array]:
    """Sums over the four side and the four diagonal neighbours; chessboard beyond the array."""
    padded = np.empty((colour.shape[0] + 2, colour.shape[1] + 2))
    padded[1:-1, 1:-1] = colour
    padded[0, 1:-1], padded[-1, 1:-1] = -chess[0], -chess[-1]
    padded[1:-1, 0], padded[1:-1, -1] = -chess[:, 0], -chess[:, -1]
    padded[0, 0], padded[0, -1] = chess[0, 0], chess[0, -1]
    padded[-1, 0], padded[-1, -1] = chess[-1, 0], chess[-1, -1]
    vertical = padded[:-2] + padded[2:]
    side = vertical[:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
    return side, vertical[:, :-2] + vertical[:, 2:]


def fit_levels(samples: FieldSamples) -> Levels | None:
    """Black and white levels over the image and the mixing of neighbours by blur.

    The colours of the fields are judged and the levels fitted in turn; fields far from the model
    (dust) lose their weight. None if there are too few fields.
    """
    chess = samples.chess
    rows, columns = np.nonzero(samples.present)
    count = len(rows)
    if count < 20:
        return None
    thin = _scattered(count, _MOST_FIELDS_FITTED)
    fitted = rows[thin], columns[thin]
    grey = samples.grey[fitted]
    basis = quadratic_basis(samples.u[fitted], samples.v[fitted])
    whole_basis = quadratic_basis(samples.u, samples.v)[rows, columns]
    colour = chess.copy()
    weight = np.ones(len(grey))
    own, side, diagonal = 1.0, 0.0, 0.0
    middle = half = np.zeros(6)
    scatter = 0.0
    for turn in range(_PASSES):
        side_sum, diagonal_sum = _neighbours(colour, chess)
        mixed = own * colour + side * side_sum + diagonal * diagonal_sum
        middle, half = _surfaces(basis, mixed[fitted], grey, weight)
        if turn > 0:
            own, side, diagonal = _mixing(
                colour[fitted], side_sum[fitted], diagonal_sum[fitted],
                grey - basis @ middle, basis @ half, weight,
            )  # fmt: skip
            mixed = own * colour + side * side_sum + diagonal * diagonal_sum
            middle, half = _surfaces(basis, mixed[fitted], grey, weight)
        # judge every field by the nearer of its two expected levels, neighbours as known
        level = (samples.grey[rows, columns] - whole_basis @ middle) / _safe(whole_basis @ half)
        context = (side * side_sum + diagonal * diagonal_sum)[rows, columns]
        colour[rows, columns] = np.where(level > context, 1.0, -1.0)
        side_sum, diagonal_sum = _neighbours(colour, chess)
        mixed = own * colour + side * side_sum + diagonal * diagonal_sum
        rest = grey - basis @ middle - (basis @ half) * mixed[fitted]
        scatter = 1.4826 * float(np.median(np.abs(rest)))
        weight = 1.0 / (1.0 + (rest / max(3 * scatter, 1e-9)) ** 2) ** 2
    return Levels(middle, half, own, side, diagonal, scatter, colour)


def _scattered(count: int, most: int) -> NDArray[np.intp]:
    """At most `most` of `count` indices, spread evenly and without regard to the chessboard."""
    if count <= most:
        return np.arange(count)
    golden = (np.sqrt(5) - 1) / 2
    return np.unique((np.mod(np.arange(most) * golden, 1.0) * count).astype(np.intp))


def _safe(half: Array) -> Array:
    """Keep a contrast surface from vanishing or changing sign far from where it was fitted."""
    floor = 0.05 * np.median(np.abs(half))
    return np.maximum(half, max(float(floor), 1e-9))


def _surfaces(basis: Array, mixed: Array, grey: Array, weight: Array) -> tuple[Array, Array]:
    design = np.hstack([basis, basis * mixed[:, None]])
    weighted = design * weight[:, None]
    normal = weighted.T @ design
    normal[np.diag_indices(12)] *= 1 + 1e-9
    solution = np.linalg.lstsq(normal, weighted.T @ grey, rcond=1e-10)[0]
    return solution[:6], solution[6:]


def _mixing(
    colour: Array, side_sum: Array, diagonal_sum: Array, level: Array, half: Array, weight: Array
) -> tuple[float, float, float]:
    """Part of the light from the field itself, from a side and from a diagonal neighbour."""
    design = np.stack([colour, side_sum, diagonal_sum], axis=1) * half[:, None]
    weighted = design * weight[:, None]
    own, side, diagonal = np.linalg.lstsq(weighted.T @ design, weighted.T @ level, rcond=1e-6)[0]
    total = own + 4 * side + 4 * diagonal
    if not (own > 0 and total > 0):
        return 1.0, 0.0, 0.0
    side, diagonal = side / total, diagonal / total
    if side < 0 or 4 * (side + max(diagonal, 0)) > 0.8:
        side = min(max(side, 0.0), 0.15)
        diagonal = min(max(diagonal, 0.0), 0.05)
    return 1 - 4 * side - 4 * diagonal, side, diagonal


@dataclass(frozen=True, eq=False)
class Readout:
    """Evidence for inversion of every field in view.

    Attributes
    ----------
    first_i, first_j : int
        Lattice indices of element [0, 0].
    llr : ndarray, shape (nj, ni)
        Log-likelihood ratio (inverted against plain) of field (first_i + column,
        first_j + row), within +-`LLR_BOUND`; 0 where there is no evidence.
    present : ndarray of bool, shape (nj, ni)
        Fields in view that show the mask.
    value : ndarray, shape (nj, ni)
        Grey level on a scale where +1 is what the chessboard says and -1 the opposite,
        corrected for the neighbours' light; NaN where not in view.
    noise : float
        Scatter of `value`.
    """

    first_i: int
    first_j: int
    llr: Array
    present: NDArray[np.bool_]
    value: Array
    noise: float


def read_fields(lattice: Lattice) -> Readout:
    """Evidence for inversion of every field in the view of a lattice."""
    samples = lattice.samples
    levels = fit_levels(samples)
    if levels is None:
        empty = np.zeros_like(samples.grey)
        return Readout(
            samples.first_i, samples.first_j, empty, samples.present & False, empty, 0.0
        )
    return read_levels(samples, levels)


def read_levels(samples: FieldSamples, levels: Levels) -> Readout:
    """Evidence for inversion, given the grey levels of the fields."""
    chess = samples.chess
    basis = quadratic_basis(samples.u, samples.v)
    half = _safe(basis @ levels.half)
    side_sum, diagonal_sum = _neighbours(levels.colour, chess)
    context = levels.side * side_sum + levels.diagonal * diagonal_sum
    level = (samples.grey - basis @ levels.middle) / half
    value = chess * (level - context) / levels.own
    noise = np.maximum(levels.scatter / half / levels.own, _LEAST_SCATTER)
    floor = np.exp(-LLR_BOUND)
    plain = np.exp(-0.5 * ((value - 1) / noise) ** 2) + floor
    inverted = np.exp(-0.5 * ((value + 1) / noise) ** 2) + floor
    present = samples.present & _shows_mask(value, samples.present)
    with np.errstate(invalid="ignore"):
        llr = np.where(present, np.log(inverted / plain), 0.0)
    typical = float(np.median(noise[samples.present])) if samples.present.any() else 0.0
    return Readout(samples.first_i, samples.first_j, llr, present, value, typical)


# In any square of this many fields of a coded mask (9 x 9 for 8 bits) at least half are plain;
# where the mean over the square is lower, the mask is not there.
_NEIGHBOURHOOD = 9
_LEAST_MEAN = 0.25


def _shows_mask(value: Array, present: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether the surroundings of a field look like a chessboard at all."""
    sums = _box_sum(np.where(present, np.clip(value, -1, 1), 0.0), _NEIGHBOURHOOD)
    counts = _box_sum(present.astype(float), _NEIGHBOURHOOD)
    return sums > _LEAST_MEAN * counts


def _box_sum(values: Array, side: int) -> Array:
    reach = side // 2
    padded = np.pad(values, reach + 1)[:-1, :-1]
    total = padded.cumsum(axis=0).cumsum(axis=1)
    summed: Array = total[side:, side:] - total[:-side, side:] - total[side:, :-side]
    return summed + total[:-side, :-side]
