"""What a real station publishes is what it records: EPICS, MQTT and Prometheus at once."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rasnik.controls.epics import EpicsServer
from rasnik.controls.mqtt import MqttPublisher
from rasnik.controls.prometheus import render
from rasnik.io import read_track
from rasnik.live.service import Station
from rasnik.live.station import CameraConfig, ChannelConfig, Epics, Mqtt, StationConfig
from rasnik.tracking.track import Track
from test_controls_epics import CA_CLIENT, PVA_CLIENT, loopback, read  # noqa: F401
from test_controls_mqtt import Listener, broker, free_port, needs_broker, until  # noqa: F401
from test_controls_prometheus import scraped

for package in ("softioc", "caproto", "p4p"):
    pytest.importorskip(package, reason=f"{package} is not installed")


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    # so slow that one reference of the tracker does, on machines with much else to do too
    camera = CameraConfig(frame_rate_hz=20.0, motion_um=0.05)
    channel = ChannelConfig(name="one", camera=camera)
    with Station(StationConfig(name="bench", folder=tmp_path, channel=[channel])) as station:
        until(lambda: station.channels["one"].status().tracked > 5, "positions come", 40)
        yield station


def recorded(station: Station) -> Track:
    """The record, after the end."""
    file = station.channels["one"].status().recording_file
    station.stop()
    return read_track(file)


def row(track: Track, time_s: float) -> int:
    """The row of a frame, by its time; there is one and it is not far."""
    k = int(np.abs(track.time_s - time_s).argmin())
    assert abs(track.time_s[k] - time_s) < 1e-6
    return k


@needs_broker
@pytest.mark.usefixtures("loopback")
def test_published_values_are_recorded_ones(station: Station, broker: Any) -> None:  # noqa: F811
    port = free_port()
    broker(port)
    epics = EpicsServer(station, Epics(enabled=True, prefix="TEST", rate_hz=20))
    mqtt = MqttPublisher(station, Mqtt(host="127.0.0.1", port=port, rate_hz=20))
    messages: list[dict[str, Any]] = []
    scrapes: list[dict[str, float]] = []
    read_by: list[dict[str, Any]] = []
    epics.start()
    mqtt.start()
    try:
        assert epics.wait(20), epics.message
        with Listener(port) as listener:
            topic = "rasnik/bench/one/status"
            until(lambda: topic in listener.last, "messages come")
            for client in (CA_CLIENT, PVA_CLIENT):
                read_by.append(read(client, *(f"TEST:one:{pv}" for pv in ("X", "Y", "SCALE"))))
                messages.append(json.loads(listener.last[topic]))
            for _ in range(20):
                found = scraped(render(station), "bench")
                scrapes.append({name: sample.value for (name, _), sample in found.items()})
                messages.append(json.loads(listener.last[topic]))
                time.sleep(0.03)
    finally:
        epics.stop()
        mqtt.stop()
    track = recorded(station)
    for seen in messages:
        k = row(track, seen["time_s"])
        for name in ("x_um", "y_um", "scale", "theta_rad", "sigma_scale", "chi2_ndf"):
            assert seen[name] == getattr(track, name)[k], name
        assert seen["x_rel_nm"] == track.x_um[k] * 1e3
        assert seen["lost_in_transfer"] == 0
    for seen in scrapes:
        k = row(track, seen["rasnik_time_s"])
        for name in ("x_um", "y_um", "scale", "theta_rad", "light_level"):
            assert seen[f"rasnik_{name}"] == getattr(track, name)[k], name
    for found in read_by:
        for pv, name in (("X", "x_um"), ("Y", "y_um"), ("SCALE", "scale")):
            value, severity, time_s = found[f"TEST:one:{pv}"]
            assert severity == 0
            assert value == getattr(track, name)[row(track, time_s)]
    assert len({seen["rasnik_x_um"] for seen in scrapes}) > 5  # they are not those of one frame
