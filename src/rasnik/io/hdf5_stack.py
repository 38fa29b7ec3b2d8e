"""Images in HDF5 files: datasets of (height, width) or (frames, height, width)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rasnik.io.array_choice import choose_images
from rasnik.io.formats import Stack, frames_of_array
from rasnik.io.utc import EARLIEST_S

__all__ = ["TIME_NAMES", "open_hdf5", "times_as_function"]

#: Times of frames (s since 1970 UTC), in an array beside the images.
TIME_NAMES = ("time_s", "host_time_s")
_ROWS = "poses"  # the table that a recording of frames has beside them


@contextmanager
def open_hdf5(path: Path, dataset: str | None) -> Iterator[Stack]:
    """Open an HDF5 file as a stack of grey images.

    The times of the frames are those in the table ``poses`` of a recording, or in a dataset
    ``time_s`` or ``host_time_s`` in the same group.

    Raises
    ------
    ImageFileError
        If there are no images in it, or several stacks and none was asked for.
    """
    with h5py.File(path, "r") as file:
        name = choose_images(
            _dimensions(file), dataset, file_name=path.name, kind="HDF5 file", part="dataset"
        )
        stack = frames_of_array(file[name], f"dataset {name}")
        times = times_as_function(_times(file[name].parent), stack.count)
        yield Stack(stack.count, stack.read, time_s=times)


def _dimensions(file: h5py.File) -> dict[str, int]:
    """Number of dimensions of every dataset of numbers."""
    found: dict[str, int] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            found["/" + name] = item.ndim if item.dtype.kind in "uif" else 0

    file.visititems(visit)
    return found


def _times(group: Any) -> NDArray[np.float64] | None:
    """Times stored beside the images."""
    rows = group.get(_ROWS)
    for name in TIME_NAMES:
        if isinstance(rows, h5py.Dataset) and name in (rows.dtype.names or ()):
            return np.asarray(rows.fields(name)[:], dtype=np.float64)
        one = group.get(name)
        if isinstance(one, h5py.Dataset) and one.ndim == 1 and one.dtype.kind in "uif":
            return np.asarray(one[:], dtype=np.float64)
    return None


def times_as_function(
    times: NDArray[np.float64] | None, count: int
) -> Callable[[int], float] | None:
    """Time of a frame by its index; None where there is not one for each frame.

    NaN for times with another zero than 1970, as that of the recording.
    """
    if times is None or len(times) < count:
        return None
    return lambda index: float(times[index]) if times[index] >= EARLIEST_S else math.nan
