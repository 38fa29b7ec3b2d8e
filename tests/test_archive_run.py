"""Whole archives: what is left out, what ends its process, what goes on; and real workers."""

import os
import shutil
import signal
import subprocess
import sys

import h5py
import numpy as np
import pytest

from _archive import FRAMES, NOON_S, SMALL, analyse_archive, keys, rows, save, save_folder
from rasnik.archive.cluster import Finished, PoolError, dask_pool
from rasnik.archive.dataset import Dataset
from rasnik.archive.plan import Limits
from rasnik.archive.run import ArchiveRun, absolute_sources
from rasnik.archive.systems_table import SystemsTable
from rasnik.archive.work import WorkerError, analyse_chunk


class FakePool:
    """Workers that can be watched, and that some frames end."""

    def __init__(self, workers: int = 2, poison: tuple = ()) -> None:
        self.workers, self._poison = workers, poison
        self._waiting: list = []
        self.most = self.deaths = 0

    def room(self) -> int:
        return 2 * self.workers - len(self._waiting)

    def submit(self, ticket, function, *arguments) -> None:
        self._waiting.append((ticket, function, arguments))
        self.most = max(self.most, len(self._waiting))

    def finished(self, timeout_s) -> list[Finished]:
        if not self._waiting:
            return []
        ticket, function, arguments = self._waiting.pop()  # not in order
        if self._is_deadly(function, *arguments):
            self.deaths += 1
            return [Finished(ticket, died=True)]
        return [Finished(ticket, function(*arguments))]

    def _is_deadly(self, function, subject) -> bool:
        if function is not analyse_chunk:  # the count of frames
            return (os.path.basename(subject.url), None) in self._poison
        spans = [
            (os.path.basename(span.item.url), span.start, span.stop) for span in subject.chunk.spans
        ]
        return any(
            name == file and (frame is None or start <= frame < (10**9 if stop is None else stop))
            for name, start, stop in spans
            for file, frame in self._poison
        )


def h5_file(path, frames):
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["frames"] = frames
    os.utime(path, (NOON_S + len(frames), NOON_S + len(frames)))
    return path


# ------------------------------------------------------------------------ all of it


def test_folders_stacks_and_files_of_many_kinds(tmp_path):
    save_folder(tmp_path / "s" / "a", 3)
    h5_file(tmp_path / "s" / "b" / "x.h5", FRAMES[:4])
    np.save(tmp_path / "s" / "b" / "y.npy", FRAMES[:2])
    (tmp_path / "s" / "b" / "notes.txt").write_text("not an image")
    run = analyse_archive(tmp_path / "s", tmp_path / "d", limits=Limits(frames=3, counted=1000))
    assert keys(tmp_path / "d") == [
        *(("a", f"image{k}.png", 0) for k in range(3)),
        *(("b", "x.h5", k) for k in range(4)),
        *(("b", "y.npy", k) for k in range(2)),
    ]
    assert all(row["ok"] for row in rows(tmp_path / "d"))
    assert run.left_out.counts == {"not an image": 1}


def test_a_stack_that_grows_is_gone_on_with(tmp_path):
    for n in (2, 5, 5, 6):
        if n != len(keys(tmp_path / "d") if (tmp_path / "d").exists() else ()):
            h5_file(tmp_path / "s" / "a" / "x.h5", FRAMES[:n])
        run = analyse_archive(tmp_path / "s", tmp_path / "d")
        assert keys(tmp_path / "d") == [("a", "x.h5", k) for k in range(n)]
    assert run.planner.n_changed == 1


def test_a_file_that_was_replaced_keeps_its_row_and_is_told(tmp_path):
    save(tmp_path / "s" / "a" / "x.png", FRAMES[0])
    analyse_archive(tmp_path / "s", tmp_path / "d")
    before = rows(tmp_path / "d")
    save(tmp_path / "s" / "a" / "x.png", FRAMES[5], NOON_S + 9)
    run = analyse_archive(tmp_path / "s", tmp_path / "d")
    assert rows(tmp_path / "d") == before
    assert run.planner.changed == [str(tmp_path / "s" / "a" / "x.png")]
    run = analyse_archive(tmp_path / "s", tmp_path / "d")
    assert run.planner.unchanged == 1


