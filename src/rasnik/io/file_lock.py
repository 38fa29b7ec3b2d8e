"""A lock that says that a file is being written, and goes away with the program that holds it."""

from __future__ import annotations

import os
import time
from pathlib import Path

from rasnik.io.disk_space import reserve

try:
    import fcntl
except ImportError:  # Windows does not let two programs write a file unless both ask for it
    fcntl = None  # type: ignore[assignment]

__all__ = ["FileLock"]


class FileLock:
    """Holds a file for one writer.

    Parameters
    ----------
    path : Path
        A file that exists.

    Raises
    ------
    BlockingIOError
        If another writer, or a reader that does not use SWMR, holds it for more than a second.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDWR)
        self._reserved = 0
        patience_s, step_s = 1.0, 0.05  # readers hold a file while they open it
        for left in range(round(patience_s / step_s), -1, -1):
            try:
                self._lock("LOCK_EX")
                break
            except BlockingIOError:
                if left:
                    time.sleep(step_s)
                    continue
                self.release()
                raise BlockingIOError(
                    f"{path}: another program has this file open and may be writing it; "
                    "stop that first, or give another name"
                ) from None

    def share(self) -> None:
        """Let readers lock the file as well, as the HDF5 library does; writers stay out."""
        self._lock("LOCK_SH")

    def sync(self) -> None:
        """Wait until the disk has what was written to the file."""
        os.fsync(self._descriptor)

    def reserve(self, end: int) -> None:
        """Set space aside for the file up to a position, and somewhat more.

        Raises
        ------
        OSError
            If the disk is full.
        """
        if end > self._reserved:
            step = 1 << 20
            start = self._reserved
            reserve(self._descriptor, start, end + step - start)
            self._reserved = end + step

    def release(self) -> None:
        os.close(self._descriptor)

    def _lock(self, kind: str) -> None:
        if fcntl is None:
            return
        try:
            fcntl.flock(self._descriptor, getattr(fcntl, kind) | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:
            pass  # some network drives have no locks
