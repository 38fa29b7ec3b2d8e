"""Lines of ICARAS: their layout, and that what is written reads back."""

from __future__ import annotations

import io
import math
import re
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from rasnik import __version__
from rasnik.analysis.flags import Flag
from rasnik.analysis.pose import Pose
from rasnik.cli import app
from rasnik.io import write_track
from rasnik.io.columns import make_record
from rasnik.io.icaras import (
    ICARAS_FIELDS,
    IcarasReading,
    IcarasWriter,
    icaras_records,
    read_icaras,
    write_icaras,
)
from rasnik.io.results import open_results, read_results
from rasnik.io.stacks import read_truth
from rasnik.tracking.track import Track

GOOD = Pose(
    ok=True,
    x_um=1234.567890123456,
    y_um=-0.1,
    scale=1.0 + 2**-40,
    theta_rad=-1e-3,
    orientation=4,
    covariance=np.diag([1e-6, 4e-6, 9e-12, 16e-12]),
    flags=Flag.NOISE_ESTIMATED,
)
BAD = Pose(flags=Flag.NO_CODE | Flag.NOISE_ESTIMATED)
RECORDS = [
    make_record("a.png", 0, GOOD),
    make_record("50 %, second.tif", 12, BAD),
    make_record("missing.png", error="missing.png: no such file."),
]
NOON = datetime(2005, 4, 25, 12, 0, 0, 250_000, tzinfo=UTC)


def run(*arguments: object, status: int = 0):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == status, result.output
    return result


@pytest.fixture
def track(rng):
    n = 50
    flags = np.zeros(n, dtype=np.uint32)
    flags[7] = Flag.NO_MASK
    flags[9] = Flag.FRAMES_LOST
    x_um = rng.normal(20_000, 1, n)
    x_um[7] = np.nan
    columns = {name: rng.normal(1, 0.1, n) for name in ("y_um", "scale", "theta_rad", "chi2_ndf")}
    sigmas = {f"sigma_{c}": np.full(n, 1e-3) for c in ("x_um", "y_um", "scale", "theta_rad")}
    nothing = {name: np.full(n, np.nan) for name in ("blur_um", "dark_level", "light_level")}
    return Track(
        frame=np.arange(100, 100 + n),
        time_s=NOON.timestamp() + np.arange(n) / 860.0,
        x_um=x_um,
        flags=flags,
        metadata={"source": "camera 1, hall"},
        **columns,
        **sigmas,
        **nothing,
    )


# ------------------------------------------------------------------------ layout


def test_the_lines_have_the_fields_of_the_page_of_nikhef():
    text = io.StringIO()
    with IcarasWriter(text, channel_id="7") as writer:
        writer.write(RECORDS[0], time=NOON, rasnik_id="BOL 3A")
    stamp, data, margins = text.getvalue().splitlines()
    # "st",seq_no,grab_date,grab_time,rasnik_id,channel_id,icaras_version,analysis_version
    assert stamp == f"st,0,2005/04/25,12:00:00.250000,BOL 3A,7,rasnik,{__version__}"
    # "ud" ierr X Y M AlphaX AlphaY AlphaZ L Sx Sy
    assert data.split()[:2] == ["ud", "0"]
    x, y, m, alpha_x, alpha_y, alpha_z, length, s_x, s_y = map(float, data.split()[2:])
    assert (x, y, m, alpha_z) == (GOOD.x_um, GOOD.y_um, GOOD.scale, GOOD.theta_rad)
    assert all(math.isnan(value) for value in (alpha_x, alpha_y, length, s_x, s_y))
    # "ue" dum DX DY DM DAlphaX DAlphaY DAlphaZ DL dum dum
    words = margins.split()
    assert words[:2] == ["ue", "0"]
    assert words[-2:] == ["0", "0"]
    expected = [1e-3, 2e-3, 3e-6, math.nan, math.nan, 4e-6, math.nan]
    np.testing.assert_allclose([float(word) for word in words[2:9]], expected, rtol=1e-12)


def test_a_frame_without_a_position_shows_no_numbers():
    text = io.StringIO()
    with IcarasWriter(text) as writer:
        for record in RECORDS[1:]:
            writer.write(record)
    lines = text.getvalue().splitlines()
    for data, number in ((lines[1], Flag.NO_CODE), (lines[4], Flag.NO_IMAGE)):
        assert data == f"ud {int(number)} " + " ".join(["nan"] * len(ICARAS_FIELDS))


