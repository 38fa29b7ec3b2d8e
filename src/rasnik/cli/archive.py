"""``rasnik archive``: data sets of millions of images from thousands of instruments."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rasnik.cli.archive_summary import archive_summary_command
from rasnik.cli.common import fail, load
from rasnik.io.folders import is_url

if TYPE_CHECKING:
    from rasnik.archive.systems_table import SystemsTable

__all__ = ["analyse_archive_command", "archive_app"]

_INSTRUMENT, _PROCESSES, _OUTPUT = "Instruments", "Processes", "Output"

archive_app = typer.Typer(
    help="Data sets of millions of images from thousands of instruments.",
    no_args_is_help=True,
    rich_markup_mode="rich",
)


def analyse_archive_command(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SRC",
            help="Folders, searched to any depth, files, or URLs (s3://, zip://).",
            show_default=False,
        ),
    ],
    dataset: Annotated[
        str,
        typer.Option(
            "--output",
            "-o",
            metavar="DATASET",
            help="Folder for the results; what it holds already is not done again.",
            rich_help_panel=_OUTPUT,
            show_default=False,
        ),
    ],
    systems: Annotated[
        Path | None,
        typer.Option(
            metavar="TABLE",
            help="Systems of the instruments: CSV, TOML or Parquet.",
            rich_help_panel=_INSTRUMENT,
        ),
    ] = None,
    system: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="System of all instruments, or of those that the table does not name.",
            rich_help_panel=_INSTRUMENT,
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="K=V",
            help="Change a value of --system; repeatable.",
            rich_help_panel=_INSTRUMENT,
        ),
    ] = None,
    pattern: Annotated[
        str | None,
        typer.Option(
            metavar="PATTERN",
            help="Where the instrument stands in the path below SRC, as in {instrument}/{day}/*; "
            "by default it is the first folder.",
            rich_help_panel=_INSTRUMENT,
        ),
    ] = None,
    track: Annotated[
        bool,
        typer.Option(
            "--track/--no-track",
            help="Follow the mask from image to image, or analyse each by itself.",
            rich_help_panel=_INSTRUMENT,
        ),
    ] = True,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=0,
            max=4096,
            help="Processes on this machine, by default one for each core; 0: this process alone.",
            rich_help_panel=_PROCESSES,
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Use the workers of this Dask scheduler, as tcp://host:8786.",
            rich_help_panel=_PROCESSES,
        ),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="A summary as JSON.", rich_help_panel=_OUTPUT),
    ] = False,
) -> None:
    """Analyse every image there is, once, with many processes.

    The same command goes on where it was stopped, and takes up images that were added since.

    Exit status: 0 all images have a position, 1 some have none or were left out, 2 wrong usage,
    130 interrupted.

    [bold]Examples[/]

    rasnik archive analyse images/ -o results --system atlas-ccd

    rasnik archive analyse /data -o results --systems channels.csv --pattern '{day}/{instrument}/*'

    rasnik archive analyse s3://bucket/images -o results --system solidras --scheduler tcp://a:8786
    """
    if workers is not None and scheduler is not None:
        fail("--workers starts processes here, --scheduler uses those there are; give one of them.")
    if system is None and settings:
        fail("--set changes a system, but there is none; give it with --system.")
    if is_url(dataset):
        fail(f"{dataset}: a dataset is written to a folder of this machine; mount it, or copy it.")
    table = _table(systems, system, settings)

    from rasnik.cli.archive_run import Options, run_archive

    raise typer.Exit(
        run_archive(
            sources,
            table,
            Options(Path(dataset), pattern, track, workers, scheduler, as_json),
        )
    )


def _table(systems: Path | None, system: str | None, settings: list[str] | None) -> SystemsTable:
    """Systems of the instruments, or the end of the command."""
    from rasnik._config import SystemConfigError
    from rasnik.archive.systems_table import SystemsTable

    default = load(system, settings or ()) if system is not None else None
    if systems is None:
        if default is None:
            fail("the instruments are not described: give --system, or a table with --systems.")
        return SystemsTable.for_all(default)
    try:
        return SystemsTable.read(systems, default)
    except (SystemConfigError, ImportError) as error:
        fail(f"{error}.")


archive_app.command("analyse")(analyse_archive_command)
archive_app.command("summary")(archive_summary_command)
