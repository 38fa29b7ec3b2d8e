"""One Rasnik in space: against rays traced point by point, closed forms, and differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rasnik import analyse
from rasnik.geometry.reading import (
    FACING,
    MOTIONS,
    READINGS,
    Placement,
    derivatives,
    projection,
    reading,
    readings,
)
from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.projection import ORIENTATIONS
from rasnik.instrument import load_system

A_MM, B_MM = 60.0, 90.0  # scale 1.5
MASK = Placement([0, 0, 0], np.eye(3))
LENS = np.array([0, 0, A_MM])
SENSOR = Placement([0, 0, A_MM + B_MM], FACING)


def turn(vector) -> np.ndarray:
    return Rotation.from_rotvec(vector).as_matrix()


def seen(mask: Placement, lens: np.ndarray, sensor: Placement, points_um: np.ndarray) -> np.ndarray:
    """(u, v) in um of mask points: each ray through the lens is cut with the sensor's plane."""
    image = []
    for x, y in points_um:
        point = mask.position_mm + mask.rotation @ [1e-3 * x, 1e-3 * y, 0.0]
        ray = lens - point
        normal = np.cross(sensor.rotation[:, 0], sensor.rotation[:, 1])
        hit = point + ray * (normal @ (sensor.position_mm - point)) / (normal @ ray)
        image.append(1e3 * (sensor.rotation[:, :2].T @ (hit - sensor.position_mm)))
    return np.array(image)


def anywhere(rng: np.random.Generator, tilt: float) -> tuple[Placement, np.ndarray, Placement]:
    """A Rasnik of any size, turned any way in the world, elements tilted by about `tilt` rad."""
    a, b = 10 ** rng.uniform(1, 4, 2)
    world, origin = Rotation.random(random_state=rng).as_matrix(), 1e3 * rng.standard_normal(3)
    tilted = tilt * rng.standard_normal((2, 3))
    places = [np.zeros(3), np.array([0, 0, a]), np.array([0, 0, a + b])]
    mask, lens, sensor = (
        origin + world @ (one + tilt * min(a, b) * 0.3 * rng.standard_normal(3)) for one in places
    )
    flip = np.diag(rng.choice([(1, 1, 1), (1, -1, -1)])).astype(float)
    about = turn([0, 0, rng.uniform(-math.pi, math.pi)])
    return (
        Placement(mask, world @ turn(tilted[0]) @ flip),
        lens,
        Placement(sensor, world @ turn(tilted[1]) @ FACING @ about),
    )


def test_aligned_elements_read_zero_code_4_and_the_ratio_of_distances() -> None:
    found = reading(MASK, LENS, SENSOR)
    assert (found.x_um, found.y_um, found.theta_rad) == (0, 0, 0)
    assert found.scale == pytest.approx(B_MM / A_MM, rel=1e-15)
    assert found.orientation == 4


@pytest.mark.parametrize(
    ("u", "v", "code"),
    [
        ((1, 0, 0), (0, -1, 0), 4),
        ((-1, 0, 0), (0, 1, 0), 1),
        ((1, 0, 0), (0, 1, 0), 2),
        ((-1, 0, 0), (0, -1, 0), 3),
    ],
)
def test_each_orientation(u, v, code) -> None:
    sensor = Placement(SENSOR.position_mm, np.column_stack([u, v, np.cross(u, v)]))
    found = reading(MASK, LENS, sensor)
    assert found.orientation == code
    assert found.theta_rad == 0
    # where the mask's X and Y grow on the image, told by the rays themselves
    origin, right, up = seen(MASK, LENS, sensor, np.array([[0, 0], [1, 0], [0, 1]]))
    assert np.sign((right - origin)[0]) == ORIENTATIONS[code][0]
    assert np.sign((up - origin)[1]) == ORIENTATIONS[code][1]


def test_a_mask_moved_up_or_right_reads_less() -> None:
    found = reading(Placement([0.01, 0.02, 0], np.eye(3)), LENS, SENSOR)
    assert (found.x_um, found.y_um) == pytest.approx((-10, -20), abs=1e-9)


def test_a_lens_moved_right_reads_more_by_one_plus_a_over_b() -> None:
    found = reading(MASK, LENS + [0.01, 0, 0], SENSOR)
    assert (found.x_um, found.y_um) == pytest.approx((10 * (1 + A_MM / B_MM), 0), abs=1e-9)


