"""DXF, through ezdxf: blocks and arrays of them, in micrometres."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rasnik.mask_files.cells import Array, Cell, field_cells
from rasnik.mask_files.gds import letter_polygons
from rasnik.mask_files.layout import LAYERS, NM_PER_UM, Box, MaskFileError, Plate

__all__ = ["write_dxf"]

_MICROMETRES = 13  # code of this unit in a DXF file


def write_dxf(path: Path, plate: Plate) -> None:
    """Write a plate to ``.dxf``: closed polylines on the layers named in `LAYERS`.

    Raises
    ------
    MaskFileError
        If ezdxf or gdstk is missing.
    """
    try:
        from ezdxf.filemanagement import new
    except ImportError:
        raise MaskFileError(
            "DXF files need the package ezdxf: pip install 'rasnik[mask]'"
        ) from None
    letters = letter_polygons(plate)
    drawing = new("R2010", units=_MICROMETRES)
    for name in LAYERS:
        drawing.layers.add(name.upper())
    for cell in field_cells(plate):
        _fill(drawing.blocks.new(cell.name), cell)
    space: Any = drawing.modelspace()
    space.add_blockref("FIELDS", (0, 0), {"layer": "FIELDS"})
    for group, boxes in (
        ("frame", plate.frame),
        ("crosses", plate.cross_boxes),
        ("outline", [plate.outline]),
    ):
        for box in boxes:
            _polyline(space, _corners(box), group)
    for polygon in letters:
        _polyline(space, polygon, "label")
    drawing.saveas(path)


def _fill(block: Any, cell: Cell) -> None:
    for box in cell.boxes:
        _polyline(block, _corners(box), "fields")
    for array in cell.arrays:
        block.add_blockref(
            array.cell,
            (array.x / NM_PER_UM, array.y / NM_PER_UM),
            {"layer": "FIELDS", **_repetition(array)},
        )


def _repetition(array: Array) -> dict[str, Any]:
    if array.columns == array.rows == 1:
        return {}
    return {
        "column_count": array.columns,
        "row_count": array.rows,
        "column_spacing": array.dx / NM_PER_UM,
        "row_spacing": array.dy / NM_PER_UM,
    }


def _corners(box: Box) -> list[tuple[int, int]]:
    x0, y0, x1, y1 = box
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def _polyline(space: Any, points: list[tuple[int, int]], group: str) -> None:
    space.add_lwpolyline(
        [(x / NM_PER_UM, y / NM_PER_UM) for x, y in points],
        close=True,
        dxfattribs={"layer": group.upper()},
    )
