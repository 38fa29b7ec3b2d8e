"""Design: optima, scaling laws, couplings, and every way of asking wrongly."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from rasnik.cli import app
from rasnik.instrument import System, SystemConfigError, load_system
from rasnik.performance import improvements as table
from rasnik.performance.bound import bound
from rasnik.performance.coupling import Coupling, coupled, image_cone, notes
from rasnik.performance.design import Curve, best_field, explore, parse_variation

SOLIDRAS = load_system("solidras")
SMALL = load_system("solidras", ["sensor.width_px=240", "sensor.height_px=180"])


def curve(system: System, text: str, **options: object) -> Curve:
    variation = parse_variation(text)
    return explore(system, [variation], **options).curve(variation)  # type: ignore[arg-type]


# ------------------------------------------------------------------------ what is varied


def test_variations_are_read() -> None:
    even = parse_variation("optics.blur_um=4:6:5")
    assert even.values == pytest.approx((4, 4.5, 5, 5.5, 6)) and not even.logarithmic
    ratio = parse_variation("mask.field_um = 20:200:3")
    assert ratio.values == pytest.approx((20, math.sqrt(4000), 200)) and ratio.logarithmic
    assert parse_variation("sensor.binning=4,1,2").values == (1, 2, 4)
    assert parse_variation("sensor.width_px=100:103:7").values == (100, 101, 102, 103)


@pytest.mark.parametrize(
    "text",
    ["mask.field_um", "=1:2", "a.b=", "a.b=x:y", "a.b=1:2:3:4", "a.b=2:1", "a.b=1:2:1",
     "a.b=1:2:2.5", "a.b=nan:2", "a.b=1:inf", "a.b=1:2:1e9", "a.b=1,,2", "a.b=nan"],
)  # fmt: skip
def test_malformed_variations_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="--vary"):
        parse_variation(text)


# ------------------------------------------------------------------------------- optima


def test_field_size_has_an_optimum_between_contour_and_contrast() -> None:
    # finer pixels than SolidRas's, so that the optimum is not at their limit
    found = curve(load_system(SMALL, {"optics.blur_um": 8.0}), "mask.field_um=18:200:13")
    assert 22 < found.optimum < 45
    assert found.best < 0.8 * min(found.figure[0], found.figure[-1])
    assert found.wide[0] <= found.optimum <= found.wide[1]
    area = 240 * 180 * 6.9**2
    assert found.contour_mm[0] == pytest.approx(1e-3 * area / 18)
    assert np.all(np.diff(found.contour_mm) < 0) and np.all(np.diff(found.contrast) > 0)
    best = best_field(load_system(SMALL, {"optics.blur_um": 8.0}))
    assert best.mask.field_um == pytest.approx(found.optimum, rel=0.15)


def test_noise_falls_as_the_root_of_area_and_of_rate() -> None:
    assert curve(SMALL, "sensor.area_mm2=2:10:4").exponent == pytest.approx(-0.5, abs=0.03)
    rate = curve(SMALL, "sensor.frame_rate_hz=100:900:3")
    assert rate.exponent == pytest.approx(-0.5, abs=1e-6)
    # at constant light nothing is gained but losses: fewer electrons in every image
    flux = curve(SMALL, "sensor.frame_rate_hz=275:900:3", rules=Coupling(light="flux"))
    assert -0.05 < flux.exponent < 0.25


def test_pixels_should_be_smaller_than_twice_the_blur() -> None:
    # the paper's rule of thumb; without electronic noise and rounding there is no lower limit,
    # and the error of a Gaussian edge grows as the root of its width, pixel included
    quiet = load_system(SMALL, {"sensor.noise_a": 0.0})
    found = curve(quiet, "sensor.pixel_um=3,4.5,9,13.5,18", rounding=False)
    width = np.sqrt(4.5**2 + np.array(found.variation.values) ** 2 / 12)
    assert found.figure / found.figure[0] == pytest.approx(np.sqrt(width / width[0]), rel=0.06)
    assert found.figure[2] < 1.1 * found.figure[0]


def test_the_exponent_of_the_wavelength() -> None:
    # limited by the pixel at fixed fields; proportional to the wavelength with best fields and
    # pixels so small that everything scales
    fixed = curve(SMALL, "optics.wavelength_nm=300:600:3")
    best = curve(SMALL, "optics.wavelength_nm=300:600:3", best_fields=True)
    assert 0.25 < fixed.exponent < 0.55
    assert fixed.exponent + 0.15 < best.exponent < 1.0
    assert best.field_um[0] < best.field_um[-1]


def test_map() -> None:
    a, b = parse_variation("mask.field_um=40:80:3"), parse_variation("optics.blur_um=3,6")
    design = explore(SMALL, [a, b])
    figure = design.map(a, b)
    assert figure.shape == (2, 3)
    assert np.all(figure[1] > figure[0]) and np.all(np.diff(figure, axis=1) > 0)


# ---------------------------------------------------------------------------- couplings


def test_diffraction() -> None:
    blur = SOLIDRAS.optics.blur_um
    uv = coupled(SOLIDRAS, {"optics.wavelength_nm": 224.0})
    assert uv.optics.blur_um == pytest.approx(blur / 2)
    wide = coupled(SOLIDRAS, {"optics.diaphragm_mm": 8.0})
    assert wide.optics.blur_um == pytest.approx(blur / 2)
    far = coupled(SOLIDRAS, {"optics.scale": 3.0})  # b = f (1 + S) doubles
    assert far.optics.blur_um == pytest.approx(2 * blur)
    assert far.geometry.lens_sensor_mm == pytest.approx(120)
    assert far.geometry.mask_lens_mm == pytest.approx(40)
    microras = load_system("microras")
    assert image_cone(microras) == pytest.approx(2 * 0.4 / 20)
    assert image_cone(SOLIDRAS) == pytest.approx(4 / 60)
    both = coupled(microras, {"optics.scale": 40.0, "optics.numerical_aperture": 0.8})
    assert both.optics.blur_um == pytest.approx(microras.optics.blur_um)
    fixed = coupled(SOLIDRAS, {"optics.wavelength_nm": 224.0}, Coupling(blur="fixed"))
    assert fixed.optics.blur_um == blur
    given = coupled(SOLIDRAS, {"optics.wavelength_nm": 224.0, "optics.blur_um": 3.0})
    assert given.optics.blur_um == 3.0


def test_electrons() -> None:
    deep = coupled(SOLIDRAS, {"sensor.full_well_e": 88_000.0})
    assert deep.noise_law == pytest.approx((0.26 / 16, 0.011 / 4))
    bits = coupled(SOLIDRAS, {"sensor.bit_depth": 12})
    ratio = 4095 / 255
    assert bits.noise_law == pytest.approx((0.26 * ratio**2, 0.011 * ratio))
    assert bits.sensor.light_level == pytest.approx(252 * ratio)
    assert bound(bits).sigma_x_nm == pytest.approx(bound(SOLIDRAS).sigma_x_nm, rel=1e-5)
    large = coupled(SOLIDRAS, {"sensor.pixel_um": 13.8})
    assert large.shape == (270, 360)
    assert large.sensor.full_well_e == 88_000
    assert large.noise_law == pytest.approx((0.26 / 16, 0.011 / 4))
    same = coupled(SOLIDRAS, {"sensor.pixel_um": 13.8}, Coupling(well="pixel", pixels="count"))
    assert same.shape == SOLIDRAS.shape and same.noise_law == SOLIDRAS.noise_law


def test_what_a_rule_needs_must_be_known() -> None:
    atlas = load_system("atlas-ccd")
    for change, words in (
        ({"optics.wavelength_nm": 300.0}, "wavelength is not known"),
        ({"optics.numerical_aperture": 0.1}, "aperture is not known"),
        ({"sensor.full_well_e": 1e5}, "full well is not known"),
        ({"sensor.frame_rate_hz": 30.0}, "frame rate is not known"),
    ):
        with pytest.raises(SystemConfigError, match=words):
            coupled(atlas, change)
    assert "aperture is not known" in notes(atlas, ["optics.scale"], Coupling())[0]


# -------------------------------------------------------------------------- improvements


def test_improvements_of_the_paper(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = table._steps()
    assert {step.factor for step in steps} >= {3.0, 2.0, 1.7, 7.0, 35.0}
    quick = [s for s in steps if not s.best] + [s for s in steps if "NA 0.40" in s.step]
    monkeypatch.setattr(table, "_steps", lambda: quick)
    rows = {row.step: row for row in table.improvements()}
    half = rows["SolidRas: half the light"]
    assert 0.60 < half.bound_factor < 1 / math.sqrt(2)  # electronic noise and rounding count
    rate = rows["MicroRas: 275 -> 860 Hz, same sensor"]
    assert rate.bound_factor == pytest.approx(math.sqrt(860 / 275))
    # twice the magnification with the same aperture is only a larger, more blurred image
    larger = rows["MicroRas: 20x -> 40x, same NA 0.40"]
    assert larger.bound_factor == pytest.approx(1, abs=0.1)
    assert larger.bound_factor_best == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("name", ["uv", "40x", "860hz", "200nm", "offshelf", "ultimate"])
def test_steps_as_systems_agree_with_the_coupling(name: str) -> None:
    step, microras = load_system(f"microras-{name}"), load_system("microras")
    optics = step.optics
    changes = {
        "optics.wavelength_nm": optics.wavelength_nm,
        "optics.numerical_aperture": optics.numerical_aperture,
        "optics.scale": optics.scale,
    }
    assert optics.blur_um == pytest.approx(coupled(microras, changes).optics.blur_um, rel=1e-3)
    assert bound(step).sigma_nm * 275**0.5 < 1.2 * bound(microras).sigma_nm * 275**0.5


# -------------------------------------------------------------------------------- command


def test_command_draws_and_tabulates(tmp_path: Path) -> None:
    plot = tmp_path / "curve.png"
    small = ["design", "solidras", "--set", "sensor.width_px=240", "--set", "sensor.height_px=180"]
    result = CliRunner().invoke(app, [*small, "--vary", "mask.field_um=15:100:5", "-o", str(plot)])
    assert result.exit_code == 0, result.output
    for words in ("best: sigma_x_nm", "contrast", "left out: 1 point"):
        assert words in result.output
    with Image.open(plot) as image:
        assert np.asarray(image.convert("L")).std() > 10
    pair = ["--vary", "mask.field_um=30,60", "--vary", "optics.blur_um=3,6", "--json"]
    result = CliRunner().invoke(app, [*small, *pair, "-o", str(plot)])
    document = json.loads(result.output)
    assert np.shape(document["values"]) == (2, 2)
    assert document["optimum"] == {"mask.field_um": 30, "optics.blur_um": 3}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["solidras"], "--vary is needed"),
        (["--vary", "mask.field_um=20:30"], "which system?"),
        (["solidras", "--vary", "mask.feld_um=20:30"], "did you mean mask.field_um"),
        (["solidras", "--vary", "mask.field_um=1:5"], "covers 0.145 pixels"),
        (["solidras", "--vary", "mask.field_um=-5:5"], "mask.field_um = -5"),
        (["solidras", "--vary", "sensor.light_factor=-1:1"], "must be a positive number"),
        (["solidras", "--vary", "optics.blur_um=1:2", "--figure", "x"], "figure must be one of"),
        (["solidras", "--vary", "optics.blur_um=1:2", "--well", "x"], "--well must be area or"),
        (["solidras", "--vary", "mask.field_um=20:30", "--best-fields"], "cannot be the best one"),
        (["solidras", "--improvements"], "a table of its own"),
        (["atlas-ccd", "--vary", "mask.field_um=80:90", "--figure", "asd_x_pm_rthz"], "frame rate"),
    ],
)
def test_bad_input_is_refused_in_a_sentence(options: list[str], words: str) -> None:
    result = CliRunner().invoke(app, ["design", *options])
    assert result.exit_code == 2
    assert words in result.output
