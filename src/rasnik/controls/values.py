"""The values that control systems see: one table for EPICS, MQTT and Prometheus."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal, Protocol, get_args

from rasnik.live.station import Alarms, ChannelConfig, StationConfig
from rasnik.live.status import ChannelState, ChannelStatus

__all__ = [
    "STATES",
    "VALUES",
    "PublishedChannel",
    "PublishedStation",
    "Severity",
    "Value",
    "frame_time_s",
    "judge",
    "limits",
    "statuses",
]

Kind = Literal["float", "count", "bool", "state", "text"]
Limits = tuple[float, float]
Content = float | int | bool | str

# Numbers of numpy are made plain ones, which JSON takes.
_PLAIN: dict[Kind, Callable[[Any], Content]] = {
    "float": float, "count": int, "bool": bool, "state": str, "text": str,
}  # fmt: skip
STATES: tuple[str, ...] = get_args(ChannelState)
_NM_PER_UM = 1e3
_MRAD_PER_RAD = 1e3
_PPM = 1e6
_PERCENT = 100.0
_NOT_A_CLOCK_S = 1e9  # the year 2001; clocks that count from 0 stay below


class Severity(IntEnum):
    """How bad a value is, with the numbers of EPICS."""

    OK = 0
    MINOR = 1
    MAJOR = 2
    INVALID = 3


class PublishedChannel(Protocol):
    """What is needed of a channel."""

    @property
    def config(self) -> ChannelConfig: ...

    def status(self) -> ChannelStatus: ...


class PublishedStation(Protocol):
    """What is needed of a station."""

    @property
    def config(self) -> StationConfig: ...

    @property
    def channels(self) -> Mapping[str, PublishedChannel]: ...


@dataclass(frozen=True)
class Value:
    """One published value.

    Attributes
    ----------
    name : str
        In JSON, in topics, and after "rasnik_" in metrics.
    pv : str
        Last part of its process variable.
    unit, description : str
        The description has at most 40 characters, as EPICS keeps no more.
    decimals : int
        Worth showing.
    measured : bool
        Whether it comes from a frame with a position, and means nothing without one.
    limits : callable
        The limits in the unit of the value, from the alarms of a channel.
    judged_by : str
        Value whose limits hold for this one too.
    source : callable
        The value, from the status of a channel; by default its attribute of that name.
    """

    name: str
    pv: str
    kind: Kind
    unit: str
    description: str
    decimals: int = 0
    measured: bool = False
    limits: Callable[[Alarms], Limits | None] = lambda alarms: None
    judged_by: str = ""
    source: Callable[[ChannelStatus], Content] | None = None

    def read(self, status: ChannelStatus) -> Content:
        """The value, from the status of a channel."""
        found = getattr(status, self.name) if self.source is None else self.source(status)
        return _PLAIN[self.kind](found)


def _times(limits: Limits | None, factor: float) -> Limits | None:
    return None if limits is None else (limits[0] * factor, limits[1] * factor)


_POSE = (
    Value(
        "x_um", "X", "float", "um", "mask x at the sensor's centre", 6, True,
        judged_by="x_rel_nm",
    ),
    Value(
        "y_um", "Y", "float", "um", "mask y at the sensor's centre", 6, True,
        judged_by="y_rel_nm",
    ),
    Value("scale", "SCALE", "float", "", "image size / mask size", 9, True, lambda a: a.scale),
    Value(
        "theta_rad", "THETA", "float", "rad", "rotation, anticlockwise on the image", 9, True,
        lambda a: _times(a.theta_mrad, 1 / _MRAD_PER_RAD),
    ),
    Value(
        "x_rel_nm", "XREL", "float", "nm", "x from its zero", 3, True,
        lambda a: _times(a.x_um, _NM_PER_UM), source=lambda s: (s.x_um - s.zero_um[0]) * _NM_PER_UM,
    ),
    Value(
        "y_rel_nm", "YREL", "float", "nm", "y from its zero", 3, True,
        lambda a: _times(a.y_um, _NM_PER_UM), source=lambda s: (s.y_um - s.zero_um[1]) * _NM_PER_UM,
    ),
    Value(
        "scale_rel_ppm", "SCALEREL", "float", "ppm", "change of scale from its zero", 3, True,
        judged_by="scale", source=lambda s: (s.scale / s.zero_scale - 1) * _PPM,
    ),
    Value(
        "theta_rel_mrad", "THETAREL", "float", "mrad", "rotation from its zero", 6, True,
        judged_by="theta_rad",
        source=lambda s: (s.theta_rad - s.zero_theta_rad) * _MRAD_PER_RAD,
    ),
    Value(
        "sigma_x_nm", "SIGMAX", "float", "nm", "standard deviation of x", 3, True,
        source=lambda s: s.sigma_x_um * _NM_PER_UM,
    ),
    Value(
        "sigma_y_nm", "SIGMAY", "float", "nm", "standard deviation of y", 3, True,
        source=lambda s: s.sigma_y_um * _NM_PER_UM,
    ),
    Value("sigma_scale", "SIGMASCALE", "float", "", "standard deviation of scale", 9, True),
    Value("sigma_theta_rad", "SIGMATHETA", "float", "rad", "standard deviation of theta", 9, True),
    Value(
        "chi2_ndf", "CHI2", "float", "", "chi-square per degree of freedom", 4, True,
        lambda a: a.chi2_ndf,
    ),
    Value("time_s", "TIME", "float", "s", "time of the frame", 6),
    Value("zero_x_um", "ZEROX", "float", "um", "zero of x", 6, source=lambda s: s.zero_um[0]),
    Value("zero_y_um", "ZEROY", "float", "um", "zero of y", 6, source=lambda s: s.zero_um[1]),
)  # fmt: skip

_STATE = (
    Value("state", "STATE", "state", "", "what the channel does"),
    Value("locked", "LOCKED", "bool", "", "the last frame gave a position"),
    Value(
        "alarm", "ALARM", "bool", "", "something is beyond its limits",
        source=lambda s: bool(s.alarms),
    ),
    Value(
        "alarms", "ALARMS", "text", "", "what is beyond its limits",
        source=lambda s: "; ".join(s.alarms),
    ),
    Value("message", "MESSAGE", "text", "", "what is wrong"),
    Value(
        "flags", "FLAGS", "text", "", "flags of the last frame", source=lambda s: " ".join(s.flags)
    ),
    Value("camera", "CAMERA", "text", "", "maker, type and serial number"),
    Value("metrology", "METROLOGY", "bool", "", "frames are as the sensor saw them"),
)  # fmt: skip

_STREAM = (
    Value("frames", "FRAMES", "count", "", "frames received"),
    Value("tracked", "TRACKED", "count", "", "frames with a position"),
    Value("lost_in_transfer", "LOST", "count", "", "missing by frame number"),
    Value("lost_by_time", "LOSTBYTIME", "count", "", "missing by time stamp alone"),
    Value("dropped", "DROPPED", "count", "", "received, not analysed in time"),
    Value("reconnects", "RECONNECTS", "count", "", "times the camera came back"),
    Value(
        "frame_rate_hz", "RATE", "float", "Hz", "frames in a second", 2,
        limits=lambda a: a.frame_rate_hz,
    ),
    Value("latency_median_ms", "LATENCY", "float", "ms", "reception to publication, median", 2),
    Value("latency_p99_ms", "LATENCY99", "float", "ms", "reception to publication, 99 %", 2),
)  # fmt: skip

_LIGHT = (
    Value("exposure_us", "EXPOSURE", "float", "us", "exposure of the last frame", 1),
    Value("gain_db", "GAIN", "float", "dB", "gain of the last frame", 2),
    Value(
        "saturated_percent", "SATURATED", "float", "%", "pixels at full scale", 3,
        source=lambda s: s.saturated_fraction * _PERCENT,
    ),
    Value("light_level", "LIGHT", "float", "grey", "grey level of white", 2, True),
    Value("dark_level", "DARK", "float", "grey", "grey level of black", 2, True),
)  # fmt: skip

_RECORD = (
    Value("recording", "RECORDING", "bool", "", "rows are written"),
    Value("recorded", "RECORDED", "count", "", "rows written"),
    Value("recording_file", "FILE", "text", "", "file they go to"),
    Value("recording_message", "FILEMESSAGE", "text", "", "what is wrong with the recording"),
)  # fmt: skip

VALUES: tuple[Value, ...] = _POSE + _STATE + _STREAM + _LIGHT + _RECORD
_BY_NAME = {value.name: value for value in VALUES}
_BAD_STATES = {"lost": Severity.MAJOR, "failed": Severity.MAJOR, "running": Severity.OK}


def statuses(station: PublishedStation) -> dict[str, ChannelStatus]:
    """The status of every channel; one that cannot tell it has failed, and the others go on."""
    found = {}
    for name, channel in station.channels.items():
        try:
            found[name] = channel.status()
        except Exception as error:
            found[name] = ChannelStatus(
                name, state="failed", message=f"The channel does not tell its status: {error}"
            )
    return found


def limits(value: Value, alarms: Alarms) -> Limits | None:
    """Least and greatest value without an alarm, in the unit of the value."""
    return value.limits(alarms)


def judge(value: Value, status: ChannelStatus, alarms: Alarms) -> Severity:
    """How bad a value is.

    INVALID: not known, or measured before the mask or the camera was lost. MAJOR: beyond
    its limits, camera lost, or anything in alarm. MINOR: not running.
    """
    if value.judged_by:
        value = _BY_NAME[value.judged_by]
    if value.kind == "state":
        return _BAD_STATES.get(status.state, Severity.MINOR)
    if value.name in ("alarm", "alarms"):
        return Severity.MAJOR if status.alarms else Severity.OK
    if value.name == "locked":
        return Severity.OK if status.locked else Severity.MAJOR
    if value.kind != "float":
        return Severity.OK
    number = value.read(status)
    current = status.locked and status.state == "running"
    if not math.isfinite(float(number)) or (value.measured and not current):
        return Severity.INVALID
    bounds = limits(value, alarms)
    if bounds is not None and not bounds[0] <= float(number) <= bounds[1]:
        return Severity.MAJOR
    return Severity.OK


def frame_time_s(status: ChannelStatus) -> float:
    """Time of the frame that a status tells of, in seconds since 1970 UTC.

    Recordings may count from their beginning, and a channel may have had no frame yet. Then it
    is the time of the call.
    """
    return status.time_s if status.time_s > _NOT_A_CLOCK_S else time.time()
