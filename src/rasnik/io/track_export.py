"""Tracks in and out of files, in the format the suffix names.

============ ===============================================================================
``.h5``      HDF5 (see `rasnik.io.track_table`), the format tracks are measured into
``.csv``     one header line with the names of the columns, one line for each frame
``.parquet`` Parquet; needs ``pip install "rasnik[parquet]"``
============ ===============================================================================

All hold every number to the last bit. CSV holds the columns alone; the others also hold the
system, the software and the source.
"""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rasnik.instrument import System
from rasnik.io.track_file import HDF5_SUFFIXES, TrackWriter, track_metadata
from rasnik.io.track_table import ROW, from_rows, read_table
from rasnik.tracking.track import TRACK_COLUMNS, Track

if TYPE_CHECKING:
    from gwpy.timeseries import TimeSeries

__all__ = ["TRACK_SUFFIXES", "read_track", "to_gwpy", "write_track"]

TRACK_SUFFIXES = (*HDF5_SUFFIXES, ".csv", ".parquet")

_SERIES_COLUMNS = tuple(
    column.name for column in TRACK_COLUMNS if column.name not in ("frame", "time_s", "flags")
)
#: Units of columns that gwpy calls otherwise: a grey level is a unit of the analog-to-digital
#: converter.
_GWPY_UNITS = {"grey": "adu"}
_REMEDY = "take a part of the track without the irregularity, or resample it knowingly"


def read_track(
    path: str | os.PathLike[str], start: int | None = None, stop: int | None = None
) -> Track:
    """Read a track, or some rows of it.

    Parameters
    ----------
    path : path-like
        A file by `TrackWriter`, also one that is being written or whose writer was killed, or
        by `write_track`.
    start, stop : int, optional
        Rows as in ``track[start:stop]``: -1000 is 1000 rows before the last. HDF5 files of any
        length are read in pieces this way.

    Returns
    -------
    Track
        ``metadata`` is what the file says of the track as a whole; nothing for CSV.

    Raises
    ------
    ValueError
        If the suffix is not known or the file holds no track.
    OSError
        If the file is not there, cannot be read, or is damaged.
    ImportError
        If the format needs an extra that is not installed.
    """
    path = Path(path)
    suffix = _known_suffix(path)
    if suffix in HDF5_SUFFIXES:
        return read_table(path, start, stop)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    if suffix == ".csv":
        return _read_csv(path)[start:stop]
    from rasnik.io.parquet import read_columns

    columns, metadata = read_columns(path)
    _check_columns(path, columns)
    return Track(
        **{column.name: columns[column.name] for column in TRACK_COLUMNS},
        metadata={key: value for key, value in metadata.items() if value},
    )[start:stop]


def write_track(
    track: Track,
    path: str | os.PathLike[str],
    *,
    system: System | None = None,
    overwrite: bool = False,
) -> None:
    """Write a whole track in the format that the suffix names.

    The file appears when it is complete. To store a track while it is measured, use
    `TrackWriter`.

    Parameters
    ----------
    track : Track
        What its metadata hold is stored too, except in CSV.
    path : path-like
        Ends in one of `TRACK_SUFFIXES`.
    system : System, optional
        Stored in place of the one in the metadata.
    overwrite : bool
        Whether an existing file is replaced.

    Raises
    ------
    FileExistsError
        If the file exists and is not to be overwritten.
    ValueError
        If the suffix is not known; for HDF5, if the numbers of the frames do not increase.
    OSError
        If the file cannot be written.
    ImportError
        If the format needs an extra that is not installed.
    """
    path = Path(path)
    suffix = _known_suffix(path)
    if path.exists() and not overwrite:
        raise FileExistsError(
            f"{path} exists already; give another name, or overwrite=True to replace it"
        )
    metadata = track_metadata(system, {"start_time_utc": "", **track.metadata})
    unfinished = path.with_name(f"{path.stem}.partial{path.suffix}")
    unfinished.unlink(missing_ok=True)
    try:
        if suffix in HDF5_SUFFIXES:
            with TrackWriter(unfinished, metadata=metadata) as writer:
                writer.write(track)
        elif suffix == ".csv":
            _write_csv(track, unfinished)
        else:
            from rasnik.io.parquet import write_columns

            write_columns(unfinished, TRACK_COLUMNS, track.as_dict(), metadata)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _known_suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in TRACK_SUFFIXES:
        raise ValueError(
            f"{path}: {suffix or 'no suffix'} is not a format of tracks; "
            f"end the name in one of {', '.join(TRACK_SUFFIXES)}"
        )
    return suffix


def _check_columns(path: Path, names: object) -> None:
    missing = [c.name for c in TRACK_COLUMNS if c.name not in names]  # type: ignore[operator]
    if missing:
        raise ValueError(f"{path}: this is not a track; columns are missing: {', '.join(missing)}")


