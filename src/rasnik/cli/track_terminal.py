"""``rasnik track`` and who sits before it: the bar that shows how far it is, and Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rasnik.cli.common import messages
from rasnik.io.images import Source, count_frames

__all__ = ["Interrupts", "progress"]

_COUNTED_SOURCES = 200  # with more, opening each only to count its frames takes too long


class Interrupts:
    """Ctrl-C between, not within, the writing of rows; once, until the file is closed."""

    def __init__(self) -> None:
        self._asked = self._held = False
        self._before: Any = None

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _on_signal(self, *_: object) -> None:
        if self._asked:
            return
        self._asked = True
        if not self._held:
            raise KeyboardInterrupt

    @contextmanager
    def held(self) -> Iterator[None]:
        self._held = True
        try:
            yield
        finally:
            self._held = False
        if self._asked:
            raise KeyboardInterrupt


@contextmanager
def progress(sources: list[Source], first: int) -> Iterator[Callable[[int], None]]:
    """Something to call with a number of frames; a bar if somebody is looking."""
    console = messages()
    if not console.is_terminal:
        yield lambda frames: None
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    few = len(sources) <= _COUNTED_SOURCES
    total = sum(count_frames(source) for source in sources) if few else len(sources)
    columns = (
        "tracking",
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(compact=True),
        "left",
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=max(total, first), completed=first, rate="")

        def advance(frames: int) -> None:
            bar.advance(task, frames)
            state = bar.tasks[0]
            bar.update(
                task,
                rate=f"{state.speed:.4g} frames/s" if state.speed else "",
                total=max(state.total or 0, state.completed),
            )

        yield advance
