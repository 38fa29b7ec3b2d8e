"""Raw frames in HDF5, one file for each event, written in a thread of its own.

``/frames``
    Grey levels as they came, shape (frames, height, width), one chunk for each.
``/poses``
    One row for each frame, with the columns of the record. Attributes as those of a track, and
    ``reason``, ``event_time_utc``, ``also`` (what else came before the last frame), ``channel``.

While it is written the file is called ``NAME.h5.part``. What a killed writer left is completed
by the next one.
"""

from __future__ import annotations

import re
import threading
from collections import deque
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rasnik.instrument import System
from rasnik.io.file_lock import FileLock
from rasnik.io.hdf5 import append_rows, describe_table
from rasnik.io.hdf5_repair import clear_write_marks
from rasnik.io.track_file import track_metadata
from rasnik.io.track_table import for_appending, in_memory
from rasnik.recording.disk import free_mib, new_name, reason_of, try_out
from rasnik.recording.events import Event
from rasnik.recording.rows import RECORD_COLUMNS, RECORD_ROW, row_of
from rasnik.recording.sample import Sample
from rasnik.tracking.track import TRACK_COLUMNS

__all__ = ["FrameWriter", "complete_frames"]

#: Frames that wait for the disk are held in no more memory than this.
_MOST_BYTES = 512 << 20
_MIB = 1 << 20
_PART = ".part"


def complete_frames(folder: Path) -> None:
    """Make whole what killed writers left in a folder; what cannot be mended stays as it is."""
    for part in sorted(folder.glob(f"*.h5{_PART}")):
        try:
            lock = FileLock(part)
        except OSError:
            continue  # another program is writing it
        try:
            clear_write_marks(part)
            with h5py.File(part, "r+", libver="v110", locking=False) as file:
                numbers = file["poses"].fields("frame")[:]
                bad = np.flatnonzero(np.diff(numbers, prepend=-1) <= 0)
                count = int(bad[0]) if len(bad) else len(numbers)
                count = min(count, len(file["frames"]))
                file["poses"].resize((count,))
                file["frames"].resize(count, axis=0)
                file["poses"].attrs["also"] = "the program was killed"
            part.rename(_final_name(part))
        except (OSError, RuntimeError, ValueError, KeyError):
            continue
        finally:
            lock.release()


def _final_name(part: Path) -> Path:
    path, number = part.with_suffix(""), 1
    while path.exists():
        number += 1
        path = part.with_name(f"{part.name.removesuffix(f'.h5{_PART}')}_{number}.h5")
    return path


def _empty_file(path: Path, image: NDArray[Any], about: Mapping[str, str]) -> bytes:
    """A file for images of this size, without any."""
    with in_memory(path) as file:
        file.create_dataset(
            "frames",
            (0, *image.shape),
            image.dtype,
            maxshape=(None, *image.shape),
            chunks=(1, *image.shape),
        )
        poses = file.create_dataset("poses", (0,), RECORD_ROW, maxshape=(None,), chunks=(64,))
        describe_table(poses, (*TRACK_COLUMNS, *RECORD_COLUMNS), about)
        # Attributes cannot be made longer afterwards: room for what else comes.
        poses.attrs["also"] = np.array(b"", dtype="S256")
        file.flush()
        content: bytes = file.id.get_file_image()
    return content