def _write_csv(track: Track, path: Path) -> None:
    """The shortest text of each number that reads back equal; what is not known is ``nan``."""
    with path.open("w", encoding="utf-8", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(track.as_dict())
        for first in range(0, len(track), 10_000):
            piece = track[first : first + 10_000].as_dict().values()
            lines.writerows(zip(*(values.tolist() for values in piece), strict=True))


def _read_csv(path: Path) -> Track:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            names = file.readline().strip().split(",")
            _check_columns(path, names)
            begin, is_empty = file.tell(), not file.readline()
            file.seek(begin)
            places = [names.index(column.name) for column in TRACK_COLUMNS]
            rows = (
                np.empty(0, dtype=ROW)
                if is_empty  # of which loadtxt would warn
                else np.loadtxt(file, dtype=ROW, delimiter=",", usecols=places, ndmin=1)
            )
    except UnicodeDecodeError:
        raise ValueError(f"{path}: this is not a text file in UTF-8") from None
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: the table is damaged or incomplete ({error})") from error
    return from_rows(rows)


# ------------------------------------------------------------------------ time series


def to_gwpy(track: Track, column: str = "x_um", *, tolerance: float = 0.05) -> TimeSeries:
    """One column of a track as a time series of gwpy, evenly sampled.

    Frames that are missing or have no position are NaN; nothing is interpolated. Needs
    ``pip install "rasnik[gw]"``.

    Parameters
    ----------
    track : Track
        With times.
    column : str
        Any column of numbers, such as ``"y_um"`` or ``"sigma_x_um"``.
    tolerance : float
        How far a frame may be from its place in an even series, as a fraction of the time
        between two.

    Returns
    -------
    gwpy.timeseries.TimeSeries
        In the unit of the column (grey levels are ``adu``), beginning at the time of the first
        frame. gwpy reads times as GPS seconds; those of a track have the zero of its source.

    Raises
    ------
    ValueError
        If there is no such column, or the times are unknown or not regular.
    ImportError
        If gwpy is not installed.
    """
    units = {c.name: c.unit for c in TRACK_COLUMNS if c.name in _SERIES_COLUMNS}
    if column not in units:
        raise ValueError(f"{column!r} is not one of the columns {', '.join(units)}")
    place, t0_s, rate_hz = _even_grid(track, tolerance)
    try:
        from gwpy.timeseries import TimeSeries
    except ImportError as error:
        raise ImportError(
            'Time series need gwpy; install it with: pip install "rasnik[gw]"'
        ) from error
    values = np.full(place[-1] + 1, np.nan)
    timed = np.isfinite(track.time_s)
    values[place] = np.where(track.ok, getattr(track, column), np.nan)[timed]
    unit = _GWPY_UNITS.get(units[column], units[column])
    return TimeSeries(values, t0=t0_s, sample_rate=rate_hz, unit=unit, name=column)


def _even_grid(track: Track, tolerance: float) -> tuple[NDArray[np.int64], float, float]:
    """(place of each frame that has a time, time of place 0 in s, places in a second)."""
    timed = np.isfinite(track.time_s)
    if (track.ok & ~timed).any() or np.count_nonzero(timed) < 2:
        raise ValueError(
            "a time series needs the time of every frame, and two frames at least; give times "
            "to the tracker"
        )
    first_s = float(track.time_s[timed][0])
    time_s = track.time_s[timed] - first_s
    steps_s = np.diff(time_s)
    if (steps_s <= 0).any():
        raise ValueError(f"the times are not regular: they go back or stand still; {_REMEDY}")
    # Between frames with successive numbers, where there are any.
    successive = np.diff(track.frame[timed]) == 1
    step_s = np.median(steps_s[successive] if successive.any() else steps_s)
    place = np.zeros(len(time_s), dtype=np.int64)
    place[1:] = np.cumsum(np.rint(steps_s / step_s))
    if (np.diff(place) < 1).any():
        raise ValueError(
            f"the times are not regular: two frames are less than half of the usual "
            f"{step_s:.3g} s apart; {_REMEDY}"
        )
    step_s, offset_s = (float(value) for value in np.polyfit(place, time_s, 1))
    off = float(np.abs(time_s - offset_s - place * step_s).max() / step_s)
    if off > tolerance:
        raise ValueError(
            f"the times are not regular: a frame is {off:.2g} of the {step_s:.3g} s between two "
            f"away from its place, more than the tolerance of {tolerance:g}; {_REMEDY}"
        )
    # Rounding errors of the times must not make 860.0000000001 Hz of 860 Hz.
    negligible = 1e-6
    if abs(offset_s) < negligible * step_s:
        offset_s = 0.0
    rates_hz = (float(f"{1 / step_s:.{digits}g}") for digits in range(1, 18))
    rate_hz = next(r for r in rates_hz if abs(r * step_s - 1) * place[-1] < negligible)
    return place, first_s + offset_s, rate_hz
