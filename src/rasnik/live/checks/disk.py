"""The disk that recordings go to."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rasnik.live.checks.finding import NOT_KNOWN, Finding, Machine, nearest_folder
from rasnik.live.checks.rates import frame_bytes, frame_rate_hz, row_bytes, stream_bytes_s
from rasnik.live.station import StationConfig

__all__ = ["Demand", "demand", "file_system", "free_space", "write_speed"]

_NETWORK = re.compile(r"nfs\d?|cifs|smb\w*|9p|afs|ceph|lustre|fuse\.(sshfs|glusterfs|rclone)|davfs")
_MEMORY = {"tmpfs", "ramfs"}
_DAY_S, _GIB, _MIB = 86400.0, 2.0**30, 2.0**20
_FEW_DAYS = 7.0
_TEST_BYTES, _BLOCK_BYTES = 32 * 2**20, 2**20
_TEST_S = 2.0
_SYNCS = 5


@dataclass(frozen=True)
class Demand:
    """What a station writes.

    Attributes
    ----------
    rows_bytes_s : float
        Rows of all channels.
    frames_bytes_s : float
        Frames of events as they are kept at the most, on average, and those on schedule.
    event_bytes : float
        Frames of one event in the channel that has most.
    keep_free_bytes : float
        Space at which recording pauses.
    flush_s : float
        Time between two flushes in the channel that flushes most often.
    """

    rows_bytes_s: float
    frames_bytes_s: float
    event_bytes: float
    keep_free_bytes: float
    flush_s: float


def demand(config: StationConfig) -> Demand:
    """What the channels that record write, by the station file."""
    rows = frames = event = keep_free = 0.0
    flush_s = 10.0
    for channel in config.channel:
        options, raw = channel.recording, channel.recording.raw
        if not options.enabled:
            continue
        rows += row_bytes() * frame_rate_hz(channel)
        of_event = stream_bytes_s(channel) * (raw.before_s + raw.after_s) if raw.on else 0.0
        frames += of_event * raw.most_per_hour / 3600.0
        frames += frame_bytes(channel) / raw.every_s if raw.every_s else 0.0
        event = max(event, of_event)
        keep_free = max(keep_free, options.keep_free_mib * _MIB)
        flush_s = min(flush_s, options.flush_s or 1.0)
    return Demand(rows, frames, event, keep_free, flush_s)


def free_space(config: StationConfig) -> Iterator[Finding]:
    """For how long there is space."""
    folder, wanted = nearest_folder(config.folder), demand(config)
    free = shutil.disk_usage(folder).free
    spare = free - wanted.keep_free_bytes
    found = f"{free / _GIB:.1f} GiB free in {folder}"
    more = "Free space there, or name a folder on a larger disk (folder = ... in the station file)."
    if spare <= 0:
        least = wanted.keep_free_bytes / _GIB
        yield Finding("disk space", "fault", f"{found}; recording pauses below {least:.2g}", more)
        return
    if not wanted.rows_bytes_s:
        yield Finding("disk space", "ok", f"{found}; nothing is to be recorded")
        return
    days = spare / wanted.rows_bytes_s / _DAY_S
    total = wanted.rows_bytes_s + wanted.frames_bytes_s
    found += f": {_days(days)} of positions"
    if wanted.frames_bytes_s:
        worst = spare / total / _DAY_S
        found += f", {_days(worst)} with as many frames as may be kept"
    if days < _FEW_DAYS:
        yield Finding("disk space", "warning", found, more)
    elif spare / total < _DAY_S:
        yield Finding(
            "disk space",
            "note",
            found,
            "Keep fewer frames (most_per_hour, before_s, after_s in the station file).",
        )
    else:
        yield Finding("disk space", "ok", found)


def _days(days: float) -> str:
    return f"{days:.0f} days" if days >= 2 else f"{24 * days:.1f} hours"


def file_system(machine: Machine, config: StationConfig) -> Iterator[Finding]:
    """Its type: files that are read while they are written need a disk of this machine."""
    folder = nearest_folder(config.folder)
    kind = _type_of(machine, folder)
    local = "Record on a disk of this machine, and copy finished files from there."
    if kind is None:
        yield Finding("file system", "note", NOT_KNOWN, local)
    elif _NETWORK.fullmatch(kind):
        yield Finding(
            "file system",
            "fault",
            f"{folder} is on {kind}, over a network: HDF5 files cannot be read safely there while "
            "they are written",
            local,
        )
    elif kind in _MEMORY:
        found = f"{folder} is on {kind}: recordings are gone when the machine is switched off"
        yield Finding("file system", "warning", found, local)
    else:
        yield Finding("file system", "ok", f"{kind}, for {folder}")


def _type_of(machine: Machine, folder: Path) -> str | None:
    """Type of the file system mounted at the longest path above a folder."""
    best, kind = -1, None
    for line in (machine.read("/proc/self/mountinfo") or "").splitlines():
        left, _, right = line.partition(" - ")
        fields, types = left.split(), right.split()
        if len(fields) < 5 or not types:
            continue
        at = re.sub(r"\\([0-7]{3})", lambda code: chr(int(code[1], 8)), fields[4])
        if folder.resolve().is_relative_to(at) and len(at) >= best:
            best, kind = len(at), types[0]
    return kind


def write_speed(config: StationConfig) -> Iterator[Finding]:
    """Writing with fsync in the folder, against what the station writes."""
    folder, wanted = nearest_folder(config.folder), demand(config)
    if shutil.disk_usage(folder).free < 4 * _TEST_BYTES:
        yield Finding(
            "disk speed", "warning", "too little space to measure it", f"Free space in {folder}."
        )
        return
    try:
        speed, sync_s = _measure(folder)
    except PermissionError:
        yield Finding(
            "disk speed",
            "fault",
            f"{folder} cannot be written by this user",
            "Name another folder in the station file (folder = ...), or give this one to the user.",
        )
        return
    needed = wanted.rows_bytes_s
    found = f"{speed / _MIB:.0f} MiB/s, {1e3 * sync_s:.0f} ms until a second's rows are safe"
    faster = "Record on a local solid-state disk (folder = ... in the station file)."
    if speed < 2 * needed or sync_s > 5 * wanted.flush_s:
        found += f"; positions need {needed / _MIB:.2g} MiB/s and a flush in {wanted.flush_s:g} s"
        yield Finding("disk speed", "fault", found, faster)
    elif speed < 2 * wanted.frames_bytes_s or sync_s > wanted.flush_s:
        found += f"; frames to be kept need {wanted.frames_bytes_s / _MIB:.0f} MiB/s"
        yield Finding("disk speed", "warning", found, faster)
    else:
        if wanted.event_bytes:
            found += f"; frames of an event in {wanted.event_bytes / speed:.1f} s"
        yield Finding("disk speed", "ok", found)


def _measure(folder: Path) -> tuple[float, float]:
    """Bytes in a second, and the seconds that a small piece takes, until they are on the disk."""
    block, second = os.urandom(_BLOCK_BYTES), os.urandom(64 * 1024)
    with tempfile.TemporaryFile(dir=folder, prefix="rasnik-doctor-") as file:
        start, written = time.perf_counter(), 0
        while written < _TEST_BYTES and time.perf_counter() - start < _TEST_S:
            written += file.write(block)
            file.flush()
        os.fsync(file.fileno())
        speed = written / (time.perf_counter() - start)
        times = []
        for _ in range(_SYNCS):
            start = time.perf_counter()
            file.write(second)
            file.flush()
            os.fsync(file.fileno())
            times.append(time.perf_counter() - start)
    return speed, sorted(times)[_SYNCS // 2]
