"""Processors, privileges and clock of this machine."""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator

from rasnik.live.checks.finding import NOT_KNOWN, Finding, Machine
from rasnik.live.priority import NICE, REAL_TIME
from rasnik.live.station import StationConfig

__all__ = [
    "clock",
    "clock_is_synchronised",
    "cores_to_use",
    "governor",
    "memory_lock",
    "priority",
    "processors",
]

_CAP_SYS_NICE, _CAP_IPC_LOCK = 23, 14
_TIME_ERROR = 5  # what adjtimex returns of a clock that nobody sets
_LOCK_BYTES = 64 * 2**20


def processors(machine: Machine, config: StationConfig) -> Iterator[Finding]:
    """Cores that this process may use, one wanted for each camera and one for the rest."""
    cores = cores_to_use(machine)
    wanted, found = len(config.channel) + 1, f"{cores:g} of {os.cpu_count() or 1} cores to use"
    if cores >= wanted:
        yield Finding("cores", "ok", found)
    else:
        yield Finding(
            "cores",
            "note",
            f"{found}; {wanted} are comfortable: one for each camera, one for page and recording",
            "If the analysis does not keep up (rasnik doctor without --quick), take more cores.",
        )


def cores_to_use(machine: Machine) -> float:
    """Cores that this process may use at a time; a part of one where it is rationed."""
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    quota = (machine.read("/sys/fs/cgroup/cpu.max") or "").split()
    if len(quota) == 2 and quota[0].isdigit() and quota[1].isdigit():
        return min(float(cores), int(quota[0]) / int(quota[1]))
    return float(cores)


def governor(machine: Machine) -> Iterator[Finding]:
    """Whether the processors may slow down while nothing seems to be wanted of them."""
    folder = "/sys/devices/system/cpu"
    cores = [name for name in machine.names(folder) if re.fullmatch(r"cpu\d+", name)]
    set_to = {machine.read(f"{folder}/{name}/cpufreq/scaling_governor") for name in cores}
    names = sorted(name for name in set_to if name)
    if not names:
        yield Finding(
            "CPU frequency",
            "note",
            f"{NOT_KNOWN}; usual in a virtual machine",
            "If latency varies, choose performance before saving of power in the firmware.",
        )
    elif names == ["performance"]:
        yield Finding("CPU frequency", "ok", "governor performance")
    else:
        yield Finding(
            "CPU frequency",
            "note",
            f"governor {', '.join(names)}: the first frames after a rest come late",
            "sudo cpupower frequency-set -g performance",
        )


def priority(machine: Machine) -> Iterator[Finding]:
    """Whether a station of this user runs before other programs, as `before_others` wants it."""
    realtime, nice = _limit(machine, "realtime priority"), _limit(machine, "nice priority")
    if realtime is None or nice is None:
        yield Finding(
            "priority", "note", NOT_KNOWN, "Let nothing else that computes run on this machine."
        )
    elif _has_capability(machine, _CAP_SYS_NICE) or realtime >= REAL_TIME:
        yield Finding("priority", "ok", "may be raised: real time where cores suffice")
    elif nice > 20:  # 20 - nice is the limit's number
        yield Finding("priority", "ok", f"may be raised to nice {max(NICE, 20 - nice):.0f}")
    else:
        yield Finding(
            "priority",
            "note",
            "this user may not raise it: other programs can delay frames",
            "Run the station as a service (rasnik doctor --service STATION.toml), which gets "
            "its priority from systemd.",
        )


def memory_lock(machine: Machine) -> Iterator[Finding]:
    """How much memory may be kept from being swapped out; swap itself is what hurts."""
    limit = _limit(machine, "locked memory")
    swaps = machine.read("/proc/swaps")
    if limit is None or swaps is None:
        yield Finding("memory lock", "note", NOT_KNOWN, "Keep enough memory free.")
    elif _has_capability(machine, _CAP_IPC_LOCK) or limit >= _LOCK_BYTES:
        yield Finding("memory lock", "ok", "allowed")
    elif len(swaps.splitlines()) < 2:
        yield Finding("memory lock", "ok", f"{limit / 1024:.0f} KiB, and nothing is swapped out")
    else:
        yield Finding(
            "memory lock",
            "note",
            f"{limit / 1024:.0f} KiB, and there is swap: memory that comes back from disk delays "
            "frames",
            "sudo sysctl -w vm.swappiness=1",
        )


def _limit(machine: Machine, name: str) -> float | None:
    """A soft limit of this process; None where there is no such file or line."""
    for line in (machine.read("/proc/self/limits") or "").splitlines():
        if found := re.match(rf"Max {name}\s+(\S+)", line):
            text = found[1]
            return float("inf") if text == "unlimited" else float(text)
    return None


def _has_capability(machine: Machine, number: int) -> bool:
    found = re.search(r"^CapEff:\s*([0-9a-f]+)", machine.read("/proc/self/status") or "", re.M)
    return found is not None and bool(int(found[1], 16) >> number & 1)


def clock(state: Callable[[], bool | None] | None = None) -> Iterator[Finding]:
    """Whether times in the record are those of other machines.

    Parameters
    ----------
    state : callable, optional
        Tells whether the clock is synchronised; None if that is not known.
    """
    synchronised = (state or clock_is_synchronised)()
    if synchronised:
        yield Finding("clock", "ok", "synchronised")
    elif synchronised is None:
        yield Finding(
            "clock", "note", NOT_KNOWN, "Compare it with a clock you trust: times of the record."
        )
    else:
        yield Finding(
            "clock",
            "warning",
            "not synchronised: times in the record drift against those of other instruments",
            "sudo apt install chrony",
        )


def clock_is_synchronised() -> bool | None:
    """As the kernel says, else as systemd says; None if neither does."""
    if sys.platform != "linux":
        return None
    try:
        # All zero asks without setting anything; the structure has 208 bytes.
        result = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(1024))
    except (OSError, AttributeError):
        result = -1
    if result >= 0:
        return result != _TIME_ERROR
    command = ["timedatectl", "show", "--property=NTPSynchronized", "--value"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=3).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
    return {"yes": True, "no": False}.get(answer)
