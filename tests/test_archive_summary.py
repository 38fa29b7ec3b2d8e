"""The summary of an archive: known scatter and drift come back, and damage is named."""

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pytest
from numpy.typing import NDArray
from pyarrow import parquet
from scipy.signal import lfilter
from typer.testing import CliRunner

from rasnik.archive.drift import drift
from rasnik.archive.summary import UNREAD, summarise
from rasnik.archive.worst import Suspects, Worst, choose
from rasnik.imaging.simulate import simulate
from rasnik.instrument import load_system

DAY_S = 86400.0
START_S = 1_704_067_200.0  # 2024-01-01

FLOATS = (
    *("x_um", "y_um", "scale", "theta_rad", "sigma_x_um", "sigma_y_um", "sigma_scale"),
    *("sigma_theta_rad", "chi2_ndf", "blur_um", "dark_level", "light_level"),
)


def write_rows(
    root: Path,
    instrument: str,
    x_um: NDArray[Any],
    *,
    interval_s: float = 60.0,
    day: str = "2024-01-01",
    name: str = "part-0",
    drop: tuple[str, ...] = (),
    start: int = 0,
    toml: str = "",
    **changed: Any,
) -> Path:
    """One part of a dataset; NaN stands for an image without a position."""
    n = len(x_um)
    good = np.isfinite(x_um)
    columns: dict[str, Any] = {
        "file": [f"/images/{instrument}/{k}.png" for k in range(start, start + n)],
        "frame": np.zeros(n, dtype=np.int64),
        "ok": good,
        "flags": [[] if ok else ["no_mask"] for ok in good],
        "error": [None if ok else "No chess pattern was found." for ok in good],
        "time_s": START_S + interval_s * np.arange(start, start + n),
        **{key: np.where(good, 1.0, np.nan) for key in FLOATS},
        "sigma_x_um": np.where(good, 1e-3, np.nan),
        "sigma_y_um": np.where(good, 1e-3, np.nan),
        "y_um": np.where(good, 5.0, np.nan),
        "x_um": x_um,
    } | changed
    folder = root / f"instrument={instrument}" / f"day={day}"
    folder.mkdir(parents=True, exist_ok=True)
    table = pyarrow.table({k: v for k, v in columns.items() if k not in drop})
    path = folder / f"{name}.parquet"
    parquet.write_table(table.replace_schema_metadata({"system_toml": toml}), path)
    return path


# ------------------------------------------------------------------------ drift


def test_drift_of_a_line_without_scatter_is_its_slope() -> None:
    t = np.arange(500) * 100.0
    found = drift(t, 3.0 * t / DAY_S)
    assert found.slope == pytest.approx(3.0, rel=1e-9)
    assert found.sigma < 1e-9


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_drift_has_the_error_that_it_states(rng: np.random.Generator, correlation: float) -> None:
    """Autoregressive scatter, where the error of a plain line would be wrong up to 4 times."""
    n, runs, true = 1500, 100, -0.7
    t = START_S + np.arange(n) * 600.0
    pulls = []
    for _ in range(runs):
        noise = lfilter([1], [1, -correlation], rng.normal(size=n + 200))[200:]
        found = drift(t, noise + true * (t - START_S) / DAY_S)
        if math.isfinite(found.sigma):
            pulls.append((found.slope - true) / found.sigma)
        else:
            assert "wanders" in found.remark
    assert len(pulls) >= 0.97 * runs
    # The largest error of four widths is about 13 % too large, as the module says.
    assert abs(np.std(pulls) - 0.87) < 4 * 0.87 / math.sqrt(2 * runs)
    assert abs(np.mean(pulls)) < 4 / math.sqrt(runs)


def test_drift_is_not_led_astray_by_wrong_positions(rng: np.random.Generator) -> None:
    t = np.arange(4000) * 60.0
    x = 0.2 * t / DAY_S + 0.01 * rng.normal(size=len(t))
    x[rng.random(len(t)) < 0.1] += 500.0
    found = drift(t, x)
    assert abs(found.slope - 0.2) < 4 * found.sigma < 0.02


