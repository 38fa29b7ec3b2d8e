"""Images in Zarr stores of version 2 or 3: arrays of (height, width) or (frames, height, width)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.io.array_choice import choose_images
from rasnik.io.formats import ImageFileError, Stack, frames_of_array
from rasnik.io.hdf5_stack import TIME_NAMES, times_as_function

__all__ = ["open_zarr", "zarr_bytes"]

_MOST_BYTES = 256 << 20  # of frames in memory


@contextmanager
def open_zarr(url: str, array: str | None = None) -> Iterator[Stack]:
    """Open a Zarr store as a stack of grey images.

    Frames are read chunk by chunk; the last chunk of frames is kept in memory. A one-dimensional
    array ``time_s`` beside the images (or ``host_time_s``), as long as the stack, gives the
    times of the frames.

    Parameters
    ----------
    url : str
        Folder, or URL of one.
    array : str, optional
        Path of the array in the store, needed if it holds several that can be images.

    Raises
    ------
    ImageFileError
        If there are no images in it.
    """
    item, group = _image_array(_opened(url), array, url)
    stack = frames_of_array(_Chunked(item), f"the array {item.path or 'of the store'}")

    def read(index: int) -> tuple[NDArray[Any], tuple[str, ...]]:
        image, notes = stack.read(index)
        return image, notes + _even_parts(image, item)

    yield Stack(stack.count, read, time_s=times_as_function(_times(group), stack.count))


def zarr_bytes(url: str) -> int:
    """Bytes of the images in a store before compression; 0 if it cannot be read."""
    try:
        item, _ = _image_array(_opened(url), None, url)
    except (ImageFileError, ImportError):
        return 0
    return int(item.nbytes)


def _opened(url: str) -> Any:
    """The array or group at a URL."""
    try:
        import zarr
    except ImportError:
        raise ImportError(
            f'{url}: Zarr stores need zarr; install it with: pip install "rasnik[archive]"'
        ) from None
    try:
        return zarr.open(url, mode="r")
    except Exception as error:  # stores behind URLs have errors of their own
        text = " ".join(str(error).split()) or type(error).__name__
        raise ImageFileError(f"the Zarr store cannot be opened ({text}); check it") from error


def _image_array(opened: Any, array: str | None, url: str) -> tuple[Any, Any]:
    """The array with the images, and the group it lies in if there is one."""
    import zarr

    if isinstance(opened, zarr.Array):
        if array is not None:
            raise ImageFileError(f"the Zarr store is one array, there is no {array} in it")
        return opened, None
    arrays = {f"/{k}": v for k, v in opened.members(None) if isinstance(v, zarr.Array)}
    name = choose_images(
        {k: v.ndim if np.dtype(v.dtype).kind in "uif" else 0 for k, v in sorted(arrays.items())},
        array,
        file_name=url.rstrip("/").rpartition("/")[2],
        kind="Zarr store",
        part="array",
    )
    parent = name.rpartition("/")[0].strip("/")
    return arrays[name], opened[parent] if parent else opened


def _times(group: Any) -> NDArray[np.float64] | None:
    """Times stored beside the images."""
    for name in TIME_NAMES if group is not None else ():
        if name in group and getattr(group[name], "ndim", None) == 1:
            return np.asarray(group[name][:], dtype=np.float64)
    return None


def _even_parts(image: NDArray[Any], array: Any) -> tuple[str, ...]:
    """A note where a part of an image may be a chunk that is missing.

    A part that is dark throughout is not stored either, so this need not be a fault.
    """
    height, width = array.chunks[:2] if array.ndim == 2 else array.chunks[1:3]
    if array.fill_value is None or (height >= image.shape[0] and width >= image.shape[1]):
        return ()
    even = image == array.fill_value
    rows = np.logical_and.reduceat(even, np.arange(0, image.shape[0], height), axis=0)
    parts = np.logical_and.reduceat(rows, np.arange(0, image.shape[1], width), axis=1)
    count = int(parts.sum())
    if not count:
        return ()
    return (f"{count} of {parts.size} chunks are {array.fill_value} throughout, or missing",)


class _Chunked:
    """An array whose frames are read a chunk at a time."""

    def __init__(self, array: Any) -> None:
        self._array = array
        self.shape, self.dtype = array.shape, array.dtype
        frame_bytes = max(1, int(np.prod(self.shape[1:])) * np.dtype(self.dtype).itemsize)
        # A chunk of very many frames is read in pieces, which costs time but bounds the memory.
        self._length = max(1, min(array.chunks[0], _MOST_BYTES // frame_bytes))
        self._start, self._block = -1, np.empty(0)

    def __getitem__(self, index: Any) -> NDArray[Any]:
        if index is Ellipsis:
            return self._checked(np.asarray(self._array[...]))
        start = index - index % self._length
        if start != self._start:
            self._block = np.asarray(self._array[start : start + self._length])
            self._start = start
        return self._checked(self._block[index - start])

    def _checked(self, image: NDArray[Any]) -> NDArray[Any]:
        """A chunk that is missing reads as an even grey, and must not pass for an image."""
        fill = self._array.fill_value
        if fill is not None and image.size and (image == fill).all():
            raise ImageFileError(
                f"every pixel is {fill}, as where a chunk of the Zarr store is missing; "
                "write or copy it again"
            )
        return image
