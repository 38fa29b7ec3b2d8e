"""Cameras by the kind and the settings that a station file names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from rasnik.cameras.camera import Camera, CameraMissingError, CameraSettings
from rasnik.instrument import System

__all__ = ["CameraOptions", "open_camera"]

_KINDS = ("simulated", "replay", "aravis", "opencv")


class CameraOptions(Protocol):
    """What is told of a camera; the table of a station file has these fields and more."""

    @property
    def kind(self) -> str: ...
    @property
    def device(self) -> str: ...
    @property
    def source(self) -> Sequence[str]: ...
    @property
    def pace(self) -> str: ...
    @property
    def repeat(self) -> bool: ...
    @property
    def motion_um(self) -> float: ...
    @property
    def motion_hz(self) -> float: ...
    @property
    def seed(self) -> int: ...
    @property
    def settings(self) -> CameraSettings: ...


def open_camera(config: CameraOptions, system: System, index: int = 0) -> Camera:
    """The camera that a station file describes; it is made, and not opened yet.

    Parameters
    ----------
    config : CameraOptions
    system : System
        What a simulated camera shows; the frame rate of others where none is given.
    index : int
        Of the channel: simulated cameras of one station have different noise and phase.

    Raises
    ------
    CameraMissingError
        If there is no such kind, or what it needs is not named or not installed.
    """
    settings = config.settings
    if config.kind == "simulated":
        from rasnik.cameras.simulated import SimulatedCamera

        return SimulatedCamera(
            system,
            motion_um=config.motion_um,
            motion_hz=config.motion_hz,
            seed=config.seed + index,
            settings=settings,
        )
    if config.kind == "replay":
        from rasnik.cameras.replay import ReplayCamera

        return ReplayCamera(
            config.source,
            pace=config.pace,
            repeat=config.repeat,
            frame_rate_hz=settings.frame_rate_hz or system.sensor.frame_rate_hz,
            bit_depth=system.sensor.bit_depth,
            settings=settings,
        )
    if config.kind == "aravis":
        from rasnik.cameras.aravis import AravisCamera

        return AravisCamera(config.device, settings)
    if config.kind == "opencv":
        from rasnik.cameras.opencv import OpenCvCamera

        return OpenCvCamera(config.device or "0", settings)
    raise CameraMissingError(
        f"there are no cameras of the kind {config.kind!r}; there are {', '.join(_KINDS)}."
    )
