"""What ``rasnik live`` shows in a terminal, and what it says in a log."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

from rich.console import Console, Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from rasnik.live.status import ChannelStatus

__all__ = ["Announcer", "table"]


def table(statuses: Sequence[ChannelStatus], url: str) -> Group:
    """All channels, a line for each, and below what is wrong and where things are."""
    grid = Table(box=None, pad_edge=False, header_style="dim")
    grid.add_column("channel")
    grid.add_column("state")
    for heading in ("x um", "y um", "sigma nm", "frames/s", "lost", "dropped", "latency ms"):
        grid.add_column(heading, justify="right")
    notes: list[Text] = []
    for status in statuses:
        lost = status.lost_in_transfer + status.lost_by_time
        grid.add_row(
            status.name,
            _state(status),
            _number(status.x_um - status.zero_um[0], ".4f"),
            _number(status.y_um - status.zero_um[1], ".4f"),
            _number(1e3 * status.sigma_x_um, ".2f"),
            _number(status.frame_rate_hz, ".1f"),
            str(lost),
            str(status.dropped),
            _number(status.latency_median_ms, ".1f"),
        )
        notes += [Text(f"{status.name}: {text}", style="yellow") for text in _wrong(status)]
        if status.recording:
            file = os.path.relpath(status.recording_file) if status.recording_file else "a new file"
            notes.append(Text(f"{status.name}: {status.recorded} rows recorded, now in {file}"))
        else:
            notes.append(Text(f"{status.name} is not recorded", style="dim"))
    if url:
        notes.append(Text(f"page: {url}"))
    notes.append(Text("Ctrl-C ends", style="dim"))
    return Group(grid, *notes)


class Announcer:
    """Says in a line what changes, for terminals and logs alike.

    Parameters
    ----------
    console : Console
    url : str
        Of the page; empty if there is none.
    """

    def __init__(self, console: Console, url: str) -> None:
        self._console = console
        self._said: dict[str, tuple[str, ...]] = {}
        if url:
            console.print(f"page: {url}", markup=False)

    def tell(self, statuses: Sequence[ChannelStatus]) -> None:
        """Say what is new since the last time."""
        for status in statuses:
            wrong = [f"{status.name}: {text}" for text in _wrong(status)]
            now = (f"{status.name} ({status.camera}): {status.state}", *wrong)
            before = self._said.get(status.name, ())
            if now != before:
                self._said[status.name] = now
                for text in now:
                    if _key(text) not in map(_key, before):
                        self._console.print(escape(text))


def _wrong(status: ChannelStatus) -> list[str]:
    texts = [status.message, status.recording_message]
    texts += [f"alarm: {alarm}" for alarm in status.alarms]
    return [text for text in texts if text]


def _key(text: str) -> str:
    """A sentence whose numbers change is said once."""
    return "".join(letter for letter in text if letter not in "0123456789.")


def _state(status: ChannelStatus) -> str:
    if status.state != "running":
        return f"[red]{status.state}[/]" if status.state in ("lost", "failed") else status.state
    return "[green]locked[/]" if status.locked else "[red]no position[/]"


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"
