"""Frames from image files, folders and stacks, one at a time.

A file that cannot be read gives a `Frame` with an error sentence in place of an image; the
others still come out.
"""

from __future__ import annotations

import glob
import math
import os
import re
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.io.folders import is_url, is_zarr_folder, natural_key
from rasnik.io.formats import (
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    EndOfStack,
    ImageFileError,
    Stack,
    open_stack,
)
from rasnik.io.lwdaq import lwdaq_bounds, lwdaq_text

__all__ = ["Frame", "Source", "count_frames", "expand_paths", "iter_frames", "split_dataset"]

_SINGLE = (".png", ".bmp", ".jpg", ".jpeg")  # formats of one image a file

Bounds = tuple[int, int, int, int]
PathLike = str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class Frame:
    """One image and where it came from.

    Attributes
    ----------
    file : str
        Name of the file as found; ``file.h5:/dataset`` if a dataset was named.
    frame : int
        Index within the file, from 0.
    image : ndarray, shape (height, width), or None
        Grey levels as stored: integers or floats. None if it could not be read.
    error : str or None
        Why there is no image: a sentence with the file's name and what to do.
    bounds_px : tuple of int or None
        (left, top, right, bottom) of the picture within the image, in pixels, last column and
        row included. None: the whole image.
    header_rows : int
        Rows at the top that are not picture but data (1 for LWDAQ images).
    notes : tuple of str
        What was done to the image on reading it.
    time_s : float
        When it was taken, since 1970 UTC, if the file says it; NaN if not.
    time_source : str
        Where the time is from: "metadata" of the file, or what the reader of an archive found.
    """

    file: str
    frame: int = 0
    image: NDArray[Any] | None = None
    error: str | None = None
    bounds_px: Bounds | None = None
    header_rows: int = 0
    notes: tuple[str, ...] = ()
    time_s: float = math.nan
    time_source: str = ""

    def clip_bounds(self, bounds_px: Bounds | None) -> Bounds | None:
        """The given bounds, without header rows; by default the frame's own bounds.

        Raises
        ------
        ValueError
            If the bounds do not lie within the image.
        """
        if bounds_px is None or self.image is None:
            return self.bounds_px
        left, top, right, bottom = bounds_px
        height, width = self.image.shape
        if right >= width or bottom >= height:
            raise ValueError(
                f"the bounds {left},{top},{right},{bottom} reach beyond the image, whose last "
                f"column is {width - 1} and last row {height - 1}; give smaller bounds"
            )
        top = max(top, self.header_rows)
        if bottom <= top:
            raise ValueError(
                f"the bounds {left},{top},{right},{bottom} leave no picture below the header "
                "row; give larger bounds"
            )
        return left, top, right, bottom


@dataclass(frozen=True)
class Source:
    """One file to read, or the reason why there is none.

    What does not lie on this machine has a `url`, and its path does not exist.
    """

    name: str
    path: Path
    dataset: str | None = None
    error: str | None = None
    url: str | None = None


def split_dataset(name: str) -> tuple[str, str | None]:
    """File and dataset of ``file.h5:/dataset`` or ``store.zarr:/array``."""
    match = re.fullmatch(r"(.*\.(?:h5|hdf5|zarr)):(/.*)", name, re.IGNORECASE)
    return (match[1], match[2]) if match else (name, None)


def _expand(name: str) -> list[Source]:
    file_name, dataset = split_dataset(name)
    if is_url(file_name):
        return [Source(name, Path(file_name), dataset, url=file_name)]
    path = Path(file_name)
    if path.is_dir() and not is_zarr_folder(path):
        try:
            entries = sorted(path.iterdir(), key=lambda p: natural_key(p.name))
        except OSError as error:
            reason = error.strerror or str(error)
            return [Source(name, path, error=f"the folder cannot be read: {reason}")]
        for suffixes in (IMAGE_SUFFIXES, VIDEO_SUFFIXES):
            files = [p for p in entries if p.suffix.lower() in suffixes and p.is_file()]
            if files:
                break
        known = ", ".join(suffix[1:] for suffix in IMAGE_SUFFIXES + VIDEO_SUFFIXES)
        return [Source(str(p), p) for p in files] or [
            Source(name, path, error=f"the folder holds no images ({known}); name another")
        ]
    if not path.exists() and glob.has_magic(file_name):
        matches = sorted(Path(match) for match in glob.glob(file_name, recursive=True))
        matches.sort(key=lambda p: (str(p.parent), natural_key(p.name)))
        sources = [Source(str(p), p, dataset) for p in matches if p.is_file()]
        return sources or [
            Source(name, path, error="no file matches this pattern; check it and the folder")
        ]
    return [Source(name, path, dataset)]


def expand_paths(paths: Iterable[PathLike]) -> list[Source]:
    """Files behind names of files, folders and patterns.

    Folders give the images in them (not those in folders below), sorted naturally, or if there
    are none the videos; HDF5 files are left out, since they hold results as often as images.
    Patterns (``*``, ``?``, ``[]``, ``**``) are expanded here if the shell has not done it. A
    folder without images and a pattern without matches give one `Source` with an `error`.
    """
    return [source for path in paths for source in _expand(os.fspath(path))]