def test_a_random_walk_has_no_drift_that_can_be_told(rng: np.random.Generator) -> None:
    t = np.arange(2000) * 600.0
    said = [drift(t, np.cumsum(rng.normal(size=len(t)))) for _ in range(40)]
    warned = [one for one in said if one.remark]
    assert len(warned) >= 36
    assert all(math.isnan(one.sigma) or "lower limit" in one.remark for one in warned)


def test_drift_needs_times() -> None:
    assert "no position has a time" in drift(np.full(9, np.nan), np.ones(9)).remark
    same = drift(np.full(50, 1e9), np.arange(50.0))
    assert math.isnan(same.slope) and "at 1 times only" in same.remark


# ------------------------------------------------------------------------ the summary


def test_known_scatter_and_drift_come_back(tmp_path: Path, rng: np.random.Generator) -> None:
    n = 3000
    t_days = np.arange(n) * 60.0 / DAY_S
    for instrument, sigma_nm, slope in (("EML2", 4.0, 0.3), ("EML10", 9.0, -0.1)):
        x = 100 + slope * t_days + 1e-3 * sigma_nm * rng.normal(size=n)
        half = n // 2
        write_rows(tmp_path, instrument, x[:half])
        write_rows(tmp_path, instrument, x[half:], day="2024-01-02", start=half)
    found = summarise(tmp_path)
    assert [one.instrument for one in found.instruments] == ["EML2", "EML10"]
    for one, sigma_nm, slope in zip(found.instruments, (4.0, 9.0), (0.3, -0.1), strict=True):
        scatter, line = one.scatter["x"], one.drift["x"]
        assert abs(scatter.sigma - sigma_nm) < 4 * scatter.sigma_error < 0.6
        assert scatter.sigma / scatter.stated == pytest.approx(sigma_nm, rel=0.1)
        assert abs(line.slope - slope) < 4 * line.sigma
        assert one.interval_s == pytest.approx(60.0)
        assert (one.images, one.good) == (n, n)
    assert found.days == {"2024-01-01": [n, 0], "2024-01-02": [n, 0]}
    assert not found.faults and not found.failed


def test_stated_error_of_the_scatter(tmp_path: Path, rng: np.random.Generator) -> None:
    pulls = []
    for number in range(40):
        write_rows(tmp_path / str(number), "A", 2e-3 * rng.normal(size=400))
        one = summarise(tmp_path / str(number)).instruments[0].scatter["x"]
        pulls.append((one.sigma - 2.0) / one.sigma_error)
    assert 0.7 < np.std(pulls) < 1.3


