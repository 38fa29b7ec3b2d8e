"""``rasnik export``: a track in another format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from rasnik.cli.common import fail, messages

__all__ = ["export_command"]


def export_command(
    track: Annotated[Path, typer.Argument(help="A track, as rasnik track writes it.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="File to write: .csv, .parquet or .h5."
        ),
    ],
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a file that is there already.")
    ] = False,
) -> None:
    """Convert a track to CSV or Parquet.

    A track that is still being measured can be exported as well, as far as it has come.

    [bold]Examples[/]

    rasnik export track.h5 -o track.csv

    rasnik export track.h5 -o track.parquet --overwrite
    """
    from rasnik.io import read_track, write_track

    if output.exists() and track.exists() and output.samefile(track):
        fail(f"{output} is the track itself; name another file.")
    if output.exists() and not overwrite:
        fail(f"{output} exists already; give another name, or --overwrite to replace it.")
    try:
        rows = read_track(track)
        write_track(rows, output, overwrite=overwrite)
    except (ValueError, ImportError) as error:
        fail(f"{str(error).rstrip('.')}.")
    except OSError as error:
        fail(f"{str(error).rstrip('.')}.")
    messages().print(escape(f"{len(rows)} frames written to {output}"))
