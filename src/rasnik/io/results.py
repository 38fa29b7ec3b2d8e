"""Writing and reading results, one record for each image, in the format the suffix names.

========== ============================================================================
``.jsonl`` JSON lines; what is not known is null
``.csv``   one row for each image; what is not known is empty
``.h5``    HDF5 (see `rasnik.io.hdf5`), readable by others while it is written
``.parquet`` Parquet (see `rasnik.io.parquet`); needs ``pip install "rasnik[parquet]"``
========== ============================================================================

The columns are those of `rasnik.io.columns.COLUMNS` in all of them. Lines of ICARAS
(``.icaras``) are written and read too, those of LWDAQ (``.txt``) read; they hold some of the
columns, see `rasnik.io.icaras` and `rasnik.io.lwdaq_results`. Every record is on its way
to the disk when `write` returns: a killed program loses none.
"""

from __future__ import annotations

import csv
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TextIO

import numpy as np
from numpy.typing import NDArray

from rasnik import __version__
from rasnik.io.columns import COLUMNS, CONVENTIONS, check_record, flag_value, plain
from rasnik.io.line_file import LineFile

if TYPE_CHECKING:
    from rasnik.instrument import System

__all__ = [
    "LINE_SUFFIXES",
    "RESULT_SUFFIXES",
    "CsvWriter",
    "JsonLinesWriter",
    "ResultWriter",
    "as_records",
    "file_metadata",
    "open_results",
    "read_results",
]

Record = Mapping[str, Any]

#: Formats that hold every column.
RESULT_SUFFIXES = (".jsonl", ".csv", ".h5", ".hdf5", ".parquet")
#: Formats of other programs, which hold some of them: lines of LWDAQ and of ICARAS.
LINE_SUFFIXES = (".txt", ".icaras")


class ResultWriter(ABC):
    """Where records go; a context manager that closes the file."""

    @abstractmethod
    def write(self, record: Record) -> None:
        """Store one record; raises ValueError if it holds keys that are not columns."""

    @abstractmethod
    def close(self) -> None:
        """Complete the file."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class JsonLinesWriter(LineFile, ResultWriter):
    """One JSON object per line; NaN and infinities are null. Takes a path or an open text file."""

    def write(self, record: Record) -> None:
        check_record(record)
        self.put(json_line(record))


class CsvWriter(LineFile, ResultWriter):
    """Comma-separated values with a header line. Takes a path or an open text file."""

    def __init__(self, target: str | os.PathLike[str] | TextIO) -> None:
        super().__init__(target)
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._rows.writerow([column.name for column in COLUMNS])

    def write(self, record: Record) -> None:
        check_record(record)
        self._rows.writerow([_csv_cell(record.get(column.name), column.name) for column in COLUMNS])
        self._file.flush()


def json_line(record: Record) -> str:
    values = {key: plain(value) for key, value in record.items()}
    if "flags" in values:
        values["flags"] = flag_value(values["flags"]).names
    return json.dumps(values, allow_nan=False, ensure_ascii=False) + "\n"


def _csv_cell(value: Any, name: str) -> Any:
    value = plain(value)
    if name == "flags":
        return " ".join(flag_value(value).names)
    if name == "candidates":
        return json.dumps(value) if value else None
    if name == "notes":
        return joined(value)
    return str(value).lower() if isinstance(value, bool) else value


def joined(notes: Iterable[str] | str | None) -> str | None:
    """Notes as one text."""
    if notes is None or isinstance(notes, str):
        return notes or None
    return "; ".join(notes) or None


def file_metadata(system: System | None) -> dict[str, str]:
    """What is stored beside the results: software, conventions, the system as TOML."""
    return {
        "software": f"rasnik {__version__}",
        "conventions": CONVENTIONS,
        "system_toml": system.to_toml() if system is not None else "",
    }


def open_results(path: str | os.PathLike[str], *, system: System | None = None) -> ResultWriter:
    """A writer for the format that the suffix names; an existing file is replaced.

    Parameters
    ----------
    path : path-like
        Ends in one of `RESULT_SUFFIXES`, or in ``.icaras``.
    system : System, optional
        Stored as TOML in HDF5 and Parquet files.

    Returns
    -------
    ResultWriter

    Raises
    ------
    ValueError
        If the suffix is not known.
    OSError
        If the file cannot be written.
    ImportError
        If the format needs an extra that is not installed.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".jsonl":
            return JsonLinesWriter(path)
        case ".csv":
            return CsvWriter(path)
        case ".h5" | ".hdf5":
            from rasnik.io.hdf5 import Hdf5Writer

            return Hdf5Writer(path, file_metadata(system))
        case ".parquet":
            from rasnik.io.parquet import ParquetWriter

            return ParquetWriter(path, file_metadata(system))
        case ".icaras":
            from rasnik.io.icaras import IcarasWriter

            return IcarasWriter(path)
        case ".txt":
            raise ValueError(
                f"{path}: lines of LWDAQ need the sizes of field, pixel and image, which results "
                "do not hold; rasnik analyse writes them"
            )
    raise ValueError(_unknown_suffix(path))


