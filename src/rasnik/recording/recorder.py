"""The record of a channel: every row to the disk, without making the tracker wait."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rasnik.instrument import System
from rasnik.recording.disk import DiskError
from rasnik.recording.events import FrameKeeper
from rasnik.recording.frame_file import FrameWriter
from rasnik.recording.history import History
from rasnik.recording.options import Recording
from rasnik.recording.record_file import RecordFiles
from rasnik.recording.rows import RowQueue, row_of
from rasnik.recording.sample import Sample

__all__ = ["Recorder", "RecorderStatus"]

_log = logging.getLogger(__name__)

#: Rows that wait for the disk: 18 minutes at 275 frames/s, 5 minutes at 900, in 50 MB.
_MOST_ROWS = 300_000
_PIECE_ROWS = 32_768
_STOP_S = 10.0  # for the rows that still wait when recording is stopped


@dataclass(frozen=True)
class RecorderStatus:
    """What a recorder is doing.

    Attributes
    ----------
    recording : bool
    rows : int
        Stored since the recorder was made.
    file : str
        The current file, or the last one; empty if there was none.
    message : str
        What is wrong, as a sentence; empty if nothing is.
    not_recorded : int
        Rows given up because the disk failed for longer than memory lasts.
    kept_frames : int
        Raw frames stored.
    dropped_frames : int
        Raw frames of events that could not be stored.
    """

    recording: bool = False
    rows: int = 0
    file: str = ""
    message: str = ""
    not_recorded: int = 0
    kept_frames: int = 0
    dropped_frames: int = 0


class Recorder:
    """Records the samples of a channel, from `start` to `stop`.

    A context manager. The layout is told in ``docs/recording.md``.

    Parameters
    ----------
    folder : Path
        Of the station; the files go to its folder ``CHANNEL``.
    channel : str
        Name of the channel.
    system : System
    options : Recording
    metadata : mapping of str to str
        Stored with every file, beside what is known by itself.
    """

    def __init__(
        self,
        folder: Path,
        channel: str,
        system: System,
        options: Recording,
        metadata: Mapping[str, str],
    ) -> None:
        self.folder = Path(folder) / channel
        self._options = options
        self._queue = RowQueue(_MOST_ROWS)
        self._files = RecordFiles(self.folder, channel, system, options, metadata)
        self._history = History(self.folder, self._files.current)
        self._frames = FrameWriter(
            self.folder / "frames", channel, system, metadata, options.keep_free_mib
        )
        self._keeper = FrameKeeper(options.raw, self._frames.write, self._frames.end)
        self._recording = False
        self._closed = False
        self._rows = 0
        self._not_recorded = 0
        self._trouble = ""
        self._fault = ""
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._keep_storing, name=f"record {channel}")
        self._thread.daemon = True
        self._thread.start()

    # ------------------------------------------------------------------ from any thread

    def add(self, sample: Sample) -> None:
        """Take a sample; quick, and never an exception."""
        recording = self._recording
        try:
            if recording and not self._queue.add(row_of(sample)):
                self._not_recorded += 1
            self._keeper.add(sample, automatic=recording)
        except Exception as error:  # measuring goes on whatever it is
            self._fault = f"A sample was refused ({type(error).__name__}: {error})."

    def start(self) -> None:
        """Record from now on, in a new file; harmless if it is recording."""
        with self._changed:
            if self._closed:
                raise RuntimeError("the recorder is closed; make a new one")
            self._recording = True

    def stop(self) -> None:
        """Record no more; what was taken before is stored, and the file is closed.

        If the disk is in trouble that is left for later.
        """
        with self._changed:
            self._recording = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_idle() or bool(self._trouble), _STOP_S)

    def close(self) -> None:
        """Stop, and end the thread; what cannot be stored by then is given up and counted."""
        self.stop()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_STOP_S)
        left = len(self._queue)
        if left:
            self._not_recorded += left
            self._queue.forget(left)
            _log.error("%s: %d rows could not be recorded. %s", self.folder, left, self._trouble)
        self._keeper.finish()
        self._frames.close(_STOP_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def status(self) -> RecorderStatus:
        """What it is doing."""
        lost, frames = self._not_recorded, self._frames
        messages = [self._fault, self._trouble, frames.trouble]
        if lost:
            messages.append(f"{lost} rows were not recorded: too many waited for the disk.")
        if frames.dropped:
            messages.append(f"{frames.dropped} raw frames were dropped.")
        if self._keeper.refused:
            messages.append(
                f"Frames of {self._keeper.refused} events were not kept: there were more than "
                f"{self._options.raw.most_per_hour} in an hour."
            )
        return RecorderStatus(
            recording=self._recording,
            rows=self._rows,
            file=str(self._files.path or ""),
            message=" ".join(message for message in messages if message),
            not_recorded=lost,
            kept_frames=frames.kept,
            dropped_frames=frames.dropped,
        )

    def event(self, reason: str) -> None:
        """Keep the frames around this moment.

        Parameters
        ----------
        reason : str
            Stored with them. Reasons that begin with "alarm", "glitch" or "lock_lost" (up to a
            colon, if there is one) count only if the options name them, and are limited in
            number; others are taken as asked for.
        """
        self._keeper.event(reason)

    def history(self, start_s: float, end_s: float, points: int) -> dict[str, NDArray[Any]]:
        """Least, mean and largest values in bins of time, read back from the record.

        Parameters
        ----------
        start_s, end_s : float
            Seconds since 1970 UTC.
        points : int
            Number of bins.

        Returns
        -------
        dict of str to ndarray, shape (points,)
            ``time_s``: the middle of each bin; ``count``: rows with a position; ``x_um_min``,
            ``x_um_mean``, ``x_um_max``, and the same of ``y_um``, ``scale`` and ``theta_rad``:
            NaN where there is none. Bins of a second and more are made of half seconds, each of
            which belongs as a whole to one bin.

        Raises
        ------
        ValueError
            If the end is not after the start, or the number of points is not sensible.
        """
        return self._history.read(start_s, end_s, points)

    def current(self) -> tuple[Path, NDArray[Any]] | None:
        """The file that is being written and the bins of its summary, as `History` wants them.

        With it another process reads the record while this one measures.
        """
        return self._files.current()

    # ------------------------------------------------------------------ in the thread

    def _is_idle(self) -> bool:
        return not self._recording and not len(self._queue) and self._files.is_closed

    def _keep_storing(self) -> None:
        wait_s = max(self._options.flush_s / 2, 0.02)
        while True:
            with self._changed:
                if not self._closed:
                    self._changed.wait(wait_s)
                closed = self._closed
            self._keeper.tick()
            stored = self._store()
            with self._changed:
                if not self._recording and stored:
                    self._files.close()
                self._changed.notify_all()
            if closed:
                self._files.close()
                return

    def _store(self) -> bool:
        """Write what waits; whether nothing does any more."""
        try:
            while len(rows := _increasing(self._queue.take(_PIECE_ROWS))):
                self._files.write(rows)
                self._queue.forget(len(rows))
                self._rows += len(rows)
                self._trouble = ""
            self._files.sync()
        except DiskError as error:
            self._trouble = str(error)
            return False
        except Exception as error:  # whatever it is, measuring and the next attempt go on
            self._trouble = f"Rows cannot be stored ({type(error).__name__}: {error})."
            self._files.close()
            return False
        return True


def _increasing(rows: NDArray[Any]) -> NDArray[Any]:
    """The first rows, up to where a number is not above the one before."""
    falls = np.flatnonzero(np.diff(rows["frame"]) <= 0)
    return rows[: falls[0] + 1] if len(falls) else rows
