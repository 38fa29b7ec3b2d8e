"""Decoders: one image file, of whatever format, as a stack of grey images.

A file's format is found from its first bytes, its name is only a hint. Every decoder checks that
the file is complete: a truncated image is an error, never an image with an empty lower half.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.io.folders import is_url, is_zarr_folder

__all__ = [
    "IMAGE_SUFFIXES",
    "STACK_SUFFIXES",
    "VIDEO_SUFFIXES",
    "EndOfStack",
    "ImageFileError",
    "Stack",
    "open_stack",
    "to_grey",
]

Image = NDArray[Any]

#: What a folder is searched for.
IMAGE_SUFFIXES = tuple(".png .tif .tiff .gif .bmp .pgm .ppm .pnm .npy .jpg .jpeg .daq".split())
#: HDF5 files hold images or results; they are read when named or matched by a pattern.
STACK_SUFFIXES = (".h5", ".hdf5")
#: A folder is searched for videos if it holds no images.
VIDEO_SUFFIXES = tuple(".mkv .avi .mp4 .m4v .mov .webm .mpg .mpeg .wmv .y4m .nut".split())

LUMINANCE = (0.299, 0.587, 0.114)
#: Larger than the image of any camera; a few bytes of a damaged file can ask for more.
_MOST_PIXELS = 1 << 28


class ImageFileError(ValueError):
    """An image cannot be read; the message says what is wrong and what to do about it."""


class EndOfStack(Exception):  # noqa: N818 -- not an error, as StopIteration is none
    """There are no frames from this one on, in a stack that could not count them beforehand."""

    def __init__(self, count: int, error: str | None = None) -> None:
        super().__init__(f"the stack has {count} frames")
        self.count, self.error = count, error


@dataclass(frozen=True)
class Stack:
    """The frames of one open file, read one at a time.

    Attributes
    ----------
    count : int
        Number of frames.
    read : callable
        ``read(index)`` gives the image, shape (height, width), and notes on what was done to it.
    error : str, optional
        What is wrong with the file after the last of these frames.
    counted : bool
        False: `count` is what the file promises, and `read` raises `EndOfStack` after the last
        frame that is there.
    time_s : callable, optional
        ``time_s(index)`` gives when a frame was taken, since 1970 UTC; NaN if not known.
    """

    count: int
    read: Callable[[int], tuple[Image, tuple[str, ...]]]
    error: str | None = None
    counted: bool = True
    time_s: Callable[[int], float] | None = None


def to_grey(colours: Image) -> Image:
    """Rec. 601 luminance of an image of shape (height, width, 3), not rounded to integers.

    Exactly the common value where the three channels are equal.
    """
    red, green, blue = (colours[..., channel] for channel in range(3))
    if np.array_equal(red, green) and np.array_equal(green, blue):
        return np.ascontiguousarray(red)
    weights = np.asarray(LUMINANCE, dtype=np.float64)
    return (colours[..., :3].astype(np.float64) @ weights).astype(np.float32)


def from_channels(pixels: Image) -> tuple[Image, tuple[str, ...]]:
    """Grey image and notes from (height, width) or (height, width, 1 to 4 channels)."""
    if pixels.ndim == 2:
        return pixels, ()
    channels = pixels.shape[2]
    notes = []
    if channels in (2, 4):
        alpha = pixels[..., -1]
        if (alpha != alpha.flat[0]).any():
            notes.append("transparency ignored")
    if channels <= 2:
        return np.ascontiguousarray(pixels[..., 0]), tuple(notes)
    grey = to_grey(pixels[..., :3])
    if grey.dtype != pixels.dtype or not np.array_equal(pixels[..., 0], pixels[..., 1]):
        notes.append("colour converted to grey (Rec. 601 luminance)")
    return grey, tuple(notes)


def check_size(height: int, width: int) -> None:
    """Refuse what would take all the memory, before any of it is read.

    Raises
    ------
    ImageFileError
    """
    if height * width > _MOST_PIXELS:
        raise ImageFileError(
            f"an image has {width} x {height} pixels, more than the {_MOST_PIXELS >> 20} million "
            "that are read; if the file is not damaged, cut it"
        )


# ------------------------------------------------------------------------ Pillow: PNG, GIF, ...


def _png_notes(path: Path) -> tuple[str, ...]:
    """Pillow keeps the upper 8 of the 16 bits of a colour PNG; say so."""
    with path.open("rb") as file:
        head = file.read(26)
    if head[:4] == b"\x89PNG" and len(head) == 26 and head[24] == 16 and head[25] != 0:
        return ("the upper 8 of 16 bits were read; store grey 16-bit images to keep all",)
    return ()


def _check_end(path: Path) -> None:
    """Formats with an end marker: Pillow is content with a file that lacks the last bytes."""
    with path.open("rb") as file:
        head = file.read(4)
        file.seek(max(0, path.stat().st_size - 4096))
        tail = file.read()
    complete = True
    if head == b"\x89PNG":
        complete = b"IEND" in tail
    elif head == b"GIF8":
        complete = tail.rstrip(b"\0").endswith(b";")
    elif head.startswith(b"\xff\xd8"):
        complete = b"\xff\xd9" in tail
    if not complete:
        raise ImageFileError("the file is truncated (its end is missing); copy it again")


@contextmanager
def open_pillow(path: Path) -> Iterator[Stack]:
    from PIL import Image as PillowImage

    _check_end(path)
    extra = _png_notes(path)
    with PillowImage.open(path, formats=["PNG", "GIF", "BMP", "JPEG", "TIFF"]) as picture:
        if picture.format == "JPEG":
            extra += ("JPEG compression has altered the grey levels",)

        def read(index: int) -> tuple[Image, tuple[str, ...]]:
            picture.seek(index)
            picture.load()
            mode = picture.mode
            if mode in ("P", "CMYK", "YCbCr", "LAB", "HSV", "PA", "RGBX"):
                pixels = np.asarray(picture.convert("RGB"))
            elif mode == "1":
                pixels = np.asarray(picture.convert("L"))
            else:
                pixels = np.asarray(picture)
            grey, notes = from_channels(pixels)
            return grey, extra + notes

        yield Stack(getattr(picture, "n_frames", 1), read)


# ------------------------------------------------------------------------ NumPy and other arrays


def frames_of_array(array: Any, what: str) -> Stack:
    """Stack from an array-like of shape (height, width), (n, height, width) or with channels."""
    shape, dtype = tuple(array.shape), np.dtype(array.dtype)
    if dtype.kind not in "buif":
        raise ImageFileError(
            f"{what} holds values of type {dtype}; store grey levels as integers or floats"
        )
    has_channels = len(shape) >= 3 and shape[-1] in (3, 4) and shape[-2] > 4
    grey_shape = shape[:-1] if has_channels else shape
    if len(grey_shape) not in (2, 3):
        raise ImageFileError(
            f"{what} has {len(shape)} dimensions {shape}; store one image (height, width) "
            "or a stack (frames, height, width)"
        )
    if 0 in shape:
        raise ImageFileError(f"{what} is empty, its shape is {shape}; write it again")
    check_size(*grey_shape[-2:])
    single = len(grey_shape) == 2

    def read(index: int) -> tuple[Image, tuple[str, ...]]:
        pixels = np.array(array[...] if single else array[index])
        return from_channels(pixels.astype(np.uint8) if pixels.dtype == bool else pixels)

    return Stack(1 if single else grey_shape[0], read)


@contextmanager
def _open_npy(path: Path) -> Iterator[Stack]:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except ValueError as error:
        if "mmap length" in str(error) or "EOF" in str(error):
            raise ImageFileError("the file is truncated; copy it again") from error
        raise ImageFileError(
            f"the array cannot be read ({error}); store grey levels as integers or floats"
        ) from error
    yield frames_of_array(array, "the array")


# ------------------------------------------------------------------------ which decoder


def _open_tiff(path: Path) -> AbstractContextManager[Stack]:
    from rasnik.io.tiff import open_tiff

    return open_tiff(path)


def _open_pnm(path: Path) -> AbstractContextManager[Stack]:
    from rasnik.io.pnm import open_pnm

    return open_pnm(path)


def _open_video(path: Path) -> AbstractContextManager[Stack]:
    from rasnik.io.video import open_video

    return open_video(path)


_MAGIC: tuple[tuple[bytes, Callable[[Path], AbstractContextManager[Stack]]], ...] = (
    (b"\x89PNG", open_pillow),
    (b"GIF8", open_pillow),
    (b"BM", open_pillow),
    (b"\xff\xd8\xff", open_pillow),
    (b"II*\0", _open_tiff),
    (b"MM\0*", _open_tiff),
    (b"II+\0", _open_tiff),
    (b"MM\0+", _open_tiff),
    (b"P2", _open_pnm),
    (b"P3", _open_pnm),
    (b"P5", _open_pnm),
    (b"P6", _open_pnm),
    (b"\x93NUMPY", _open_npy),
)
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


def _is_video(head: bytes, suffix: str) -> bool:
    """Matroska, AVI, MP4 or Y4M by the first bytes; what else FFmpeg reads by the name."""
    avi = head[:4] == b"RIFF" and head[8:12] == b"AVI "
    known = head.startswith((b"\x1a\x45\xdf\xa3", b"YUV4MPEG2")) or head[4:8] == b"ftyp"
    return avi or known or suffix in VIDEO_SUFFIXES


def open_stack(path: Path | str, dataset: str | None = None) -> AbstractContextManager[Stack]:
    """Open an image file, or a Zarr store.

    Parameters
    ----------
    path : Path or str
        On this machine, or a URL.
    dataset : str, optional
        Dataset of an HDF5 file or array of a Zarr store, needed if it holds more than one that
        can be images.

    Returns
    -------
    context manager of Stack

    Raises
    ------
    ImageFileError
        If the file is missing, empty, or of no format known here; and, when it is entered or
        read, if it is truncated, damaged or has the wrong dimensions.
    """
    if isinstance(path, str) and is_url(path):
        from rasnik.io.remote import open_remote

        return open_remote(path, dataset)
    path = Path(path)
    if not path.exists():
        raise ImageFileError("no such file; check the name and the folder")
    if path.is_dir() and (is_zarr_folder(path) or path.suffix.lower() == ".zarr"):
        from rasnik.io.zarr_stack import open_zarr

        return open_zarr(str(path), dataset)
    if not path.is_file():
        raise ImageFileError("this is not a file; name image files, or a folder of them")
    with path.open("rb") as file:
        head = file.read(12)
    if not head:
        raise ImageFileError("the file is empty; copy or record it again")
    suffix = path.suffix.lower()
    is_hdf5 = head.startswith(_HDF5_MAGIC)
    if is_hdf5 or suffix in STACK_SUFFIXES:
        if not is_hdf5:
            raise ImageFileError(f"the content is not HDF5, as {suffix} promises; check the file")
        from rasnik.io.hdf5_stack import open_hdf5

        return open_hdf5(path, dataset)
    if dataset is not None:
        raise ImageFileError(f"this is not an HDF5 file, so it has no dataset {dataset}")
    for magic, opener in _MAGIC:
        if head.startswith(magic):
            return opener(path)
    if suffix == ".daq":
        from rasnik.io.daq import open_daq

        return open_daq(path)
    if _is_video(head, suffix):
        return _open_video(path)
    known = ", ".join(s[1:] for s in (*IMAGE_SUFFIXES, *STACK_SUFFIXES, *VIDEO_SUFFIXES))
    if suffix in IMAGE_SUFFIXES:
        raise ImageFileError(
            f"the content is not that of a {suffix} image, nor of any other format read here; "
            "check the file"
        )
    raise ImageFileError(
        f"{suffix or 'a file without suffix'} is not an image format read here; "
        f"convert it to one of {known}"
    )
