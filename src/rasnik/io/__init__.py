"""Reading images, writing results and tracks.

The names below are loaded when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rasnik.io.track_export import read_track, to_gwpy, write_track
    from rasnik.io.track_file import TrackWriter

__all__ = ["TrackWriter", "read_track", "to_gwpy", "write_track"]

_HOME = {
    "TrackWriter": "rasnik.io.track_file",
    "read_track": "rasnik.io.track_export",
    "to_gwpy": "rasnik.io.track_export",
    "write_track": "rasnik.io.track_export",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_HOME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
