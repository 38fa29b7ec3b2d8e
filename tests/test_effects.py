"""Every source of error against a closed form, a count, or a statistic it must show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import j1, sici

from rasnik import load_system, simulate
from rasnik.analysis.analyse import analyse
from rasnik.imaging.deviations import CoherentLight, Deviations, EdgeErrors
from rasnik.imaging.effects import (
    EFFECTS,
    Chain,
    Context,
    effects_markdown,
    make_effect,
    make_effects,
)
from rasnik.imaging.effects.air import INDEX_PER_KELVIN, bending_um, relaxing_noise
from rasnik.imaging.effects.optics import image_aperture, undistorted
from rasnik.imaging.montecarlo import exact_image, exact_pattern
from rasnik.imaging.projection import Projection
from rasnik.imaging.transfer import AiryTransfer, DiscTransfer, GaussianTransfer
from rasnik.mask import ChessField

SMALL = {"sensor.width_px": 96, "sensor.height_px": 64}
# Large enough to hold a pivot and its code.
CODED = {"sensor.width_px": 240, "sensor.height_px": 180}
POSE = (41000.0, 30200.0, 0.01)


def small(**changes):
    return load_system("solidras", {**SMALL, **changes})


@pytest.fixture(scope="module")
def system():
    return small()


@pytest.fixture(scope="module")
def plain(system):
    return simulate(system, POSE, seed=1).expected(0)


def expected(system, effects, seed=1, pose=POSE, **options):
    return simulate(system, pose, seed=seed, effects=effects, **options).expected(0)


def projection(theta=0.01, x=41000.0, y=30200.0, scale=1.0):
    return Projection.from_pose(x, y, scale, theta, 4)


# -------------------------------------------------------------------------- the table


def test_every_effect_is_complete_and_can_be_switched_on(system, plain):
    for name, info in EFFECTS.items():
        assert info.summary and info.stage and info.reference and info.parameter
        frame = simulate(system, POSE, seed=2, effects=name)[0][0]
        assert frame.shape == (64, 96), name
        assert frame.dtype == np.uint8, name


def test_the_documentation_holds_the_table():
    page = Path(__file__).parents[1] / "docs" / "simulation.md"
    # Made again by: python -c "from rasnik.imaging.effects import *; print(effects_markdown())"
    assert effects_markdown() in page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("effects", "sentence"),
    [
        ({"mask_edge": 6}, "no effect 'mask_edge'; did you mean mask_edges"),
        ({"mask_edges": {"rms": 6}}, "no parameter 'rms', but rms_nm, segments; did you mean"),
        ({"mask_edges": -1}, "mask_edges must be at least 0, not -1"),
        ({"gain_spread": float("nan")}, "must be finite"),
        ("gain_spread=much", "'much' is not a number"),
        (["dust", "dust=3"], "dust is given twice"),
        ({"distortion": -100.0}, "folds the image over"),
        ({"dead_area": 8.0}, "does not fit a 6.9 um pixel"),
    ],
)
def test_what_is_refused(system, effects, sentence):
    with pytest.raises(ValueError, match=sentence):
        simulate(system, POSE, effects=effects).expected(0)


def test_values_of_a_wrong_type():
    with pytest.raises(TypeError, match="rms must be a number"):
        make_effects({"gain_spread": "a"})
    with pytest.raises(TypeError, match="names and values"):
        make_effects(3)


def test_the_ways_to_name_an_effect_agree():
    made = make_effects({"mask_edges": {"rms_nm": 4, "segments": 3}, "dust": True, "stains": False})
    assert made == make_effects(["dust", "mask_edges=4,segments=3"])
    assert (
        made == make_effects([make_effect("dust"), make_effect("mask_edges=4"[:10], 4)])[:0] + made
    )
    assert [e.info.name for e in made] == ["mask_edges", "dust"]
    assert make_effects("rounding=0") == make_effects({"rounding": False})


def test_what_the_system_must_state():
    vague = load_system("solidras", {**SMALL, "optics.diaphragm_mm": None})
    with pytest.raises(ValueError, match="aperture of system solidras is not known"):
        simulate(vague, POSE, effects="diffraction")
    far = load_system("solidras", {**SMALL, "geometry.mask_lens_mm": None})
    with pytest.raises(ValueError, match="give geometry.mask_lens_mm"):
        simulate(far, POSE, effects="air_gradient")


def test_effects_are_seeded(system):
    both = {"gain_spread": 0.02, "mask_edges": 50, "dust": 5}
    np.testing.assert_array_equal(expected(system, both), expected(system, both))
    assert np.abs(expected(system, both) - expected(system, both, seed=2)).max() > 1


# ------------------------------------------------------------------------------- mask


@pytest.mark.parametrize("segments", [1, 6])
def test_mask_errors_move_the_position_by_their_mean(segments):
    # 6 nm over the root of the number of segments in view; with 1.5e4 of them, 50 pm.
    assert 6.0 / np.sqrt(1.5e4) == pytest.approx(0.05, rel=0.03)
    system = small(**CODED)
    plain = analyse(expected(system, None), system, model="similarity", orientation=4)
    in_view = 240 * 180 * (6.9 / 85) ** 2 * segments
    errors = []
    for seed in range(20):
        image = expected(system, {"mask_edges": {"rms_nm": 60, "segments": segments}}, seed=seed)
        found = analyse(image, system, model="similarity", orientation=4, prior=plain)
        errors += [found.x_um - plain.x_um, found.y_um - plain.y_um]
    rms_nm = 1e3 * np.sqrt(np.mean(np.square(errors)))
    # 40 values know their rms to 11 %; sides cut by the edge of the view count in part.
    assert rms_nm == pytest.approx(60.0 / np.sqrt(in_view), rel=3 / np.sqrt(2 * 40))


def test_more_segments_average_better(system, plain):
    def rms(segments):
        effect = {"mask_edges": {"rms_nm": 30.0, "segments": segments}}
        return np.std([expected(system, effect, seed=s) - plain for s in range(6)])

    # A segment of 85/8 um is still as wide as the blur, so less is averaged than 1/sqrt(8).
    assert 1 < rms(1) / rms(8) < np.sqrt(8)


def test_a_displaced_contour_lies_where_it_should():
    # All contours displaced alike is a mask that has moved.
    class Alike(EdgeErrors):
        def vertical_um(self, i, j):
            return np.full(np.broadcast_shapes(i.shape, j.shape), 0.1)

        def horizontal_um(self, i, j):
            return np.full(np.broadcast_shapes(i.shape, j.shape), -0.05)

    mask, blur = ChessField(field_um=85.0), GaussianTransfer(4.5)
    displaced = exact_pattern(mask, projection(), (40, 50), 6.9, blur, edges=Alike(1.0))
    moved = exact_pattern(mask, projection(x=41000.0 - 0.1, y=30200.0 + 0.05), (40, 50), 6.9, blur)
    step = moved - exact_pattern(mask, projection(), (40, 50), 6.9, blur)
    assert np.abs(step).max() > 0.005
    # What is left out: 0.1 x 0.05 um twice at the corners of fields, blurred by optics and pixel.
    corner = 2 * 0.1 * 0.05 / (2 * np.pi * (4.5**2 + 6.9**2 / 12))
    assert np.abs(displaced - moved).max() < corner


def test_mask_errors_belong_to_the_mask(system):
    # The same part of the mask, seen elsewhere on the sensor, has the same errors.
    change = Deviations(edges=EdgeErrors(0.5, seed=3, segments=2))
    here = exact_image(system, projection(0.0), deviations=change)
    there = exact_image(system, projection(0.0, x=41000.0 + 6.9 * 5), deviations=change)
    np.testing.assert_allclose(here[:, :-5], there[:, 5:], atol=1e-4)


def test_contour_errors_are_normal_and_independent():
    edges = EdgeErrors(1.0, seed=5)
    i, j = np.arange(400), np.arange(500)[:, None]
    x, y = edges.vertical_um(i, j), edges.horizontal_um(i, j)
    n = x.size
    assert abs(x.mean()) < 4 / np.sqrt(n) and abs(x.var() - 1) < 4 * np.sqrt(2 / n)
    assert abs((x**4).mean() - 3) < 4 * np.sqrt(96 / n)
    for other in (y, np.roll(x, 1, 0), np.roll(x, 1, 1), EdgeErrors(1.0, 6).vertical_um(i, j)):
        assert abs((x * other).mean()) < 4 / np.sqrt(n)


@pytest.mark.parametrize(
    ("effects", "scale"),
    [
        ({"mask_scale": 200.0}, 1 + 200e-6),
        ({"mask_temperature": 300.0}, 1 + 300 * 0.55e-6),
        ({"mask_temperature": {"kelvin": 100.0, "cte_per_k": 8e-6}}, 1 + 800e-6),
        ({"sensor_temperature": 100.0}, 1 / (1 + 100 * 2.6e-6)),
    ],
)
def test_growth_changes_the_scale_alone(effects, scale):
    system = small(**CODED)
    image = expected(system, effects)
    found = analyse(image, system, model="similarity", orientation=4)
    assert found.scale == pytest.approx(scale, abs=2e-7)
    assert found.x_um == pytest.approx(41000.0, abs=1e-4)
    assert found.y_um == pytest.approx(30200.0, abs=1e-4)
    np.testing.assert_allclose(image, exact_image(system, projection(scale=scale)), atol=0.02)


# -------------------------------------------------------------------------------- air


def test_bending_of_light_by_integrating_the_ray(system):
    # Newton's law of the ray, x'' = g, from the mask through the middle of the lens.
    a, b, gradient = 0.06, 0.06, INDEX_PER_KELVIN * 2.0
    z, dz = np.linspace(0, b, 20001, retstep=True)
    slope = -gradient * b / 2
    behind = slope * b + np.sum(np.diff(z) * (b - z[:-1] - dz / 2)) * gradient
    assert behind == pytest.approx(0, abs=1e-13)
    on_mask = -slope * a + gradient * a**2 / 2
    assert bending_um(system, 2.0) == pytest.approx(on_mask * 1e6, rel=1e-6)
    shift = simulate(system, POSE, effects={"air_gradient": 2.0}).chain.shifts_um
    np.testing.assert_allclose(shift, [[0, on_mask * 1e6]], atol=1e-12)


def test_bending_grows_as_the_square_of_the_distance():
    near, far = (
        small(**{"geometry.mask_lens_mm": d, "geometry.lens_sensor_mm": d}) for d in (60.0, 600.0)
    )
    assert bending_um(far, 1.0) == pytest.approx(100 * bending_um(near, 1.0))


def test_air_moves_the_image_and_not_the_truth(system):
    simulation = simulate(system, POSE, seed=1, effects={"air_gradient": 1e4})
    shift = bending_um(system, 1e4)
    moved = exact_image(system, projection(y=30200.0 + shift))
    np.testing.assert_allclose(simulation.expected(0), moved, atol=1e-6)
    assert simulation.truth[0].y_um == 30200.0


def test_fluctuation_has_its_size_and_relaxation():
    walk = relaxing_noise(40000, 100.0, 0.05, np.random.default_rng(1))
    # One relaxation is 5 frames: 40000 frames hold some 4000 independent values.
    assert walk.var() == pytest.approx(1, abs=4 * np.sqrt(2 / 4000))
    for lag in (1, 5, 10):
        assert (walk[lag:] * walk[:-lag]).mean() == pytest.approx(np.exp(-lag / 5), abs=0.08)


def test_fans_leave_less_bias_and_more_noise(system):
    still = simulate(system, POSE, n=400, seed=1, effects={"air_gradient": 10.0})
    fans = {"air_gradient": 10.0, "fan_mixing": {"left": 0.2, "noise_kelvin_per_m": 1.0}}
    mixed = simulate(system, POSE, n=400, seed=1, effects=fans)
    steady = bending_um(system, 10.0)
    np.testing.assert_allclose(still.chain.shifts_um[:, 1], steady)
    noise = abs(bending_um(system, 1.0))
    # 0.05 s are 14 frames at 275 Hz: 400 frames hold some 14 independent values.
    y = mixed.chain.shifts_um[:, 1]
    assert y.mean() == pytest.approx(0.2 * steady, abs=4 * noise / np.sqrt(14))
    assert y.std() == pytest.approx(noise, rel=0.6)


# ----------------------------------------------------------------------------- optics


def test_distortion_displaces_a_known_point():
    # What stood at r is seen at r (1 + k1 r^2).
    u, v = undistorted(np.array([[1200.0 * 1.000144]]), np.array([[0.0]]), 1e-4)
    assert u[0, 0] == pytest.approx(1200.0, abs=1e-6) and v[0, 0] == 0
    r = 1500.0 * (1 - 0.02 * 1.5**2)
    u, v = undistorted(np.array([[0.6 * r]]), np.array([[0.8 * r]]), -0.02)
    assert (u[0, 0], v[0, 0]) == (pytest.approx(900.0), pytest.approx(1200.0))


def test_distorted_image_shows_the_undistorted_point(system):
    # Every pixel equals the middle pixel of an undistorted view from where it looks.
    image = expected(system, {"distortion": 0.5})
    row, column = 5, 90
    u, v = (column - 47.5) * 6.9, (row - 31.5) * 6.9
    u0, v0 = undistorted(np.array([[u]]), np.array([[v]]), 0.5)
    assert np.hypot(u - u0, v - v0).item() > 1.0
    x, y = projection().to_mask(u0.item(), v0.item())
    pixel = exact_image(system, projection(x=float(x), y=float(y)), shape=(1, 1))
    assert image[row, column] == pytest.approx(pixel.item(), abs=1e-4)


def test_blur_of_a_pixel_is_its_own(system):
    image = expected(system, {"blur_variation": 0.5})
    for row, column in ((0, 0), (32, 48), (10, 80), (63, 40)):
        square = (column - 47.5) ** 2 + (row - 31.5) ** 2
        blur = 4.5 * (1 + 0.5 * square / (47.5**2 + 31.5**2))
        alone = exact_image(system, projection(), transfer=GaussianTransfer(blur))
        assert image[row, column] == pytest.approx(alone[row, column], abs=227e-5)


def test_airy_transfer_in_closed_form():
    optics = AiryTransfer(0.45, 0.05)
    f = np.array([0.0, 0.25, 0.5, 1.0, 2.0]) * optics.cutoff_per_um
    mtf = optics(f, np.zeros_like(f))
    # At half the cutoff 2/3 - sqrt(3)/(2 pi); slope -4/pi at the start.
    np.testing.assert_allclose(
        mtf[[0, 2, 3, 4]], [1, 2 / 3 - np.sqrt(3) / 2 / np.pi, 0, 0], atol=1e-12
    )
    near = optics(np.array([1e-4 * optics.cutoff_per_um]), np.zeros(1))
    assert (1 - near[0]) / 1e-4 == pytest.approx(4 / np.pi, rel=1e-6)


def test_diffraction_has_its_first_dark_ring_at_1_22_wavelength_over_2_na():
    # Point spread as the Hankel transform of the transfer, against (2 J1(z) / z)^2.
    wavelength, aperture = 0.45, 0.05
    optics = AiryTransfer(wavelength, aperture)
    f = np.linspace(0, optics.cutoff_per_um, 4001)
    mtf = optics(f, np.zeros_like(f))
    from scipy.special import j0

    def spread(r):
        return np.trapezoid(mtf * j0(2 * np.pi * f * r) * f, f) * 2 * np.pi

    ring = 1.2196699 * wavelength / (2 * aperture)
    assert abs(spread(ring)) < 1e-6 * spread(0)
    z = 2 * np.pi * aperture / wavelength * 3.0
    assert spread(3.0) / spread(0) == pytest.approx((2 * j1(z) / z) ** 2, abs=1e-6)


def test_strong_defocus_becomes_the_disc_of_geometrical_optics():
    optics = AiryTransfer(0.45, 0.05, defocus_um=3000.0)
    assert optics.waves > 8
    f = np.linspace(1e-4, 0.004, 40)
    disc = DiscTransfer(3000.0 * 0.05)(f, np.zeros_like(f))
    np.testing.assert_allclose(optics(f, np.zeros_like(f)), disc, atol=0.02)
    in_focus = AiryTransfer(0.45, 0.05, defocus_um=1e-6)
    f = np.linspace(0, 0.25, 50)
    np.testing.assert_allclose(in_focus(f, 0 * f), AiryTransfer(0.45, 0.05)(f, 0 * f), atol=1e-9)


def test_defocus_against_quadrature_over_the_pupil():
    # Overlap integral of two displaced pupils by brute force.
    optics = AiryTransfer(0.45, 0.05, defocus_um=250.0)
    x = (np.arange(2000) + 0.5) / 1000 - 1
    x, y = x, x[:, None]
    for n in (0.1, 0.35, 0.7):
        inside = np.hypot(np.abs(x) + n, y) <= 1
        phase = 8 * np.pi * optics.waves * n * x
        brute = (inside * np.cos(phase)).sum() * 1e-6 / np.pi
        value = optics(np.array([n * optics.cutoff_per_um]), np.zeros(1))[0]
        assert value == pytest.approx(brute, abs=2e-4)


def test_defocus_adds_the_variance_of_a_disc():
    # A disc of radius r has r^2 / 4 of variance along x; transfer to second order.
    disc = DiscTransfer(5.0)
    f = 1e-3
    second = (1 - disc(np.array([f]), np.zeros(1))[0]) / (2 * np.pi**2 * f**2)
    assert second == pytest.approx(25 / 4, rel=1e-3)
    system = small()
    blurred = expected(system, {"defocus": 150.0})
    wide = np.sqrt(4.5**2 + (150.0 * image_aperture(system)) ** 2 / 4)
    gauss = exact_image(system, projection(), transfer=GaussianTransfer(wide))
    plain = expected(system, None)
    assert np.abs(blurred - gauss).std() < 0.2 * np.abs(blurred - plain).std()


def test_diffraction_image_does_not_depend_on_the_window(monkeypatch):
    from rasnik.imaging import transfer

    mask = ChessField(field_um=85.0)
    optics = AiryTransfer(0.448, 0.033)
    image = exact_pattern(mask, projection(), (40, 50), 6.9, optics)
    monkeypatch.setattr(transfer, "_REACH_AIRY", 150.0)
    wider = exact_pattern(mask, projection(), (40, 50), 6.9, optics)
    assert np.abs(image - wider).max() < 1e-4


def test_coherent_edge_is_a_sine_integral():
    # A long straight edge: amplitude 1/2 + Si(2 pi NA x / wavelength) / pi, and 1/4 of the light
    # at its place. One field fills the view and more.
    system = load_system(
        "solidras",
        {
            "mask.field_um": 4000.0, "sensor.width_px": 32, "sensor.height_px": 8,
            "sensor.pixel_um": 2.0, "optics.scale": 1.0,
        },
    )  # fmt: skip
    light = CoherentLight(1.0, 0.448, 0.0333)
    mask = system.mask
    i = 9 * 5 + 4
    assert mask.is_white(i, i) and not mask.is_white(i - 1, i)
    place = Projection.from_pose(i * 4000.0, (i + 0.5) * 4000.0, 1.0, 0.0, 1)
    change = Deviations(coherent=light)
    image = exact_image(system, place, deviations=change, light_map=1.0, dark_map=0.0)
    node, weight = np.polynomial.legendre.leggauss(8)
    x = (np.arange(32) - 15.5)[:, None] * 2.0 + node
    amplitude = 0.5 + sici(2 * np.pi * light.numerical_aperture / 0.448 * x)[0] / np.pi
    np.testing.assert_allclose(image[4], amplitude**2 @ weight / 2, atol=1.5e-3)


# ------------------------------------------------------------------- light and geometry


def test_uneven_light(system, plain):
    ratio = expected(system, {"uneven_light": {"fall": 0.3, "slope": 0.1}}) / plain
    radius = 47.5**2 + 31.5**2
    assert ratio[0, 0] == pytest.approx(0.7 - 0.05)
    assert ratio[0, 95] == pytest.approx(0.7 + 0.05)
    assert ratio[31, 47] == pytest.approx(1 - 0.3 * 0.5 / radius - 0.1 * 0.5 / 95)


@pytest.mark.parametrize(("name", "depth"), [("dust", 0.8), ("stains", 0.1)])
def test_specks_take_their_share_of_light(system, plain, name, depth):
    many = [expected(system, {name: 3.0}, seed=s) / plain for s in range(25)]
    darkest = min(ratio.min() for ratio in many)
    assert 1 - depth - 1e-9 < darkest ** (1.0) or darkest < 1 - depth  # overlapping ones are darker
    assert max(ratio.max() for ratio in many) <= 1 + 1e-12
    # Without a speck, exp(-3) of the images.
    assert np.mean([(r > 1 - 1e-9).all() for r in many]) < 0.3
    one = expected(system, {name: {"count": 40.0, "depth": 0.0}})
    np.testing.assert_allclose(one, plain)


def test_a_displaced_column_sees_what_lies_there(system):
    image = expected(system, {"column_widths": 0.2})
    chain = Chain(make_effects({"column_widths": 0.2}), Context(system, 1), True)
    u, v = chain.deviations.points_um
    displaced = u[0] - (np.arange(96) - 47.5) * 6.9
    assert np.ptp(displaced) > 0.5 and abs(displaced.mean()) < 1e-9
    for column in (3, 60):
        x, y = projection().to_mask(displaced[column], 0.0)
        moved = exact_image(system, projection(x=float(x), y=float(y)))
        np.testing.assert_allclose(image[:, column], moved[:, column], atol=1e-4)


def test_widths_accumulate_and_positions_do_not():
    system = small()
    for name, axis in (("column_widths", 1), ("row_widths", 0)):
        at = []
        for seed in range(200):
            chain = Chain(make_effects({name: 0.01}), Context(system, seed), True)
            points = chain.deviations.points_um[1 - axis]
            line = points[0] if axis else points[:, 0]
            at.append(np.diff(line) - 6.9)
        # Distance of neighbours: half of the error of either.
        assert np.std(at) == pytest.approx(0.01 / np.sqrt(2), rel=0.05)
    chain = Chain(make_effects({"pixel_positions": 0.03}), Context(system, 1), True)
    u, v = chain.deviations.points_um
    assert np.std(u - u.mean(axis=0)) == pytest.approx(0.03, rel=0.05)
    assert np.std(v - v.mean(axis=1)[:, None]) == pytest.approx(0.03, rel=0.05)


def test_dead_area_sharpens_as_a_smaller_pixel(system):
    # A pixel with a gap is a smaller pixel: variance a^2 / 12 of the blur is lost.
    image = expected(system, {"dead_area": 2.0})
    lost = (6.9**2 - 4.9**2) / 12
    sharper = exact_image(
        system, projection(0.01), transfer=GaussianTransfer(np.sqrt(4.5**2 - lost))
    )
    plain = expected(system, None)
    assert np.abs(image - sharper).std() < 0.1 * np.abs(image - plain).std()
