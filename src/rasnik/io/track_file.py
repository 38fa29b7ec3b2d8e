"""Measuring a track into a file: rows on their way to the disk within a second."""

from __future__ import annotations

import atexit
import math
import os
import threading
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rasnik.instrument import System
from rasnik.io.file_lock import FileLock
from rasnik.io.hdf5 import append_rows
from rasnik.io.results import file_metadata
from rasnik.io.track_table import (
    MOST_ROWS,
    TABLE,
    TABLE_ATTRIBUTES,
    create_table,
    reopened,
    row_type,
)
from rasnik.tracking.track import Track, TrackColumn

__all__ = ["HDF5_SUFFIXES", "TrackWriter", "track_metadata"]

HDF5_SUFFIXES = (".h5", ".hdf5")
_SPARE_BYTES = 1 << 20


def track_metadata(system: System | None, metadata: Mapping[str, str] | None) -> dict[str, str]:
    """What is stored beside a track: what is known by itself, and what is given."""
    taken = TABLE_ATTRIBUTES & set(metadata or {})
    if taken:
        raise ValueError(f"metadata cannot be named {', '.join(sorted(taken))}; use other names")
    known = {**file_metadata(system), **(metadata or {})}
    if system is not None:
        known["system_toml"] = system.to_toml()
    return {key: str(value) for key, value in known.items()}


