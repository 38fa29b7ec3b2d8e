"""The process that serves process variables: ``python -m rasnik.controls.ioc``.

It reads lines of JSON: first what there is to serve, then all values again and again, each as
(value, severity, time). It ends when they end. Started by `rasnik.controls.epics`.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import threading
import time
from typing import Any

from rasnik.controls.values import STATES, Severity
from rasnik.live.priority import give_way

__all__ = ["READY", "main"]

READY = "process variables are served"
_READ_ONLY = "ASG(DEFAULT) { RULE(1, READ) }\n"
_LONGEST_TEXT = 255  # bytes
# Alarm conditions of EPICS (alarm.h) that tell why.
_READ_ALARM, _STATE_ALARM, _LIMIT_ALARM = 1, 7, 11


def main() -> None:
    """Serve until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the station, which ends this
    give_way()
    about = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with, args=(about["parent"],), daemon=True).start()
    values = json.loads(sys.stdin.readline())

    from softioc import builder, softioc

    pvs = about["pvs"]
    records = [_record(builder, pv) for pv in pvs]
    shown: list[Any] = [None] * len(pvs)
    _show(records, pvs, values, shown)  # before anyone can read what is not known yet
    builder.LoadDatabase()
    _read_only(lambda: softioc.iocInit(_no_writes))
    sys.stdout.write(READY + "\n")
    sys.stdout.flush()
    for line in sys.stdin:
        _show(records, pvs, json.loads(line), shown)
    sys.stdout.flush()
    os._exit(0)  # EPICS has threads that do not end


def _record(builder: Any, pv: dict[str, Any]) -> Any:
    """A record for a value."""
    about = {"DESC": pv["description"], "TSE": "-2"}  # -2: the time comes with the value
    match pv["kind"]:
        case "float":
            if pv["limits"] is not None:
                about |= dict(zip(("LOLO", "HIHI"), pv["limits"], strict=True))
                about |= {"LLSV": "MAJOR", "HHSV": "MAJOR"}
            return builder.aIn(pv["pv"], EGU=pv["unit"], PREC=pv["decimals"], **about)
        case "count":
            return builder.int64In(pv["pv"], **about)
        case "bool":
            return builder.boolIn(pv["pv"], ZNAM="no", ONAM="yes", **about)
        case "state":
            return builder.mbbIn(pv["pv"], *STATES, **about)
        case _:
            return builder.longStringIn(pv["pv"], length=_LONGEST_TEXT + 1, **about)


def _show(
    records: list[Any], pvs: list[dict[str, Any]], values: list[Any], shown: list[Any]
) -> None:
    """Set what has changed."""
    for k, (record, pv, (value, severity, when)) in enumerate(
        zip(records, pvs, values, strict=True)
    ):
        # Numbers are repeated with their time; words and switches are shown when they change.
        now = (value, severity, when if pv["kind"] == "float" else None)
        if now != shown[k]:
            record.set(_content(value, pv["kind"]), severity, _why(severity, pv["kind"]), when)
            shown[k] = now


def _content(value: Any, kind: str) -> Any:
    if kind == "state":
        return STATES.index(value)
    if kind == "text":
        return str(value).encode()[:_LONGEST_TEXT].decode(errors="ignore")
    return float(value) if kind == "float" else int(value)


def _why(severity: int, kind: str) -> int:
    if severity == Severity.OK:
        return 0
    if severity == Severity.INVALID:
        return _READ_ALARM
    return _LIMIT_ALARM if kind == "float" else _STATE_ALARM


def _read_only(begin: Any) -> None:
    """Begin with rules of access that let nobody write, not even the fields of a record."""
    from softioc.imports import dbCore

    with tempfile.NamedTemporaryFile("w", suffix=".acf") as rules:
        rules.write(_READ_ONLY)
        rules.flush()
        dbCore.asSetFilename(rules.name.encode())
        begin()


def _no_writes(*arguments: Any, **options: Any) -> None:
    """Called for values that clients write; there are none."""


def _end_with(parent: int) -> None:
    """End with the station, also if something else holds its end of the pipe."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(0)


if __name__ == "__main__":
    main()
