"""The last minutes of a channel, in memory."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.recording.sample import Sample
from rasnik.tracking.track import POSE_COLUMNS, TRACK_COLUMNS

__all__ = ["RECENT_ROW", "Recent"]

_ARRIVAL = ("host_time_s", "device_time_s", "received_s", "latency_s", "exposure_us")
#: The columns of a track, and what is only known where the frames come in. Times between rows
#: are those of `received_s`: nobody sets that clock.
RECENT_ROW = np.dtype(
    [(column.name, column.dtype) for column in TRACK_COLUMNS] + [(name, "f8") for name in _ARRIVAL]
)
_ROWS = 1 << 16


class Recent:
    """A ring of rows; written by one thread, read by any.

    Rows are counted from 0 since the channel began; the oldest are overwritten.

    Parameters
    ----------
    rows : int
        How many are kept.
    """

    def __init__(self, rows: int = _ROWS) -> None:
        self._rows = np.empty(rows, dtype=RECENT_ROW)
        self._rows[:] = 0  # memory taken now: as rows come it would look like a leak
        self._count = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return min(self._count, len(self._rows))

    @property
    def count(self) -> int:
        """Rows since the channel began; the index that the next one will have."""
        return self._count

    def add(self, sample: Sample, time_s: float, latency_s: float) -> None:
        """Append the row of a sample."""
        frame, pose = sample.frame, sample.pose
        row = (
            sample.number,
            time_s,
            *(getattr(pose, name) for name in POSE_COLUMNS),
            int(pose.flags),
            frame.host_time_s,
            frame.device_time_s,
            frame.received_s,
            latency_s,
            frame.exposure_us,
        )
        with self._lock:
            self._rows[self._count % len(self._rows)] = row
            self._count += 1

    def extend(self, rows: NDArray[Any], following: int) -> None:
        """Take rows of another ring of this size; the next one there has the index `following`."""
        with self._lock:
            size = len(self._rows)
            rows = rows[-size:]
            self._rows[np.arange(following - len(rows), following) % size] = rows
            self._count = following

    def since(self, index: int, most: int | None = None) -> tuple[NDArray[Any], int]:
        """Rows from an index on, as far as they are kept, and the index to continue from.

        Parameters
        ----------
        index : int
            0 for all; what the last call returned for those that are new.
        most : int, optional
            No more rows than this, the oldest first.
        """
        with self._lock:
            size = len(self._rows)
            first = min(max(index, self._count - size, 0), self._count)
            end = self._count if most is None else min(self._count, first + most)
            start, stop = first % size, end % size
            if first == end:
                return self._rows[:0].copy(), end
            if start < stop:
                return self._rows[start:stop].copy(), end
            return np.concatenate([self._rows[start:], self._rows[:stop]]), end

    def last(self, seconds: float) -> NDArray[Any]:
        """Rows of the last seconds before the newest."""
        size = 1024
        while True:  # the ring is large: no more of it is copied than is needed
            rows, _ = self.since(max(self._count - size, 0))
            if not len(rows):
                return rows
            begin_s = rows["received_s"][-1] - seconds
            if rows["received_s"][0] < begin_s or len(rows) < size:
                return rows[rows["received_s"] >= begin_s]
            size *= 4
