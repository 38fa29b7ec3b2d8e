"""One chunk: a row for every image, the same as analysing it alone, whatever is wrong with it."""

import io
import math
import os

import numpy as np
import pytest
from pyarrow import parquet

import rasnik.archive.work as work_module
from _archive import FRAMES, NOON_S, POSES, SETTINGS, SMALL, item, save, save_folder
from rasnik import Flag, analyse, simulate
from rasnik.archive.done import DoneFrames
from rasnik.archive.plan import Chunk, Planner, Span
from rasnik.archive.sources import find_items
from rasnik.archive.systems_table import InstrumentSettings
from rasnik.archive.work import Poses, Work, WorkerError, analyse_chunk, lost_image
from rasnik.io.analysed import AnalysisOptions, analysed
from rasnik.io.columns import COLUMNS, make_record
from rasnik.io.folders import natural_key
from rasnik.io.images import Frame, iter_frames


def work_of(folder, settings=SETTINGS, **options) -> Work:
    planner = Planner(lambda name: settings, DoneFrames())
    (chunk,) = planner.chunks(find_items([str(folder)]))
    return Work(chunk, settings, **options)


def rows_of(result) -> list[dict]:
    """In the order of the images."""
    found = [
        row | {"day": part.day}
        for part in result.parts
        for row in parquet.read_table(io.BytesIO(part.data)).to_pylist()
    ]
    return sorted(found, key=lambda row: (natural_key(row["file"]), row["frame"]))


# ------------------------------------------------------------------------ rows


def test_without_tracking_rows_are_those_of_rasnik_analyse(tmp_path):
    save_folder(tmp_path / "a", 3)
    save(tmp_path / "a" / "zblank.png", np.full(SMALL.shape, 30, np.uint8))
    result = analyse_chunk(work_of(tmp_path, track=False))
    found = rows_of(result)
    assert (result.good, result.failed, result.found) == (3, 1, (1, 1, 1, 1))
    options = AnalysisOptions(SMALL)
    for row, frame in zip(found, iter_frames([tmp_path / "a"]), strict=True):
        pose, _ = analysed(frame, options)
        record = make_record(frame.file, frame.frame, pose)
        for column in COLUMNS:
            expected = record.get(column.name)
            if column.kind == "float" and expected is not None:
                assert row[column.name] == pytest.approx(expected, rel=1e-9)
            elif column.name != "notes":
                assert row[column.name] == expected


def test_tracking_gives_the_same_positions_within_their_errors(tmp_path):
    save_folder(tmp_path / "a", 12)
    found = rows_of(analyse_chunk(work_of(tmp_path)))
    # Tracked and not: only the first frame began from nothing.
    assert [("cold_start" in row["flags"]) for row in found] == [True] + [False] * 11
    for row, (x, y, _) in zip(found, POSES, strict=True):
        assert abs(row["x_um"] - x) < 5 * row["sigma_x_um"]
        assert abs(row["y_um"] - y) < 5 * row["sigma_y_um"]
        alone = analyse(FRAMES[int(row["file"].split("image")[1][:-4])], SMALL)
        assert row["x_um"] == pytest.approx(alone.x_um, abs=row["sigma_x_um"])
        assert row["sigma_x_um"] == pytest.approx(alone.sigma_x_um, rel=0.05)


def test_jumping_images_are_found_and_tracking_is_left_alone_after_a_while(rng):
    poses = [(*rng.uniform(3000, 9000, 2), 0.0) for _ in range(14)]
    frames = [frame for frame, _ in simulate(SMALL, poses, seed=3)]
    calls = []
    followed = Poses(SETTINGS)
    tracker_for = followed._tracker_for
    followed._tracker_for = lambda frame: calls.append(frame.frame) or tracker_for(frame)
    for k, frame in enumerate(frames):
        pose, error = followed.of(Frame("f", k, frame))
        alone = analyse(frame, SMALL)
        assert (error is None) == alone.ok
        if alone.ok:
            assert pose.x_um == pytest.approx(alone.x_um, abs=2 * alone.sigma_x_um)
    assert calls == [0, 1, 2, 3, 4, 9, 10]


