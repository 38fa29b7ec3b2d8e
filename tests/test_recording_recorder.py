"""The record of a channel: what was added is in the files, whatever the disk does."""

import errno
import time
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pytest

from rasnik import Flag, load_system
from rasnik.analysis.pose import Pose
from rasnik.cameras.camera import CameraFrame
from rasnik.io import read_track
from rasnik.io.track_table import read_rows
from rasnik.recording import disk, record_file, recorder
from rasnik.recording.options import RawFrames, Recording
from rasnik.recording.record_file import record_files
from rasnik.recording.recorder import Recorder
from rasnik.recording.rows import RECORD_COLUMNS, RowQueue, row_of
from rasnik.recording.sample import Sample

SYSTEM = load_system("solidras")
CHANNEL = "hall-1"
BEGIN_S = datetime(2026, 3, 1, 12, tzinfo=UTC).timestamp()
RATE_HZ = 275.0
IMAGE = np.zeros((6, 8), dtype=np.uint8)


def sample_of(number: int, time_s: float | None = None, ok: bool = True) -> Sample:
    """A sample whose every value follows from its number."""
    time_s = BEGIN_S + number / RATE_HZ if time_s is None else time_s
    frame = CameraFrame(
        IMAGE, number % 65536, time_s, time.perf_counter(), number / RATE_HZ, 200.0, 3.0
    )
    if not ok:
        return Sample(frame, number, Pose(flags=Flag.NO_MASK))
    pose = Pose(
        ok=True, x_um=number + 0.25, y_um=-number, scale=1 + 1e-6 * number, theta_rad=1e-3,
        covariance=np.diag([1e-6, 4e-6, 1e-12, 1e-10]), chi2_ndf=1.0, flags=Flag.MOVED,
    )  # fmt: skip
    return Sample(frame, number, pose)


def recorder_of(folder: Path, **options) -> Recorder:
    options = {"flush_s": 0.1, "keep_free_mib": 0, **options}
    return Recorder(folder, CHANNEL, SYSTEM, Recording(**options), {"camera": "simulated 1"})


def wait_for(condition, seconds: float = 8.0) -> None:
    end_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"
        time.sleep(0.01)


def rows_in(folder: Path) -> np.ndarray:
    return np.concatenate([read_rows(path)[0] for path in record_files(folder / CHANNEL)])


# ------------------------------------------------------------------------ rows and files


def test_every_column_is_what_the_sample_holds(tmp_path):
    with recorder_of(tmp_path) as record:
        record.start()
        record.add(sample_of(7))
        record.add(sample_of(9, ok=False))
        wait_for(lambda: record.status().rows == 2)
        status = record.status()
        assert status.recording
        assert status.message == ""
    path = tmp_path / CHANNEL / f"{CHANNEL}_20260301T120000Z.h5"
    assert Path(status.file) == path
    rows, metadata = read_rows(path)
    np.testing.assert_array_equal(rows["frame"], [7, 9])  # 8 is a gap
    np.testing.assert_array_equal(rows["x_um"], [7.25, np.nan])
    np.testing.assert_array_equal(rows["sigma_y_um"], [2e-3, np.nan])
    np.testing.assert_array_equal(rows["flags"], [Flag.MOVED, Flag.NO_MASK])
    np.testing.assert_array_equal(rows["time_s"], rows["host_time_s"])
    np.testing.assert_array_equal(rows["host_time_s"], BEGIN_S + rows["frame"] / RATE_HZ)
    np.testing.assert_array_equal(rows["device_time_s"], rows["frame"] / RATE_HZ)
    np.testing.assert_array_equal(rows["camera_number"], [7, 9])
    np.testing.assert_array_equal(rows["exposure_us"], 200.0)
    np.testing.assert_array_equal(rows["gain_db"], 3.0)
    assert (rows["latency_s"] > 0).all()
    assert (rows["latency_s"] < 1).all()
    assert metadata["camera"] == "simulated 1"
    assert metadata["source"] == CHANNEL
    assert metadata["start_time_utc"] == "2026-03-01T12:00:00.025+00:00"
    assert metadata["system_toml"] == SYSTEM.to_toml()
    track = read_track(path)
    np.testing.assert_array_equal(track.ok, [True, False])
    with h5py.File(path) as file:
        assert list(file["track"].attrs["columns"][-6:]) == [c.name for c in RECORD_COLUMNS]


