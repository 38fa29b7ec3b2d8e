"""LWDAQ's own image files (``.daq``): the 8-bit pixels and nothing else, header in row 0."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from rasnik.io.formats import Image, ImageFileError, Stack

__all__ = ["open_daq"]


@contextmanager
def open_daq(path: Path) -> Iterator[Stack]:
    """Open a file whose size is told by the last row and column in its first four bytes.

    Source: read_daq_file and image_from_daq in images.pas of https://github.com/OSI-INC/LWDAQ.
    """
    data = np.fromfile(path, dtype=np.uint8)
    if data.size < 4:
        raise ImageFileError("the file is truncated: its header is missing; copy it again")
    last_row, last_column = (int(number) for number in data[:4].view(">u2"))
    shape = (last_row + 1, last_column + 1)
    if data.size != shape[0] * shape[1]:
        raise ImageFileError(
            f"its header tells of {shape[1]} x {shape[0]} pixels, but the file has {data.size} "
            "bytes; it is truncated or no image of LWDAQ, copy it again"
        )

    def read(index: int) -> tuple[Image, tuple[str, ...]]:
        return data.reshape(shape), ()

    yield Stack(1, read)
