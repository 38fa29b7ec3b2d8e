"""``rasnik track`` and ``rasnik export``, run as a user does."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from PIL import Image

from rasnik import Flag, Track, Tracker, simulate
from rasnik.cli.track_summary import Summary
from rasnik.io import TrackWriter, read_track
from rasnik.io.images import Frame
from rasnik.io.read_ahead import read_ahead
from rasnik.report.track import envelope, plot_track, track_figure
from test_cli import INSTRUMENT, SYSTEM, rasnik, refused

COUNT = 10
# A drift of 0.3 um from frame to frame.
POSES = [(20000.0 + 0.3 * k, 15000.0 - 0.1 * k, 0.001) for k in range(COUNT)]


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.stack([frame for frame, _ in simulate(SYSTEM, POSES, seed=5)])


@pytest.fixture(scope="module")
def reference(images) -> Track:
    """The track that Python gives."""
    return Tracker(SYSTEM).run(images)


def write_folder(path: Path, images: np.ndarray) -> Path:
    path.mkdir()
    for k, image in enumerate(images):
        Image.fromarray(image).save(path / f"f{k}.png")
    return path


def write_tiff(path: Path, images: np.ndarray) -> Path:
    with tifffile.TiffWriter(path) as writer:
        for image in images:
            writer.write(image, photometric="minisblack", metadata=None)
    return path


def write_hdf5(path: Path, images: np.ndarray) -> Path:
    with h5py.File(path, "w") as file:
        file["frames"] = images
    return path


def write_video(path: Path, images: np.ndarray) -> Path:
    av = pytest.importorskip("av", reason="PyAV is missing: pip install 'rasnik[video]'")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.height, stream.width = images.shape[1:]
        stream.pix_fmt = "gray"
        for image in images:
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="gray")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def same_positions(track: Track, reference: Track) -> None:
    """Equal but for where a fit began: a part of the noise, of which frames are 300 apart."""
    np.testing.assert_array_equal(track.frame, reference.frame)
    for column in ("x_um", "y_um", "scale", "theta_rad"):
        sigma = getattr(reference, f"sigma_{column}")
        np.testing.assert_array_less(
            np.abs(getattr(track, column) - getattr(reference, column)), 0.25 * sigma
        )


# ------------------------------------------------------------------------ sources


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("folder", write_folder),
        ("pages.tif", write_tiff),
        ("stack.h5", write_hdf5),
        ("run.mkv", write_video),
    ],
)
def test_a_track_from_every_kind_of_source(tmp_path, images, reference, name, write):
    source, path = write(tmp_path / name, images), tmp_path / "track.h5"
    result = rasnik("track", source, *INSTRUMENT, "-o", path)
    assert result.exit_code == 0
    track = read_track(path)
    same_positions(track, reference)
    np.testing.assert_allclose(track.x_um, [x for x, *_ in POSES], atol=0.01)
    np.testing.assert_allclose(track.time_s, np.arange(COUNT) / SYSTEM.sensor.frame_rate_hz)
    assert track.metadata["source"] == str(source)
    assert str(path) in result.stderr


def test_several_sources_are_one_sequence(tmp_path, images, reference):
    first = write_folder(tmp_path / "a", images[:4])
    last = write_tiff(tmp_path / "b.tif", images[4:])
    rasnik("track", first, last, *INSTRUMENT, "-o", tmp_path / "track.h5")
    same_positions(read_track(tmp_path / "track.h5"), reference)


def test_the_summary(tmp_path, images, reference):
    source = write_hdf5(tmp_path / "s.h5", images)
    result = rasnik("track", source, *INSTRUMENT)
    assert result.exit_code == 0
    words = " ".join(result.stdout.split())
    assert "frames 10 tracked" in words
    assert "cold starts 1" in words
    assert "failed 0" in words
    assert f"x {reference.x_um.mean():.4f} {1e3 * reference.x_um.std():.4g}"[:-1] in words
    assert result.stderr == ""
    assert [p.name for p in tmp_path.iterdir()] == ["s.h5"]  # nothing is stored unasked


def test_the_summary_as_json(tmp_path, images, reference):
    source = write_hdf5(tmp_path / "s.h5", images)
    result = rasnik("track", source, *INSTRUMENT, "--json")
    summary = json.loads(result.stdout)
    assert summary["frames"] == COUNT
    assert summary["tracked"] + summary["refitted"] == COUNT - 1
    assert summary["cold_starts"] == 1
    assert summary["failed"] == 0
    assert summary["frames_per_s"] > 0
    x = summary["x"]
    assert x["mean_um"] == pytest.approx(reference.x_um.mean(), abs=1e-4)
    assert x["rms_nm"] == pytest.approx(1e3 * reference.x_um.std(), rel=1e-3)
    assert x["peak_to_peak_nm"] == pytest.approx(2700, abs=10)
    assert x["mean_sigma_nm"] == pytest.approx(1e3 * reference.sigma_x_um.mean(), rel=0.05)


# ------------------------------------------------------------------------ bad frames


def test_bad_frames_are_rows_and_the_others_come_out(tmp_path, images, reference):
    folder, path = write_folder(tmp_path / "frames", images), tmp_path / "track.h5"
    (folder / "f4.png").write_bytes(b"\x89PNG no more")
    Image.fromarray(images[6][:100]).save(folder / "f6.png")
    Image.fromarray(np.full_like(images[8], 90)).save(folder / "f8.png")
    result = rasnik("track", folder, *INSTRUMENT, "-o", path)
    assert result.exit_code == 1
    track = read_track(path)
    bad = np.isin(np.arange(COUNT), (4, 6, 8))
    np.testing.assert_array_equal(track.ok, ~bad)
    assert np.isnan(track.x_um[bad]).all()
    assert track.flags[4] & Flag.NO_IMAGE
    assert track.flags[6] & Flag.NO_IMAGE
    np.testing.assert_allclose(track.x_um[~bad], reference.x_um[~bad], atol=1e-3)
    errors = " ".join(result.stderr.split())
    assert f"frame 4: {folder}/f4.png: " in errors
    assert f"frame 6: {folder}/f6.png: the image has 320 x 100 pixels, the system 320 x 240" in (
        errors
    )
    assert f"frame 8: {folder}/f8.png: " in errors
    words = " ".join(result.stdout.split())
    assert "failed 3 no_image 2" in words


def test_a_fault_in_one_frame_leaves_the_others(tmp_path, images, monkeypatch):
    source = write_hdf5(tmp_path / "s.h5", images)
    honest = Tracker.blocks

    def broken(self, frames, *arguments, **options):
        frames = list(frames)
        if any(frame is not None and np.array_equal(frame, images[5]) for frame in frames):
            raise ZeroDivisionError("a fault of ours")
        return honest(self, frames, *arguments, **options)

    monkeypatch.setattr(Tracker, "blocks", broken)
    result = rasnik("track", source, *INSTRUMENT, "--json")
    summary = json.loads(result.stdout)
    assert (summary["frames"], summary["failed"]) == (COUNT, 1)
    (failure,) = summary["failures"]
    assert failure["frame"] == 5
    assert "unexpected ZeroDivisionError" in failure["reason"]
    assert "s.h5[5]" in failure["reason"]


# ------------------------------------------------------------------------ times


def test_times_from_a_rate_a_file_or_none(tmp_path, images):
    source, path = write_hdf5(tmp_path / "s.h5", images), tmp_path / "track.h5"
    rasnik("track", source, *INSTRUMENT, "-o", path, "--frame-rate", "50")
    np.testing.assert_allclose(read_track(path).time_s, np.arange(COUNT) / 50)
    assert float(read_track(path).metadata["frame_rate_hz"]) == 50
    times = np.arange(COUNT) ** 2 / 7 + 1e9
    np.savetxt(tmp_path / "times.txt", times, fmt="%.17g")
    command = ("track", source, *INSTRUMENT, "-o", path, "--overwrite")
    rasnik(*command, "--times", tmp_path / "times.txt")
    np.testing.assert_array_equal(read_track(path).time_s, times)
    rasnik(*command, "--set", "sensor.frame_rate_hz=none")
    assert np.isnan(read_track(path).time_s).all()
    np.savetxt(tmp_path / "few.txt", times[:7])
    result = rasnik(*command, "--times", tmp_path / "few.txt")
    assert "7 times for 10 frames" in result.stderr
    assert np.isnan(read_track(path).time_s).sum() == 3


# ------------------------------------------------------------------------ resuming

# The command, with a camera that stops to deliver after 7 frames.
STALLED = """
import itertools, sys, time
import rasnik.cli.track_run as run
from rasnik.cli import app

