"""The budget: sources against closed forms, and the linear estimator against the fit."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from rasnik import analyse
from rasnik.cli import app
from rasnik.imaging.montecarlo import exact_image
from rasnik.instrument import SystemConfigError, load_system
from rasnik.performance.assumptions import Assumptions, assume
from rasnik.performance.bound import bound
from rasnik.performance.budget import Budget, Contribution, budget
from rasnik.performance.estimator import estimator

SMALL = load_system("solidras", ["sensor.width_px=240", "sensor.height_px=180"])


def row(found: Budget, source: str) -> Contribution:
    return next(one for one in found.contributions if one.source == source)


@pytest.fixture(scope="module")
def small() -> Budget:
    return budget(SMALL)


def test_white_noise_adds_up_to_the_bound(small: Budget) -> None:
    parts = [row(small, s) for s in ("shot noise", "electronic noise", "rounding to grey levels")]
    total = math.sqrt(sum(one.x_nm**2 for one in parts))
    assert total == pytest.approx(small.bound.sigma_x_nm, rel=0.03)  # mean of four places
    assert all(one.kind == "random" and one.time == "white" for one in parts)


def test_the_estimator_is_that_of_the_bound() -> None:
    least = bound(SMALL, (12_000.0, 13_000.0, 0.01), rounding=True)
    found = estimator(SMALL, least.poses[0])
    a, b = found.noise
    x, y = found.random_nm(np.sqrt(a + b * found.expected))
    assert (x, y) == pytest.approx((least.sigma_x_nm, least.sigma_y_nm), rel=5e-3)


def test_the_estimator_sees_displacement_and_not_light_or_blur() -> None:
    least = bound(SMALL, (12_000.0, 13_000.0, 0.01))
    found = estimator(SMALL, least.poses[0])
    du, dv = 0.003, -0.002
    expected = -1e3 * least.poses[0].jacobian @ [du, dv]
    ones = np.ones(SMALL.shape)
    assert found.displaced_nm(du * ones, dv * ones) == pytest.approx(tuple(expected), rel=1e-4)
    for change in (found.white, 1 - found.white, found.by_blur):
        assert found.shift_nm(change) == pytest.approx((0, 0), abs=1e-3)


def test_pixel_gains_move_the_fit_as_predicted(rng) -> None:
    least = bound(SMALL, (12_000.0, 13_000.0, 0.01))
    found = estimator(SMALL, least.poses[0])
    image = exact_image(SMALL, least.poses[0])
    gains = 0.01 * rng.standard_normal(image.shape)
    start = analyse(image, SMALL, model="similarity", orientation=4)
    moved = analyse(image * (1 + gains), SMALL, model="similarity", orientation=4)
    shift = 1e3 * np.array([moved.x_um - start.x_um, moved.y_um - start.y_um])
    assert shift == pytest.approx(np.array(found.shift_nm(gains * image)), abs=0.04)
    sigma = np.array(found.random_nm(0.01 * image))
    assert np.all(np.abs(shift) < 4 * sigma) and np.abs(shift).max() > 0.1 * sigma.max()


def test_mask_edges_as_in_the_paper() -> None:
    found = budget(SMALL, assume(["mask_edge_samples=15000"]))
    assert row(found, "mask edges").x_nm == pytest.approx(0.050, rel=0.03)
    full = load_system("solidras")
    samples = 720 * 6.9 / 85 * 540
    edges = row(budget(full), "mask edges")
    assert edges.x_nm == pytest.approx(6 / math.sqrt(samples))


def test_shot_noise_is_sqrt_2_larger_at_half_light() -> None:
    system = load_system(SMALL, {"sensor.noise_a": 0.0})
    dim = load_system(system, {"sensor.dark_level": 12.5, "sensor.light_level": 126.0})
    pair = [row(budget(one), "shot noise").x_nm for one in (system, dim)]
    # weights hold the rounding, which is the same in both
    assert pair[1] / pair[0] == pytest.approx(math.sqrt(2), rel=0.01)


def test_air(small: Budget) -> None:
    steady = row(small, "air: steady gradient").x_nm
    assert steady == pytest.approx(9.3e-7 * 0.06 * 0.12 / 2 * 1e9, rel=0.01)
    distances = {"geometry.mask_lens_mm": 120.0, "geometry.lens_sensor_mm": 120.0}
    longer = budget(load_system(SMALL, distances))
    assert row(longer, "air: steady gradient").x_nm == pytest.approx(4 * steady)
    vacuum = budget(SMALL, assume(["air_pressure_hpa=0"]))
    assert row(vacuum, "air: turbulence").x_nm == 0
    unknown = load_system(SMALL, {"geometry.mask_lens_mm": None, "geometry.lens_sensor_mm": None})
    assert row(budget(unknown), "air: turbulence").x_nm is None


def test_what_scales_with_its_parameter(small: Budget) -> None:
    double = {
        name: 2 * getattr(Assumptions(), name)
        for name in ("gain_spread", "pedestal_grey", "flicker", "column_place_nm", "distortion",
                     "pixel_place_nm", "light_third_order", "mask_temperature_k", "arm_mm")
    }  # fmt: skip
    found = budget(SMALL, Assumptions(**double))
    for source in ("pixel gain spread", "pixel pedestal spread", "pixel flicker (1/f)",
                   "row and column geometry", "pixel geometry", "distortion, periodic",
                   "distortion, offset", "uneven light", "mask temperature",
                   "suspension, arms"):  # fmt: skip
        assert row(found, source).x_nm == pytest.approx(2 * row(small, source).x_nm, rel=1e-3)


def test_what_does_not_move_the_position(small: Budget) -> None:
    for source in ("sensor expansion", "black fields too large", "defocus, lens temperature"):
        assert row(small, source).x_nm == row(small, source).y_nm == 0
    assert "2.6e-06" in row(small, "sensor expansion").formula


def test_totals(small: Budget) -> None:
    fixed = [one for one in small.contributions if one.time == "fixed"]
    assert small.total_nm("fixed")[1] == pytest.approx(math.hypot(*(one.y_nm for one in fixed)))
    assert small.total_nm("white")[0] > small.bound.sigma_x_nm * 0.97


def test_unknown_and_absurd_assumptions() -> None:
    with pytest.raises(SystemConfigError, match="did you mean mask_edge_nm"):
        assume(["mask_edg_nm=3"])
    with pytest.raises(SystemConfigError, match="greater than or equal to 0"):
        assume(["mask_edge_nm=-3"])


def test_command(tmp_path: Path) -> None:
    plot = tmp_path / "budget.png"
    small = ["--set", "sensor.width_px=240", "--set", "sensor.height_px=180"]
    result = CliRunner().invoke(app, ["budget", "solidras", *small, "-o", str(plot)])
    assert result.exit_code == 0, result.output
    assert "mask edges" in result.output and "3.1 light through air" in result.output
    with Image.open(plot) as image:
        assert min(image.size) > 500
        assert np.asarray(image.convert("L")).std() > 20
    as_json = CliRunner().invoke(app, ["budget", "solidras", *small, "--json"])
    document = json.loads(as_json.output)
    assert {one["time"] for one in document["contributions"]} == {"white", "slow", "fixed"}
    for options in (["--assume", "x=1"], ["--pose", "1e9,0"], ["-o", str(tmp_path / "b.xyz")]):
        assert CliRunner().invoke(app, ["budget", "solidras", *small, *options]).exit_code == 2
