"""The bound: the paper's instrument, closed forms, and the scatter of the fit itself."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from rasnik import analyse
from rasnik.cli import app
from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.noise import ReadOut
from rasnik.imaging.projection import Projection
from rasnik.instrument import load_system
from rasnik.performance.bound import (
    bound,
    noise_of,
    pose_information,
    positions,
    reference_pose,
    state_at,
)
from rasnik.performance.coupling import coupled
from rasnik.performance.light import light_of
from rasnik.performance.soap import fourier_noise

SOLIDRAS = load_system("solidras")
SMALL = load_system("solidras", ["sensor.width_px=240", "sensor.height_px=180"])


def test_solidras_at_the_position_of_the_paper() -> None:
    plain, rounded = bound(SOLIDRAS), bound(SOLIDRAS, rounding=True)
    assert plain.poses[0].x_um == pytest.approx(4000) and plain.poses[0].y_um == pytest.approx(5000)
    for sigma in (plain.sigma_x_nm, plain.sigma_y_nm):
        assert sigma == pytest.approx(0.38, rel=0.02)
    for sigma in (rounded.sigma_x_nm, rounded.sigma_y_nm):
        assert sigma == pytest.approx(0.39, rel=0.02)
    assert plain.sigma_theta_rad == pytest.approx(0.21e-6, rel=0.02)


@pytest.mark.parametrize("binning", [1, 2])
def test_the_fit_scatters_as_the_bound_says(binning: int, rng) -> None:
    system = load_system(SMALL, {"sensor.binning": binning})
    pose = (12_345.0, 23_456.0, 0.01)
    least = bound(system, pose, rounding=True)
    projection = least.poses[0]
    readout = ReadOut(exact_image(system, projection), system)
    found = []
    for _ in range(150):
        image = readout.frame(rng)
        result = analyse(image, system, model="similarity", orientation=4)
        assert result.ok
        found.append([result.x_um, result.y_um, result.scale, result.theta_rad])
    ratio = np.std(found, axis=0) / np.sqrt(np.diag(least.covariance))
    # the two coordinates together: known to 4 %; all four: to 3 %
    assert math.hypot(*ratio[:2]) / math.sqrt(2) == pytest.approx(1, abs=0.1)
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1, abs=0.1)


def test_the_fourier_method_scatters_as_its_noise_says(rng) -> None:
    projection = positions(SMALL, (12_345.0, 23_456.0, 0.01))[0]
    predicted = fourier_noise(SMALL, projection)
    readout = ReadOut(exact_image(SMALL, projection), SMALL)
    poses = [analyse(readout.frame(rng), SMALL, method="fourier") for _ in range(150)]
    scatter = np.std([[p.x_um, p.y_um] for p in poses], axis=0) * 1e3
    assert math.hypot(*scatter) / math.sqrt(2) == pytest.approx(predicted.harmonics_nm, rel=0.12)
    assert predicted.primary_nm > 1.2 * predicted.harmonics_nm
    assert predicted.harmonics_nm > 1.2 * bound(SMALL).sigma_nm


def test_information_of_one_straight_edge() -> None:
    # small pixels, constant noise: information = length * step^2 / (A p^2 2 sqrt(pi) blur)
    system = load_system(
        SOLIDRAS,
        {
            "mask.field_um": 1000.0,
            "optics.blur_um": 6.0,
            "sensor.pixel_um": 2.0,
            "sensor.width_px": 400,
            "sensor.height_px": 300,
            "sensor.noise_a": 1.0,
            "sensor.noise_b": 0.0,
        },
    )
    # in the middle of the contour between fields 2 and 3 of row 1, which are not coded
    state = state_at(system, Projection.from_pose(3000.0, 1500.0, 1.0, 0.0, 4))
    information = pose_information(system, state, noise_of(system, False))
    smear = math.sqrt(6.0**2 + 2.0**2 / 12)
    expected = 600.0 * 227.0**2 / (1.0 * 2.0**2 * 2 * math.sqrt(math.pi) * smear)
    assert information[0, 0] == pytest.approx(expected, rel=2e-3)
    assert information[1, 1] < 1e-6 * expected  # no contour along y in view


def test_shot_noise_alone_grows_as_one_over_root_light() -> None:
    system = load_system(SMALL, {"sensor.noise_a": 0.0})
    half = coupled(system, {"sensor.light_factor": 0.5})
    assert bound(half).sigma_nm / bound(system).sigma_nm == pytest.approx(math.sqrt(2), rel=1e-4)


def test_twice_the_view_halves_the_variance() -> None:
    area = [bound(SOLIDRAS, count=1).sigma_nm]
    large = load_system(SOLIDRAS, {"sensor.width_px": 1440})
    area.append(bound(large, count=1).sigma_nm)
    assert area[0] / area[1] == pytest.approx(math.sqrt(2), rel=0.03)


def test_not_knowing_the_light_costs_next_to_nothing() -> None:
    found = bound(SMALL)
    cost = np.diag(found.covariance) / np.diag(found.covariance_known)
    assert (cost >= 1 - 1e-9).all() and (cost < 1.01).all()


def test_magnification_refers_to_the_mask() -> None:
    figures = bound(load_system("microras")).figures()
    assert figures["image_sigma_x_nm"] == pytest.approx(20 * figures["sigma_x_nm"])
    assert figures["floor_x_pm_rthz"] == pytest.approx(1e3 * figures["sigma_x_nm"] / 275**0.5)
    assert figures["asd_x_pm_rthz"] == pytest.approx(2**0.5 * figures["floor_x_pm_rthz"])
    # on the sensor the same fields are seen with a wider blur: worse than SolidRas there
    assert figures["image_sigma_x_nm"] > bound(SOLIDRAS).sigma_x_nm


def test_no_rate_no_noise_floor() -> None:
    figures = bound(load_system("atlas-ccd")).figures()
    assert figures["asd_x_pm_rthz"] is None and figures["floor_y_pm_rthz"] is None


def test_random_places_are_seeded_and_average() -> None:
    one, again = bound(SMALL, count=3, seed=5), bound(SMALL, count=3, seed=5)
    assert one.sigma_x_nm == again.sigma_x_nm and len(one.poses) == 3
    each = [bound(SMALL, (p.x_um, p.y_um)).covariance[0, 0] for p in one.poses]
    assert one.covariance[0, 0] == pytest.approx(np.mean(each))


def test_reference_pose_stays_on_the_mask() -> None:
    assert reference_pose(load_system("microras")) == pytest.approx((200.0, 250.0))
    wide = load_system("solidras", ["mask.field_um=30"])
    x, y = reference_pose(wide)
    half = math.hypot(720, 540) * 6.9 / 2
    assert min(x, y) > half
    assert (x / 30 - 4000 / 85) % 144 == pytest.approx(0, abs=1e-9)
    tiny = load_system("solidras", ["mask.columns=3", "mask.rows=2"])
    assert reference_pose(tiny) == pytest.approx((1.5 * 9 * 85, 9 * 85))


def test_light_of_solidras() -> None:
    light = light_of(SOLIDRAS)
    assert light.electrons_white == pytest.approx(252 / 0.011)
    assert light.full_well_use == pytest.approx(252 / 0.011 / 22000)
    assert light.full_well_consistency == pytest.approx(255 / 0.011 / 22000)
    electrons = (25 + 252) / 2 / 0.011 * 720 * 540 * 275
    assert light.electrons_per_second == pytest.approx(electrons)
    assert light.power_uw == pytest.approx(1e6 * electrons * 1.98644586e-25 / 448e-9, rel=1e-6)
    weak = light_of(load_system(SOLIDRAS, {"sensor.quantum_efficiency": 0.5}))
    assert weak.power_uw == pytest.approx(2 * light.power_uw)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("mask.field_um=15", "covers 2.17 pixels"),
        ("optics.blur_um=200", "cannot be seen through a blur of 200 um"),
        ("optics.blur_um=-1", "greater than or equal to 0"),
        ("mask.field_um=1e9", "less than or equal"),
        ("sensor.pixl_um=7", "did you mean sensor.pixel_um"),
        ("mask.field_um=9000", "the view holds too few contours"),
        ("sensor.noise_a=none", "noise_a and noise_b go together"),
    ],
)
def test_bad_systems_are_refused_in_a_sentence(change: str, words: str) -> None:
    result = CliRunner().invoke(app, ["predict", "solidras", "--set", change])
    assert result.exit_code == 2
    assert words in result.output


def test_unknown_noise_and_no_noise_are_refused() -> None:
    unknown = load_system("solidras", {"sensor.noise_a": None, "sensor.noise_b": None})
    with pytest.raises(ValueError, match=r"give sensor\.noise_a"):
        bound(unknown)
    silent = load_system("solidras", {"sensor.noise_a": 0.0, "sensor.noise_b": 0.0})
    with pytest.raises(ValueError, match="no noise in black fields"):
        bound(silent)
    assert bound(silent, rounding=True).sigma_x_nm > 0


def test_predict_as_json() -> None:
    result = CliRunner().invoke(app, ["predict", "solidras", "--json"])
    assert result.exit_code == 0
    figures = json.loads(result.output)
    assert figures["sigma_x_nm"] == pytest.approx(0.38, rel=0.02)
    assert figures["sigma_y_nm"] == pytest.approx(0.38, rel=0.02)
    assert figures["rounded_sigma_x_nm"] == pytest.approx(0.39, rel=0.02)
    assert figures["plane"] == "mask" and figures["rounding_counted"] is False
    expected = {"sigma_theta_rad", "sigma_scale", "asd_x_pm_rthz", "asd_y_pm_rthz"}
    assert expected | {"asd_theta_rad_rthz", "floor_x_pm_rthz", "power_uw"} <= set(figures)


def test_predict_in_words() -> None:
    result = CliRunner().invoke(app, ["predict", "microras", "--average", "2"])
    assert result.exit_code == 0
    for words in ("referred to the mask", "mean of 2 places", "20 times as far", "with rounding"):
        assert words in result.output
    both = CliRunner().invoke(app, ["predict", "microras", "--average", "2", "--pose", "200,250"])
    assert both.exit_code == 2
