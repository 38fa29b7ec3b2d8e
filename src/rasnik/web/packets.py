"""Messages of the websocket: a header in JSON, then arrays as they lie in memory.

A message is: length of the header (uint32, little-endian); the header (UTF-8), filled up with
blanks so that the arrays begin at a multiple of 8 bytes; the arrays, each filled up with zeros
to a multiple of 8. ``header["arrays"]`` lists their name, type (of numpy) and length in order.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["pack", "unpack"]

_ALIGN = 8


def pack(
    header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any] | bytes] | None = None
) -> bytes:
    """One message."""
    parts: list[bytes] = []
    listed: list[tuple[str, str, int]] = []
    for name, values in (arrays or {}).items():
        flat = np.frombuffer(values, np.uint8) if isinstance(values, bytes) else np.ravel(values)
        listed.append((name, flat.dtype.str.lstrip("<|"), len(flat)))
        data = flat.tobytes()
        parts += [data, bytes(-len(data) % _ALIGN)]
    text = json.dumps({**header, "arrays": listed}, allow_nan=False).encode()
    text += b" " * (-(len(text) + 4) % _ALIGN)
    return b"".join([len(text).to_bytes(4, "little"), text, *parts])


def unpack(message: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """(header, arrays) of a message."""
    start = 4 + int.from_bytes(message[:4], "little")
    header = json.loads(message[4:start])
    arrays = {}
    for name, kind, length in header["arrays"]:
        arrays[name] = np.frombuffer(message, np.dtype(kind), length, start)
        size = arrays[name].nbytes
        start += size + -size % _ALIGN
    return header, arrays
