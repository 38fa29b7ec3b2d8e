"""The systemd unit that runs a station unattended."""

from __future__ import annotations

import getpass
import shutil
import sys
from importlib import resources
from pathlib import Path

from rasnik.live.station import StationConfig

__all__ = ["service_unit"]


def service_unit(config: StationConfig, station: Path) -> str:
    """The unit file for a station, to be written to /etc/systemd/system.

    Parameters
    ----------
    config : StationConfig
    station : Path
        File of the station.
    """
    beside = Path(sys.executable).with_name("rasnik")
    program = beside if beside.exists() else Path(shutil.which("rasnik") or beside)
    station = station.resolve()
    text = (resources.files("rasnik") / "live" / "rasnik-live.service").read_text(encoding="utf-8")
    values = {
        "@NAME@": config.name,
        "@USER@": getpass.getuser(),
        "@FOLDER@": str(station.parent).replace("%", "%%"),  # not quoted: up to the line's end
        "@RASNIK@": _word(program),
        "@STATION@": _word(station),
    }
    for mark, value in values.items():
        text = text.replace(mark, value)
    return text


def _word(path: Path) -> str:
    """A path as one word of a command of systemd."""
    text = str(path).replace("\\", "\\\\").replace('"', '\\"')
    return '"' + text.replace("%", "%%").replace("$", "$$") + '"'
