"""GDSII and OASIS, through gdstk."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

from rasnik.mask_files.cells import Array, field_cells
from rasnik.mask_files.layout import LAYERS, NM_PER_UM, Box, MaskFileError, Plate

__all__ = ["letter_polygons", "write_layout"]

#: Coordinates of GDSII have 32 bits.
_COORDINATE_LIMIT = 2**31 - 1
#: The same mask makes the same file: no date of writing.
_DATE = datetime(2000, 1, 1)


def write_layout(path: Path, plate: Plate) -> None:
    """Write a plate to ``.gds`` or ``.oas``: database unit 1 nm, user unit 1 um.

    The cell ``MASK`` holds everything; the layers are those of `LAYERS`.

    Raises
    ------
    MaskFileError
        If the numbers of the format do not reach, or gdstk is missing.
    """
    gdstk = _gdstk()
    if max(map(abs, plate.outline)) > _COORDINATE_LIMIT:
        raise MaskFileError(
            f"the mask reaches {max(map(abs, plate.outline)) / 1e9:.3g} m from its origin, but "
            "coordinates of layout files end at 2.147 m; draw a smaller part of it"
        )
    library = gdstk.Library("RASNIK", unit=1e-6, precision=1e-9)
    cells: dict[str, Any] = {}

    def reference(array: Array) -> object:
        x, y, dx, dy = (v / NM_PER_UM for v in (array.x, array.y, array.dx, array.dy))
        if array.columns == array.rows == 1:
            return gdstk.Reference(cells[array.cell], (x, y))
        return gdstk.Reference(
            cells[array.cell], (x, y), columns=array.columns, rows=array.rows, spacing=(dx, dy)
        )

    def rectangle(box: Box, group: str) -> object:
        x0, y0, x1, y1 = (v / NM_PER_UM for v in box)
        return gdstk.rectangle((x0, y0), (x1, y1), layer=LAYERS[group])

    for cell in field_cells(plate):
        cells[cell.name] = made = library.new_cell(cell.name)
        made.add(*(rectangle(box, "fields") for box in cell.boxes))
        made.add(*(reference(array) for array in cell.arrays))
    top = library.new_cell("MASK")
    top.add(gdstk.Reference(cells["FIELDS"]), rectangle(plate.outline, "outline"))
    top.add(*(rectangle(box, "frame") for box in plate.frame))
    top.add(*(rectangle(box, "crosses") for box in plate.cross_boxes))
    for vertices in letter_polygons(plate):
        points = [(x / NM_PER_UM, y / NM_PER_UM) for x, y in vertices]
        top.add(gdstk.Polygon(points, layer=LAYERS["label"]))
    if path.suffix.lower() == ".oas":
        library.write_oas(path)
    else:
        library.write_gds(path, timestamp=_DATE)


def letter_polygons(plate: Plate) -> list[list[tuple[int, int]]]:
    """The label as polygons: vertices (x, y) in nm, all sides along x or y.

    Raises
    ------
    MaskFileError
        If gdstk, whose letters these are, is missing.
    """
    gdstk = _gdstk()
    box, text = plate.label_box, plate.label
    # With a height of 16 the vertices are whole numbers; whole multiples stay on the grid.
    unit = plate.letter_height(text) // 16
    if box is None or not unit:
        return []
    x, y = box[0], (box[1] + box[3]) // 2 - 8 * unit
    return [
        [(x + round(u) * unit, y + round(v) * unit) for u, v in polygon.points]
        for polygon in gdstk.text(text, 16, (0, 0))
    ]


def _gdstk() -> Any:
    try:
        import gdstk
    except ImportError:
        raise MaskFileError(
            "GDSII, OASIS and DXF files need the packages gdstk and ezdxf: "
            "pip install 'rasnik[mask]'"
        ) from None
    return gdstk