class _FrameFile:
    """The file of one event."""

    def __init__(
        self,
        folder: Path,
        channel: str,
        event: Event,
        image: NDArray[Any],
        metadata: Mapping[str, str],
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        kind = re.sub(r"[^A-Za-z0-9]+", "-", event.reason.partition(":")[0]).strip("-")[:40]
        self.path = new_name(folder, channel, event.time_s, f"_{kind or 'event'}.h5{_PART}")
        when = datetime.fromtimestamp(event.time_s, UTC).isoformat(timespec="milliseconds")
        about = {"event_time_utc": when, "reason": event.reason, "channel": channel, **metadata}
        with self.path.open("xb") as file:
            file.write(_empty_file(self.path, image, about))
        self._lock = FileLock(self.path)
        self._lock.share()
        self._file = for_appending(self.path)
        self._frames, self._poses = self._file["frames"], self._file["poses"]
        self._number = -1

    def write(self, sample: Sample) -> bool:
        """Append a frame; False if it does not fit into the file."""
        if sample.frame.image.shape != self._frames.shape[1:] or sample.number <= self._number:
            return False
        size = self._file.id.get_filesize() + sample.frame.image.nbytes
        self._lock.reserve(size + _MIB)  # the row and the index of chunks fit into the rest
        # What the row refers to is on its way before the row.
        count = len(self._frames)
        self._frames.resize(count + 1, axis=0)
        self._frames[count] = sample.frame.image
        self._frames.flush()
        append_rows(self._poses, np.array([row_of(sample)], dtype=RECORD_ROW))
        self._number = sample.number
        return True

    def close(self, later: list[str]) -> None:
        """Close the file and give it its name."""
        try:
            also = "; ".join(dict.fromkeys(later)).encode()[:256]
            self._poses.attrs.modify("also", np.array(also, dtype="S256"))
            self._file.close()
            self.path.rename(_final_name(self.path))
        finally:
            self._lock.release()


class FrameWriter:
    """Takes frames of events, and writes them when the disk lets it.

    Parameters
    ----------
    folder : Path
        Where the files go.
    channel : str
    system : System
    metadata : mapping of str to str
    keep_free_mib : float
        Space to leave on the disk.
    most_bytes : int
        Of the frames that wait; what comes beyond is dropped, and counted.
    """

    def __init__(
        self,
        folder: Path,
        channel: str,
        system: System,
        metadata: Mapping[str, str],
        keep_free_mib: float,
        most_bytes: int = _MOST_BYTES,
    ) -> None:
        self._folder, self._channel = folder, channel
        self._metadata = track_metadata(system, metadata)
        self._keep_free_mib, self._most_bytes = keep_free_mib, most_bytes
        self._waiting: deque[tuple[Event, Sample | None]] = deque()
        self._bytes = 0
        self._open: dict[Event, _FrameFile] = {}
        self._broken: set[Event] = set()
        self._closed = False
        self._changed = threading.Condition()
        self.kept = 0
        self.dropped = 0
        self.trouble = ""
        self._thread = threading.Thread(target=self._run, name=f"frames {channel}", daemon=True)
        self._thread.start()

    def write(self, event: Event, sample: Sample) -> None:
        """Take a frame of an event."""
        size = sample.frame.image.nbytes
        with self._changed:
            if self._closed or self._bytes + size > self._most_bytes:
                self.dropped += 1
                return
            self._bytes += size
            self._waiting.append((event, sample))
            self._changed.notify_all()

    def end(self, event: Event) -> None:
        """The event has no further frames."""
        with self._changed:
            self._waiting.append((event, None))
            self._changed.notify_all()

    def close(self, timeout_s: float) -> None:
        """Write what waits, and end the thread; what is left after the time is dropped."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        complete_frames(self._folder)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    break
                event, sample = self._waiting[0]
            self._handle(event, sample)
            with self._changed:
                self._waiting.popleft()
                self._bytes -= 0 if sample is None else sample.frame.image.nbytes
        for event in list(self._open):
            self._handle(event, None)

    def _handle(self, event: Event, sample: Sample | None) -> None:
        """Write a frame, or end a file; what the disk refuses is dropped and said."""
        try:
            if sample is None:
                self._broken.discard(event)
                file = self._open.pop(event, None)
                if file is not None:
                    file.close(event.later)
            elif event in self._broken or not self._stored(event, sample):
                self.dropped += 1
            else:
                self.kept += 1
        except Exception as error:  # whatever it is, the next event is another matter
            self._give_up(event, error)
            self.dropped += sample is not None

    def _stored(self, event: Event, sample: Sample) -> bool:
        size_mib = sample.frame.image.nbytes / _MIB
        self._folder.mkdir(parents=True, exist_ok=True)
        if free_mib(self._folder) < max(self._keep_free_mib, 1.0) + size_mib:
            self.trouble = "Raw frames are not kept: the disk is full. Make space."
            return False
        if event not in self._open:
            try_out(self._folder, sample.frame.image.nbytes + _MIB)
            self._open[event] = _FrameFile(
                self._folder, self._channel, event, sample.frame.image, self._metadata
            )
        self.trouble = ""
        return self._open[event].write(sample)

    def _give_up(self, event: Event, error: Exception) -> None:
        self.trouble = (
            f"Raw frames could not be kept ({reason_of(error)}). The next event is tried again."
        )
        self._broken.add(event)
        file = self._open.pop(event, None)
        if file is not None:
            try:
                file.close(event.later)
            except (OSError, RuntimeError, ValueError, KeyError):
                pass  # what was written is completed at the next start
