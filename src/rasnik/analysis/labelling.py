"""The eight ways in which the axes of a lattice can be those of the mask."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.readout import Readout
from rasnik.imaging.projection import Projection

__all__ = ["Labelling", "labellings"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Labelling:
    """A lattice with axes along those of the mask, its origin still open.

    Attributes
    ----------
    matrix : ndarray, shape (2, 3)
        Field coordinates = matrix @ (u_um, v_um, 1), growing with mask x and mask y.
    change : ndarray of int, shape (2, 2)
        ``matrix = change @ lattice.matrix``.
    first_i, first_j : int
        Field indices of element [0, 0] of the arrays.
    llr : ndarray, shape (nj, ni)
        Evidence for inversion, see `Readout`.
    present : ndarray of bool, shape (nj, ni)
    even_is_bright : bool
        Whether the bright fields of the chessboard are those with even i + j.
    orientation : int
    theta_rad : float
    """

    matrix: Array
    change: NDArray[np.int64]
    first_i: int
    first_j: int
    llr: Array
    present: NDArray[np.bool_]
    even_is_bright: bool
    orientation: int
    theta_rad: float


def labellings(matrix: Array, readout: Readout, orientation: int | None) -> list[Labelling]:
    """The labellings to try.

    Without `orientation` there is one for each orientation code: the one of least rotation, which
    is within 45 degrees for a similarity. (Column and row codes look alike, so every reading
    exists a second time with x and y exchanged and a quarter turn more.) With it, the four
    rotations of that code's handedness.
    """
    found = []
    for exchange in (False, True):
        for flip_p in (False, True):
            for flip_q in (False, True):
                one = _label(matrix, readout, exchange, flip_p, flip_q, orientation)
                if one is not None:
                    found.append(one)
    if orientation is not None:
        return found
    least: dict[int, Labelling] = {}
    for one in found:
        known = least.get(one.orientation)
        if known is None or abs(one.theta_rad) < abs(known.theta_rad):
            least[one.orientation] = one
    return [least[code] for code in sorted(least)]


def _label(
    matrix: Array,
    readout: Readout,
    exchange: bool,
    flip_p: bool,
    flip_q: bool,
    orientation: int | None,
) -> Labelling | None:
    change = np.array([[0, 1], [1, 0]]) if exchange else np.eye(2, dtype=np.int64)
    change = np.diag([-1 if flip_p else 1, -1 if flip_q else 1]) @ change
    labelled = change @ matrix
    projection = Projection(np.vstack([labelled, [0.0, 0.0, 1.0]]))
    if orientation is not None and projection.mirrored != (orientation in (2, 3)):
        return None
    _, theta, code = projection.similarity(orientation)

    llr, present = readout.llr, readout.present
    first_i, first_j = readout.first_i, readout.first_j
    if exchange:
        llr, present, first_i, first_j = llr.T, present.T, first_j, first_i
    rows, columns = llr.shape
    if flip_p:  # p -> -p takes field i to -i - 1
        llr, present, first_i = llr[:, ::-1], present[:, ::-1], -first_i - columns
    if flip_q:
        llr, present, first_j = llr[::-1], present[::-1], -first_j - rows
    return Labelling(
        matrix=labelled,
        change=change,
        first_i=first_i,
        first_j=first_j,
        llr=llr,
        present=present,
        even_is_bright=flip_p == flip_q,
        orientation=code,
        theta_rad=theta,
    )
