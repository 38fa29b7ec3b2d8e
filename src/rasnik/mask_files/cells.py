"""The fields as few small cells and arrays of them: what GDSII, OASIS and DXF files hold.

A code cell is its pivot, the column code above it, the row code beside it and the plain 8 x 8
chess. The plain chess is the same everywhere, a column code the same in every cell of its
column: each is drawn once and repeated by reference. With an odd period (8 bits have 9) the
colours swap from one code cell to the next, so that repeats are two code cells apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rasnik.mask_files.layout import Box, MaskFileError, Plate

__all__ = ["Array", "Cell", "field_cells"]


#: Counts of arrays in GDSII files have 15 bits.
_CELL_LIMIT = 2**15 - 1


@dataclass(frozen=True)
class Array:
    """A cell repeated `columns` x `rows` times, (dx, dy) nm apart, the first at (x, y) nm."""

    cell: str
    x: int
    y: int
    columns: int = 1
    rows: int = 1
    dx: int = 0
    dy: int = 0


@dataclass
class Cell:
    """Boxes and arrays of other cells, in nm."""

    name: str
    boxes: list[Box] = field(default_factory=list)
    arrays: list[Array] = field(default_factory=list)


def field_cells(plate: Plate) -> list[Cell]:
    """All fields as cells; the last, ``FIELDS``, holds all others and lies in the mask frame.

    No two boxes overlap unless the plate has an overlap; then drawn neighbours do.

    Raises
    ------
    MaskFileError
        If the mask has more code cells than layout files can repeat.
    """
    most = max(plate.mask.column_count, plate.mask.row_count)
    if most > _CELL_LIMIT:
        raise MaskFileError(
            f"the mask has {most} code cells in a row, but layout files repeat a cell at most "
            f"{_CELL_LIMIT} times; draw a smaller part of it"
        )
    return _Builder(plate).build()


class _Builder:
    def __init__(self, plate: Plate) -> None:
        self.plate = plate
        mask, self.a = plate.mask, plate.field
        self.period, self.step = mask.period, mask.period * plate.field
        self.m0, self.n0 = mask.first_column, mask.first_row
        self.m1, self.n1 = self.m0 + mask.column_count, self.n0 + mask.row_count
        # Code cells whose (m, n) differ by multiples of this have the same chess.
        self.cycle = 2 if self.period % 2 else 1
        self.top = Cell("FIELDS")
        self.cells: dict[tuple[Box, ...], Cell] = {}
        self.repeated: list[Cell] = []

    def build(self) -> list[Cell]:
        h, a = self.plate.half_gap, self.a
        one = Cell("FIELD", [(h, h, a - h, a - h)])
        self._plain_chess()
        self._pivots()
        for m in range(self.m0, self.m1):
            for n, count, gap in _classes(self.n0, self.n1, self.cycle):
                cell = self._strip(m, n, upright=True)
                self._place(cell, m, n, 1, count, gap)
        for n in range(self.n0, self.n1):
            for m, count, gap in _classes(self.m0, self.m1, self.cycle):
                cell = self._strip(m, n, upright=False)
                self._place(cell, m, n, count, 1, gap)
        return [one, *self.repeated, *self.cells.values(), self.top]

    def _drawn(self, i: int, j: int) -> bool:
        return bool(self.plate.drawn(np.asarray(i), np.asarray(j)))

    def _place(self, cell: str | None, m: int, n: int, columns: int, rows: int, gap: int) -> None:
        if cell is not None:
            spacing = gap * self.step
            self.top.arrays.append(
                Array(cell, m * self.step, n * self.step, columns, rows, spacing, spacing)
            )

    def _places(self) -> list[tuple[int, int, int, int]]:
        """(m, n, columns, rows) of arrays of like code cells which together cover the mask."""
        c = self.cycle
        return [
            (m, n, len(range(m, self.m1, c)), len(range(n, self.n1, c)))
            for m in range(self.m0, min(self.m0 + c, self.m1))
            for n in range(self.n0, min(self.n0 + c, self.n1))
        ]

    def _plain_chess(self) -> None:
        a, b = self.a, self.period - 1
        names: dict[bool, str] = {}
        for m, n, columns, rows in self._places():
            corner = self._drawn(m * self.period + 1, n * self.period + 1)
            if corner not in names:
                names[corner] = f"CHESS_{'A' if corner else 'B'}"
                cell = Cell(names[corner])
                for q in (1, 2)[:b]:  # two rows, then again
                    p = 1 if corner == (q == 1) else 2
                    wide, high = len(range(p, b + 1, 2)), len(range(q, b + 1, 2))
                    if wide:
                        cell.arrays.append(Array("FIELD", p * a, q * a, wide, high, 2 * a, 2 * a))
                self.repeated.append(cell)
            self._place(names[corner], m, n, columns, rows, self.cycle)

    def _pivots(self) -> None:
        for m, n, columns, rows in self._places():
            if self._drawn(m * self.period, n * self.period):
                self._place("FIELD", m, n, columns, rows, self.cycle)

    def _strip(self, m: int, n: int, *, upright: bool) -> str | None:
        """Name of the cell with the column code (upright) or row code of code cell (m, n).

        None where nothing is drawn. A gap keeps fields that share an edge joined: the bridges
        between them belong to the strips, as only a field of the code can be like its neighbour.
        """
        along = np.arange(self.period + 1)
        across = np.array([-1, 0, 1])[:, None]
        i, j = (across, along) if upright else (along, across)
        drawn = self.plate.drawn(m * self.period + i, n * self.period + j)
        boxes = _strip_boxes(drawn, self.a, self.plate.half_gap)
        if not boxes:
            return None
        if not upright:
            boxes = [(y0, x0, y1, x1) for x0, y0, x1, y1 in boxes]
        key = tuple(boxes)
        if key not in self.cells:
            kind, code, other = ("COLUMN", m, n) if upright else ("ROW", n, m)
            self.cells[key] = Cell(f"{kind}_{code}_AT_{other}", boxes)
        return self.cells[key].name


def _strip_boxes(drawn: NDArray[np.bool_], a: int, h: int) -> list[Box]:
    """Boxes of an upright strip: `drawn[1]` is the strip from pivot to pivot, 0 and 2 its sides."""
    left, strip, right = drawn
    boxes: list[Box] = []
    for q in range(1, len(strip)):
        low, high = q * a + h, (q + 1) * a - h
        here = strip[q] and q < len(strip) - 1
        if here:
            boxes.append((h, low, a - h, high))
        if h > 0:
            if here and left[q]:
                boxes.append((-h, low, h, high))
            if here and right[q]:
                boxes.append((a - h, low, a + h, high))
            if strip[q] and strip[q - 1]:
                boxes.append((h, q * a - h, a - h, q * a + h))
    return boxes


def _classes(first: int, end: int, cycle: int) -> list[tuple[int, int, int]]:
    """(start, count, gap) of runs of like codes: the last, at the edge of the mask, by itself."""
    last = end - 1
    runs = [(k, len(range(k, last, cycle)), cycle) for k in range(first, min(first + cycle, last))]
    return [*runs, (last, 1, cycle)]
