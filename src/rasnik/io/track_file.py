"""Tracks in HDF5: one table that grows while others read it (SWMR).

``/track``
    Compound table with one row for each frame; the columns are those of
    `rasnik.tracking.track.TRACK_COLUMNS`. A row is written as a whole, so columns never differ in
    length. Numbers of frames increase from row to row. Attributes: ``format`` and
    ``format_version``; ``columns``, ``units``, ``descriptions``; ``flag_masks`` and
    ``flag_meanings`` for the integer column ``flags``; ``conventions``, ``software`` and
    ``system_toml``; ``start_time_utc``; where known ``source`` and ``frame_rate_hz``; further
    texts as given.

The rows are not compressed: a part of a chunk that is written again in compressed form takes a
new place in the file, and a file flushed every second would hold most rows many times.
"""

from __future__ import annotations

import atexit
import math
import os
import threading
import time
import tomllib
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from rasnik._config import parse_overrides
from rasnik.instrument import System
from rasnik.io.file_lock import FileLock
from rasnik.io.hdf5 import append_rows, describe_table
from rasnik.io.hdf5_repair import clear_write_marks
from rasnik.io.results import file_metadata
from rasnik.tracking.track import TRACK_COLUMNS, Track

__all__ = [
    "HDF5_SUFFIXES",
    "ROW",
    "TrackWriter",
    "from_rows",
    "read_track_file",
    "track_metadata",
]

HDF5_SUFFIXES = (".h5", ".hdf5")

_FORMAT = "rasnik track"
_VERSION = 1
_TABLE = "track"
#: One row, as it is stored.
ROW = np.dtype([(column.name, column.dtype) for column in TRACK_COLUMNS])
_CHUNK_ROWS = 1024
#: No more rows than these wait in memory; `TrackWriter.write` itself stores them then.
_MOST_PENDING = 65_536
#: The format of HDF5 1.10, the first with SWMR: the widest choice of readers.
_LIBVER = "v110"
#: Attributes that describe the table and not what was measured.
_TABLE_ATTRIBUTES = {
    "format", "format_version", "columns", "units", "descriptions", "flag_masks", "flag_meanings",
}  # fmt: skip


def track_metadata(system: System | None, metadata: Mapping[str, str] | None) -> dict[str, str]:
    """What is stored beside a track: what is known by itself, and what is given."""
    taken = _TABLE_ATTRIBUTES & set(metadata or {})
    if taken:
        raise ValueError(f"metadata cannot be named {', '.join(sorted(taken))}; use other names")
    known = {**file_metadata(system), **(metadata or {})}
    if system is not None:
        known["system_toml"] = system.to_toml()
    return {key: str(value) for key, value in known.items()}