def stalled(sources, start=0, honest=run.iter_frames):
    yield from itertools.islice(honest(sources, start), 7)
    time.sleep(600)

run.iter_frames = stalled
app(sys.argv[1:])
"""


def start_stalled(source: Path, path: Path) -> subprocess.Popen:
    """Start the command and wait until rows are in the file."""
    arguments = ["track", str(source), *INSTRUMENT, "-o", str(path)]
    process = subprocess.Popen(
        [sys.executable, "-c", STALLED, *arguments], stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 120
    while not (path.exists() and len(read_track(path)) >= 3):
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return process


def test_the_same_command_continues_after_a_kill(tmp_path, images, reference):
    source, path = write_hdf5(tmp_path / "s.h5", images), tmp_path / "track.h5"
    process = start_stalled(source, path)
    process.kill()
    process.communicate()
    kept = len(read_track(path))
    assert 3 <= kept <= 7
    command = ("track", source, *INSTRUMENT, "-o", path)
    result = rasnik(*command)
    assert result.exit_code == 0
    assert f"is continued at frame {kept}" in result.stderr
    track = read_track(path)
    same_positions(track, reference)
    assert np.flatnonzero(track.flags & Flag.COLD_START).tolist() == [0, kept]
    assert "frames 10" in " ".join(result.stdout.split())  # those before the kill are counted
    again = rasnik(*command)
    assert again.exit_code == 0
    assert "nothing to do" in again.stderr
    assert len(read_track(path)) == COUNT


@pytest.mark.skipif(os.name != "posix", reason="sends a signal")
def test_ctrl_c_closes_the_file_and_says_how_to_go_on(tmp_path, images, reference):
    source, path = write_hdf5(tmp_path / "s.h5", images), tmp_path / "track.h5"
    process = start_stalled(source, path)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert f"the same command continues {path}" in " ".join(errors.split())
    with h5py.File(path, "r") as file:  # closed properly: opens without SWMR
        assert 3 <= len(file["track"]) <= 7
    rasnik("track", source, *INSTRUMENT, "-o", path)
    same_positions(read_track(path), reference)


def test_frames_that_came_later_are_added(tmp_path, images, reference):
    folder, path = write_folder(tmp_path / "frames", images[:6]), tmp_path / "track.h5"
    rasnik("track", folder, *INSTRUMENT, "-o", path)
    for k in range(6, COUNT):
        Image.fromarray(images[k]).save(folder / f"f{k}.png")
    rasnik("track", folder, *INSTRUMENT, "-o", path)
    same_positions(read_track(path), reference)


def test_another_sequence_is_not_appended(tmp_path, images):
    source, path = write_hdf5(tmp_path / "s.h5", images[:3]), tmp_path / "track.h5"
    other = write_hdf5(tmp_path / "other.h5", images)
    command = ("track", source, *INSTRUMENT, "-o", path)
    rasnik(*command)
    message = refused("track", other, *INSTRUMENT, "-o", path)
    assert "cannot be continued" in message
    assert "other.h5" in message
    assert "--overwrite" in refused(*command, "--frame-rate", "50")
    assert "--overwrite" in refused(*command, "--model", "affine")
    assert "optics.scale" in refused(*command, "--set", "optics.scale=1.02")
    assert len(read_track(path)) == 3
    rasnik("track", other, *INSTRUMENT, "-o", path, "--overwrite")
    assert len(read_track(path)) == COUNT


def test_a_track_that_is_being_written_is_left_alone(tmp_path, images):
    source, path = write_hdf5(tmp_path / "s.h5", images[:2]), tmp_path / "track.h5"
    rasnik("track", source, *INSTRUMENT, "-o", path)
    with TrackWriter(path, system=SYSTEM, metadata={"source": str(source)}, resume=True):
        assert "another program" in refused("track", source, *INSTRUMENT, "-o", path)
        message = refused("track", source, *INSTRUMENT, "-o", path, "--overwrite")
        assert "another program" in message
    assert len(read_track(path)) == 2


# ------------------------------------------------------------------------ refusals


def test_wrong_usage_is_refused_in_one_sentence(tmp_path, images):
    source = write_hdf5(tmp_path / "s.h5", images[:2])
    command = ("track", source, *INSTRUMENT)
    assert "rasnik export" in refused(*command, "-o", tmp_path / "t.csv")
    assert "there is no folder" in refused(*command, "-o", tmp_path / "no" / "t.h5")
    assert "is one of the images" in refused(*command, "-o", source, "--overwrite")
    other = write_hdf5(tmp_path / "other.h5", images[:1])
    assert "holds no track" in refused(*command, "-o", other, "--overwrite")
    assert other.exists()
    assert "exclude" in refused(*command, "--frame-rate", "5", "--times", "t.txt")
    assert "--frame-rate" in refused(*command, "--frame-rate", "-5")
    assert "cannot be read" in refused(*command, "--times", tmp_path / "none.txt")
    (tmp_path / "words.txt").write_text("one\ntwo\n")
    assert "one time in s" in refused(*command, "--times", tmp_path / "words.txt")
    assert ".png, .pdf or .svg" in refused(*command, "--plot", tmp_path / "t.gif")
    assert "there are no images" in refused("track", tmp_path / "none*.png", *INSTRUMENT)
    missing = refused("track", tmp_path / "none.png", *INSTRUMENT, "-o", tmp_path / "t.h5")
    assert "no such file" in missing
    assert not (tmp_path / "t.h5").exists()


def test_without_the_video_extra_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "v.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    assert 'pip install "rasnik[video]"' in refused("track", tmp_path / "v.mp4", *INSTRUMENT)


# ------------------------------------------------------------------------ export


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".h5"])
def test_export(tmp_path, images, reference, suffix):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    path, target = tmp_path / "track.h5", tmp_path / f"copy{suffix}"
    with TrackWriter(path, system=SYSTEM) as writer:
        writer.write(reference)
    result = rasnik("export", path, "-o", target)
    assert result.exit_code == 0
    assert "10 frames written" in result.stderr
    np.testing.assert_array_equal(read_track(target).x_um, reference.x_um)
    assert "--overwrite" in refused("export", path, "-o", target)
    assert rasnik("export", path, "-o", target, "--overwrite").exit_code == 0
    assert "is the track itself" in refused("export", path, "-o", path, "--overwrite")
    assert "is not a format of tracks" in refused("export", path, "-o", tmp_path / "t.txt")
    assert "no such file" in refused("export", tmp_path / "none.h5", "-o", tmp_path / "t.csv")


# ------------------------------------------------------------------------ summary, read-ahead


def random_track(rng: np.random.Generator, n: int) -> Track:
    columns = {
        name: rng.normal(1000, 1, n)
        for name in ("x_um", "y_um", "scale", "theta_rad", "sigma_x_um", "sigma_y_um")
    }
    lost = rng.random(n) < 0.1
    for values in columns.values():
        values[lost] = np.nan
    rest = {name: np.ones(n) for name in ("sigma_scale", "sigma_theta_rad", "chi2_ndf", "blur_um")}
    return Track(
        frame=np.arange(n), time_s=np.arange(n) / 100, **columns, **rest,
        dark_level=np.ones(n), light_level=np.ones(n),
        flags=np.where(lost, int(Flag.BLANK), 0) | np.where(rng.random(n) < 0.1, Flag.REFITTED, 0),
    )  # fmt: skip


def test_a_summary_of_blocks_is_that_of_the_whole(rng):
    track, pieces = random_track(rng, 5000), Summary()
    for first in (0, 1, 10, 1700):
        pieces.add(track[first : {0: 1, 1: 10, 10: 1700, 1700: 5000}[first]])
    found, ok = pieces.as_dict(), track.ok
    assert found["frames"] == 5000
    assert found["failed_by_flag"] == {"blank": int((~ok).sum())}
    assert found["refitted"] == int((ok & (track.flags & Flag.REFITTED != 0)).sum())
    for axis in "xy":
        values = getattr(track, f"{axis}_um")[ok]
        assert found[axis]["mean_um"] == pytest.approx(values.mean(), rel=1e-13)
        assert found[axis]["rms_nm"] == pytest.approx(1e3 * values.std(), rel=1e-9)
        assert found[axis]["peak_to_peak_nm"] == pytest.approx(1e3 * np.ptp(values), rel=1e-12)
    assert len(found["failures"]) == 5


def test_reading_ahead_keeps_order_and_memory(rng):
    read: list[int] = []

    def source():
        for k in range(200):
            read.append(k)
            yield Frame("f", k, np.full((10, 100), k % 256, dtype=np.uint8))

    stream = read_ahead(source(), most_bytes=5000)
    seen = []
    for frame in stream:
        seen.append(frame.frame)
        time.sleep(0.001)
        assert len(read) - len(seen) <= 5 + 1  # those that wait, and one in the hand
    assert seen == list(range(200))


def test_reading_ahead_passes_on_errors_and_ends(rng):
    def source():
        yield Frame("f", 0, np.zeros((2, 2)))
        raise OSError("the disk is gone")

    stream = read_ahead(source())
    assert next(stream).frame == 0
    with pytest.raises(OSError, match="the disk is gone"):
        next(stream)
    endless = read_ahead((Frame("f", k, np.zeros((9, 9))) for k in range(10**9)), 1000)
    next(endless)
    endless.close()
    assert "read ahead" not in [thread.name for thread in threading.enumerate()]


# ------------------------------------------------------------------------ plot


def test_plot_of_a_run(tmp_path, images):
    source, picture = write_hdf5(tmp_path / "s.h5", images), tmp_path / "track.png"
    result = rasnik("track", source, *INSTRUMENT, "--plot", picture)
    assert f"plot in {picture}" in " ".join(result.stderr.split())
    with Image.open(picture) as image:
        assert image.size[0] > 900


def test_curves_show_the_track_in_its_units(rng):
    track = random_track(rng, 500)
    figure = track_figure(track, title="bench")
    curves = figure.axes[:4]
    x = curves[0].lines[0].get_ydata()
    ok = track.ok
    assert curves[0].get_ylabel().endswith("µm")
    np.testing.assert_array_equal(np.isnan(x), ~ok)
    np.testing.assert_allclose(np.diff(x[ok]), np.diff(track.x_um[ok]), atol=1e-9)
    assert figure.axes[-1].get_xlabel() == "time, s"
    names = [text.get_text() for text in figure.axes[-1].get_yticklabels()]
    assert names[0] == f"no position ({int((~ok).sum())})"
    assert names[1].startswith("refitted")
    assert "500 frames" in curves[0].get_title()
    assert "bench" in curves[0].get_title()


def test_missing_frames_and_times(rng):
    track = random_track(rng, 300)
    columns = track.as_dict() | {"time_s": np.full(300, np.nan)}
    part = Track(**columns)[np.r_[0:100, 150:300]]
    figure = track_figure(part)
    assert figure.axes[-1].get_xlabel() == "number of the frame"
    line = figure.axes[0].lines[0]
    before = np.searchsorted(line.get_xdata(), 99.5)
    assert np.isnan(line.get_ydata()[before])  # no line across the frames that are missing


def test_no_spike_is_lost_in_a_long_track(rng, tmp_path):
    n = 300_000
    along, values = np.arange(n) / 7.0, rng.normal(size=n)
    values[123_456], values[200_001] = 40.0, -30.0
    values[50_000:60_000] = np.nan
    drawn, curve = envelope(along, values, 1000)
    assert len(drawn) <= 2000
    assert (np.diff(drawn) > 0).all()
    assert curve[drawn == along[123_456]] == 40.0
    assert curve[drawn == along[200_001]] == -30.0
    inside = (drawn > along[50_400]) & (drawn < along[59_600])
    assert inside.any()
    assert np.isnan(curve[inside]).all()
    column = np.minimum((np.arange(n) * 1000) // n, 999)
    for k in (0, 411, 999):
        part = values[column == k]
        shown = curve[(drawn >= along[column == k][0]) & (drawn <= along[column == k][-1])]
        assert np.nanmax(shown) == pytest.approx(np.nanmax(part), abs=0.5)


def test_plots_of_next_to_nothing(tmp_path):
    with pytest.raises(ValueError, match="empty"):
        plot_track(Track(), tmp_path / "t.png")
    failed = Track.from_poses([])
    assert len(failed) == 0
    blind = Tracker(SYSTEM).run([None, None])
    plot_track(blind, tmp_path / "blind.png")
    plot_track(blind[:1], tmp_path / "one.png")
    assert (tmp_path / "one.png").exists()