def test_a_sensor_moved_right_reads_less_by_a_over_b() -> None:
    found = reading(MASK, LENS, Placement(SENSOR.position_mm + [0.01, 0, 0], FACING))
    assert (found.x_um, found.y_um) == pytest.approx((-10 * A_MM / B_MM, 0), abs=1e-9)


def test_a_mask_turned_anticlockwise_turns_the_image_anticlockwise() -> None:
    # seen from the lens X is right and Y up; the image of code 4 is that view turned by pi
    found = reading(Placement([0, 0, 0], turn([0, 0, 0.1])), LENS, SENSOR)
    assert found.theta_rad == pytest.approx(0.1, rel=1e-12)
    assert found.orientation == 4


def test_half_a_turn_is_the_other_code_unless_the_code_is_given() -> None:
    mask = Placement([0, 0, 0], turn([0, 0, math.pi - 0.1]))
    found = reading(mask, LENS, SENSOR)
    assert (found.orientation, found.theta_rad) == (1, pytest.approx(-0.1))
    assert reading(mask, LENS, SENSOR, 4).theta_rad == pytest.approx(math.pi - 0.1)


@pytest.mark.parametrize("tilt", [0.0, 1e-3, 0.3])
def test_rays_traced_point_by_point_fit_the_map_of_the_conventions(rng, tilt) -> None:
    for _ in range(20):
        mask, lens, sensor = anywhere(rng, tilt)
        found = reading(mask, lens, sensor)
        dx, dy = ORIENTATIONS[found.orientation]
        # points of a small patch around the crossing, so that tilt acts as its local map
        patch = (1e-4 * np.linalg.norm(lens - mask.position_mm) * 1e3) * rng.uniform(-1, 1, (40, 2))
        patch = np.vstack([patch, -patch])
        points = patch + [found.x_um, found.y_um]
        u, v = seen(mask, lens, sensor, points).T

        def misfit(pose, u=u, v=v, points=points, dx=dx, dy=dy):
            x, y, log_scale, theta = pose
            c, s = math.cos(theta), math.sin(theta)
            S = math.exp(log_scale)
            return np.concatenate(
                [
                    x + dx * (u * c - v * s) / S - points[:, 0],
                    y + dy * (u * s + v * c) / S - points[:, 1],
                ]
            )

        start = [found.x_um + 1, found.y_um - 1, math.log(found.scale) + 0.01, found.theta_rad]
        size = np.abs(patch).max()
        fit = least_squares(misfit, start, x_scale=[size, size, 1, 1], xtol=1e-15, ftol=1e-15)
        x, y, log_scale, theta = fit.x
        if tilt == 0:
            assert np.abs(fit.fun).max() < 1e-6 * size
            assert math.exp(log_scale) == pytest.approx(found.scale, rel=1e-8)
            assert theta == pytest.approx(found.theta_rad, abs=1e-8)
            assert (x, y) == pytest.approx((found.x_um, found.y_um), abs=1e-6 * size)
        # tilted: the exact map, of which the reading is the nearest similarity at its centre
        assert seen(mask, lens, sensor, np.array([[found.x_um, found.y_um]])) == pytest.approx(
            np.zeros((1, 2)), abs=1e-5
        )
        whole = projection(mask, lens, sensor)
        assert np.array(whole.to_mask(u, v)).T == pytest.approx(points, abs=1e-5 * size)
        S, theta, code = whole.similarity()
        assert found.orientation == code
        assert (found.scale, found.theta_rad) == pytest.approx((S, theta), rel=1e-9, abs=1e-12)


def test_many_at_once_are_the_same_as_one_by_one(rng) -> None:
    single = [anywhere(rng, 0.1) for _ in range(12)]
    masks, lenses, sensors = zip(*single, strict=True)
    many = [
        Placement(np.array([p.position_mm for p in places]), np.array([p.rotation for p in places]))
        for places in (masks, sensors)
    ]
    values, codes = readings(many[0], np.array(lenses), many[1])
    slopes = derivatives(many[0], np.array(lenses), many[1])
    assert values.shape == (12, 4) and slopes.shape == (12, len(READINGS), len(MOTIONS))
    for k, one in enumerate(single):
        found = reading(*one)
        assert values[k] == pytest.approx([getattr(found, name) for name in READINGS], rel=1e-12)
        assert codes[k] == found.orientation
        assert slopes[k] == pytest.approx(derivatives(*one), rel=1e-10, abs=1e-12)


