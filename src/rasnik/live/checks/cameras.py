"""Cameras that are seen, and those that the station names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rasnik._config import SystemConfigError
from rasnik.cameras.addresses import is_address
from rasnik.cameras.camera import CameraError
from rasnik.live.checks.finding import Finding, Machine
from rasnik.live.checks.rates import system_of
from rasnik.live.station import ChannelConfig, StationConfig

if TYPE_CHECKING:
    from rasnik.cameras.aravis import SeenCamera

__all__ = ["aravis_cameras", "channels", "described", "seen", "video_devices"]


def aravis_cameras() -> list[SeenCamera]:
    """Cameras of the network and of USB, as Aravis sees them.

    Raises
    ------
    CameraError
        If Aravis is not installed.
    """
    from rasnik.cameras.aravis import list_cameras

    return list_cameras()


def video_devices(machine: Machine) -> dict[str, str]:
    """Names of the video devices of Linux, by their paths."""
    folder = "/sys/class/video4linux"
    return {
        f"/dev/{name}": machine.read(f"{folder}/{name}/name") or ""
        for name in machine.names("/dev")
        if name.startswith("video") and name[5:].isdigit()
    }


def seen(machine: Machine, cameras: Sequence[SeenCamera] | CameraError) -> Iterator[Finding]:
    """Every camera that there is."""
    if isinstance(cameras, CameraError):
        yield Finding(
            "cameras",
            "note",
            "GigE Vision and USB3 Vision cameras cannot be looked for without Aravis",
            str(cameras),
        )
    elif not cameras:
        yield Finding(
            "cameras",
            "note",
            "no GigE Vision or USB3 Vision camera is seen",
            "If there should be one: see its power and cable, and that no other program has it.",
        )
    else:
        for camera in cameras:
            yield Finding("cameras", "ok", str(camera))
    for path, name in video_devices(machine).items():
        yield Finding("video devices", "ok", f"{path} {name}".strip())


def channels(
    machine: Machine, config: StationConfig, cameras: Sequence[SeenCamera] | CameraError
) -> Iterator[Finding]:
    """For each channel, whether its system and its camera are there."""
    for channel in config.channel:
        about = f"channel {channel.name}"
        try:
            system = system_of(channel)
        except SystemConfigError as error:
            yield Finding(
                about,
                "fault",
                " ".join(str(error).split()),
                "Correct system and region of the channel; rasnik systems lists what is shipped.",
            )
            continue
        yield _camera(about, machine, channel, cameras, f"{system.name}, ")


def described(config: StationConfig) -> StationConfig:
    """The station without channels whose system cannot be read; those are faults already."""

    def readable(channel: ChannelConfig) -> bool:
        try:
            system_of(channel)
        except SystemConfigError:
            return False
        return True

    return config.model_copy(update={"channel": [c for c in config.channel if readable(c)]})


def _camera(
    about: str,
    machine: Machine,
    channel: ChannelConfig,
    cameras: Sequence[SeenCamera] | CameraError,
    start: str,
) -> Finding:
    camera = channel.camera
    if camera.kind == "replay":
        missing = [name for name in camera.source if not _may_be_there(name)]
        if missing:
            found = f"there is nothing at {', '.join(missing)}"
            return Finding(about, "fault", found, "Correct source in the channel's camera.")
        return Finding(about, "ok", f"{start}replay of {', '.join(camera.source)}")
    if camera.kind == "opencv":
        return _webcam(about, machine, camera.device or "0", start)
    if camera.kind == "aravis":
        return _aravis(about, camera.device, cameras, start)
    return Finding(about, "ok", f"{start}{camera.kind} camera")


def _may_be_there(source: str) -> bool:
    """Patterns and data sets within files are left to whoever reads them."""
    return any(sign in source for sign in "*?[:") or Path(source).exists()


def _webcam(about: str, machine: Machine, device: str, start: str) -> Finding:
    path = f"/dev/video{device}" if device.isdigit() else device
    if machine.names("/dev") and not machine.path(path).exists():
        return Finding(
            about,
            "fault",
            f"there is no video device {path}",
            f"Plug it in, or set device to one of: {', '.join(video_devices(machine)) or 'none'}.",
        )
    return Finding(about, "ok", f"{start}webcam {path}, not for metrology")


def _aravis(
    about: str, device: str, cameras: Sequence[SeenCamera] | CameraError, start: str
) -> Finding:
    if isinstance(cameras, CameraError):
        return Finding(about, "fault", "its camera needs Aravis, which is missing", str(cameras))
    for camera in cameras:
        if device in {"", camera.device_id, camera.serial, camera.address, camera.model}:
            return Finding(about, "ok", f"{start}{camera}")
    if is_address(device):
        return Finding(
            about,
            "warning",
            f"its camera {device} did not answer when all cameras were asked; one of another "
            "network does not hear that",
            f"See whether it is there: ping {device}",
        )
    if not cameras:
        return Finding(
            about,
            "fault",
            f"its camera {device or '(any)'} is not seen, nor any other",
            "See its power and cable, and that its address is one of this machine's networks.",
        )
    return Finding(
        about,
        "fault",
        f"its camera {device} is not among those seen",
        "Set device to the serial number of one of the cameras above.",
    )
