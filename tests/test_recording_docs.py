"""The page on recording: its example runs, its columns are the files', frames are images."""

import re
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from rasnik import load_system
from rasnik.analysis.pose import Pose
from rasnik.cameras.camera import CameraFrame
from rasnik.cameras.replay import ReplayCamera
from rasnik.live.station import ChannelConfig
from rasnik.recording.options import RawFrames, Recording
from rasnik.recording.recorder import Recorder
from rasnik.recording.rows import RECORD_COLUMNS, RECORD_ROW
from rasnik.recording.sample import Sample

PAGE = Path(__file__).resolve().parents[1] / "docs" / "recording.md"
NUMBERS = [*range(10), *range(13, 20)]


@pytest.fixture
def text() -> str:
    if not PAGE.exists():
        pytest.skip("the pages are not beside the tests")
    return PAGE.read_text(encoding="utf-8")


@pytest.fixture
def station(tmp_path):
    """A folder with a record of two files, and the frames of one event."""
    options = Recording(keep_free_mib=0, flush_s=0.1)
    folder = tmp_path / "rasnik-data"
    with Recorder(folder, "hall-1", load_system("solidras"), options, {}) as recorder:
        for part in (NUMBERS[:5], NUMBERS[5:]):
            recorder.start()
            for number in part:
                image = np.full((4, 6), number, dtype=np.uint8)
                frame = CameraFrame(image, number, 1.77e9 + number, time.perf_counter(), number / 9)
                pose = Pose(ok=True, x_um=number / 3, y_um=0.0, scale=1.0, theta_rad=0.0)
                recorder.add(Sample(frame, number, pose))
            recorder.stop()
        recorder.event("asked for")
    return folder


def test_the_example_runs(text, station, monkeypatch):
    example = re.search(r"    from pathlib import Path\n.*?- 1\n", text, re.DOTALL)
    assert example is not None
    monkeypatch.chdir(station.parent)
    names: dict = {}
    exec(textwrap.dedent(example[0]), names)  # noqa: S102 -- what the page says
    np.testing.assert_array_equal(names["x_um"], np.array(NUMBERS) / 3)
    np.testing.assert_array_equal(names["time_s"], np.array(NUMBERS) / 9)
    assert names["lost"].sum() == 3


def test_columns_are_those_of_the_files(text):
    for column in RECORD_COLUMNS:
        assert f"| `{column.name}` | {column.unit} | {column.description} |" in text
    assert f"One row takes {RECORD_ROW.itemsize} bytes" in text


def test_options_are_those_of_the_station_file(text):
    import tomllib

    blocks = re.findall(r"(?:^    .*\n|^\n)+", text, re.MULTILINE)
    (toml,) = (block for block in blocks if "[channel.recording]" in block)
    given = tomllib.loads(textwrap.dedent(toml))["channel"]
    channel = ChannelConfig.model_validate({"name": "hall", **given})
    assert channel.recording == Recording(raw=RawFrames(every_s=60))
    assert set(given["recording"]) == set(Recording.model_fields)
    assert set(given["recording"]["raw"]) == set(RawFrames.model_fields)


def test_frames_of_an_event_are_replayed(station):
    (path,) = (station / "hall-1" / "frames").iterdir()
    camera = ReplayCamera([str(path)], pace="full", bit_depth=8)
    camera.open()
    frames = [camera.read(1.0) for _ in NUMBERS]
    camera.close()
    assert [int(frame.image[0, 0]) for frame in frames] == NUMBERS