def _unknown_suffix(path: Path) -> str:
    return (
        f"{path}: {path.suffix or 'no suffix'} is not a format of results; "
        f"end the name in one of {', '.join((*RESULT_SUFFIXES, *LINE_SUFFIXES))}"
    )


# ------------------------------------------------------------------------ reading


def read_results(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """Results as one array per column, the same for every format.

    Parameters
    ----------
    path : path-like
        A file written by `open_results`, also one whose writer was killed or still runs; or,
        ending in ``.txt``, lines of LWDAQ (`rasnik.io.lwdaq_results`).

    Returns
    -------
    dict of ndarray, shape (images,)
        Keys are the names in `COLUMNS`. Floats (NaN: not known), int64, bool; ``flags`` as
        integers (see `rasnik.analysis.flags.Flag`); texts as objects (str or None), notes
        joined by ``"; "``; ``candidates`` as lists of dict.

    Raises
    ------
    ValueError
        If the suffix is not known or the content is not that of results.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".jsonl":
            return to_arrays(read_json_lines(path))
        case ".csv":
            return to_arrays(_read_csv(path))
        case ".h5" | ".hdf5":
            from rasnik.io.hdf5 import read_hdf5

            return to_arrays(read_hdf5(path))
        case ".parquet":
            from rasnik.io.parquet import read_parquet

            return to_arrays(read_parquet(path))
        case ".icaras":
            from rasnik.io.icaras import icaras_records

            return to_arrays(icaras_records(path))
        case ".txt":
            from rasnik.io.lwdaq_results import read_lwdaq_results

            return to_arrays(read_lwdaq_results(path))
    raise ValueError(_unknown_suffix(path))


def read_json_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Records of a JSON lines file; a last line that was cut off is left out."""
    with path.open(encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            try:
                record = json.loads(line)
            except ValueError:
                if not line.endswith("\n"):
                    return
                raise ValueError(f"{path}: line {number} is not JSON; check the file") from None
            if not isinstance(record, dict):
                raise ValueError(f"{path}: line {number} is not a JSON object; check the file")
            yield record


def _read_csv(path: Path) -> Iterator[dict[str, Any]]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        if not rows.fieldnames or "x_um" not in rows.fieldnames:
            raise ValueError(f"{path}: this is not a table of results; its columns differ")
        for row in rows:
            yield {key: value or None for key, value in row.items()}


def to_arrays(records: Iterable[Record]) -> dict[str, NDArray[Any]]:
    """One array per column from records of numbers or of their texts."""
    rows = list(records)
    columns: dict[str, NDArray[Any]] = {}
    for column in COLUMNS:
        values = [row.get(column.name) for row in rows]
        match column.kind:
            case "float":
                filled = [np.nan if value is None else float(value) for value in values]
                columns[column.name] = np.array(filled, dtype=np.float64)
            case "int":
                columns[column.name] = np.array([int(v or 0) for v in values], dtype=np.int64)
            case "bool":
                truth = [value in (True, "true") for value in values]
                columns[column.name] = np.array(truth, dtype=bool)
            case "flags":
                flags = [int(flag_value(value)) for value in values]
                columns[column.name] = np.array(flags, dtype=np.uint32)
            case "list" if column.name == "candidates":
                columns[column.name] = _objects(_candidates(value) for value in values)
            case "list":
                columns[column.name] = _objects(joined(value) for value in values)
            case _:
                columns[column.name] = _objects(value or None for value in values)
    return columns


def as_records(arrays: Mapping[str, NDArray[Any]]) -> Iterator[dict[str, Any]]:
    """Records from the arrays of `to_arrays`."""
    for row in zip(*(arrays[column.name] for column in COLUMNS), strict=True):
        record = {column.name: plain(value) for column, value in zip(COLUMNS, row, strict=True)}
        notes, candidates = record.pop("notes"), record.pop("candidates")
        if notes:
            record["notes"] = notes.split("; ")
        if candidates:
            record["candidates"] = [
                {key: plain(value) for key, value in candidate.items()} for candidate in candidates
            ]
        yield record


def _candidates(value: str | list[Record] | None) -> list[dict[str, Any]]:
    listed = json.loads(value) if isinstance(value, str) else value or []
    return [
        {
            key: int(number) if key == "orientation" else float("nan" if number is None else number)
            for key, number in candidate.items()
        }
        for candidate in listed
    ]


def _objects(values: Iterable[Any]) -> NDArray[Any]:
    items = list(values)
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array