def test_nothing_is_recorded_before_start_or_after_stop(tmp_path):
    with recorder_of(tmp_path) as record:
        record.add(sample_of(0))
        record.start()
        record.start()
        for number in range(1, 5):
            record.add(sample_of(number))
        record.stop()
        assert not record.status().recording
        record.add(sample_of(5))
        record.start()
        record.add(sample_of(6))
        record.stop()
        record.stop()
    first, second = record_files(tmp_path / CHANNEL)
    np.testing.assert_array_equal(read_track(first).frame, [1, 2, 3, 4])
    np.testing.assert_array_equal(read_track(second).frame, [6])
    with pytest.raises(RuntimeError, match="closed; make a new one"):
        record.start()


def test_a_recorder_that_never_starts_leaves_no_file(tmp_path):
    with recorder_of(tmp_path) as record:
        record.add(sample_of(0))
    assert list(tmp_path.rglob("*")) == []


def test_files_are_rotated_by_size_without_losing_a_row(tmp_path, monkeypatch):
    monkeypatch.setattr(record_file, "_MIB", 65_536)  # a file is full after 64 KiB
    with recorder_of(tmp_path, rotate_mib=1) as record:
        record.start()
        for number in range(3000):
            record.add(sample_of(number))
            if number % 100 == 99:
                wait_for(lambda stored=number + 1: record.status().rows == stored)
    assert len(record_files(tmp_path / CHANNEL)) >= 5
    np.testing.assert_array_equal(rows_in(tmp_path)["frame"], np.arange(3000))


def test_files_are_rotated_by_time(tmp_path):
    with recorder_of(tmp_path, rotate_hours=0.3 / 3600) as record:
        record.start()
        for number in range(3):
            record.add(sample_of(number))
            wait_for(lambda stored=number + 1: record.status().rows == stored)
            time.sleep(0.35)
    names = [path.name for path in record_files(tmp_path / CHANNEL)]
    stem = f"{CHANNEL}_20260301T120000Z"
    assert names == [f"{stem}.h5", f"{stem}_2.h5", f"{stem}_3.h5"]
    np.testing.assert_array_equal(rows_in(tmp_path)["frame"], [0, 1, 2])


def test_an_existing_file_is_never_touched(tmp_path):
    path = tmp_path / CHANNEL / f"{CHANNEL}_20260301T120000Z.h5"
    path.parent.mkdir()
    path.write_bytes(b"of somebody else")
    with recorder_of(tmp_path) as record:
        record.start()
        record.add(sample_of(0))
    assert path.read_bytes() == b"of somebody else"
    np.testing.assert_array_equal(
        read_track(path.with_name(f"{CHANNEL}_20260301T120000Z_2.h5")).frame, [0]
    )


def test_numbers_that_begin_again_begin_a_new_file(tmp_path):
    with recorder_of(tmp_path) as record:
        record.start()
        record.add(sample_of(10))
        wait_for(lambda: record.status().rows == 1)
        record.add(sample_of(3))
    assert [len(read_track(path)) for path in record_files(tmp_path / CHANNEL)] == [1, 1]


def test_numbers_that_begin_again_among_rows_that_wait(tmp_path):
    with recorder_of(tmp_path, flush_s=2.0) as record:
        record.start()
        for number in (10, 11, 3, 4, 4):
            record.add(sample_of(number))
    np.testing.assert_array_equal(rows_in(tmp_path)["frame"], [10, 11, 3, 4, 4])


# ------------------------------------------------------------------------ trouble with the disk


def test_a_full_disk_is_said_and_waited_for(tmp_path, monkeypatch):
    free = [100.0]
    monkeypatch.setattr(record_file, "free_mib", lambda folder: free[0])
    with recorder_of(tmp_path, keep_free_mib=50) as record:
        record.start()
        record.add(sample_of(0))
        wait_for(lambda: record.status().rows == 1)
        free[0] = 49.0
        for number in range(1, 500):
            record.add(sample_of(number))
        wait_for(lambda: record.status().message)
        status = record.status()
        assert "The disk is full: 49.0 MiB are free" in status.message
        assert "Make space" in status.message
        assert (status.rows, status.not_recorded) == (1, 0)
        free[0] = 60.0
        wait_for(lambda: record.status().rows == 500)
        assert record.status().message == ""
    assert len(record_files(tmp_path / CHANNEL)) == 1
    np.testing.assert_array_equal(rows_in(tmp_path)["frame"], np.arange(500))


