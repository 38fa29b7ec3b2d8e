"""Station files: what they say is what is done; each fault is a sentence that names its field."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rasnik.instrument import SystemConfigError
from rasnik.live.station import StationConfig, load_station
from rasnik.live.station_file import station_toml

ONE = '[[channel]]\nname = "one"\n'
CAMERA = ONE + "[channel.camera]\n"


def load(folder: Path, text: str) -> StationConfig:
    file = folder / "station.toml"
    file.write_text(text, encoding="utf-8")
    return load_station(file)


def problems(folder: Path, text: str) -> list[str]:
    with pytest.raises(SystemConfigError) as caught:
        load(folder, text)
    assert str(folder / "station.toml") in str(caught.value)
    return list(caught.value.problems)


# ------------------------------------------------------------------------------ what is meant


def test_an_empty_file_is_a_simulated_station(tmp_path: Path) -> None:
    config = load(tmp_path, "")
    (channel,) = config.channel
    assert channel.camera.kind == "simulated" and config.server.host == "127.0.0.1"
    assert config == StationConfig().model_copy(update={"folder": tmp_path / "rasnik-data"})


def test_paths_count_from_the_folder_of_the_file(tmp_path: Path) -> None:
    text = (
        'folder = "data"\n[server]\ntoken_file = "token"\n'
        '[controls.mqtt]\npassword_file = "/etc/password"\n'
        + ONE
        + 'system = "mine.toml"\n[channel.camera]\nkind = "replay"\nsource = ["a/*.png", "/b"]\n'
        + '[[channel]]\nname = "two"\nsystem = "microras"\n'
    )
    config = load(tmp_path, text)
    assert config.folder == tmp_path / "data"
    assert config.server.token_file == tmp_path / "token"
    assert config.controls.mqtt.password_file == Path("/etc/password")
    assert config.channel[0].system == str(tmp_path / "mine.toml")
    assert config.channel[0].camera.source == [str(tmp_path / "a/*.png"), "/b"]
    assert config.channel[1].system == "microras"


def test_settings_of_the_camera(tmp_path: Path) -> None:
    text = CAMERA + 'frame_rate_hz = 275\nregion = [8, 4, 640, 480]\npixel_format = "Mono12"\n'
    camera = load(tmp_path, text).channel[0].camera
    assert camera.settings.changed() == {
        "frame_rate_hz": 275.0, "region": (8, 4, 640, 480), "pixel_format": "Mono12",
    }  # fmt: skip


def test_a_limit_of_one_side(tmp_path: Path) -> None:
    alarms = load(tmp_path, ONE + "[channel.alarms]\nx_um = [-inf, 2.5]\n").channel[0].alarms
    assert alarms.x_um == (-math.inf, 2.5)


def test_what_is_written_is_what_is_read(tmp_path: Path) -> None:
    text = (
        'name = "hall"\nfolder = "/data"\n[controls.epics]\nenabled = true\n'
        + ONE
        + 'orientation = 4\n[channel.camera]\nkind = "aravis"\ndevice = "a \\"b\\" \\\\ c"\n'
        + "region = [0, 0, 64, 32]\n[channel.alarms]\ny_um = [-1, inf]\n"
        + '[channel.recording.raw]\non = ["glitch", "alarm"]\nevery_s = 60\n'
        + '[[channel]]\nname = "two"\n[channel.recording]\nenabled = false\n'
    )
    config = load(tmp_path, text)
    assert load(tmp_path, station_toml(config)) == config


# ------------------------------------------------------------------------------ faults

FAULTS = {
    "no such field": ("port = 1\n", "there is no field port; did you mean server.port"),
    "near a field of a channel": (
        CAMERA + "exposure = 5\n",
        "no field channel[one].camera.exposure; did you mean channel.camera.exposure_us",
    ),
    "one bracket": ('[channel]\nname = "one"\n', "write [[channel]] with two brackets"),
    "plural": ('[[channels]]\nname = "one"\n', "there is no field channels; did you mean channel"),
    "no channel": ("channel = []\n", "channel = []: it should have at least 1"),
    "numbers for channels": ("channel = [3]\n", "channel[1] = 3: it should be a table"),
    "no name": (ONE + "[[channel]]\n", "channel[2].name is missing"),
    "bad name": ('[[channel]]\nname = "a/b"\n', "channel[a/b].name = 'a/b'"),
    "long name": (f'[[channel]]\nname = "{"a" * 41}"\n', ".name = 'aaa"),
    "twice": (ONE + ONE, "different names; not so: one"),
    "twice for some disks": (ONE + '[[channel]]\nname = "One"\n', "not so: One, one"),
    "kind": (CAMERA + 'kind = "usb"\n', "channel[one].camera.kind = 'usb': it should be 'simul"),
    "no source": (CAMERA + 'kind = "replay"\n', "channel[one].camera, a replay needs a source"),
    "source as text": (CAMERA + 'source = "x"\n', "camera.source = 'x': it should be a list"),
    "rate of zero": (CAMERA + "frame_rate_hz = 0\n", "frame_rate_hz = 0: it should be greater"),
    "rate with unit": (CAMERA + 'frame_rate_hz = "275 Hz"\n', "frame_rate_hz = '275 Hz'"),
    "rate without end": (CAMERA + "frame_rate_hz = inf\n", "frame_rate_hz = inf: it should be a f"),
    "gain not a number": (CAMERA + "gain_db = nan\n", "camera.gain_db = nan"),
    "three numbers": (CAMERA + "region = [1, 2, 3]\n", "camera.region.3 is missing"),
    "region left of zero": (CAMERA + "region = [-1, 0, 64, 64]\n", "region = [-1, 0, 64, 64] is"),
    "region of nothing": (CAMERA + "region = [0, 0, 64, 0]\n", "width and height at least 8"),
    "pixel format": (CAMERA + 'pixel_format = "RGB8"\n', "pixel_format = 'RGB8': it should be 'M"),
    "packets": (CAMERA + "packet_bytes = 100\n", "packet_bytes = 100: it should be greater than"),
    "limits exchanged": (ONE + "[channel.alarms]\nx_um = [3, 1]\n", "alarms.x_um, the lower limit"),
    "limits no numbers": (ONE + "[channel.alarms]\nx_um = [nan, 1]\n", "alarms.x_um, the lower"),
    "one limit": (ONE + "[channel.alarms]\nx_um = 3\n", "alarms.x_um = 3: it should be a list"),
    "event": (ONE + '[channel.recording.raw]\non = ["x"]\n', "recording.raw.on.0 = 'x'"),
    "rotation": (ONE + "[channel.recording]\nrotate_hours = 0\n", "recording.rotate_hours = 0"),
    "table as text": (ONE + 'camera = "aravis"\n', "camera = 'aravis': it should be a table"),
    "orientation": (ONE + "orientation = 5\n", "channel[one].orientation = 5"),
    "port": ("[server]\nport = 99999\n", "server.port = 99999: it should be less than"),
    "host": ("[server]\nhost = 3\n", "server.host = 3: it should be a valid string"),
    "prefix": ('[controls.epics]\nprefix = "a b"\n', "controls.epics.prefix = 'a b'"),
    "folder": ("folder = 3\n", "folder = 3: it should be a path"),
    "no TOML": ('name = "one\n', "not valid TOML"),
    "a key twice": ("[server]\n[server]\n", "not valid TOML"),
}


@pytest.mark.parametrize("text, words", FAULTS.values(), ids=FAULTS)
def test_fault(tmp_path: Path, text: str, words: str) -> None:
    (sentence,) = problems(tmp_path, text)
    assert words in sentence
    assert "\n" not in sentence and "pydantic" not in sentence and "Input" not in sentence


def test_all_faults_at_once(tmp_path: Path) -> None:
    text = CAMERA + 'kind = "usb"\nframe_rate_hz = -1\n[[channel]]\nname = "two"\nx = 1\n'
    found = problems(tmp_path, text)
    assert len(found) == 3
    assert sum("channel[one].camera" in sentence for sentence in found) == 2
    assert any("channel[two].x" in sentence for sentence in found)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(SystemConfigError, match="there is no such file"):
        load_station(tmp_path / "none.toml")
    with pytest.raises(SystemConfigError, match="a folder"):
        load_station(tmp_path)
    (tmp_path / "x.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SystemConfigError, match="UTF-8"):
        load_station(tmp_path / "x.toml")


VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5),
    st.lists(st.integers(), max_size=4), st.dictionaries(st.text(max_size=3), st.integers()),
)  # fmt: skip
FIELDS = ("name", "folder", "server", "controls", "channel")


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(st.sampled_from(FIELDS), VALUES), st.lists(VALUES, max_size=2))
def test_whatever_a_file_holds_it_is_read_or_refused(
    data: dict[str, Any], channels: list[Any]
) -> None:
    """No fault gets past as another error than the one for faults."""
    if channels:
        data["channel"] = channels
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rasnik.live.station.read_toml", lambda path: data)
        try:
            config = load_station(Path("station.toml"))
        except SystemConfigError as error:
            assert error.problems and all(error.problems)
        else:
            assert config.channel
