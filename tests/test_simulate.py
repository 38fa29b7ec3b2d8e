"""Sensor noise and simulated frames: statistics, what can be asked for, what is refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.noise import ReadOut, add_noise
from rasnik.imaging.projection import Projection
from rasnik.imaging.simulate import simulate
from rasnik.instrument import SystemConfigError, load_system

SMALL = {"sensor.width_px": 96, "sensor.height_px": 64}


def small(**changes):
    return load_system("solidras", {**SMALL, **changes})


@pytest.fixture(scope="module")
def system():
    return small()


# ------------------------------------------------------------------------------ noise


def variance_law(system, statistics, levels, frames=400):
    """(A, B) and their standard errors from the scatter of many noisy frames."""
    expected = np.repeat(levels[:, None], 2000, axis=1)
    rng = np.random.default_rng(11)
    readout = ReadOut(expected, system, statistics)
    squares = np.zeros(expected.shape)
    for _ in range(frames):
        squares += (readout.frame(rng, quantise=False) - expected) ** 2
    variance = squares.mean(axis=1) / frames
    error = variance * np.sqrt(2 / (frames * expected.shape[1]))
    design = np.stack([np.ones_like(levels), levels], axis=1) / error[:, None]
    covariance = np.linalg.inv(design.T @ design)
    return covariance @ design.T @ (variance / error), np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("statistics", ["gaussian", "poisson"])
def test_variance_is_a_plus_b_q(system, statistics):
    found, error = variance_law(system, statistics, np.linspace(5.0, 250.0, 12))
    assert (error < [0.002, 2e-5]).all()
    assert (abs(found - [0.26, 0.011]) < 4 * error).all()


def test_a_superpixel_has_a_quarter_of_the_variance():
    found, error = variance_law(
        small(**{"sensor.binning": 2}), "gaussian", np.linspace(5.0, 250.0, 12)
    )
    assert (abs(found - [0.26 / 4, 0.011 / 4]) < 4 * error).all()


def test_poisson_noise_is_skewed_as_electrons_are(system):
    # Third moment of N electrons of B grey levels each: B^3 N = B^2 Q.
    expected = np.full((1000, 1000), 20.0)
    readout = ReadOut(expected, small(**{"sensor.noise_b": 0.5}), "poisson")
    deviation = readout.frame(np.random.default_rng(5), quantise=False) - 20
    sigma = deviation.std()
    third = (deviation**3).mean()
    assert abs(third - 0.5**2 * 20) < 4 * np.sqrt(15 / deviation.size) * sigma**3
    assert abs(deviation.mean()) < 4 * sigma / 1000


def test_rounding_adds_a_twelfth(system):
    rng = np.random.default_rng(2)
    expected = rng.uniform(100, 110, (1000, 1000))
    frame = add_noise(expected, system, rng)
    variance = ((frame - expected) ** 2).mean()
    law = 0.26 + 0.011 * expected.mean() + 1 / 12
    assert abs(variance - law) < 4 * law * np.sqrt(2 / expected.size)
    assert abs((frame - expected).mean()) < 4 * np.sqrt(law / expected.size)


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (10, np.uint16), (12, np.uint16)])
def test_range_and_type_by_bit_depth(bits, dtype):
    system = small(**{"sensor.bit_depth": bits})
    full = 2**bits - 1
    expected = np.tile([-50.0, -0.3, 100.0, full, full + 50.0], (100, 1))
    frame = add_noise(expected, system, 1)
    assert frame.dtype == dtype
    assert (frame[:, 0] == 0).all() and (frame[:, 4] == full).all()
    assert 0 < (frame[:, 3] == full).mean() < 1  # half of them cut off


def test_noise_does_not_change_its_input_and_is_seeded(system):
    expected = np.full((20, 30), 100.0)
    a, b = add_noise(expected, system, 7), add_noise(expected, system, np.random.default_rng(7))
    np.testing.assert_array_equal(a, b)
    assert (add_noise(expected, system, 8) != a).any()
    assert (expected == 100).all()


def test_noise_that_cannot_be_made(system):
    expected = np.full((4, 4), 100.0)
    with pytest.raises(ValueError, match=r"noise of system solidras is not known"):
        add_noise(expected, small(**{"sensor.noise_a": None, "sensor.noise_b": None}))
    with pytest.raises(ValueError, match="not finite"):
        add_noise(np.full((4, 4), np.nan), system)
    with pytest.raises(ValueError, match="statistics must be"):
        add_noise(expected, system, statistics="uniform")


# --------------------------------------------------------------------- frames and truth


def test_frames_of_one_pose(system):
    simulation = simulate(system, (4000, 5000, 0.01), n=5, seed=3)
    assert simulation.frames.shape == (5, 64, 96)
    assert simulation.frames.dtype == np.uint8
    assert len(simulation) == len(simulation.truth) == 5
    projection = Projection.from_pose(4000, 5000, 1.0, 0.01, 4)
    expected = exact_image(system, projection)
    np.testing.assert_array_equal(simulation.expected(2), expected)
    pull = (simulation.frames - expected) / np.sqrt(0.26 + 0.011 * expected + 1 / 12)
    dark = expected < 200
    assert np.sqrt((pull[:, dark] ** 2).mean()) == pytest.approx(1, abs=0.02)
    assert all(
        (a != b).any() for a, b in zip(simulation.frames[:-1], simulation.frames[1:], strict=True)
    )
    assert simulation.truth[0].as_dict() == {
        "x_um": 4000.0,
        "y_um": 5000.0,
        "scale": 1.0,
        "theta_rad": 0.01,
        "orientation": 4,
    }


def test_a_frame_is_the_same_however_it_is_asked_for(system):
    simulation = simulate(system, [(4000, 5000), (7000, 8000)], n=3, seed=3)
    listed = [frame for frame, _ in simulation]
    np.testing.assert_array_equal(simulation.frames, listed)
    np.testing.assert_array_equal(simulation[4][0], listed[4])
    np.testing.assert_array_equal(simulation[-1][0], listed[-1])
    assert [t.x_um for t in simulation.truth] == [4000] * 3 + [7000] * 3
    assert simulation[4][1] is simulation.truth[4]
    again = simulate(system, [(4000, 5000), (7000, 8000)], n=3, seed=simulation.seed)
    np.testing.assert_array_equal(again.frames, listed)
    with pytest.raises(IndexError):
        simulation[6]


def test_seeds_differ(system):
    a, b = (simulate(system, (4000, 5000), seed=s) for s in (1, 2))
    assert (a.frames != b.frames).any()
    c, d = simulate(system, (4000, 5000)), simulate(system, (4000, 5000))
    assert c.seed != d.seed
    np.testing.assert_array_equal(c.frames, simulate(system, (4000, 5000), seed=c.seed).frames)


def test_random_positions_fill_the_view(system):
    simulation = simulate(system, n=400, seed=9)
    x = np.array([t.x_um for t in simulation.truth])
    y = np.array([t.y_um for t in simulation.truth])
    half_view = np.hypot(64, 96) * 6.9 / 2
    for z in (x, y):
        assert z.min() > half_view and z.max() < 195840 - half_view
        assert abs(z.mean() - 195840 / 2) < 5 * 195840 / np.sqrt(12 * 400)
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.25
    assert [t.x_um for t in simulate(system, n=400, seed=9).truth] == list(x)
    assert simulate(system, n=400, seed=10).truth[0].x_um != x[0]


def test_random_positions_on_a_mask_smaller_than_the_view():
    system = small(**{"mask.columns": 1, "mask.code_bits": 2})
    simulation = simulate(system, n=50, seed=1)
    assert all(0 <= t.x_um <= 255 for t in simulation.truth)


@pytest.mark.parametrize(
    "pose",
    [
        (4000, 5000, 0.1, 0.9, 2),
        [4000, 5000, 0.1, 0.9, 2],
        np.array([4000, 5000, 0.1, 0.9, 2]),
        {"x_um": 4000, "y_um": 5000, "theta_rad": 0.1, "scale": 0.9, "orientation": 2},
        SimpleNamespace(x_um=4000, y_um=5000, theta_rad=0.1, scale=0.9, orientation=2),
        Projection.from_pose(4000, 5000, 0.9, 0.1, 2),
        [(4000, 5000, 0.1, 0.9, 2)],
        np.array([[4000, 5000, 0.1, 0.9, 2]]),
    ],
    ids=["tuple", "list", "array", "mapping", "object", "projection", "sequence", "table"],
)
def test_forms_of_a_pose(system, pose):
    (truth,) = simulate(system, pose, noise=False).truth
    values = truth.as_dict()
    assert values.pop("orientation") == 2
    assert values == pytest.approx({"x_um": 4000, "y_um": 5000, "theta_rad": 0.1, "scale": 0.9})
    matrix = Projection.from_pose(4000, 5000, 0.9, 0.1, 2).matrix
    np.testing.assert_allclose(truth.projection.matrix, matrix, rtol=1e-14)


def test_what_a_pose_leaves_out_is_the_systems():
    system = small(**{"optics.theta_rad": 0.2, "optics.scale": 0.8, "optics.orientation": 1})
    geometry_free = load_system(system)
    (truth,) = simulate(geometry_free, {"x_um": 1, "y_um": 2, "scale": None}).truth
    assert (truth.theta_rad, truth.scale, truth.orientation) == (0.2, 0.8, 1)


def test_without_noise_the_expected_image_comes_out(system):
    simulation = simulate(system, (4000, 5000), n=2, noise=False)
    assert simulation.frames.dtype == np.float64
    np.testing.assert_array_equal(simulation.frames[1], simulation.expected(1))
    rounded = simulate(system, (4000, 5000), noise=False, quantise=True).frames[0]
    assert rounded.dtype == np.uint8
    np.testing.assert_array_equal(rounded, np.rint(simulation.frames[0]))
    noisy = simulate(system, (4000, 5000), quantise=False, seed=1).frames[0]
    assert noisy.dtype == np.float64 and (noisy % 1 != 0).mean() > 0.99


def test_affine_pose_light_and_binning():
    system = small(**{"sensor.binning": 2})
    projection = Projection([[-0.83, 0.05, 5000.0], [0.007, 1.1, 7000.0], [0, 0, 1]])
    simulation = simulate(system, projection, noise=False, light_map=lambda u, v: 200 + u / 50)
    assert simulation.frames.shape == (1, 32, 48)
    expected = exact_image(system, projection, light_map=lambda u, v: 200 + u / 50)
    np.testing.assert_array_equal(simulation.frames[0], expected)
    truth = simulation.truth[0]
    assert (truth.x_um, truth.y_um) == (5000, 7000)
    # The truth of a simulation can be simulated again, oblique axes and all.
    again = simulate(system, truth, noise=False, light_map=lambda u, v: 200 + u / 50)
    np.testing.assert_array_equal(again.frames, simulation.frames)
    assert again.truth[0].as_dict() == truth.as_dict()


def test_a_shipped_system_by_name():
    assert simulate("solidras", (4000, 5000), noise=False)[0][0].shape == (540, 720)


def test_the_view_may_reach_beyond_the_mask(system):
    frame = simulate(system, (0, 0), noise=False).frames[0]
    # Orientation 4: mask x grows to the left, mask y downward; the rest is dark.
    np.testing.assert_allclose(frame[:20], 25, atol=1e-4)
    np.testing.assert_allclose(frame[:, 60:], 25, atol=1e-4)
    assert frame[40:, :40].max() > 240


@pytest.mark.parametrize(
    ("poses", "sentence"),
    [
        ((-1.0, 5000), r"pose: \(-1, 5000\) um is not on the mask, which covers x 0..195840"),
        ([(4000, 5000), (4000, 2e5)], r"pose 1: .* is not on the mask"),
        ((4000,), "2 to 5 values"),
        ((1, 2, 3, 4, 1, 6), "2 to 5 values"),
        ((None, 5000), "x_um is missing"),
        ({"x_um": 4000}, "y_um is missing"),
        ({"x_um": 1, "y_um": 2, "theta": 0.1}, "unknown key 'theta'.*did you mean theta_rad"),
        ((4000, np.nan), "y_um must be finite"),
        ((4000, 5000, 0.1, 0.0), "scale must be positive"),
        ((4000, 5000, 0.1, 1.0, 5), "orientation must be 1, 2, 3 or 4"),
        ((4000, 5000, 0.1, 1.0, 1.5), "orientation must be 1, 2, 3 or 4"),
        ([], "poses is empty"),
    ],
)
def test_poses_that_are_refused(system, poses, sentence):
    with pytest.raises(ValueError, match=sentence):
        simulate(system, poses)


@pytest.mark.parametrize(
    ("poses", "sentence"),
    [
        (3.0, "a pose or a sequence of poses"),
        ("centre", "a pose or a sequence of poses"),
        ([(4000, 5000), 3.0], "pose 1: 3.0 is not a pose"),
        ([(4000, "far")], "y_um must be a number"),
    ],
)
def test_things_that_are_no_poses(system, poses, sentence):
    with pytest.raises(TypeError, match=sentence):
        simulate(system, poses)


@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        ({"n": 0}, ValueError, "n, the number of frames, must be at least 1, not 0"),
        ({"n": -3}, ValueError, "must be at least 1, not -3"),
        ({"n": 2.5}, TypeError, "must be a whole number, not 2.5"),
        ({"seed": -1}, ValueError, "seed must not be negative"),
        ({"seed": "a"}, TypeError, "seed must be a whole number"),
        ({"path": "magic"}, ValueError, "path must be one of exact, paper, not 'magic'"),
        ({"statistics": "flat"}, ValueError, "statistics must be 'gaussian' or 'poisson'"),
    ],
)
def test_options_that_are_refused(system, options, error, sentence):
    with pytest.raises(error, match=sentence):
        simulate(system, (4000, 5000), **options)


def test_systems_that_are_refused():
    with pytest.raises(SystemConfigError, match="did you mean solidras"):
        simulate("solidrass", (4000, 5000))
    silent = small(**{"sensor.noise_a": None, "sensor.noise_b": None})
    with pytest.raises(ValueError, match="noise of system solidras is not known"):
        simulate(silent, (4000, 5000))
    assert simulate(silent, (4000, 5000), noise=False).frames.shape == (1, 64, 96)
