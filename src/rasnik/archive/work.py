"""One chunk of an archive: images in, rows out. This is what runs in the worker processes.

The rows go back as finished Parquet files in memory, one for each day. A worker writes nothing
to any disk, so that one that is killed, or one that goes on after its run has ended, leaves
nothing behind.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rasnik import __version__
from rasnik.archive.plan import Chunk, Span
from rasnik.archive.sources import frames_of
from rasnik.archive.systems_table import InstrumentSettings
from rasnik.io.analysed import AnalysisOptions, analysed
from rasnik.io.columns import Column, make_record
from rasnik.io.folders import is_url
from rasnik.io.images import Frame

if TYPE_CHECKING:
    from rasnik.analysis.pose import Pose
    from rasnik.tracking.tracker import Tracker

__all__ = [
    "TIME_COLUMNS",
    "UNKNOWN_DAY",
    "Part",
    "Poses",
    "Result",
    "Work",
    "WorkerError",
    "analyse_chunk",
    "lost_image",
]

#: Columns of an archive beside those of every table of results.
TIME_COLUMNS = (
    Column("time_s", "float", "s", "when the image was taken, since 1970 UTC"),
    Column("time_source", "word", "", "where that is from: metadata, name, modified"),
)
#: In place of a date, where no time is known.
UNKNOWN_DAY = "unknown"

_IN_VAIN = 4  # frames in a row that tracking did not help with before it is left for a while
_LONGEST_LEAVE = 256  # frames


class WorkerError(RuntimeError):
    """A worker that cannot do this work at all, whatever the images; says what to do."""


@dataclass(frozen=True)
class Work:
    """A chunk, and how its images are analysed.

    Attributes
    ----------
    chunk : Chunk
    settings : InstrumentSettings
    track : bool
        Whether the mask is followed from frame to frame.
    software : str
        Version of this package that asks for it.
    """

    chunk: Chunk
    settings: InstrumentSettings
    track: bool = True
    software: str = __version__


@dataclass(frozen=True)
class Part:
    """The rows of one day, as the content of a Parquet file."""

    day: str
    rows: int
    data: bytes


@dataclass(frozen=True)
class Result:
    """What came out of a chunk.

    Attributes
    ----------
    found : tuple of int
        Rows of each of its spans.
    good, failed : int
        Images with a position, and without.
    seconds : float
        Time of the worker.
    parts : tuple of Part
    """

    found: tuple[int, ...]
    good: int
    failed: int
    seconds: float
    parts: tuple[Part, ...]


def analyse_chunk(work: Work) -> Result:
    """Analyse every image of a chunk.

    Raises
    ------
    WorkerError
        If this process has another version of the package, or does not see the files. Nothing
        that is wrong with an image raises: it becomes a row.
    """
    start_s = time.perf_counter()
    _check_worker(work)
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # faults come out as errors
    poses = Poses(work.settings, work.track)
    rows = _Rows(work.settings)
    found = []
    for span in work.chunk.spans:
        before = rows.count
        for frame in _frames(span):
            rows.add(frame, *poses.of(frame))
        found.append(rows.count - before)
    return rows.result(tuple(found), start_s)


def lost_image(work: Work) -> Result:
    """The row of an image that ended the processes that were to analyse it; it is not opened."""
    (span,) = work.chunk.spans
    rows = _Rows(work.settings)
    name = f"{span.item.name}[{span.start}]" if span.start else span.item.name
    sentence = (
        f"{name}: the process that analysed this image ended, and so did others that were given "
        "it alone; look at its size and whether the memory suffices, or whether it is damaged."
    )
    frame = Frame(span.item.name, span.start, error=sentence)
    rows.add(_with_time(frame, span), None, sentence)
    return rows.result((1,), time.perf_counter())


def _check_worker(work: Work) -> None:
    if work.software != __version__:
        raise WorkerError(
            f"a worker has rasnik {__version__}, and this is {work.software}; install the same "
            "version for all"
        )
    item = work.chunk.spans[0].item
    folder = Path(item.url).parent
    if not is_url(item.url) and not folder.is_dir():
        raise WorkerError(
            f"a worker does not see the folder {folder}; mount it there under the same name, or "
            "put it back"
        )


# ------------------------------------------------------------------------ frames


def _frames(span: Span) -> Iterator[Frame]:
    """The frames of a span; what cannot be read is a frame with an error."""
    count = None if span.stop is None else span.stop - span.start
    number = span.start
    try:
        for frame in islice(frames_of(span.item, span.start), count):
            number = frame.frame + 1
            yield frame
    except Exception as error:  # of a library behind a URL, say
        sentence = f"{span.item.name}: unexpected {type(error).__name__} ({error})."
        yield _with_time(Frame(span.item.name, number, error=sentence), span)
        return
    if span.expected and number == span.start:
        sentence = (
            f"{span.item.name}[{number}]: {span.expected} frames from here on were counted, but "
            "none of them can be read; copy the file again."
        )
        yield _with_time(Frame(span.item.name, number, error=sentence), span)


def _with_time(frame: Frame, span: Span) -> Frame:
    """A frame that was not read, with what its name or file say of the time."""
    times = {"name": span.item.time_s, "modified": span.item.modified_s}
    for source, time_s in times.items():
        if math.isfinite(time_s):
            return Frame(
                frame.file, frame.frame, error=frame.error, time_s=time_s, time_source=source
            )
    return frame


class Poses:
    """Poses of the frames of an instrument, given in the order in which they were taken.

    As long as each frame is near the one before it, it is tracked, which takes a fraction of the
    time. Any other frame is analysed by itself, as by `rasnik.analyse`; and where that is so for
    most of them, tracking is left alone for a while.

    Parameters
    ----------
    settings : InstrumentSettings
    track : bool
    """

    def __init__(self, settings: InstrumentSettings, track: bool = True) -> None:
        self._options = AnalysisOptions(
            settings.system, model=settings.model, orientation=settings.orientation
        )
        self._track = track
        self._tracker: Tracker | None = None
        self._bounds: tuple[int, int, int, int] | None = None
        self._vain = 0  # frames in a row
        self._leave, self._leave_left = _IN_VAIN, 0

    def of(self, frame: Frame) -> tuple[Pose | None, str | None]:
        """Pose of a frame, and the sentence that says why there is no position."""
        pose = self._tracked(frame) if self._track and frame.image is not None else None
        return (pose, None) if pose is not None else analysed(frame, self._options)

    def _tracked(self, frame: Frame) -> Pose | None:
        """The pose, if tracking finds one."""
        from rasnik.analysis.flags import Flag

        if self._leave_left:
            self._leave_left -= 1
            return None
        try:
            pose = self._tracker_for(frame).update(frame.image)
        except Exception:  # told by `analysed`, if it lies with the frame
            self._tracker = None
            return None
        if pose.ok and not pose.flags & Flag.COLD_START:
            self._vain, self._leave = 0, _IN_VAIN
        else:
            self._vain += 1
        if self._vain > _IN_VAIN:
            self._tracker = None
            self._vain, self._leave_left = _IN_VAIN - 1, self._leave  # the next try is short
            self._leave = min(2 * self._leave, _LONGEST_LEAVE)
        return pose if pose.ok else None

    def _tracker_for(self, frame: Frame) -> Tracker:
        from rasnik.tracking.tracker import Tracker

        if self._tracker is None or self._bounds != frame.bounds_px:
            options, self._bounds = self._options, frame.bounds_px
            self._tracker = Tracker(
                options.system,
                model=options.model,
                orientation=options.orientation,
                bounds=frame.bounds_px,
            )
        return self._tracker


# ------------------------------------------------------------------------ rows


class _Rows:
    """Rows by day, and how many are good."""

    def __init__(self, settings: InstrumentSettings) -> None:
        self._settings = settings
        self._days: dict[str, list[dict[str, Any]]] = {}
        self.count = self._good = 0

    def add(self, frame: Frame, pose: Pose | None, error: str | None) -> None:
        """The row of one frame."""
        own = error if pose is None else None
        row = make_record(frame.file, frame.frame, pose, error=own, notes=frame.notes)
        time_s = self._time(frame)
        row["time_s"] = time_s if math.isfinite(time_s) else None
        row["time_source"] = frame.time_source or None
        self._days.setdefault(_day(time_s), []).append(row)
        self.count += 1
        self._good += error is None

    def _time(self, frame: Frame) -> float:
        """Frames of a file with one time for all follow each other at the instrument's rate."""
        rate_hz = self._settings.frame_rate_hz
        if rate_hz is None or frame.time_source == "metadata":
            return frame.time_s
        return frame.time_s + frame.frame / rate_hz

    def result(self, found: tuple[int, ...], start_s: float) -> Result:
        parts = tuple(
            Part(day, len(rows), _parquet(rows, self._settings))
            for day, rows in sorted(self._days.items())
        )
        seconds = time.perf_counter() - start_s
        return Result(found, self._good, self.count - self._good, seconds, parts)


def _day(time_s: float) -> str:
    """Date in UTC."""
    try:
        return datetime.fromtimestamp(time_s, UTC).date().isoformat()
    except (ValueError, OverflowError, OSError):
        return UNKNOWN_DAY


def _parquet(rows: Iterable[dict[str, Any]], settings: InstrumentSettings) -> bytes:
    """A Parquet file with these rows; it says what system they are from."""
    import pyarrow
    from pyarrow import parquet

    from rasnik.io.parquet import record_schema, record_table
    from rasnik.io.results import file_metadata

    schema = record_schema(file_metadata(settings.system), TIME_COLUMNS)
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(record_table(rows, schema), sink, compression="zstd")
    return bytes(sink.getvalue())
