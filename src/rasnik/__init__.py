"""Where a coded mask stands, from images of it: analysis and simulation of Rasnik systems.

The names below are loaded when they are first used, so that ``import rasnik`` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rasnik.analysis.analyse import analyse
    from rasnik.analysis.flags import Flag
    from rasnik.analysis.pose import Pose
    from rasnik.imaging.projection import Projection
    from rasnik.imaging.simulate import simulate
    from rasnik.instrument import System, SystemConfigError, load_system, system_names
    from rasnik.mask import ChessField
    from rasnik.performance.bound import bound
    from rasnik.tracking.track import Track
    from rasnik.tracking.tracker import Tracker

    __version__: str

__all__ = [
    "ChessField",
    "Flag",
    "Pose",
    "Projection",
    "System",
    "SystemConfigError",
    "Track",
    "Tracker",
    "__version__",
    "analyse",
    "bound",
    "load_system",
    "simulate",
    "system_names",
]

_HOME = {
    "ChessField": "rasnik.mask",
    "Flag": "rasnik.analysis.flags",
    "Pose": "rasnik.analysis.pose",
    "Projection": "rasnik.imaging.projection",
    "System": "rasnik.instrument",
    "SystemConfigError": "rasnik.instrument",
    "Track": "rasnik.tracking.track",
    "Tracker": "rasnik.tracking.tracker",
    "analyse": "rasnik.analysis.analyse",
    "bound": "rasnik.performance.bound",
    "load_system": "rasnik.instrument",
    "simulate": "rasnik.imaging.simulate",
    "system_names": "rasnik.instrument",
}


def __getattr__(name: str) -> Any:
    value: Any
    if name == "__version__":
        from importlib.metadata import version

        value = version("rasnik")
    elif name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value  # the next use finds it without coming here
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
