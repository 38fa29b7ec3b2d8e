"""The HTTP interface for programs: one table of what can be asked, and what answers.

`rasnik.web.openapi` describes the same table.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import rasnik
from rasnik.cameras.camera import CameraError
from rasnik.web.picture import encoded
from rasnik.web.quantities import QUANTITIES, channel_dict, finite

if TYPE_CHECKING:
    from rasnik.live.channel import Channel
    from rasnik.live.service import Station

__all__ = ["ENDPOINTS", "ApiError", "Bytes", "Endpoint", "Parameter"]

#: Rows in one answer; ask again with ``next`` for more.
MOST_ROWS = 5000
MOST_POINTS = 4000


class ApiError(Exception):
    """A request that cannot be answered; the message is a sentence."""

    def __init__(self, status: int, sentence: str) -> None:
        self.status = status
        super().__init__(sentence)


@dataclass(frozen=True)
class Bytes:
    """An answer that is not JSON."""

    content: bytes
    media_type: str


@dataclass(frozen=True)
class Parameter:
    """A number or word in the query, or in the body of a POST.

    Attributes
    ----------
    kind : str
        "number", "integer", "boolean" or "string".
    default : object
        None if it must be given.
    """

    name: str
    kind: str
    description: str
    default: Any = None
    least: float | None = None
    most: float | None = None
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Endpoint:
    """One row of the table.

    Attributes
    ----------
    answer : callable
        (station, channel or None, values of the parameters) -> JSON, or `Bytes`. Runs in a
        thread of its own.
    schema : str
        Of the answer, in `rasnik.web.openapi`; a media type if it is not JSON.
    """

    method: str
    path: str
    summary: str
    schema: str
    answer: Callable[[Station, Any, dict[str, Any]], Any]
    parameters: tuple[Parameter, ...] = ()


# ----------------------------------------------------------------------- what is asked


def _station(station: Station, _: None, values: dict[str, Any]) -> Any:
    return {
        "name": station.config.name,
        "version": rasnik.__version__,
        "folder": str(station.config.folder),
        "channels": list(station.channels),
    }


def _health(station: Station, _: None, values: dict[str, Any]) -> Any:
    states = {name: channel.status().state for name, channel in station.channels.items()}
    return {"ok": not set(states.values()) & {"failed", "lost"}, "channels": states}


def _channels(station: Station, _: None, values: dict[str, Any]) -> Any:
    return [channel_dict(channel) for channel in station.channels.values()]


def _channel(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    return channel_dict(channel)


def columns(rows: NDArray[Any]) -> dict[str, list[Any]]:
    """Rows as lists by column, None where a number is not known."""
    return {name: finite(rows[name].tolist()) for name in rows.dtype.names or ()}


def _rows(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    rows, after = channel.recent.since(values["since"])
    left = max(0, len(rows) - MOST_ROWS)
    return {"next": after - left, "rows": columns(rows[: len(rows) - left])}


def _history(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    start_s, end_s = values["start"], values["end"]
    if not start_s < end_s:
        raise ApiError(400, "start must be before end; both are seconds since 1970 UTC.")
    found = channel.history(start_s, end_s, values["points"])
    return shown_history(found, channel)


def shown_history(found: dict[str, NDArray[Any]], channel: Channel) -> dict[str, Any]:
    """A part of the record in the units of the page, from the present zero."""
    status = channel.status()
    kept = _worth_drawing(np.isfinite(np.asarray(found["x_um_mean"], dtype=np.float64)))
    answer: dict[str, Any] = {"time_s": found["time_s"][kept].tolist()}
    for quantity in QUANTITIES:
        for kind in ("min", "mean", "max"):
            values = quantity.shown(found[f"{quantity.column}_{kind}"][kept], status)
            answer[f"{quantity.key}_{kind}"] = finite(values.tolist())
    return answer


def _worth_drawing(filled: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Bins with a value, and one without in every gap.

    Bins shorter than the time between frames are empty without anything missing: an empty bin
    is a gap where the values beside it are three times as far apart as usual.
    """
    places = np.flatnonzero(filled)
    if len(places) < 2:
        return places
    steps = np.diff(places)
    gaps = places[:-1][steps > 3 * np.median(steps)] + 1
    return np.sort(np.concatenate([places, gaps]))