def _sentence(name: str, reason: str) -> str:
    return f"{name}: {reason.rstrip('.')}."


def _decoder_failure(path: Path, error: Exception) -> str:
    """What a decoder's exception means to the user."""
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, PermissionError):
        return "the file cannot be read: permission denied; change its permissions"
    if isinstance(error, MemoryError):
        return "the image is too large for the memory; cut it or split the stack"
    if re.search(r"truncat|end of file|EOF|not enough|buffer", text, re.IGNORECASE):
        return f"the file is truncated or damaged ({text}); copy it again"
    kind = path.suffix[1:].upper() or "image"
    return (
        f"the file cannot be read as {kind} ({text}); it is damaged or of an unusual kind, "
        "save it again as PNG or TIFF"
    )


def _check(image: NDArray[Any]) -> tuple[str, ...]:
    """Refuse what is no image; note what is odd about it."""
    if image.ndim != 2 or 0 in image.shape:
        raise ImageFileError(
            f"the image has the shape {image.shape}; grey images of (height, width) are needed"
        )
    if image.dtype.kind != "f":
        return ()
    bad = image.size - int(np.count_nonzero(np.isfinite(image)))
    if bad == image.size:
        raise ImageFileError("every pixel is NaN or infinite; check how the image was made")
    return (f"{bad} of {image.size} pixels are NaN or infinite",) if bad else ()


def _frame(source: Source, index: int, stack: Stack) -> Frame:
    image, notes = stack.read(index)
    time_s = math.nan if stack.time_s is None else stack.time_s(index)
    notes += _check(image)
    bounds = lwdaq_bounds(image)
    if bounds is not None:
        left, top, right, bottom = bounds
        notes += (f"LWDAQ header in row 0: bounds {left},{top},{right},{bottom}",)
        text = lwdaq_text(image)
        notes += (f"its text: {text}",) if text else ()
    return Frame(
        source.name,
        index,
        image,
        bounds_px=bounds,
        header_rows=int(bounds is not None),
        notes=notes,
        time_s=time_s,
        time_source="metadata" if math.isfinite(time_s) else "",
    )


def _error_frame(source: Source, index: int, error: Exception | str) -> Frame:
    if isinstance(error, Exception) and not isinstance(error, ImageFileError):
        error = _decoder_failure(source.path, error)
    name = f"{source.name}[{index}]" if index else source.name
    return Frame(source.name, index, error=_sentence(name, str(error)))


def _frames_of(source: Source, start: int) -> Generator[Frame, None, int]:
    """Frames from number `start` on; returns how many of those before `start` it does not have."""
    # Decoders raise nearly anything on damaged files, hence the broad excepts.
    if source.error is not None:
        if start == 0:
            yield _error_frame(source, 0, source.error)
        return max(0, start - 1)
    try:
        with open_stack(source.url or source.path, source.dataset) as stack:
            total, fault = stack.count, stack.error
            for index in range(start, total) if stack.counted else count(start):
                try:
                    frame = _frame(source, index, stack)
                except EndOfStack as end:
                    total, fault = end.count, end.error
                    break
                except Exception as error:
                    frame = _error_frame(source, index, error)
                yield frame
            if fault is not None and start <= total:
                yield _error_frame(source, total, fault)
            return max(0, start - total - (fault is not None))
    except Exception as error:
        if start == 0:
            yield _error_frame(source, 0, error)
        return max(0, start - 1)


def iter_frames(paths: Iterable[PathLike | Source], start: int = 0) -> Iterator[Frame]:
    """Every frame of the files, folders and patterns named.

    Reads PNG, TIFF (with pages), GIF, BMP, PGM, PPM, JPEG, NPY, HDF5 and Zarr (two- or
    three-dimensional; ``file.h5:/dataset`` where there are several) and video, also from URLs.
    Colour becomes Rec. 601 luminance, which is noted. Nothing is kept in memory but the current
    frame, except a PGM file's bytes and a chunk of a Zarr store.

    Parameters
    ----------
    paths : iterable of path-like or Source
    start : int
        Number of frames to leave out at the beginning; they are not read.

    Yields
    ------
    Frame
        One with `error` set, and without image, for each file or frame that cannot be read.
        The whole frames of a truncated stack are given, and then the error.
    """
    for path in paths:
        for source in [path] if isinstance(path, Source) else _expand(os.fspath(path)):
            start = yield from _frames_of(source, start)


def count_frames(source: Source) -> int:
    """Number of frames `iter_frames` will give for a source; only headers are read.

    Of a video it is the number that its header promises, or an estimate from its duration.
    """
    if source.error is not None:
        return 1
    if source.url is not None and source.url.partition("::")[0].lower().endswith(_SINGLE):
        return 1  # not worth a copy
    try:
        with open_stack(source.url or source.path, source.dataset) as stack:
            return stack.count + (stack.error is not None)
    except Exception:  # reported when the file is read
        return 1