def test_a_stack_that_was_cut_off_is_done_again_once_its_rows_are_removed(tmp_path):
    """The error of the missing frames stands for the first of them, until then."""
    path, whole = tmp_path / "s" / "a" / "x.pgm", b""
    for frame in FRAMES[:4]:
        whole += b"P5 200 152 255\n" + frame.tobytes()
    path.parent.mkdir(parents=True)
    path.write_bytes(whole[: len(whole) * 7 // 10])
    os.utime(path, (NOON_S, NOON_S))
    analyse_archive(tmp_path / "s", tmp_path / "d")
    assert [row["ok"] for row in rows(tmp_path / "d")] == [True, True, False]
    path.write_bytes(whole)
    os.utime(path, (NOON_S + 9, NOON_S + 9))
    run = analyse_archive(tmp_path / "s", tmp_path / "d")
    assert run.planner.n_changed == 1
    assert [row["ok"] for row in rows(tmp_path / "d")] == [True, True, False, True]
    shutil.rmtree(next((tmp_path / "d").glob("instrument=a/day=*")))
    analyse_archive(tmp_path / "s", tmp_path / "d")
    assert [row["ok"] for row in rows(tmp_path / "d")] == [True] * 4


def test_instruments_without_a_system_are_named_and_done_once_they_have_one(tmp_path):
    save_folder(tmp_path / "s" / "a", 1)
    save_folder(tmp_path / "s" / "b", 2)
    (tmp_path / "small.toml").write_text(SMALL.to_toml())
    (tmp_path / "t.csv").write_text("instrument,system\na,small.toml\n")
    table = SystemsTable.read(tmp_path / "t.csv")
    run = analyse_archive(tmp_path / "s", tmp_path / "d", table=table)
    assert keys(tmp_path / "d") == [("a", "image0.png", 0)]
    ((name, (sentence, files)),) = run.planner.refused.items()
    assert (name, files) == ("b", 2)
    assert "names no system for the instrument b" in sentence
    (tmp_path / "t.csv").write_text("instrument,system\na,small.toml\nb,small.toml\n")
    analyse_archive(tmp_path / "s", tmp_path / "d", table=SystemsTable.read(tmp_path / "t.csv"))
    assert len(keys(tmp_path / "d")) == 3


def test_never_much_is_given_out(tmp_path):
    for name in "abcdefgh":
        save_folder(tmp_path / "s" / name, 2)
    pool = FakePool(workers=2)
    seen = []
    with Dataset(tmp_path / "d") as dataset:
        sources = absolute_sources([str(tmp_path / "s")])
        run = ArchiveRun(sources, SystemsTable.for_all(SMALL), dataset, limits=Limits(frames=1))
        run.run(pool, seen.append)
    assert pool.most == 4
    assert [progress.images for progress in seen] == list(range(1, 17))
    assert len(keys(tmp_path / "d")) == 16
    size = sum(file.stat().st_size for file in (tmp_path / "s").rglob("*.png"))
    assert seen[-1].size == pytest.approx(size)


# ------------------------------------------------------------------------ images that kill


def test_an_image_that_ends_its_process_is_found_and_is_a_row(tmp_path):
    save_folder(tmp_path / "s" / "a", 11)
    pool = FakePool(poison=(("image7.png", None),))
    run = analyse_archive(tmp_path / "s", tmp_path / "d", pool=lambda: pool)
    found = rows(tmp_path / "d")
    assert len(found) == 11
    assert [row["file"].endswith("image7.png") for row in found if not row["ok"]] == [True]
    assert run.lost == [str(tmp_path / "s" / "a" / "image7.png")]
    assert pool.deaths < 10
    again = analyse_archive(tmp_path / "s", tmp_path / "d")
    assert again.planner.unchanged == 11


@pytest.mark.parametrize("counted", [1000, 10**9])
def test_a_frame_of_a_stack_that_ends_its_process_is_found(tmp_path, counted):
    h5_file(tmp_path / "s" / "a" / "x.h5", FRAMES[:9])
    pool = FakePool(poison=(("x.h5", 5),))
    limits = Limits(frames=6, counted=counted)
    analyse_archive(tmp_path / "s", tmp_path / "d", pool=lambda: pool, limits=limits)
    assert keys(tmp_path / "d") == [("a", "x.h5", k) for k in range(9)]
    assert [row["frame"] for row in rows(tmp_path / "d") if not row["ok"]] == [5]


def test_a_file_that_cannot_even_be_opened_without_harm(tmp_path):
    save_folder(tmp_path / "s" / "a", 3)
    pool = FakePool(poison=(("image1.png", None),))
    analyse_archive(tmp_path / "s", tmp_path / "d", pool=lambda: pool)
    bad = [row for row in rows(tmp_path / "d") if not row["ok"]]
    assert len(bad) == 1
    assert "the process that analysed this image ended" in bad[0]["error"]


# ------------------------------------------------------------------------ what is refused


def test_a_source_within_another_is_refused(tmp_path):
    for sources in (["a", "a/b"], ["a/b", "a"], ["a", "./a/"], ["s3://x/a/b", "s3://x/a"]):
        with pytest.raises(ValueError, match="would come twice"):
            absolute_sources(sources)
    assert absolute_sources(["a", "ab", "s3://x/a"]) == [
        os.path.abspath("a"),
        os.path.abspath("ab"),
        "s3://x/a",
    ]


def test_a_fault_of_a_worker_ends_the_run_and_nothing_is_written(tmp_path):
    save_folder(tmp_path / "s" / "a", 2)

    class Refusing(FakePool):
        def finished(self, timeout_s):
            raise WorkerError("another version")

    with pytest.raises(WorkerError):
        analyse_archive(tmp_path / "s", tmp_path / "d", pool=Refusing)
    analyse_archive(tmp_path / "s", tmp_path / "d")
    assert len(keys(tmp_path / "d")) == 2


def test_no_scheduler_is_told(monkeypatch):
    monkeypatch.setattr("rasnik.archive.cluster._PATIENCE_S", 0.5)
    with pytest.raises(PoolError, match="no scheduler answers at tcp://127.0.0.1:1"):
        with dask_pool(scheduler="tcp://127.0.0.1:1"):
            pass


# ------------------------------------------------------------------------ real processes

PROGRAM = """
import os, signal, sys
from pathlib import Path
import psutil
sys.path.insert(0, sys.argv[3])
from _archive import SMALL
from rasnik.archive.cluster import dask_pool
from rasnik.archive.dataset import Dataset
from rasnik.archive.plan import Limits
from rasnik.archive.run import ArchiveRun
from rasnik.archive.systems_table import SystemsTable

def main():
    killed = []
    def kill(progress):
        if progress.images and not killed:
            children = psutil.Process().children(recursive=True)
            killed.append(next(c for c in children if "spawn_main" in " ".join(c.cmdline())))
            killed[0].kill()
        if progress.images >= 9:  # the worker that took its place has done some
            os.kill(os.getpid(), signal.SIGKILL)
    with Dataset(Path(sys.argv[2])) as dataset, dask_pool(1, system=SMALL) as pool:
        table = SystemsTable.for_all(SMALL)
        ArchiveRun([sys.argv[1]], table, dataset, limits=Limits(frames=3)).run(pool, kill)

if __name__ == "__main__":
    main()
"""


@pytest.mark.slow
def test_a_killed_worker_and_a_killed_run(tmp_path):
    """A program of its own, whose worker is killed, and then all of it; then it is gone on with."""
    for name in ("a", "b"):
        save_folder(tmp_path / "s" / name, 12)
    (tmp_path / "program.py").write_text(PROGRAM)
    run = subprocess.run(
        [
            *(sys.executable, tmp_path / "program.py"),
            *(tmp_path / "s", tmp_path / "d", os.path.dirname(__file__)),
        ],
        timeout=120,
    )
    assert run.returncode == -signal.SIGKILL
    done = len(keys(tmp_path / "d"))
    assert 9 <= done < 24
    analyse_archive(tmp_path / "s", tmp_path / "d")
    expected = [(name, f"image{k}.png", 0) for name in "ab" for k in range(12)]
    assert keys(tmp_path / "d") == sorted(expected)
    assert all(row["ok"] for row in rows(tmp_path / "d"))