def _image(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    sample = channel.latest()
    if sample is None:
        raise ApiError(404, "No frame has come yet.")
    kind = values["format"]
    image = encoded(
        sample.frame.image, channel.system.full_scale, kind.upper(), values["width"] or None
    )
    return Bytes(image, f"image/{kind}")


def _metrics(station: Station, _: None, values: dict[str, Any]) -> Any:
    if not station.config.controls.prometheus.enabled:
        raise ApiError(404, "Metrics are switched off in the station file.")
    from rasnik.controls.prometheus import CONTENT_TYPE, render

    try:
        return Bytes(render(station).encode(), CONTENT_TYPE)
    except ImportError as error:
        raise ApiError(503, str(error)) from None


# ------------------------------------------------------------------------ what is done


def _done(channel: Channel) -> Any:
    return channel_dict(channel)


def _start_recording(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    channel.start_recording()
    return _done(channel)


def _stop_recording(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    channel.stop_recording()
    return _done(channel)


def _exposure(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    channel.set_exposure(values["exposure_us"])
    return _done(channel)


def _keep_exposure(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    channel.keep_exposure(values["on"])
    return _done(channel)


def _zero(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    if not channel.status().locked:
        raise ApiError(409, "There is no position now that could be the zero.")
    channel.zero()
    return _done(channel)


def _clear_zero(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    channel.clear_zero()
    return _done(channel)


def _keep_frames(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    channel.keep_frames()
    return _done(channel)


def _snapshot(station: Station, channel: Channel, values: dict[str, Any]) -> Any:
    if channel.latest() is None:
        raise ApiError(409, "No frame has come yet; there is nothing to save.")
    return {"file": str(channel.snapshot())}


_SINCE = Parameter("since", "integer", "`next` of the last answer; 0 for all that is held", 0, 0)
_HISTORY = (
    Parameter("start", "number", "seconds since 1970 UTC", None, 0, 1e11),
    Parameter("end", "number", "seconds since 1970 UTC", None, 0, 1e11),
    Parameter("points", "integer", "at most", 1000, 1, MOST_POINTS),
)
_IMAGE = (
    Parameter("format", "string", "png is exact, to 8 bits", "png", choices=("png", "jpeg")),
    Parameter("width", "integer", "pixels, at most; 0 for all", 0, 0, 16384),
)
_ON = Parameter("on", "boolean", "whether to")
_EXPOSURE = Parameter("exposure_us", "number", "in microseconds", None, 0.1, 1e7)
_NAME = "/api/channels/{name}"

ENDPOINTS: tuple[Endpoint, ...] = (
    Endpoint("GET", "/health", "Whether all channels are at work", "Health", _health),
    Endpoint("GET", "/metrics", "For Prometheus", "text/plain", _metrics),
    Endpoint("GET", "/api/station", "The installation", "Station", _station),
    Endpoint("GET", "/api/channels", "All channels as they are now", "ChannelList", _channels),
    Endpoint("GET", _NAME, "A channel as it is now", "Channel", _channel),
    Endpoint("GET", f"{_NAME}/rows", "Rows since an index", "Rows", _rows, (_SINCE,)),
    Endpoint(
        "GET", f"{_NAME}/history", "The record, thinned out: least, mean, most of each bin",
        "History", _history, _HISTORY,
    ),
    Endpoint("GET", f"{_NAME}/image", "The latest frame", "image/*", _image, _IMAGE),
    Endpoint("POST", f"{_NAME}/start-recording", "Record", "Channel", _start_recording),
    Endpoint("POST", f"{_NAME}/stop-recording", "Do not record", "Channel", _stop_recording),
    Endpoint("POST", f"{_NAME}/exposure", "Set the exposure", "Channel", _exposure, (_EXPOSURE,)),
    Endpoint(
        "POST", f"{_NAME}/keep-exposure",
        "Keep the brightest fields just below full scale, or leave the exposure as it is",
        "Channel", _keep_exposure, (_ON,),
    ),
    Endpoint("POST", f"{_NAME}/zero", "Count from here", "Channel", _zero),
    Endpoint("POST", f"{_NAME}/clear-zero", "Count from the mask's origin", "Channel", _clear_zero),
    Endpoint(
        "POST", f"{_NAME}/keep-frames", "Keep the raw frames before and after this moment",
        "Channel", _keep_frames,
    ),
    Endpoint("POST", f"{_NAME}/snapshot", "Save the latest frame and its pose", "Saved", _snapshot),
)  # fmt: skip


# ---------------------------------------------------------------------- from a request


def parameters_of(endpoint: Endpoint, given: dict[str, Any]) -> dict[str, Any]:
    """The values of an endpoint's parameters.

    Raises
    ------
    ApiError
        400, with what is wrong.
    """
    unknown = sorted(set(given) - {parameter.name for parameter in endpoint.parameters})
    if unknown:
        raise ApiError(400, f"There is no parameter {unknown[0][:40]!r} here.")
    return {p.name: _value(p, given.get(p.name)) for p in endpoint.parameters}


def _value(parameter: Parameter, given: Any) -> Any:
    if given is None:
        if parameter.default is None:
            raise ApiError(400, f"{parameter.name} is missing: {parameter.description}.")
        return parameter.default
    try:
        value = _CONVERTED[parameter.kind](given)
    except (TypeError, ValueError, OverflowError):
        raise ApiError(400, f"{parameter.name} must be of the kind {parameter.kind}.") from None
    if parameter.choices and value not in parameter.choices:
        raise ApiError(400, f"{parameter.name} must be one of {', '.join(parameter.choices)}.")
    if parameter.least is not None and value < parameter.least:
        raise ApiError(400, f"{parameter.name} must be at least {parameter.least:g}.")
    if parameter.most is not None and value > parameter.most:
        raise ApiError(400, f"{parameter.name} must be at most {parameter.most:g}.")
    return value


def _number(given: Any) -> float:
    if isinstance(given, bool) or not math.isfinite(value := float(given)):
        raise ValueError
    return value


def _integer(given: Any) -> int:
    if isinstance(given, bool | float) or len(str(given)) > 18:
        raise ValueError
    return int(given)


def _boolean(given: Any) -> bool:
    if not isinstance(given, bool):
        raise ValueError
    return given


_CONVERTED: dict[str, Callable[[Any], Any]] = {
    "number": _number, "integer": _integer, "boolean": _boolean, "string": str,
}  # fmt: skip


def body_of(body: bytes) -> dict[str, Any]:
    """The JSON object in the body of a POST; an empty body is an empty one."""
    if not body.strip():
        return {}
    try:
        content = json.loads(body)
    except (ValueError, RecursionError):
        raise ApiError(400, "The body must be JSON.") from None
    if not isinstance(content, dict):
        raise ApiError(400, "The body must be a JSON object.")
    return content


def answer(endpoint: Endpoint, station: Station, name: str | None, given: dict[str, Any]) -> Any:
    """What an endpoint answers; failures of the camera and the disk become sentences."""
    channel = None
    if name is not None:
        channel = station.channels.get(name)
        if channel is None:
            raise ApiError(404, "There is no channel of this name.")
    values = parameters_of(endpoint, given)
    try:
        return endpoint.answer(station, channel, values)
    except (CameraError, ValueError) as error:
        raise ApiError(409, str(error)) from None
    except OSError as error:
        raise ApiError(507, f"The disk does not take it: {error.strerror or error}.") from None
