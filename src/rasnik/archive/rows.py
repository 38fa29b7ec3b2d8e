"""Rows of a dataset, instrument by instrument, in batches that fit into memory.

The parts of the dataset are opened one by one, so that one that is damaged costs its own rows
only.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from rasnik.io.folders import natural_key

__all__ = ["NUMBERS", "Faults", "Part", "Rows", "instruments_of", "read_rows"]

#: Columns of numbers that a summary is made of.
NUMBERS = (
    *("time_s", "x_um", "y_um", "scale", "theta_rad"),
    *("sigma_x_um", "sigma_y_um", "sigma_scale", "sigma_theta_rad"),
    *("chi2_ndf", "blur_um", "dark_level", "light_level"),
)
_TEXTS = ("file", "frame", "error", "flags")
_BATCH_ROWS = 65_536
_NAMED = 20


@dataclass
class Faults:
    """What is wrong with a dataset, counted, and the first of each kind by name.

    Attributes
    ----------
    parts : Counter of str
        Number of parts by sentence of what is wrong with them.
    names : dict of str to list of str
        The first parts of each.
    """

    parts: Counter[str] = field(default_factory=Counter)
    names: dict[str, list[str]] = field(default_factory=dict)

    def add(self, sentence: str, part: str) -> None:
        """Count a part."""
        self.parts[sentence] += 1
        listed = self.names.setdefault(sentence, [])
        if len(listed) < _NAMED:
            listed.append(part)

    @property
    def sentences(self) -> list[str]:
        """One for each kind."""
        found = []
        for sentence, count in self.parts.items():
            named = ", ".join(self.names[sentence][:3])
            more = f" and {count - 3} more" if count > 3 else ""
            found.append(f"{sentence}: {named}{more}")
        return found


@dataclass(frozen=True)
class Part:
    """One Parquet file."""

    path: Path
    instrument: str
    day: str


@dataclass(frozen=True)
class Rows:
    """Some successive rows of one part.

    Attributes
    ----------
    numbers : dict of str to ndarray
        One array of floats for each of `NUMBERS`; NaN where a column is missing.
    ok : ndarray of bool
    follows : ndarray of bool
        Whether the row is of the image after that of the row before.
    flags : list or None
        A `pyarrow.Array` of lists of names; None if there is no such column.
    table : pyarrow.RecordBatch
        The rows as read.
    system_toml : str
        The system they were analysed with; empty if it is not stored.
    """

    numbers: dict[str, NDArray[np.float64]]
    ok: NDArray[np.bool_]
    follows: NDArray[np.bool_]
    flags: Any
    table: Any
    system_toml: str

    def __len__(self) -> int:
        return len(self.ok)

    def flagged(self, name: str) -> NDArray[np.int64]:
        """Indices of the rows that carry a flag."""
        from pyarrow import compute

        if self.flags is None:
            return np.empty(0, dtype=np.int64)
        rows = compute.list_parent_indices(self.flags)
        return np.asarray(rows.filter(compute.equal(self.flags.flatten(), name)), dtype=np.int64)

    def text(self, name: str, index: int) -> Any:
        """A value of one of the other columns; None if there is none."""
        return self.table.column(name)[index].as_py() if name in self.table.schema.names else None


def instruments_of(path: Path, faults: Faults) -> Iterator[tuple[str, list[Part]]]:
    """Every instrument with its parts, in natural order.

    Raises
    ------
    ValueError
        If the folder holds no dataset.
    """
    if not path.is_dir():
        raise ValueError(
            f"{path} is not the folder of a dataset; name what rasnik archive analyse -o wrote"
        )
    folders = sorted((e for e in os.scandir(path) if e.is_dir()), key=lambda e: natural_key(e.name))
    folders = [entry for entry in folders if entry.name.startswith("instrument=")]
    if not folders:
        raise ValueError(
            f"{path} holds no rows: there is no folder instrument=... in it; analyse images first, "
            "or name another"
        )
    for folder in folders:
        parts = list(_parts(Path(folder.path), unquote(folder.name.partition("=")[2]), faults))
        parts.sort(key=lambda part: (part.day, natural_key(part.path.name)))
        yield unquote(folder.name.partition("=")[2]), parts


def _parts(folder: Path, instrument: str, faults: Faults) -> Iterator[Part]:
    """Parts of an instrument; names that begin with _ or . are of files not finished."""
    days = [folder, *(Path(e.path) for e in os.scandir(folder) if e.is_dir())]
    for day in days:
        name = unquote(day.name.partition("=")[2]) if day is not folder else ""
        try:
            entries = [e for e in os.scandir(day) if e.name.endswith(".parquet")]
        except OSError as error:
            faults.add(f"a folder cannot be read ({error.strerror})", str(day))
            continue
        for entry in entries:
            if not entry.name.startswith(("_", ".")):
                yield Part(Path(entry.path), instrument, name)


def read_rows(part: Part, faults: Faults) -> Iterator[Rows]:
    """The rows of a part, as far as it can be read."""
    try:
        from pyarrow import parquet
    except ImportError:
        raise ImportError(
            'Parquet files need pyarrow; install it with: pip install "rasnik[archive]"'
        ) from None
    last: tuple[Any, int] | None = None
    count = 0
    try:
        with parquet.ParquetFile(part.path) as file:
            schema = file.schema_arrow
            _name_missing(schema.names, part, faults)
            if "ok" not in schema.names:
                return
            wanted = [name for name in (*NUMBERS, "ok", *_TEXTS) if name in schema.names]
            toml = (schema.metadata or {}).get(b"system_toml", b"").decode()
            for batch in file.iter_batches(_BATCH_ROWS, columns=wanted):
                rows, last = _rows(batch, toml, last)
                count += len(rows)
                yield rows
    except Exception as error:  # pyarrow has many kinds for what is damaged
        text = " ".join(str(error).split())[:120] or type(error).__name__
        some = f" after {count} rows" if count else ""
        faults.add(f"a part cannot be read{some} ({text}), analyse its images again", _name(part))


def _name(part: Part) -> str:
    return "/".join(part.path.parts[-3:])


def _name_missing(names: list[str], part: Part, faults: Faults) -> None:
    if "ok" not in names:
        faults.add("a part has no column ok, its rows are not counted", _name(part))
        return
    for name in (*NUMBERS, *_TEXTS):
        if name not in names:
            faults.add(f"a part has no column {name}, which counts as not known", _name(part))


def _rows(batch: Any, toml: str, last: tuple[Any, int] | None) -> tuple[Rows, tuple[Any, int]]:
    """Rows of a batch, and file and frame of its last one."""
    names = batch.schema.names
    unknown = np.full(batch.num_rows, np.nan)
    numbers = {
        name: np.asarray(batch.column(name).to_numpy(zero_copy_only=False), dtype=np.float64)
        if name in names
        else unknown
        for name in NUMBERS
    }
    ok = np.asarray(batch.column("ok").fill_null(False).to_numpy(zero_copy_only=False), dtype=bool)
    ok &= np.isfinite(numbers["x_um"]) | ("x_um" not in names)
    follows, last = _follows(batch, last)
    flags = batch.column("flags") if "flags" in names else None
    return Rows(numbers, ok, follows, flags, batch, toml), last


def _follows(batch: Any, last: tuple[Any, int] | None) -> tuple[NDArray[np.bool_], tuple[Any, int]]:
    """Where an image is the next one: the next frame of the file, or the first of the next file."""
    count = batch.num_rows
    if not {"file", "frame"} <= set(batch.schema.names) or not count:
        return np.zeros(count, dtype=bool), ("", -1)
    frame = np.asarray(batch.column("frame").fill_null(-1).to_numpy(zero_copy_only=False))
    coded = batch.column("file").dictionary_encode()
    file = np.asarray(coded.indices.fill_null(-1).to_numpy(zero_copy_only=False))
    same = np.concatenate([[False], file[1:] == file[:-1]])
    before = np.concatenate([[-2], frame[:-1]])
    if last is not None:
        same[0], before[0] = batch.column("file")[0].as_py() == last[0], last[1]
    follows = np.where(same, frame == before + 1, (frame == 0) & (before > -2))
    return follows, (batch.column("file")[count - 1].as_py(), int(frame[-1]))
