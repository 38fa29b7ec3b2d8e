"""The websocket: rows as they come, pictures and spectra at the pace that a client can take.

A client has one loop here. It makes a message when one is due and the last one has left, so a
slow client gets fewer pictures, and nothing piles up: no message is made before it can be sent.
A client also confirms the pictures that it has drawn; two at most are on their way.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect

from rasnik.web.packets import pack
from rasnik.web.picture import Pictures
from rasnik.web.quantities import QUANTITIES, channel_dict, finite
from rasnik.web.rows import last_rows, torn
from rasnik.web.spectra import Spectra

if TYPE_CHECKING:
    from rasnik.live.channel import Channel
    from rasnik.live.service import Station

__all__ = ["Feeds"]

_log = logging.getLogger(__name__)

MOST_CLIENTS = 32
_MOST_ROWS = 60_000  # in one message
_MOST_UNSEEN = 2  # pictures
_STATUS_HZ = 4.0
_SPECTRUM_HZ = 1.0
_TICK_S = 0.004  # between looks at what is due

# What a client may ask for: (default, least, most).
_NUMBERS = {
    "image_hz": (20.0, 0.0, 30.0),
    "rows_hz": (25.0, 0.0, 50.0),
    "rows_s": (30.0, 0.0, 600.0),
    "spectrum_s": (20.0, 0.0, 120.0),
    "width": (720.0, 64.0, 2048.0),
}


class _WrongMessageError(Exception):
    """What a client sent is not a wish; it is not listened to any more."""


@dataclass
class _Wishes:
    """What a client looks at."""

    channel: str | None = None
    image_hz: float = 20.0
    rows_hz: float = 25.0
    rows_s: float = 30.0
    spectrum_s: float = 20.0
    width: float = 720.0


class Feeds:
    """All clients of a station."""

    def __init__(self, station: Station) -> None:
        self.station = station
        self.pictures = {n: Pictures(c.system) for n, c in station.channels.items()}
        self.spectra = {n: Spectra(c.recent) for n, c in station.channels.items()}
        self._clients = 0

    async def serve(self, socket: WebSocket) -> None:
        """One client, from its coming to its going."""
        if self._clients >= MOST_CLIENTS:
            await socket.close(1013)
            return
        self._clients += 1
        try:
            await socket.accept()
            client = _Client(self, socket)
            tasks = {asyncio.create_task(client.listen()), asyncio.create_task(client.talk())}
            done, rest = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in rest:
                task.cancel()
            await asyncio.gather(*rest, return_exceptions=True)
            for task in done:
                await _say_goodbye(socket, task.exception())
        finally:
            self._clients -= 1


async def _say_goodbye(socket: WebSocket, error: BaseException | None) -> None:
    if error is None or isinstance(error, WebSocketDisconnect):
        return
    code, reason = 1011, "Something failed inside."
    if isinstance(error, _WrongMessageError):
        code, reason = 1008, str(error)
    else:
        _log.error("a client of the page was let go", exc_info=error)
    try:
        await socket.close(code, reason)
    except (RuntimeError, OSError):
        pass  # it is gone already


class _Client:
    def __init__(self, feeds: Feeds, socket: WebSocket) -> None:
        self._feeds = feeds
        self._socket = socket
        self._wishes = _Wishes()
        self._changed = True
        self._unseen = 0
        self._drawn: int | None = None  # number of the last frame in the curves

    # ------------------------------------------------------------------ what it says

    async def listen(self) -> None:
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            text = message.get("text")
            if text is None:
                raise _WrongMessageError("Messages must be JSON text.")
            self._hear(text)

    def _hear(self, text: str) -> None:
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):
            raise _WrongMessageError("Messages must be JSON.") from None
        if not isinstance(content, dict):
            raise _WrongMessageError("Messages must be JSON objects.")
        if content == {"seen": True}:
            self._unseen = max(0, self._unseen - 1)
            return
        self._wishes = self._wished(content)
        self._unseen = 0
        self._changed = True

    def _wished(self, content: dict[str, Any]) -> _Wishes:
        name = content.pop("channel", None)
        if name is not None and (
            not isinstance(name, str) or name not in self._feeds.station.channels
        ):
            raise _WrongMessageError("There is no channel of this name.")
        wishes = _Wishes(name)
        for key, value in content.items():
            if key not in _NUMBERS:
                raise _WrongMessageError("The message has a part that is not known.")
            _, least, most = _NUMBERS[key]
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise _WrongMessageError(f"{key} must be a number.")
            if not least <= value <= most:
                raise _WrongMessageError(f"{key} must lie from {least:g} to {most:g}.")
            setattr(wishes, key, float(value))
        return wishes

    # -------------------------------------------------------------- what it is told

    async def talk(self) -> None:
        due = dict.fromkeys(("status", "rows", "image", "spectrum"), 0.0)
        next_row = picture = 0
        while True:
            if self._changed:
                self._changed, next_row, picture = False, -1, -1
                due = dict.fromkeys(due, 0.0)
            wishes, now = self._wishes, time.monotonic()
            if now >= due["status"]:
                due["status"] = now + 1 / _STATUS_HZ
                await self._send(self._status())
            channel = self._feeds.station.channels.get(wishes.channel or "")
            if channel is not None:
                if wishes.rows_hz and now >= due["rows"]:
                    due["rows"] = _after(due["rows"], now, wishes.rows_hz)
                    next_row = await self._rows(channel, wishes, next_row)
                if wishes.image_hz and now >= due["image"] and self._unseen < _MOST_UNSEEN:
                    due["image"] = _after(due["image"], now, wishes.image_hz)
                    picture = await self._picture(channel, wishes, picture)
                if wishes.spectrum_s and now >= due["spectrum"]:
                    due["spectrum"] = now + 1 / _SPECTRUM_HZ
                    await self._spectrum(channel, wishes)
            await asyncio.sleep(_TICK_S)

    async def _send(self, message: bytes) -> None:
        await self._socket.send_bytes(message)

    def _status(self) -> bytes:
        channels = [channel_dict(c) for c in self._feeds.station.channels.values()]
        return pack({"kind": "status", "host_time_s": time.time(), "channels": channels})

    async def _rows(self, channel: Channel, wishes: _Wishes, after: int) -> int:
        first = after < 0
        if first:
            rows, following = last_rows(channel.recent, wishes.rows_s)
        else:
            rows, following = channel.recent.since(after)
        rows = rows[-_MOST_ROWS:]
        if not len(rows) and not first:
            return following
        drawn = torn(rows, None if first else self._drawn)
        self._drawn = int(rows["frame"][-1]) if len(rows) else None
        status = channel.status()
        arrays: dict[str, Any] = {"time_s": drawn["host_time_s"].astype(np.float64)}
        for quantity in QUANTITIES:
            arrays[quantity.key] = quantity.shown(drawn[quantity.column], status)
        header = {
            "kind": "rows",
            "channel": wishes.channel,
            "first": first,
            "next": int(following),
            "zero": [quantity.zero(status) for quantity in QUANTITIES],
        }
        await self._send(pack(header, arrays))
        return int(following)

    async def _picture(self, channel: Channel, wishes: _Wishes, last: int) -> int:
        sample = channel.latest()
        if sample is None or sample.number == last:
            return last
        pictures = self._feeds.pictures[str(wishes.channel)]
        made = await run_in_threadpool(pictures.of, sample, int(wishes.width))
        header = {
            "kind": "image",
            "channel": wishes.channel,
            "number": made.number,
            "time_s": made.time_s,
            "height": made.shape[0],
            "width": made.shape[1],
            "full_scale": channel.system.full_scale,
            "saturated_fraction": made.saturated_fraction,
        }
        arrays: dict[str, Any] = {
            "lines": made.lines,
            "code": made.code,
            "counts": made.counts,
            "jpeg": made.jpeg,
        }
        self._unseen += 1
        await self._send(pack(header, arrays))
        return sample.number

    async def _spectrum(self, channel: Channel, wishes: _Wishes) -> None:
        spectra = self._feeds.spectra[str(wishes.channel)]
        header: dict[str, Any] = {"kind": "spectrum", "channel": wishes.channel}
        try:
            arrays, bounds = await run_in_threadpool(spectra.last, wishes.spectrum_s)
        except ValueError as error:
            await self._send(pack({**header, "error": str(error)}))
            return
        header["bounds"] = finite(bounds)
        await self._send(pack(header, dict(arrays)))


def _after(due: float, now: float, rate_hz: float) -> float:
    """The next moment of a regular beat; beats that were missed are left out."""
    beat = 1 / rate_hz
    return max(due + beat, now) if math.isfinite(due) and now - due < beat else now + beat
