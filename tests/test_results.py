"""Writing and reading results: the same records come back from every format."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from rasnik import load_system
from rasnik.analysis.flags import FLAGS, Flag
from rasnik.analysis.pose import Candidate, Pose
from rasnik.io.columns import COLUMNS, flag_value, make_record
from rasnik.io.results import RESULT_SUFFIXES, JsonLinesWriter, open_results, read_results

FIRST_KEYS = (
    "file frame ok flags error x_um y_um scale theta_rad orientation "
    "sigma_x_um sigma_y_um sigma_scale sigma_theta_rad chi2_ndf"
).split()

GOOD = Pose(
    ok=True,
    x_um=1234.567890123456,
    y_um=-0.1,
    scale=1.0 + 2**-40,
    theta_rad=-1e-3,
    orientation=4,
    covariance=np.diag([1e-6, 4e-6, 9e-12, 16e-12]),
    chi2_ndf=1.01,
    blur_um=4.5,
    dark_level=25.0,
    light_level=252.0,
    polarity="negative",
    code_lines_read=7,
    code_lines_in_view=8,
    masked_fraction=0.25,
    flags=Flag.NOISE_ESTIMATED | Flag.AFFINE,
    method="likelihood",
    model="affine",
)
AMBIGUOUS = Pose(
    flags=Flag.AMBIGUOUS,
    candidates=(
        Candidate(1.0, 2.0, 1.0, 0.1, 1, 0.0),
        Candidate(2.0, 1.0, 1.0, 0.1, 4, -3.5),
    ),
)
RECORDS = [
    make_record("a.png", 0, GOOD),
    make_record('dünn, "fein".tif', 12, AMBIGUOUS, notes=("colour converted", "second")),
    make_record("missing.png", error="missing.png: no such file."),
]


def written(path: Path, records=RECORDS, **options) -> Path:
    with open_results(path, **options) as results:
        for record in records:
            results.write(record)
    return path


# ------------------------------------------------------------------------ records


def test_a_record_has_the_promised_keys_in_order():
    assert list(RECORDS[0])[: len(FIRST_KEYS)] == FIRST_KEYS
    assert set(RECORDS[1]) == {column.name for column in COLUMNS}


def test_a_record_without_pose():
    record = RECORDS[2]
    assert record["ok"] is False
    assert record["error"] == "missing.png: no such file."
    assert record["x_um"] is None
    assert record["flags"] == []


def test_an_ambiguous_record_lists_the_candidates():
    assert [c["orientation"] for c in RECORDS[1]["candidates"]] == [1, 4]
    assert "candidates" not in RECORDS[0]


def test_columns_have_every_value_of_a_pose():
    assert set(GOOD.as_dict()) <= {column.name for column in COLUMNS}


def test_flag_values():
    assert flag_value(["noise_estimated", "affine"]) == Flag.NOISE_ESTIMATED | Flag.AFFINE
    assert flag_value("noise_estimated affine") == GOOD.flags
    assert flag_value(int(GOOD.flags)) == GOOD.flags
    with pytest.raises(ValueError, match="'nonsense' is not a flag"):
        flag_value(["nonsense"])


# ------------------------------------------------------------------------ all formats


@pytest.mark.parametrize("suffix", RESULT_SUFFIXES)
def test_every_format_gives_back_what_was_written(tmp_path, suffix):
    back = read_results(written(tmp_path / f"r{suffix}"))
    assert list(back) == [column.name for column in COLUMNS]
    assert back["file"].tolist() == ["a.png", 'dünn, "fein".tif', "missing.png"]
    assert back["frame"].tolist() == [0, 12, 0]
    assert back["ok"].tolist() == [True, False, False]
    assert back["flags"].tolist() == [int(GOOD.flags), int(Flag.AMBIGUOUS), 0]
    assert back["error"].tolist() == [None, AMBIGUOUS.error, "missing.png: no such file."]
    assert back["polarity"].tolist() == ["negative", None, None]
    assert back["model"].tolist() == ["affine", "similarity", "similarity"]
    assert back["orientation"].tolist() == [4, 0, 0]
    assert back["notes"].tolist() == [None, "colour converted; second", None]
    assert back["candidates"][0] == []
    assert back["candidates"][1] == [vars(candidate) for candidate in AMBIGUOUS.candidates]
    for column in COLUMNS:
        if column.kind == "float":  # to the last bit
            expected = GOOD.as_dict()[column.name]
            values = back[column.name]
            assert values.dtype == np.float64
            assert values[0] == expected or (math.isnan(values[0]) and math.isnan(expected))
            if column.name != "masked_fraction":
                assert np.isnan(values[1:]).all()


@pytest.mark.parametrize("suffix", RESULT_SUFFIXES)
def test_no_records(tmp_path, suffix):
    back = read_results(written(tmp_path / f"r{suffix}", records=[]))
    assert {len(values) for values in back.values()} <= {0}


@pytest.mark.parametrize("suffix", RESULT_SUFFIXES)
def test_an_unknown_key_is_refused(tmp_path, suffix):
    with open_results(tmp_path / f"r{suffix}") as results:
        with pytest.raises(ValueError, match="no column for x_nm"):
            results.write({"file": "a", "x_nm": 1.0})


@pytest.mark.parametrize("suffix", RESULT_SUFFIXES)
def test_results_stay_after_an_exception(tmp_path, suffix):
    path = tmp_path / f"r{suffix}"
    with pytest.raises(KeyboardInterrupt), open_results(path) as results:
        results.write(RECORDS[0])
        raise KeyboardInterrupt
    assert read_results(path)["x_um"].tolist() == [GOOD.x_um]


CHILD = """
import os, signal, sys
from rasnik.io.columns import make_record
from rasnik.io.results import open_results
results = open_results(sys.argv[1])
for index in range(300):
    results.write(make_record(f"f{index}.png", index, error=f"bad {index}"))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
