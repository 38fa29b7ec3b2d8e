"""Tracks in HDF5: one table that grows while others read it (SWMR).

``/track``
    Compound table with one row for each frame; the columns are those of
    `rasnik.tracking.track.TRACK_COLUMNS`, and perhaps more after them. A row is written as a
    whole, so columns never differ in length. Numbers of frames increase from row to row.
    Attributes: ``format`` and ``format_version``; ``columns``, ``units``, ``descriptions``;
    ``flag_masks`` and ``flag_meanings`` for the integer column ``flags``; ``conventions``,
    ``software`` and ``system_toml``; ``start_time_utc``; where known ``source`` and
    ``frame_rate_hz``; further texts as given.

The rows are not compressed: a part of a chunk that is written again in compressed form takes a
new place in the file, and a file flushed every second would hold most rows many times.
"""

from __future__ import annotations

import os
import time
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from rasnik._config import parse_overrides
from rasnik.instrument import System
from rasnik.io.hdf5 import describe_table
from rasnik.io.hdf5_repair import clear_write_marks
from rasnik.tracking.track import TRACK_COLUMNS, Track, TrackColumn

__all__ = [
    "MOST_ROWS",
    "ROW",
    "TABLE",
    "TABLE_ATTRIBUTES",
    "create_table",
    "for_appending",
    "from_rows",
    "in_memory",
    "read_rows",
    "read_table",
    "reopened",
    "row_type",
]

_FORMAT = "rasnik track"
_VERSION = 1
TABLE = "track"


def row_type(extra: Sequence[TrackColumn] = ()) -> np.dtype[Any]:
    """One row, as it is stored."""
    return np.dtype([(column.name, column.dtype) for column in (*TRACK_COLUMNS, *extra)])


#: A row of a track without further columns.
ROW = row_type()
_CHUNK_ROWS = 1024
#: No more rows than these are appended at a time.
MOST_ROWS = 65_536
#: The format of HDF5 1.10, the first with SWMR: the widest choice of readers.
_LIBVER = "v110"
#: Attributes that describe the table and not what was measured.
TABLE_ATTRIBUTES = {
    "format", "format_version", "columns", "units", "descriptions", "flag_masks", "flag_meanings",
}  # fmt: skip


# ------------------------------------------------------------------------ making and continuing


def create_table(
    path: Path, metadata: Mapping[str, str], extra: Sequence[TrackColumn] = ()
) -> None:
    """A file without rows. It gets its name once it is complete: a kill leaves no half of it."""
    unfinished = path.with_name(path.name + ".new")
    columns, row = (*TRACK_COLUMNS, *extra), row_type(extra)
    with in_memory(unfinished) as file:
        table = file.create_dataset(
            TABLE,
            shape=(0,),
            maxshape=(None,),
            dtype=row,
            chunks=(_CHUNK_ROWS,),
            fillvalue=np.array((-1, *(0,) * (len(columns) - 1)), dtype=row),
        )
        attributes = {"format": _FORMAT, "format_version": _VERSION, **metadata}
        describe_table(table, columns, attributes)
        file.flush()
        content = file.id.get_file_image()
    try:
        unfinished.write_bytes(content)
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def reopened(
    path: Path, metadata: Mapping[str, str], extra: Sequence[TrackColumn] = ()
) -> tuple[h5py.File, int, int]:
    """(file in SWMR mode, rows, next frame) of a file to append to, repaired if need be."""
    try:
        stored = read_table(path, start=-1).metadata
    except OSError:  # perhaps killed in `_cut`, the one state that SWMR readers refuse
        clear_write_marks(path)
        stored = read_table(path, start=-1).metadata
    _check_same(path, stored, metadata)
    clear_write_marks(path)
    with h5py.File(path, "r", locking=False) as file:
        table = file[TABLE]
        if table.dtype != row_type(extra):
            raise ValueError(
                f"{path}: the columns are others than those to be written, or of another "
                "version of this program; begin a new file"
            )
        announced = len(table)
        first = max(0, announced - 4 * MOST_ROWS)  # more rows than are stored at a time
        frame = table.fields("frame")[first:]
    rows = first + _whole_rows(frame)
    if rows < announced:
        _cut(path, rows)
    return for_appending(path), rows, int(frame[rows - 1 - first]) + 1 if rows else 0


def _cut(path: Path, rows: int) -> None:
    """Leave only the first rows of a table; not to be done in SWMR mode."""
    with h5py.File(path, "r+", libver=_LIBVER, locking=False) as file:
        file[TABLE].resize((rows,))


