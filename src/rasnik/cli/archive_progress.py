"""The bar of ``rasnik archive analyse``."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rasnik.cli.common import messages

if TYPE_CHECKING:
    from rasnik.archive.run import ArchiveRun, Progress

__all__ = ["archive_progress"]

_RECENT_S = 120.0  # over which the rate is averaged, and so many chunks of each worker at least
_RECENT_CHUNKS = 4


class _Total:
    """Adds up how much there is to do, while the work goes on."""

    def __init__(self, run: ArchiveRun) -> None:
        self.size: float | None = None
        """Bytes; None as long as the search goes on."""
        self._run, self._stopped = run, False
        self._thread = threading.Thread(target=self._search, name="total", daemon=True)
        self._thread.start()

    def _search(self) -> None:
        from rasnik.archive.sources import find_items

        size = 0
        for item in find_items(self._run.sources, self._run.pattern):
            if self._stopped:
                return
            if self._run.dataset.done.left(item)[0]:
                size += item.size
        self.size = float(size)

    def stop(self) -> None:
        self._stopped = True
        self._thread.join(2.0)


@contextmanager
def archive_progress(run: ArchiveRun) -> Iterator[Callable[[Progress], None]]:
    """Something to call with the progress of a run; a bar if somebody is looking."""
    console = messages()
    if not console.is_terminal:
        yield lambda progress: None
        return
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        BarColumn(),
        TextColumn("{task.fields[images]} images"),
        TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[remarks]}"),
        TimeRemainingColumn(compact=True),
        "left",
    )
    total, recent = _Total(run), deque([(time.monotonic(), 0)])
    try:
        with Bar(*columns, console=console, transient=True, speed_estimate_period=300.0) as bar:
            task = bar.add_task("", total=None, images=0, rate="", remarks="")

            def show(progress: Progress) -> None:
                bar.update(
                    task,
                    completed=progress.size,
                    total=total.size and max(total.size, progress.size),
                    images=progress.images,
                    rate=_rate(progress, recent),
                    remarks=_remarks(progress),
                )

            yield show
    finally:
        total.stop()


def _rate(progress: Progress, recent: deque[tuple[float, int]]) -> str:
    """Images per second of late, in all and for each process."""
    now_s, workers = time.monotonic(), max(progress.workers, 1)
    if progress.images != recent[-1][1]:
        recent.append((now_s, progress.images))
    while len(recent) > _RECENT_CHUNKS * workers and recent[0][0] < now_s - _RECENT_S:
        recent.popleft()
    (first_s, first), (last_s, last) = recent[0], recent[-1]
    if last == first:
        return ""
    rate = (last - first) / max(last_s - first_s, 1e-9)
    return f"{rate:.4g} images/s, {rate / workers:.4g} for each of {workers} workers"


def _remarks(progress: Progress) -> str:
    if not progress.workers:
        return "waiting for a worker"
    return f"{progress.failed} without a position" if progress.failed else ""
