"""Three points: closed forms of each motion, exact inverses, what cannot be told apart, errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy import stats

from rasnik.geometry.dependence import dependent, indistinguishable
from rasnik.geometry.inverse import displacement, displacements
from rasnik.geometry.reading import READINGS
from rasnik.geometry.three_points import (
    ALL_MOTIONS,
    ThreePoints,
    motion_index,
    motion_unit,
    three_points,
)
from rasnik.instrument import load_system

A_MM, B_MM = 60.0, 90.0
A, B, S = 6e4, 9e4, 1.5
BENCH = ThreePoints(A_MM, B_MM)

#: Sets of four that one Rasnik can tell apart.
COMPLETE = [
    ("mask_x", "mask_y", "mask_z", "mask_turn_z"),
    ("lens_x", "lens_y", "lens_z", "mask_turn_z"),
    ("sensor_x", "sensor_y", "sensor_z", "sensor_turn_z"),
    ("camera_x", "camera_y", "camera_z", "camera_turn_z"),
    ("camera_turn_x", "camera_turn_y", "camera_z", "camera_turn_z"),
    ("mask_x", "lens_y", "sensor_z", "camera_turn_z"),
]


def random_bench(rng: np.random.Generator) -> ThreePoints:
    a, b = 10 ** rng.uniform(1, 4, 2)
    return ThreePoints(
        a,
        b,
        theta_rad=rng.uniform(-math.pi, math.pi),
        orientation=int(rng.integers(1, 5)),
        x_um=4000.0,
        y_um=-5000.0,
        pivot_mm=rng.uniform(0, a + b),
    )


@pytest.mark.parametrize(
    ("motion", "expected"),
    [  # by similar triangles, mask at 0, lens at a, sensor at a + b
        ("mask_x", (-1, 0, 0, 0)),
        ("mask_y", (0, -1, 0, 0)),
        ("mask_z", (0, 0, S / A, 0)),
        ("lens_x", (1 + A / B, 0, 0, 0)),
        ("lens_y", (0, 1 + A / B, 0, 0)),
        ("lens_z", (0, 0, -(1 + S) / A, 0)),
        ("sensor_x", (-A / B, 0, 0, 0)),
        ("sensor_y", (0, -A / B, 0, 0)),
        ("sensor_z", (0, 0, 1 / A, 0)),
        ("camera_x", (1, 0, 0, 0)),
        ("camera_y", (0, 1, 0, 0)),
        ("camera_z", (0, 0, -S / A, 0)),
        ("camera_turn_x", (0, A, 0, 0)),
        ("camera_turn_y", (-A, 0, 0, 0)),
        ("camera_turn_z", (0, 0, 0, -1)),
        ("mask_turn_z", (0, 0, 0, 1)),
        ("sensor_turn_z", (0, 0, 0, -1)),
        *((f"{one}_turn_{axis}", (0, 0, 0, 0)) for one in ("mask", "sensor") for axis in "xy"),
    ],
)
def test_what_each_motion_does(motion, expected) -> None:
    found = BENCH.matrix([motion])[:, 0]
    assert found / BENCH.natural_readings * A == pytest.approx(
        np.array(expected) / BENCH.natural_readings * A, abs=1e-10
    )


@pytest.mark.parametrize("orientation", [1, 2, 3, 4])
def test_built_as_described(orientation) -> None:
    bench = ThreePoints(A_MM, B_MM, 0.3, orientation, 4000.0, 5000.0)
    found = bench.read({})
    assert found.orientation == orientation
    values = [getattr(found, name) for name in READINGS]
    assert values == pytest.approx([4000, 5000, S, 0.3], rel=1e-12)
    # whatever the orientation: what x, y and z do is a matter of the mask's own axes
    for motion in ("mask_x", "lens_y", "camera_z", "sensor_z"):
        assert bench.matrix([motion]) == pytest.approx(BENCH.matrix([motion]), rel=1e-12)


@pytest.mark.parametrize(("orientation", "sign"), [(1, 1), (2, -1), (3, -1), (4, 1)])
def test_a_mask_seen_from_behind_turns_the_other_way(orientation, sign) -> None:
    """Right-handed about X, Y and X x Y; the light goes against X x Y where codes are mirrored."""
    bench = ThreePoints(A_MM, B_MM, 0.3, orientation)
    for motion, row, size in (
        ("mask_turn_z", 3, 1), ("sensor_turn_z", 3, -1), ("camera_turn_z", 3, -1),
        ("camera_turn_x", 1, A), ("camera_turn_y", 0, -A),
    ):  # fmt: skip
        assert bench.matrix([motion])[row, 0] == pytest.approx(sign * size, rel=1e-12)


def test_a_camera_turned_about_the_mask_reads_the_same_place() -> None:
    bench = ThreePoints(A_MM, B_MM, pivot_mm=0.0)
    found = bench.read({"camera_turn_x": 0.1, "camera_turn_y": 0.05})
    assert (found.x_um, found.y_um) == pytest.approx((0, 0), abs=1e-9)


def test_a_camera_turned_about_its_lens_moves_the_crossing_by_the_tangent() -> None:
    found = BENCH.read({"camera_turn_y": 0.1})
    assert found.x_um == pytest.approx(-A * math.tan(0.1), rel=1e-12)


def test_a_tilted_mask_is_seen_in_second_order_as_a_larger_scale() -> None:
    # heights shrink by cos: two magnifications S and S cos, whose geometric mean is read
    found = BENCH.read({"mask_turn_x": 0.1})
    assert (found.x_um, found.y_um, found.theta_rad) == pytest.approx((0, 0, 0), abs=1e-9)
    assert found.scale == pytest.approx(S * math.sqrt(math.cos(0.1)), rel=1e-12)


def test_elements_moved_together_read_the_same(rng) -> None:
    shift = dict(zip("xyz", 1e3 * rng.standard_normal(3), strict=True))
    together = {f"{one}_{k}": v for one in ("mask", "lens", "sensor") for k, v in shift.items()}
    found, built = BENCH.read(together), BENCH.as_built
    assert [getattr(found, name) for name in READINGS] == pytest.approx(
        [getattr(built, name) for name in READINGS], abs=1e-9
    )


def test_slopes_are_those_of_differences(rng) -> None:
    for _ in range(10):
        bench = random_bench(rng)
        columns, rows = bench.natural_motions(ALL_MOTIONS), bench.natural_readings
        shorter = min(1, bench.scale)
        motions = 0.1 * rng.standard_normal(len(ALL_MOTIONS)) * columns
        motions[[motion_unit(name) == "um" for name in ALL_MOTIONS]] *= 0.2 * shorter
        step = 1e-3 * shorter
        steps = step * np.diag(columns)
        ends = [bench.values(motions + k * steps) for k in (-2, -1, 1, 2)]
        found = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]).T / (12 * step)
        expected = bench.slopes(motions) * columns / rows[:, None]
        assert np.abs(found / rows[:, None] - expected).max() < 1e-8 * np.abs(expected).max()


@pytest.mark.parametrize("names", COMPLETE)
def test_random_displacements_come_back(rng, names) -> None:
    for _ in range(20):
        bench = random_bench(rng)
        turns = np.array([motion_unit(name) == "rad" for name in names])
        size = np.where(turns, 0.3, 0.1e3 * min(bench.mask_lens_mm, bench.lens_sensor_mm))
        truth = size * rng.uniform(-1, 1, 4)
        found = displacement(bench, bench.read(dict(zip(names, truth, strict=True))), names)
        assert (
            np.abs(found.values - truth) == pytest.approx(np.zeros(4), abs=0, rel=0)
            or (np.abs(found.values - truth) <= 1e-9 * size).all()
        )


def test_the_mask_in_four_dimensions_seen_by_a_camera(rng) -> None:
    for _ in range(20):
        a = A_MM * rng.uniform(0.5, 2)
        x, y, turn = *(1e3 * rng.standard_normal(2)), rng.uniform(-0.5, 0.5)
        motions = {"mask_x": x, "mask_y": y, "mask_z": 1e3 * (A_MM - a), "mask_turn_z": turn}
        found = BENCH.read(motions)
        # x, y of the axis in the axes of the turned mask, S = b / a
        c, s = math.cos(turn), math.sin(turn)
        expected = (-(c * x + s * y), s * x - c * y, B_MM / a, turn)
        assert [getattr(found, name) for name in READINGS] == pytest.approx(expected, rel=1e-11)
        back = displacement(BENCH, found, tuple(motions))
        assert back.values == pytest.approx(list(motions.values()), rel=1e-9)


def test_small_displacements_are_those_of_the_matrix() -> None:
    names = COMPLETE[1]
    truth = np.array([1e-3, -2e-3, 3e-3, 1e-8])
    reading = BENCH.read(dict(zip(names, truth, strict=True)))
    change = [getattr(reading, n) - getattr(BENCH.as_built, n) for n in READINGS]
    linear = np.linalg.solve(BENCH.matrix(names), change)
    assert linear == pytest.approx(truth, rel=1e-6)
    assert displacement(BENCH, reading, names).values == pytest.approx(truth, rel=1e-6)


def test_what_one_rasnik_cannot_tell_apart() -> None:
    assert dependent(BENCH, ["mask_x", "lens_x"]) == {"lens_x": {"mask_x": pytest.approx(-5 / 3)}}
    assert dependent(BENCH, ["mask_turn_x", "mask_x"]) == {"mask_turn_x": {}}
    assert dependent(BENCH, COMPLETE[5]) == {}
    assert dependent(BENCH, ["mask_x", "mask_z"], ["x_um", "y_um"]) == {"mask_z": {}}
    said = indistinguishable(BENCH)
    assert len(said) == 1 + 13  # four tilts are not seen; 17 motions are seen in 4 readings
    assert "mask_turn_x, mask_turn_y, sensor_turn_x, sensor_turn_y: not seen" in said[0]
    assert "1 µm of lens_x reads as -1.66667 µm of mask_x" in said
    assert "1 µrad of camera_turn_y reads as 0.06 µm of mask_x" in said
    with pytest.raises(ValueError, match=r"tell these motions apart: 1 µm of sensor_y reads as"):
        displacement(BENCH, BENCH.as_built, ["lens_y", "sensor_y"])


@dataclass
class Noisy:
    x_um: float
    y_um: float
    scale: float
    theta_rad: float
    orientation: int = 4
    covariance: np.ndarray = field(default_factory=lambda: COVARIANCE)


def _covariance() -> np.ndarray:
    sigma = np.array([0.4, 0.3, 2e-6, 3e-6])
    correlation = np.eye(4)
    correlation[0, 1] = correlation[1, 0] = 0.3
    correlation[0, 2] = correlation[2, 0] = -0.5
    return correlation * np.outer(sigma, sigma)


COVARIANCE = _covariance()


def agrees(sample: np.ndarray, covariance: np.ndarray) -> None:
    """The scatter of draws against a covariance, to 4.5 of its own standard deviations."""
    n = len(sample)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), (sample - sample.mean(0)).T)
    scatter = whitened @ whitened.T / (n - 1)
    unit = np.eye(len(covariance))
    assert np.abs(scatter - unit).max() < 4.5 * math.sqrt(2 / n)


@pytest.mark.parametrize("names", [COMPLETE[1], COMPLETE[4], COMPLETE[5]])
def test_covariance_is_that_of_draws(rng, names) -> None:
    draws = 10_000
    truth = {name: 0.05 if motion_unit(name) == "rad" else 300.0 for name in names}
    exact = BENCH.read(truth)
    values = np.array([getattr(exact, name) for name in READINGS])
    noisy = values + rng.multivariate_normal(np.zeros(4), COVARIANCE, draws)
    found = displacements(BENCH, noisy, names)
    stated = displacement(BENCH, exact, names, COVARIANCE)
    agrees(found, stated.covariance)
    sigma = np.sqrt(np.diag(stated.covariance))
    inside = (np.abs(found - list(truth.values())) < sigma).mean(axis=0)
    assert inside == pytest.approx(np.full(4, 0.6827), abs=4.5 * math.sqrt(0.22 / draws))


def test_fewer_motions_than_readings_are_weighed_and_judged_by_chi_square(rng) -> None:
    draws, names = 10_000, ("lens_x", "lens_z")
    truth = {"lens_x": 200.0, "lens_z": -100.0}
    exact = BENCH.read(truth)
    values = np.array([getattr(exact, name) for name in READINGS])
    noisy = values + rng.multivariate_normal(np.zeros(4), COVARIANCE, draws)
    found = displacements(BENCH, noisy, names, COVARIANCE)
    stated = displacement(BENCH, exact, names, COVARIANCE)
    agrees(found, stated.covariance)
    # the correlation of y with x is used: better than x and S alone
    alone = displacement(BENCH, exact, names, COVARIANCE, ("x_um", "scale"))
    assert stated.sigma("lens_x") < 0.999 * alone.sigma("lens_x")
    chi2 = [displacement(BENCH, Noisy(*one), names).chi2 for one in noisy[:100]]
    assert np.mean(chi2) == pytest.approx(2, abs=4.5 * math.sqrt(2 * 2 / 100))
    moved = Noisy(values[0], values[1] + 30.0, *values[2:])  # 100 sigma along y, not of these
    assert displacement(BENCH, moved, names).chi2 > 5000
    chances = [displacement(BENCH, Noisy(*one), names).probability for one in noisy[:400]]
    assert stats.kstest(chances, "uniform").pvalue > 1e-3


def test_sagitta_of_the_lens(rng) -> None:
    for _ in range(10):
        bench = random_bench(rng)
        moved = {"lens_x": 30.0, "lens_y": -20.0, "lens_z": 500.0}
        found = bench.read(moved)
        sagitta, _ = bench.sagitta(found.x_um, found.y_um, found.scale)
        assert sagitta == pytest.approx([30, -20], rel=1e-9)
        # the line moved with its ends: mask by m, sensor by s, at the lens (m b + s a) / (a + b)
        m, s = 10.0, -7.0
        at_lens = (m * bench.lens_sensor_mm + s * bench.mask_lens_mm) / (
            bench.lens_sensor_mm + bench.mask_lens_mm
        )
        found = bench.read({"mask_x": m, "sensor_x": s})
        sagitta, _ = bench.sagitta(found.x_um, found.y_um, found.scale)
        assert sagitta == pytest.approx([-at_lens, 0], rel=1e-9, abs=1e-9)


def test_covariance_of_the_sagitta_is_that_of_draws(rng) -> None:
    large = COVARIANCE.copy()
    large[2] *= 100  # so that the error of S is felt
    large[:, 2] *= 100
    values = np.array([3000.0, -2000.0, S, 0.0])
    draws = rng.multivariate_normal(values, large, 10_000)
    found = np.array([BENCH.sagitta(*one[:3])[0] for one in draws])
    agrees(found, BENCH.sagitta(*values[:3], large)[1])
    assert np.isnan(BENCH.sagitta(*values[:3])[1]).all()


def test_from_distances_scale_or_system() -> None:
    assert three_points(60, 90) == three_points(60, scale=1.5) == three_points(None, 90, 1.5)
    assert three_points(60, 90, 1.55).scale == 1.5  # lens measured to its middle
    solidras = load_system("solidras")
    assert three_points(system=solidras).mask_lens_mm == 60
    assert three_points(system=solidras, mask_lens_mm=50.0).lens_sensor_mm == 50
    turned = load_system("solidras", ["optics.orientation=2", "optics.theta_rad=0.1"])
    assert three_points(system=turned).orientation == 2
    assert three_points(system=turned).as_built.theta_rad == 0.1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"mask_lens_mm": 60, "lens_sensor_mm": 90, "scale": 2}, "make a scale of 1.5; give two"),
        ({"mask_lens_mm": -60, "lens_sensor_mm": 90}, "mask_lens_mm = -60 must be positive"),
        ({"mask_lens_mm": 60, "lens_sensor_mm": math.nan}, "lens_sensor_mm = nan must be"),
        ({"mask_lens_mm": 60}, "give two of mask_lens_mm, lens_sensor_mm and scale"),
        ({"system": load_system("microras")}, "system microras does not state its distances"),
        ({"mask_lens_mm": 60, "scale": 1, "orientation": 5}, "orientation must be 1, 2, 3 or 4"),
        ({"mask_lens_mm": 60, "scale": 1, "x_um": math.inf}, "finite"),
    ],
)
def test_contradictions_are_said(arguments, sentence) -> None:
    with pytest.raises(ValueError, match=sentence):
        three_points(**arguments)


def test_distances_are_positive() -> None:
    with pytest.raises(ValueError, match="counted along the light"):
        ThreePoints(60, -90)


def test_what_cannot_be_inverted_is_said() -> None:
    names = COMPLETE[0]
    with pytest.raises(ValueError, match="orientation 1, the Rasnik was built with 4"):
        displacement(BENCH, Noisy(0, 0, 1.5, 0, 1), names)
    with pytest.raises(ValueError, match="no position"):
        displacement(BENCH, Noisy(math.nan, 0, 1.5, 0), names)
    with pytest.raises(ValueError, match="no displacement of .* explains"):
        displacement(BENCH, Noisy(0, 0, -1.5, 0), names)  # no lens makes a negative scale
    with pytest.raises(ValueError, match="4 readings for 2 motions: give a covariance"):
        displacements(BENCH, np.zeros(4), ("lens_x", "lens_y"))
    with pytest.raises(ValueError, match="each once"):
        displacements(BENCH, np.zeros(4), ("lens_x", "lens_x"))
    with pytest.raises(ValueError, match="positive definite"):
        displacements(BENCH, np.zeros(4), ("lens_x",), np.zeros((4, 4)))
    with pytest.raises(ValueError, match="not known or not positive"):
        displacements(BENCH, np.zeros(4), ("lens_x",), np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match="readings are x_um"):
        displacements(BENCH, np.zeros(4), ("lens_x",), None, ("x",))
    with pytest.raises(KeyError, match="there is no motion 'lens_turn_x'"):
        BENCH.read({"lens_turn_x": 0.1})
    with pytest.raises(ValueError, match="lens is not between"):
        BENCH.read({"lens_z": 2e5})


def test_one_reading_without_a_solution_does_not_stop_the_others() -> None:
    values = np.array([[10.0, 0, 1.5, 0], [0, 0, -1.5, 0], [math.nan] * 4, [0, 20.0, 1.4, 0.1]])
    found = displacements(BENCH, values, COMPLETE[0])
    assert np.isnan(found).any(axis=1).tolist() == [False, True, True, False]
    assert found[0] == pytest.approx([-10, 0, 0, 0], abs=1e-9)


def test_result_as_a_dictionary() -> None:
    found = displacement(BENCH, BENCH.read({"lens_x": 5.0}), ("lens_x",), use=("x_um",))
    assert found["lens_x"] == pytest.approx(5, rel=1e-9)
    assert found.as_dict()["sigma_lens_x_um"] is None and found.ndf == 0
    assert found.as_dict()["probability"] is None
    found = displacement(BENCH, Noisy(10, 0, 1.5, 0), COMPLETE[1])
    assert found.as_dict()["sigma_lens_x_um"] == pytest.approx(0.4 / (1 + A / B), rel=1e-5)
    assert motion_index("mask_x") == 0
