"""Python, packages and compiled kernels."""

from __future__ import annotations

import platform
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from rasnik.live.checks.finding import Finding, nearest_folder
from rasnik.live.station import StationConfig

__all__ = ["EXTRAS", "Extra", "extras", "kernels", "needed_extras", "python"]

_CORE = ("numpy", "scipy", "numba", "pydantic", "h5py", "Pillow", "tifffile", "matplotlib")


@dataclass(frozen=True)
class Extra:
    """Packages that bring something more, as ``pip install "rasnik[name]"`` installs them.

    Attributes
    ----------
    gives : str
        What there is with them.
    packages : dict
        From the name of a package to that of its module.
    before : str
        What has to be installed first.
    """

    gives: str
    packages: dict[str, str]
    before: str = ""


EXTRAS = {
    "live": Extra(
        "the page and the HTTP interface",
        {"starlette": "starlette", "uvicorn": "uvicorn", "websockets": "websockets"},
    ),
    "camera": Extra(
        "GigE Vision and USB3 Vision cameras",
        {"PyGObject": "gi"},
        "sudo apt install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev python3-dev && ",
    ),
    "epics": Extra("EPICS process variables", {"softioc": "softioc"}),
    "mqtt": Extra("messages to an MQTT broker", {"paho-mqtt": "paho.mqtt"}),
    "prometheus": Extra("metrics for Prometheus", {"prometheus-client": "prometheus_client"}),
    "video": Extra("videos as a source of frames", {"av": "av"}),
    "parquet": Extra("tracks as Parquet files", {"pyarrow": "pyarrow"}),
}


def python() -> Iterator[Finding]:
    """Interpreter and packages that are always there."""
    from rasnik import __version__

    versions = {name: _version(name) for name in _CORE}
    missing = [name for name, version in versions.items() if not version]
    if missing:
        yield Finding(
            "packages",
            "fault",
            f"missing: {', '.join(missing)}",
            "Install the package again: pip install --force-reinstall rasnik",
        )
    found = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    yield Finding("python", "ok", f"rasnik {__version__}, Python {platform.python_version()}")
    yield Finding("packages", "ok", found)


def extras(config: StationConfig) -> Iterator[Finding]:
    """Optional packages; a fault where the station needs what is missing."""
    needed = needed_extras(config)
    for name, extra in EXTRAS.items():
        about = f"extra {name}"
        missing = [each for each, module in extra.packages.items() if not _is_there(module)]
        if missing:
            use = f"; the station needs {extra.gives}" if name in needed else f" for {extra.gives}"
            yield Finding(
                about,
                "fault" if name in needed else "note",
                f"not installed: {', '.join(missing)}{use}",
                f'{extra.before}pip install "rasnik[{name}]"',
            )
        else:
            found = ", ".join(f"{each} {_version(each)}".strip() for each in extra.packages)
            yield Finding(about, "ok", f"{found}: {extra.gives}")
    if any(channel.camera.kind == "opencv" for channel in config.channel):
        yield _opencv()


def _opencv() -> Finding:
    if _is_there("cv2"):
        return Finding("opencv", "ok", "installed: webcams, not for metrology")
    return Finding(
        "opencv",
        "fault",
        "not installed; a channel of the station takes its frames by it",
        "pip install opencv-python-headless",
    )


def needed_extras(config: StationConfig) -> set[str]:
    """Those without which a part of the station does not run."""
    controls = config.controls
    wanted = {
        "live": True,
        "camera": any(channel.camera.kind == "aravis" for channel in config.channel),
        "epics": controls.epics.enabled,
        "mqtt": controls.mqtt.enabled,
        # on by default: missed only by those who ask for it
        "prometheus": controls.prometheus.enabled
        and "enabled" in controls.prometheus.model_fields_set,
    }
    return {name for name, needed in wanted.items() if needed}


def kernels() -> Iterator[Finding]:
    """Whether a start has to compile, and whether what it compiles is kept."""
    from rasnik.tracking.kernels import store
    from rasnik.tracking.warm_up import is_compiled

    stats = getattr(store, "stats", None)
    if stats is None:
        yield Finding(
            "kernels",
            "fault",
            "the compiler is switched off, and analysis hundreds of times slower",
            "Start without the environment variable NUMBA_DISABLE_JIT.",
        )
        return
    folder = Path(stats.cache_path)
    writable = _can_write(nearest_folder(folder))
    if is_compiled():
        yield Finding("kernels", "ok", f"compiled, in {folder}")
    elif writable:
        yield Finding(
            "kernels",
            "note",
            "not compiled yet: the first start takes some 15 s longer",
            "Run rasnik doctor without --quick, which compiles them.",
        )
    if not writable:
        yield Finding(
            "kernels",
            "note" if is_compiled() else "warning",
            f"{folder} cannot be written: what has to be compiled is compiled at every start",
            "Name a folder that can be: export NUMBA_CACHE_DIR=$HOME/.cache/rasnik",
        )


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def _is_there(module: str) -> bool:
    if module in sys.modules:
        return sys.modules[module] is not None
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):  # the package around it is missing, or half there
        return False


def _can_write(folder: Path) -> bool:
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
