"""The search over all readings of a code.

A hypothesis -- which way the axes run, where the pivots are, the code of the first column and
of the first row -- says of every field whether it is inverted, since codes count up from line to
line. Its score is the sum of the evidence over its inverted fields. Column and row codes add
independently, so all hypotheses can be tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.labelling import Labelling
from rasnik.mask import ChessField

__all__ = ["MOST_CANDIDATES", "WINDOW", "Hypothesis", "fold", "search"]

Array = NDArray[np.float64]

#: Hypotheses this far below the best are not listed, and not more than this many.
WINDOW = 30.0
MOST_CANDIDATES = 16
# A field beyond the mask's extent that looks like chessboard is this much evidence against.
_OUTSIDE = -1.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Where the pivots are, and the codes of the first column and row of pivots.

    Attributes
    ----------
    labelling : Labelling
    offset_i, offset_j : int
        Array indices of the first pivot.
    column, row : int
        Codes of the first column and row of pivots.
    score : float
        Log-likelihood relative to a chessboard without code.
    """

    labelling: Labelling
    offset_i: int
    offset_j: int
    column: int
    row: int
    score: float


def search(choices: list[Labelling], mask: ChessField) -> list[Hypothesis]:
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
    found: list[Hypothesis] = []
    best = -np.inf
    for bound_here, scores, di, dj in offsets:
        if bound_here < best - WINDOW:
            break
        here = scores.readings(di, dj, best - WINDOW)
        best = max([best, *(one.score for one in here)])
        found += here
    found = [one for one in found if one.score >= best - WINDOW]
    found.sort(key=lambda one: -one.score)
    return found


class _Scores:
    """Evidence of one labelling, summed along columns and rows of fields.

    All cells of a code column show the same code, so the evidence for bit b of the column at i
    is the sum over all rows j congruent to the pivots' row + b: `by_column[residue of j, i]`.
    """

    def __init__(self, labelling: Labelling, mask: ChessField) -> None:
        self.labelling, self.mask = labelling, mask
        self.by_column = fold(labelling.llr, mask.period)
        self.by_row = fold(labelling.llr.T, mask.period)
        present = labelling.present.astype(float)
        self.column_fields = present.sum(axis=0)
        self.row_fields = present.sum(axis=1)
        self.pivots = fold(self.by_column.T, mask.period).T  # [residue of j, residue of i]

    def upper_bound(self) -> Array:
        """What a pivot at each offset [dj, di] can score at most."""
        period = self.mask.period
        # sum over the lines at each residue of all positive evidence except the pivots'
        columns = fold(np.maximum(self.by_column, 0).T, period).T
        rows = fold(np.maximum(self.by_row, 0).T, period)
        whole_columns, whole_rows = columns.sum(axis=0), rows.sum(axis=1)
        return self.pivots + (whole_columns - columns) + (whole_rows[:, None] - rows)

    def readings(self, di: int, dj: int, least: float) -> list[Hypothesis]:
        """The best readings with pivots at offset (di, dj) that score more than `least`."""
        mask = self.mask
        column_scores, first_column = _line_scores(
            self.by_column, self.column_fields, di, dj, mask, mask.first_column, mask.column_count
        )
        row_scores, first_row = _line_scores(
            self.by_row, self.row_fields, dj, di, mask, mask.first_row, mask.row_count
        )
        pivot = float(self.pivots[dj, di])
        highest = pivot + float(column_scores.max() + row_scores.max())
        least = max(least, highest - WINDOW)
        if highest < least:
            return []
        columns, rows = _top(column_scores), _top(row_scores)
        total = pivot + np.add.outer(column_scores[columns], row_scores[rows])
        return [
            Hypothesis(
                self.labelling,
                di,
                dj,
                int(columns[c]) + first_column,
                int(rows[r]) + first_row,
                float(total[c, r]),
            )
            for c, r in zip(*np.nonzero(total >= least), strict=True)
        ]


def fold(values: Array, period: int) -> Array:
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
    few = min(MOST_CANDIDATES, len(scores))
    top = np.argpartition(scores, -few)[-few:]
    best: NDArray[np.intp] = top[scores[top] >= scores[top].max() - WINDOW]
    return best
