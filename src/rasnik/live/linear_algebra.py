"""Linear algebra in one thread: a channel has a thread of its own, and others want the cores."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

__all__ = ["in_one_thread"]

_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Names of the same function in OpenBLAS as Debian builds it and as it comes with numpy and scipy.
_FUNCTIONS = (
    "openblas_set_num_threads",
    "openblas_set_num_threads64_",
    "scipy_openblas_set_num_threads",
    "scipy_openblas_set_num_threads64_",
)


def in_one_thread() -> None:
    """Let linear algebra use the thread that calls it, unless the environment says otherwise.

    Frames are too small for more: the threads of OpenBLAS wait for each other in loops that keep a
    second core busy, and a frame waits where that core is wanted by others.
    """
    if any(name in os.environ for name in _VARIABLES):
        return
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))  # for what is loaded later
    for path in _loaded():
        library = ctypes.CDLL(path)
        for name in _FUNCTIONS:
            if hasattr(library, name):
                getattr(library, name)(1)


def _loaded() -> set[str]:
    """Files of OpenBLAS in this process, where the system tells."""
    try:
        maps = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return set()
    paths = {line[line.index("/") :] for line in maps.splitlines() if "openblas" in line}
    return {path for path in paths if Path(path).exists()}
