"""``rasnik paper``: the figures and numbers of the paper, done again."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from rasnik.cli.common import fail, messages, output

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rasnik.paper.run import Result

__all__ = ["paper_command"]


def paper_command(
    folder: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR",
            help="Folder for everything that is made.",
            show_default=False,
        ),
    ],
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer images: two minutes instead of fifteen.")
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="NAME", help="Only this figure; may be repeated."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all noise and motion.")] = 1,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes; by default one for each core.", show_default=False),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The results as JSON.")] = False,
) -> None:
    """Redo what software can redo of the paper: pictures, a table and one HTML report.

    Writes report.html (with all pictures in it), table.md, results.json, and a PNG and a JSON
    file for each figure. A figure that fails does not stop the others; the command then ends
    with status 1.

    [bold]Examples[/]

    rasnik paper -o paper --quick

    rasnik paper -o paper --only linearity --only scatter
    """  # fmt: skip
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fail(f"the folder {folder} cannot be made: {error.strerror}.")

    from rasnik.paper.outcome import Effort
    from rasnik.paper.page import made_by, write_all

    effort = Effort(quick, seed)
    start = time.perf_counter()
    try:
        results = _redo(folder, effort, only or [], workers)
    except ValueError as error:
        fail(f"{error}.")
    seconds = time.perf_counter() - start
    made = made_by(effort, seconds, only or ())
    document = write_all(folder, results, made)
    if as_json:
        typer.echo(json.dumps(document, indent=1))
    else:
        _print_table(results)
        output().print(f"\n{escape(made)}\nwritten: {escape(str(folder / 'report.html'))}")
    failed = [result for result in results if result.error]
    for result in failed:
        messages().print(f"[bold red]failed:[/] {result.name}: {escape(result.error)}")
    if failed:
        raise typer.Exit(1)


def _redo(folder: Path, effort: object, only: list[str], workers: int | None) -> list[Result]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from rasnik.paper.outcome import Effort
    from rasnik.paper.run import parts_named, redo_all

    assert isinstance(effort, Effort)
    total = sum(part.weight for part in parts_named(only))
    weights = {part.name: part.weight for part in parts_named(only)}
    columns = (
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=messages()) as progress:
        task = progress.add_task("redoing the paper's figures", total=total)

        def finished(result: Result) -> None:
            word = "[red]failed[/]" if result.error else "done"
            progress.print(f"{word:>6} {result.name} ({result.seconds:.0f} s)")
            progress.advance(task, weights[result.name])

        return redo_all(folder, effort, only, workers, finished)


def _print_table(results: Sequence[Result]) -> None:
    from rich.table import Table

    from rasnik.paper.table import HEADINGS, cells, notes_of

    rows = [row for result in results for row in result.rows]
    if not rows:
        return
    notes, numbers = notes_of(rows)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in HEADINGS:
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    table.add_column("note", justify="right")
    for row, number in zip(rows, numbers, strict=True):
        table.add_row(*map(escape, cells(row)), str(number or ""))
    output().print(table)
    for number, note in enumerate(notes, 1):
        output().print(f"{number}. {escape(note)}", soft_wrap=True)
