"""Frames around events: which are kept, where, and what a kill leaves of them."""

import errno
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from rasnik import Flag, load_system
from rasnik.analysis.pose import Pose
from rasnik.cameras.camera import CameraFrame
from rasnik.io.images import iter_frames
from rasnik.recording import frame_file
from rasnik.recording.events import Event, FrameKeeper, Glitches
from rasnik.recording.frame_file import FrameWriter, complete_frames
from rasnik.recording.options import RawFrames, Recording
from rasnik.recording.recorder import Recorder
from rasnik.recording.sample import Sample

SYSTEM = load_system("solidras")
BEGIN_S = 1_772_366_400.0
RATE_HZ = 100.0
SIGMA_UM = 0.002


def sample_of(number: int, x_um: float = 5.0, ok: bool = True, received_s: float = 0.0) -> Sample:
    """Frame `number` shows its number, and came 10 ms after the one before."""
    image = np.full((6, 8), number % 65536, dtype=np.uint16)
    frame = CameraFrame(image, number, BEGIN_S + number / RATE_HZ, received_s + number / RATE_HZ)
    if not ok:
        return Sample(frame, number, Pose(flags=Flag.NO_MASK))
    covariance = np.diag([SIGMA_UM**2, SIGMA_UM**2, 1e-12, 1e-12])
    pose = Pose(ok=True, x_um=x_um, y_um=0.0, scale=1.0, theta_rad=0.0, covariance=covariance)
    return Sample(frame, number, pose)


class Kept:
    """What a keeper hands over."""

    def __init__(self) -> None:
        self.frames: dict[Event, list[int]] = {}
        self.ended: list[Event] = []

    def write(self, event: Event, sample: Sample) -> None:
        self.frames.setdefault(event, []).append(sample.number)

    def keeper(self, most_bytes: int = 1 << 20, **options) -> FrameKeeper:
        return FrameKeeper(RawFrames(**options), self.write, self.ended.append, most_bytes)

    @property
    def numbers(self) -> list[tuple[str, list[int]]]:
        return [(event.reason, numbers) for event, numbers in self.frames.items()]


# ------------------------------------------------------------------------ which frames


def test_frames_before_and_after_a_lost_lock():
    kept = Kept()
    keeper = kept.keeper(before_s=0.095, after_s=0.055)
    for number in range(100):
        keeper.add(sample_of(number, ok=not 50 <= number < 53), automatic=True)
    assert kept.numbers == [("lock_lost", list(range(41, 56)))]
    assert [event.reason for event in kept.ended] == ["lock_lost"]


def test_a_camera_that_never_had_a_lock_does_not_lose_it():
    kept = Kept()
    keeper = kept.keeper()
    for number in range(100):
        keeper.add(sample_of(number, ok=False), automatic=True)
    assert kept.numbers == []


def test_events_are_for_while_it_records():
    kept = Kept()
    keeper = kept.keeper(every_s=0.1)
    for number in range(100):
        keeper.add(sample_of(number, ok=number < 50), automatic=False)
    assert kept.numbers == []


def test_frames_before_an_event_are_bounded_in_memory():
    kept = Kept()
    size = sample_of(0).frame.image.nbytes
    keeper = kept.keeper(most_bytes=5 * size, before_s=60, after_s=0)
    for number in range(100):
        keeper.add(sample_of(number, ok=number < 50), automatic=True)
    assert kept.numbers == [("lock_lost", [45, 46, 47, 48, 49, 50])]


def test_on_schedule():
    kept = Kept()
    keeper = kept.keeper(every_s=0.295, on=[])
    for number in range(100):
        keeper.add(sample_of(number), automatic=True)
    assert kept.numbers == [("schedule", [number]) for number in (0, 30, 60, 90)]
    assert len(kept.ended) == 4


def test_on_demand_and_by_alarm(monkeypatch):
    kept = Kept()
    now_s = [0.0]
    monkeypatch.setattr("rasnik.recording.events.time.perf_counter", lambda: now_s[0])
    keeper = kept.keeper(before_s=0.045, after_s=0.045, on=["alarm"])
    for number in range(200):
        now_s[0] = number / RATE_HZ
        keeper.add(sample_of(number), automatic=False)
        match number:
            case 20:
                keeper.event("asked for")
            case 22:
                keeper.event("alarm: x_um is too large")
            case 100:
                keeper.event("alarm: y_um is too large")
            case 150:
                keeper.event("glitch")  # not among the options
    assert kept.numbers == [
        ("asked for", list(range(16, 25))),
        ("alarm: y_um is too large", list(range(96, 105))),
    ]
    assert kept.ended[0].later == ["alarm: x_um is too large"]


