"""Results in HDF5: one table, appended to row by row, readable while it grows (SWMR).

``/results``
    Compound table with one row for each image. A row is written as a whole, so columns never
    differ in length. Attributes: ``columns``, ``units``, ``descriptions``; ``flag_masks`` and
    ``flag_meanings`` for the integer column ``flags``; ``conventions``, ``software`` and
    ``system_toml`` (the system the images were analysed with).
``/texts``
    Fixed-length UTF-8 texts; the columns ``file``, ``error`` and ``notes`` of ``/results`` are
    indices into it, -1 for none. (Texts of variable length cannot be written in SWMR mode.)
``/candidates``
    Compound table of the poses that explain an ambiguous image: ``row`` of ``/results``, pose
    and log-odds.

Each record is flushed as it is written. Open a file that is being written, or whose writer was
killed, with ``h5py.File(path, "r", swmr=True)``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.flags import FLAGS
from rasnik.io.columns import COLUMNS, Column, check_record, flag_value
from rasnik.io.results import Record, ResultWriter, joined
from rasnik.tracking.track import TrackColumn

__all__ = ["Hdf5Writer", "append_rows", "describe_table", "read_hdf5"]

_TEXT_BYTES = 1024
_CHUNK_ROWS = 256
_TYPES = {"float": "f8", "int": "i8", "bool": "?", "flags": "u4", "word": "S16"}
_CANDIDATE = np.dtype(
    [
        ("row", "i8"),
        ("x_um", "f8"),
        ("y_um", "f8"),
        ("scale", "f8"),
        ("theta_rad", "f8"),
        ("orientation", "i8"),
        ("log_odds", "f8"),
    ]
)
_TABLE_COLUMNS = tuple(column for column in COLUMNS if column.name != "candidates")
#: Columns that are indices into /texts have the kinds left out of _TYPES.
_ROW = np.dtype([(column.name, _TYPES.get(column.kind, "i4")) for column in _TABLE_COLUMNS])


class Hdf5Writer(ResultWriter):
    """Writes records into a new HDF5 file; see the module for its layout."""

    def __init__(self, path: Path, metadata: dict[str, str]) -> None:
        self._file = h5py.File(path, "w", libver="latest")
        self._results = self._table("results", _ROW)
        self._texts = self._table("texts", np.dtype(f"S{_TEXT_BYTES}"), chunk_rows=32)
        self._candidates = self._table("candidates", _CANDIDATE, chunk_rows=32)
        self._known_texts: dict[str, int] = {}
        describe_table(self._results, _TABLE_COLUMNS, metadata)
        self._file.swmr_mode = True

    def _table(self, name: str, dtype: np.dtype[Any], chunk_rows: int = _CHUNK_ROWS) -> Any:
        return self._file.create_dataset(
            name, shape=(0,), maxshape=(None,), dtype=dtype, chunks=(chunk_rows,)
        )

    def _text_index(self, text: str | None) -> int:
        """Row of /texts holding a text, added if it is new."""
        if not text:
            return -1
        if text not in self._known_texts:
            encoded = text.encode()
            if len(encoded) > _TEXT_BYTES:
                cut = (_TEXT_BYTES - 5) // 2
                head, tail = encoded[:cut].decode(errors="ignore"), encoded[-cut:]
                encoded = f"{head} ... {tail.decode(errors='ignore')}".encode()[:_TEXT_BYTES]
            self._known_texts[text] = append_rows(self._texts, np.array([encoded], dtype="S"))
        return self._known_texts[text]

    def write(self, record: Record) -> None:
        check_record(record)
        row = np.zeros(1, dtype=_ROW)
        for column in _TABLE_COLUMNS:
            value = record.get(column.name)
            match column.kind:
                case "text" | "list":
                    row[column.name] = self._text_index(joined(value))
                case "flags":
                    row[column.name] = int(flag_value(value))
                case "word":
                    row[column.name] = (value or "").encode()
                case "float":
                    row[column.name] = np.nan if value is None else value
                case _:
                    row[column.name] = value or 0
        for candidate in record.get("candidates") or ():
            values = {"row": len(self._results), **candidate}
            line = tuple(np.nan if values[n] is None else values[n] for n in _CANDIDATE.names or ())
            append_rows(self._candidates, np.array([line], dtype=_CANDIDATE))
        # What the row refers to is on the disk before the row.
        append_rows(self._results, row)

    def close(self) -> None:
        self._file.close()


def describe_table(
    dataset: Any, columns: Sequence[Column | TrackColumn], metadata: Mapping[str, Any]
) -> None:
    """Say in attributes what the columns and flags of a table mean, and add the metadata."""
    attributes = dataset.attrs
    attributes["columns"] = [column.name for column in columns]
    attributes["units"] = [column.unit for column in columns]
    attributes["descriptions"] = [column.description for column in columns]
    attributes["flag_masks"] = np.array([int(info.flag) for info in FLAGS], dtype="u4")
    attributes["flag_meanings"] = " ".join(info.name for info in FLAGS)
    for key, value in metadata.items():
        attributes[key] = value


def append_rows(dataset: Any, rows: NDArray[Any]) -> int:
    """Add rows, flush them, and tell the index of the first."""
    index = len(dataset)
    dataset.resize((index + len(rows),))
    dataset[index:] = rows
    dataset.flush()
    return int(index)


def read_hdf5(path: Path) -> Iterator[dict[str, Any]]:
    """Records of a file by `Hdf5Writer`, also one that is being written.

    Raises
    ------
    ValueError
        If the file holds no results.
    OSError
        If it cannot be read.
    """
    with h5py.File(path, "r", swmr=True) as file:
        if not all(name in file for name in ("results", "texts", "candidates")):
            raise ValueError(f"{path}: the HDF5 file holds no results of an analysis")
        rows = file["results"][:]
        texts = [text.decode(errors="replace") for text in file["texts"][:]]
        candidates: dict[int, list[dict[str, Any]]] = {}
        for line in file["candidates"][:]:
            values = {name: line[name].item() for name in _CANDIDATE.names or ()}
            candidates.setdefault(values.pop("row"), []).append(values)
    kinds = {column.name: column.kind for column in COLUMNS}
    for number, row in enumerate(rows):
        record: dict[str, Any] = {}
        for name in rows.dtype.names:
            value = row[name].item()
            if kinds.get(name) in ("text", "list"):
                value = texts[value] if value >= 0 else None
            elif isinstance(value, bytes):
                value = value.decode()
            record[name] = value
        record["candidates"] = candidates.get(number)
        yield record
