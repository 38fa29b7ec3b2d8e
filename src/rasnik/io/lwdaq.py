"""The header which LWDAQ writes into the first row of its images.

Row 0 of such an image is not picture: its first twelve 8-bit pixels are six big-endian 16-bit
numbers (last row, last column, then top, left, bottom and right of the analysis bounds), and a
text follows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["lwdaq_bounds"]

_HEADER_BYTES = 12


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
