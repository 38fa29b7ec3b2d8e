"""A whole archive: chunks are planned, worked on and written, never many at a time."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

from rasnik.archive.cluster import Finished, Pool
from rasnik.archive.dataset import Dataset, DatasetError, Totals
from rasnik.archive.plan import Chunk, Limits, Planner, Span, frames_in
from rasnik.archive.sources import Item, LeftOut, find_items
from rasnik.archive.systems_table import InstrumentSettings, SystemsTable
from rasnik.archive.work import Result, Work, analyse_chunk, lost_image
from rasnik.instrument import System
from rasnik.io.folders import is_url

__all__ = ["ArchiveRun", "Progress", "absolute_sources"]

_POLL_S = 0.5
_NAMED = 20
#: How often an image is tried alone before it is left out, having ended its processes each time.
_TRIES_ALONE = 2


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Attributes
    ----------
    images, failed : int
        Rows written by this run, and those without a position.
    size : float
        Bytes of the files they are from.
    workers : int
        Processes there are now.
    elapsed_s : float
    """

    images: int
    failed: int
    size: float
    workers: int
    elapsed_s: float


@dataclass
class _Job:
    """Something that was submitted: a chunk, or the count of its frames."""

    work: Work
    tries: int = 0
    counts: bool = False


@dataclass
class ArchiveRun:
    """Analyses what is not yet in a dataset.

    Parameters
    ----------
    sources : list of str
        By `absolute_sources`.
    table : SystemsTable
    dataset : Dataset
    pattern : str, optional
        As for `rasnik.archive.sources.find_items`.
    track : bool
        Whether the mask is followed where frames follow each other.
    limits : Limits

    Attributes
    ----------
    planner : Planner
        With what it left out.
    left_out : LeftOut
        What the search left out.
    totals : dict of str to Totals
        Of this run, by instrument.
    lost : list of str
        The first images that ended the processes they were given to.
    elapsed_s : float
    """

    sources: list[str]
    table: SystemsTable
    dataset: Dataset
    pattern: str | None = None
    track: bool = True
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        self.planner = Planner(self._settings_of, self.dataset.done, self.limits)
        self.left_out = LeftOut()
        self.totals: dict[str, Totals] = {}
        self.lost: list[str] = []
        self.elapsed_s = 0.0
        self._size = 0.0
        self._jobs: dict[int, _Job] = {}
        self._new = map(self._work, self.planner.chunks(self.items()))
        self._again: deque[_Job] = deque()
        self._tickets = 0

    def items(self) -> Iterator[Item]:
        """What the search finds, done or not."""
        return find_items(self.sources, self.pattern, self.left_out)

    def first_system(self) -> System | None:
        """The system of the first images there are to analyse; None if there are none."""
        first = next(self._new, None)
        if first is None:
            return None
        self._again.append(_Job(first))
        return first.settings.system

    def run(
        self,
        pool: Pool,
        progress: Callable[[Progress], None] = lambda progress: None,
        guard: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        """Do all of it.

        Parameters
        ----------
        pool : Pool
        progress : callable, optional
            Called whenever something has come out, and every half second.
        guard : callable, optional
            Gives a context in which a dataset is written, and which Ctrl-C does not end.

        Raises
        ------
        PoolError, WorkerError
            If the processes cannot do the work; what was done until then is in the dataset.
        """
        start_s = time.monotonic()
        planned = False
        while not planned or self._jobs or self._again:
            while pool.room() > 0:
                job = self._next()
                if job is None:
                    planned = True
                    break
                self._submit(pool, job)
            for finished in pool.finished(_POLL_S):
                self._take(self._jobs.pop(finished.ticket), finished, guard)
            self.elapsed_s = time.monotonic() - start_s
            progress(self._progress(pool))

    def _settings_of(self, instrument: str) -> InstrumentSettings:
        """Settings, unless the dataset has rows that were made with others."""
        settings, folder = self.table.of(instrument), self.dataset.folder_of(instrument)
        differing = self.dataset.differences(instrument, settings, self.track)
        if differing:
            raise DatasetError(
                f"{self.dataset.path} holds results of {instrument} that were made with another "
                f"{' and '.join(differing)} than is asked for now; name a new folder, or remove "
                f"{folder} to have it analysed anew"
            )
        return settings

    def _work(self, chunk: Chunk) -> Work:
        return Work(chunk, self.table.of(chunk.instrument), self.track)

    def _next(self) -> _Job | None:
        if self._again:
            return self._again.popleft()
        work = next(self._new, None)
        return None if work is None else _Job(work)

    def _submit(self, pool: Pool, job: _Job) -> None:
        self._tickets += 1
        self._jobs[self._tickets] = job
        if job.counts:
            pool.submit(self._tickets, frames_in, job.work.chunk.spans[0].item)
        else:
            pool.submit(self._tickets, analyse_chunk, job.work)

    def _take(
        self, job: _Job, finished: Finished, guard: Callable[[], AbstractContextManager[None]]
    ) -> None:
        """Write what came out, or find out which image it is that ends processes."""
        if job.counts:
            self._again += _divided(job, 1 if finished.died else int(finished.value))
            return
        if not finished.died:
            self._store(job.work, finished.value, guard)
            return
        parts = _divided(job)
        if parts:
            self._again += parts
            return
        if len(self.lost) < _NAMED:
            self.lost.append(job.work.chunk.spans[0].item.name)
        self._store(job.work, lost_image(job.work), guard)

    def _store(
        self, work: Work, result: Result, guard: Callable[[], AbstractContextManager[None]]
    ) -> None:
        with guard():
            self.dataset.store(work, result)
            new = Totals(result.good, result.failed, result.seconds)
            name = work.chunk.instrument
            self.totals[name] = self.totals.get(name, Totals()) + new
            self._size += sum(span.size for span in work.chunk.spans)

    def _progress(self, pool: Pool) -> Progress:
        images = sum(total.images for total in self.totals.values())
        failed = sum(total.failed for total in self.totals.values())
        return Progress(images, failed, self._size, pool.workers, self.elapsed_s)


def _divided(job: _Job, counted: int | None = None) -> list[_Job]:
    """What is tried in place of a chunk that ended its processes; none if it is one lost image.

    Parameters
    ----------
    counted : int, optional
        Frames of its only item, if they have been counted.
    """
    spans = job.work.chunk.spans
    if len(spans) > 1:
        half = len(spans) // 2
        return [_with_spans(job, spans[:half]), _with_spans(job, spans[half:])]
    (span,) = spans
    if span.stop is None and counted is None and not job.tries:
        return [replace(job, counts=True)]
    frames = (counted or 0) - span.start if span.stop is None else span.stop - span.start
    if frames > 1:
        middle, share = span.start + frames // 2, (frames // 2) / frames
        first = Span(span.item, span.start, middle, frames // 2, share * span.size)
        rest = frames - frames // 2
        second = Span(span.item, middle, span.stop, rest, (1 - share) * span.size)
        return [_with_spans(job, (first,)), _with_spans(job, (second,))]
    again = replace(job, tries=job.tries + 1, counts=False)
    return [again] if again.tries < _TRIES_ALONE else []


def _with_spans(job: _Job, spans: tuple[Span, ...]) -> _Job:
    return _Job(replace(job.work, chunk=replace(job.work.chunk, spans=spans)))


# ------------------------------------------------------------------------ before it begins


def absolute_sources(sources: Iterable[str]) -> list[str]:
    """Names of sources that mean the same in every folder and process.

    Raises
    ------
    ValueError
        If one lies in another, so that its images would come twice.
    """
    names = [name if is_url(name) else os.path.abspath(name) for name in sources]
    for k, name in enumerate(names):
        for other in names[k + 1 :]:
            inner, outer = sorted((name, other), key=len, reverse=True)
            if inner == outer or inner.startswith(outer.rstrip("/" + os.sep) + "/"):
                raise ValueError(
                    f"{inner} lies in {outer}, so its images would come twice; leave one out"
                )
    return names
