"""What ``rasnik archive analyse`` does: opens what it needs, runs, and says what came out."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape
from rich.table import Table

from rasnik.cli.archive_progress import archive_progress
from rasnik.cli.common import fail, messages, output
from rasnik.cli.track_terminal import Interrupts

if TYPE_CHECKING:
    from rasnik.archive.dataset import Dataset, Totals
    from rasnik.archive.run import ArchiveRun
    from rasnik.archive.systems_table import SystemsTable

__all__ = ["Options", "run_archive"]

INTERRUPTED = 130  # 128 + SIGINT, as shells count

_LISTED = 30  # instruments in the table
_NAMED = 5  # of everything else


@dataclass(frozen=True)
class Options:
    """Where results go, and who does the work."""

    dataset: Path
    pattern: str | None
    track: bool
    workers: int | None
    scheduler: str | None
    json: bool


def run_archive(sources: list[str], table: SystemsTable, options: Options) -> int:
    """Analyse an archive; returns the status the command exits with."""
    try:
        from rasnik.archive.cluster import PoolError
        from rasnik.archive.dataset import Dataset
        from rasnik.archive.run import ArchiveRun, absolute_sources
        from rasnik.archive.work import WorkerError

        for fault in table.faults[:_NAMED]:
            messages().print(f"[yellow]{escape(fault)}[/]")
        with Dataset(options.dataset) as dataset:
            run = ArchiveRun(
                absolute_sources(sources), table, dataset, options.pattern, options.track
            )
            interrupted = _run(run, options)
            return _finish(run, dataset, options, interrupted)
    except (ValueError, OSError, ImportError, PoolError, WorkerError) as error:
        fail(f"{str(error).rstrip('.')}.")


def _run(run: ArchiveRun, options: Options) -> bool:
    """Do the work, or what there is time for until Ctrl-C; returns whether it was that."""
    from rasnik.archive.cluster import Here, dask_pool

    with ExitStack() as opened:
        stop = opened.enter_context(Interrupts())
        try:
            system = run.first_system()
            if system is None:
                return False
            if options.workers == 0:
                pool: Any = Here()
            else:
                messages().print("starting the workers")
                pool = opened.enter_context(dask_pool(options.workers, options.scheduler, system))
            progress = opened.enter_context(archive_progress(run))
            run.run(pool, progress, stop.held)
        except KeyboardInterrupt:
            return True
    return False


# ------------------------------------------------------------------------ the end


def _finish(run: ArchiveRun, dataset: Dataset, options: Options, interrupted: bool) -> int:
    """Say what came out; returns the exit status."""
    if not dataset.totals and not interrupted and not run.planner.refused:
        why = "; ".join(run.left_out.faults[:_NAMED]) or "there are none in these sources"
        fail(f"there are no images: {why.rstrip('.')}.")
    if options.json:
        typer.echo(json.dumps(_document(run, dataset, options, interrupted)))
    else:
        _print_table(dataset.totals)
    _print_remarks(run, dataset)
    new = _sum(run.totals)
    text = f"{new.images} images analysed: {new.good} with a position"
    if new.failed:
        text += f", {new.failed} without"
    if run.elapsed_s and new.images:
        text += f"; {new.images / run.elapsed_s:.4g} images/s"
    (messages() if options.json else output()).print(escape(f"{text}; {options.dataset}"))
    if interrupted:
        messages().print("interrupted; the same command goes on")
        return INTERRUPTED
    left_out = bool(run.planner.refused or run.left_out.faults)
    return 1 if left_out or _sum(dataset.totals).failed else 0


def _sum(totals: dict[str, Totals]) -> Totals:
    from rasnik.archive.dataset import Totals

    return sum(totals.values(), Totals())


def _rate(totals: Totals) -> float | None:
    """Images per second of one process."""
    return totals.images / totals.seconds if totals.seconds else None


def _print_table(totals: dict[str, Totals]) -> None:
    """Instruments, those with most failures first; of all runs."""
    if not totals:
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("instrument", overflow="fold")
    for heading in ("images", "with a position", "without", "images/s of a process"):
        table.add_column(heading, justify="right", no_wrap=True)
    names = sorted(totals, key=lambda name: -totals[name].failed)
    for name in names[:_LISTED]:
        table.add_row(escape(name), *_cells(totals[name]))
    others = names[_LISTED:]
    if others:
        rest = _sum({name: totals[name] for name in others})
        table.add_row(f"{len(others)} others", *_cells(rest))
    if len(names) > 1:
        table.add_row("all", *_cells(_sum(totals)), style="bold")
    output().print(table)


def _cells(totals: Totals) -> list[str]:
    rate = _rate(totals)
    counts = (totals.images, totals.good, totals.failed)
    return [*map(str, counts), "" if rate is None else f"{rate:.4g}"]


def _print_remarks(run: ArchiveRun, dataset: Dataset) -> None:
    """What was left out, and what else is to be known."""
    planner = run.planner
    if dataset.removed:
        _remark(f"{dataset.removed} parts of chunks that were not finished were removed")
    if dataset.set_aside:
        _remark(
            f"{dataset.set_aside} parts that the journal does not name are kept as _part-*.aside "
            "beside the others: the journal was cut off or damaged, and their images are analysed "
            "again where they are still there",
            "red",
        )
    if planner.unchanged:
        _remark(f"{planner.unchanged} files had been analysed before")
    if planner.n_changed:
        _remark(
            f"{planner.n_changed} files have changed since they were analysed "
            f"({_some(planner.changed, planner.n_changed)}): only frames that were added to them "
            "count; to have the others done again, errors too, remove the folder of their day or "
            "instrument in the dataset"
        )
    for name, (sentence, files) in list(planner.refused.items())[:_NAMED]:
        _remark(f"{name}, {files} files left out: {sentence}", "red")
    if len(planner.refused) > _NAMED:
        files = sum(count for _, count in planner.refused.values())
        _remark(f"in all {len(planner.refused)} instruments with {files} files left out", "red")
    for name in run.lost:
        _remark(f"{name} ended the processes that were to analyse it", "red")
    for fault in run.left_out.faults[:_NAMED]:
        _remark(fault, "red")
    if len(run.left_out.faults) > _NAMED:
        _remark(f"and {len(run.left_out.faults) - _NAMED} more like these", "red")
    for reason, count in run.left_out.counts.items():
        names = run.left_out.names.get(reason, [])
        _remark(f"{count} files left out, {reason}: {_some(names, count)}")


def _remark(text: str, style: str = "") -> None:
    messages().print(escape(text), style=style)


def _some(names: list[str], count: int) -> str:
    more = count - len(names[:_NAMED])
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more else "")


def _document(
    run: ArchiveRun, dataset: Dataset, options: Options, interrupted: bool
) -> dict[str, Any]:
    """The summary for other programs."""
    new, planner = _sum(run.totals), run.planner
    return {
        "dataset": str(options.dataset),
        "images": new.images,
        "good": new.good,
        "failed": new.failed,
        "seconds": round(run.elapsed_s, 3),
        "images_per_s": new.images / run.elapsed_s if run.elapsed_s else None,
        "interrupted": interrupted,
        "files_done_before": planner.unchanged,
        "files_changed": planner.n_changed,
        "parts_removed": dataset.removed,
        "parts_set_aside": dataset.set_aside,
        "refused": {
            name: {"error": sentence, "files": files}
            for name, (sentence, files) in planner.refused.items()
        },
        "lost": run.lost,
        "faults": run.left_out.faults,
        "left_out": run.left_out.counts,
        "instruments": {
            name: {
                "images": totals.images,
                "good": totals.good,
                "failed": totals.failed,
                "images_per_s_of_a_process": _rate(totals),
            }
            for name, totals in dataset.totals.items()
        },
    }
