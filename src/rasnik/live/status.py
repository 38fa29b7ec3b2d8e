"""What a channel tells of itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

__all__ = ["ChannelState", "ChannelStatus"]

ChannelState = Literal["starting", "running", "lost", "ended", "failed", "stopped"]
NAN = float("nan")


@dataclass(frozen=True)
class ChannelStatus:
    """A channel at one moment; what page, control systems and `GET /api/channels` show.

    Positions are in micrometres and count from the mask's origin; `zero_um` is taken off by
    whoever shows them.

    Attributes
    ----------
    state : str
        "starting", "running", "lost" (camera gone, connecting again), "ended" (recording at its
        end), "failed" (will not go on; `message` says why), "stopped".
    message : str
        What is wrong, as a sentence; empty if nothing is.
    locked : bool
        Whether the last frame gave a position.
    frames, tracked : int
        Received, and with a position.
    lost_in_transfer : int
        Missing by their numbers.
    lost_by_time : int
        Missing by time stamps although the numbers have no gap.
    dropped : int
        Received, but not analysed in time.
    latency_median_ms, latency_p99_ms : float
        From reception to publication, over the last 10 s.
    """

    name: str
    state: ChannelState = "starting"
    message: str = ""
    camera: str = ""
    metrology: bool = True
    locked: bool = False
    time_s: float = NAN
    x_um: float = NAN
    y_um: float = NAN
    scale: float = NAN
    theta_rad: float = NAN
    sigma_x_um: float = NAN
    sigma_y_um: float = NAN
    sigma_scale: float = NAN
    sigma_theta_rad: float = NAN
    chi2_ndf: float = NAN
    flags: tuple[str, ...] = ()
    frames: int = 0
    tracked: int = 0
    lost_in_transfer: int = 0
    lost_by_time: int = 0
    dropped: int = 0
    reconnects: int = 0
    frame_rate_hz: float = NAN
    latency_median_ms: float = NAN
    latency_p99_ms: float = NAN
    exposure_us: float = NAN
    gain_db: float = NAN
    saturated_fraction: float = NAN
    light_level: float = NAN
    dark_level: float = NAN
    zero_um: tuple[float, float] = (0.0, 0.0)
    zero_scale: float = 1.0
    zero_theta_rad: float = 0.0
    alarms: tuple[str, ...] = ()
    recording: bool = False
    recorded: int = 0
    recording_file: str = ""
    recording_message: str = ""
    driver_counters: dict[str, int] = field(default_factory=dict)