def test_an_event_ends_also_if_no_frames_come(monkeypatch):
    kept = Kept()
    now_s = [0.0]
    monkeypatch.setattr("rasnik.recording.events.time.perf_counter", lambda: now_s[0])
    keeper = kept.keeper(after_s=1.0)
    keeper.add(sample_of(0), automatic=True)
    keeper.event("asked for")
    now_s[0] = 1.2
    keeper.tick()
    assert kept.ended == []
    now_s[0] = 1.6
    keeper.tick()
    assert len(kept.ended) == 1


def test_no_more_events_in_an_hour_than_wanted():
    kept = Kept()
    keeper = kept.keeper(most_per_hour=3, before_s=0, after_s=0)
    for number in range(100):
        keeper.add(sample_of(number, ok=number % 10 < 5), automatic=True)
    assert len(kept.frames) == 3
    assert keeper.refused == 7
    for number in range(370_000, 370_010):
        keeper.add(sample_of(number, ok=number % 10 < 5), automatic=True)
    assert len(kept.frames) == 4


# ------------------------------------------------------------------------ glitches


def glitches_in(x_um: np.ndarray, sigmas: float = 8.0) -> list[int]:
    finder = Glitches(sigmas)
    return [k for k, value in enumerate(x_um) if finder.add(sample_of(k, float(value)))]


def test_noise_alone_is_no_glitch(rng):
    assert glitches_in(rng.normal(0, SIGMA_UM, 5000)) == []


def test_a_jump_is_a_glitch_and_what_jumped_is_named(rng):
    x_um = rng.normal(0, SIGMA_UM, 1000)
    x_um[700:] += 12 * np.sqrt(2) * SIGMA_UM
    assert glitches_in(x_um) == [700]
    finder = Glitches(8.0)
    finder.add(sample_of(0, 0.0))
    assert finder.add(sample_of(1, 1.0)) == "x"


def test_motion_is_no_glitch_once_it_is_known(rng):
    """2 um at 0.3 Hz moves by 19 of these sigma from frame to frame."""
    time_s = np.arange(3000) / RATE_HZ
    x_um = 2 * np.sin(2 * np.pi * 0.3 * time_s) + rng.normal(0, SIGMA_UM, len(time_s))
    assert all(k < 100 for k in glitches_in(x_um))
    x_um[2000] += 1.0
    assert 2000 in glitches_in(x_um)


def test_only_neighbours_are_compared():
    finder = Glitches(8.0)
    finder.add(sample_of(0, 0.0))
    assert finder.add(sample_of(2, 1.0)) == ""
    finder.add(sample_of(3, ok=False))
    assert finder.add(sample_of(4, 5.0)) == ""


# ------------------------------------------------------------------------ files


def write_event(folder: Path, event: Event, samples: list[Sample]) -> FrameWriter:
    writer = FrameWriter(folder, "hall", SYSTEM, {"camera": "simulated 1"}, keep_free_mib=0)
    for sample in samples:
        writer.write(event, sample)
    writer.end(event)
    writer.close(10.0)
    return writer


def test_frames_come_back_with_their_poses_and_the_reason(tmp_path):
    event = Event("glitch: x, y", BEGIN_S, ["alarm: y", "alarm: y", "lock_lost"])
    samples = [sample_of(number, x_um=number / 7) for number in (3, 4, 6)]
    writer = write_event(tmp_path, event, samples)
    assert (writer.kept, writer.dropped, writer.trouble) == (3, 0, "")
    (path,) = tmp_path.iterdir()
    assert path.name == "hall_20260301T120000Z_glitch.h5"
    images = [frame.image for frame in iter_frames([path])]
    for image, sample in zip(images, samples, strict=True):
        np.testing.assert_array_equal(image, sample.frame.image)
    with h5py.File(path) as file:
        about = dict(file["poses"].attrs)
        poses = file["poses"][:]
    np.testing.assert_array_equal(poses["frame"], [3, 4, 6])
    np.testing.assert_array_equal(poses["x_um"], [s.pose.x_um for s in samples])
    np.testing.assert_array_equal(poses["host_time_s"], [s.frame.host_time_s for s in samples])
    assert about["reason"] == "glitch: x, y"
    assert about["also"].decode() == "alarm: y; lock_lost"
    assert about["event_time_utc"] == "2026-03-01T12:00:00.000+00:00"
    assert about["camera"] == "simulated 1"
    assert about["system_toml"] == SYSTEM.to_toml()


def test_two_events_in_a_second_have_two_files(tmp_path):
    for number in range(3):
        write_event(tmp_path, Event("asked for", BEGIN_S), [sample_of(number)])
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [f"hall_20260301T120000Z_asked-for{n}.h5" for n in ("", "_2", "_3")]


