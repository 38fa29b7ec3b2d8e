"""The results of an archive: Parquet by instrument and day, and a journal of what is done.

One process writes a dataset at a time, and it alone. The parts of a chunk are written first,
each under another name and then renamed; then one line is added to the journal. A part that no
line of the journal names is of a chunk that was not finished: it is removed when the dataset is
opened again, and the chunk done again. So every image has one row, whatever is killed and when.
Parts of more than one such chunk are not from a kill, and are kept under another name.
A chunk of which a part is missing or cut off counts as not done either.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from hashlib import blake2b
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rasnik.archive.done import DoneFrames, pack_spans, unpack_spans
from rasnik.archive.journal import (
    JOURNAL,
    DatasetError,
    Line,
    folder_name,
    journal_of,
    part_name,
    prepare,
    read_lines,
)
from rasnik.archive.systems_table import InstrumentSettings
from rasnik.archive.work import Part, Result, Work
from rasnik.io.file_lock import FileLock

__all__ = ["Dataset", "DatasetError", "Totals", "open_dataset"]

_UNFINISHED = "_unfinished-"
_PART = re.compile(rf"({_UNFINISHED})?part-[0-9a-f]+\.parquet")
_WRITERS = 8
_LONGEST_NAME = 255  # bytes, of a folder on nearly every disk


@dataclass(frozen=True)
class Totals:
    """How many images of an instrument have rows, and what they took.

    Attributes
    ----------
    good, failed : int
        Images with a position, and without.
    seconds : float
        Time of the workers.
    """

    good: int = 0
    failed: int = 0
    seconds: float = 0.0

    @property
    def images(self) -> int:
        return self.good + self.failed

    def __add__(self, other: Totals) -> Totals:
        good, failed = self.good + other.good, self.failed + other.failed
        return Totals(good, failed, self.seconds + other.seconds)


def _values(settings: InstrumentSettings, track: bool) -> str:
    """All that decides how images of an instrument are analysed, as text."""
    about = {
        "system": settings.system.to_toml(),
        "model": settings.model,
        "orientation": settings.orientation,
        "frame rate": settings.frame_rate_hz,
        "tracking": track,
    }
    return json.dumps(about)


def _key(values: str) -> str:
    return blake2b(values.encode(), digest_size=8).hexdigest()


class Dataset:
    """A dataset that is being written.

    Parameters
    ----------
    path : Path
        A folder; made if it is not there.

    Attributes
    ----------
    done : DoneFrames
        What had rows when it was opened.
    totals : dict of str to Totals
        By instrument, of all runs.
    removed : int
        Parts of chunks that were not finished, removed on opening.
    set_aside : int
        Parts that a damaged journal does not name, renamed on opening.

    Raises
    ------
    DatasetError
        If the folder holds something else, or was written by another version of the package.
    BlockingIOError
        If another program writes it.
    OSError
        If it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.done = DoneFrames()
        self.totals: dict[str, Totals] = {}
        self._instruments: dict[str, str] = {}  # and the key of their settings
        self._settings: dict[str, str] = {}  # by key
        self.removed = self.set_aside = 0
        journal = journal_of(path)
        self._lock = FileLock(journal)
        try:
            prepare(path, journal)
            self._read(journal)
            self._journal = journal.open("ab")
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let others write it."""
        with suppress(OSError):  # of a line that did not fit on the disk, which was told then
            self._journal.close()
        self._lock.release()

    def _read(self, journal: Path) -> None:
        """What is done; and clear away what is not."""
        there = dict(_parts(self.path))
        whole: set[str] = set()
        named: set[str] = set()
        for line in read_lines(journal):
            if isinstance(line, str):
                self._settings[_key(line)] = line
                continue
            paths = line.paths
            if line.settings not in self._settings:
                continue
            named.update(paths)
            if all(there.get(path) == size for path, size in paths.items()):
                whole.update(paths)
                self.done.add(unpack_spans(line.spans))
                self._count(line)
        self._clear([path for path in there if path not in whole], named)

    def _clear(self, spare: list[str], named: set[str]) -> None:
        """Take away parts that do not count.

        A chunk is written down before the next is begun, so that a run that was killed leaves
        the parts of one. Where there are more, it is the journal that is damaged: those parts
        are whole, and their images may be gone.
        """
        unknown = {
            path
            for path in spare
            if path not in named and not os.path.basename(path).startswith(_UNFINISHED)
        }
        damaged = len(set(map(os.path.basename, unknown))) > 1
        for path in spare:
            file = self.path / path
            if damaged and path in unknown:
                file.replace(file.with_name(f"_{file.name}.aside"))
                self.set_aside += 1
            else:
                file.unlink()
                self.removed += 1

    def _count(self, line: Line) -> None:
        new = Totals(line.good, line.failed, line.seconds)
        self.totals[line.instrument] = self.totals.get(line.instrument, Totals()) + new
        if line.parts:  # else no row was made with them
            self._instruments[line.instrument] = line.settings

    def folder_of(self, instrument: str) -> Path:
        """Where the rows of an instrument are.

        Raises
        ------
        DatasetError
            If its name is too long for a folder.
        """
        folder = folder_name(instrument)
        if len(folder) > _LONGEST_NAME:
            raise DatasetError(
                f"the name {instrument} is too long for a folder of the dataset, in which letters "
                "other than ASCII take 6 to 12 places; rename it, or take a part with --pattern"
            )
        return self.path / folder

    def differences(self, instrument: str, settings: InstrumentSettings, track: bool) -> list[str]:
        """Names of settings that its rows were made with other values of; none without rows."""
        if instrument not in self._instruments:
            return []
        before = json.loads(self._settings[self._instruments[instrument]])
        now = json.loads(_values(settings, track))
        return [key for key in now if before.get(key) != now[key]]

    def store(self, work: Work, result: Result) -> None:
        """Write the rows of a chunk, then that it is done.

        Raises
        ------
        DatasetError
            If the disk does not take them; what was stored before is not harmed.
        """
        try:
            self._store(work, result)
        except OSError as error:
            raise DatasetError(
                f"{self.path} cannot be written ({error.strerror or error}); once it can, the same "
                "command goes on"
            ) from error

    def _store(self, work: Work, result: Result) -> None:
        chunk = work.chunk
        folder = self.folder_of(chunk.instrument)
        with ThreadPoolExecutor(_WRITERS) as pool:  # each waits for the disk
            list(pool.map(lambda part: _write(folder, chunk.name, part), result.parts))
        line = Line(
            chunk.name,
            chunk.instrument,
            self._key_of(_values(work.settings, work.track)),
            result.good,
            result.failed,
            round(result.seconds, 3),
            tuple((part.day, part.rows, len(part.data)) for part in result.parts),
            pack_spans(s.done(n) for s, n in zip(chunk.spans, result.found, strict=True)),
        )
        self._add_line(asdict(line))
        self._count(line)

    def _key_of(self, values: str) -> str:
        """The key of settings, which are written down when they are used first."""
        key = _key(values)
        if key not in self._settings:
            self._add_line({"values": values})
            self._settings[key] = values
        return key

    def _add_line(self, content: dict[str, Any]) -> None:
        self._journal.write(json.dumps(content).encode() + b"\n")
        self._journal.flush()
        os.fsync(self._journal.fileno())


def _write(folder: Path, chunk: str, part: Part) -> None:
    """Write a part, complete or not at all."""
    path = folder / part_name(part.day, chunk)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(_UNFINISHED + path.name)
    with unfinished.open("wb") as file:
        file.write(part.data)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)


# ------------------------------------------------------------------------ files


def _parts(path: Path) -> Iterator[tuple[str, int]]:
    """(path below the dataset, bytes) of every part there is, unfinished ones too."""

    def refuse(error: OSError) -> None:
        raise error  # parts that are not seen would be done once more

    for folder, _, names in os.walk(path, onerror=refuse, followlinks=True):
        for name in names:
            file = os.path.join(folder, name)
            if _PART.fullmatch(name):
                yield os.path.relpath(file, path), os.stat(file).st_size
            elif name.endswith(".parquet"):
                raise DatasetError(
                    f"{file} was not written by this program, and would be counted with the "
                    "rest; move it out of the dataset"
                )


# ------------------------------------------------------------------------ reading


def open_dataset(path: str | os.PathLike[str]) -> Any:
    """A dataset of an archive as a `pyarrow.dataset.Dataset`.

    Instruments are text, also where their names are numbers.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    DatasetError
        If there is none.
    ImportError
        If pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import dataset
    except ImportError:
        raise ImportError(
            'datasets need pyarrow; install it with: pip install "rasnik[archive]"'
        ) from None
    if not (Path(path) / JOURNAL).exists():
        raise DatasetError(f"{path} holds no dataset of an archive; check the name")
    names = pyarrow.schema([(name, pyarrow.string()) for name in ("instrument", "day")])
    layout = dataset.partitioning(names, flavor="hive")
    opened = dataset.dataset(str(path), format="parquet", partitioning=layout)
    return opened.replace_schema(opened.schema.remove_metadata())
