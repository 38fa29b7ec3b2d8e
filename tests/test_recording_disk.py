"""Space on the disk: set aside before the library writes, and names that are not taken."""

import errno
import os
import shutil
import sys

import numpy as np
import pytest

from rasnik import Track
from rasnik.io import TrackWriter, disk_space, file_lock, read_track
from rasnik.io.disk_space import reserve
from rasnik.io.hdf5_repair import clear_write_marks
from rasnik.recording.disk import free_mib, new_name, reason_of, try_out
from rasnik.recording.record_file import record_files
from rasnik.recording.rows import RECORD_COLUMNS

ON_LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="for Linux")


def track_of(first: int, stop: int) -> Track:
    frame = np.arange(first, stop)
    values = {name: np.sin(frame) for name in Track().as_dict() if name != "frame"}
    return Track(**{**values, "frame": frame, "flags": frame % 7})


@ON_LINUX
def test_blocks_are_taken_and_the_length_stays(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"content")
    descriptor = os.open(path, os.O_RDWR)
    try:
        reserve(descriptor, 0, 1 << 20)
    finally:
        os.close(descriptor)
    if path.stat().st_blocks * 512 < 1 << 20:
        pytest.skip("the file system takes no blocks beforehand")
    assert path.read_bytes() == b"content"


@ON_LINUX
def test_more_than_the_disk_has_is_refused_before_any_is_taken(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_bytes(b"content")
    free = shutil.disk_usage(tmp_path).free
    monkeypatch.setattr(disk_space.ctypes, "CDLL", None)  # not to be called
    descriptor = os.open(path, os.O_RDWR)
    try:
        with pytest.raises(OSError, match="No space left") as caught:
            reserve(descriptor, 0, 2 * free + 1)
        assert caught.value.errno == errno.ENOSPC
    finally:
        os.close(descriptor)
    assert path.stat().st_size == len(b"content")


def test_a_track_file_on_a_full_disk_stays_whole(tmp_path, monkeypatch):
    """The library is not asked to write what there is no space for."""
    calls = []

    def full(descriptor, start, size):
        calls.append((start, size))
        if len(calls) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(file_lock, "reserve", full)
    path = tmp_path / "t.h5"
    file = TrackWriter(path, flush_s=0)
    file.write(track_of(0, 1000))
    stored = 1000
    with pytest.raises(OSError, match="No space left"):
        for first in range(1000, 10**6, 1000):
            file.write(track_of(first, first + 1000))
            stored = first + 1000
    with pytest.raises(OSError, match="No space left"):
        file.close()
    start, size = calls[0]
    assert start == 0
    assert size >= path.stat().st_size  # whatever was written was set aside before
    assert not clear_write_marks(path)  # closed as it should be
    np.testing.assert_array_equal(read_track(path).frame, np.arange(stored))
    assert stored > 5000  # in what was set aside
    monkeypatch.undo()
    with TrackWriter(path, resume=True) as file:
        file.write(track_of(stored, stored + 5))
    assert len(read_track(path)) == stored + 5


def test_further_columns_have_to_be_given(tmp_path):
    extra = RECORD_COLUMNS[:2]
    with TrackWriter(tmp_path / "t.h5", extra=extra) as file:
        values = {column.name: np.arange(3.0) for column in extra}
        file.write(track_of(0, 3), values)
        for wrong in (None, {}, {"host_time_s": np.arange(3.0)}, {**values, "gain_db": 1.0}):
            with pytest.raises(ValueError, match="the columns host_time_s, device_time_s are"):
                file.write(track_of(3, 6), wrong)
    assert len(read_track(tmp_path / "t.h5")) == 3
    with pytest.raises(ValueError, match="the columns are others"):
        TrackWriter(tmp_path / "t.h5", resume=True)
    with TrackWriter(tmp_path / "u.h5") as file, pytest.raises(ValueError, match=r"\(none\)"):
        file.write(track_of(0, 3), values)


def test_names_that_are_taken_get_a_number(tmp_path):
    names = []
    for _ in range(3):
        path = new_name(tmp_path, "a_b", 0.0, ".h5")
        path.touch()
        names.append(path.name)
    stem = "a_b_19700101T000000Z"
    assert names == [f"{stem}.h5", f"{stem}_2.h5", f"{stem}_3.h5"]
    for number in range(4, 12):
        (tmp_path / f"{stem}_{number}.h5").touch()
    for other in ("notes.h5", f"{stem}_x.h5", f"{stem}.csv", "a_b_20260101T000000Z.h5"):
        (tmp_path / other).touch()
    found = [path.name for path in record_files(tmp_path)]
    expected = [f"{stem}.h5", *(f"{stem}_{n}.h5" for n in range(2, 12)), "a_b_20260101T000000Z.h5"]
    assert found == expected


def test_trying_a_disk_leaves_nothing(tmp_path):
    try_out(tmp_path, 10_000)
    assert list(tmp_path.iterdir()) == []
    assert free_mib(tmp_path) > 0
    with pytest.raises(OSError):
        try_out(tmp_path / "none", 10)


def test_the_reason_is_said_without_buffers():
    text = "Unable to flush (file write failed: errno = 28, error message = 'No space left', buf"
    assert reason_of(RuntimeError(text)) == "No space left"
    assert reason_of(OSError(errno.ENOSPC, "No space left on device")) == "No space left on device"
    assert reason_of(ValueError("something else")) == "something else"
