"""What every camera can do, whatever it is connected by."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from numpy.typing import NDArray

__all__ = [
    "Camera",
    "CameraError",
    "CameraFrame",
    "CameraLostError",
    "CameraMissingError",
    "CameraSettings",
    "SettingRefusedError",
    "SourceEndedError",
]

NAN = float("nan")


class CameraError(Exception):
    """Something is wrong with a camera; the message is a sentence with its remedy."""


class CameraMissingError(CameraError):
    """There is no such camera, or what it needs is not installed."""


class CameraLostError(CameraError):
    """The camera was there and is gone: cable, power, or another program took it."""


class SettingRefusedError(CameraError):
    """The camera cannot be set to that."""


class SourceEndedError(CameraError):
    """A recording is at its end; no more frames come."""


@dataclass(frozen=True)
class CameraSettings:
    """Settings of a camera; None where it is left as it is, or has no such setting.

    Attributes
    ----------
    frame_rate_hz : float
    exposure_us : float
    gain_db : float
    pixel_format : str
        As GenICam names it: "Mono8", "Mono10", "Mono12", "Mono16".
    region : tuple of int
        (left, top, width, height), in pixels.
    trigger : str
        "free", or the name of an input line such as "Line0".
    packet_bytes : int
        Size of network packets.
    """

    frame_rate_hz: float | None = None
    exposure_us: float | None = None
    gain_db: float | None = None
    pixel_format: str | None = None
    region: tuple[int, int, int, int] | None = None
    trigger: str | None = None
    packet_bytes: int | None = None

    def changed(self) -> dict[str, Any]:
        """Those that are not None."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One frame as it came from a camera.

    Attributes
    ----------
    image : ndarray, shape (H, W)
        Grey levels, uint8 or uint16; owned by the frame.
    number : int
        As the camera counts, not unwrapped.
    device_time_s : float
        Time stamp of the camera's own clock; NaN if it gives none.
    host_time_s : float
        When the frame came, in seconds since 1970 UTC.
    received_s : float
        The same moment by `time.perf_counter`, from which latencies are counted.
    exposure_us, gain_db : float
        In force for this frame; NaN if they are not known.
    """

    image: NDArray[Any]
    number: int
    host_time_s: float
    received_s: float
    device_time_s: float = NAN
    exposure_us: float = NAN
    gain_db: float = NAN


class Camera(ABC):
    """A source of frames. `read` is called by one thread, the rest by any.

    Attributes
    ----------
    name : str
        What it is: maker, type, serial number; known once it is open.
    metrology : bool
        Whether its frames are what the sensor saw: no compression, no automatic settings.
    number_wraps_at : int or None
        The largest frame number; the next is 1. None if numbers do not wrap.
    live : bool
        Whether frames that are not read in time are lost. Recordings wait.
    """

    name: str = ""
    metrology: ClassVar[bool] = True
    number_wraps_at: int | None = None
    live: bool = True

    @abstractmethod
    def open(self) -> None:
        """Connect, apply the settings and begin to take frames.

        Raises
        ------
        CameraMissingError, SettingRefusedError
        """

    @abstractmethod
    def close(self) -> None:
        """Stop and let go of the camera; harmless if it is not open."""

    @abstractmethod
    def read(self, timeout_s: float) -> CameraFrame | None:
        """The next frame; None if none came within the time.

        Raises
        ------
        CameraLostError
            Then `close` and, after a while, `open` connect again.
        SourceEndedError
        """

    @property
    @abstractmethod
    def settings(self) -> CameraSettings:
        """What is in force, as the camera tells."""

    @abstractmethod
    def change(self, settings: CameraSettings) -> CameraSettings:
        """Change what is not None while frames are taken; what is in force afterwards.

        Raises
        ------
        SettingRefusedError
            With the range that is possible.
        """

    def counters(self) -> dict[str, int]:
        """Losses that the camera's driver counts: "missing_packets", "failures", "underruns"."""
        return {}
