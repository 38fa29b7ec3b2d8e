"""What ``rasnik live`` does: a station with its page and control systems, until its end."""

from __future__ import annotations

import queue
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from rasnik._config import SystemConfigError
from rasnik.cameras.camera import CameraError
from rasnik.cli.common import fail, messages
from rasnik.cli.live_table import Announcer, table

if TYPE_CHECKING:
    from rasnik.live.service import Station
    from rasnik.live.station import StationConfig

__all__ = ["run_live"]

_REFRESH_S = 0.25
_OVER = ("ended", "failed")


def run_live(config: StationConfig, seconds: float | None, page: bool) -> int:
    """Run a station until a signal, the time, or the end of all its channels; the exit status."""
    from rasnik.live.linear_algebra import in_one_thread
    from rasnik.live.priority import before_others

    in_one_thread()
    with _asked_to_end() as asked, before_others(len(config.channel)):
        from rasnik.live.service import Station

        try:
            station = Station(config)
        except (SystemConfigError, CameraError) as error:
            fail(str(error))
        services: list[Any] = []
        try:
            services = _services(station, page)
            station.start()
            url = _start(services)
            _show(station, url, asked, None if seconds is None else time.monotonic() + seconds)
            failed = any(c.status().state == "failed" for c in station.channels.values())
        finally:
            for service in reversed(services):
                with suppress(Exception):  # the record comes first
                    service.stop()
            station.stop()
    _say_end(station)
    return 1 if failed else 0


class _Asked:
    """Whether somebody asked to end.

    Set by a signal handler, which `threading.Event` may not be: the handler would wait for a
    lock that is held by what it interrupts.
    """

    def __init__(self) -> None:
        self._asked: queue.SimpleQueue[None] = queue.SimpleQueue()

    def set(self) -> None:
        self._asked.put(None)

    def wait(self, timeout_s: float) -> bool:
        """Whether it was set before the time was over, or before this call."""
        try:
            self._asked.get(timeout=timeout_s)
        except queue.Empty:
            return False
        self.set()
        return True


@contextmanager
def _asked_to_end() -> Iterator[_Asked]:
    """Set by SIGINT and SIGTERM; a second one changes nothing, as the record is being closed."""
    asked = _Asked()
    before = {
        number: signal.signal(number, lambda *_: asked.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# ------------------------------------------------------------------------ page and controls


def _services(station: Station, page: bool) -> list[Any]:
    """Page and control systems, not started yet. What is open to strangers ends the command."""
    services: list[Any] = []
    controls = station.config.controls
    if page:
        from rasnik.web.process import page_of
        from rasnik.web.serving import PageError

        try:
            services.append(page_of(station, station.config.server))
        except PageError as error:
            fail(str(error))
    try:
        if controls.epics.enabled:
            from rasnik.controls.epics import EpicsServer

            services.append(EpicsServer(station, controls.epics))
        if controls.mqtt.enabled:
            from rasnik.controls.mqtt import MqttPublisher

            services.append(MqttPublisher(station, controls.mqtt))
    except (ImportError, ValueError) as error:
        fail(f"{str(error).rstrip('.')}.")
    return services


def _start(services: list[Any]) -> str:
    """Start them; measuring goes on without one that cannot be. Address of the page, if any."""
    url = ""
    for service in services:
        try:
            service.start()
        except Exception as error:
            messages().print(f"[yellow]{escape(str(error))}[/] Measuring goes on without it.")
        else:
            url = url or getattr(service, "url", "")
    return url


# ------------------------------------------------------------------------ while it runs


def _show(station: Station, url: str, asked: _Asked, end_s: float | None) -> None:
    """Show what happens, until somebody asks to end, the time is over, or no frames come."""
    console = messages()
    announcer = Announcer(console, url)

    def over() -> bool:
        statuses = [channel.status() for channel in station.channels.values()]
        announcer.tell(statuses)
        ended = all(status.state in _OVER for status in statuses)
        return ended or (end_s is not None and time.monotonic() >= end_s)

    if not console.is_terminal:
        while not over() and not asked.wait(_REFRESH_S):
            pass
        return
    from rich.live import Live

    with Live(console=console, auto_refresh=False, transient=True) as live:
        while not over() and not asked.wait(_REFRESH_S):
            statuses = [channel.status() for channel in station.channels.values()]
            live.update(table(statuses, url), refresh=True)


def _say_end(station: Station) -> None:
    for name, channel in station.channels.items():
        status = channel.status()
        lost = status.lost_in_transfer + status.lost_by_time
        text = (
            f"{name}: {status.frames} frames, {status.tracked} with a position, {lost} lost, "
            f"{status.dropped} dropped, {status.recorded} recorded"
        )
        if status.recording_file:
            text += f" in {station.config.folder / name}"
        messages().print(escape(text))