def test_tracking_begins_again_after_images_without_a_mask():
    blank = np.full(SMALL.shape, 30, np.uint8)
    followed = Poses(SETTINGS)
    found = [followed.of(Frame("f", k, image))[0] for k, image in enumerate(
        [FRAMES[0], FRAMES[1], blank, FRAMES[2], FRAMES[3]]
    )]  # fmt: skip
    assert [pose.ok for pose in found] == [True, True, False, True, True]
    assert found[2].flags & Flag.BLANK
    assert not found[4].flags & Flag.COLD_START


@pytest.mark.parametrize("level", [0, 30, 255])
def test_an_image_without_any_contrast_has_no_position(level):
    """Whatever was seen before it."""
    blank = np.full(SMALL.shape, level, np.uint8)
    for frame in FRAMES[:6]:
        followed = Poses(SETTINGS)
        found = [followed.of(Frame("f", k, image))[0] for k, image in enumerate([frame, blank])]
        assert [pose.ok for pose in found] == [True, False]


def test_damaged_files_are_rows_with_their_sentence(tmp_path):
    save_folder(tmp_path / "a", 2)
    (tmp_path / "a" / "image0.png").write_bytes(b"\x89PNG nothing")
    (tmp_path / "a" / "image2.png").write_bytes(b"")
    save(tmp_path / "a" / "image3.png", FRAMES[0][:100])
    found = rows_of(analyse_chunk(work_of(tmp_path)))
    assert [row["ok"] for row in found] == [False, True, False, False]
    assert "image0.png" in found[0]["error"]
    assert "the file is empty" in found[2]["error"]
    assert "200 x 100 pixels" in found[3]["error"]


def test_what_nobody_expected_is_a_row(tmp_path, monkeypatch):
    save_folder(tmp_path / "a", 3)

    def broken(image, *arguments, **options):
        if np.array_equal(image, FRAMES[1]):
            raise ZeroDivisionError("a fault")
        return analyse(image, *arguments, **options)

    monkeypatch.setattr("rasnik.analysis.analyse.analyse", broken)
    found = rows_of(analyse_chunk(work_of(tmp_path, track=False)))
    assert [row["ok"] for row in found] == [True, False, True]
    assert "unexpected ZeroDivisionError (a fault)" in found[1]["error"]


def test_a_tracker_that_fails_is_replaced(tmp_path, monkeypatch):
    save_folder(tmp_path / "a", 4)
    update, calls = work_module.Poses._tracker_for, []

    def broken(self, frame):
        calls.append(frame.frame)
        if len(calls) == 2:
            raise ZeroDivisionError("a fault")
        return update(self, frame)

    monkeypatch.setattr(work_module.Poses, "_tracker_for", broken)
    found = rows_of(analyse_chunk(work_of(tmp_path)))
    assert [row["ok"] for row in found] == [True] * 4
    assert len(calls) == 4


def test_a_library_that_fails_in_the_middle_of_a_file_is_a_row(tmp_path, monkeypatch):
    def broken(item, start):
        yield Frame(item.name, 0, FRAMES[0])
        raise RuntimeError("connection lost")

    monkeypatch.setattr(work_module, "frames_of", broken)
    chunk = Chunk("a", (Span(item(str(tmp_path / "s.tif"))),))
    result = analyse_chunk(Work(chunk, SETTINGS))
    found = rows_of(result)
    assert result.found == (2,)
    assert [(row["frame"], row["ok"]) for row in found] == [(0, True), (1, False)]
    assert "unexpected RuntimeError (connection lost)" in found[1]["error"]


def test_frames_that_were_counted_but_are_gone_are_told(tmp_path):
    np.save(tmp_path / "s.npy", FRAMES[:3])
    (whole,) = find_items([str(tmp_path)])
    chunk = Chunk("a", (Span(whole, 0, 2, 2), Span(whole, 5, None, 4)))
    result = analyse_chunk(Work(chunk, SETTINGS))
    found = rows_of(result)
    assert [(row["frame"], row["ok"]) for row in found] == [(0, True), (1, True), (5, False)]
    assert "none of them can be read" in found[2]["error"]


