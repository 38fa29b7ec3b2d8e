"""``rasnik archive analyse``, run as a user does."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import deque

import numpy as np
import pytest
from rich.console import Console

from _archive import FRAMES, INSTRUMENT, SMALL, keys, rows, save, save_folder
from rasnik.archive.dataset import Dataset
from rasnik.archive.run import Progress
from rasnik.cli.archive_progress import _rate
from test_cli import rasnik, refused

HERE = ["--workers", "0"]


@pytest.fixture
def source(tmp_path):
    save_folder(tmp_path / "s" / "a", 2)
    save_folder(tmp_path / "s" / "b", 1)
    return tmp_path / "s"


def analyse(source, dataset, *more):
    return rasnik("archive", "analyse", source, "-o", dataset, *INSTRUMENT, *HERE, *more)


def test_help_names_both_commands():
    assert "analyse" in rasnik("archive", "--help").stdout
    assert "summary" in rasnik("archive", "--help").stdout
    text = " ".join(rasnik("archive", "analyse", "--help").stdout.split())
    for option in ("--systems", "--scheduler", "--no-track", "--pattern", "--workers"):
        assert option in text


def test_a_table_of_instruments(source, tmp_path):
    result = analyse(source, tmp_path / "d")
    assert result.exit_code == 0
    lines = [line.split()[:4] for line in result.stdout.splitlines()]
    assert ["a", "2", "2", "0"] in lines
    assert ["b", "1", "1", "0"] in lines
    assert ["all", "3", "3", "0"] in lines
    assert "3 images analysed: 3 with a position" in result.stdout
    assert len(keys(tmp_path / "d")) == 3


def test_json(source, tmp_path):
    save(source / "a" / "zblank.png", np.full(SMALL.shape, 30, np.uint8))
    result = analyse(source, tmp_path / "d", "--json")
    assert result.exit_code == 1
    document = json.loads(result.stdout)
    assert (document["images"], document["good"], document["failed"]) == (4, 3, 1)
    assert document["instruments"]["a"]["failed"] == 1
    assert document["images_per_s"] > 0
    again = analyse(source, tmp_path / "d", "--json")
    assert again.exit_code == 1  # one is still without a position
    document = json.loads(again.stdout)
    assert (document["images"], document["files_done_before"]) == (0, 4)
    assert document["instruments"]["a"]["images"] == 3


def test_the_same_command_goes_on(source, tmp_path):
    analyse(source, tmp_path / "d")
    save(source / "c" / "new.png", FRAMES[0])
    result = analyse(source, tmp_path / "d")
    assert result.exit_code == 0
    assert "1 images analysed" in result.stdout
    assert "3 files had been analysed before" in result.stderr


def test_relative_names_mean_the_same_from_anywhere(source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    analyse("s", "d")
    monkeypatch.chdir(source)
    assert "3 files had been" in analyse(".", tmp_path / "d").stderr
    assert all(os.path.isabs(row["file"]) for row in rows(tmp_path / "d"))


def test_a_table_of_systems_with_a_gap(source, tmp_path):
    (tmp_path / "small.toml").write_text(SMALL.to_toml())
    (tmp_path / "t.csv").write_text("instrument,system\na,small.toml\nc,nonsense\n")
    result = rasnik(
        "archive", "analyse", source, "-o", tmp_path / "d", "--systems", tmp_path / "t.csv", *HERE
    )
    assert result.exit_code == 1
    text = " ".join(result.stderr.split())
    assert "b, 1 files left out" in text
    assert "nonsense" in text
    assert "2 images analysed: 2 with a position" in result.stdout
    document = json.loads(analyse(source, tmp_path / "e", "--json", "--no-track").stdout)
    assert document["refused"] == {}


def test_other_settings_are_refused_with_a_sentence(source, tmp_path):
    analyse(source, tmp_path / "d")
    result = analyse(source, tmp_path / "d", "--set", "optics.blur_um=9")
    assert result.exit_code == 1
    text = " ".join(result.stderr.split())
    assert "made with another system than is asked for now; name a new folder" in text
    assert len(keys(tmp_path / "d")) == 3


def test_a_pattern_says_where_the_instrument_stands(tmp_path):
    save_folder(tmp_path / "s" / "2026-01-01" / "a", 1)
    save_folder(tmp_path / "s" / "2026-01-02" / "a", 1)
    result = analyse(tmp_path / "s", tmp_path / "d", "--pattern", "{day:%Y-%m-%d}/{instrument}/*")
    assert result.exit_code == 0
    found = rows(tmp_path / "d")
    assert [row["instrument"] for row in found] == ["a", "a"]
    assert [row["day"] for row in found] == ["2026-01-01", "2026-01-02"]
    assert [row["time_source"] for row in found] == ["name", "name"]


def test_unreadable_places_are_named_and_the_rest_is_done(source, tmp_path):
    result = rasnik(
        *("archive", "analyse", source, tmp_path / "nowhere", "-o", tmp_path / "d"),
        *(*INSTRUMENT, *HERE),
    )
    assert result.exit_code == 1
    assert "nowhere" in result.stderr
    assert len(keys(tmp_path / "d")) == 3


def test_what_is_not_understood(source, tmp_path):
    d = tmp_path / "d"
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    begin = ["archive", "analyse", source]
    assert "give --system" in refused(*begin, "-o", d)
    assert "one of them" in refused(
        *begin, "-o", d, *INSTRUMENT, "--workers", 2, "--scheduler", "tcp://a:1"
    )
    assert "--set changes a system" in refused(*begin, "-o", d, "--set", "a=1")
    assert "no such file" in refused(*begin, "-o", d, "--systems", tmp_path / "t.csv")
    assert "folder of this machine" in refused(*begin, "-o", "s3://bucket/d", *INSTRUMENT)
    assert "is a file" in refused(*begin, "-o", tmp_path / "file", *INSTRUMENT, *HERE)
    assert "something else" in refused(*begin, "-o", tmp_path, *INSTRUMENT, *HERE)
    assert "would come twice" in refused(*begin, source / "a", "-o", d, *INSTRUMENT, *HERE)
    assert "pattern" in refused(*begin, "-o", tmp_path / "e", *INSTRUMENT, *HERE, "--pattern", "*")
    empty = ["archive", "analyse", tmp_path / "empty", "-o", tmp_path / "f", *INSTRUMENT, *HERE]
    assert "there are no images" in refused(*empty)
    with Dataset(d):
        assert "another program" in refused(*begin, "-o", d, *INSTRUMENT, *HERE)


def test_the_bar_tells_rate_and_failures(source, tmp_path, monkeypatch):
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=150)
    monkeypatch.setattr("rasnik.cli.archive_progress.messages", lambda: console)
    save(source / "a" / "zblank.png", np.full(SMALL.shape, 30, np.uint8))
    assert analyse(source, tmp_path / "d").exit_code == 1
    assert "4 images" in screen.getvalue()
    assert "for each of 1 workers 1 without a position" in screen.getvalue()


def test_rates_are_of_several_chunks():
    recent = deque([(time.monotonic() - 10, 0)])
    for images in (50, 100):
        text = _rate(Progress(images, 0, 0.0, 2, 10.0), recent)
    assert text == "10 images/s, 5 for each of 2 workers"
    assert _rate(Progress(0, 0, 0.0, 0, 1.0), deque([(0.0, 0)])) == ""


def test_ctrl_c_keeps_what_is_done(source, tmp_path):
    """A program of its own, with one process."""
    for k in range(300):
        shutil.copy(source / "a" / "image0.png", source / "a" / f"more{k}.png")
    code = """
from functools import partialmethod
from rasnik.archive.plan import Limits
from rasnik.archive.run import ArchiveRun
from rasnik.cli import app
ArchiveRun.__init__ = partialmethod(ArchiveRun.__init__, limits=Limits(frames=5))
app()
"""
    command = [sys.executable, "-c", code, "archive", "analyse", str(source)]
    command += ["-o", str(tmp_path / "d"), *INSTRUMENT, *HERE, "--no-track"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    journal, end_s = tmp_path / "d" / "_journal.jsonl", time.monotonic() + 60
    while not (journal.exists() and journal.read_bytes().count(b"\n") > 3):
        assert time.monotonic() < end_s
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "interrupted; the same command goes on" in errors
    done = len(keys(tmp_path / "d"))
    assert f"{done} images analysed" in output
    assert 0 < done < 303
