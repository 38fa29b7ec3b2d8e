"""All that can keep a station from working, looked at in turn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rasnik.cameras.camera import CameraError, CameraMissingError
from rasnik.live.checks import cameras, disk, machine, network, packages, services
from rasnik.live.checks.finding import Finding, Machine, guarded
from rasnik.live.station import StationConfig

if TYPE_CHECKING:
    from rasnik.cameras.aravis import SeenCamera

__all__ = ["examine"]


def examine(
    config: StationConfig,
    *,
    read_token: Callable[[Path], object],
    quick: bool = False,
    computer: Machine | None = None,
) -> Iterator[Finding]:
    """Look at everything a station needs.

    Parameters
    ----------
    config : StationConfig
    read_token : callable
        Reads a token file as the page does, and raises if it would not be accepted.
    quick : bool, optional
        Whether to leave out what has to be measured: disk and analysis.
    computer : Machine, optional

    Yields
    ------
    Finding
        As it is found. What cannot be looked at is a finding, too.
    """
    computer = computer or Machine()
    seen, sized = _cameras(), cameras.described(config)
    checks: list[tuple[str, Callable[[], Iterable[Finding]]]] = [
        ("python", packages.python),
        ("extras", lambda: packages.extras(config)),
        ("cameras", lambda: cameras.seen(computer, seen)),
        ("channels", lambda: cameras.channels(computer, config, seen)),
        ("packet size", lambda: network.jumbo_frames(computer, config)),
        ("socket buffers", lambda: network.receive_buffers(computer, sized)),
        ("reverse path", lambda: network.reverse_path_filter(computer, config)),
        ("USB memory", lambda: network.usb_memory(computer, config)),
        ("cores", lambda: machine.processors(computer, config)),
        ("CPU frequency", lambda: machine.governor(computer)),
        ("priority", lambda: machine.priority(computer)),
        ("memory lock", lambda: machine.memory_lock(computer)),
        ("clock", machine.clock),
        ("disk space", lambda: disk.free_space(sized)),
        ("file system", lambda: disk.file_system(computer, config)),
        ("port", lambda: services.port(config)),
        ("token file", lambda: services.token_file(config, read_token)),
        ("password file", lambda: services.password_file(config)),
        ("MQTT broker", lambda: services.broker(config)),
    ]
    if not quick:
        checks.append(("disk speed", lambda: disk.write_speed(sized)))
        checks.append(("analysis", lambda: _analysis(computer, sized)))
    checks.append(("kernels", packages.kernels))  # the analysis may just have compiled them
    for about, check in checks:
        yield from guarded(about, check)


def _cameras() -> list[SeenCamera] | CameraError:
    try:
        return cameras.aravis_cameras()
    except CameraError as error:
        return error
    except Exception as error:  # a broken installation of Aravis must not stop the rest
        return CameraMissingError(f"Install Aravis again; it fails with: {error}")


def _analysis(computer: Machine, config: StationConfig) -> Iterator[Finding]:
    from rasnik.live.checks.analysis_rate import analysis_rate

    return analysis_rate(computer, config)
