"""``rasnik archive summary``: what an archive of results says about its instruments."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, messages, output

if TYPE_CHECKING:
    from rasnik.archive.summary import Summary
    from rasnik.archive.worst import Worst
    from rasnik.report.archive import Picture

__all__ = ["archive_summary_command"]

_MOST_LINES = 60


def archive_summary_command(
    dataset: Annotated[
        Path,
        typer.Argument(help="Folder that rasnik archive analyse wrote.", show_default=False),
    ],
    folder: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Write summary.html, with pictures of the worst images, overview.png and "
            "instruments.csv.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON.")] = False,
) -> None:
    """Resolution, drift, failures and the worst images of all instruments of an archive.

    Exit status: 0 the whole dataset was read, 1 parts of it are damaged, 2 wrong usage.

    [bold]Examples[/]

    rasnik archive summary results

    rasnik archive summary results -o report

    rasnik archive summary results --json | jq '.instruments[] | {instrument, good}'
    """
    from rasnik.archive.summary import summarise

    if folder is not None and folder.exists() and not folder.is_dir():
        fail(f"{folder} is a file; name a folder for the report.")
    try:
        with _progress() as advance:
            found = summarise(dataset, advance)
    except (ValueError, ImportError, OSError) as error:
        fail(f"{str(error).rstrip('.')}.")
    document = found.as_dict()
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        _print(found)
    if folder is not None:
        _write(folder, found, document, quiet=as_json)
    raise typer.Exit(1 if found.faults else 0)


def _progress() -> Any:
    """Rows and instruments done, on a terminal."""
    from contextlib import contextmanager

    from rich.markup import escape
    from rich.progress import Progress, TextColumn, TimeElapsedColumn

    @contextmanager
    def running() -> Any:
        console = messages()
        columns = TextColumn("{task.description}"), TimeElapsedColumn()
        with Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        ) as bar:
            task, rows = bar.add_task("reading"), 0

            def advance(instrument: str, count: int) -> None:
                nonlocal rows
                rows += count
                bar.update(task, description=escape(f"{rows:,} rows, up to {instrument}"))

            yield advance

    return running()


# ------------------------------------------------------------------------ screen


def _print(found: Summary) -> None:
    from rich.markup import escape
    from rich.table import Table

    from rasnik.report.numbers import with_sigma

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("instrument", no_wrap=True)
    for head in ("images", "failed", "x, nm", "/ stated", "y, nm", "/ stated",
                 "drift x, µm/day", "drift y, µm/day"):  # fmt: skip
        table.add_column(head, justify="right", no_wrap=True)
    for one in found.instruments[:_MOST_LINES]:
        cells = []
        for name in ("x", "y"):
            scatter = one.scatter.get(name)
            if scatter is None:
                cells += ["-", "-"]
                continue
            cells.append(with_sigma(scatter.sigma, scatter.sigma_error))
            ratio = scatter.sigma / scatter.stated if scatter.stated > 0 else None
            cells.append("-" if ratio is None else f"{ratio:.2f}")
        drifts = [with_sigma(d.slope, d.sigma) if d.sigma >= 0 else "-" for d in one.drift.values()]
        failed = one.images - one.good
        table.add_row(escape(one.instrument), f"{one.images:,}", f"{failed:,}", *cells, *drifts)
    console = output()
    console.print(table)
    more = len(found.instruments) - _MOST_LINES
    if more > 0:
        console.print(f"and {more:,} more instruments; -o FOLDER writes all of them")
    console.print(
        "(nm: standard deviation of a single image, from the differences between successive "
        "images; / stated: over the error that comes with the positions)"
    )
    reasons = ", ".join(f"{count:,} {name}" for name, count in found.failed.items())
    console.print(
        f"{len(found.instruments):,} instruments, {found.images:,} images, {found.good:,} with a "
        f"position" + (f"; without: {reasons}" if reasons else "")
    )
    for worst in found.worst:
        console.print(f"{worst.instrument}: {worst.kind}: {worst.name}: {worst.sentence}",
                      style="yellow", markup=False, soft_wrap=True)  # fmt: skip
    for fault in found.faults:
        console.print(f"{fault}.", style="red", markup=False, soft_wrap=True)


# ------------------------------------------------------------------------ files


def _write(folder: Path, found: Summary, document: dict[str, Any], *, quiet: bool) -> None:
    from rasnik.report.archive import draw_overview, write_archive_page, write_archive_table

    try:
        folder.mkdir(parents=True, exist_ok=True)
        pictures = [_picture(worst) for worst in found.worst]
        overview = draw_overview(document)
        (folder / "overview.png").write_bytes(overview)
        write_archive_page(folder / "summary.html", document, overview, pictures)
        write_archive_table(folder / "instruments.csv", document)
    except OSError as error:
        fail(f"{folder} cannot be written: {error.strerror or error}.")
    if not quiet:
        for name in ("summary.html", "overview.png", "instruments.csv"):
            output().print(f"written: {folder / name}", markup=False)


def _picture(worst: Worst) -> Picture:
    """The image again with what is found in it, if it can still be read."""
    from rasnik.report.archive import Picture

    try:
        png, remark = _drawn(worst)
    except Exception as error:  # a picture less must not cost the report
        png, remark = None, f"It cannot be drawn ({type(error).__name__}: {error})."
    return Picture(worst.as_dict(), png, remark)


def _drawn(worst: Worst) -> tuple[bytes | None, str]:
    import io
    import tomllib

    from rasnik.instrument import System
    from rasnik.io.analysed import AnalysisOptions, analysed
    from rasnik.io.images import iter_frames
    from rasnik.report.overlay import overlay_figure
    from rasnik.report.residuals import residual_image

    if not worst.file or not worst.system_toml:
        return None, "The dataset does not say which file or system it was."
    frame = next(iter(iter_frames([worst.file], start=worst.frame)), None)
    if frame is None or frame.image is None:
        return None, "The image cannot be read now." if frame is None else str(frame.error)
    system = System.model_validate(tomllib.loads(worst.system_toml))
    pose, error = analysed(frame, AnalysisOptions(system))
    if pose is None:
        return None, str(error)
    residuals = None
    if pose.ok and pose.projection is not None:
        residuals = residual_image(frame.image, pose, system, frame.bounds_px)
    sink = io.BytesIO()
    overlay_figure(frame.image, pose, system, residuals).savefig(sink, format="png", dpi=80)
    remark = ""
    if pose.ok == worst.is_failure:
        has = "a position" if pose.ok else "no position"
        remark = f"Analysed again by itself, with its system and nothing else, it has {has}."
    return sink.getvalue(), remark