def in_memory(path: Path) -> h5py.File:
    """A file that is in memory only: should the disk be full, the library does not get to know.

    ``file.id.get_file_image()`` gives the bytes to write to the path. Two of the same path would
    be one to the library.
    """
    return h5py.File(
        str(path), "w", driver="core", backing_store=False, libver=_LIBVER, locking=False
    )


def for_appending(path: Path) -> h5py.File:
    """The file in SWMR mode from the first moment, so that others can read it even now."""
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_V110, h5py.h5f.LIBVER_LATEST)
    access.set_file_locking(False, True)
    mode = h5py.h5f.ACC_RDWR | h5py.h5f.ACC_SWMR_WRITE
    return h5py.File(h5py.h5f.open(os.fsencode(path), mode, fapl=access))


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


def read_table(path: Path, start: int | None = None, stop: int | None = None) -> Track:
    """The rows of a file by `TrackWriter`, also one that is being written; see `read_track`."""
    return from_rows(*read_rows(path, start, stop))


def read_rows(
    path: Path, start: int | None = None, stop: int | None = None
) -> tuple[NDArray[Any], dict[str, str]]:
    """Rows of a file with all of their columns, and its metadata; see `read_track`.

    Parameters
    ----------
    path : Path
        A file by `TrackWriter`, also one that is being written or whose writer was killed.
    start, stop : int, optional
        Rows as in ``rows[start:stop]``.

    Returns
    -------
    rows : ndarray
        Structured, with the columns of a track and those that the writer added.
    metadata : dict of str
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    with _for_reading(path) as file:
        try:
            rows, metadata = _content(path, file, start, stop)
        except (OSError, RuntimeError, KeyError) as error:
            raise OSError(f"{path}: the file is damaged or incomplete ({error})") from error
    return rows[: _whole_rows(rows["frame"])], metadata


def _content(
    path: Path, file: h5py.File, start: int | None, stop: int | None
) -> tuple[NDArray[Any], dict[str, str]]:
    """(rows, metadata) of an open file."""
    table = file.get(TABLE)
    if not isinstance(table, h5py.Dataset) or table.attrs.get("format") != _FORMAT:
        raise ValueError(f"{path}: the HDF5 file holds no track")
    if table.attrs["format_version"] > _VERSION:
        raise ValueError(
            f"{path}: the track was written by a later version "
            f"({table.attrs.get('software')}); update rasnik to read it"
        )
    missing = [name for name in ROW.names or () if name not in (table.dtype.names or ())]
    if missing:
        raise ValueError(f"{path}: columns of the track are missing: {', '.join(missing)}")
    metadata = {
        key: str(value)
        for key, value in table.attrs.items()
        if key not in TABLE_ATTRIBUTES and str(value)
    }
    first, last, _ = slice(start, stop).indices(len(table))
    if first < last:
        _check_complete(path, table, last)
    return table[first:last], metadata


def _check_complete(path: Path, table: h5py.Dataset, rows: int) -> None:
    """Refuse a file that ends before its rows do; in SWMR mode the library reads zeros there.

    Raises
    ------
    OSError
    """
    chunk = table.id.get_chunk_info_by_coord(((rows - 1) // _CHUNK_ROWS * _CHUNK_ROWS,))
    if chunk.byte_offset is not None and chunk.byte_offset + chunk.size > path.stat().st_size:
        raise OSError("it ends before its last row; was it copied as a whole?")


def from_rows(rows: NDArray[Any], metadata: Mapping[str, str] | None = None) -> Track:
    """A track from a structured array that has the columns of `ROW`."""
    columns: dict[str, Any] = {column.name: rows[column.name] for column in TRACK_COLUMNS}
    return Track(**columns, metadata=metadata or {})


def _for_reading(path: Path) -> h5py.File:
    """An HDF5 file for reading; a writer may be about to open or close it at this moment."""
    attempts = 10
    for attempt in range(attempts):
        try:
            return h5py.File(path, "r", swmr=True, locking=False)
        except OSError as error:
            if not h5py.is_hdf5(path):
                raise ValueError(f"{path}: this is not an HDF5 file") from error
            marked = "open for" in str(error)
            if attempt == attempts - 1 or not marked:
                remedy = "; if nobody is writing it, TrackWriter(..., resume=True) repairs it"
                raise OSError(
                    f"{path}: the HDF5 file cannot be opened ({error}){remedy if marked else ''}"
                ) from error
        time.sleep(0.1)
    raise AssertionError("not reached")
