"""PGM and PPM files, plain or binary, one image or several."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.io.formats import ImageFileError, Stack, from_channels

__all__ = ["open_pnm"]

Image = NDArray[Any]

_PNM_TOKEN = re.compile(rb"(?:\s|#[^\n]*\n)*([^\s#]+)")


@dataclass(frozen=True)
class _PnmHeader:
    kind: bytes
    width: int
    height: int
    maximum: int
    offset: int

    @property
    def channels(self) -> int:
        return 3 if self.kind in (b"P3", b"P6") else 1

    @property
    def binary(self) -> bool:
        return self.kind in (b"P5", b"P6")

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype("u1" if self.maximum < 256 else ">u2")

    @property
    def size(self) -> int:
        return self.width * self.height * self.channels

    @property
    def end(self) -> int:
        return self.offset + self.size * self.dtype.itemsize


def _pnm_header(data: bytes, start: int) -> _PnmHeader:
    kind, position, numbers = data[start : start + 2], start + 2, []
    for _ in range(3):
        match = _PNM_TOKEN.match(data, position)
        if match is None or not match[1].isdigit():
            raise ImageFileError("the PGM header is damaged or cut off; copy the file again")
        numbers.append(int(match[1]))
        position = match.end()
    width, height, maximum = numbers
    if not (width and height and 0 < maximum < 65536):
        raise ImageFileError(
            f"the PGM header gives {width} x {height} pixels and a maximum of {maximum}, which "
            "is no image; write the file again"
        )
    return _PnmHeader(kind, width, height, maximum, position + 1)


def _pnm_pixels(data: bytes, header: _PnmHeader) -> Image:
    if header.binary:
        found = (len(data) - header.offset) // header.dtype.itemsize
        values = np.frombuffer(data, header.dtype, min(found, header.size), header.offset)
    else:
        text = re.sub(rb"#[^\n]*", b"", data[header.offset :]).split()
        values = np.array(text[: header.size], dtype=np.int64)
    if values.size < header.size:
        raise ImageFileError(
            f"the file is truncated: {values.size} of {header.size} values are there; copy it again"
        )
    pixels = values.astype(np.uint8 if header.maximum < 256 else np.uint16)
    shape = (header.height, header.width, header.channels)
    return pixels.reshape(shape)


@contextmanager
def open_pnm(path: Path) -> Iterator[Stack]:
    """PGM and PPM, plain or binary, 8 or 16 bit; several images in one file as well.

    Grey levels are as stored, not stretched to the full range of 8 or 16 bits.
    """
    data = path.read_bytes()
    headers = [_pnm_header(data, 0)]
    while headers[-1].binary:
        start = headers[-1].end
        if data[start : start + 2] not in (b"P5", b"P6"):
            break
        headers.append(_pnm_header(data, start))

    def read(index: int) -> tuple[Image, tuple[str, ...]]:
        return from_channels(_pnm_pixels(data, headers[index]))

    yield Stack(len(headers), read)
