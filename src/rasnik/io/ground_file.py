"""Ground motion into files: one row for each place of the grid, one column for each direction.

``.csv`` holds the columns alone; ``.h5`` and ``.parquet`` also how the motion was found. What is
not known is NaN. For miniSEED see `rasnik.io.seismic_files`.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rasnik.seismic.ground import GroundMotion
from rasnik.seismic.suspension import QUANTITIES, Suspension
from rasnik.tracking.track import TrackColumn

__all__ = ["GROUND_SUFFIXES", "write_ground"]

GROUND_SUFFIXES = (".h5", ".hdf5", ".csv", ".parquet")

_PER_TIME = ("", "_per_s", "_per_s2")


def write_ground(
    motions: Mapping[str, GroundMotion],
    suspension: Suspension,
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
) -> None:
    """Write motions of one grid; the file appears when it is complete.

    Parameters
    ----------
    motions : mapping of str to GroundMotion
        By direction, as "x"; the columns are ``time_s`` and ``x_velocity_nm_per_s``.
    suspension : Suspension
        Stored in HDF5 and Parquet.
    path : path-like
        Ends in one of `GROUND_SUFFIXES`.
    overwrite : bool
        Whether an existing file is replaced.

    Raises
    ------
    FileExistsError
        If the file exists and is not to be overwritten.
    ValueError
        If the suffix is not known, or the motions have different grids.
    OSError
        If the file cannot be written.
    ImportError
        If the format needs an extra that is not installed.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in GROUND_SUFFIXES:
        raise ValueError(
            f"{path}: {suffix or 'no suffix'} is not a format of ground motion; end the name in "
            f"one of {', '.join(GROUND_SUFFIXES)}"
        )
    if path.exists() and not overwrite:
        raise FileExistsError(
            f"{path} exists already; give another name, or overwrite=True to replace it"
        )
    columns, arrays = _table(motions)
    about = {"suspension": suspension.model_dump_json()}
    for name, motion in motions.items():
        low, high = motion.band_hz
        about[f"{name}_motion"] = (
            f"{motion.name}; complete from {low:g} to {high:g} Hz, method {motion.method}, "
            f"{motion.edge_s:g} s missing at each end of a stretch"
        )
        if motion.exposure_s:
            about[f"{name}_motion"] += f", mean over an exposure of {motion.exposure_s:g} s undone"
        if math.isfinite(motion.sigma):
            about[f"{name}_sigma"] = (
                f"{motion.sigma:.6g} {motion.unit} by the noise of the readings"
            )
    unfinished = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        if suffix == ".csv":
            with unfinished.open("w", encoding="utf-8", newline="") as file:
                lines = csv.writer(file, lineterminator="\n")
                lines.writerow(arrays)
                lines.writerows(zip(*(values.tolist() for values in arrays.values()), strict=True))
        elif suffix == ".parquet":
            from rasnik.io.parquet import write_columns

            write_columns(unfinished, columns, arrays, about)
        else:
            _write_hdf5(unfinished, columns, arrays, about)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _table(
    motions: Mapping[str, GroundMotion],
) -> tuple[list[TrackColumn], dict[str, np.ndarray]]:
    """Columns, and their values by name."""
    grids = {(len(one), one.rate_hz, one.start_s) for one in motions.values()}
    if len(grids) != 1:
        raise ValueError("the motions must be one or more, with the same times")
    length, rate_hz, start_s = grids.pop()
    columns = [TrackColumn("time_s", "f8", "s", "time of the reading")]
    arrays = {"time_s": start_s + np.arange(length) / rate_hz}
    for name, motion in motions.items():
        end = motion.unit.partition("/")[0] + _PER_TIME[QUANTITIES[motion.quantity]]
        column = f"{name}_{motion.quantity}_{end}"
        columns.append(TrackColumn(column, "f8", motion.unit, motion.name))
        arrays[column] = motion.values
    return columns, arrays


def _write_hdf5(
    path: Path,
    columns: list[TrackColumn],
    arrays: Mapping[str, np.ndarray],
    about: Mapping[str, str],
) -> None:
    """One data set for each column, its unit and meaning as attributes."""
    import h5py

    with h5py.File(path, "w") as file:
        for column in columns:
            stored = file.create_dataset(column.name, data=arrays[column.name])
            stored.attrs["unit"] = column.unit
            stored.attrs["description"] = column.description
        file.attrs.update(dict(about))
