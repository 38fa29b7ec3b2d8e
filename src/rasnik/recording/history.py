"""Looking back into the record: a few points of a time from seconds to weeks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.io.track_table import read_rows
from rasnik.recording.record_file import record_files
from rasnik.recording.summary import BIN, QUANTITIES, STEP_S, bins_of, merged, summary_of

__all__ = ["History"]

_PIECE_ROWS = 65_536
_MOST_POINTS = 100_000


class History:
    """Least, mean and largest values, from all record files of a channel.

    Parameters
    ----------
    folder : Path
        Of the channel.
    current : callable
        Gives the file that is being written and its bins, or None.
    """

    def __init__(
        self, folder: Path, current: Callable[[], tuple[Path, NDArray[Any]] | None]
    ) -> None:
        self._folder, self._current = folder, current
        self._spans: dict[Path, tuple[float, float]] = {}

    def read(self, start_s: float, end_s: float, points: int) -> dict[str, NDArray[Any]]:
        """Values in `points` bins of equal length; see `Recorder.history`.

        Raises
        ------
        ValueError
            If the end is not after the start, or the number of points is not sensible.
        """
        if not (np.isfinite([start_s, end_s]).all() and start_s < end_s):
            raise ValueError("the end of the time to look at must be after its start")
        if not 1 <= points <= _MOST_POINTS:
            raise ValueError(f"points must be from 1 to {_MOST_POINTS}, not {points}")
        width_s = (end_s - start_s) / points
        parts = [np.empty(0, dtype=BIN)]
        for path, bins in self._bins(start_s, end_s):
            if width_s >= 2 * STEP_S:
                centre_s = (bins["step"] + 0.5) * STEP_S
                parts.append(_grouped(centre_s, bins, start_s, width_s, points))
            else:
                parts.extend(_from_rows(path, bins, start_s, width_s, points))
        found = np.concatenate(parts)
        found = found[np.argsort(found["step"], kind="stable")]
        return _columns(merged(found["step"], found), start_s, width_s, points)

    def _bins(self, start_s: float, end_s: float) -> Iterator[tuple[Path, NDArray[Any]]]:
        """Files that have rows in a time, with their bins; what cannot be read is left out."""
        current = self._current()
        for path in record_files(self._folder):
            if current is not None and path == current[0]:
                yield current
                continue
            first_s, last_s = self._spans.get(path, (start_s, end_s))
            if last_s < start_s or first_s > end_s:
                continue
            try:
                bins = summary_of(path)
            except (OSError, ValueError):
                continue
            if len(bins):
                steps = bins["step"]
                self._spans[path] = (steps.min() * STEP_S, (steps.max() + 1) * STEP_S)
                yield path, bins


def _grouped(
    time_s: NDArray[np.float64], bins: NDArray[Any], start_s: float, width_s: float, points: int
) -> NDArray[Any]:
    """Bins gathered into those that are asked for."""
    place = np.floor((time_s - start_s) / width_s)
    inside = (place >= 0) & (place < points)
    return merged(place[inside].astype(np.int64), bins[inside])


def _from_rows(
    path: Path, bins: NDArray[Any], start_s: float, width_s: float, points: int
) -> Iterator[NDArray[Any]]:
    """The same from the rows themselves, of which only those of the time are read."""
    end_s = start_s + width_s * points
    near = (bins["step"] * STEP_S <= end_s) & ((bins["step"] + 1) * STEP_S >= start_s)
    at = np.flatnonzero(near)
    if not len(at):
        return
    first = int(bins["row"][at[0]])
    last = int(bins["row"][at[-1] + 1]) if at[-1] + 1 < len(bins) else None
    while last is None or first < last:
        stop = first + _PIECE_ROWS if last is None else min(last, first + _PIECE_ROWS)
        try:
            rows = read_rows(path, first, stop)[0]
        except (OSError, ValueError):
            return
        if not len(rows):
            return
        rows = rows[np.isfinite(rows["host_time_s"])]
        yield _grouped(rows["host_time_s"], bins_of(rows, first), start_s, width_s, points)
        first = stop


def _columns(
    found: NDArray[Any], start_s: float, width_s: float, points: int
) -> dict[str, NDArray[Any]]:
    """Arrays of one value for each point."""
    count = np.zeros(points, dtype=np.int64)
    count[found["step"]] = found["count"]
    result: dict[str, NDArray[Any]] = {
        "time_s": start_s + (np.arange(points) + 0.5) * width_s,
        "count": count,
    }
    filled = np.maximum(found["count"], 1)
    for name in QUANTITIES:
        mean = np.where(found["count"] > 0, found[f"{name}_sum"] / filled, np.nan)
        for kind, values in (
            ("min", found[f"{name}_min"]),
            ("mean", mean),
            ("max", found[f"{name}_max"]),
        ):
            result[f"{name}_{kind}"] = np.full(points, np.nan)
            result[f"{name}_{kind}"][found["step"]] = values
    return result
