"""Reading on while what was read is worked on."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Generator, Iterable

from rasnik.io.images import Frame

__all__ = ["read_ahead"]

_MOST_BYTES = 64 << 20
_LAST_READ_S = 2.0  # a read that hangs must not keep the program from ending


def read_ahead(
    frames: Iterable[Frame], most_bytes: int = _MOST_BYTES
) -> Generator[Frame, None, None]:
    """The same frames, fetched by a thread of their own before they are asked for.

    Parameters
    ----------
    frames : iterable of Frame
        Is used by the thread only.
    most_bytes : int
        Images of no more than this wait in memory, and one at least.

    Yields
    ------
    Frame
        In order. An exception of `frames` is raised here, after the frames before it. Closing
        the iterator ends the thread.
    """
    shelf = _Shelf(most_bytes)
    thread = threading.Thread(target=shelf.fill, args=(frames,), name="read ahead", daemon=True)
    thread.start()
    try:
        while (frame := shelf.take()) is not None:
            yield frame
    finally:
        shelf.close()
        thread.join(_LAST_READ_S)


class _Shelf:
    """Frames that wait, between the thread that reads and the one that works."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._waiting: deque[Frame] = deque()
        self._bytes = 0
        self._ended = self._closed = False
        self._error: BaseException | None = None
        self._changed = threading.Condition()

    def fill(self, frames: Iterable[Frame]) -> None:
        try:
            for frame in frames:
                if not self._put(frame):
                    return
        except BaseException as error:
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()

    def _put(self, frame: Frame) -> bool:
        size = _bytes(frame)
        with self._changed:
            while self._waiting and self._bytes + size > self._most_bytes and not self._closed:
                self._changed.wait()
            self._waiting.append(frame)
            self._bytes += size
            self._changed.notify()
            return not self._closed

    def take(self) -> Frame | None:
        with self._changed:
            while not self._waiting and not self._ended:
                self._changed.wait()
            if self._waiting:
                frame = self._waiting.popleft()
                self._bytes -= _bytes(frame)
                self._changed.notify()
                return frame
        if self._error is not None:
            raise self._error
        return None

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify()


def _bytes(frame: Frame) -> int:
    return 0 if frame.image is None else int(frame.image.nbytes)