def moved(place: tuple[Placement, np.ndarray, Placement], motion: str, step: float):
    """The Rasnik with one element moved by a step in mm or rad."""
    element, _, kind = motion.partition("_")
    vector = step * np.eye(3)["xyz".index(kind[-1])]
    mask, lens, sensor = place
    if element == "lens":
        return mask, lens + vector, sensor
    old = mask if element == "mask" else sensor
    if kind.startswith("turn"):
        new = Placement(old.position_mm, turn(vector) @ old.rotation)
    else:
        new = Placement(old.position_mm + vector, old.rotation)
    return (new, lens, sensor) if element == "mask" else (mask, lens, new)


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_derivatives_are_those_of_differences(rng, tilt) -> None:
    for _ in range(10):
        place = anywhere(rng, tilt)
        code = reading(*place).orientation
        slopes = derivatives(*place)
        ends_mm = (place[0].position_mm, place[2].position_mm)
        size = min(np.linalg.norm(place[1] - one) for one in ends_mm)
        # lengths in units of the smaller distance make everything of order 1
        rows = np.array([1e3 * size, 1e3 * size, 1, 1])
        columns = np.array([1 if "turn" in motion else 1e3 * size for motion in MOTIONS])
        expected = slopes / rows[:, None] * columns
        step = 1e-3  # of fourth order: errors of step^4, and of rounding over the step
        for column, motion in enumerate(MOTIONS):
            length = step if "turn" in motion else step * size
            ends = [
                readings(*moved(place, motion, sign * length), code)[0] for sign in (-2, -1, 1, 2)
            ]
            found = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step) / rows
            assert np.abs(found - expected[:, column]).max() < 1e-8 * np.abs(expected).max()


def test_what_cannot_be_read_is_said() -> None:
    with pytest.raises(ValueError, match="lens is not between mask and sensor"):
        reading(MASK, LENS + [0, 0, 200], SENSOR)
    with pytest.raises(ValueError, match="runs along the mask"):
        reading(Placement([0, 0, 0], turn([math.pi / 2, 0, 0])), LENS, SENSOR)
    with pytest.raises(ValueError, match="edge on"):
        reading(MASK, LENS, Placement(SENSOR.position_mm, turn([math.pi / 2, 0, 0])))
    with pytest.raises(ValueError, match="same place"):
        reading(MASK, SENSOR.position_mm, SENSOR)
    with pytest.raises(ValueError, match="orientation 2 is not possible.*1 and 4"):
        reading(MASK, LENS, SENSOR, 2)
    with pytest.raises(ValueError, match="not a finite number"):
        reading(MASK, LENS * math.nan, SENSOR)
    with pytest.raises(ValueError, match="3 x 3 rotation"):
        Placement([0, 0], np.eye(3))
    with pytest.raises(ValueError, match="use readings"):
        reading(Placement(np.zeros((2, 3)), np.eye(3)), LENS, SENSOR)


def test_one_that_cannot_be_read_does_not_stop_the_others() -> None:
    lenses = np.array([LENS, LENS + [0, 0, 200], LENS + [0, 0, 10]])
    values, codes = readings(MASK, lenses, SENSOR, allow_missing=True)
    assert codes.tolist() == [4, 0, 4]
    assert np.isnan(values).any(axis=1).tolist() == [False, True, False]
    slopes = derivatives(MASK, lenses, SENSOR, allow_missing=True)
    assert np.isnan(slopes).all(axis=(1, 2)).tolist() == [False, True, False]
    assert readings(MASK, LENS, SENSOR, 2, allow_missing=True)[1] == 0
    with pytest.raises(ValueError, match="lens is not between"):
        readings(MASK, lenses, SENSOR)


def test_an_image_of_tilted_elements_is_analysed_to_the_same_reading() -> None:
    system = load_system("solidras", ["sensor.width_px=360", "sensor.height_px=270"])
    mask = Placement([-5.0, -6.0, 0], turn([0.0, 0.04, 0.01]))
    sensor = Placement([0.2, -0.1, 126.0], turn([0.03, 0, 0]) @ FACING)
    expected = reading(mask, LENS, sensor)
    image = exact_image(system, projection(mask, LENS, sensor))
    found = analyse(image, system, model="projective")
    assert found.ok and found.orientation == expected.orientation
    # frames without noise: what is left is the tolerance of generator and fit
    assert (found.x_um, found.y_um) == pytest.approx((expected.x_um, expected.y_um), abs=2e-4)
    assert found.scale == pytest.approx(expected.scale, abs=2e-7)
    assert found.theta_rad == pytest.approx(expected.theta_rad, abs=2e-7)
