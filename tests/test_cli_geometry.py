"""The command ``rasnik geometry`` and its drawing."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.transforms import Bbox
from PIL import Image
from typer.testing import CliRunner

from rasnik.cli import app
from rasnik.geometry.three_points import ThreePoints
from rasnik.instrument import load_system
from rasnik.performance.bound import bound
from rasnik.report.geometry import geometry_figure

RUNNER = CliRunner()
SMALL = ["solidras", "--set", "sensor.width_px=240", "--set", "sensor.height_px=180"]


def run(*arguments: str) -> str:
    result = RUNNER.invoke(app, ["geometry", *arguments])
    assert result.exit_code == 0, result.output
    return result.output


def refused(*arguments: str) -> str:
    result = RUNNER.invoke(app, ["geometry", *arguments])
    assert result.exit_code == 2
    return " ".join(result.output.split())


def test_help() -> None:
    text = RUNNER.invoke(app, ["geometry", "--help"]).output
    assert "--mask-lens-mm" in text and "Examples" in text


def test_table_of_a_system() -> None:
    text = run(*SMALL)
    assert "mask - lens 60 mm, lens - sensor 60 mm, S = 1" in text
    row = next(line for line in text.splitlines() if line.startswith("lens_x"))
    assert row.split()[1:5] == ["2000", "0", "0", "0"]
    assert "1 µm of lens_x reads as -2 µm of mask_x" in text
    assert "mask_turn_x, mask_turn_y, sensor_turn_x, sensor_turn_y: not seen" in text
    assert "1 K/m along x all the way" in text


def test_resolution_is_the_bound_in_motions() -> None:
    document = json.loads(run(*SMALL, "--json"))
    system = load_system("solidras", [one for one in SMALL if "=" in one])
    covariance = bound(system, rounding=True).covariance
    stated = document["motions"]["lens_z"]["sigma_one_image_um"]
    # S = (b - z) / (a + z) while x, y and theta are known to stand still
    sigma_scale = math.sqrt(1 / np.linalg.inv(covariance)[2, 2])
    assert stated == pytest.approx(sigma_scale * 6e4 / 2, rel=1e-9)
    assert document["motions"]["mask_turn_x"]["sigma_one_image_rad"] is None
    assert document["reads_as"]["sensor_x"] == {"mask_x": pytest.approx(1)}


def test_a_reading_is_inverted() -> None:
    bench = ThreePoints(60.0, 90.0, x_um=100.0, y_um=200.0)
    moved = {"mask_x": 12.0, "mask_y": -5.0, "mask_z": 300.0, "mask_turn_z": 0.01}
    one = bench.read(moved)
    document = json.loads(
        run("--mask-lens-mm", "60", "--lens-sensor-mm", "90", "--reference", "100,200",
            "--reading", f"{one.x_um!r},{one.y_um!r},{one.scale!r},{one.theta_rad!r}",
            "--find", ",".join(moved), "--json")
    )  # fmt: skip
    found = document["displacement"]
    assert found["mask_x_um"] == pytest.approx(12, rel=1e-9)
    assert found["mask_turn_z_rad"] == pytest.approx(0.01, rel=1e-9)
    assert found["sigma_mask_x_um"] is None
    share = one.scale / (1 + one.scale)
    assert document["sagitta_um"][0] == pytest.approx(share * (one.x_um - 100))


def test_a_reading_of_x_and_y_alone() -> None:
    text = run(*SMALL, "--reading", "12.5,-2")
    assert "lens_x         6.25" in text and "lens_z" not in text.split("explained")[1]
    assert "Sagitta of the lens on the line from mask to sensor: x 6.25" in text
    assert "±" in text


def test_motions_that_do_not_explain_a_reading_are_not_its_explanation() -> None:
    asked = [*SMALL, "--find", "lens_x,lens_y", "--reading"]
    result = RUNNER.invoke(app, ["geometry", *asked, "1,2,1.5"])  # the scale has changed by half
    assert result.exit_code == 1
    assert "do not explain the reading" in result.output and "exactly" not in result.output
    text = run(*asked, "1,2,1")
    assert "fitted best by" in text and "1 degree of freedom, probability 1" in text
    document = json.loads(run(*asked, "1,2,1", "--json"))["displacement"]
    assert document["probability"] == pytest.approx(1) and document["ndf"] == 1


def test_air() -> None:
    found = json.loads(run("--mask-lens-mm", "2000", "--lens-sensor-mm", "3000", "--json"))["air"]
    assert found["shift_um"] == pytest.approx(found["index_per_k"] * 2000 * 5000 / 2)
    assert found["equivalent_um"]["lens_x"] == pytest.approx(found["shift_um"] / (1 + 2 / 3))
    vacuum = ("--mask-lens-mm", "60", "--lens-sensor-mm", "60", "--pressure-hpa", "0",
              "--humidity", "0")  # fmt: skip
    assert json.loads(run(*vacuum, "--json"))["air"]["shift_um"] == 0
    text = run("microras-200nm", "--mask-lens-mm", "10")
    assert "Nothing is said of the air" in text and "wavelength_nm = 200" in text


def test_the_drawing(tmp_path: Path) -> None:
    path = tmp_path / "three.png"
    assert "written" in run("--mask-lens-mm", "60", "--lens-sensor-mm", "90", "-o", str(path))
    with Image.open(path) as picture:
        assert picture.size[0] > 900


@pytest.mark.parametrize(
    "instrument",
    [
        ThreePoints(2000.0, 3000.0),
        ThreePoints(10.0, 200.0, orientation=2),
        ThreePoints(400.0, 20.0, pivot_mm=-100.0),
    ],
)
def test_all_that_is_drawn_can_be_seen(instrument: ThreePoints) -> None:
    figure = geometry_figure(instrument)
    figure.canvas.draw()
    for axes in figure.axes:
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        for line in axes.lines:
            x, y = (np.asarray(one, dtype=float) for one in line.get_data())
            assert x.min() >= left and x.max() <= right and y.min() >= low and y.max() <= high
        boxes = []
        for label in axes.get_xticklabels():
            box, lines = label.get_window_extent(), label.get_text().split("\n")
            empty = box.height * lines.count("") / len(lines)  # above the words
            boxes.append(Bbox.from_extents(box.x0, box.y0, box.x1, box.y1 - empty - 1))
        assert not any(one.overlaps(other) for one, other in itertools.pairwise(boxes))
    slope = instrument.matrix(["camera_turn_y"])[0, 0] / 1e3
    assert f"x = {slope:g} mm" in figure.axes[1].get_title()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "Give --mask-lens-mm and --lens-sensor-mm, or a system."),
        (("--mask-lens-mm", "60"), "Give --mask-lens-mm and --lens-sensor-mm, or a system."),
        (("microras",), "does not state its distances: give --mask-lens-mm or --lens-sensor-mm."),
        ((*SMALL, "--kelvin-per-m", "nan"), "--kelvin-per-m = nan is not a finite number"),
        ((*SMALL, "-o", "x.gif"), "the name must end in .png, .pdf, .svg"),
        (
            (
                "--mask-lens-mm",
                "6",
                "--lens-sensor-mm",
                "9",
                "--find",
                "lens_x",
                "--reading",
                "1,2",
            ),
            "--reading has 2 numbers, --find asks for 1: their errors have to weigh them",
        ),
        (("--mask-lens-mm", "-5", "--lens-sensor-mm", "5"), "--mask-lens-mm = -5 must be positive"),
        (("--set", "sensor.binning=2"), "name the system"),
        (("solidras", "--set", "geometry.mask_lens_mm=30.0"), "make a scale of 2"),
        ((*SMALL, "--reading", "1"), "2 to 4 are needed"),
        ((*SMALL, "--reading", "1,2", "--find", "lens_q"), "there is no motion 'lens_q'"),
        (
            (*SMALL, "--reading", "1,2", "--find", "lens_x,mask_x"),
            "cannot tell these motions apart",
        ),
        ((*SMALL, "--reading", "1,2", "--find", "lens_z,lens_x"), "lens_z: not seen in x_um, y_um"),
    ],
)
def test_what_makes_no_sense_is_said(arguments, sentence) -> None:
    assert sentence in refused(*arguments)
