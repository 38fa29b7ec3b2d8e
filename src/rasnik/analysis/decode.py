"""Steps 2 and 3 of the analysis: the code lines read together, by likelihood.

Every field in view carries evidence for or against being inverted (`read_fields`). All readings
of the code are tried (`code_search`); the best counts if no other comes near it and the
image agrees with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.code_search import MOST_CANDIDATES, WINDOW, Hypothesis, fold, search
from rasnik.analysis.flags import Flag
from rasnik.analysis.labelling import Labelling, labellings
from rasnik.analysis.lattice import Lattice
from rasnik.analysis.readout import LLR_BOUND_BRIGHT, LLR_BOUND_DARK, Readout
from rasnik.imaging.projection import Projection
from rasnik.mask import ChessField

__all__ = ["LabelledLattice", "Decoding", "decode"]

Array = NDArray[np.float64]

#: Log-odds by which a position must beat every other one: more than any single field can give.
LEAST_MARGIN = LLR_BOUND_BRIGHT + 0.5
# A plain chessboard, or another code, makes hardly any position better than no code at all,
# leaves inversions unexplained and predicts ones that are not seen. A position needs more
# evidence than the suspicion of one.
_SOME_EVIDENCE = 15.0
_LEAST_EVIDENCE = 25.0
_LEAST_EXPLAINED = 0.5
_LEAST_SEEN = 0.75
# Certain bits that are not as decoded, per code line on average. A code that is nowhere in view
# has at least one in every line, for all the dirt there is. Columns and rows are judged by
# themselves: in an image torn by whole fields only those that cross the tear are misread.
_MOST_CONTRADICTED = 0.8
_QUARTER_TURN_RAD = np.radians(40)


@dataclass(frozen=True, eq=False)
class LabelledLattice:
    """A lattice whose fields are named: one reading of the code.

    Attributes
    ----------
    projection : Projection
        Affine map from sensor to mask (um).
    change : ndarray of int, shape (2, 2)
        Axes of the mask in terms of the lattice's: ``d(i, j) mask = change @ d(p, q) lattice``.
    orientation : int
    theta_rad : float
    column, row : int
        Code of the first column and row of pivots in the readout's arrays, which may reach
        beyond the view and even the mask.
    polarity : str
        ``"positive"`` if fields with even i + j are white before inversion.
    score : float
        Log-likelihood relative to a chessboard without code.
    log_odds : float
        Relative to the best reading: 0 for the best, negative for others.
    """

    projection: Projection
    change: NDArray[np.int64]
    orientation: int
    theta_rad: float
    column: int
    row: int
    polarity: str
    score: float
    log_odds: float


@dataclass(frozen=True, eq=False)
class Decoding:
    """What the code says.

    Attributes
    ----------
    flags : Flag
        `Flag.NO_CODE` or `Flag.AMBIGUOUS` if the position is not known.
    best : LabelledLattice or None
        The most likely reading, also when it is ambiguous.
    candidates : tuple of LabelledLattice
        All readings within 30 of the best (16 at most), best first.
    margin : float
        Log-odds of the best against the next other position.
    lines_read, lines_in_view : int
        Columns and rows of code whose every bit in view is certain and as decoded, at least half
        of the bits being in view; and all of those with any bit in view.
    """

    flags: Flag
    best: LabelledLattice | None = None
    candidates: tuple[LabelledLattice, ...] = ()
    margin: float = 0.0
    lines_read: int = 0
    lines_in_view: int = 0
    readout: Readout | None = field(default=None, repr=False)

    @property
    def ok(self) -> bool:
        """Whether there is one certain position."""
        return self.best is not None and not self.flags & (Flag.NO_CODE | Flag.AMBIGUOUS)

    @property
    def projection(self) -> Projection | None:
        """Affine map from sensor to mask of the best reading."""
        return None if self.best is None else self.best.projection

    @property
    def orientation(self) -> int:
        return 0 if self.best is None else self.best.orientation

    @property
    def polarity(self) -> str:
        return "" if self.best is None else self.best.polarity


def decode(
    readout: Readout,
    lattice: Lattice,
    mask: ChessField,
    orientation: int | None = None,
    *,
    least_margin: float = LEAST_MARGIN,
) -> Decoding:
    """Find which fields of the mask are in view.

    Parameters
    ----------
    readout : Readout
        Evidence for inversion per field (`read_fields`).
    lattice : Lattice
    mask : ChessField
        Field size, code bits and extent; its polarity is not used but found.
    orientation : int, optional
        Take the mask's axes to lie as in this orientation code, with any rotation. By default
        all four are tried, each with the rotation within 45 degrees.
    least_margin : float
        Log-odds below which the result is called ambiguous.

    Returns
    -------
    Decoding

    Raises
    ------
    ValueError
        If `orientation` is not 1..4.
    """
    if orientation not in (None, 1, 2, 3, 4):
        raise ValueError(f"orientation must be 1, 2, 3 or 4, not {orientation!r}")
    choices = labellings(lattice.matrix, readout, orientation)
    found = search(choices, mask)
    if not found or found[0].score < _SOME_EVIDENCE:
        return Decoding(Flag.NO_CODE, readout=readout)
    best = found[0]
    candidates = tuple(_labelled(one, best.score, mask) for one in found[:MOST_CANDIDATES])
    margin = best.score - found[1].score if len(found) > 1 else WINDOW
    lines_read, lines_in_view, plausible = _check(best, mask)
    flags = Flag.NONE
    if not plausible or _fits_beyond(choices, best, mask):
        flags |= Flag.NO_CODE
    elif margin < least_margin or best.score < _LEAST_EVIDENCE:
        flags |= Flag.AMBIGUOUS
    if orientation is None and abs(best.labelling.theta_rad) > _QUARTER_TURN_RAD:
        flags |= Flag.QUARTER_TURN
    return Decoding(
        flags, candidates[0], candidates, margin, lines_read, lines_in_view, readout=readout
    )


# ------------------------------------------------------------------------- result


def _fits_beyond(choices: list[Labelling], best: Hypothesis, mask: ChessField) -> bool:
    """Whether codes that this mask does not have explain the image better."""
    every = ChessField(field_um=mask.field_um, code_bits=mask.code_bits)
    if mask.bounds_fields == every.bounds_fields:
        return False
    return search(choices, every)[0].score > best.score + LEAST_MARGIN


def _labelled(one: Hypothesis, best_score: float, mask: ChessField) -> LabelledLattice:
    labelling, period = one.labelling, mask.period
    # mask index of a field = its index in the labelling + shift
    shift_i = one.column * period - (labelling.first_i + one.offset_i)
    shift_j = one.row * period - (labelling.first_j + one.offset_j)
    matrix = np.vstack([labelling.matrix, [0.0, 0.0, 1.0]])
    matrix[0, 2] += shift_i
    matrix[1, 2] += shift_j
    matrix[:2] *= mask.field_um
    positive = labelling.even_is_bright == ((shift_i + shift_j) % 2 == 0)
    return LabelledLattice(
        projection=Projection(matrix),
        change=labelling.change,
        orientation=labelling.orientation,
        theta_rad=labelling.theta_rad,
        column=one.column,
        row=one.row,
        polarity="positive" if positive else "negative",
        score=one.score,
        log_odds=one.score - best_score,
    )


def _check(one: Hypothesis, mask: ChessField) -> tuple[int, int, bool]:
    """Code lines read, code lines in view, and whether code and image agree at all."""
    labelling, period = one.labelling, mask.period
    llr = labelling.llr
    rows, columns = llr.shape
    i = np.arange(columns) - one.offset_i + one.column * period
    j = np.arange(rows) - one.offset_j + one.row * period
    inverted = mask.inverted(i, j[:, None])
    sure = 0.75 * LLR_BOUND_DARK
    seen = (llr > sure) & labelling.present
    certain = (np.abs(llr) > sure) & labelling.present
    explained = (seen & inverted).sum() / max(1, seen.sum())
    shown = (seen & inverted).sum() / max(1, (certain & inverted).sum())

    wrong = certain & (seen != inverted)
    on_column, on_row = i % period == 0, (j % period == 0)[:, None]
    contradicted = max(
        mask.code_bits * float((wrong & code).sum()) / max(1, (certain & code).sum())
        for code in (on_column & ~on_row, on_row & ~on_column)
    )

    by_column, by_row = fold(llr, period), fold(llr.T, period)
    seen_column = fold(labelling.present.astype(float), period)
    seen_row = fold(labelling.present.T.astype(float), period)
    read = in_view = 0
    for evidence, present, line, across, code in (
        (by_column, seen_column, one.offset_i, one.offset_j, one.column),
        (by_row, seen_row, one.offset_j, one.offset_i, one.row),
    ):
        bits = np.arange(1, period)
        index = (across + bits) % period
        lines, there = evidence[index, line::period], present[index, line::period] > 0
        codes = code + np.arange(lines.shape[1])
        expected = (codes >> (mask.code_bits - bits)[:, None]) & 1 == 1
        support = np.where(expected, lines, -lines)
        good = (~there | (support > sure)).all(axis=0)
        enough = 2 * there.sum(axis=0) >= mask.code_bits
        in_view += int(there.any(axis=0).sum())
        read += int((good & enough).sum())
    plausible = (
        explained > _LEAST_EXPLAINED and shown > _LEAST_SEEN and contradicted < _MOST_CONTRADICTED
    )
    return read, in_view, bool(plausible)
