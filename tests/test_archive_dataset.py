"""A dataset holds each image once, wherever the writing of it is cut off."""

import errno
import json
import os
import shutil

import pytest
from pyarrow import dataset as arrow

import rasnik.archive.dataset as dataset_module
from _archive import FRAMES, NOON_S, SETTINGS, SMALL, analyse_archive, keys, rows, save, save_folder
from rasnik import load_system
from rasnik.archive.dataset import Dataset, DatasetError, open_dataset
from rasnik.archive.systems_table import InstrumentSettings


class KilledError(BaseException):
    """In place of SIGKILL: nothing that is written after it is written."""


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Images of two instruments, some on either side of midnight."""
    folder = tmp_path_factory.mktemp("source")
    for name in ("0012", "b c=d"):
        for k in (0, 2, 3):
            save(folder / name / f"image{k}.png", FRAMES[k], NOON_S + 3600 * 5 * k)
    return folder


@pytest.fixture(scope="module")
def finished(source, tmp_path_factory):
    path = tmp_path_factory.mktemp("finished") / "dataset"
    analyse_archive(source, path)
    return path


@pytest.fixture
def dataset(finished, tmp_path):
    """A copy of the finished dataset."""
    return shutil.copytree(finished, tmp_path / "dataset")


EXPECTED = [(name, f"image{k}.png", 0) for name in ("0012", "b c=d") for k in (0, 2, 3)]


# ------------------------------------------------------------------------ what is in it


def test_instruments_and_days_are_columns_of_text(finished):
    found = rows(finished)
    assert keys(finished) == EXPECTED
    assert all(row["ok"] for row in found)
    days = [row["day"] for row in found[:3]]
    assert days[0] == days[1] < days[2]
    folders = {name for name in os.listdir(finished) if not name.startswith("_")}
    assert folders == {"instrument=0012", "instrument=b%20c%3Dd"}


def test_other_readers_find_the_rows_as_well(finished):
    table = arrow.dataset(finished, partitioning="hive").to_table()
    assert table.num_rows == len(EXPECTED)


def test_only_rows_and_the_journal_are_left(finished):
    files = [file for _, _, names in os.walk(finished) for file in names]
    others = [f for f in files if not (f.startswith("part-") and f.endswith(".parquet"))]
    assert others == ["_journal.jsonl"]


def test_totals_are_counted(finished):
    with Dataset(finished) as opened:
        assert {name: total.good for name, total in opened.totals.items()} == {
            "0012": 3,
            "b c=d": 3,
        }
        assert len(opened.done) == 6
        assert opened.removed == 0


# ------------------------------------------------------------------------ killed


def test_killed_at_every_step_of_writing(source, tmp_path, monkeypatch):
    """Before and after every write, rename and line: 2 chunks with 2 parts each."""
    steps = 0
    while True:
        path, left = tmp_path / f"dataset{steps}", [steps]

        def count(function, left=left):
            def counted(*arguments):
                if left[0] == 0:
                    raise KilledError
                left[0] -= 1
                return function(*arguments)

            return counted

        with monkeypatch.context() as patch:
            for name in ("fsync", "replace"):
                patch.setattr(os, name, count(getattr(os, name)))
            patch.setattr(dataset_module.Path, "replace", count(dataset_module.Path.replace))
            patch.setattr(Dataset, "_add_line", count(Dataset._add_line))
            try:
                analyse_archive(source, path)
                killed = False
            except KilledError:
                killed = True
        analyse_archive(source, path)
        assert keys(path) == EXPECTED, f"after {steps} steps"
        if not killed:
            break
        steps += 1
    assert steps > 12


def test_a_full_disk_is_told_and_what_is_stored_stays(source, tmp_path, monkeypatch):
    """At each write, the last byte of which does not get there."""
    fsync = os.fsync
    for steps in range(4):  # of the first chunk: two parts, settings, its line
        path, left = tmp_path / f"dataset{steps}", [steps]

        def full(descriptor, left=left):
            fsync(descriptor)
            if left[0] == 0:
                os.ftruncate(descriptor, os.fstat(descriptor).st_size - 1)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            left[0] -= 1

        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            with pytest.raises(DatasetError, match="cannot be written .No space left on device"):
                analyse_archive(source, path)
        analyse_archive(source, path)
        assert keys(path) == EXPECTED, f"after {steps} steps"


def test_a_journal_cut_off_anywhere(source, dataset, finished):
    """As by a crash in the middle of its last lines."""
    journal = (finished / "_journal.jsonl").read_bytes()
    lines = journal.splitlines(keepends=True)
    last = len(journal) - len(lines[-1])
    for length in [0, 5, len(lines[0]) - 1, len(lines[0]), last, last + 40, len(journal) - 1]:
        shutil.rmtree(dataset)
        shutil.copytree(finished, dataset)
        (dataset / "_journal.jsonl").write_bytes(journal[:length])
        analyse_archive(source, dataset)
        assert keys(dataset) == EXPECTED, f"cut off at {length}"


@pytest.mark.parametrize("spoilt", ["cut off", "settings"])
def test_rows_that_a_damaged_journal_does_not_name_are_kept_aside(dataset, spoilt):
    """Their images may be gone. A run that is killed leaves one such chunk at most."""
    before = {path: path.read_bytes() for path in dataset.glob("*/*/*.parquet")}
    journal = dataset / "_journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    kept = lines[:1] if spoilt == "cut off" else [lines[0], b"garbage\n", *lines[2:]]
    journal.write_bytes(b"".join(kept))
    with Dataset(dataset) as opened:
        assert (opened.removed, opened.set_aside) == (0, len(before))
        assert not opened.totals
    for path, content in before.items():
        assert not path.exists()
        assert path.with_name(f"_{path.name}.aside").read_bytes() == content
    assert open_dataset(dataset).count_rows() == 0


def test_a_journal_spoilt_in_the_middle(source, dataset):
    journal = dataset / "_journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    for spoilt in (1, 2):
        journal.write_bytes(b"".join([*lines[:spoilt], b"\0\0garbage\n", *lines[spoilt + 1 :]]))
        analyse_archive(source, dataset)
        assert keys(dataset) == EXPECTED


@pytest.mark.parametrize("harm", ["removed", "cut off", "folder removed"])
def test_a_part_that_is_gone_is_done_again(source, dataset, harm):
    part = next(dataset.glob("instrument=0012/*/*.parquet"))
    if harm == "removed":
        part.unlink()
    elif harm == "cut off":
        part.write_bytes(part.read_bytes()[:100])
    else:
        shutil.rmtree(dataset / "instrument=0012")
    run = analyse_archive(source, dataset)
    assert run.totals["0012"].images == 3
    assert "b c=d" not in run.totals
    assert keys(dataset) == EXPECTED


def test_a_chunk_done_twice_replaces_itself(source, dataset):
    """The mark is gone, the parts are there."""
    parts = sorted(dataset.glob("*/*/*.parquet"))
    journal = dataset / "_journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:-1]))
    analyse_archive(source, dataset)
    assert keys(dataset) == EXPECTED
    assert sorted(dataset.glob("*/*/*.parquet")) == parts


# ------------------------------------------------------------------------ refused


def test_two_programs_do_not_write_one_dataset(dataset):
    with Dataset(dataset), pytest.raises(BlockingIOError, match="another program"):
        Dataset(dataset)
    Dataset(dataset).close()


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("keep me")
    with pytest.raises(DatasetError, match="holds something else"):
        Dataset(tmp_path)
    assert os.listdir(tmp_path) == ["notes.txt"]
    with pytest.raises(DatasetError, match="is a file"):
        Dataset(tmp_path / "notes.txt")


def test_files_of_others_in_a_dataset_are_not_touched(dataset):
    merged = dataset / "instrument=0012" / "merged.parquet"
    merged.write_bytes(b"by somebody")
    with pytest.raises(DatasetError, match="merged.parquet was not written by this program"):
        Dataset(dataset)
    assert merged.exists()


def test_another_version_does_not_go_on(dataset):
    journal = dataset / "_journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    head = json.loads(lines[0]) | {"software": "0.0.1"}
    journal.write_bytes(b"".join([json.dumps(head).encode() + b"\n", *lines[1:]]))
    with pytest.raises(DatasetError, match="was begun with rasnik 0.0.1"):
        Dataset(dataset)


def test_a_folder_without_a_dataset_cannot_be_read(tmp_path):
    with pytest.raises(DatasetError, match="holds no dataset"):
        open_dataset(tmp_path)


def test_differences_of_settings_are_named(finished):
    other = load_system(SMALL, {"optics.blur_um": 9.0})
    with Dataset(finished) as opened:
        assert opened.differences("0012", SETTINGS, True) == []
        assert opened.differences("never seen", SETTINGS, True) == []
        assert opened.differences("0012", SETTINGS, False) == ["tracking"]
        changed = InstrumentSettings(other, model="affine", orientation=2, frame_rate_hz=1.0)
        named = ["system", "model", "orientation", "frame rate"]
        assert opened.differences("0012", changed, True) == named


def test_results_made_with_other_settings_are_not_mixed(source, dataset, tmp_path):
    run = analyse_archive(source, dataset, track=False)
    assert set(run.planner.refused) == {"0012", "b c=d"}
    assert "made with another tracking" in run.planner.refused["0012"][0]
    shutil.rmtree(dataset / "instrument=0012")  # as the sentence says
    run = analyse_archive(source, dataset, track=False)
    assert run.totals["0012"].images == 3
    assert set(run.planner.refused) == {"b c=d"}
    assert keys(dataset) == EXPECTED


def test_images_added_later_are_taken_up(tmp_path):
    save_folder(tmp_path / "source" / "a", 2)
    analyse_archive(tmp_path / "source", tmp_path / "dataset")
    save_folder(tmp_path / "source" / "a0", 1)
    save(tmp_path / "source" / "a" / "image00.png", FRAMES[5])
    run = analyse_archive(tmp_path / "source", tmp_path / "dataset")
    assert {name: total.images for name, total in run.totals.items()} == {"a": 1, "a0": 1}
    assert keys(tmp_path / "dataset") == [
        ("a", "image0.png", 0),
        ("a", "image00.png", 0),
        ("a", "image1.png", 0),
        ("a0", "image0.png", 0),
    ]


def test_a_removed_folder_is_done_with_other_settings_also_if_a_file_had_changed(source, tmp_path):
    """A file that was only touched has a line in the journal, but no part."""
    images, dataset = shutil.copytree(source, tmp_path / "s"), tmp_path / "d"
    analyse_archive(images, dataset)
    os.utime(images / "0012" / "image0.png", (NOON_S + 1, NOON_S + 1))
    analyse_archive(images, dataset)
    shutil.rmtree(dataset / "instrument=0012")
    run = analyse_archive(images, dataset, track=False)
    assert set(run.planner.refused) == {"b c=d"}
    assert keys(dataset) == EXPECTED


def test_a_name_too_long_for_a_folder_is_left_out_and_the_rest_done(tmp_path):
    for name in ("a", "\u6e2c" * 27, "\u6e2c" * 28):  # 9 bytes each, and 11 before them
        save_folder(tmp_path / "s" / name, 1)
    run = analyse_archive(tmp_path / "s", tmp_path / "d")
    assert [name for name, _, _ in keys(tmp_path / "d")] == ["a", "\u6e2c" * 27]
    assert "is too long for a folder" in run.planner.refused["\u6e2c" * 28][0]


def test_an_instrument_on_another_disk_is_not_done_again(source, dataset, tmp_path):
    """Its folder was moved, and a link put in its place."""
    shutil.move(dataset / "instrument=0012", tmp_path / "elsewhere")
    os.symlink(tmp_path / "elsewhere", dataset / "instrument=0012")
    run = analyse_archive(source, dataset)
    assert run.planner.unchanged == len(EXPECTED)
    assert keys(dataset) == EXPECTED
