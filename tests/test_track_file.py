"""Tracks in files: what was written comes back, and a kill loses no more than promised."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from rasnik import Flag, Track, load_system
from rasnik.analysis.flags import FLAGS
from rasnik.io import TrackWriter, read_track, to_gwpy, write_track
from rasnik.io.hdf5_repair import _lookup3, clear_write_marks
from rasnik.io.track_export import TRACK_SUFFIXES
from rasnik.tracking.track import TRACK_COLUMNS

SYSTEM = load_system("solidras")
RATE_HZ = 860.0
FLOATS = [column.name for column in TRACK_COLUMNS if column.dtype == "f8"]
HDF5_FILE = "t.h5"


@pytest.fixture
def make(rng):
    """``make(first, stop)``: a track with random bits in every number, but regular times."""

    def track(first: int = 0, stop: int = 10, **columns) -> Track:
        frame = np.arange(first, stop)
        values = {
            name: rng.normal(size=len(frame)) * 10.0 ** rng.integers(-9, 9) for name in FLOATS
        }
        values |= {"frame": frame, "time_s": frame / RATE_HZ, "flags": np.zeros(len(frame))}
        return Track(**{**values, **columns})

    return track


def assert_same(track: Track, expected: Track) -> None:
    """To the last bit, types included."""
    for name, values in expected.as_dict().items():
        found = track.as_dict()[name]
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values, err_msg=name)


# ------------------------------------------------------------------------ all formats


@pytest.mark.parametrize("suffix", TRACK_SUFFIXES)
def test_every_format_gives_back_what_was_written(tmp_path, make, suffix):
    track = make(5, 30)
    track.x_um[3] = np.nan
    track.scale[0] = 1 + 2**-52
    track.y_um[:3] = np.inf, -np.inf, 5e-324
    track.flags[3] = np.uint32(2**32 - 1)
    track.frame[-1] = 2**62
    path = tmp_path / f"t{suffix}"
    write_track(track, path)
    assert_same(read_track(path), track)
    assert_same(read_track(path, 3, 7), track[3:7])
    assert_same(read_track(path, -4), track[-4:])
    assert_same(read_track(path, stop=-20), track[:-20])
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", TRACK_SUFFIXES)
def test_a_track_without_frames(tmp_path, suffix):
    path = tmp_path / f"t{suffix}"
    write_track(Track(), path)
    assert_same(read_track(path), Track())


@pytest.mark.parametrize("suffix", [".h5", ".parquet"])
def test_metadata_go_from_file_to_file(tmp_path, make, suffix):
    track = make()
    with TrackWriter(
        tmp_path / HDF5_FILE,
        system=SYSTEM,
        metadata={"source": "camera 1", "frame_rate_hz": "860.0"},
    ) as file:
        file.write(track)
    first = read_track(tmp_path / HDF5_FILE)
    write_track(first, tmp_path / f"copy{suffix}")
    copy = read_track(tmp_path / f"copy{suffix}")
    assert copy.metadata == first.metadata
    assert copy.metadata["source"] == "camera 1"
    assert copy.metadata["frame_rate_hz"] == "860.0"
    assert copy.metadata["software"].startswith("rasnik ")
    assert copy.metadata["start_time_utc"].endswith("+00:00")
    assert copy.metadata["system_toml"] == SYSTEM.to_toml()

    other = load_system("microras")
    write_track(first, tmp_path / f"other{suffix}", system=other)
    assert read_track(tmp_path / f"other{suffix}").metadata["system_toml"] == other.to_toml()


def test_a_written_track_makes_no_start_time_up(tmp_path, make):
    write_track(make(), tmp_path / HDF5_FILE)
    assert "start_time_utc" not in read_track(tmp_path / HDF5_FILE).metadata


@pytest.mark.parametrize("suffix", TRACK_SUFFIXES)
def test_an_existing_file_is_kept(tmp_path, make, suffix):
    path = tmp_path / f"t{suffix}"
    first, second = make(), make()
    write_track(first, path)
    with pytest.raises(FileExistsError, match="overwrite=True"):
        write_track(second, path)
    assert_same(read_track(path), first)
    write_track(second, path, overwrite=True)
    assert_same(read_track(path), second)


def test_csv_is_a_plain_table_for_numpy(tmp_path, make):
    track = make()
    track.x_um[2] = np.nan
    write_track(track, tmp_path / "t.csv")
    table = np.genfromtxt(tmp_path / "t.csv", delimiter=",", names=True)
    assert table.dtype.names == tuple(column.name for column in TRACK_COLUMNS)
    np.testing.assert_array_equal(table["x_um"], track.x_um)


def test_parquet_says_what_it_holds(tmp_path, make):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_track(make(), tmp_path / "t.parquet")
    schema = parquet.read_schema(tmp_path / "t.parquet")
    assert schema.names == [column.name for column in TRACK_COLUMNS]
    assert schema.field("theta_rad").metadata[b"unit"] == b"rad"


def test_hdf5_says_what_it_holds(tmp_path, make):
    with TrackWriter(tmp_path / HDF5_FILE, system=SYSTEM) as file:
        file.write(make())
    with h5py.File(tmp_path / HDF5_FILE) as file:
        about = dict(file["track"].attrs)
        assert list(file["track"].dtype.names) == list(about["columns"])
    assert about["format"] == "rasnik track"
    assert about["format_version"] == 1
    assert list(about["units"]) == [column.unit for column in TRACK_COLUMNS]
    assert about["flag_meanings"].split() == [info.name for info in FLAGS]
    assert about["flag_masks"].tolist() == [int(info.flag) for info in FLAGS]
    assert "anticlockwise" in about["conventions"]


# ------------------------------------------------------------------------ what cannot be read


@pytest.mark.parametrize("suffix", TRACK_SUFFIXES)
def test_a_file_that_is_missing(tmp_path, suffix):
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        read_track(tmp_path / f"t{suffix}")


@pytest.mark.parametrize("suffix", TRACK_SUFFIXES)
def test_a_file_of_another_kind(tmp_path, suffix):
    path = tmp_path / f"t{suffix}"
    path.write_bytes(b"\x89 neither text nor table\n" * 9)
    with pytest.raises(ValueError, match=path.name):
        read_track(path)


@pytest.mark.parametrize("suffix", TRACK_SUFFIXES)
@pytest.mark.parametrize("left", [0.1, 0.5, 0.9])
def test_a_file_that_was_cut_off(tmp_path, make, suffix, left):
    path = tmp_path / f"t{suffix}"
    track = make(0, 20_000)
    write_track(track, path)
    os.truncate(path, round(left * path.stat().st_size))
    with pytest.raises((ValueError, OSError), match=path.name):
        read_track(path)


def test_tables_and_hdf5_files_without_a_track(tmp_path, make):
    (tmp_path / "t.csv").write_text("frame,time_s,x_um\n0,0,1\n")
    with pytest.raises(ValueError, match="columns are missing: y_um, scale"):
        read_track(tmp_path / "t.csv")
    with h5py.File(tmp_path / HDF5_FILE, "w") as file:
        file["track"] = np.zeros(3)
    with pytest.raises(ValueError, match="holds no track"):
        read_track(tmp_path / HDF5_FILE)
    with h5py.File(tmp_path / HDF5_FILE, "r+") as file:
        file["track"].attrs.update({"format": "rasnik track", "format_version": 1})
    with pytest.raises(ValueError, match="columns of the track are missing: frame, time_s"):
        read_track(tmp_path / HDF5_FILE)
    with h5py.File(tmp_path / HDF5_FILE, "w") as file:
        file["results"] = np.zeros(3)
    before = (tmp_path / HDF5_FILE).read_bytes()
    with pytest.raises(ValueError, match="holds no track"):
        TrackWriter(tmp_path / HDF5_FILE, resume=True)
    assert (tmp_path / HDF5_FILE).read_bytes() == before


def test_a_file_by_a_later_version(tmp_path, make):
    write_track(make(), tmp_path / HDF5_FILE)
    with h5py.File(tmp_path / HDF5_FILE, "r+") as file:
        file["track"].attrs["format_version"] = 2
    with pytest.raises(ValueError, match="later version"):
        read_track(tmp_path / HDF5_FILE)


def test_unknown_suffixes(tmp_path, make):
    with pytest.raises(ValueError, match=r"\.txt is not a format of tracks"):
        read_track(tmp_path / "t.txt")
    with pytest.raises(ValueError, match="no suffix is not a format of tracks"):
        write_track(make(), tmp_path / "t")
    with pytest.raises(ValueError, match=r"end the name in \.h5"):
        TrackWriter(tmp_path / "t.csv")


# ------------------------------------------------------------------------ while it is measured


def others_see(path: Path) -> list[str]:
    """Rows and last x that another program reads."""
    code = (
        "import sys; from rasnik.io import read_track; t = read_track(sys.argv[1]); "
        "print(len(t), *map(repr, t.x_um[-1:].tolist()))"
    )
    run = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return run.stdout.split()


def test_others_read_while_it_is_written(tmp_path, make):
    with TrackWriter(tmp_path / HDF5_FILE) as file:
        assert others_see(tmp_path / HDF5_FILE) == ["0"]
        for first in (0, 1500):
            block = make(first, first + 1500)
            file.write(block)
            file.flush()
            assert others_see(tmp_path / HDF5_FILE) == [
                str(first + 1500),
                repr(block.x_um[-1].item()),
            ]
            assert len(read_track(tmp_path / HDF5_FILE)) == first + 1500


def test_rows_reach_the_file_though_no_more_follow(tmp_path, make):
    with TrackWriter(tmp_path / HDF5_FILE, flush_s=0.5) as file:
        file.write(make(0, 3))
        written_s = time.monotonic()
        while len(read_track(tmp_path / HDF5_FILE)) < 3:
            assert time.monotonic() - written_s < 5
            time.sleep(0.01)
        # Half of the time is for the disk, the rest for other programs on a busy machine.
        assert time.monotonic() - written_s < 0.5


def test_no_waiting(tmp_path, make):
    with TrackWriter(tmp_path / HDF5_FILE, flush_s=0) as file:
        file.write(make(0, 3))
        assert len(read_track(tmp_path / HDF5_FILE)) == 3


def test_memory_is_bounded(tmp_path, make):
    """A flood of rows is stored by `write` itself, long before a minute is over."""
    block = make(0, 20_000)
    with TrackWriter(tmp_path / HDF5_FILE, flush_s=120) as file:
        for i in range(4):
            rows = block.as_dict() | {"frame": block.frame + len(block) * i}
            file.write(Track(**rows))
        assert file.rows == 80_000
        assert len(read_track(tmp_path / HDF5_FILE)) == 80_000
    assert np.array_equal(read_track(tmp_path / HDF5_FILE).frame, np.arange(80_000))


def test_numbers_of_frames_increase(tmp_path, make):
    with TrackWriter(tmp_path / HDF5_FILE) as file:
        assert (file.rows, file.next_frame) == (0, 0)
        file.write(make(0, 5))
        file.write(make(7, 9))
        file.write(Track())
        assert (file.rows, file.next_frame) == (7, 9)
        for frames in ([8, 9], [9, 9], [10, 9]):
            with pytest.raises(ValueError, match="begin at 9 or later"):
                file.write(make(0, 2, frame=frames))
    assert read_track(tmp_path / HDF5_FILE).frame.tolist() == [0, 1, 2, 3, 4, 7, 8]


def test_a_full_disk_is_reported_and_what_was_stored_stays(tmp_path, make, monkeypatch):
    def full(*_):
        raise OSError("No space left on device")

    file = TrackWriter(tmp_path / HDF5_FILE, flush_s=0)
    file.write(make(0, 5))
    monkeypatch.setattr("rasnik.io.track_file.append_rows", full)
    with pytest.raises(OSError, match="No space left on device.*resume=True"):
        file.write(make(5, 6))
    with pytest.raises(OSError, match="No space left"):
        file.write(make(6, 7))
    with pytest.raises(OSError, match="No space left"):
        file.close()
    file.close()
    monkeypatch.undo()
    with TrackWriter(tmp_path / HDF5_FILE, resume=True) as file:
        assert file.next_frame == 5


def test_a_closed_file_takes_nothing(tmp_path, make):
    with TrackWriter(tmp_path / HDF5_FILE) as file:
        file.write(make(0, 5))
    with pytest.raises(ValueError, match="closed"):
        file.write(make(5, 6))
    assert len(read_track(tmp_path / HDF5_FILE)) == 5


@pytest.mark.parametrize("flush_s", [-1, np.nan, np.inf])
def test_wrong_arguments(tmp_path, flush_s):
    with pytest.raises(ValueError, match="flush_s"):
        TrackWriter(tmp_path / HDF5_FILE, flush_s=flush_s)
    with pytest.raises(ValueError, match="cannot be named units"):
        TrackWriter(tmp_path / HDF5_FILE, metadata={"units": "km"})
    assert list(tmp_path.iterdir()) == []


def test_a_program_that_forgets_to_close(tmp_path):
    code = (
        "import sys; from rasnik import Track; from rasnik.io import TrackWriter\n"
        "from rasnik.analysis.pose import Pose\n"
        "TrackWriter(sys.argv[1]).write(Track.from_poses([Pose(x_um=1.5)]))"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path / HDF5_FILE], check=True)
    assert read_track(tmp_path / HDF5_FILE).x_um.tolist() == [1.5]


# ------------------------------------------------------------------------ going on


def test_a_file_is_continued(tmp_path, make):
    about = {"system": SYSTEM, "metadata": {"source": "camera 1"}}
    blocks = [make(0, 5), make(5, 2000), make(2000, 2001)]
    for block in blocks:
        with TrackWriter(tmp_path / HDF5_FILE, resume=True, **about) as file:
            assert file.next_frame == block.frame[0] == file.rows
            file.write(block)
    assert_same(read_track(tmp_path / HDF5_FILE), Track.concatenate(blocks))
    with pytest.raises(FileExistsError, match="resume=True"):
        TrackWriter(tmp_path / HDF5_FILE, **about)


@pytest.mark.parametrize(
    ("system", "source", "message"),
    [
        (
            load_system(SYSTEM, {"sensor.pixel_um": 7.4}),
            "a",
            r"sensor\.pixel_um is 6\.9 in the file, 7\.4 now\. ",
        ),
        (load_system(SYSTEM, {"mask.field_um": 90}), "b", r"mask\.field_um is 85.*; source is 'a'"),
        (SYSTEM, None, "source is 'a' in the file, nothing now"),
        (None, "a", "system is 'solidras' in the file, nothing now"),
    ],
)
def test_a_file_of_another_system_or_source_is_not(tmp_path, make, system, source, message):
    path = tmp_path / HDF5_FILE
    with TrackWriter(path, system=SYSTEM, metadata={"source": "a"}) as file:
        file.write(make())
    metadata = {"source": source} if source else {}
    with pytest.raises(ValueError, match=message):
        TrackWriter(path, system=system, metadata=metadata, resume=True)
    with TrackWriter(path, system=SYSTEM, metadata={"source": "a"}, resume=True) as file:
        assert file.next_frame == 10


def test_a_system_with_another_description_is_the_same(tmp_path):
    path = tmp_path / HDF5_FILE
    TrackWriter(path, system=SYSTEM).close()
    TrackWriter(path, system=load_system(SYSTEM, {"description": "new"}), resume=True).close()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows itself keeps a second writer out")
def test_two_programs_do_not_write_one_file(tmp_path, make):
    with TrackWriter(tmp_path / HDF5_FILE) as file:
        file.write(make())
        with pytest.raises(BlockingIOError, match="another program has this file open"):
            TrackWriter(tmp_path / HDF5_FILE, resume=True)
    TrackWriter(tmp_path / HDF5_FILE, resume=True).close()


# ------------------------------------------------------------------------ killed

needs_kill = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL")


@pytest.fixture
def kill_study():
    """The module of the study in the benchmarks."""
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "track_kill.py"
    if not path.exists():
        pytest.skip("the benchmarks are not beside the tests")
    spec = importlib.util.spec_from_file_location("track_kill", path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@needs_kill
@pytest.mark.parametrize(("flush_s", "longest_s"), [(1.0, 2.0), (0.0, 0.5)])
def test_a_kill_loses_at_most_the_last_second(tmp_path, kill_study, flush_s, longest_s):
    """The study itself checks the rows found, and those after going on."""
    kills = kill_study.study(tmp_path, 3, 4, flush_s, longest_s)
    assert kills[-1].found > 0


def test_the_study_of_kills_can_fail(make, kill_study):
    kill_study.check(kill_study.rows_of(0, 9))
    with pytest.raises(AssertionError):
        kill_study.check(kill_study.rows_of(0, 9)[np.array([0, 1, 3])])
    with pytest.raises(AssertionError):
        kill_study.check(make())


def mark_as_written(path: Path, announced: int) -> None:
    """Bring a file into a state that a kill may leave: rows announced but not written."""
    code = (
        "import h5py, os, signal, sys\n"
        "file = h5py.File(sys.argv[1], 'r+', libver='v110', locking=False)\n"
        "if len(sys.argv) == 3: file.swmr_mode = True\n"
        "file['track'].resize((int(sys.argv[2]),)); file['track'].flush()\n"
        "file.flush(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    run = subprocess.run([sys.executable, "-c", code, path, str(announced)], check=False)
    assert run.returncode == -signal.SIGKILL


@needs_kill
@pytest.mark.parametrize("written", [0, 1, 5, 1024, 3000])
def test_rows_that_were_announced_but_not_written_are_left_out(tmp_path, make, written):
    path, track = tmp_path / HDF5_FILE, make(0, written)
    write_track(track, path)
    mark_as_written(path, written + 2000)
    with pytest.raises(OSError, match="already open for write"):
        h5py.File(path, "r+")
    assert_same(read_track(path), track)
    more = make(written, written + 10)
    with TrackWriter(path, resume=True) as file:
        assert (file.rows, file.next_frame) == (written, written)
        file.write(more)
    assert_same(read_track(path), Track.concatenate([track, more]))


@needs_kill
def test_a_copy_of_a_file_that_was_killed_must_be_whole(tmp_path, make):
    """The library itself reads zeros beyond the end of such a file."""
    path, track = tmp_path / HDF5_FILE, make(0, 20_000)
    write_track(track, path)
    mark_as_written(path, 20_000)
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(OSError, match=r"t\.h5: the file is damaged or incomplete \(it ends before"):
        read_track(path)
    with pytest.raises(OSError, match="it ends before its last row"):
        TrackWriter(path, resume=True)
    assert_same(read_track(path, stop=5000), track[:5000])


@needs_kill
def test_a_kill_while_the_file_is_made_ready(tmp_path, make):
    """Such a file is open for writing, but not in SWMR mode."""
    path, track = tmp_path / HDF5_FILE, make(0, 100)
    write_track(track, path)
    code = (
        "import h5py, os, signal, sys; file = h5py.File(sys.argv[1], 'r+', libver='v110')\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, path], check=False)
    with pytest.raises(OSError, match="resume=True"):
        read_track(path)
    TrackWriter(path, resume=True).close()
    assert_same(read_track(path), track)


def test_lookup3_of_its_author():
    """The value in the comments of lookup3.c."""
    assert _lookup3(b"Four score and seven years ago") == 0x17770551


def test_marks_are_taken_away_only_where_they_are_understood(tmp_path, make):
    path = tmp_path / HDF5_FILE
    write_track(make(), path)
    whole = path.read_bytes()
    assert not clear_write_marks(path)
    assert path.read_bytes() == whole
    for content, message in [
        (whole[:20], "not a complete HDF5 file"),
        (b"x" + whole[1:], "not an HDF5 file that can be appended to"),
        (whole[:30] + b"\xff" + whole[31:], "damaged"),
    ]:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            clear_write_marks(path)
        assert path.read_bytes() == content


# ------------------------------------------------------------------------ time series


@pytest.fixture(scope="module")
def gwpy():
    """gwpy, or skip; it and astropy warn of themselves when they are loaded."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip("gwpy.timeseries", reason="the extra gw is not installed")


