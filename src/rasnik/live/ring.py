"""Frames on their way from the camera to the tracker, in bounded memory."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from rasnik.cameras.camera import CameraFrame
from rasnik.live.losses import Arrival

__all__ = ["FrameRing", "Waiting"]

_FEWEST = 8  # frames that always find room, however large they are
_FEW = 64  # frames that find room, however long they wait
_LONGEST_S = 0.6  # that more may wait: what comes later is of little use


@dataclass(frozen=True, slots=True)
class Waiting:
    """A frame that waits for the tracker."""

    frame: CameraFrame
    arrival: Arrival


class FrameRing:
    """A queue between two threads that never makes the first one wait.

    Parameters
    ----------
    most_bytes : int
        Of images. When they are reached, or more than 64 frames wait and the oldest for 0.6 s,
        the older half makes room.

    Attributes
    ----------
    dropped : int
        Frames that made room.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._frames: deque[Waiting] = deque()
        self._bytes = 0
        self._closed = False
        self._changed = threading.Condition()
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, waiting: Waiting) -> None:
        """Append a frame; the older half is dropped where there is no room."""
        with self._changed:
            if self._is_full():
                for _ in range((len(self._frames) + 1) // 2):
                    self._bytes -= self._frames.popleft().frame.image.nbytes
                    self.dropped += 1
            self._append(waiting)

    def put_when_free(self, waiting: Waiting, timeout_s: float) -> bool:
        """Append a frame as soon as there is room; whether there was within the time."""
        with self._changed:
            if not self._changed.wait_for(lambda: not self._is_full(), timeout_s):
                return False
            self._append(waiting)
            return True

    def get(self, timeout_s: float) -> Waiting | None:
        """The oldest frame; None if there is none within the time."""
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._closed, timeout_s)
            if not self._frames:
                return None
            waiting = self._frames.popleft()
            self._bytes -= waiting.frame.image.nbytes
            self._changed.notify_all()
            return waiting

    def close(self) -> None:
        """No more frames come."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def finished(self) -> bool:
        """Whether no more frames come and all have been taken."""
        with self._changed:
            return self._closed and not self._frames

    def abandon(self) -> None:
        """Drop what waits."""
        with self._changed:
            self.dropped += len(self._frames)
            self._frames.clear()
            self._bytes = 0

    def _is_full(self) -> bool:
        count = len(self._frames)
        if self._bytes >= self._most_bytes and count >= _FEWEST:
            return True
        if count < _FEW:
            return False
        return self._frames[-1].frame.received_s - self._frames[0].frame.received_s > _LONGEST_S

    def _append(self, waiting: Waiting) -> None:
        self._frames.append(waiting)
        self._bytes += waiting.frame.image.nbytes
        self._changed.notify_all()
