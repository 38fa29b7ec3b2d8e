"""Making an HDF5 file writable again whose writer was killed.

A writer in SWMR mode marks the file as open for writing, and keeps the length of the file to
itself until it closes it. If it is killed, the mark stays, and the length on record is that of
the beginning: the library refuses to open the file for writing, and if only the mark were taken
away it would write over the data. Readers in SWMR mode look at neither.

Here both are set right, in the first 48 bytes of the file (the superblock of version 3, the only
one that SWMR has). They are described in "HDF5 File Format Specification Version 3.0", section
II.A; the checksum is R. J. Jenkins' lookup3. The data themselves need no repair: in SWMR mode
what refers to something is written after it.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

__all__ = ["clear_write_marks"]

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Signature, version, sizes of offsets and lengths, marks; addresses of base, extension, end of
# file and root group; checksum of all before.
_SUPERBLOCK = struct.Struct("<8s4B4QI")
_CHECKED_BYTES = _SUPERBLOCK.size - 4
_WORD = 0xFFFFFFFF


def clear_write_marks(path: Path) -> bool:
    """Take away the marks of a writer that is gone.

    The caller must know that no program is writing the file.

    Parameters
    ----------
    path : Path
        An HDF5 file.

    Returns
    -------
    bool
        Whether there were marks.

    Raises
    ------
    ValueError
        If the file does not begin as HDF5 files made for SWMR do.
    OSError
        If it cannot be read or written.
    """
    with path.open("r+b", buffering=0) as file:
        block = file.read(_SUPERBLOCK.size)
        if len(block) < _SUPERBLOCK.size:
            raise ValueError(f"{path}: this is not a complete HDF5 file")
        signature, version, *sizes, marks, base, extension, _, root, checksum = _SUPERBLOCK.unpack(
            block
        )
        if (signature, version, sizes) != (_SIGNATURE, 3, [8, 8]):
            raise ValueError(f"{path}: this is not an HDF5 file that can be appended to")
        if checksum != _lookup3(block[:_CHECKED_BYTES]):
            raise ValueError(f"{path}: the first bytes of the HDF5 file are damaged")
        if marks == 0:
            return False
        end = file.seek(0, os.SEEK_END) - base
        block = _SUPERBLOCK.pack(signature, version, *sizes, 0, base, extension, end, root, 0)
        checksum = struct.pack("<I", _lookup3(block[:_CHECKED_BYTES]))
        file.seek(0)
        file.write(block[:_CHECKED_BYTES] + checksum)
        os.fsync(file.fileno())
    return True


def _rotated(word: int, bits: int) -> int:
    return (word << bits | word >> (32 - bits)) & _WORD


def _lookup3(data: bytes) -> int:
    """Jenkins' hash of 32 bits, ``hashlittle`` with the initial value 0."""
    a = b = c = (0xDEADBEEF + len(data)) & _WORD
    words = struct.unpack(
        f"<{-(-len(data) // 12) * 3}I", data.ljust(-(-len(data) // 12) * 12, b"\0")
    )
    for i in range(0, len(words) - 3, 3):
        a, b, c = (a + words[i]) & _WORD, (b + words[i + 1]) & _WORD, (c + words[i + 2]) & _WORD
        for bits in (4, 6, 8, 16, 19, 4):
            a = (a - c) & _WORD ^ _rotated(c, bits)
            c = (c + b) & _WORD
            a, b, c = b, c, a
    a, b, c = (a + words[-3]) & _WORD, (b + words[-2]) & _WORD, (c + words[-1]) & _WORD
    for bits in (14, 11, 25, 16, 4, 14, 24):
        c = ((c ^ b) - _rotated(b, bits)) & _WORD
        a, b, c = b, c, a
    return b