def test_a_regular_track_as_a_time_series(make, gwpy):
    track = make(100, 1000)
    series = to_gwpy(track)
    assert isinstance(series, gwpy.TimeSeries)
    np.testing.assert_array_equal(series.value, track.x_um)
    assert series.unit == "um"
    assert series.name == "x_um"
    assert series.sample_rate.value == RATE_HZ
    assert series.t0.value == 100 / RATE_HZ
    np.testing.assert_allclose(series.times.value, track.time_s, rtol=0, atol=1e-9)
    assert to_gwpy(track, "theta_rad").unit == "rad"
    assert to_gwpy(track, "scale").unit == ""
    assert to_gwpy(track, "light_level").unit == "adu"


def test_missing_and_failed_frames_are_nan(make, gwpy):
    track = make(0, 100)
    track.flags[50] = Flag.NO_MASK
    track.flags[60] = Flag.REFITTED
    track.x_um[70] = np.nan
    keep = np.ones(100, dtype=bool)
    keep[[10, 11, 12, 80]] = False
    series = to_gwpy(track[keep])
    expected = track.x_um.copy()
    expected[[10, 11, 12, 50, 70, 80]] = np.nan
    np.testing.assert_array_equal(series.value, expected)
    # The same if the source counts the frames that arrive.
    renumbered = track[keep].as_dict() | {"frame": np.arange(96)}
    np.testing.assert_array_equal(to_gwpy(Track(**renumbered)).value, expected)


