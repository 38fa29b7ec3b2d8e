"""Where the rows of a channel go: one file after the other, whatever the disk does."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.instrument import System
from rasnik.io.track_file import TrackWriter
from rasnik.io.track_table import from_rows
from rasnik.recording.disk import DiskError, free_mib, new_name, reason_of, try_out
from rasnik.recording.options import Recording
from rasnik.recording.rows import RECORD_COLUMNS
from rasnik.recording.summary import Summary, save_summary

__all__ = ["RecordFiles", "name_time", "record_files"]

_MIB = 1 << 20
_SPARE_MIB = 1.0  # for what a file needs beside its rows
_PATIENCE_S = 30.0  # longest time between attempts with a disk that fails


def name_time(path: Path) -> tuple[str, int]:
    """What record files are sorted by: the time in the name, and the number after it."""
    match = re.search(r"_(\d{8}T\d{6}Z)(?:_(\d+))?\.h5$", path.name)
    return (match[1], int(match[2] or 1)) if match else ("", 0)


def record_files(folder: Path) -> list[Path]:
    """The record files of a channel's folder, oldest first."""
    return sorted((p for p in folder.glob("*.h5") if name_time(p)[0]), key=name_time)


class RecordFiles:
    """Writes rows into files that are rotated; used by one thread.

    A file that cannot be written is left as it is, and a new one is begun once there is space.

    Parameters
    ----------
    folder : Path
        Of the channel; made if need be.
    channel : str
    system : System
    options : Recording
    metadata : mapping of str to str
    """

    def __init__(
        self,
        folder: Path,
        channel: str,
        system: System,
        options: Recording,
        metadata: Mapping[str, str],
    ) -> None:
        self.folder, self.channel = folder, channel
        self._system, self._options, self._metadata = system, options, metadata
        self._writer: TrackWriter | None = None
        self._summary = Summary()
        self._began_s, self._stored = 0.0, 0
        self._failures = 0
        self._again_s = 0.0
        self._trouble = ""
        self.path: Path | None = None

    @property
    def is_closed(self) -> bool:
        return self._writer is None

    def current(self) -> tuple[Path, NDArray[Any]] | None:
        """The file that is being written, and the bins of its summary; from any thread."""
        writer, summary = self._writer, self._summary
        return None if writer is None else (writer.path, summary.bins())

    def write(self, rows: NDArray[Any]) -> None:
        """Store rows.

        Raises
        ------
        DiskError
            If none of the rows could be stored for certain; they are to be given again.
        """
        if time.monotonic() < self._again_s:
            raise DiskError(self._trouble)
        try:
            self._check_space(rows.nbytes)
            writer = self._ready(rows)
            first = writer.rows
            columns = {column.name: rows[column.name] for column in RECORD_COLUMNS}
            writer.write(from_rows(rows), columns)
        except (OSError, RuntimeError) as error:
            self._fail(error)
        self._stored += len(rows)
        self._summary.extend(rows, first)
        self._failures = 0

    def sync(self) -> None:
        """Ask the disk to have what was written."""
        if self._writer is not None:
            try:
                self._writer.flush()
            except (OSError, RuntimeError) as error:
                self._fail(error)

    def close(self) -> None:
        """End the current file; the next rows begin a new one."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.close()
        except (OSError, RuntimeError):
            pass  # its rows were stored, or will be in the next file
        bins, self._summary = self._summary.bins(), Summary()
        if self._stored:
            save_summary(writer.path, bins)
        else:
            writer.path.unlink(missing_ok=True)

    def _check_space(self, size: int) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        free = free_mib(self.folder)
        least = max(self._options.keep_free_mib, _SPARE_MIB + size / _MIB)
        if free < least:
            raise DiskError(
                f"The disk is full: {free:.1f} MiB are free at {self.folder}, less than the "
                f"{least:.4g} MiB that recording needs or is to leave. Make space; it goes on by "
                "itself."
            )
        if self._failures or self._writer is None:
            try_out(self.folder, size + int(_SPARE_MIB * _MIB))

    def _ready(self, rows: NDArray[Any]) -> TrackWriter:
        """The file for these rows, a new one if it is time for that."""
        writer, options = self._writer, self._options
        if writer is not None and (
            time.monotonic() - self._began_s > options.rotate_hours * 3600
            or writer.rows * rows.itemsize > options.rotate_mib * _MIB
            or rows["frame"][0] < writer.next_frame
        ):
            self.close()
            writer = None
        if writer is None:
            first_s = float(rows["host_time_s"][0])
            began = first_s if np.isfinite(first_s) and first_s > 0 else time.time()
            self.path = new_name(self.folder, self.channel, began, ".h5")
            start = datetime.fromtimestamp(began, UTC).isoformat(timespec="milliseconds")
            writer = self._writer = TrackWriter(
                self.path,
                system=self._system,
                metadata={"source": self.channel, "start_time_utc": start, **self._metadata},
                flush_s=0.0,
                extra=RECORD_COLUMNS,
            )
            self._began_s, self._stored = time.monotonic(), 0
        return writer

    def _fail(self, error: Exception) -> None:
        """Give up the current file, and wait longer each time before the next."""
        self.close()
        self._failures += 1
        self._again_s = time.monotonic() + min(2.0 ** (self._failures - 1), _PATIENCE_S)
        self._trouble = (
            f"Rows cannot be stored ({reason_of(error)}). The next attempt follows by itself."
        )
        raise DiskError(self._trouble) from error
