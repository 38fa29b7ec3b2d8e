"""Frames before other programs, where the system allows it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress

__all__ = ["NICE", "REAL_TIME", "before_others", "give_way"]

#: Where it may, a station runs in real time at the least priority there is (sched(7), SCHED_RR):
#: before all that does not, and no sooner than what the system itself needs.
REAL_TIME = 1
#: Else before programs that are at 0, by setpriority(2).
NICE = -10
_AFTER = 5


@contextmanager
def before_others(channels: int) -> Iterator[str]:
    """Run this process before other programs; what is not allowed is left.

    The whole station is raised and not the tracker alone: a thread that holds the interpreter's
    lock or a part of a matrix, and does not run, keeps the tracker waiting, too. Real time is for
    machines with a core more than channels: with less, a station that cannot keep up would leave
    nothing for others.

    Parameters
    ----------
    channels : int
        Of the station; each may keep a core busy.

    Yields
    ------
    str
        What was had: "real time", "nice -10" or another number, "" if nothing.
    """
    if sys.platform != "linux":  # elsewhere these calls concern other things than threads
        yield ""
        return
    # Threads that begin later have what the thread has that begins them.
    before: dict[int, tuple[int, os.sched_param, int]] = {}
    for thread in map(int, os.listdir("/proc/self/task")):
        with suppress(OSError):  # it has ended
            before[thread] = _now(thread)
    had = _real_time(before) if len(os.sched_getaffinity(0)) > channels else ""
    try:
        yield had or _lowered(before)
    finally:
        for thread, (policy, parameter, nice) in before.items():
            with suppress(OSError):
                os.sched_setscheduler(thread, policy, parameter)
                os.setpriority(os.PRIO_PROCESS, thread, nice)


def give_way() -> None:
    """Let other programs run before this one, whatever started it; no thread may run yet."""
    if sys.platform == "linux":
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.setpriority(os.PRIO_PROCESS, 0, max(_AFTER, os.getpriority(os.PRIO_PROCESS, 0)))


def _now(thread: int) -> tuple[int, os.sched_param, int]:
    """(policy, its parameter, niceness)."""
    nice = os.getpriority(os.PRIO_PROCESS, thread)
    return os.sched_getscheduler(thread), os.sched_getparam(thread), nice


def _real_time(threads: Iterable[int]) -> str:
    had = ""
    for thread in threads:
        with suppress(OSError):
            os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(REAL_TIME))
            had = "real time"
    return had


def _lowered(threads: Mapping[int, tuple[int, os.sched_param, int]]) -> str:
    """Lower the niceness as far as a limit allows."""
    had = ""
    for thread, (_, _, nice) in threads.items():
        for wanted in range(min(NICE, nice), 0):
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, thread, wanted)
                had = f"nice {wanted}"
                break
    return had