def test_a_frame_without_a_time_is_missing_if_it_has_no_position(make, gwpy):
    track = make(0, 20)
    track.time_s[5] = track.x_um[5] = np.nan
    expected = track.x_um.copy()
    np.testing.assert_array_equal(to_gwpy(track).value, expected)
    track.time_s[6] = np.nan
    with pytest.raises(ValueError, match="needs the time of every frame"):
        to_gwpy(track)


def test_times_with_some_jitter(make, gwpy, rng):
    track = make(0, 5000)
    time_s = 1.4e9 + (track.frame + rng.uniform(-0.04, 0.04, 5000)) / RATE_HZ
    series = to_gwpy(make(0, 5000, time_s=time_s))
    assert len(series) == 5000
    assert series.sample_rate.value == pytest.approx(RATE_HZ, rel=1e-6)
    with pytest.raises(ValueError, match=r"0\.04.* tolerance of 0\.01"):
        to_gwpy(make(0, 5000, time_s=time_s), tolerance=0.01)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, 1, 2, 3.4, 4.4, 5.4], "away from its place"),
        ([0, 1, 2, 2.2, 3.2, 4.2], "less than half"),
        ([0, 1, 2, 2, 3, 4], "go back or stand still"),
        ([0, 1, 2, 1, 3, 4], "go back or stand still"),
        ([np.nan] * 6, "needs the time of every frame"),
    ],
)
def test_irregular_times_are_refused(make, times, message):
    with pytest.raises(ValueError, match=message):
        to_gwpy(make(0, 6, time_s=times))


