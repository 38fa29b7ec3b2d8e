"""Which fields are inverted: the likelihood of each, from its grey level and its neighbours'."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.lattice import Lattice
from rasnik.analysis.levels import Levels, neighbour_sums, safe_half
from rasnik.analysis.sampling import FieldSamples
from rasnik.imaging.appearance import surface

__all__ = ["LLR_BOUND_BRIGHT", "LLR_BOUND_DARK", "Readout", "read_fields", "read_levels"]

Array = NDArray[np.float64]

#: Bounds of a field's log-likelihood ratio: dust lies with any size. It makes fields dark
#: rather than bright, so a bright field is better evidence.
LLR_BOUND_DARK = 4.0
LLR_BOUND_BRIGHT = 6.0
# Scatter of the grey levels below this part of the black-white step is not believed:
# the model of blur by nearest neighbours is no better.
_LEAST_SCATTER = 0.15


@dataclass(frozen=True, eq=False)
class Readout:
    """Evidence for inversion of every field in view.

    Attributes
    ----------
    first_i, first_j : int
        Lattice indices of element [0, 0].
    llr : ndarray, shape (nj, ni)
        Log-likelihood ratio (inverted against plain) of field (first_i + column,
        first_j + row), within +-`LLR_BOUND_BRIGHT`; 0 where there is no evidence.
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
    return read_levels(lattice.samples, lattice.levels)


def read_levels(samples: FieldSamples, levels: Levels) -> Readout:
    """Evidence for inversion, given the grey levels of the fields."""
    chess = samples.chess
    basis = surface(samples.u, samples.v)
    half = safe_half(basis @ levels.half)
    side_sum, diagonal_sum = neighbour_sums(levels.colour, chess)
    context = levels.side * side_sum + levels.diagonal * diagonal_sum
    level = (samples.grey - basis @ levels.middle) / half
    value = chess * (level - context) / levels.own
    noise = np.maximum(levels.scatter / half / levels.own, _LEAST_SCATTER)
    # p(grey | colour) is a Gaussian on a floor of outliers
    floor = np.exp(-np.where(level > context, LLR_BOUND_BRIGHT, LLR_BOUND_DARK))
    plain = np.exp(-0.5 * ((value - 1) / noise) ** 2) + floor
    inverted = np.exp(-0.5 * ((value + 1) / noise) ** 2) + floor
    present = samples.present
    with np.errstate(invalid="ignore"):
        llr = np.where(present, np.log(inverted / plain), 0.0)
    typical = float(np.median(noise[samples.present])) if samples.present.any() else 0.0
    return Readout(samples.first_i, samples.first_j, llr, present, value, typical)