def test_what_memory_cannot_hold_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "_MOST_ROWS", 1000)
    free = [0.0]
    monkeypatch.setattr(record_file, "free_mib", lambda folder: free[0])
    with recorder_of(tmp_path) as record:
        record.start()
        for number in range(1500):
            record.add(sample_of(number))
        assert record.status().not_recorded == 500
        assert "500 rows were not recorded" in record.status().message
        free[0] = 60.0
        wait_for(lambda: record.status().rows == 1000)
        record.add(sample_of(1500))
    np.testing.assert_array_equal(rows_in(tmp_path)["frame"], [*range(1000), 1500])
    assert record.status().not_recorded == 500


def test_what_still_waits_at_the_end_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "_STOP_S", 0.2)
    monkeypatch.setattr(record_file, "free_mib", lambda folder: 0.0)
    with recorder_of(tmp_path) as record:
        record.start()
        record.add(sample_of(0))
    assert record.status().not_recorded == 1


def test_a_file_that_breaks_is_followed_by_another(tmp_path, monkeypatch):
    """Rows whose storing failed are in the next file, whether or not the first has them."""
    from rasnik.io import track_file

    healthy, broken = track_file.append_rows, [False]

    def failing(dataset, rows):
        if broken[0]:
            raise OSError(errno.EIO, "input/output error")
        return healthy(dataset, rows)

    monkeypatch.setattr(track_file, "append_rows", failing)
    with recorder_of(tmp_path) as record:
        record.start()
        record.add(sample_of(0))
        wait_for(lambda: record.status().rows == 1)
        broken[0] = True
        record.add(sample_of(1))
        wait_for(lambda: record.status().message)
        assert "input/output error" in record.status().message
        assert "The next attempt follows by itself" in record.status().message
        record.add(sample_of(2))
        broken[0] = False
        wait_for(lambda: record.status().rows == 3)
        assert record.status().message == ""
    first, second = record_files(tmp_path / CHANNEL)
    np.testing.assert_array_equal(read_track(first).frame, [0])
    np.testing.assert_array_equal(read_track(second).frame, [1, 2])


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / CHANNEL).write_text("a file")
    with recorder_of(tmp_path) as record:
        record.start()
        record.add(sample_of(0))
        wait_for(lambda: record.status().message)
        assert "cannot be stored" in record.status().message
        (tmp_path / CHANNEL).unlink()
        wait_for(lambda: record.status().rows == 1)


def test_adding_does_not_wait_for_a_slow_disk(tmp_path, monkeypatch):
    from rasnik.io.file_lock import FileLock

    monkeypatch.setattr(FileLock, "sync", lambda self: time.sleep(1.0))
    longest_s = 0.0
    with recorder_of(tmp_path) as record:
        record.start()
        samples = [sample_of(number) for number in range(1500)]
        for sample in samples:
            time.sleep(0.0005)
            begin_s = time.perf_counter()
            record.add(sample)
            longest_s = max(longest_s, time.perf_counter() - begin_s)
        record.stop()
    assert longest_s < 0.5  # half of what one wait for the disk takes
    np.testing.assert_array_equal(rows_in(tmp_path)["frame"], np.arange(1500))


def test_a_sample_that_makes_no_sense_stops_nothing(tmp_path):
    with recorder_of(tmp_path) as record:
        record.start()
        record.add(None)
        record.add(sample_of(1))
        assert "A sample was refused" in record.status().message
    np.testing.assert_array_equal(rows_in(tmp_path)["frame"], [1])


def test_space_is_that_of_the_disk(tmp_path):
    import shutil

    assert disk.free_mib(tmp_path) == pytest.approx(shutil.disk_usage(tmp_path).free / 2**20, 0.1)


# ------------------------------------------------------------------------ rows that wait


def test_rows_leave_the_queue_in_order(rng):
    queue, taken, number = RowQueue(50_000), [], 0
    for _ in range(200):
        for _ in range(int(rng.integers(0, 200))):
            assert queue.add(row_of(sample_of(number)))
            number += 1
        rows = queue.take(int(rng.integers(1, 9000)))
        part = int(rng.integers(0, len(rows) + 1))
        taken.extend(rows["frame"][:part])
        queue.forget(part)
        assert len(queue) == number - len(taken)
    while len(rows := queue.take(5000)):
        taken.extend(rows["frame"])
        queue.forget(len(rows))
    np.testing.assert_array_equal(taken, np.arange(number))
    assert len(queue) == 0


def test_options_for_frames_are_those_of_the_station():
    assert Recording().raw == RawFrames()