def test_columns_that_are_no_series(make):
    for column in ("flags", "frame", "time_s", "x_nm"):
        with pytest.raises(ValueError, match="is not one of the columns x_um, y_um"):
            to_gwpy(make(), column)


def test_gwpy_missing_names_the_extra(make, monkeypatch):
    monkeypatch.setitem(sys.modules, "gwpy", None)
    monkeypatch.setitem(sys.modules, "gwpy.timeseries", None)
    with pytest.raises(ImportError, match=r'pip install "rasnik\[gw\]"'):
        to_gwpy(make())


# ------------------------------------------------------------------------ light, and described


def test_every_column_is_described():
    page = Path(__file__).resolve().parents[1] / "docs" / "track-files.md"
    if not page.exists():
        pytest.skip("the pages are not beside the tests")
    lines = page.read_text(encoding="utf-8").splitlines()
    for column in TRACK_COLUMNS:
        assert f"| `{column.name}` | {column.unit} | {column.description} |" in lines


def test_the_names_are_loaded_when_they_are_used():
    code = (
        "import sys, rasnik.io; assert 'h5py' not in sys.modules\n"
        "assert 'read_track' in dir(rasnik.io)\n"
        "from rasnik.io import read_track, TrackWriter; assert 'h5py' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(ImportError, match="read_trak"):
        from rasnik.io import read_trak  # noqa: F401
