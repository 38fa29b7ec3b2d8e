"""The header which LWDAQ writes into the first row of its images.

Row 0 of such an image is not picture: its first twelve 8-bit pixels are six big-endian 16-bit
numbers (last row, last column, then top, left, bottom and right of the analysis bounds), and a
text follows, which LWDAQ calls the results string. It ends with a zero.

Source: images.pas and lwdaq.pas of https://github.com/OSI-INC/LWDAQ.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["lwdaq_bounds", "lwdaq_text", "with_lwdaq_header", "write_lwdaq_image"]

_HEADER_BYTES = 12
#: Formats that hold 8-bit grey levels as they are, and that LWDAQ opens.
_SUFFIXES = (".png", ".gif", ".daq")


def lwdaq_bounds(image: NDArray[Any]) -> tuple[int, int, int, int] | None:
    """Analysis bounds of an image if its first row is an LWDAQ header.

    Parameters
    ----------
    image : ndarray, shape (height, width)

    Returns
    -------
    tuple of int or None
        (left, top, right, bottom) in pixels, the last column and row included, as LWDAQ stores
        them. If the header is there but holds no usable bounds: everything below row 0. None if
        row 0 is not a header, which is recognised by the image's own size standing in it.
    """
    if image.dtype != np.uint8 or image.ndim != 2:
        return None
    height, width = image.shape
    if width < _HEADER_BYTES or height < 2:
        return None
    header = np.ascontiguousarray(image[0, :_HEADER_BYTES]).view(">u2")
    last_row, last_column, top, left, bottom, right = (int(number) for number in header)
    if (last_row, last_column) != (height - 1, width - 1):
        return None
    if 1 <= top < bottom < height and 0 <= left < right < width:
        return left, top, right, bottom
    return 0, 1, width - 1, height - 1


def lwdaq_text(image: NDArray[Any]) -> str:
    """The text in the LWDAQ header of an image.

    Parameters
    ----------
    image : ndarray, shape (height, width)

    Returns
    -------
    str
        Empty if there is no header or no text in it. What is not readable is no text: headers
        without one are followed by pixels.
    """
    if lwdaq_bounds(image) is None:
        return ""
    text, end, _ = image[0, _HEADER_BYTES:].tobytes().partition(b"\0")
    readable = bool(end) and text.isascii() and text.decode("ascii").isprintable()
    return text.decode("ascii").strip() if readable else ""


def with_lwdaq_header(
    image: NDArray[Any], bounds_px: tuple[int, int, int, int] | None = None, text: str = ""
) -> NDArray[np.uint8]:
    """A copy of an image with the header of LWDAQ in place of its first row.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        Its row 0 is lost.
    bounds_px : tuple of int, optional
        (left, top, right, bottom) of what LWDAQ is to analyse, last column and row included.
        By default everything below row 0.
    text : str
        In ASCII. What does not fit into the row is cut off, as LWDAQ does.

    Returns
    -------
    ndarray of uint8, shape (height, width)

    Raises
    ------
    ValueError
        If the image is not of 8 bits, too small or too large, the bounds do not lie within it
        below row 0, or the text is not ASCII.
    """
    if image.dtype != np.uint8 or image.ndim != 2:
        raise ValueError(
            f"an LWDAQ image has 8-bit grey levels, not {image.dtype} of shape {image.shape}; "
            "use a system with sensor.bit_depth=8, or another format"
        )
    height, width = image.shape
    if not (2 <= height <= 1 << 15 and _HEADER_BYTES < width <= 1 << 15):
        raise ValueError(
            f"an LWDAQ header needs an image of 2 to 32768 rows and 13 to 32768 columns, "
            f"not {height} x {width}"
        )
    left, top, right, bottom = bounds_px or (0, 1, width - 1, height - 1)
    if not (1 <= top < bottom < height and 0 <= left < right < width):
        raise ValueError(
            f"the bounds {left},{top},{right},{bottom} do not lie below row 0 of an image of "
            f"{width} x {height} pixels"
        )
    if not text.isascii() or "\0" in text:
        raise ValueError("the text of an LWDAQ header must be ASCII without zeros")
    row = np.zeros(width, dtype=np.uint8)
    numbers = np.array([height - 1, width - 1, top, left, bottom, right], dtype=">u2")
    row[:_HEADER_BYTES] = numbers.view(np.uint8)
    letters = np.frombuffer(text.encode("ascii")[: width - _HEADER_BYTES - 1], dtype=np.uint8)
    row[_HEADER_BYTES : _HEADER_BYTES + len(letters)] = letters
    headed = np.array(image)
    headed[0] = row
    return headed


def write_lwdaq_image(
    path: str | os.PathLike[str],
    image: NDArray[Any],
    bounds_px: tuple[int, int, int, int] | None = None,
    text: str = "",
) -> None:
    """Write an image that LWDAQ opens with its analysis bounds and its text.

    Parameters
    ----------
    path : path-like
        Ends in ``.png``, ``.gif`` or ``.daq``; an existing file is replaced.
    image, bounds_px, text
        As for `with_lwdaq_header`.

    Raises
    ------
    ValueError
        If the suffix is another one, or as `with_lwdaq_header` does.
    OSError
        If the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _SUFFIXES:
        raise ValueError(f"{path}: an LWDAQ image ends in one of {', '.join(_SUFFIXES)}")
    headed = with_lwdaq_header(image, bounds_px, text)
    if suffix == ".daq":
        headed.tofile(path)
        return
    from PIL import Image

    Image.fromarray(headed).save(path)
