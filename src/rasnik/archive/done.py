"""Which frames of an archive have rows already, small enough to know it of millions of files."""

from __future__ import annotations

import base64
import json
import zlib
from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.archive.sources import Item

__all__ = ["DoneFrames", "DoneSpan", "pack_spans", "unpack_spans"]


@dataclass(frozen=True)
class DoneSpan:
    """Frames of one item that have been worked on.

    Attributes
    ----------
    name : str
        Of the item.
    size, modified_s
        Of the item as it was then.
    start, frames : int
        The first frame, and how many there are.
    to_end : bool
        Whether the item ended there.
    """

    name: str
    size: int
    modified_s: float | None
    start: int
    frames: int
    to_end: bool

    @classmethod
    def of(cls, item: Item, start: int, frames: int, to_end: bool) -> DoneSpan:
        """Frames of an item as it is now."""
        modified_s = item.modified_s if np.isfinite(item.modified_s) else None
        return cls(item.name, item.size, modified_s, start, frames, to_end)

    @property
    def stamp(self) -> int:
        """A number that changes with the item."""
        return _digest(f"{self.size} {self.modified_s!r}")


def pack_spans(spans: Iterable[DoneSpan]) -> str:
    """Spans as one text, of some 10 bytes for each."""
    rows = [[s.name, s.size, s.modified_s, s.start, s.frames, int(s.to_end)] for s in spans]
    return base64.b64encode(zlib.compress(json.dumps(rows).encode())).decode("ascii")


def unpack_spans(text: str) -> list[DoneSpan]:
    """The spans in a text by `pack_spans`; raises ValueError if it is damaged."""
    try:
        rows = json.loads(zlib.decompress(base64.b64decode(text, validate=True)))
        return [
            DoneSpan(name, size, modified_s, start, frames, bool(to_end))
            for name, size, modified_s, start, frames, to_end in rows
        ]
    except (zlib.error, TypeError) as error:
        raise ValueError(str(error)) from error


class DoneFrames:
    """Finds what is left to do of an item.

    Names are kept as numbers of 64 bits: 56 bytes for each span, whatever its name.
    """

    def __init__(self) -> None:
        self._numbers = array("Q")  # name and stamp in turn
        self._frames = array("q")  # start, frames, whether to the end
        self._keys: NDArray[np.uint64] | None = None  # sorted
        self._stamps: NDArray[Any] = np.empty(0)
        self._spans: NDArray[Any] = np.empty(0)
        self._order: NDArray[np.intp] = np.empty(0, dtype=np.intp)

    def __len__(self) -> int:
        return len(self._numbers) // 2

    def add(self, spans: Iterable[DoneSpan]) -> None:
        """Take note of spans."""
        self._keys = None
        self._stamps = self._spans = np.empty(0)  # were views of what grows
        for span in spans:
            self._numbers.extend((_digest(span.name), span.stamp))
            self._frames.extend((span.start, span.frames, span.to_end))

    def left(self, item: Item) -> tuple[list[tuple[int, int | None]], bool]:
        """What is left of an item.

        Returns
        -------
        gaps : list of (int, int or None)
            First frame, and the one after the last; None: all to the end.
        changed : bool
            Whether the item is another than the one that was worked on.
        """
        rows = self._rows(item.name)
        if not len(rows):
            return [(0, None)], False
        stamp = DoneSpan.of(item, 0, 0, False).stamp
        same = self._stamps[rows] == stamp
        gaps: list[tuple[int, int | None]] = []
        position = 0
        for start, frames, _ in sorted(self._spans[rows].tolist()):
            if start > position:
                gaps.append((position, start))
            position = max(position, start + frames)
        complete = bool((same & (self._spans[rows, 2] > 0)).any())
        if not complete:
            gaps.append((position, None))
        return gaps, not complete and not same.all()

    def _rows(self, name: str) -> NDArray[np.intp]:
        """The rows of a name."""
        if self._keys is None:
            self._sort()
        assert self._keys is not None
        key = np.uint64(_digest(name))
        first, last = (int(np.searchsorted(self._keys, key, side)) for side in ("left", "right"))
        return self._order[first:last]

    def _sort(self) -> None:
        numbers = np.frombuffer(self._numbers, dtype=np.uint64).reshape(-1, 2)
        self._spans = np.frombuffer(self._frames, dtype=np.int64).reshape(-1, 3)
        self._order = np.argsort(numbers[:, 0], kind="stable")
        self._keys, self._stamps = numbers[self._order, 0], numbers[:, 1]


def _digest(text: str) -> int:
    raw = text.encode(errors="surrogateescape")
    return int.from_bytes(blake2b(raw, digest_size=8).digest(), "little")
