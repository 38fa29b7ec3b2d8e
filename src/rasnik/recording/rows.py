"""One row of a record, and the rows that wait for the disk."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.recording.sample import Sample
from rasnik.tracking.track import POSE_COLUMNS, TRACK_COLUMNS, TrackColumn

__all__ = ["RECORD_COLUMNS", "RECORD_ROW", "RowQueue", "row_of"]

#: What a record holds of a frame beside the columns of a track.
RECORD_COLUMNS: tuple[TrackColumn, ...] = (
    TrackColumn("host_time_s", "f8", "s", "when the frame came, since 1970 UTC, by this computer"),
    TrackColumn("device_time_s", "f8", "s", "time of the frame by the camera's own clock"),
    TrackColumn("latency_s", "f8", "s", "from the frame's arrival until it was recorded"),
    TrackColumn("exposure_us", "f8", "us", "exposure of the frame"),
    TrackColumn("gain_db", "f8", "dB", "gain of the frame"),
    TrackColumn("camera_number", "i8", "", "number of the frame as the camera counts"),
)
RECORD_ROW = np.dtype([(c.name, c.dtype) for c in (*TRACK_COLUMNS, *RECORD_COLUMNS)])

_BLOCK_ROWS = 4096


def row_of(sample: Sample) -> tuple[Any, ...]:
    """The values of `RECORD_ROW` for a frame."""
    frame, pose = sample.frame, sample.pose
    return (
        sample.number,
        frame.host_time_s,
        *[getattr(pose, name) for name in POSE_COLUMNS],
        int(pose.flags),
        frame.host_time_s,
        frame.device_time_s,
        time.perf_counter() - frame.received_s,
        frame.exposure_us,
        frame.gain_db,
        frame.number,
    )


class RowQueue:
    """Rows on their way to the disk, in memory that is bounded.

    Parameters
    ----------
    most_rows : int
        When so many wait, further rows are refused.
    """

    def __init__(self, most_rows: int) -> None:
        self._most_rows = most_rows
        self._lock = threading.Lock()
        self._blocks: list[NDArray[Any]] = []
        self._filled = 0  # rows of the last block
        self._rows = 0

    def __len__(self) -> int:
        return self._rows

    def add(self, row: tuple[Any, ...]) -> bool:
        """Append a row; False if there is no room for it."""
        with self._lock:
            if self._rows >= self._most_rows:
                return False
            if not self._blocks or self._filled == len(self._blocks[-1]):
                self._blocks.append(np.empty(_BLOCK_ROWS, dtype=RECORD_ROW))
                self._filled = 0
            self._blocks[-1][self._filled] = row
            self._filled += 1
            self._rows += 1
            return True

    def take(self, most: int) -> NDArray[Any]:
        """The oldest rows, about `most` of them, which stay in the queue until `forget`."""
        with self._lock:
            blocks = self._blocks[: max(1, most // _BLOCK_ROWS)]
            if blocks and len(blocks) == len(self._blocks):
                blocks[-1] = blocks[-1][: self._filled]
            return np.concatenate(blocks) if blocks else np.empty(0, dtype=RECORD_ROW)

    def forget(self, rows: int) -> None:
        """Let go of the oldest rows; they are on the disk."""
        with self._lock:
            self._rows -= rows
            while rows:
                last = len(self._blocks) == 1
                held = self._filled if last else len(self._blocks[0])
                if rows < held:
                    self._blocks[0] = self._blocks[0][rows:]
                    if last:
                        self._filled -= rows
                    return
                rows -= held
                del self._blocks[0]
                if last:
                    self._filled = 0
