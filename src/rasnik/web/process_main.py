"""The process that serves the page: ``python -m rasnik.web.process_main``.

Started by `rasnik.web.process`, which hands it a listening socket and three connections. It ends
with the station's process, however that ends.
"""

from __future__ import annotations

import importlib
import signal
import socket
import sys
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, cast

from rasnik.live.linear_algebra import in_one_thread
from rasnik.live.priority import give_way

__all__ = ["main"]

_LOOK_S = 0.5


def main() -> None:
    """Serve until the station says stop, or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the station, which ends this
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    in_one_thread()
    give_way()  # before anything is loaded, which takes a second
    from rasnik.web.line import Line
    from rasnik.web.remote import Plan, RemoteStation

    listener_fd, *lines = map(int, sys.argv[1:])
    control, quick, slow = (Connection(line) for line in lines)
    try:
        plan: Plan = control.recv()
        station = RemoteStation(plan, Line(quick), Line(slow))
        with socket.socket(fileno=listener_fd) as listener:
            _serve(cast(Any, station), plan.token, listener, control)
    except (EOFError, OSError):
        pass  # the station is gone


def _serve(station: Any, token: str | None, listener: socket.socket, control: Connection) -> None:
    from rasnik.web.line import READY
    from rasnik.web.serving import PageError, Serving

    _load()
    try:
        serving = Serving(station, token, listener)
    except PageError as error:
        control.send_bytes(str(error).encode())
        return
    try:
        control.send_bytes(READY)
        # A signal may come to another thread, and is seen when this one goes on.
        while not control.poll(_LOOK_S):
            pass
    finally:
        serving.stop()


def _load() -> None:
    """Load what is loaded at its first use, so that no viewer waits for it."""
    with suppress(ImportError):  # what is missing is told by who needs it
        importlib.import_module("scipy.signal")
        from PIL import Image

        Image.preinit()


if __name__ == "__main__":
    main()