def test_times_are_utc():
    elsewhere = NOON.astimezone(timezone(timedelta(hours=2)))
    reading = IcarasReading(0, elsewhere, "a", "", 0)
    assert ",2005/04/25,12:00:00.250000," in reading.lines()


# ------------------------------------------------------------------------ round trip


def test_records_come_back(tmp_path):
    path = tmp_path / "a.icaras"
    with open_results(path) as writer:
        for record in RECORDS:
            writer.write(record)
    first, second, third = icaras_records(path)
    for column in ("file", "frame", "ok", "error", "x_um", "y_um", "scale", "theta_rad"):
        assert first[column] == RECORDS[0][column]
    for column in ("sigma_x_um", "sigma_y_um", "sigma_scale", "sigma_theta_rad"):
        assert first[column] == RECORDS[0][column]
    assert (second["file"], second["frame"], second["ok"]) == ("50 %, second.tif", 12, False)
    assert second["flags"] == ["no_code"]  # not the one that is not fatal
    assert second["error"] == RECORDS[1]["error"]
    assert third["flags"] == ["no_image"]
    table = read_results(path)
    assert table["x_um"][0] == GOOD.x_um
    assert np.isnan(table["x_um"][1:]).all()


def test_a_track_comes_back(tmp_path, track):
    path = tmp_path / "track.icaras"
    write_icaras(track, path, rasnik_id="camera 1, hall", channel_id="3")
    readings = list(read_icaras(path))
    assert len(readings) == len(track)
    for k, reading in enumerate(readings):
        assert isinstance(reading, IcarasReading)
        assert reading.sequence == track.frame[k]
        assert (reading.rasnik_id, reading.channel_id) == ("camera 1, hall", "3")
        assert reading.time is not None
        after_s = (reading.time - NOON).total_seconds()
        assert after_s == pytest.approx(track.time_s[k] - track.time_s[0], abs=1.1e-6)
        assert reading.ierr == (Flag.NO_MASK if k == 7 else 0)
        for name, value in reading.values.items():
            expected = np.nan if k == 7 else getattr(track, name)[k]
            np.testing.assert_array_equal(value, expected)


def test_times_with_another_zero_are_not_written_unless_it_is_given(tmp_path, track):
    bare = Track(**track.as_dict() | {"time_s": track.time_s - NOON.timestamp()})
    path = tmp_path / "a.icaras"
    write_icaras(bare, path)
    readings = list(read_icaras(path))
    assert len(readings) == len(track)
    assert all(isinstance(r, IcarasReading) and r.time is None for r in readings)
    write_icaras(bare, path, start_s=NOON.timestamp())
    first, second, *_ = read_icaras(path)
    assert isinstance(first, IcarasReading)
    assert isinstance(second, IcarasReading)
    assert first.time == NOON
    assert second.time is not None
    assert (second.time - NOON).total_seconds() == pytest.approx(1 / 860, abs=1.1e-6)
    with pytest.raises(ValueError, match="counted from 1970 already"):
        write_icaras(track, path, start_s=NOON.timestamp())


def test_a_track_without_frames(tmp_path, track):
    write_icaras(track[:0], tmp_path / "b.icaras")
    assert (tmp_path / "b.icaras").read_text() == ""


def test_writing_again_what_was_read_gives_the_same_file(tmp_path):
    path, again = tmp_path / "a.icaras", tmp_path / "b.icaras"
    with open_results(path) as writer:
        for record in RECORDS:
            writer.write(record)
    with open_results(again) as writer:
        for record in icaras_records(path):
            writer.write(record)
    assert again.read_text() == path.read_text()


def test_another_unit_is_one_entry_of_the_table(tmp_path, monkeypatch):
    import dataclasses

    in_mm = tuple(
        dataclasses.replace(f, per_unit=1e-3) if f.name in "XY" else f for f in ICARAS_FIELDS
    )
    monkeypatch.setattr("rasnik.io.icaras.ICARAS_FIELDS", in_mm)
    path = tmp_path / "a.icaras"
    with open_results(path) as writer:
        writer.write(RECORDS[0])
    data, margins = path.read_text().splitlines()[1:]
    assert float(data.split()[2]) == pytest.approx(GOOD.x_um / 1000)
    assert float(margins.split()[2]) == pytest.approx(1e-6)
    (record,) = icaras_records(path)
    assert record["x_um"] == pytest.approx(GOOD.x_um, rel=1e-15)
    assert record["scale"] == GOOD.scale


