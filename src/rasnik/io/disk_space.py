"""Space on the disk set aside before it is needed.

The HDF5 library cannot go on, nor even let go of a file, when the disk is full in the middle of
its writing. So the space for what it will write is taken beforehand, and a full disk is noticed
while nothing is half done.
"""

from __future__ import annotations

import ctypes
import errno
import os
import sys

__all__ = ["reserve"]

_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE of linux/falloc.h: blocks beyond the end, which stays
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def reserve(descriptor: int, start: int, size: int) -> None:
    """Take blocks for a part of a file, whose length stays as it is.

    Where the system or the file system cannot do that, nothing is done.

    Parameters
    ----------
    descriptor : int
        Of a file open for writing.
    start, size : int
        In bytes.

    Raises
    ------
    OSError
        If there is not so much space.
    """
    if not sys.platform.startswith("linux"):
        return
    disk = os.fstatvfs(descriptor)
    if disk.f_bavail * disk.f_frsize < size:  # else a part of it would be taken and kept
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    library = ctypes.CDLL(None, use_errno=True)
    offsets = [ctypes.c_int64(value) for value in (start, size)]
    name = "fallocate64" if hasattr(library, "fallocate64") else "fallocate"
    if getattr(library, name)(ctypes.c_int(descriptor), ctypes.c_int(_KEEP_SIZE), *offsets) != 0:
        number = ctypes.get_errno()
        if number in _NO_SPACE:
            raise OSError(number, os.strerror(number))
