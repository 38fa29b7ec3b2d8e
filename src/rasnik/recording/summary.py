"""Short form of a record file: least, mean and largest value in every half second.

Zooming out over days reads these and not the rows. The summary of a file is kept beside it, as
``summaries/NAME.npy``; it is made again from the rows if it is missing.
"""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.flags import FLAGS
from rasnik.io.track_table import read_rows

__all__ = [
    "BIN",
    "QUANTITIES",
    "STEP_S",
    "Summary",
    "bins_of",
    "merged",
    "save_summary",
    "summary_of",
    "summary_path",
]

QUANTITIES = ("x_um", "y_um", "scale", "theta_rad")
STEP_S = 0.5
#: One bin: the half second, its first row in the file, the rows with a position, and of each
#: quantity the least value, the sum and the largest.
BIN = np.dtype(
    [
        ("step", "i8"),
        ("row", "i8"),
        ("count", "i8"),
        *[(f"{name}_{kind}", "f8") for name in QUANTITIES for kind in ("min", "sum", "max")],
    ]
)
_FATAL = np.uint32(sum(int(info.flag) for info in FLAGS if info.fatal))
_PIECE_ROWS = 65_536


def merged(groups: NDArray[np.int64], bins: NDArray[Any]) -> NDArray[Any]:
    """Bins of the same group made one, where they follow each other.

    Parameters
    ----------
    groups : ndarray of int64, shape (n,)
    bins : ndarray of BIN, shape (n,)

    Returns
    -------
    ndarray of BIN, shape (m,)
        ``step`` is the group.
    """
    if not len(bins):
        return bins
    first = np.flatnonzero(np.diff(groups, prepend=groups[0] - 1))
    result = np.empty(len(first), dtype=BIN)
    result["step"], result["row"] = groups[first], bins["row"][first]
    result["count"] = np.add.reduceat(bins["count"], first)
    for name in QUANTITIES:
        result[f"{name}_min"] = np.fmin.reduceat(bins[f"{name}_min"], first)
        result[f"{name}_max"] = np.fmax.reduceat(bins[f"{name}_max"], first)
        result[f"{name}_sum"] = np.add.reduceat(bins[f"{name}_sum"], first)
    return result


def bins_of(rows: NDArray[Any], first_row: int) -> NDArray[Any]:
    """Every row with a time as a bin of its own."""
    at = np.flatnonzero(np.isfinite(rows["host_time_s"]))
    rows = rows[at]
    ok = np.isfinite(rows["x_um"]) & (rows["flags"] & _FATAL == 0)
    bins = np.zeros(len(rows), dtype=BIN)
    bins["row"], bins["count"] = first_row + at, ok
    for name in QUANTITIES:
        bins[f"{name}_min"] = bins[f"{name}_max"] = np.where(ok, rows[name], np.nan)
        bins[f"{name}_sum"] = np.where(ok, rows[name], 0.0)
    bins["step"] = np.floor(rows["host_time_s"] / STEP_S)
    return bins


class Summary:
    """The bins of a file that grows; extended by one thread, read by any."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._parts: list[NDArray[Any]] = []

    def extend(self, rows: NDArray[Any], first_row: int) -> None:
        """Take further rows, of which the first is number `first_row` in the file."""
        bins = bins_of(rows, first_row)
        new = merged(bins["step"], bins)
        if not len(new):
            return
        with self._lock:
            if self._parts:
                new = np.concatenate([self._parts[-1][-1:], new])
                new = merged(new["step"], new)
                self._parts[-1] = self._parts[-1][:-1]
            self._parts.append(new)

    def bins(self) -> NDArray[Any]:
        """Those up to now, shape (n,)."""
        with self._lock:
            if len(self._parts) > 1:
                self._parts = [np.concatenate(self._parts)]
            return self._parts[0].copy() if self._parts else np.empty(0, dtype=BIN)


def summary_path(path: Path) -> Path:
    """Where the summary of a record file is kept."""
    return path.parent / "summaries" / f"{path.stem}.npy"


def save_summary(path: Path, bins: NDArray[Any]) -> None:
    """Keep the summary of a file that is complete; without space for it, it is left out."""
    place = summary_path(path)
    unfinished = place.with_suffix(f".{os.getpid()}.partial")
    try:
        place.parent.mkdir(exist_ok=True)
        with unfinished.open("wb") as file:
            np.save(file, bins)
        unfinished.replace(place)
    except OSError:
        unfinished.unlink(missing_ok=True)


def summary_of(path: Path) -> NDArray[Any]:
    """The bins of a record file, from its summary or else from its rows.

    Raises
    ------
    OSError, ValueError
        If the file cannot be read.
    """
    place = summary_path(path)
    try:
        # A file that was continued since is younger than its summary.
        if place.stat().st_mtime >= path.stat().st_mtime:
            bins: NDArray[Any] = np.load(place)
            if bins.dtype == BIN:
                return bins
    except (OSError, ValueError):
        pass
    summary, first = Summary(), 0
    while len(rows := read_rows(path, first, first + _PIECE_ROWS)[0]):
        summary.extend(rows, first)
        first += len(rows)
    bins = summary.bins()
    save_summary(path, bins)
    return bins