def test_a_span_takes_its_own_frames_only(tmp_path):
    np.save(tmp_path / "s.npy", FRAMES[:6])
    (whole,) = find_items([str(tmp_path)])
    result = analyse_chunk(Work(Chunk("a", (Span(whole, 2, 4, 2),)), SETTINGS))
    assert [row["frame"] for row in rows_of(result)] == [2, 3]
    result = analyse_chunk(Work(Chunk("a", (Span(whole, 4),)), SETTINGS))
    assert [row["frame"] for row in rows_of(result)] == [4, 5]


# ------------------------------------------------------------------------ days and times


def test_rows_go_to_the_day_of_their_time(tmp_path):
    for k, hours in enumerate((0, 11.9, 12.1, 36.1)):
        save(tmp_path / "a" / f"image{k}.png", FRAMES[k], NOON_S + 3600 * hours)
    result = analyse_chunk(work_of(tmp_path))
    assert [part.rows for part in result.parts] == [2, 1, 1]
    days = [np.datetime64(part.day) for part in result.parts]
    assert np.diff(days).tolist() == [np.timedelta64(1, "D")] * 2
    found = rows_of(result)
    assert [row["time_source"] for row in found] == ["modified"] * 4
    assert found[1]["time_s"] == NOON_S + 3600 * 11.9


def test_frames_of_a_file_follow_at_the_instruments_rate(tmp_path):
    np.save(tmp_path / "s.npy", FRAMES[:3])
    os.utime(tmp_path / "s.npy", (NOON_S, NOON_S))
    settings = InstrumentSettings(SMALL, frame_rate_hz=4.0)
    found = rows_of(analyse_chunk(work_of(tmp_path, settings)))
    assert [row["time_s"] - NOON_S for row in found] == [0, 0.25, 0.5]


def test_without_a_time_the_day_is_unknown(tmp_path):
    path = save(tmp_path / "a.png", FRAMES[0])
    chunk = Chunk("a", (Span(item(str(path), modified_s=math.nan)),))
    (part,) = analyse_chunk(Work(chunk, SETTINGS)).parts
    assert part.day == "unknown"
    (row,) = parquet.read_table(io.BytesIO(part.data)).to_pylist()
    assert (row["time_s"], row["time_source"]) == (None, None)


def test_parts_say_what_system_they_are_from(tmp_path):
    save_folder(tmp_path / "a", 1)
    (part,) = analyse_chunk(work_of(tmp_path)).parts
    file = parquet.ParquetFile(io.BytesIO(part.data))
    assert file.schema_arrow.metadata[b"system_toml"].decode() == SMALL.to_toml()
    assert file.metadata.row_group(0).column(0).compression == "ZSTD"


# ------------------------------------------------------------------------ workers


def test_a_worker_of_another_version_refuses(tmp_path):
    save_folder(tmp_path / "a", 1)
    with pytest.raises(WorkerError, match="and this is 0.0.1; install the same"):
        analyse_chunk(work_of(tmp_path, software="0.0.1"))


def test_a_worker_that_does_not_see_the_images_refuses(tmp_path):
    chunk = Chunk("a", (Span(item(str(tmp_path / "not there" / "a.png"))),))
    with pytest.raises(WorkerError, match="does not see the folder"):
        analyse_chunk(Work(chunk, SETTINGS))


def test_a_lost_image_has_a_row_without_being_opened():
    chunk = Chunk("a", (Span(item("/not/there.tif", modified_s=NOON_S), 7, 8),))
    result = lost_image(Work(chunk, SETTINGS))
    assert (result.good, result.failed, result.found) == (0, 1, (1,))
    (row,) = rows_of(result)
    assert (row["file"], row["frame"], row["ok"]) == ("/not/there.tif", 7, False)
    assert row["error"].startswith("/not/there.tif[7]: the process that analysed this image ended")
    assert row["time_source"] == "modified"
