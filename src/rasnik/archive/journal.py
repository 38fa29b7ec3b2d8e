"""The journal of a dataset: which chunks are done, and with what settings.

JSON lines. The first says what the file is; then there is one for each chunk that is done, after
one for the settings that are used first with it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from rasnik import __version__
from rasnik.archive.done import unpack_spans

__all__ = [
    "JOURNAL",
    "DatasetError",
    "Line",
    "folder_name",
    "journal_of",
    "part_name",
    "prepare",
    "read_lines",
]

JOURNAL = "_journal.jsonl"  # readers of Parquet leave out names that begin with _ or .
_FORMAT = "rasnik archive 1"


class DatasetError(ValueError):
    """A folder that cannot be, or go on as, this dataset; says why and what to do."""


@dataclass(frozen=True)
class Line:
    """What the journal says of one chunk; settings by their key, parts as (day, rows, bytes)."""

    chunk: str
    instrument: str
    settings: str
    good: int
    failed: int
    seconds: float
    parts: tuple[tuple[str, int, int], ...]
    spans: str

    @property
    def paths(self) -> dict[str, int]:
        """Size of each part by its path below the dataset."""
        folder = folder_name(self.instrument)
        return {
            os.path.join(folder, part_name(day, self.chunk)): size for day, _, size in self.parts
        }


def journal_of(path: Path) -> Path:
    """The journal of a dataset; an empty one if there is none."""
    journal = path / JOURNAL
    if path.exists() and not path.is_dir():
        raise DatasetError(f"{path} is a file, not a folder with a dataset; name another")
    if not journal.exists():
        if path.exists() and any(path.iterdir()):
            raise DatasetError(
                f"{path} holds something else than a dataset of this program; name a new folder"
            )
        path.mkdir(parents=True, exist_ok=True)
        journal.touch()
    return journal


def prepare(path: Path, journal: Path) -> None:
    """Begin a journal, or see that it can be gone on with."""
    with journal.open("ab+") as file:
        file.seek(0)
        head = file.readline()
        if not head.endswith(b"\n"):  # new, or killed when it was
            file.truncate(0)
            file.write(json.dumps({"format": _FORMAT, "software": __version__}).encode() + b"\n")
            return
        file.seek(-1, os.SEEK_END)
        if file.read(1) != b"\n":  # a line that was being written
            file.write(b"\n")
    _check(path, head)


def _check(path: Path, head: bytes) -> None:
    try:
        about = json.loads(head)
        kind, version = about["format"], about["software"]
    except (ValueError, KeyError, TypeError):
        kind, version = None, None
    if kind != _FORMAT:
        raise DatasetError(f"{path / JOURNAL} is not the journal of a dataset; name a new folder")
    if version != __version__:
        raise DatasetError(
            f"{path} was begun with rasnik {version}, and this is {__version__}, whose results may "
            "differ; go on with that version, or name a new folder"
        )


def read_lines(journal: Path) -> Iterator[Line | str]:
    """Settings, and chunks that are done; a line that a crash has spoilt is left out."""
    with journal.open("rb") as file:
        next(file)
        for text in file:
            try:
                values = json.loads(text)
                if "values" in values:
                    yield str(values["values"])
                    continue
                line = Line(**{**values, "parts": tuple(map(tuple, values["parts"]))})
                unpack_spans(line.spans)
            except (ValueError, TypeError, KeyError):
                continue
            yield line


def folder_name(instrument: str) -> str:
    readable = instrument.encode(errors="backslashreplace")  # names of files need not be text
    return f"instrument={quote(readable, safe='')}"


def part_name(day: str, chunk: str) -> str:
    return os.path.join(f"day={day}", f"part-{chunk}.parquet")
