"""Metrics, read back by the parser of Prometheus' own library."""

import math
import sys
import time
from dataclasses import replace
from typing import Any

import pytest

pytest.importorskip("prometheus_client", reason="prometheus_client is not installed")

from prometheus_client.parser import text_string_to_metric_families

from rasnik.controls.prometheus import render
from rasnik.controls.values import STATES, VALUES
from test_controls_values import STATUS, FakeStation

Found = dict[tuple[str, str], Any]


def scraped(text: str, station: str = "rasnik") -> Found:
    """Samples by name (that of a state follows it) and channel."""
    found: Found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            assert sample.labels["station"] == station
            name = sample.name + sample.labels.get("state", "")
            key = name, sample.labels["channel"]
            assert key not in found
            found[key] = sample
    return found


def test_values_are_those_of_the_status() -> None:
    station = FakeStation()
    station.add(STATUS)
    found = scraped(render(station))
    for value in VALUES:
        if value.kind in ("float", "bool"):
            assert found[f"rasnik_{value.name}", "one"].value == value.read(STATUS), value.name
        elif value.kind == "count":
            assert found[f"rasnik_{value.name}_total", "one"].value == value.read(STATUS)
    for state in STATES:
        assert found[f"rasnik_state{state}", "one"].value == (state == "running")
    assert found["rasnik_camera_info", "one"].labels["camera"] == "simulated"


def test_frames_and_losses_are_counters() -> None:
    station = FakeStation()
    station.add(STATUS)
    kinds = {f.name: f.type for f in text_string_to_metric_families(render(station))}
    assert kinds["rasnik_frames"] == kinds["rasnik_lost_in_transfer"] == "counter"
    assert kinds["rasnik_x_um"] == kinds["rasnik_state"] == "gauge"


def test_several_channels_unlocked_and_broken() -> None:
    station = FakeStation()
    station.add(STATUS)
    station.add(replace(STATUS, name="two", x_um=math.nan, locked=False, camera='a "b"\nc\\'))
    station.add_broken("bad")
    found = scraped(render(station))
    assert found["rasnik_x_um", "one"].value == STATUS.x_um
    assert math.isnan(found["rasnik_x_um", "two"].value)
    assert found["rasnik_locked", "two"].value == 0
    assert found["rasnik_camera_info", "two"].labels["camera"] == 'a "b"\nc\\'
    assert found["rasnik_frames_total", "bad"].value == 0


def test_a_scrape_costs_little() -> None:
    station = FakeStation()
    for k in range(4):
        station.add(replace(STATUS, name=f"c{k}"))
    render(station)
    began = time.process_time()
    for _ in range(10):
        render(station)
    # about 3 ms on a machine of 2020; a scrape is every few seconds
    assert (time.process_time() - began) / 10 < 0.1


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(ImportError, match=r'pip install "rasnik\[prometheus\]"'):
        render(FakeStation())
