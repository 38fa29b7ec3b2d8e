"""``rasnik mask``: a file to have a mask made from, or to print one."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from rasnik.cli.common import fail, load, messages

if TYPE_CHECKING:
    from rasnik.mask_files import Plate

__all__ = ["mask_command"]


class Polarity(StrEnum):
    """Which fields are white before the code inverts some."""

    POSITIVE = "positive"
    NEGATIVE = "negative"


class Drawn(StrEnum):
    """Which fields are drawn."""

    BLACK = "black"
    CLEAR = "clear"


def mask_command(
    system: Annotated[str, typer.Argument(help="Name of a system, or path of a TOML file.")],
    path: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="File: .gds, .oas, .dxf, .svg, .pdf or .png."
        ),
    ],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="K=V", help="Change a value of the system; repeatable."),
    ] = None,
    size_mm: Annotated[
        str | None,
        typer.Option(
            metavar="MM[xMM]",
            help="Area for the fields: side, or width x height; whole code cells are drawn. "
            "By default the system's whole mask.",
        ),
    ] = None,
    polarity: Annotated[
        Polarity | None, typer.Option(help="Instead of the system's polarity.")
    ] = None,
    start_column: Annotated[
        int | None, typer.Option(metavar="M", help="Code of the first column.")
    ] = None,
    start_row: Annotated[
        int | None, typer.Option(metavar="N", help="Code of the first row.")
    ] = None,
    draw: Annotated[
        Drawn, typer.Option(help="Fields that are drawn: the chrome, or the openings in it.")
    ] = Drawn.BLACK,
    gap_um: Annotated[
        float | None,
        typer.Option(metavar="UM", help="Draw apart, by this much, fields that touch at corners."),
    ] = None,
    overlap_um: Annotated[
        float | None, typer.Option(metavar="UM", help="Let them overlap by this much instead.")
    ] = None,
    border_mm: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Border with frame, crosses and label; 0 for none. By default a tenth of the "
            "smaller side.",
        ),
    ] = None,
    label: Annotated[
        str | None,
        typer.Option(metavar="TEXT", help="What the label begins with; the system by default."),
    ] = None,
    crosses: Annotated[bool, typer.Option(help="With alignment crosses.")] = True,
    dpi: Annotated[
        float | None, typer.Option(help="Pixels per inch of a PNG; 600 by default.")
    ] = None,
) -> None:
    """Draw a mask: for a mask maker (GDSII, OASIS, DXF), or to print (PDF, SVG, PNG).

    GDSII, OASIS and DXF files need pip install 'rasnik\\[mask]'.

    [bold]Examples[/]

    rasnik mask microras --size-mm 5 -o mask.gds

    rasnik mask solidras --size-mm 20x10 --polarity negative --gap-um 0.4 -o mask.oas

    rasnik mask solidras --set mask.field_um=1000 --size-mm 180x250 --border-mm 8 -o desk.pdf
    """
    from rasnik.mask_files import MaskFileError, Plate, sized_mask, write_mask

    instrument = load(system, settings or ())
    try:
        plate = Plate(
            sized_mask(
                instrument.mask,
                _size(size_mm),
                polarity=polarity.value if polarity else None,
                start_column=start_column,
                start_row=start_row,
            ),
            tone=draw.value,
            gap_um=_gap(gap_um, overlap_um),
            border_mm=border_mm,
            crosses=crosses,
            title=instrument.name if label is None else label,
        )
        write_mask(path, plate, dpi=dpi)
    except MaskFileError as error:
        fail(f"{error}.")
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror or error}.")
    _tell(path, plate, dpi)


def _size(text: str | None) -> float | tuple[float, float] | None:
    if text is None:
        return None
    try:
        sides = [float(part) for part in text.lower().split("x")]
    except ValueError:
        sides = []
    if len(sides) not in (1, 2):
        fail(f"--size-mm {text!r} is neither a side, such as 5, nor width x height, such as 20x10.")
    return sides[0] if len(sides) == 1 else (sides[0], sides[1])


def _gap(gap_um: float | None, overlap_um: float | None) -> float:
    if gap_um is not None and overlap_um is not None:
        fail("--gap-um and --overlap-um exclude each other.")
    for option, value in (("--gap-um", gap_um), ("--overlap-um", overlap_um)):
        if value is not None and not value >= 0:
            fail(f"{option} {value:g} must not be below zero.")
    return gap_um or -(overlap_um or 0.0)


def _tell(path: Path, plate: Plate, dpi: float | None) -> None:
    """What was drawn, with what is needed to use it."""
    mask = plate.mask
    x0, x1, y0, y1 = (v / 1000 for v in mask.bounds_um)
    lines = [
        f"{path}: {path.stat().st_size:,} bytes".replace(",", " "),
        f"{mask.column_count} x {mask.row_count} code cells of {mask.field_um:g} um fields, "
        f"{x1 - x0:.10g} x {y1 - y0:.10g} mm: "
        f"x {x0:.10g} to {x1:.10g}, y {y0:.10g} to {y1:.10g} mm",
        f"label: {plate.label}",
    ]
    if path.suffix.lower() == ".png":
        from rasnik.mask_files.raster import pixels_per_field
        from rasnik.mask_files.write import DEFAULT_DPI

        pixels, true_dpi = pixels_per_field(plate, DEFAULT_DPI if dpi is None else dpi)
        lines.append(f"{pixels} pixels to a field; print at {true_dpi:.2f} dpi for true size")
    if plate.cross_centres:
        (a, b), *_, (c, d) = ((x / 1e6, y / 1e6) for x, y in plate.cross_centres)
        lines.append(f"crosses at x {a:.10g} and {c:.10g}, y {b:.10g} and {d:.10g} mm")
    messages().print(escape("\n".join(lines)))
