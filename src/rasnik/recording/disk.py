"""Space on a disk, and names that are not taken."""

from __future__ import annotations

import os
import re
import shutil
from datetime import UTC, datetime
from pathlib import Path

__all__ = ["DiskError", "free_mib", "new_name", "reason_of", "try_out"]


class DiskError(Exception):
    """Something cannot be stored now; the message is a sentence with its remedy."""


def free_mib(folder: Path) -> float:
    """Space that is left on the disk of a folder."""
    return shutil.disk_usage(folder).free / (1 << 20)


def new_name(folder: Path, channel: str, time_s: float, suffix: str) -> Path:
    """CHANNEL_YYYYmmddTHHMMSSZ and the suffix, with a number if the name is taken."""
    stem = f"{channel}_{datetime.fromtimestamp(time_s, UTC):%Y%m%dT%H%M%SZ}"
    path, number = folder / f"{stem}{suffix}", 1
    while path.exists():
        number += 1
        path = folder / f"{stem}_{number}{suffix}"
    return path


def reason_of(error: Exception) -> str:
    """What is wrong, without what the HDF5 library tells of its buffers."""
    cause = error.__cause__ or error
    text = (isinstance(cause, OSError) and cause.strerror) or str(cause)
    found = re.search(r"error message = '([^']+)'", text)
    return found[1] if found else text


def try_out(folder: Path, size: int) -> None:
    """Write a file of some size and remove it: a disk can refuse what it says is free.

    Raises
    ------
    OSError
    """
    path = folder / f".trial.{os.getpid()}"
    try:
        with path.open("wb") as file:
            file.write(bytes(size))
            file.flush()
            os.fsync(file.fileno())
    finally:
        path.unlink(missing_ok=True)
