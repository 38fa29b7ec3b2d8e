"""Black and white grey levels over an image and the mixing of neighbouring fields by blur."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.sampling import FieldSamples
from rasnik.imaging.appearance import surface

__all__ = ["Levels", "fit_levels", "neighbour_sums", "safe_half"]

Array = NDArray[np.float64]

_MOST_FIELDS_FITTED = 1500
_PASSES = 5
# A field counts little beyond this many times the scatter, or this part of the contrast.
_TOLERANCE = 3.0
_LEAST_TOLERANCE = 0.05
_LEAST_FIELDS = 20
_MOST_MIXING = 0.8


@dataclass(frozen=True, eq=False)
class Levels:
    """Grey levels of the fields: g = middle + half x (own s0 + side s4 + diagonal d4).

    s0 is the field's colour (+1 bright, -1 dark), s4 and d4 the sums over its four side and four
    diagonal neighbours; own + 4 side + 4 diagonal = 1.

    Attributes
    ----------
    middle, half : ndarray, shape (6,)
        Coefficients of `rasnik.imaging.appearance.surface`.
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


def neighbour_sums(colour: Array, chess: Array) -> tuple[Array, Array]:
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


def safe_half(half: Array) -> Array:
    """Keep a contrast surface from vanishing or changing sign far from where it was fitted."""
    floor = 0.05 * np.median(np.abs(half))
    return np.maximum(half, max(float(floor), 1e-9))


def fit_levels(samples: FieldSamples) -> Levels | None:
    """Black and white levels over the image and the mixing of neighbours by blur.

    The colours of the fields are judged and the levels fitted in turn; fields far from the model
    (dust) lose their weight. None if there are too few fields.
    """
    chess = samples.chess
    rows, columns = np.nonzero(samples.present)
    if len(rows) < _LEAST_FIELDS:
        return None
    thin = _scattered(len(rows), _MOST_FIELDS_FITTED)
    fitted = rows[thin], columns[thin]
    whole_basis = surface(samples.u[rows, columns], samples.v[rows, columns])
    basis, whole_grey = whole_basis[thin], samples.grey[rows, columns]
    grey = whole_grey[thin]
    colour = chess.copy()
    weight = np.ones(len(grey))
    part = np.array([1.0, 0.0, 0.0])  # own, side, diagonal
    scatter = 0.0
    for turn in range(_PASSES):
        sums = np.stack([colour, *neighbour_sums(colour, chess)])
        terms = sums[:, *fitted].T
        middle, half = _surfaces(basis, terms @ part, grey, weight)
        if turn > 0:
            part = _mixing(terms, grey - basis @ middle, basis @ half, weight)
            middle, half = _surfaces(basis, terms @ part, grey, weight)
        # judge every field by the nearer of its two expected levels, neighbours as known
        level = (whole_grey - whole_basis @ middle) / safe_half(whole_basis @ half)
        context = (part[1] * sums[1] + part[2] * sums[2])[rows, columns]
        judged = np.where(level > context, 1.0, -1.0)
        settled = turn > 1 and np.array_equal(judged, colour[rows, columns])
        colour[rows, columns] = judged
        rest = grey - basis @ middle - (basis @ half) * (terms @ part)
        scatter = 1.4826 * float(np.median(np.abs(rest)))
        if settled:
            break
        tolerance = max(
            _TOLERANCE * scatter, _LEAST_TOLERANCE * float(np.median(np.abs(basis @ half))), 1e-9
        )
        weight = 1.0 / (1.0 + (rest / tolerance) ** 2) ** 2
    own, side, diagonal = (float(value) for value in part)
    return Levels(middle, half, own, side, diagonal, scatter, colour)


def _scattered(count: int, most: int) -> NDArray[np.intp]:
    """At most `most` of `count` indices, spread evenly and without regard to the chessboard."""
    if count <= most:
        return np.arange(count)
    golden = (np.sqrt(5) - 1) / 2
    return np.unique((np.mod(np.arange(most) * golden, 1.0) * count).astype(np.intp))


def _surfaces(basis: Array, mixed: Array, grey: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares for the coefficients of middle and half."""
    design = np.hstack([basis, basis * mixed[:, None]])
    weighted = design * weight[:, None]
    found = np.linalg.lstsq(weighted.T @ design, weighted.T @ grey, rcond=1e-10)[0]
    solution = np.asarray(found, np.float64)
    return solution[:6], solution[6:]


def _mixing(terms: Array, level: Array, half: Array, weight: Array) -> Array:
    """Part of the light from the field itself, from a side and from a diagonal neighbour."""
    design = terms * half[:, None]
    weighted = design * weight[:, None]
    own, side, diagonal = np.linalg.lstsq(weighted.T @ design, weighted.T @ level, rcond=1e-6)[0]
    total = own + 4 * side + 4 * diagonal
    if not (own > 0 and total > 0):
        return np.array([1.0, 0.0, 0.0])
    side, diagonal = side / total, diagonal / total
    if side < 0 or 4 * (side + max(diagonal, 0)) > _MOST_MIXING:
        side = min(max(side, 0.0), 0.15)
        diagonal = min(max(diagonal, 0.0), 0.05)
    return np.array([1 - 4 * side - 4 * diagonal, side, diagonal])
