"""TIFF files: single images, multi-page files, stacks with one directory for many frames."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rasnik.io.formats import ImageFileError, Stack, check_size, from_channels, open_pillow

__all__ = ["open_tiff"]

Image = NDArray[Any]

_TRUNCATED = "the TIFF file is truncated, not all of its pages are there; copy it again"


def _directories_complete(file: BinaryIO, size: int) -> bool:
    """Whether the list of page directories ends inside the file, as it must.

    tifffile leaves out, with no more than a line in the log, the pages whose directory is
    missing; a truncated file would look like a shorter one.
    """
    file.seek(0)
    head = file.read(16)
    order = "<" if head[:2] == b"II" else ">"
    big = head[2:4] in (b"+\0", b"\0+")
    entry_bytes, count_code, offset_code = (20, "Q", "Q") if big else (12, "H", "I")
    count_bytes, offset_bytes = struct.calcsize(count_code), struct.calcsize(offset_code)
    start = 8 if big else 4
    if len(head) < start + offset_bytes:
        return False
    (offset,) = struct.unpack_from(order + offset_code, head, start)
    seen: set[int] = set()
    while offset:
        if offset in seen or offset + count_bytes > size:
            return False
        seen.add(offset)
        file.seek(offset)
        (entries,) = struct.unpack(order + count_code, file.read(count_bytes))
        end = offset + count_bytes + entries * entry_bytes
        if end + offset_bytes > size:
            return False
        file.seek(end)
        (offset,) = struct.unpack(order + offset_code, file.read(offset_bytes))
    return bool(seen)


def _is_complete(page: Any, size: int) -> bool:
    ends = np.add(page.dataoffsets, page.databytecounts)
    return len(ends) > 0 and int(np.max(ends)) <= size


def _grey_levels(pixels: Image, page: Any) -> tuple[Image, tuple[str, ...]]:
    """Grey image from a page's samples, whatever they stand for."""
    keyframe = page.keyframe
    photometric = getattr(keyframe.photometric, "name", "")
    if photometric == "PALETTE" and keyframe.colormap is not None:
        colours = np.moveaxis(np.asarray(keyframe.colormap), 0, -1)[pixels]
        if (colours % 257 == 0).all():  # 8-bit colours, stored as 16-bit ones
            colours = (colours // 257).astype(np.uint8)
        return from_channels(colours)
    if pixels.dtype == bool:
        pixels = pixels.astype(np.uint8)
    if pixels.ndim == 3 and keyframe.axes == "SYX":
        pixels = np.moveaxis(pixels, 0, -1)
    if pixels.ndim > 3 or (pixels.ndim == 3 and pixels.shape[-1] > 4):
        raise ImageFileError(
            f"a TIFF page has the shape {pixels.shape}; store grey pages of (height, width)"
        )
    grey, notes = from_channels(pixels)
    if photometric == "MINISWHITE" and grey.dtype.kind == "u":
        grey = (2**keyframe.bitspersample - 1 - grey).astype(grey.dtype)
        notes += ("stored with 0 as white, inverted",)
    return grey, notes


def _frames(tif: Any, size: int) -> tuple[list[tuple[Any, int | None]], bool]:
    """(page, None) or (series, index) of every frame, and whether all are in the file."""
    frames: list[tuple[Any, int | None]] = []
    complete = True
    if len(tif.series) == 1 and tif.is_uniform:
        tif.pages.useframes = True  # of pages that are alike only what differs is read
    for series in tif.series:
        pages = [page for page in series.pages if page is not None]
        if not pages or pages[0].keyframe.is_reduced:
            continue  # a thumbnail
        count = int(np.prod(series.shape) // max(1, np.prod(pages[0].shape)))
        if count <= len(pages):
            whole = [page for page in pages if _is_complete(page, size)]
            frames += [(page, None) for page in whole]
            complete &= len(whole) == len(pages)
        elif series.dataoffset is None:
            raise ImageFileError(
                f"the TIFF stack {series.shape} is stored in a way not read here; "
                "save it with one page per frame"
            )
        else:
            present = min(count, (size - series.dataoffset) // (series.nbytes // count))
            frames += [(series, index) for index in range(present)]
            complete &= present == count
    return frames, complete


def _contiguous_frame(path: Path, series: Any, index: int) -> Image:
    """Frame of a stack with one page directory for all (ImageJ writes these)."""
    page = series.pages[0]
    bytes_each = int(np.prod(page.shape)) * series.dtype.itemsize
    dtype = series.dtype.newbyteorder(series.parent.byteorder if series.parent else "=")
    pixels = np.fromfile(
        path, dtype, int(np.prod(page.shape)), offset=series.dataoffset + index * bytes_each
    )
    return pixels.reshape(page.shape).astype(series.dtype.newbyteorder("="))


def _date(page: Any) -> float:
    """The date of a page, taken as UTC, in s since 1970; NaN without one."""
    try:
        date = page.aspage().datetime
    except (AttributeError, ValueError):
        return math.nan
    return math.nan if date is None else float(date.replace(tzinfo=UTC).timestamp())


@contextmanager
def open_tiff(path: Path) -> Iterator[Stack]:
    """Open a TIFF file as a stack of grey images; thumbnails are left out.

    The time of a frame is the date of its page, or that of the first page.

    Raises
    ------
    ImageFileError
        If the file is truncated or stored in a way not read here.
    """
    import tifffile

    size = path.stat().st_size
    with path.open("rb") as file:
        complete = _directories_complete(file, size)
    with ExitStack() as opened:
        try:
            tif = opened.enter_context(tifffile.TiffFile(path))
            frames, all_there = _frames(tif, size)
            if not complete:  # the pages may then be more than tifffile's series
                pages = [page for page in tif.pages if _is_complete(page, size)]
                if len(pages) > len(frames):
                    frames = [(page, None) for page in pages]
        except Exception as error:
            if complete:
                raise
            raise ImageFileError(_TRUNCATED) from error
        if not frames:
            raise ImageFileError(_TRUNCATED)

        def read(index: int) -> tuple[Image, tuple[str, ...]]:
            source, part = frames[index]
            page = source if part is None else source.pages[0]
            check_size(page.keyframe.imagelength, page.keyframe.imagewidth)
            try:
                pixels = page.asarray() if part is None else _contiguous_frame(path, source, part)
            except ValueError as error:
                if "imagecodecs" not in str(error):
                    raise
                # Compressions (LZW, JPEG) and packed 12 bits that tifffile leaves to an optional
                # package are read by Pillow.
                if not complete:
                    raise ImageFileError(_TRUNCATED) from error
                with open_pillow(path) as stack:
                    return stack.read(page.index)
            return _grey_levels(pixels, page)

        def time_s(index: int) -> float:
            source, part = frames[index]
            own = _date(source if part is None else source.pages[0])
            return own if math.isfinite(own) else _date(tif.pages.first)

        fault = None if complete and all_there else _TRUNCATED
        yield Stack(len(frames), read, fault, time_s=time_s)
