"""Station files, the ring of rows, alarms."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from _live_camera import PERIOD_S, camera_frame
from rasnik.analysis.pose import Pose
from rasnik.live.alarms import AlarmWatch, Condition
from rasnik.live.recent import RECENT_ROW, Recent
from rasnik.live.station import Alarms, StationConfig, load_station
from rasnik.live.station_file import station_toml
from rasnik.recording.sample import Sample
from rasnik.web.rows import last_rows


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


# ------------------------------------------------------------------------ station files


def test_a_station_file_loads_as_it_was_written(tmp_path):
    config = StationConfig.model_validate(
        {
            "name": "bench",
            "folder": "/data/rasnik",
            "server": {"port": 8081, "token_file": "/etc/token"},
            "controls": {"mqtt": {"enabled": True, "username": 'o"h'}},
            "channel": [
                {"name": "one", "camera": {"region": [0, 0, 720, 540], "trigger": "Line0"}},
                {
                    "name": "two",
                    "system": "microras",
                    "camera": {"kind": "replay", "source": ["/data/a", "/data/b.h5"]},
                    "recording": {"raw": {"on": ["glitch", "alarm"]}},
                    "alarms": {"x_um": [-10.5, 10], "unlocked_s": 5},
                },
            ],
        }
    )
    path = write(tmp_path / "station.toml", station_toml(config))
    assert load_station(path) == config


def test_every_setting_stands_in_a_station_file():
    lines = station_toml(StationConfig()).splitlines()

    def fields(schema: dict, part: dict) -> None:
        for name, told in part.get("properties", {}).items():
            reference = told.get("$ref") or told.get("items", {}).get("$ref")
            if reference:
                fields(schema, schema["$defs"][reference.rpartition("/")[2]])
                continue
            line = next(
                (li for li in lines if li.startswith((f"{name} = ", f"# {name} is not set"))), None
            )
            assert line is not None, name
            if "description" in told:
                assert any(told["description"] in li for li in lines), name

    schema = StationConfig.model_json_schema()
    fields(schema, schema)


def test_relative_paths_count_from_the_file(tmp_path):
    text = """
    folder = "data"
    server.token_file = "token"
    controls.mqtt.password_file = "password"
    [[channel]]
    name = "one"
    system = "mine.toml"
    camera = { kind = "replay", source = ["frames", "/other"] }
    """
    config = load_station(write(tmp_path / "station.toml", text))
    assert config.folder == tmp_path / "data"
    assert config.server.token_file == tmp_path / "token"
    assert config.controls.mqtt.password_file == tmp_path / "password"
    assert config.channel[0].system == str(tmp_path / "mine.toml")
    assert config.channel[0].camera.source == [str(tmp_path / "frames"), "/other"]


# ------------------------------------------------------------------------ the last minutes


def sample(k: int) -> Sample:
    return Sample(camera_frame(k, received_s=k * PERIOD_S), k, Pose(x_um=float(k)))


def test_the_ring_keeps_the_newest_rows_and_counts_all():
    recent = Recent(rows=8)
    assert len(recent.since(0)[0]) == 0
    assert len(recent.last(10)) == 0
    seen = 0
    for k in range(20):
        recent.add(sample(k), 1.0, 0.001)
        rows, seen = recent.since(seen)
        assert rows["frame"].tolist() == [k]
    assert (len(recent), recent.count, seen) == (8, 20, 20)
    rows, following = recent.since(0)
    assert rows.dtype == RECENT_ROW
    assert rows["frame"].tolist() == list(range(12, 20))
    assert (rows["x_um"] == rows["frame"]).all()
    assert following == 20
    assert len(recent.since(20)[0]) == len(recent.since(99)[0]) == 0
    assert recent.since(15)[0]["frame"].tolist() == list(range(15, 20))


def test_the_last_seconds_are_those_before_the_newest_row():
    recent = Recent(rows=4096)
    for k in range(3000):  # 10 ms apart
        recent.add(sample(k), 1.0, 0.001)
    assert recent.last(1.005)["frame"].tolist() == list(range(2899, 3000))
    assert len(recent.last(25.005)) == 2501
    assert len(recent.last(1e6)) == 3000


# ------------------------------------------------------------------------ alarms


def rows(*x_um: float) -> np.ndarray:
    table = np.zeros(len(x_um), dtype=RECENT_ROW)
    table["x_um"] = x_um
    return table


def watch(**limits: object) -> AlarmWatch:
    usual = {"lost_percent": None, "unlocked_s": None}
    return AlarmWatch(Alarms.model_validate(usual | limits))


def test_an_alarm_says_what_is_beyond_which_limit():
    alarms = watch(x_um=[-10, 10])
    assert alarms.look(rows(1.0, -3.0), (0, 0), Condition(0.0)) == ()
    new = alarms.look(rows(1.0, 12.3, 2.0), (0, 0), Condition(0.2))
    assert new == ("x is 12.3 um, above 10 um",)
    assert alarms.look(rows(-11.0), (0, 0), Condition(0.4)) == ("x is -11 um, below -10 um",)
    assert len(alarms.sentences) == 2


def test_a_value_just_beyond_its_limit_reads_so():
    alarms = watch(x_um=[-10, 10])
    (sentence,) = alarms.look(rows(10.00012), (0, 0), Condition(0.0))
    assert sentence == "x is 10.00012 um, above 10 um"


def test_positions_count_from_the_zero():
    alarms = watch(x_um=[-10, 10])
    assert alarms.look(rows(1005.0), (1000.0, 0.0), Condition(0.0)) == ()
    assert alarms.look(rows(1015.0), (1000.0, 0.0), Condition(0.2)) == ("x is 15 um, above 10 um",)


def test_an_alarm_ends_after_a_second_and_well_inside_the_limits():
    alarms = watch(x_um=[-10, 10])
    alarms.look(rows(11.0), (0, 0), Condition(0.0))
    alarms.look(rows(0.0), (0, 0), Condition(0.5))
    assert alarms.sentences  # it can be seen, however short
    alarms.look(rows(9.5), (0, 0), Condition(2.0))
    assert alarms.sentences  # inside, but by less than 5 % of the width
    alarms.look(rows(), (0, 0), Condition(3.0))
    alarms.look(rows(np.nan), (0, 0), Condition(4.0))
    assert alarms.sentences  # not to be seen is not to be well
    alarms.look(rows(8.9), (0, 0), Condition(5.0))
    assert alarms.sentences == ()
    assert alarms.look(rows(10.5), (0, 0), Condition(6.0))  # new again


def test_one_value_too_many_while_an_alarm_is_on_is_not_new():
    alarms = watch(x_um=[-10, 10])
    assert alarms.look(rows(11.0), (0, 0), Condition(0.0))
    assert alarms.look(rows(13.0), (0, 0), Condition(0.2)) == ()
    assert alarms.sentences == ("x is 13 um, above 10 um",)


@pytest.mark.parametrize(
    ("limits", "condition", "sentence"),
    [
        ({"lost_percent": 1}, {"lost_percent": 2.5}, "lost frames are 2.5 %, above 1 %"),
        (
            {"unlocked_s": 1},
            {"unlocked_s": 4.0},
            "the time without a position is 4 s, above 1 s",
        ),
        (
            {"frame_rate_hz": [100, 300]},
            {"frame_rate_hz": 0.0},
            "frame rate is 0 Hz, below 100 Hz",
        ),
    ],
)
def test_alarms_of_the_channel_itself(limits, condition, sentence):
    alarms = watch(**limits)
    assert alarms.look(rows(), (0, 0), Condition(time.monotonic())) == ()
    assert alarms.look(rows(), (0, 0), Condition(time.monotonic(), **condition)) == (sentence,)


@pytest.mark.parametrize("step_s", [3600.0, -3600.0, -0.5])
def test_a_time_of_day_that_is_set_leaves_the_last_seconds_alone(step_s):
    """Where a zero is set, rows of before would be averaged; a spectrum would have a wrong rate."""
    recent = Recent()
    for k in range(3000):
        step = step_s * (k >= 2950)
        frame = camera_frame(k, host_time_s=1000 + k * PERIOD_S + step, received_s=k * PERIOD_S)
        recent.add(Sample(frame, k, Pose(x_um=float(k))), frame.host_time_s, 0.001)
    expected = list(range(2899, 3000))
    assert recent.last(1.005)["frame"].tolist() == expected
    assert last_rows(recent, 1.005)[0]["frame"].tolist() == expected
