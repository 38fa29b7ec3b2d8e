"""What stands on the plate: fields, frame, crosses, label, outline, in whole nanometres.

Coordinates are those of the mask frame (x right, y up, origin at the lower-left corner of the
pivot of code cell (0, 0)), so that a position read from the file is one that analysis reports.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from rasnik.mask import ChessField

__all__ = ["LAYERS", "NM_PER_UM", "Box", "MaskFileError", "Plate", "Tone", "sized_mask"]

Tone = Literal["black", "clear"]
#: x0, y0, x1, y1 in nm
Box = tuple[int, int, int, int]

#: Layer number of each group of shapes; the datatype is 0. The outline is not to be made.
LAYERS = {"fields": 1, "frame": 2, "crosses": 3, "label": 4, "outline": 10}

NM_PER_UM = 1000
#: Nanometres by which a length may miss the grid and still be taken as on it: rounding of
#: decimal fractions, no more.
_GRID_TOLERANCE_NM = 1e-4
#: Share of the smaller side that the border has by default, and of the border the frame.
_BORDER_SHARE, _FRAME_SHARE = 0.1, 0.25
#: Height of a letter over its pitch in the fixed-pitch letters of the drawing formats.
_LETTER_PITCH = 9 / 16


class MaskFileError(ValueError):
    """A mask that cannot be drawn as asked for; one sentence says why and what would do."""


def sized_mask(
    mask: ChessField,
    size_mm: float | tuple[float, float] | None = None,
    *,
    polarity: Literal["positive", "negative"] | None = None,
    start_column: int | None = None,
    start_row: int | None = None,
) -> ChessField:
    """The part of a mask that fits on an area: as many whole code cells as it holds.

    Parameters
    ----------
    mask : ChessField
        Field size, code bits, and what is not given below.
    size_mm : float or (float, float), optional
        Side, or width and height, of the area for the fields. By default the whole mask.
    polarity : {"positive", "negative"}, optional
    start_column, start_row : int, optional
        Codes at the lower-left corner. Where a code is given without `size_mm`, the mask
        keeps its number of code cells as far as there are codes.

    Returns
    -------
    ChessField

    Raises
    ------
    MaskFileError
        If the size is not positive, holds no code cell, or asks for more codes than there are.
    """
    values = mask.model_dump()
    if polarity is not None:
        values["polarity"] = polarity
    sizes = size_mm if isinstance(size_mm, tuple) else (size_mm, size_mm)
    for start, axis, size in (
        (start_column, "column", sizes[0]),
        (start_row, "row", sizes[1]),
    ):
        if start is not None:
            values[f"first_{axis}"] = start
        first = int(values[f"first_{axis}"])
        if not 0 <= first < 2**mask.code_bits:
            raise MaskFileError(
                f"the mask cannot start at {axis} {first}: with mask.code_bits = "
                f"{mask.code_bits} the codes are 0 to {2**mask.code_bits - 1}"
            )
        if size is not None:
            values[f"{axis}s"] = _cells(mask, size, first, axis)
        elif start is not None and values[f"{axis}s"] is not None:
            values[f"{axis}s"] = min(values[f"{axis}s"], 2**mask.code_bits - first)
    try:
        return ChessField(**values)
    except ValidationError as error:  # whatever the checks above do not know of
        raise MaskFileError(str(error)) from error


def _cells(mask: ChessField, size_mm: float, first: int, axis: str) -> int:
    """Number of whole code cells on a length."""
    if not 0 < size_mm < np.inf:
        raise MaskFileError(f"the size of the mask, {size_mm:g} mm, must be above zero")
    cell_mm = mask.period * mask.field_um / 1000
    # A length that is a whole number of cells but for rounding holds that number.
    count = int(size_mm / cell_mm * (1 + 1e-12))
    if count < 1:
        raise MaskFileError(
            f"{size_mm:g} mm is less than one code cell, which is {mask.period} fields of "
            f"{mask.field_um:g} um = {cell_mm:g} mm; make the mask larger or the fields smaller"
        )
    if first + count > 2**mask.code_bits:
        raise MaskFileError(
            f"{size_mm:g} mm need the {axis} codes {first} to {first + count - 1}, but "
            f"{mask.code_bits} bits end at {2**mask.code_bits - 1}; "
            + _more_bits(mask, size_mm, first)
        )
    return count


def _more_bits(mask: ChessField, size_mm: float, first: int) -> str:
    for bits in range(mask.code_bits + 1, 25):
        if first + int(size_mm * 1000 / ((bits + 1) * mask.field_um)) <= 2**bits:
            return f"{bits} bits would do: --set mask.code_bits={bits}"
    return "no number of bits up to 24 would do: make the mask smaller"


def whole_nm(name: str, value_um: float, step_nm: int = 1) -> int:
    """A length as a whole number of nanometres.

    Raises
    ------
    MaskFileError
        If it is not a multiple of `step_nm`.
    """
    nm = value_um * NM_PER_UM
    whole = round(nm / step_nm) * step_nm
    if abs(nm - whole) > _GRID_TOLERANCE_NM:
        raise MaskFileError(
            f"{name} = {value_um:.10g} um is not a multiple of {step_nm / NM_PER_UM:g} um: masks "
            f"are drawn on a grid of 1 nm; the nearest that is: {whole / NM_PER_UM:.10g} um"
        )
    return whole


@dataclass(frozen=True)
class Plate:
    """A mask and what is drawn around it.

    Attributes
    ----------
    mask : ChessField
    tone : {"black", "clear"}
        Which fields are drawn: the black ones (the chrome is drawn) or the clear ones (the
        openings in the chrome are).
    gap_um : float
        Every edge of the drawn area moves inward by half of this: fields that touch at a
        corner come apart, those that share an edge stay joined. A negative gap is an overlap.
    border_mm : float, optional
        Width of the border that carries frame, crosses and label; 0 for none. By default a
        tenth of the smaller side.
    crosses : bool
        Alignment crosses in the four corners of the border.
    title : str
        What the label begins with; the facts of the mask follow.
    """

    mask: ChessField
    tone: Tone = "black"
    gap_um: float = 0.0
    border_mm: float | None = None
    crosses: bool = True
    title: str = "rasnik"

    def __post_init__(self) -> None:
        if self.tone not in ("black", "clear"):
            raise MaskFileError(f"tone {self.tone!r} is neither black nor clear")
        if self.border_mm is not None and not 0 <= self.border_mm < np.inf:
            raise MaskFileError(f"the border of {self.border_mm:g} mm must not be below zero")
        if not (self.title.isascii() and (self.title.isprintable() or not self.title)):
            raise MaskFileError(
                f"the label {self.title!r} has letters that cannot be drawn; "
                "use those of ASCII, on one line"
            )
        if abs(self.half_gap) * 2 >= self.field:
            what = "gap" if self.half_gap > 0 else "overlap"
            raise MaskFileError(
                f"the {what} of {abs(self.gap_um):g} um must be smaller than a field of "
                f"{self.mask.field_um:g} um"
            )
        _ = self.border

    # ------------------------------------------------------------------ lengths in nm

    @property
    def field(self) -> int:
        """Side of a field."""
        return whole_nm("mask.field_um", self.mask.field_um)

    @property
    def half_gap(self) -> int:
        """What every edge of the drawn area moves inward; negative: outward."""
        if not np.isfinite(self.gap_um):
            raise MaskFileError(f"the gap of {self.gap_um} um is not a length")
        return whole_nm("the gap or overlap", self.gap_um, step_nm=2) // 2

    @property
    def area(self) -> Box:
        """The fields, without gap or overlap."""
        i0, i1, j0, j1 = self.mask.bounds_fields
        a = self.field
        return i0 * a, j0 * a, i1 * a, j1 * a

    @property
    def border(self) -> int:
        """Width of the border."""
        if self.border_mm is not None:
            return whole_nm("the border", self.border_mm * 1000)
        x0, y0, x1, y1 = self.area
        share = min(x1 - x0, y1 - y0) * _BORDER_SHARE
        unit = 10_000 if share > 100_000 else 1
        return round(share / unit) * unit

    @property
    def outline(self) -> Box:
        """All that is drawn lies within."""
        x0, y0, x1, y1 = self.area
        b = self.border
        return x0 - b, y0 - b, x1 + b, y1 + b

    # --------------------------------------------------------------- around the fields

    @property
    def frame(self) -> list[Box]:
        """The opaque frame around the fields: four boxes, none where the clear tone is drawn."""
        width, h = round(self.border * _FRAME_SHARE), self.half_gap
        if self.tone == "clear" or width <= 2 * abs(h):
            return []
        x0, y0, x1, y1 = self.area
        X0, Y0, X1, Y1 = x0 - width + h, y0 - width + h, x1 + width - h, y1 + width - h
        x0, y0, x1, y1 = x0 - h, y0 - h, x1 + h, y1 + h
        return [(X0, Y0, X1, y0), (X0, y1, X1, Y1), (X0, y0, x0, y1), (x1, y0, X1, y1)]

    @property
    def cross_centres(self) -> list[tuple[int, int]]:
        """Centres of the alignment crosses; none without a border."""
        shift = round(self.border * (1 + _FRAME_SHARE) / 2)
        if not self.crosses or self.border < 100:
            return []
        x0, y0, x1, y1 = self.area
        return [(x, y) for y in (y0 - shift, y1 + shift) for x in (x0 - shift, x1 + shift)]

    @property
    def cross_boxes(self) -> list[Box]:
        """Each cross as three boxes that do not overlap."""
        arm, half = round(self.border * 0.3), max(round(self.border * 0.025), 1)
        boxes: list[Box] = []
        for x, y in self.cross_centres:
            boxes += [
                (x - arm, y - half, x + arm, y + half),
                (x - half, y + half, x + half, y + arm),
                (x - half, y - arm, x + half, y - half),
            ]
        return boxes

    @property
    def label(self) -> str:
        """The text on the plate."""
        m = self.mask
        facts = [
            f"field {m.field_um:.10g} um",
            f"columns {m.first_column}-{m.first_column + m.column_count - 1}",
            f"rows {m.first_row}-{m.first_row + m.row_count - 1}",
            f"{m.code_bits} bits {m.polarity}",
            f"{self.tone} drawn",
        ]
        if self.half_gap:
            facts.append(f"{'gap' if self.gap_um > 0 else 'overlap'} {abs(self.gap_um):g} um")
        return ", ".join([self.title] * bool(self.title) + facts)

    @property
    def label_box(self) -> Box | None:
        """Room for the label in the lower border between the crosses; None without a border."""
        return self._strip(lower=True)

    @property
    def bar_box(self) -> Box | None:
        """Room for a scale bar in the upper border; None without a border."""
        return self._strip(lower=False)

    def _strip(self, *, lower: bool) -> Box | None:
        if self.border < 100:
            return None
        x0, y0, x1, y1 = self.area
        near = round(self.border * (_FRAME_SHARE + 0.1))
        far = round(self.border * 0.9)
        y = (y0 - far, y0 - near) if lower else (y1 + near, y1 + far)
        inset = round(self.border * 0.1)
        return x0 + inset, y[0], x1 - inset, y[1]

    def letter_height(self, text: str) -> int:
        """Height of fixed-pitch letters with which a text fits into its box, nm."""
        box = self.label_box
        if box is None:
            return 0
        return int(min((box[2] - box[0]) / (len(text) * _LETTER_PITCH), (box[3] - box[1]) * 0.5))

    # --------------------------------------------------------------------------- fields

    def drawn(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether fields (i, j) are drawn; none is outside the mask."""
        white = self.mask.is_white(i, j)
        return white if self.tone == "clear" else self.mask.inside(i, j) & ~white

    def drawn_count(self) -> int:
        """Number of drawn fields."""
        i0, i1, j0, j1 = self.mask.bounds_fields
        columns = np.arange(i0, i1)
        # A band at a time: a large mask has some 10^8 fields.
        return sum(
            int(np.count_nonzero(self.drawn(columns, np.arange(j, min(j + 256, j1))[:, None])))
            for j in range(j0, j1, 256)
        )