@pytest.mark.parametrize("suffix", [".jsonl", ".csv", ".h5", ".parquet"])
def test_a_killed_program_loses_nothing(tmp_path, suffix):
    path = tmp_path / f"r{suffix}"
    run = subprocess.run([sys.executable, "-c", CHILD, str(path)], check=False)
    assert run.returncode == -9
    if suffix == ".parquet":
        assert not path.exists()
        path = tmp_path / "r.parquet.partial.jsonl"
    back = read_results(path)
    assert back["frame"].tolist() == list(range(300))
    assert back["error"][299] == "bad 299"


def test_unknown_suffix(tmp_path):
    with pytest.raises(ValueError, match=r"\.xlsx is not a format of results; end the name in"):
        open_results(tmp_path / "r.xlsx")
    with pytest.raises(ValueError, match="no suffix is not a format"):
        read_results(tmp_path / "r")


@pytest.mark.parametrize("suffix", RESULT_SUFFIXES)
def test_a_folder_that_is_missing(tmp_path, suffix):
    with pytest.raises(OSError, match="No such file|unable to"):
        open_results(tmp_path / "nowhere" / f"r{suffix}")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("r.jsonl", "[1, 2]\n"),
        ("r.jsonl", "no json\n"),
        ("r.csv", "a,b\n1,2\n"),
        ("r.parquet", "no parquet"),
    ],
)
def test_files_that_hold_no_results(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=name):
        read_results(tmp_path / name)


def test_hdf5_that_holds_no_results(tmp_path):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["data"] = np.zeros(3)
    with pytest.raises(ValueError, match="holds no results"):
        read_results(tmp_path / "r.h5")


# ------------------------------------------------------------------------ one by one


def test_json_lines_hold_null_for_nan(tmp_path):
    lines = written(tmp_path / "r.jsonl").read_text(encoding="utf-8").splitlines()
    records = [json.loads(line) for line in lines]
    assert len(records) == 3
    assert list(records[0])[: len(FIRST_KEYS)] == FIRST_KEYS
    assert records[0]["flags"] == ["noise_estimated", "affine"]
    assert records[0]["x_um"] == GOOD.x_um
    assert records[1]["x_um"] is None
    assert records[1]["candidates"][1]["log_odds"] == -3.5
    assert not any(word in line for line in lines for word in ("NaN", "Infinity"))


