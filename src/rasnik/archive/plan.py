"""An archive cut into chunks of work: frames of one instrument, in order, for about a minute.

The search for images and the cutting go on while the first chunks are worked on: what is kept
in memory does not grow with the archive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path

from rasnik.archive.done import DoneFrames, DoneSpan
from rasnik.archive.sources import Item
from rasnik.archive.systems_table import InstrumentSettings
from rasnik.io.folders import is_url
from rasnik.io.images import Source, count_frames

__all__ = ["Chunk", "Limits", "Planner", "Span", "frames_in"]

_NAMED = 20


@dataclass(frozen=True)
class Span:
    """Consecutive frames of one item.

    Attributes
    ----------
    item : Item
    start : int
    stop : int or None
        The frame after the last; None: all to the end.
    expected : int
        Frames that should be there, as far as it is known; 0 if it is not.
    size : float
        Bytes of the file that hold them.
    """

    item: Item
    start: int = 0
    stop: int | None = None
    expected: int = 0
    size: float = 0.0

    def done(self, found: int) -> DoneSpan:
        """What is done once the frames that were found have rows."""
        frames = found if self.stop is None else self.stop - self.start
        return DoneSpan.of(self.item, self.start, frames, self.stop is None)


@dataclass(frozen=True)
class Chunk:
    """Work for one process: frames of one instrument in their order."""

    instrument: str
    spans: tuple[Span, ...]

    @property
    def name(self) -> str:
        """The same for the same frames of the same files."""
        digest = blake2b(self.instrument.encode(errors="surrogateescape"), digest_size=12)
        for span in self.spans:
            known = DoneSpan.of(span.item, span.start, 0, span.stop is None)
            text = f"\0{known.name}\0{known.stamp}\0{span.start}\0{span.stop}"
            digest.update(text.encode(errors="surrogateescape"))
        return digest.hexdigest()


@dataclass(frozen=True)
class Limits:
    """How large a chunk may be.

    A frame takes from 1 ms (small, tracked) to 0.3 s (4 megapixels, found from nothing): these
    limits make chunks of a second to some minutes. Larger ones would leave one worker long with
    the last.

    Attributes
    ----------
    frames : int
    size : int
        Bytes of the files.
    counted : int
        Bytes. Larger files are opened to count their frames; smaller ones are taken whole.
    waiting : int
        Spans that may wait for others of their instrument, where instruments take turns.
    """

    frames: int = 500
    size: int = 256 << 20
    counted: int = 8 << 20
    waiting: int = 20_000


@dataclass
class _Open:
    """A chunk that is being filled."""

    spans: list[Span] = field(default_factory=list)
    frames: int = 0
    size: float = 0.0


class Planner:
    """Cuts what is left to do into chunks, as it is asked for them.

    Parameters
    ----------
    settings_of : callable
        Settings of an instrument by its name. Instruments for which it raises ValueError are
        left out, and listed in `refused`.
    done : DoneFrames
        What has rows already.
    limits : Limits

    Attributes
    ----------
    refused : dict of str to (str, int)
        Instruments that are left out: why, and how many files they have.
    unchanged : int
        Files that need nothing.
    changed : list of str
        The first files that are not as they were when they were analysed. Only frames that were
        added to them are analysed.
    n_changed : int
        How many there are.
    """

    def __init__(
        self,
        settings_of: Callable[[str], InstrumentSettings],
        done: DoneFrames,
        limits: Limits | None = None,
    ) -> None:
        self._settings_of, self._done = settings_of, done
        self._limits = limits or Limits()
        self._frame_bytes: dict[str, int] = {}
        self._open: dict[str, _Open] = {}
        self._waiting = 0
        self.refused: dict[str, tuple[str, int]] = {}
        self.unchanged = 0
        self.changed: list[str] = []
        self.n_changed = 0

    def chunks(self, items: Iterable[Item]) -> Iterator[Chunk]:
        """Chunks of work, in the order of the items."""
        for item in items:
            if not self._accepted(item.instrument):
                continue
            for span, frames in self._pieces(item):
                yield from self._add(span, frames)
            while self._waiting > self._limits.waiting:
                yield self._close(next(iter(self._open)))
        for instrument in list(self._open):
            yield self._close(instrument)

    def _accepted(self, instrument: str) -> bool:
        """Whether there are settings for an instrument."""
        if instrument in self._frame_bytes:
            return True
        if instrument in self.refused:
            sentence, files = self.refused[instrument]
            self.refused[instrument] = sentence, files + 1
            return False
        try:
            self._frame_bytes[instrument] = _frame_bytes(self._settings_of(instrument))
        except ValueError as error:
            self.refused[instrument] = f"{str(error).rstrip('.')}.", 1
        return instrument in self._frame_bytes

    def _pieces(self, item: Item) -> Iterator[tuple[Span, int]]:
        """Spans of an item, none larger than a chunk may be, and how many frames they may be."""
        gaps, changed = self._done.left(item)
        self.unchanged += not gaps
        if changed:
            self.n_changed += 1
            self.changed += [item.name] if len(self.changed) < _NAMED else []
        total = frames_in(item) if gaps and item.size > self._limits.counted else 0
        if total > 1:
            most = max(1, min(self._limits.frames, int(self._limits.size * total / item.size)))
            for start, stop in gaps:
                for span in _cut(item, start, stop, total, most):
                    yield span, span.expected
            return
        frames = max(1, item.size // self._frame_bytes[item.instrument])
        for start, stop in gaps:
            expected = 0 if stop is None else stop - start
            yield Span(item, start, stop, expected, float(item.size)), expected or frames

    def _add(self, span: Span, frames: int) -> Iterator[Chunk]:
        """Put a span into its instrument's chunk, which may have to be closed before or after."""
        instrument, limits = span.item.instrument, self._limits
        chunk, size = self._open.get(instrument), span.size
        if chunk and (chunk.frames + frames > limits.frames or chunk.size + size > limits.size):
            yield self._close(instrument)
        chunk = self._open.setdefault(instrument, _Open())
        chunk.spans.append(span)
        chunk.frames += frames
        chunk.size += size
        self._waiting += 1
        if chunk.frames >= limits.frames or chunk.size >= limits.size:
            yield self._close(instrument)

    def _close(self, instrument: str) -> Chunk:
        spans = self._open.pop(instrument).spans
        self._waiting -= len(spans)
        return Chunk(instrument, tuple(spans))


def frames_in(item: Item) -> int:
    """Number of frames as the file tells it."""
    url = item.url if is_url(item.url) else None
    return count_frames(Source(item.name, Path(item.url), item.dataset, url=url))


def _frame_bytes(settings: InstrumentSettings) -> int:
    height, width = settings.system.shape
    return height * width * (1 if settings.system.sensor.bit_depth <= 8 else 2)


def _cut(item: Item, start: int, stop: int | None, total: int, most: int) -> Iterator[Span]:
    """The frames of a gap, so many at a time; the last piece goes to the end if the gap does."""
    each, end = item.size / total, total if stop is None else stop
    while end - start > most:
        yield Span(item, start, start + most, most, most * each)
        start += most
    if stop is None or start < stop:
        rest = max(0, end - start)
        yield Span(item, start, stop, rest, rest * each)
