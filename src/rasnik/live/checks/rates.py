"""What comes from the cameras of a station, by its file."""

from __future__ import annotations

from rasnik.instrument import System, load_system
from rasnik.live.station import ChannelConfig

__all__ = ["frame_bytes", "frame_rate_hz", "row_bytes", "stream_bytes_s", "system_of"]

_USUAL_RATE_HZ = 275.0  # of SolidRas, where neither camera nor system state one


def system_of(channel: ChannelConfig) -> System:
    """The system, with the region that the camera reads as its pixels."""
    system, region = load_system(channel.system), channel.camera.region
    if region is None:
        return system
    width_px, height_px = (system.sensor.binning * pixels for pixels in region[2:])
    return load_system(system, {"sensor.width_px": width_px, "sensor.height_px": height_px})


def frame_rate_hz(channel: ChannelConfig) -> float:
    """As the camera is set, else the system's, else that of SolidRas."""
    stated = channel.camera.frame_rate_hz or load_system(channel.system).sensor.frame_rate_hz
    return float(stated or _USUAL_RATE_HZ)


def frame_bytes(channel: ChannelConfig) -> int:
    """Size of a frame in memory."""
    height, width = system_of(channel).shape
    return height * width * (1 if channel.camera.pixel_format in (None, "Mono8") else 2)


def stream_bytes_s(channel: ChannelConfig) -> float:
    """Bytes in a second from the camera."""
    return frame_bytes(channel) * frame_rate_hz(channel)


def row_bytes() -> int:
    """Size of a recorded row."""
    from rasnik.recording.rows import RECORD_ROW

    return RECORD_ROW.itemsize