# ------------------------------------------------------------------------ files as they are


def written(path: Path) -> list[str]:
    with open_results(path) as writer:
        for record in RECORDS:
            writer.write(record)
    return path.read_text().splitlines(keepends=True)


def test_a_writer_that_was_killed_loses_the_last_image_at_most(tmp_path):
    path = tmp_path / "a.icaras"
    text = "".join(written(path))
    for cut in range(1, len(text)):
        path.write_text(text[:cut])
        if "\n" not in text[:cut]:
            continue
        complete = re.findall(r"^ue .*\n", text[:cut], re.MULTILINE)
        records = list(icaras_records(path))
        assert len(records) == len(complete)
        assert all("damaged" not in (record["error"] or "") for record in records)


def test_damaged_readings_are_named_and_the_others_read(tmp_path):
    path = tmp_path / "a.icaras"
    lines = written(path)
    lines[4] = lines[4].replace("nan", "?", 1)
    path.write_text("".join(lines[:8]) + "".join(lines[9:]) + "".join(lines[:3]))
    first, second, third, fourth = icaras_records(path)
    assert first["ok"]
    assert fourth["ok"]
    assert "the reading at line 4 is damaged" in second["error"]
    assert "the reading at line 7 is damaged" in third["error"]


def test_lines_for_debugging_are_passed_over(tmp_path):
    path = tmp_path / "a.icaras"
    lines = written(path)
    path.write_text("".join([*lines[:3], "rx 1 2 3\nqf TFFF 0 0\n", *lines[3:]]))
    assert len(list(icaras_records(path))) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x_um,y_um\n", "does not begin with 'st,'"),
        ("st,1,2005/04/25,12:00:00,1,1,3.2,140\nud 0 1 2 3 4 5 6 7 8 9\n", "nothing tells their"),
    ],
)
def test_files_of_others_are_refused(tmp_path, text, message):
    path = tmp_path / "a.icaras"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_results(path)


# ------------------------------------------------------------------------ commands


def test_analyse_and_export(tmp_path):
    size = ["--set", "sensor.width_px=320", "--set", "sensor.height_px=240"]
    stack, lines, table = (tmp_path / f"a.{suffix}" for suffix in ("h5", "icaras", "parquet"))
    run("simulate", "solidras", *size, "-n", 2, "--seed", 1, "-o", stack)
    with h5py.File(stack, "r+") as file:
        file["time_s"] = NOON.timestamp() + np.array([0.0, 0.5])
    run("analyse", f"{stack}:/frames", "--system", "solidras", *size, "-o", lines)
    readings = list(read_icaras(lines))
    assert [r.time for r in readings] == [NOON, NOON + timedelta(seconds=0.5)]
    assert readings[1].rasnik_id == f"{stack}:/frames[1]"
    run("export", lines, "-o", table)
    results, truth = read_results(table), read_truth(stack).poses
    assert results["ok"].all()
    assert results["frame"].tolist() == [0, 1]
    for column in ("x_um", "y_um"):
        off = results[column] - [pose[column] for pose in truth]
        assert (np.abs(off) < 5 * results[f"sigma_{column}"]).all()


def test_export_of_a_track(tmp_path, track):
    write_track(track, tmp_path / "t.h5")
    said = run("export", tmp_path / "t.h5", "-o", tmp_path / "t.icaras").stderr
    assert "50 frames written" in said
    first = next(iter(read_icaras(tmp_path / "t.icaras")))
    assert isinstance(first, IcarasReading)
    assert first.rasnik_id == "camera 1, hall"
    assert first.time == NOON
    bare = Track(**track.as_dict() | {"time_s": np.arange(50) / 860})
    write_track(bare, tmp_path / "t.csv")
    said = run("export", tmp_path / "t.csv", "-o", tmp_path / "u.icaras").stderr
    assert "without times" in said


def test_export_keeps_what_is_there_and_names_what_it_cannot_read(tmp_path, track):
    write_track(track, tmp_path / "t.csv")
    output = tmp_path / "t.icaras"
    output.write_text("mine")
    assert "exists already" in run("export", tmp_path / "t.csv", "-o", output, status=2).stderr
    assert output.read_text() == "mine"
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    said = run("export", tmp_path / "bad.csv", "-o", tmp_path / "x.icaras", status=2).stderr
    assert "this is not a track" in " ".join(said.split())
    said = run("export", output, "-o", tmp_path / "x.csv", status=2).stderr
    assert "no file of ICARAS lines" in " ".join(said.split())
