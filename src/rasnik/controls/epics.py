"""Values as process variables of EPICS, by Channel Access and PV Access.

EPICS runs once in a process and cannot be stopped in it. So it has a process of its own
(`rasnik.controls.ioc`), which gets the values through a pipe and ends with it.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import subprocess
import threading
import time
from collections import deque
from typing import Any

from rasnik.controls.ioc import READY
from rasnik.controls.values import (
    VALUES,
    PublishedStation,
    Value,
    frame_time_s,
    judge,
    statuses,
)
from rasnik.live.processes import environment_of_modules, module_command
from rasnik.live.station import Epics

__all__ = ["EpicsServer", "pv_name"]

_log = logging.getLogger(__name__)
_LONGEST_NAME = 60  # of EPICS
_LONGEST_WAIT_S = 30.0  # before the process is started again
_SETTLED_S = 60.0  # a process that ran as long may be started again at once


def pv_name(prefix: str, channel: str, value: Value) -> str:
    """Name of the process variable of a value: PREFIX:CHANNEL:X."""
    return f"{prefix}:{channel}:{value.pv}"


class EpicsServer:
    """Serve the values of a station as process variables that can be read, not written.

    Parameters
    ----------
    station : Station
    config : Epics

    Attributes
    ----------
    message : str
        What is wrong, as a sentence; empty if nothing is.

    Raises
    ------
    ImportError
        If softioc is missing; the message says how to install it.
    ValueError
        If a name would be too long for EPICS.

    Notes
    -----
    The variables of EPICS hold as in any server: EPICS_CA_SERVER_PORT, EPICS_CAS_INTF_ADDR_LIST,
    EPICS_PVAS_INTF_ADDR_LIST and so on.
    """

    def __init__(self, station: PublishedStation, config: Epics) -> None:
        if importlib.util.find_spec("softioc") is None:
            raise ImportError('EPICS needs softioc; install it with: pip install "rasnik[epics]"')
        names = [
            pv_name(config.prefix, name, value) for name in station.channels for value in VALUES
        ]
        longest = max(names, key=len)
        if len(longest) > _LONGEST_NAME:
            raise ValueError(
                f"controls.epics.prefix: {longest} has {len(longest)} letters and EPICS takes "
                f"{_LONGEST_NAME}; choose a shorter prefix or shorter names of channels"
            )
        self._station = station
        self._config = config
        self._stopping = threading.Event()
        self._ready = threading.Event()
        self._thread: threading.Thread | None = None
        self._child: subprocess.Popen[str] | None = None
        self._said: deque[str] = deque(maxlen=5)
        self.message = ""

    def start(self) -> None:
        """Begin to serve; returns at once."""
        if self._thread is None:
            self.message = "The EPICS server is starting."
            self._thread = threading.Thread(target=self._run, name="epics", daemon=True)
            self._thread.start()

    def wait(self, timeout_s: float) -> bool:
        """Whether the process variables are there, at the latest after the time."""
        return self._ready.wait(timeout_s)

    def stop(self) -> None:
        """End the server; harmless if it was not started."""
        self._stopping.set()
        if self._child is not None:
            self._child.kill()  # it may take no values, and a thread wait for it
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    # ----------------------------------------------------------------- the other process

    def _run(self) -> None:
        """What the thread does: feed the process, and start it again if it ends."""
        wait_s = 1.0
        while not self._stopping.is_set():
            began = time.monotonic()
            try:
                self._serve()
            except Exception as error:  # nothing of this may reach the station
                if self._stopping.is_set():
                    break
                why = "; ".join([str(error), *self._said])
                self.message = f"The EPICS server has ended and is started again: {why}"
                _log.warning(self.message)
            self._ready.clear()
            wait_s = 1.0 if time.monotonic() - began > _SETTLED_S else wait_s
            self._stopping.wait(wait_s)
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S)

    def _serve(self) -> None:
        child = subprocess.Popen(
            module_command("rasnik.controls.ioc"), env=environment_of_modules(),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, encoding="utf-8", errors="replace",
        )  # fmt: skip
        self._child = child
        listener = threading.Thread(target=self._listen, args=(child,), name="epics", daemon=True)
        listener.start()
        try:
            self._feed(child)
        finally:
            child.kill()  # it holds nothing that could be lost
            child.wait()
            listener.join()
            for pipe in (child.stdin, child.stdout):
                _close(pipe)

    def _feed(self, child: subprocess.Popen[str]) -> None:
        """Send the table of process variables, then values, until the station stops."""
        assert child.stdin is not None
        child.stdin.write(json.dumps({"parent": os.getpid(), "pvs": self._table()}) + "\n")
        while True:
            child.stdin.write(json.dumps(self._values()) + "\n")
            child.stdin.flush()
            if self._stopping.wait(1 / self._config.rate_hz):
                return
            if child.poll() is not None:
                raise OSError(f"exit status {child.returncode}")

    def _listen(self, child: subprocess.Popen[str]) -> None:
        """What EPICS says goes to the log."""
        assert child.stdout is not None
        for line in child.stdout:
            if line.strip() == READY:
                self.message = ""
                self._ready.set()
            elif line.strip():
                self._said.append(line.strip())
                _log.info("EPICS: %s", line.strip())

    # ----------------------------------------------------------------- what is sent

    def _table(self) -> list[dict[str, Any]]:
        """The process variables, in the order in which values are sent."""
        return [
            {
                "pv": pv_name(self._config.prefix, name, value), "kind": value.kind,
                "unit": value.unit, "description": value.description, "decimals": value.decimals,
                "limits": value.limits(channel.config.alarms),
            }
            for name, channel in self._station.channels.items()
            for value in VALUES
        ]  # fmt: skip

    def _values(self) -> list[tuple[Any, int, float]]:
        """Value, severity and time of each."""
        now = time.time()
        found: list[tuple[Any, int, float]] = []
        for name, status in statuses(self._station).items():
            alarms = self._station.channels[name].config.alarms
            frame = frame_time_s(status)
            for value in VALUES:
                when = frame if value.measured or value.name == "time_s" else now
                found.append((value.read(status), int(judge(value, status, alarms)), when))
        return found


def _close(pipe: Any) -> None:
    try:
        pipe.close()
    except OSError:  # what is left in it has no reader
        pass
