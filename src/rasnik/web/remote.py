"""What stands in the place of a station in the page's process.

It has what the page uses of `rasnik.live.service.Station`, and asks the station no more often
than the page can show. The record is read here, from its files.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from rasnik.instrument import System
from rasnik.live.recent import Recent
from rasnik.live.station import ChannelConfig, StationConfig
from rasnik.live.status import ChannelStatus
from rasnik.recording.history import History
from rasnik.recording.sample import Sample
from rasnik.web.line import Line

__all__ = ["ChannelPlan", "Plan", "RemoteChannel", "RemoteRecent", "RemoteStation"]

_STATUS_S = 0.1  # between questions
_ROWS_S = _FRAME_S = 0.02
_MOST_ROWS = 4096  # in one answer
_SHORT_S = 60.0  # so much of the record is read in a moment


@dataclass(frozen=True)
class ChannelPlan:
    """What the page's process is told of a channel at its start.

    Attributes
    ----------
    config : ChannelConfig
    system : System
    folder : Path
        Of its record.
    """

    config: ChannelConfig
    system: System
    folder: Path


@dataclass(frozen=True)
class Plan:
    """What it is told of the station.

    Attributes
    ----------
    config : StationConfig
    channels : dict of str to ChannelPlan
    token : str or None
        Of the page.
    """

    config: StationConfig
    channels: dict[str, ChannelPlan]
    token: str | None


class RemoteStation:
    """A station in another process.

    Parameters
    ----------
    plan : Plan
    quick : Line
        For what is asked all the time.
    slow : Line
        For what may take long: nothing else waits for it.

    Attributes
    ----------
    config : StationConfig
    channels : dict of str to RemoteChannel
    """

    def __init__(self, plan: Plan, quick: Line, slow: Line) -> None:
        self.config = plan.config
        self._quick = quick
        self._lock = threading.Lock()
        self._statuses: dict[str, tuple[ChannelStatus, bool | None]] = {}
        self._asked_s = -_STATUS_S
        self.channels = {
            name: RemoteChannel(self, name, channel, quick, slow)
            for name, channel in plan.channels.items()
        }

    def status_of(self, name: str) -> tuple[ChannelStatus, bool | None]:
        """(status, whether the exposure is kept) of a channel, a tenth of a second old at most."""
        with self._lock:
            now_s = time.monotonic()
            if now_s - self._asked_s >= _STATUS_S:
                self._statuses = self._quick.ask("statuses")
                self._asked_s = now_s
            return self._statuses[name]

    def forget_statuses(self) -> None:
        """Something was changed: ask before the next answer."""
        with self._lock:
            self._asked_s = -_STATUS_S


class RemoteRecent(Recent):
    """The last minutes of a channel in another process: a copy that follows when it is read."""

    def __init__(self, name: str, line: Line) -> None:
        super().__init__()
        self._name, self._line = name, line
        self._following = threading.Lock()
        self._asked_s = -_ROWS_S

    @property
    def count(self) -> int:
        self._follow()
        return self._count

    def since(self, index: int, most: int | None = None) -> tuple[NDArray[Any], int]:
        self._follow()
        return super().since(index, most)

    def _follow(self) -> None:
        """Take what is new. Nobody reads before all is there: rows in between may be missing."""
        with self._following:
            if time.monotonic() - self._asked_s < _ROWS_S:
                return
            full = True
            while full:
                rows, following = self._line.ask("rows", self._name, self._count, _MOST_ROWS)
                self.extend(rows, following)
                full = len(rows) == _MOST_ROWS
            self._asked_s = time.monotonic()


class RemoteChannel:
    """A channel in another process; see `rasnik.live.channel.Channel`."""

    def __init__(
        self, station: RemoteStation, name: str, plan: ChannelPlan, quick: Line, slow: Line
    ) -> None:
        self.config, self.system = plan.config, plan.system
        self.recent = RemoteRecent(name, quick)
        self._station, self._name, self._quick, self._slow = station, name, quick, slow
        self._history = History(plan.folder, lambda: slow.ask("recorded", name))
        self._lock = threading.Lock()
        self._latest: Sample | None = None
        self._asked_s = -_FRAME_S

    def status(self) -> ChannelStatus:
        return self._station.status_of(self._name)[0]

    @property
    def keeps_exposure(self) -> bool | None:
        return self._station.status_of(self._name)[1]

    def latest(self) -> Sample | None:
        with self._lock:
            if time.monotonic() - self._asked_s >= _FRAME_S:
                known = -1 if self._latest is None else self._latest.number
                new = self._quick.ask("latest", self._name, known)
                self._latest = self._latest if new is None else new
                self._asked_s = time.monotonic()
            return self._latest

    def history(self, start_s: float, end_s: float, points: int) -> dict[str, NDArray[Any]]:
        """From the files; a short look at the newest rows is left to who writes them."""
        written_s = time.time() - 2 * self.config.recording.flush_s
        if end_s > written_s and end_s - start_s < _SHORT_S:
            found: dict[str, NDArray[Any]] = self._slow.ask(
                "history", self._name, start_s, end_s, points
            )
            return found
        return self._history.read(start_s, end_s, points)

    def set_exposure(self, us: float) -> None:
        self._do("set_exposure", us)

    def keep_exposure(self, on: bool) -> None:
        self._do("keep_exposure", on)

    def zero(self) -> None:
        self._do("zero")

    def clear_zero(self) -> None:
        self._do("clear_zero")

    def start_recording(self) -> None:
        self._do("start_recording")

    def stop_recording(self) -> None:
        self._do("stop_recording")

    def keep_frames(self) -> None:
        self._do("keep_frames")

    def snapshot(self) -> Path:
        return Path(self._do("snapshot"))

    def _do(self, action: str, *arguments: Any) -> Any:
        try:
            return self._slow.ask(action, self._name, *arguments)
        finally:
            self._station.forget_statuses()
