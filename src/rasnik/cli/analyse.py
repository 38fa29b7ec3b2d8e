"""``rasnik analyse``: poses from images."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from rasnik.cli.common import fail, load, numbers

__all__ = ["Method", "Model", "analyse_command", "check_instrument", "parse_bounds"]

_INSTRUMENT, _ANALYSIS, _OUTPUT = "Instrument", "Analysis", "Output"
_ORIENTATIONS = {"auto": None, "1": 1, "2": 2, "3": 3, "4": 4}
_SIZES_UM = {"--field-um": (0.01, 1e6), "--pixel-um": (0.1, 1e3)}


class Method(StrEnum):
    """How the position is found."""

    LIKELIHOOD = "likelihood"
    FOURIER = "fourier"


class Model(StrEnum):
    """What map from mask to image is fitted."""

    AUTO = "auto"
    SIMILARITY = "similarity"
    AFFINE = "affine"
    PROJECTIVE = "projective"


def analyse_command(
    images: Annotated[
        list[str],
        typer.Argument(
            help="Image files, folders, patterns; stacks as multi-page TIFF, NPY or HDF5 "
            "(file.h5:/dataset where there are several)."
        ),
    ],
    system: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="System by name (see rasnik systems) or TOML file.",
            rich_help_panel=_INSTRUMENT,
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="K=V",
            help="Change a value of the system, as in sensor.pixel_um=7.4; repeatable.",
            rich_help_panel=_INSTRUMENT,
        ),
    ] = None,
    field_um: Annotated[
        float | None,
        typer.Option(
            metavar="F",
            help="Side of a chess field on the mask in um. With --pixel-um no system is needed.",
            rich_help_panel=_INSTRUMENT,
        ),
    ] = None,
    pixel_um: Annotated[
        float | None,
        typer.Option(
            metavar="P", help="Pitch of the sensor's pixels in um.", rich_help_panel=_INSTRUMENT
        ),
    ] = None,
    orientation: Annotated[
        str,
        typer.Option(
            metavar="auto|1..4",
            help="1 nominal, 2 mirrored left-right, 3 up-down, 4 turned by 180 degrees.",
            rich_help_panel=_ANALYSIS,
        ),
    ] = "auto",
    method: Annotated[
        Method,
        typer.Option(
            help="likelihood: to the bound that noise sets; fourier: the paper's spectrum.",
            rich_help_panel=_ANALYSIS,
        ),
    ] = Method.LIKELIHOOD,
    model: Annotated[
        Model,
        typer.Option(help="Map from mask to image that is fitted.", rich_help_panel=_ANALYSIS),
    ] = Model.AUTO,
    bounds: Annotated[
        str | None,
        typer.Option(
            metavar="L,T,R,B",
            help="Use these columns and rows only: left, top, right, bottom in pixels from 0, "
            "the last ones included.",
            rich_help_panel=_ANALYSIS,
        ),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="JSON lines instead of a table.", rich_help_panel=_OUTPUT),
    ] = False,
    as_csv: Annotated[
        bool, typer.Option("--csv", help="CSV instead of a table.", rich_help_panel=_OUTPUT)
    ] = False,
    as_lwdaq: Annotated[
        bool,
        typer.Option(
            "--lwdaq", help="LWDAQ's result lines instead of a table.", rich_help_panel=_OUTPUT
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Write results to a file: .jsonl, .csv, .h5 or .parquet; .txt for lines of "
            "LWDAQ, .icaras for those of ICARAS.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    overlay: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Draw the fitted lattice, codes and residuals of every image.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
) -> None:
    """Find where the mask stands in images.

    Exit status: 0 all good, 1 some images gave no position, 2 wrong usage.

    [bold]Examples[/]

    rasnik analyse images/ --system solidras

    rasnik analyse ccd_*.gif --field-um 120 --pixel-um 10 --overlay overlays

    rasnik analyse stack.tif --system mine.toml --set sensor.pixel_um=7.4 -o results.h5

    rasnik analyse image.png --system solidras --json | jq .x_um
    """
    if sum((as_json, as_csv, as_lwdaq, output is not None)) > 1:
        fail("--json, --csv, --lwdaq and -o exclude each other; give one of them.")
    if orientation not in _ORIENTATIONS:
        fail(f"--orientation {orientation!r} is not known; give auto, 1, 2, 3 or 4.")
    check_instrument(system, settings, field_um, pixel_um)
    if method is Method.FOURIER and model not in (Model.AUTO, Model.SIMILARITY):
        fail(f"--method fourier knows only the similarity; leave out --model {model.value}.")
    edges = parse_bounds(bounds) if bounds is not None else None
    instrument = load(system, settings or ()) if system is not None else None

    from rasnik.cli.batch import Destination, run_batch
    from rasnik.io.analysed import AnalysisOptions

    all_good = run_batch(
        images,
        AnalysisOptions(
            system=instrument,
            field_um=field_um,
            pixel_um=pixel_um,
            method=cast(Any, method.value),
            model=cast(Any, model.value),
            orientation=_ORIENTATIONS[orientation],
            bounds=edges,
        ),
        Destination(json=as_json, csv=as_csv, lwdaq=as_lwdaq, file=output, overlays=overlay),
    )
    raise typer.Exit(0 if all_good else 1)


def check_instrument(
    system: str | None, settings: list[str] | None, field_um: float | None, pixel_um: float | None
) -> None:
    """The instrument is described once, and in full."""
    sizes = {"--field-um": field_um, "--pixel-um": pixel_um}
    given = [name for name, value in sizes.items() if value is not None]
    if system is not None and given:
        key = {"--field-um": "mask.field_um", "--pixel-um": "sensor.pixel_um"}[given[0]]
        fail(f"--system and {given[0]} contradict each other; use --system with --set {key}=...")
    if system is None and settings:
        fail("--set changes a system, but there is none; give it with --system.")
    if system is None and len(given) < 2:
        missing = [name for name in sizes if name not in given]
        fail(
            "the instrument is not described: give --system, or --field-um and --pixel-um."
            if not given
            else f"{missing[0]} is missing; it goes with {given[0]}."
        )
    for name, value in sizes.items():
        least, most = _SIZES_UM[name]
        if value is not None and not least <= value <= most:
            fail(f"{name} must be between {least:g} and {most:g} um, not {value:g}.")


def parse_bounds(text: str) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) from the text of ``--bounds``, or the end of the command."""
    values = numbers(text, "--bounds", "left,top,right,bottom", 4)
    if any(value != int(value) if abs(value) < 1e9 else True for value in values):
        fail(f"--bounds {text!r} must be whole numbers of pixels.")
    left, top, right, bottom = (int(value) for value in values)
    if left < 0 or top < 0 or right <= left or bottom <= top:
        fail(
            f"--bounds {text!r} must be left,top,right,bottom with 0 <= left < right and "
            "0 <= top < bottom."
        )
    return left, top, right, bottom
