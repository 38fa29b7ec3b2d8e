"""``rasnik live``, run as a user does."""

from __future__ import annotations

import importlib.util
import io
import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from _live_camera import IMAGES, write_system
from rasnik.cli.live_run import _asked_to_end
from rasnik.cli.live_table import Announcer
from rasnik.io import read_track
from rasnik.live.station import StationConfig, load_station
from rasnik.live.status import ChannelStatus
from test_cli import rasnik, refused

PAGE = all(importlib.util.find_spec(name) for name in ("starlette", "uvicorn", "websockets"))
CHANNEL = """
[[channel]]
name = "one"
system = "small.toml"
"""
SIMULATED = CHANNEL + "camera = { frame_rate_hz = 50, motion_um = 0.1 }\n"
LAST_LINE = re.compile(
    r"one: (\d+) frames, (\d+) with a position, (\d+) lost, (\d+) dropped, (\d+) recorded"
)


@pytest.fixture
def station(tmp_path) -> Path:
    write_system(tmp_path)
    path = tmp_path / "station.toml"
    path.write_text(SIMULATED, encoding="utf-8")
    return path


def begin(*arguments: object, folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "from rasnik.cli import app; app()", "live"]
    return subprocess.Popen(
        [*command, *map(str, arguments)], cwd=folder, text=True, bufsize=1,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def line_with(process: subprocess.Popen[str], text: str) -> str:
    assert process.stderr is not None
    said = []
    for line in process.stderr:
        said.append(line)
        if text in line:
            return line
    raise AssertionError(f"{text!r} was not said, but {said}")


def recorded(folder: Path) -> np.ndarray:
    files = sorted((folder / "one").glob("*.h5"))
    return np.concatenate([read_track(file).frame for file in files])


@pytest.mark.skipif(not PAGE, reason="the page is not installed: pip install 'rasnik[live]'")
@pytest.mark.skipif(os.name != "posix", reason="signals are sent to a process")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_two_seconds_with_a_page_and_a_signal(station, tmp_path, number):
    process = begin(station, "--port", "0", folder=tmp_path)
    try:
        url = line_with(process, "page: ").split()[1]
        line_with(process, "running")
        with urllib.request.urlopen(url, timeout=10) as answer:
            assert answer.status == 200
        time.sleep(2)
        process.send_signal(number)
        output, errors = process.communicate(timeout=20)
    finally:
        process.kill()
    assert (process.returncode, output) == (0, "")
    assert "Traceback" not in errors
    found = LAST_LINE.search(errors)
    assert found, errors
    frames, tracked, _, dropped, rows = map(int, found.groups())
    assert tracked + dropped == frames >= 20
    assert rows == tracked
    assert len(recorded(tmp_path / "rasnik-data")) == rows


def test_a_replay_ends_by_itself(tmp_path):
    write_system(tmp_path)
    (tmp_path / "frames").mkdir()
    for k in range(6):
        Image.fromarray(IMAGES[k % len(IMAGES)]).save(tmp_path / "frames" / f"{k}.png")
    station = tmp_path / "station.toml"
    camera = 'camera = { kind = "replay", source = ["frames"], pace = "full" }\n'
    station.write_text(CHANNEL + camera, encoding="utf-8")
    result = rasnik("live", station, "--no-page", "--record", tmp_path / "there")
    assert result.exit_code == 0
    assert "one: 6 frames, 6 with a position, 0 lost, 0 dropped, 6 recorded" in result.stderr
    assert recorded(tmp_path / "there").tolist() == list(range(6))


def test_seconds_end_it_and_nothing_is_recorded(station, tmp_path):
    result = rasnik("live", station, "--no-page", "--no-record", "--seconds", "1")
    assert result.exit_code == 0
    found = LAST_LINE.search(result.stderr)
    assert found, result.stderr
    assert int(found[5]) == 0
    assert not list(tmp_path.rglob("*.h5"))


def test_a_camera_that_cannot_be_set_fails(station):
    station.write_text(SIMULATED.replace("50", "50, gain_db = 99"), encoding="utf-8")
    result = rasnik("live", station, "--no-page", "--seconds", "20")
    assert result.exit_code == 1
    assert "failed" in result.stderr
    assert "gain" in result.stderr


def test_init_writes_a_station_and_overwrites_none(tmp_path):
    path = tmp_path / "new.toml"
    assert rasnik("live", "--init", path).exit_code == 0
    config = load_station(path)
    assert config == StationConfig(folder=tmp_path / "rasnik-data")
    assert "exists already" in refused("live", "--init", path)
    assert "cannot be written" in refused("live", "--init", tmp_path / "no" / "new.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("channel = 3", "channel = 3"),
        (CHANNEL + "camra = 1", "there is no field channel[one].camra"),
        (CHANNEL + "[channel.camera]\nkind = 'replay'", "a replay needs a source"),
        (CHANNEL.replace("small", "other"), "other.toml"),
    ],
)
def test_a_station_file_with_faults_is_refused(station, text, message):
    station.write_text(text, encoding="utf-8")
    assert message in refused("live", station, "--no-page")


def test_what_does_not_go_together_is_refused(station):
    assert "exclude each other" in refused("live", station, "--record", "x", "--no-record")
    assert "there is no such file" in refused("live", station.with_name("none.toml"))


@pytest.mark.skipif(not PAGE, reason="the page is not installed: pip install 'rasnik[live]'")
def test_other_addresses_need_a_token(station):
    message = refused("live", station, "--host", "0.0.0.0", "--port", "0")
    assert "token_file" in message


def test_every_line_of_the_log_names_its_channel():
    console = Console(file=io.StringIO(), width=200)
    alarm, full = "x is 12 um, above 10 um", "The disk is full."
    statuses = [
        ChannelStatus("one", state="running", camera="a camera", alarms=(alarm,)),
        ChannelStatus("two", state="lost", camera="another", recording_message=full),
    ]
    announcer = Announcer(console, "")
    announcer.tell(statuses)
    announcer.tell(statuses)
    assert console.file.getvalue().splitlines() == [  # type: ignore[attr-defined]
        "one (a camera): running", f"one: alarm: {alarm}", "two (another): lost", f"two: {full}",
    ]  # fmt: skip


def test_who_asks_to_end_is_heard_while_it_waits_and_afterwards():
    with _asked_to_end() as asked:
        assert not asked.wait(0.01)
        later = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM))
        later.start()
        assert asked.wait(20)
        assert asked.wait(0.01)
        later.join()
