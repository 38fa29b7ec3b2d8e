"""Results in Parquet, for archives.

A Parquet file is complete only once it is closed, so the records go to
``NAME.parquet.partial.jsonl`` first and are turned into ``NAME.parquet`` at the end. After a
crash that file holds every record; `rasnik.io.results.read_results` reads it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from rasnik.io.columns import COLUMNS, Column, flag_value
from rasnik.io.results import JsonLinesWriter, Record, ResultWriter, joined, read_json_lines
from rasnik.tracking.track import TrackColumn

try:
    import pyarrow
    from pyarrow import parquet
except ImportError as error:
    raise ImportError(
        'Parquet files need pyarrow; install it with: pip install "rasnik[parquet]"'
    ) from error

__all__ = [
    "ParquetWriter",
    "partial_path",
    "read_columns",
    "read_parquet",
    "record_schema",
    "record_table",
    "write_columns",
]

_BATCH_ROWS = 50_000


def partial_path(path: Path) -> Path:
    """Where the records are kept until the Parquet file is complete."""
    return path.with_name(path.name + ".partial.jsonl")


def record_schema(metadata: Mapping[str, str], more: Sequence[Column] = ()) -> Any:
    """Arrow schema of records, with further columns if there are any."""
    candidate = pyarrow.struct(
        [
            (name, pyarrow.int64() if name == "orientation" else pyarrow.float64())
            for name in ("x_um", "y_um", "scale", "theta_rad", "orientation", "log_odds")
        ]
    )
    types = {
        "float": pyarrow.float64(),
        "int": pyarrow.int64(),
        "bool": pyarrow.bool_(),
        "flags": pyarrow.list_(pyarrow.string()),
    }
    fields = []
    for column in (*COLUMNS, *more):
        kind = types.get(column.kind, pyarrow.string())
        if column.name == "candidates":
            kind = pyarrow.list_(candidate)
        fields.append(_field(column, kind))
    return pyarrow.schema(fields, metadata=dict(metadata))


def _field(column: Column | TrackColumn, kind: Any) -> Any:
    """A column of a table, with its unit and meaning."""
    about = {"unit": column.unit, "description": column.description}
    return pyarrow.field(column.name, kind, metadata=about)


def record_table(records: Iterable[Record], schema: Any) -> Any:
    """Arrow table of records, with the columns of a schema by `record_schema`."""
    return pyarrow.Table.from_pylist([_row(r, schema.names) for r in records], schema=schema)


def _row(record: Record, names: Iterable[str]) -> dict[str, Any]:
    row = {name: record.get(name) for name in names}
    row["flags"] = flag_value(row["flags"]).names
    row["notes"] = joined(row["notes"])
    return row


class ParquetWriter(ResultWriter):
    """Writes records, and on closing the Parquet file; see the module."""

    def __init__(self, path: Path, metadata: dict[str, str]) -> None:
        self._path, self._metadata = path, metadata
        partial = partial_path(path)
        if partial.exists():
            raise FileExistsError(
                f"{partial} is left from a run that was cut off; keep what it holds "
                "(it is a file of results like any other) or delete it, then start again"
            )
        self._lines = JsonLinesWriter(partial)

    def write(self, record: Record) -> None:
        self._lines.write(record)

    def close(self) -> None:
        self._lines.close()
        partial = partial_path(self._path)
        unfinished = self._path.with_name(self._path.name + ".partial")
        schema = record_schema(self._metadata)
        with parquet.ParquetWriter(unfinished, schema) as writer:
            records = read_json_lines(partial)
            while rows := list(islice(records, _BATCH_ROWS)):
                writer.write_table(record_table(rows, schema))
        unfinished.replace(self._path)
        partial.unlink()


def read_parquet(path: Path) -> Iterator[dict[str, Any]]:
    """Records of a file by `ParquetWriter`.

    Raises
    ------
    ValueError
        If the file is not Parquet or holds no results.
    """
    try:
        with parquet.ParquetFile(path) as file:
            if "x_um" not in file.schema_arrow.names:
                raise ValueError(f"{path}: the Parquet file holds no results of an analysis")
            for batch in file.iter_batches():
                yield from batch.to_pylist()
    except pyarrow.ArrowInvalid as error:
        raise ValueError(f"{path}: this is not a complete Parquet file ({error})") from error


def write_columns(
    path: Path,
    columns: Sequence[TrackColumn],
    arrays: Mapping[str, NDArray[Any]],
    metadata: Mapping[str, str],
) -> None:
    """Write arrays of numbers as a Parquet file, in the order of `columns`."""
    fields = [_field(c, pyarrow.from_numpy_dtype(arrays[c.name].dtype)) for c in columns]
    schema = pyarrow.schema(fields, metadata=dict(metadata))
    parquet.write_table(pyarrow.table([arrays[c.name] for c in columns], schema=schema), path)


def read_columns(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """(arrays, metadata) of a Parquet file.

    Raises
    ------
    ValueError
        If the file is not Parquet.
    """
    try:
        table = parquet.read_table(path)
    except pyarrow.ArrowInvalid as error:
        raise ValueError(f"{path}: this is not a complete Parquet file ({error})") from error
    metadata = {
        key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()
    }
    return {name: table.column(name).to_numpy() for name in table.column_names}, metadata
