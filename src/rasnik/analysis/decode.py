"""Steps 2 and 3 of the analysis: the code lines read together, by likelihood.

Every field in view carries evidence for or against being inverted (`read_fields`). A hypothesis
-- which way the axes run, where the pivots are, the code of the first column and of the first
row -- says of every field whether it is inverted, since codes count up from line to line. Its
score is the sum of the evidence over its inverted fields, the log-likelihood relative to a
plain chessboard. Column and row codes add independently, so all hypotheses can be tried.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

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
# Hypotheses this far below the best are not listed.
_WINDOW = 30.0
_MOST_CANDIDATES = 16
# A plain chessboard, or another code, makes hardly any position better than no code at all,
# leaves inversions unexplained and predicts ones that are not seen. A position needs more
# evidence than the suspicion of one.
_SOME_EVIDENCE = 15.0
_LEAST_EVIDENCE = 25.0
_LEAST_EXPLAINED = 0.5
_LEAST_SEEN = 0.75
_QUARTER_TURN_RAD = np.radians(40)
# A field beyond the mask's extent that looks like chessboard is this much evidence against.
_OUTSIDE = -1.0


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
        Code of the first column and row with a pivot in view.
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


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    labelling: Labelling
    offset_i: int
    offset_j: int
    column: int
    row: int
    score: float


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
    found = _search(labellings(lattice.matrix, readout, orientation), mask)
    if not found or found[0].score < _SOME_EVIDENCE:
        return Decoding(Flag.NO_CODE, readout=readout)
    best = found[0]
    candidates = tuple(_labelled(one, best.score, mask) for one in found[:_MOST_CANDIDATES])
    margin = best.score - found[1].score if len(found) > 1 else _WINDOW
    lines_read, lines_in_view, plausible = _check(best, mask)
    flags = Flag.NONE
    if not plausible:
        flags |= Flag.NO_CODE
    elif margin < least_margin or best.score < _LEAST_EVIDENCE:
        flags |= Flag.AMBIGUOUS
    if orientation is None and abs(best.labelling.theta_rad) > _QUARTER_TURN_RAD:
        flags |= Flag.QUARTER_TURN
    return Decoding(
        flags, candidates[0], candidates, margin, lines_read, lines_in_view, readout=readout
    )


# ------------------------------------------------------------------------- search


def _search(choices: list[Labelling], mask: ChessField) -> list[_Hypothesis]:
    """All hypotheses within the window of the best, best first.

    What a pivot offset can reach at most is known from the evidence alone; offsets are tried in
    falling order of that, and those that cannot come near the best are skipped.
    """
    offsets = []
    for labelling in choices:
        scores = _Scores(labelling, mask)
        bound = scores.upper_bound()
        offsets += [
            (float(bound[dj, di]), scores, di, dj)
            for dj in range(mask.period)
            for di in range(mask.period)
        ]
    offsets.sort(key=lambda one: -one[0])
    found: list[_Hypothesis] = []
    best = -np.inf
    for bound_here, scores, di, dj in offsets:
        if bound_here < best - _WINDOW:
            break
        found += scores.readings(di, dj)
        best = max(best, max(one.score for one in found)) if found else best
    found = [one for one in found if one.score >= best - _WINDOW]
    found.sort(key=lambda one: -one.score)
    return found


class _Scores:
    """Evidence of one labelling, summed along columns and rows of fields.

    All cells of a code column show the same code, so the evidence for bit b of the column at i
    is the sum over all rows j congruent to the pivots' row + b: `by_column[residue of j, i]`.
    """

    def __init__(self, labelling: Labelling, mask: ChessField) -> None:
        self.labelling, self.mask = labelling, mask
        self.by_column = _fold(labelling.llr, mask.period)
        self.by_row = _fold(labelling.llr.T, mask.period)
        present = labelling.present.astype(float)
        self.column_fields = present.sum(axis=0)
        self.row_fields = present.sum(axis=1)
        self.pivots = _fold(self.by_column.T, mask.period).T  # [residue of j, residue of i]

    def upper_bound(self) -> Array:
        """What a pivot at each offset [dj, di] can score at most."""
        period = self.mask.period
        # sum over the lines at each residue of all positive evidence except the pivots'
        columns = _fold(np.maximum(self.by_column, 0).T, period).T
        rows = _fold(np.maximum(self.by_row, 0).T, period)
        whole_columns, whole_rows = columns.sum(axis=0), rows.sum(axis=1)
        return self.pivots + (whole_columns - columns) + (whole_rows[:, None] - rows)

    def readings(self, di: int, dj: int) -> list[_Hypothesis]:
        """The best readings with pivots at offset (di, dj)."""
        mask = self.mask
        column_scores, first_column = _line_scores(
            self.by_column, self.column_fields, di, dj, mask, mask.first_column, mask.column_count
        )
        row_scores, first_row = _line_scores(
            self.by_row, self.row_fields, dj, di, mask, mask.first_row, mask.row_count
        )
        best_columns, best_rows = _top(column_scores), _top(row_scores)
        pivot = float(self.pivots[dj, di])
        readings = [
            _Hypothesis(
                self.labelling, di, dj, int(c) + first_column, int(r) + first_row,
                pivot + float(column_scores[c] + row_scores[r]),
            )
            for c in best_columns
            for r in best_rows
        ]  # fmt: skip
        least = max(one.score for one in readings) - _WINDOW if readings else 0.0
        return [one for one in readings if one.score >= least]


def _fold(values: Array, period: int) -> Array:
    """Sum of rows a period apart: element [r] is the sum of rows r, r + period, ..."""
    rows = -(-values.shape[0] // period) * period
    padded = np.zeros((rows, values.shape[1]))
    padded[: values.shape[0]] = values
    folded: Array = padded.reshape(-1, period, values.shape[1]).sum(axis=0)
    return folded


def _line_scores(
    evidence: Array, fields: Array, line: int, across: int, mask: ChessField, first: int, count: int
) -> tuple[Array, int]:
    """Score of each code for the first line, and which code element 0 stands for.

    Parameters
    ----------
    evidence : ndarray, shape (period, n)
        See `_Scores.by_column`.
    fields : ndarray, shape (n,)
        Fields in view on each line of fields.
    line, across : int
        Residues of the pivots along and across the lines.
    first, count : int
        Codes on the mask.
    """
    period = mask.period
    bits = np.arange(1, period)
    lines = evidence[(across + bits) % period, line::period]  # [bit, line]
    n = lines.shape[1]
    if n == 0:
        return np.zeros(count), first
    codes = np.arange(first, first + count)
    set_bits = (codes[:, None] >> (mask.code_bits - bits)) & 1
    inside = set_bits @ lines  # [code, line]
    # lines may lie beyond the mask, where nothing should look like a chessboard
    n_out = n - 1
    outside = np.zeros(n)
    for k in range(n):
        near = fields[line + k * period : line + (k + 1) * period]
        outside[k] = _OUTSIDE * float(near.sum())
    whole = np.empty((count + 2 * n_out, n))
    whole[:n_out] = whole[n_out + count :] = outside
    whole[n_out : n_out + count] = inside
    total = np.zeros(count + n_out)
    for k in range(n):
        total += whole[k : k + count + n_out, k]
    return total, first - n_out


def _top(scores: Array) -> NDArray[np.intp]:
    """Indices of the best few scores within the window."""
    few = min(_MOST_CANDIDATES, len(scores))
    top = np.argpartition(scores, -few)[-few:]
    best: NDArray[np.intp] = top[scores[top] >= scores[top].max() - _WINDOW]
    return best


# ------------------------------------------------------------------------- result


def _labelled(one: _Hypothesis, best_score: float, mask: ChessField) -> LabelledLattice:
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


def _check(one: _Hypothesis, mask: ChessField) -> tuple[int, int, bool]:
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
    plausible = bool(explained > _LEAST_EXPLAINED and shown > _LEAST_SEEN)

    by_column, by_row = _fold(llr, period), _fold(llr.T, period)
    seen_column = _fold(labelling.present.astype(float), period)
    seen_row = _fold(labelling.present.T.astype(float), period)
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
        good = np.where(there, np.where(expected, lines, -lines) > sure, True).all(axis=0)
        enough = 2 * there.sum(axis=0) >= mask.code_bits
        in_view += int(there.any(axis=0).sum())
        read += int((good & enough).sum())
    return read, in_view, plausible