class TrackWriter:
    """Writes a track into an HDF5 file while it is measured; see the module for its layout.

    A context manager. Others can read the file at any time, with `rasnik.io.read_track`. What
    is written is in the file, for the case that this program is killed, within `flush_s`,
    whether or not more follows.

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
        Longest time between `write` and the file. With 0 every write waits for the disk.

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
            _create(self.path, about)
        self._lock = FileLock(self.path)
        try:
            self._file, self._rows, self._next_frame = _reopened(self.path, about)
        except BaseException:
            self._lock.release()
            raise
        self._lock.share()
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

    def write(self, track: Track) -> None:
        """Append the rows of a track; its metadata are not looked at.

        Raises
        ------
        ValueError
            If the numbers of the frames do not increase from row to row, those written before
            included, or the file is closed.
        OSError
            If rows could not be stored, these or earlier ones.
        """
        rows = np.empty(len(track), dtype=ROW)
        for name, values in track.as_dict().items():
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
            if self._wait_s == 0 or self._pending_rows >= _MOST_PENDING:
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
            for first in range(0, len(rows), _MOST_PENDING):
                append_rows(self._file[_TABLE], rows[first : first + _MOST_PENDING])
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


# ------------------------------------------------------------------------ making and continuing


def _create(path: Path, metadata: Mapping[str, str]) -> None:
    """A file without rows. It gets its name once it is complete: a kill leaves no half of it."""
    unfinished = path.with_name(path.name + ".new")
    with h5py.File(unfinished, "w", libver=_LIBVER, locking=False) as file:
        table = file.create_dataset(
            _TABLE,
            shape=(0,),
            maxshape=(None,),
            dtype=ROW,
            chunks=(_CHUNK_ROWS,),
            fillvalue=np.array((-1, *(0,) * (len(TRACK_COLUMNS) - 1)), dtype=ROW),
        )
        attributes = {"format": _FORMAT, "format_version": _VERSION, **metadata}
        describe_table(table, TRACK_COLUMNS, attributes)
    unfinished.replace(path)


def _reopened(path: Path, metadata: Mapping[str, str]) -> tuple[h5py.File, int, int]:
    """(file in SWMR mode, rows, next frame) of a file to append to, repaired if need be."""
    _check_same(path, read_track_file(path, stop=0).metadata, metadata)
    was_killed = clear_write_marks(path)
    file = h5py.File(path, "r+", libver=_LIBVER, locking=False)
    try:
        table = file[_TABLE]
        if table.dtype != ROW:
            raise ValueError(
                f"{path}: the columns are those of another version of this program; "
                "begin a new file"
            )
        rows = len(table)
        if was_killed:
            # More rows than are ever stored at a time.
            first = max(0, rows - 4 * _MOST_PENDING)
            rows = first + _whole_rows(table.fields("frame")[first:])
            table.resize((rows,))
        next_frame = int(table[rows - 1]["frame"]) + 1 if rows else 0
        file.swmr_mode = True
    except BaseException:
        file.close()
        raise
    return file, rows, next_frame


def _whole_rows(frame: NDArray[np.int64]) -> int:
    """Number of rows before the first that was announced but, after a kill, never written.

    In such rows the number of the frame is -1 or 0, so it does not increase.
    """
    bad = np.flatnonzero(np.diff(frame, prepend=-1) <= 0)
    return int(bad[0]) if len(bad) else len(frame)


def _check_same(path: Path, stored: Mapping[str, str], given: Mapping[str, str]) -> None:
    """Refuse to continue a track of another system or source.

    Raises
    ------
    ValueError
    """
    differences = _system_differences(stored.get("system_toml", ""), given.get("system_toml", ""))
    if stored.get("source", "") != given.get("source", ""):
        differences.append(_difference("source", stored.get("source"), given.get("source")))
    if differences:
        raise ValueError(
            f"{path} cannot be continued, it was made with another system or source: "
            f"{'; '.join(differences)}. Give another name, or what it was made with"
        )


def _difference(name: str, stored: object, given: object) -> str:
    texts = ["nothing" if value in (None, "") else repr(value) for value in (stored, given)]
    return f"{name} is {texts[0]} in the file, {texts[1]} now"


def _system_differences(stored: str, given: str) -> list[str]:
    """What differs between two systems in TOML, one sentence for each field."""
    if not stored or not given:
        before, now = (
            tomllib.loads(text).get("name") if text else None for text in (stored, given)
        )
        return [] if stored == given else [_difference("system", before, now)]
    fields: list[dict[str, Any]] = []
    for text in (stored, given):
        content = tomllib.loads(text)
        try:  # fields that an earlier version did not know get their defaults
            content = System.model_validate(content).model_dump(exclude_none=True)
        except ValidationError:
            pass
        fields.append(parse_overrides("", content))
    old, new = fields
    return [
        _difference(name, old.get(name), new.get(name))
        for name in {**old, **new}
        if name != "description" and old.get(name) != new.get(name)
    ]


# ------------------------------------------------------------------------ reading


def read_track_file(path: Path, start: int | None = None, stop: int | None = None) -> Track:
    """The rows of a file by `TrackWriter`, also one that is being written; see `read_track`."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    with _opened(path) as file:
        table = file.get(_TABLE)
        if not isinstance(table, h5py.Dataset) or table.attrs.get("format") != _FORMAT:
            raise ValueError(f"{path}: the HDF5 file holds no track")
        if table.attrs["format_version"] > _VERSION:
            raise ValueError(
                f"{path}: the track was written by a later version "
                f"({table.attrs.get('software')}); update rasnik to read it"
            )
        metadata = {
            key: str(value)
            for key, value in table.attrs.items()
            if key not in _TABLE_ATTRIBUTES and str(value)
        }
        try:
            rows = table[slice(*slice(start, stop).indices(len(table)))]
        except OSError as error:
            raise OSError(f"{path}: the file is damaged or incomplete ({error})") from error
    rows = rows[: _whole_rows(rows["frame"])]
    return from_rows(rows, metadata)


def from_rows(rows: NDArray[Any], metadata: Mapping[str, str] | None = None) -> Track:
    """A track from a structured array of type `ROW`."""
    columns: dict[str, Any] = {column.name: rows[column.name] for column in TRACK_COLUMNS}
    return Track(**columns, metadata=metadata or {})


def _opened(path: Path) -> h5py.File:
    """An HDF5 file for reading; a writer may be about to open or close it at this moment."""
    attempts = 10
    for attempt in range(attempts):
        try:
            return h5py.File(path, "r", swmr=True, locking=False)
        except OSError as error:
            if not h5py.is_hdf5(path):
                raise ValueError(f"{path}: this is not an HDF5 file") from error
            if attempt == attempts - 1 or "open for" not in str(error):
                raise OSError(f"{path}: the HDF5 file cannot be opened ({error})") from error
        time.sleep(0.1)
    raise AssertionError("not reached")