def test_infinities_are_null_too(tmp_path):
    path = tmp_path / "r.jsonl"
    with JsonLinesWriter(path) as results:
        results.write({"file": "a", "x_um": float("inf"), "y_um": np.float64("nan")})
    assert json.loads(path.read_text()) == {"file": "a", "x_um": None, "y_um": None}


def test_json_line_that_was_cut_off_is_left_out(tmp_path):
    path = written(tmp_path / "r.jsonl")
    path.write_bytes(path.read_bytes()[:-10])
    assert read_results(path)["frame"].tolist() == [0, 12]


def test_csv_has_a_header_and_empty_cells(tmp_path):
    with written(tmp_path / "r.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == [column.name for column in COLUMNS]
    cells = dict(zip(rows[0], rows[2], strict=True))
    assert cells["ok"] == "false"
    assert cells["x_um"] == ""
    assert cells["flags"] == "ambiguous"


def test_hdf5_says_what_it_holds(tmp_path):
    system = load_system("solidras")
    path = written(tmp_path / "r.h5", system=system)
    with h5py.File(path, "r") as file:
        table = file["results"]
        about = dict(table.attrs)
        units = dict(zip(about["columns"], about["units"], strict=True))
        assert set(units) == set(table.dtype.names)
        assert units["x_um"] == "um"
        assert units["theta_rad"] == "rad"
        assert about["flag_meanings"].split() == [info.name for info in FLAGS]
        assert about["flag_masks"].tolist() == [int(info.flag) for info in FLAGS]
        assert "anticlockwise" in about["conventions"]
        assert about["software"].startswith("rasnik ")
        assert table["x_um"][0] == GOOD.x_um
        (tmp_path / "s.toml").write_text(about["system_toml"], encoding="utf-8")
    assert load_system(tmp_path / "s.toml") == system


def test_hdf5_is_readable_while_it_is_written(tmp_path):
    path = tmp_path / "r.h5"
    with open_results(path) as results:
        for number in (1, 2):
            results.write(RECORDS[0])
            code = (
                "from rasnik.io.results import read_results; "
                f"print(len(read_results({str(path)!r})['x_um']))"
            )
            run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
            assert run.stdout.strip() == str(number), run.stderr


def test_hdf5_shortens_very_long_texts_in_the_middle(tmp_path):
    name = "/start" + "ü" * 2000 + "/end.png"
    back = read_results(written(tmp_path / "r.h5", [make_record(name)]))
    assert back["file"][0].startswith("/start")
    assert back["file"][0].endswith("/end.png")


def test_parquet_has_units_and_the_system(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    path = written(tmp_path / "r.parquet", system=load_system("solidras"))
    schema = parquet.read_schema(path)
    assert schema.field("x_um").metadata[b"unit"] == b"um"
    assert b"field_um" in schema.metadata[b"system_toml"]
    assert sorted(tmp_path.iterdir()) == [path]


def test_parquet_keeps_what_an_earlier_run_left(tmp_path):
    partial = tmp_path / "r.parquet.partial.jsonl"
    partial.write_text('{"file": "a.png", "x_um": 1.0}\n')
    with pytest.raises(FileExistsError, match="left from a run that was cut off"):
        open_results(tmp_path / "r.parquet")
    assert read_results(partial)["x_um"].tolist() == [1.0]


def test_parquet_without_pyarrow_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "rasnik.io.parquet", raising=False)
    with pytest.raises(ImportError, match=r'pip install "rasnik\[parquet\]"'):
        open_results(tmp_path / "r.parquet")


def test_file_names_need_not_be_text(tmp_path):
    """Linux allows any bytes in a file name."""
    record = make_record("caf\udce9.png")
    for suffix in RESULT_SUFFIXES:
        back = read_results(written(tmp_path / f"r{suffix}", [record]))
        assert back["file"][0] == "caf\\udce9.png"
