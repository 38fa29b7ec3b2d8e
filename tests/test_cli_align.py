"""The command ``rasnik align`` and its drawing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from rasnik.cli import app
from rasnik.geometry.adjustment import adjust
from rasnik.geometry.installation import load_installation
from rasnik.geometry.network import Network
from rasnik.geometry.observations import Readings, write_readings
from rasnik.report.installation import installation_figure

RUNNER = CliRunner()


def run(*arguments: str, status: int = 0) -> str:
    result = RUNNER.invoke(app, ["align", *arguments])
    assert result.exit_code == status, result.output
    return " ".join(result.output.split())


@pytest.fixture(scope="module")
def linked() -> Network:
    return Network(load_installation("atlas-tower-linked"))


@pytest.fixture
def moved(linked: Network, tmp_path: Path, rng: np.random.Generator) -> tuple[Path, Path]:
    """Readings before and after the outer chamber moved by 500 um along x, without noise."""
    offsets = rng.normal(size=linked.nominal.shape) * [300, 300, 1e-6, 1e-3]
    motions = np.zeros((3, 6))
    motions[2, 0] = 500.0
    write_readings(linked, linked.nominal + offsets, tmp_path / "before.csv")
    write_readings(linked, linked.values(motions) + offsets, tmp_path / "after.csv")
    return tmp_path / "before.csv", tmp_path / "after.csv"


def test_help() -> None:
    text = run("--help")
    assert "--reference" in text and "Examples" in text


def test_what_an_installation_can_measure() -> None:
    text = run("atlas-tower", status=1)
    assert "no readings: what one reading of each Rasnik would tell" in text
    assert "middle unmeasured unmeasured unmeasured ± 0.048" in text
    assert "unmeasured: middle and outer: shear, along x in proportion" in text
    assert "sagitta centre: x ± 0.16 µm, y ± 0.21 µm" in text
    assert "an error of x is named with 80 % chance from 5.38 µm on" in text
    assert "unmeasured" not in run("atlas-tower-linked")


def test_motion_since_a_reference(moved: tuple[Path, Path]) -> None:
    before, after = moved
    text = run("atlas-tower-linked", str(after), "--reference", str(before))
    assert "inner held held" in text
    assert "outer 500.0 ± 1.4" in text
    assert "sagitta centre: x -250.00 ± 0.29 µm" in text
    assert "chi2 0.0 for 36 degrees of freedom, probability 1" in text


def test_json(moved: tuple[Path, Path]) -> None:
    before, after = moved
    arguments = ["atlas-tower-linked", str(after), "--reference", str(before), "--json"]
    document = json.loads(RUNNER.invoke(app, ["align", *arguments]).stdout)
    outer = document["bodies"]["outer"]["x_um"]
    assert outer["value"] == pytest.approx(500, rel=1e-6) and outer["state"] == "measured"
    document = json.loads(RUNNER.invoke(app, ["align", "atlas-tower", "--json"]).stdout)
    assert document["bodies"]["outer"]["x_um"]["value"] is None
    assert document["bodies"]["outer"]["x_um"]["state"] == "unmeasured"


def test_wrong_and_missing_readings_are_named(
    linked: Network, tmp_path: Path, moved: tuple[Path, Path]
) -> None:
    values = linked.nominal.copy()
    values[1, 0] += 40.0
    values[5] = np.nan
    write_readings(linked, values, tmp_path / "wrong.csv")
    with (tmp_path / "wrong.csv").open("a") as file:
        file.write("Z9,1,2,3,4\n")
    text = run("atlas-tower-linked", str(tmp_path / "wrong.csv"), status=1)
    assert "wrong: x of A2 by" in text and "not left out" in text
    assert "There is no reading of C2." in text
    assert "Reading 12 is of 'Z9', but there is no such Rasnik in atlas-tower-linked." in text
    text = run("atlas-tower-linked", str(tmp_path / "wrong.csv"), "--reject", "--all", status=1)
    assert "wrong: x of A2 by" in text and "; left out" in text
    assert "probability 1" in text
    assert "theta of A1" in text and "redundancy" in text


def test_the_title_counts_what_was_used(linked: Network) -> None:
    values = linked.nominal.copy()
    values[1, 0] += 40.0
    wrong = Readings(values, np.full_like(values, np.nan))
    for reject, used in ((False, 48), (True, 47)):
        figure = installation_figure(adjust(linked, wrong, reject=reject))
        assert f"motions from {used} values" in figure.get_suptitle()


def test_faulty_rasniks_are_named_and_the_rest_done(tmp_path: Path) -> None:
    text = run("atlas-tower-linked", "--toml")
    assert text.startswith("# A tower like atlas-tower")
    toml = RUNNER.invoke(app, ["align", "atlas-tower-linked", "--toml"]).stdout
    path = tmp_path / "mine.toml"
    path.write_text(toml.replace('sensor = { body = "outer"', 'sensor = { body = "roof"', 1))
    text = run(str(path), status=1)
    assert "3 bodies, 11 Rasniks" in text
    assert "Sensor of rasnik A1: there is no body 'roof'; there are inner, middle, outer." in text


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nothing"], "there is no installation of this name"),
        (["nothing.toml"], "there is no such file"),
        (["atlas-tower", "nothing.csv"], "nothing.csv cannot be read"),
        (["atlas-tower", "nothing.xls"], "readings are .csv, .json, .jsonl or .toml"),
        (["atlas-tower", "--reference", "x.csv"], "--reference needs READINGS"),
        (["atlas-tower", "-o", "x.gif"], "the name must end in .png, .pdf, .svg"),
    ],
)
def test_refusals(arguments: list[str], sentence: str) -> None:
    assert sentence in run(*arguments, status=2)


def test_drawings(moved: tuple[Path, Path], tmp_path: Path) -> None:
    before, after = moved
    plot = tmp_path / "tower.png"
    text = run("atlas-tower-linked", str(after), "--reference", str(before), "--plot", str(plot))
    assert "written:" in text
    with Image.open(plot) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    blue = (np.abs(pixels - (0x2F, 0x6F, 0xB3)).sum(axis=-1) < 30).sum()
    assert blue > 1000  # bodies that have moved, and their motions
    run("atlas-tower", "-o", str(tmp_path / "design.svg"), status=1)
    assert "<!-- unmeasured -->" in (tmp_path / "design.svg").read_text(encoding="utf-8")