def test_images_that_do_not_follow_each_other_are_not_compared(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Between the runs the mask is moved by far more than the scatter."""
    x = 1e-3 * rng.normal(size=1200) + np.repeat(np.arange(12) * 50.0, 100)
    pauses = np.repeat(np.arange(12) * 4000.0, 100)
    time_s = START_S + 10.0 * np.arange(1200) + pauses
    write_rows(tmp_path, "A", x, time_s=time_s)
    one = summarise(tmp_path).instruments[0].scatter["x"]
    assert one.sigma == pytest.approx(1.0, rel=0.1)
    assert not one.outliers


def test_rows_of_a_long_run_are_thinned_in_runs(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rasnik.archive.summary._MOST_ROWS", 3000)
    x = 1e-3 * rng.normal(size=20_000) + np.cumsum(0.05e-3 * rng.normal(size=20_000))
    write_rows(tmp_path, "A", x)
    one = summarise(tmp_path).instruments[0]
    assert one.images == 20_000 and one.used == 3000
    assert one.scatter["x"].sigma == pytest.approx(1.0, rel=0.08)


def test_failures_by_reason_and_the_worst(tmp_path: Path, rng: np.random.Generator) -> None:
    n = 500
    x = 1e-3 * rng.normal(size=n)
    flags: list[list[str]] = [["saturated"] if k < 7 else [] for k in range(n)]
    for k, names in ((10, ["no_code"]), (11, ["no_code"]), (12, ["blank", "no_mask"]), (13, [])):
        x[k], flags[k] = np.nan, names
    x[200] += 0.1
    chi2 = np.where(np.isfinite(x), 1.0, np.nan)
    chi2[300] = 40.0
    write_rows(tmp_path, "A", x, flags=flags, chi2_ndf=chi2)
    found = summarise(tmp_path)
    (one,) = found.instruments
    assert one.failed == {"no_code": 2, "no_mask": 1, UNREAD: 1}
    assert one.flags["saturated"] == 7
    assert one.good == n - 4
    by_kind = {worst.kind: worst for worst in found.worst}
    assert by_kind["jump"].file.endswith("/200.png")
    assert "0.099" in by_kind["jump"].sentence
    assert by_kind["misfit"].file.endswith("/300.png")
    assert "40 " in by_kind["misfit"].sentence.replace(",", " ,")
    assert [worst.kind for worst in found.worst].count("no_code") == 2
    assert [worst.file for worst in found.worst if worst.kind == "jump"] == [by_kind["jump"].file]


def test_one_kind_of_trouble_does_not_hide_the_others() -> None:
    suspects = []
    for instrument in ("A", "B"):
        one = Suspects(instrument)
        one.failed["no_mask"] = 1000
        one.by_kind["no_mask"] = [
            Worst(instrument, f"{instrument}{k}", 0, "no_mask", 1.0, "") for k in range(10)
        ]
        suspects.append(one)
    suspects[1].by_kind["jump"] = [Worst("B", "jumped", 0, "jump", 50.0, "")]
    chosen = choose(suspects)
    assert len(chosen) == 10
    assert chosen[1].file == "jumped"
    assert [one.instrument for one in chosen if one.kind == "no_mask"][:2] == ["A", "B"]


def test_a_mask_with_another_field_is_told_though_every_image_is_good(tmp_path: Path) -> None:
    """The positions are wrong by the factor of the scale, and neither jump nor scatter."""
    n = 30
    flags = [["cold_start", "scale_unexpected"] if k > 11 else [] for k in range(n)]
    write_rows(tmp_path, "A", np.full(n, 5.0), flags=flags, scale=np.full(n, 0.5))
    write_rows(tmp_path, "B", np.full(n, 5.0))
    found = summarise(tmp_path)
    wrong, right = found.instruments
    assert wrong.good == n
    assert wrong.remarks[0].startswith("18 images: The scale differs from the system's")
    assert not [remark for remark in right.remarks if "scale" in remark]
    (worst,) = [one for one in found.worst if one.kind == "scale"]
    assert worst.file == "/images/A/12.png" and not worst.is_failure
    assert worst.sentence.startswith("the scale is 0.5. The scale differs")


# ------------------------------------------------------------------------ damage


def test_damaged_parts_and_missing_columns_are_named_and_the_rest_done(tmp_path: Path) -> None:
    write_rows(tmp_path, "A", np.zeros(20))
    whole = write_rows(tmp_path, "A", np.zeros(20), name="part-1", start=20)
    write_rows(tmp_path, "B", np.zeros(20), drop=("chi2_ndf", "file"))
    write_rows(tmp_path, "C", np.zeros(20), drop=("ok",))
    (tmp_path / "instrument=D" / "day=unknown").mkdir(parents=True)
    whole.write_bytes(whole.read_bytes()[:500])
    (tmp_path / "instrument=A" / "day=2024-01-01" / "_unfinished-part-2.parquet").write_text("x")
    found = summarise(tmp_path)
    assert {one.instrument: one.images for one in found.instruments} == {"A": 20, "B": 20}
    text = "\n".join(found.faults)
    assert "part-1.parquet" in text and "cannot be read" in text
    assert "no column chi2_ndf" in text and "instrument=B" in text
    assert "no column ok" in text and "instrument=C" in text
    assert "unfinished" not in text
    assert math.isnan(found.instruments[1].levels["chi2_ndf"][1])
    assert any("resolution of x not measured" in r for r in found.instruments[1].remarks)


def test_a_folder_without_a_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no rows"):
        summarise(tmp_path)
    with pytest.raises(ValueError, match="not the folder of a dataset"):
        summarise(tmp_path / "nothing")


def test_names_of_instruments_are_read_back(tmp_path: Path) -> None:
    write_rows(tmp_path, "001", np.zeros(3))
    write_rows(tmp_path, "north%2Fupper", np.zeros(3))
    assert [one.instrument for one in summarise(tmp_path).instruments] == ["001", "north/upper"]


# ------------------------------------------------------------------------ command and report


def run(*arguments: str) -> Any:
    from rasnik.cli import app

    return CliRunner().invoke(app, ["archive", "summary", *arguments], catch_exceptions=False)


def test_command_helps() -> None:
    result = run("--help")
    assert result.exit_code == 0 and "Resolution, drift" in result.output


def test_command_writes_a_report_with_pictures(tmp_path: Path, rng: np.random.Generator) -> None:
    from PIL import Image

    system = load_system("solidras", ["sensor.width_px=200", "sensor.height_px=160"])
    files = []
    for k, (frame, _) in enumerate(simulate(system, n=2, seed=4)):
        files.append(str(tmp_path / f"{k}.png"))
        Image.fromarray(np.asarray(frame)).save(files[-1])
    x = 1e-3 * rng.normal(size=60)
    x[30] += 1.0
    x[40] = np.nan
    names = [f"/gone/{k}.png" for k in range(60)]
    names[30], names[20] = files
    chi2 = np.where(np.isfinite(x), 1.0, np.nan)
    chi2[20] = 9.0
    data = tmp_path / "data"
    write_rows(data, "A<b>", x, file=names, chi2_ndf=chi2, toml=system.to_toml())
    result = run(str(data), "-o", str(tmp_path / "report"))
    assert result.exit_code == 0
    assert "60 images, 59 with a position; without: 1 no_mask" in result.output
    page = (tmp_path / "report" / "summary.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 3  # overview and two overlays
    assert (tmp_path / "report" / "overview.png").read_bytes().startswith(b"\x89PNG")
    assert "A&lt;b&gt;" in page and "A<b>" not in page
    assert "no such file" in page  # of the failure, which is gone
    assert "http" not in page.replace("http-equiv", "")
    with (tmp_path / "report" / "instruments.csv").open(encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert row["instrument"] == "A<b>" and row["images"] == "60" and row["failed"] == "no_mask:1"
    assert float(row["resolution_x_nm"]) == pytest.approx(1.0, rel=0.4)


def test_names_that_no_font_or_formula_knows_are_drawn(tmp_path: Path) -> None:
    for name in (r"a$\nothing$", "\u6e2c"):
        write_rows(tmp_path, name, np.zeros(5))
    assert run(str(tmp_path), "-o", str(tmp_path / "report")).exit_code == 0
    page = (tmp_path / "report" / "summary.html").read_text(encoding="utf-8")
    assert r"<td>a$\nothing$</td>" in page and "<td>\u6e2c</td>" in page


def test_command_prints_json(tmp_path: Path) -> None:
    write_rows(tmp_path, "A[red]", np.zeros(5))
    assert "A[red]" in run(str(tmp_path)).output
    result = run(str(tmp_path), "--json")
    assert result.exit_code == 0
    document = json.loads(result.output)
    (one,) = document["instruments"]
    assert one["images"] == 5 and one["resolution_nm"]["x"] is None
    assert one["drift_um_per_day"]["x"]["slope"] is None
    assert document["worst"] == [] and document["faults"] == []


def test_command_tells_of_damaged_parts(tmp_path: Path) -> None:
    write_rows(tmp_path, "A", np.zeros(5))
    write_rows(tmp_path, "A", np.zeros(5), name="part-1").write_text("damaged")
    result = run(str(tmp_path))
    assert result.exit_code == 1
    assert "a part cannot be read" in result.output and "part-1.parquet" in result.output


def test_command_refuses_what_is_no_dataset(tmp_path: Path) -> None:
    result = run(str(tmp_path))
    assert result.exit_code == 2