class TrackWriter:
    """Writes a track into an HDF5 file while it is measured.

    A context manager. The layout is told in `rasnik.io.track_table`. Others can read the file
    at any time, with `rasnik.io.read_track`. What is written is in the file, for the case that
    this program is killed, within `flush_s`, whether or not more follows.

    Parameters
    ----------
    path : path-like
        Ends in ``.h5`` or ``.hdf5``.
    system : System, optional
        Stored as TOML.
    metadata : mapping of str to str, optional
        Stored as attributes. ``source`` says where the frames come from, ``frame_rate_hz`` how
        many there are in a second, ``start_time_utc`` when the first was taken (now, if it is
        not given).
    resume : bool
        Continue a file of the same system and source, also one whose writer was killed. Without
        such a file a new one is begun.
    flush_s : float
        Longest time between `write` and the file. With 0 every `write` waits for it.
    extra : sequence of TrackColumn
        Columns stored after those of a track; `write` takes their values.

    Raises
    ------
    FileExistsError
        If the file exists and `resume` is not set.
    ValueError
        If the suffix is not that of HDF5; if the file to continue is not a track, or one of
        another system or source.
    OSError
        If the file cannot be written, or another program is writing it.

    Examples
    --------
    >>> with TrackWriter("track.h5", system=system, metadata={"source": "camera 1"}) as file:
    ...     for block in tracker.blocks(frames):
    ...         file.write(block)
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        system: System | None = None,
        metadata: Mapping[str, str] | None = None,
        resume: bool = False,
        flush_s: float = 1.0,
        extra: Sequence[TrackColumn] = (),
    ) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() not in HDF5_SUFFIXES:
            raise ValueError(f"{path}: a track is measured into HDF5; end the name in .h5")
        if not (math.isfinite(flush_s) and flush_s >= 0):
            raise ValueError(f"flush_s must be a number of seconds, not {flush_s}")
        if not resume and self.path.exists():
            raise FileExistsError(
                f"{path} exists already and is not overwritten; "
                "give another name, or resume=True to continue it"
            )
        about = track_metadata(system, metadata)
        # Half of the time is left for the disk.
        self._wait_s = flush_s / 2
        if not self.path.exists():
            about.setdefault("start_time_utc", datetime.now(UTC).isoformat(timespec="milliseconds"))
            create_table(self.path, about, extra)
        self._lock = FileLock(self.path)
        try:
            self._file, self._rows, self._next_frame = reopened(self.path, about, extra)
        except BaseException:
            self._lock.release()
            raise
        self._lock.share()
        self._row_type = row_type(extra)
        self._extra = [column.name for column in extra]
        self._pending: list[NDArray[Any]] = []
        self._pending_rows = 0
        self._pending_since = 0.0
        self._error: BaseException | None = None
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(
            target=self._keep_storing, name=f"track {self.path.name}", daemon=True
        )
        self._thread.start()
        atexit.register(self.close)

    @property
    def rows(self) -> int:
        """Rows written, those that are still on their way to the file among them."""
        return self._rows

    @property
    def next_frame(self) -> int:
        """Number of the last frame written + 1; 0 for a new file."""
        return self._next_frame

    def write(self, track: Track, extra: Mapping[str, NDArray[Any]] | None = None) -> None:
        """Append the rows of a track; its metadata are not looked at.

        Parameters
        ----------
        track : Track
        extra : mapping of str to ndarray, shape (n,)
            Values of the further columns of the file, all of them.

        Raises
        ------
        ValueError
            If the numbers of the frames do not increase from row to row, those written before
            included, the further columns are not those of the file, or the file is closed.
        OSError
            If rows could not be stored, these or earlier ones.
        """
        if set(extra or ()) != set(self._extra):
            raise ValueError(
                f"{self.path}: the columns {', '.join(self._extra) or '(none)'} are needed beside "
                f"those of a track, not {', '.join(extra or ()) or '(none)'}"
            )
        rows = np.empty(len(track), dtype=self._row_type)
        for name, values in {**track.as_dict(), **(extra or {})}.items():
            rows[name] = values
        with self._changed:
            if self._closed:
                raise ValueError(f"{self.path}: the file is closed; nothing can be written to it")
            self._raise_error()
            if not len(rows):
                return
            numbers = np.concatenate([[self._next_frame - 1], track.frame])
            if numbers[0] < -1 or (np.diff(numbers) <= 0).any():
                raise ValueError(
                    f"{self.path}: the numbers of the frames must increase from row to row, and "
                    f"begin at {self._next_frame} or later; a counter that starts again has to be "
                    "continued before"
                )
            if not self._pending:
                self._pending_since = time.monotonic()
            self._pending.append(rows)
            self._pending_rows += len(rows)
            self._rows += len(rows)
            self._next_frame = int(track.frame[-1]) + 1
            if self._wait_s == 0 or self._pending_rows >= MOST_ROWS:
                self._store()
                self._raise_error()
            else:
                self._changed.notify()

    def flush(self) -> None:
        """Store what is written so far, and wait until the disk has it."""
        with self._changed:
            self._store()
            self._raise_error()
        self._lock.sync()

    def close(self) -> None:
        """Store the rest and close the file."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify()
        self._thread.join()
        atexit.unregister(self.close)
        try:
            self._store()
            self._file.close()
        finally:
            self._lock.release()
        self._raise_error()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _store(self) -> None:
        """Move what is pending to the file; a failure is kept for the next call to raise."""
        if not self._pending or self._error is not None:
            return
        try:
            rows = np.concatenate(self._pending)
            # A chunk that is begun, and the index of chunks, fit into the megabyte beyond.
            self._lock.reserve(self._file.id.get_filesize() + rows.nbytes + _SPARE_BYTES)
            for first in range(0, len(rows), MOST_ROWS):
                append_rows(self._file[TABLE], rows[first : first + MOST_ROWS])
        except Exception as error:
            self._error = error
        self._pending.clear()
        self._pending_rows = 0

    def _raise_error(self) -> None:
        if self._error is not None:
            raise OSError(
                f"{self.path}: rows could not be stored ({self._error}); the file holds those "
                "before. Check the space on the disk, then continue it with resume=True"
            ) from self._error

    def _keep_storing(self) -> None:
        """What the thread does: store rows when the oldest has waited long enough."""
        while self._rows_are_due():
            with self._changed:
                self._store()
            try:
                self._lock.sync()  # outside of the lock: it may take long, and nobody waits for it
            except OSError as error:
                self._error = error

    def _rows_are_due(self) -> bool:
        """Wait until rows have to be stored; False when the file is to be closed."""
        with self._changed:
            while not self._closed:
                left = self._pending_since + self._wait_s - time.monotonic()
                if self._pending and left <= 0:
                    return True
                self._changed.wait(left if self._pending else None)
            return False
