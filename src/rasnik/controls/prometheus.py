"""Metrics for Prometheus, in its text format."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rasnik.controls.values import STATES, VALUES, PublishedStation, Value, statuses
from rasnik.live.status import ChannelStatus

__all__ = ["CONTENT_TYPE", "render"]

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_LABELS = ("station", "channel")


def render(station: PublishedStation) -> str:
    """All values of a station, as they are now.

    Numbers are gauges, except frames and losses, which are counters. Each state of a channel is
    a gauge that is 1 while the channel is in it. Of the texts only the camera is there, as a
    label of `rasnik_camera_info`; the others are found by EPICS, MQTT and the page.

    Raises
    ------
    ImportError
        If prometheus_client is missing; the message says how to install it.
    """
    try:
        from prometheus_client import CollectorRegistry, generate_latest
    except ImportError as error:
        raise ImportError(
            'Metrics need prometheus_client; install it with: pip install "rasnik[prometheus]"'
        ) from error
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Collector(station))
    return generate_latest(registry).decode()


class _Collector:
    """What the registry asks for metrics."""

    def __init__(self, station: PublishedStation) -> None:
        self._station = station.config.name
        self._statuses = statuses(station)

    def collect(self) -> Iterator[Any]:
        for value in VALUES:
            metric = _metric(value)
            if metric is None:
                continue
            for name, status in self._statuses.items():
                _fill(metric, value, [self._station, name], status)
            yield metric


def _metric(value: Value) -> Any:
    """An empty metric of the right type; None for texts."""
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily

    name = f"rasnik_{value.name}"
    about = value.description + (f", {value.unit}" if value.unit else "")
    if value.kind == "count":
        return CounterMetricFamily(name, about, labels=_LABELS)
    if value.kind == "state":
        return GaugeMetricFamily(name, about, labels=(*_LABELS, "state"))
    if value.name == "camera":
        return InfoMetricFamily(name, about, labels=_LABELS)
    if value.kind == "text":
        return None
    return GaugeMetricFamily(name, about, labels=_LABELS)


def _fill(metric: Any, value: Value, labels: list[str], status: ChannelStatus) -> None:
    found = value.read(status)
    if value.kind == "state":
        for state in STATES:
            metric.add_metric([*labels, state], float(state == found))
    elif value.kind == "text":
        metric.add_metric(labels, {value.name: str(found)})
    else:
        metric.add_metric(labels, float(found))
