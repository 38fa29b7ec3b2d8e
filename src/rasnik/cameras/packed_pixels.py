"""Grey levels from the bytes of an image, as the GenICam pixel formats lay them out.

Source: GenICam Pixel Format Naming Convention 2.4; GigE Vision 1.2 for the names in "Packed".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["PIXEL_FORMATS", "grey_levels"]

Bytes = NDArray[np.uint8]


def _mono12p(data: Bytes) -> NDArray[np.uint16]:
    b = data.reshape(-1, 3).astype(np.uint16)
    return np.stack([b[:, 0] | (b[:, 1] & 0xF) << 8, b[:, 1] >> 4 | b[:, 2] << 4], axis=1)


def _mono12_packed(data: Bytes) -> NDArray[np.uint16]:
    b = data.reshape(-1, 3).astype(np.uint16)
    return np.stack([b[:, 0] << 4 | (b[:, 1] & 0xF), b[:, 2] << 4 | b[:, 1] >> 4], axis=1)


def _mono10_packed(data: Bytes) -> NDArray[np.uint16]:
    b = data.reshape(-1, 3).astype(np.uint16)
    return np.stack([b[:, 0] << 2 | (b[:, 1] & 3), b[:, 2] << 2 | (b[:, 1] >> 4 & 3)], axis=1)


def _mono10p(data: Bytes) -> NDArray[np.uint16]:
    b = data.reshape(-1, 5).astype(np.uint16)
    levels = [b[:, k] >> 2 * k | (b[:, k + 1] << 8 - 2 * k & 0x3FF) for k in range(4)]
    return np.stack(levels, axis=1)


# Code of the format: name, bytes and pixels of the smallest whole piece, how it is unpacked.
_Unpack = Callable[[Bytes], NDArray[Any]]
_FORMATS: dict[int, tuple[str, int, int, _Unpack]] = {
    0x01080001: ("Mono8", 1, 1, lambda data: data),
    0x01100003: ("Mono10", 2, 1, lambda data: data.view("<u2")),
    0x01100005: ("Mono12", 2, 1, lambda data: data.view("<u2")),
    0x01100025: ("Mono14", 2, 1, lambda data: data.view("<u2")),
    0x01100007: ("Mono16", 2, 1, lambda data: data.view("<u2")),
    0x010A0046: ("Mono10p", 5, 4, _mono10p),
    0x010C0047: ("Mono12p", 3, 2, _mono12p),
    0x010C0004: ("Mono10Packed", 3, 2, _mono10_packed),
    0x010C0006: ("Mono12Packed", 3, 2, _mono12_packed),
}

#: Formats that can be read, by name.
PIXEL_FORMATS = tuple(name for name, *_ in _FORMATS.values())


def grey_levels(data: bytes, code: int, width: int, height: int) -> NDArray[Any]:
    """An image of uint8 or uint16, with the lowest bit of the level as bit 0.

    Parameters
    ----------
    data : bytes
        At least as long as the image.
    code : int
        Of the pixel format.
    width, height : int

    Returns
    -------
    ndarray, shape (height, width)
        Owned by the caller.

    Raises
    ------
    ValueError
        If the format is not one of grey levels, or there are not enough data.
    """
    if code not in _FORMATS:
        raise ValueError(f"images in the pixel format 0x{code:08x} cannot be read")
    name, n_bytes, n_pixels, unpack = _FORMATS[code]
    pixels = width * height
    needed = -(-pixels // n_pixels) * n_bytes
    if len(data) < needed:
        raise ValueError(
            f"{len(data)} bytes are too few for {width} x {height} pixels in {name}, "
            f"which are {needed}"
        )
    levels = unpack(np.frombuffer(data, np.uint8, needed)).ravel()[:pixels]
    stored = np.uint8 if levels.dtype == np.uint8 else np.uint16
    return np.array(levels.reshape(height, width), dtype=stored)
