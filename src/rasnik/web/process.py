"""The page in a process of its own: what it does never keeps a frame waiting.

Threads of one process take turns, and a page that packs rows, makes pictures and spectra would
take its turn before the tracker's. So the station only answers short questions (`Answers`), and
the page is served elsewhere (`rasnik.web.process_main`).
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import threading
import time
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING

from rasnik.live.processes import environment_of_modules, module_command
from rasnik.live.station import Server
from rasnik.web.line import READY, Answers
from rasnik.web.remote import ChannelPlan, Plan
from rasnik.web.server import Page, PageServer
from rasnik.web.serving import PageError

if TYPE_CHECKING:
    from rasnik.live.service import Station

__all__ = ["PageProcess", "page_of"]

_log = logging.getLogger(__name__)

_START_S = 30.0  # for Python to load all packages, on a slow disk
_END_S = 5.0
_FIRST_WAIT_S, _LONGEST_WAIT_S = 1.0, 30.0  # before it is started again
_SETTLED_S = 60.0  # a process that ran as long may be started again at once
_MOST_STARTS = 6  # in a row, each of which did not last


def page_of(station: Station, config: Server) -> Page:
    """The page of a station: in its own process, or a thread where sockets cannot be handed on.

    Raises
    ------
    PageError
        As `Page`.
    """
    kind = PageProcess if os.name == "posix" else PageServer
    return kind(station, config)


class PageProcess(Page):
    """The page served by another process, which is started again if it ends.

    Parameters
    ----------
    station : Station
    config : Server
        Where to listen. Port 0 takes any that is free.

    Attributes
    ----------
    message : str
        What is wrong, as a sentence; empty if nothing is.

    Raises
    ------
    PageError
        If the address is not that of this machine alone and there is no token.
    """

    def __init__(self, station: Station, config: Server) -> None:
        super().__init__(station, config)
        self.message = ""
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._child: _Child | None = None

    @property
    def pid(self) -> int | None:
        """Number of the process that serves now; None if none does."""
        child = self._child
        return None if child is None else child.process.pid

    def stop(self) -> None:
        """Close all connections and end the process; harmless if it does not run."""
        if self._thread is None:
            return
        with self._lock:  # none is begun after this
            self._stopping.set()
            child = self._child
        if child is not None:
            child.stop()
        self._thread.join()
        self._thread = None

    def _serve(self, listener: socket.socket) -> None:
        self._stopping.clear()
        child = self._begin(listener)
        assert child is not None
        try:
            child.wait_until_ready()
        except PageError:
            child.end()
            raise
        self._thread = threading.Thread(
            target=self._watch, args=(child, listener), name="page", daemon=True
        )
        self._thread.start()

    def _begin(self, listener: socket.socket) -> _Child | None:
        """A new process; None if the page is being stopped."""
        with self._lock:
            if self._stopping.is_set():
                return None
            self._child = _Child(self._station, self._token, listener)
            return self._child

    def _watch(self, child: _Child | None, listener: socket.socket) -> None:
        """Start it again when it ends; the listener stays, so its address does, too."""
        starts, wait_s, began_s = 1, _FIRST_WAIT_S, time.monotonic()
        with listener:
            while True:
                how = "it could not be started" if child is None else child.wait()
                self._child = None
                if time.monotonic() - began_s > _SETTLED_S:
                    starts, wait_s = 0, _FIRST_WAIT_S
                # Whoever ended it may be about to end the station.
                if self._stopping.wait(wait_s):
                    return
                if starts >= _MOST_STARTS:
                    self._say(f"The page has ended {starts} times in a row ({how}) and stays off.")
                    return
                self._say(f"The page has ended ({how}) and is started again; measuring goes on.")
                starts, wait_s = starts + 1, min(2 * wait_s, _LONGEST_WAIT_S)
                began_s = time.monotonic()
                child = self._again(listener)

    def _again(self, listener: socket.socket) -> _Child | None:
        child = None
        try:
            child = self._begin(listener)
            if child is not None:
                child.wait_until_ready()
                self.message = ""
        except PageError as error:
            self._say(str(error))
        return child

    def _say(self, sentence: str) -> None:
        self.message = sentence
        _log.warning(sentence)


class _Child:
    """One process that serves the page, and the threads that answer it."""

    def __init__(self, station: Station, token: str | None, listener: socket.socket) -> None:
        channels = {
            name: ChannelPlan(channel.config, channel.system, channel.recorder.folder)
            for name, channel in station.channels.items()
        }
        pairs = [Pipe() for _ in range(3)]
        self._control, *here = [pair[0] for pair in pairs]
        there = [pair[1] for pair in pairs]
        handed = [listener.fileno(), *(line.fileno() for line in there)]
        try:
            self.process = subprocess.Popen(
                module_command("rasnik.web.process_main", *map(str, handed)),
                pass_fds=handed, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                env=environment_of_modules(),
                start_new_session=True,  # Ctrl-C is for the station, which ends this
            )  # fmt: skip
        except OSError as error:
            raise PageError(f"The page's process cannot be started: {error}.") from None
        finally:
            for line in there:
                line.close()
        self._answers = Answers(station)
        self._threads = [
            threading.Thread(target=self._answer, args=(line,), name="page answers", daemon=True)
            for line in here
        ]
        for thread in self._threads:
            thread.start()
        with suppress(OSError):  # it may have ended already, which is seen by who waits for it
            self._control.send(Plan(station.config, channels, token))

    def _answer(self, line: Connection) -> None:
        """What a thread does; without its answers the process would serve errors for ever."""
        self._answers.serve(line)
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.terminate()

    def wait_until_ready(self) -> None:
        """Return when it answers requests.

        Raises
        ------
        PageError
            If it does not; it says why itself where it can.
        """
        if not self._control.poll(_START_S):
            self.process.kill()
            raise PageError(f"The page's process did not start within {_START_S:g} s.")
        try:
            said = self._control.recv_bytes()
        except (EOFError, OSError):
            raise PageError(
                f"The page's process ended at its start ({self.end()}); the log says why."
            ) from None
        if said != READY:
            raise PageError(said.decode("utf-8", "replace"))

    def wait(self) -> str:
        """Return when it has ended; how it did."""
        with suppress(EOFError, OSError):
            while True:
                self._control.recv_bytes()
        return self.end()

    def stop(self) -> None:
        """Ask it to end, and see to it that it does."""
        with suppress(OSError):
            self._control.send_bytes(b"stop")
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(_END_S)
        self.process.kill()

    def end(self) -> str:
        """Clear away what is left of it; how it ended."""
        try:
            status = self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        for thread in self._threads:
            thread.join(1.0)  # one may be at something that takes long
        self._control.close()
        return f"signal {-status}" if status < 0 else f"exit status {status}"