def test_a_frame_of_another_size_is_dropped_and_counted(tmp_path):
    other = sample_of(1)
    object.__setattr__(other.frame, "image", np.zeros((3, 3), dtype=np.uint16))
    writer = write_event(tmp_path, Event("asked for", BEGIN_S), [sample_of(0), other])
    assert (writer.kept, writer.dropped) == (1, 1)


def test_what_does_not_fit_into_memory_is_dropped_and_counted(tmp_path):
    size = sample_of(0).frame.image.nbytes
    writer = FrameWriter(tmp_path, "a", SYSTEM, {}, keep_free_mib=0, most_bytes=size - 1)
    writer.write(Event("asked for", BEGIN_S), sample_of(0))
    writer.close(10.0)
    assert (writer.kept, writer.dropped) == (0, 1)


def test_a_disk_without_space_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(frame_file, "free_mib", lambda folder: 0.0)
    writer = write_event(tmp_path, Event("asked for", BEGIN_S), [sample_of(0)])
    assert (writer.kept, writer.dropped) == (0, 1)
    assert "the disk is full" in writer.trouble
    assert list(tmp_path.iterdir()) == []


def test_an_event_that_fails_does_not_stop_the_next(tmp_path, monkeypatch):
    healthy, failing = frame_file.append_rows, [True]

    def append(dataset, rows):
        if failing[0]:
            raise OSError(errno.EIO, "input/output error")
        return healthy(dataset, rows)

    monkeypatch.setattr(frame_file, "append_rows", append)
    writer = FrameWriter(tmp_path, "a", SYSTEM, {}, keep_free_mib=0)
    first, second = Event("first", BEGIN_S), Event("second", BEGIN_S)
    writer.write(first, sample_of(0))
    writer.write(first, sample_of(1))
    while writer.dropped < 2:
        time.sleep(0.01)
    assert "input/output error" in writer.trouble
    failing[0] = False
    writer.write(second, sample_of(2))
    writer.end(second)
    writer.close(10.0)
    assert (writer.kept, writer.dropped, writer.trouble) == (1, 2, "")


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_frames_of_a_killed_program_are_completed(tmp_path):
    code = f"""if True:
        import os, signal, sys, time
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from test_recording_frames import *
        writer = FrameWriter(Path(sys.argv[1]), "hall", SYSTEM, {{}}, keep_free_mib=0)
        for number in range(20):
            writer.write(event := Event("asked for", BEGIN_S) if number == 0 else event,
                         sample_of(number))
        while writer.kept < 20:
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    subprocess.run([sys.executable, "-c", code, tmp_path], check=False)
    (part,) = tmp_path.iterdir()
    assert part.name.endswith(".h5.part")
    complete_frames(tmp_path)
    (path,) = tmp_path.iterdir()
    assert path.name == "hall_20260301T120000Z_asked-for.h5"
    frames = list(iter_frames([path]))
    assert [int(frame.image[0, 0]) for frame in frames] == list(range(20))


def test_a_part_that_another_program_writes_is_left_alone(tmp_path):
    writer = FrameWriter(tmp_path, "hall", SYSTEM, {}, keep_free_mib=0)
    event = Event("asked for", BEGIN_S)
    writer.write(event, sample_of(0))
    while not writer.kept:
        time.sleep(0.01)
    complete_frames(tmp_path)
    assert [path.suffix for path in tmp_path.iterdir()] == [".part"]
    (tmp_path / "x.h5.part").write_bytes(b"damaged")
    complete_frames(tmp_path)
    assert (tmp_path / "x.h5.part").read_bytes() == b"damaged"
    writer.close(10.0)
    assert len(list(tmp_path.glob("hall*.h5"))) == 1


def test_a_recorder_keeps_them(tmp_path):
    options = Recording(flush_s=0.1, keep_free_mib=0, raw=RawFrames(before_s=0.505, after_s=0.105))
    with Recorder(tmp_path, "hall", SYSTEM, options, {}) as record:
        record.start()
        now_s = time.perf_counter()
        for number in range(100):
            record.add(sample_of(number, ok=number < 80, received_s=now_s))
        record.event("asked for")
    assert record.status().kept_frames == 70
    assert record.status().dropped_frames == 0
    numbers = {
        path.stem.rpartition("_")[2]: [int(frame.image[0, 0]) for frame in iter_frames([path])]
        for path in (tmp_path / "hall" / "frames").iterdir()
    }
    assert numbers == {"lock-lost": list(range(30, 91)), "asked-for": list(range(91, 100))}
