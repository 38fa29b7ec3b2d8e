"""Air: the index against published tables, bending against rays followed through the gradient."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rasnik.geometry.air import Air, _saturation_pa
from rasnik.geometry.effects import corrected
from rasnik.geometry.refraction import (
    air_effect,
    bending_along_path_um,
    bending_effect,
    bending_um,
    equivalent_motions_um,
    index_gradient,
    path_weights_um,
)
from rasnik.geometry.three_points import ThreePoints

BENCH = ThreePoints(2000.0, 3000.0)

# Stone and Zimmerman, Index of Refraction of Air (NIST), comparison of both equations:
# degrees, % humidity, kPa, nm, n of Ciddor, n of the modified Edlen equation.
NIST = [
    (20, 0, 101.325, 633, 1.000271800, 1.000271799),
    (20, 0, 60, 633, 1.000160924, 1.000160920),
    (20, 0, 120, 633, 1.000321916, 1.000321918),
    (50, 0, 100, 633, 1.000243285, 1.000243270),
    (5, 0, 100, 633, 1.000282756, 1.000282750),
    (-40, 0, 100, 633, 1.000337580, 1.000337471),
    (50, 100, 120, 633, 1.000287924, 1.000287864),
    (40, 75, 120, 633, 1.000299418, 1.000299406),
    (20, 100, 100, 633, 1.000267394, 1.000267394),
    (40, 100, 110, 1700, 1.000270247, 1.000270237),
    (20, 0, 101.325, 1700, 1.000268479, 1.000268483),
    (40, 100, 110, 300, 1.000289000, 1.000288922),
    (20, 0, 101.325, 300, 1.000286581, 1.000286579),
    (-40, 0, 120, 300, 1.000427233, 1.000427072),
]


@pytest.mark.parametrize("row", NIST)
def test_index_is_that_of_the_published_table(row) -> None:
    celsius, percent, kpa, nm, ciddor, edlen = row
    air = Air(273.15 + celsius, 10 * kpa, percent / 100, nm)
    assert air.index == pytest.approx(edlen, abs=0.51e-9)  # rounded there
    assert air.index == pytest.approx(ciddor, abs=1.7e-7)


def test_saturation_pressure_is_that_of_the_published_check_values() -> None:
    # IAPWS-IF97, table 35: nine digits
    assert _saturation_pa(300.0) == pytest.approx(3536.58941, rel=0, abs=0.5e-5)
    assert _saturation_pa(500.0) == pytest.approx(2.63889776e6, rel=0, abs=0.5e-2)
    # ice and water meet at the triple point
    assert _saturation_pa(273.1599) == pytest.approx(_saturation_pa(273.1601), rel=1e-4)


def test_slopes_are_those_of_a_gas() -> None:
    # n - 1 goes with the density; air deviates from the ideal gas by some 1e-3
    for air in (Air(humidity=0), Air(humidity=0.8), Air(263.15, 900, 0.5, 1000)):
        assert air.slopes.per_k == pytest.approx(-air.refractivity / air.temperature_k, rel=3e-3)
        assert air.slopes.per_hpa == pytest.approx(air.refractivity / air.pressure_hpa, rel=2e-3)
        wet, dry = (Air(air.temperature_k, air.pressure_hpa, h, air.wavelength_nm) for h in (1, 0))
        assert air.slopes.per_humidity == pytest.approx(wet.index - dry.index, rel=1e-6)


def test_vacuum_bends_nothing() -> None:
    vacuum = Air(pressure_hpa=0, humidity=0)
    assert vacuum.index == 1
    assert vacuum.slopes.per_k == 0
    assert air_effect(BENCH, vacuum, (5, 5)).change == pytest.approx(np.zeros(4))


def test_pressure_falls_upward_by_a_hectopascal_in_8_metres() -> None:
    # 1.2 kg/m^3 of air weigh 11.8 N
    assert Air().hydrostatic_hpa_per_m == pytest.approx(-1.2041 * 9.80665 / 100, rel=1e-3)


def test_errors_of_the_index_are_those_of_draws(rng) -> None:
    sigmas = np.array([0.3, 2.0, 0.05])
    air = Air(295.0, 990.0, 0.4, 450, *sigmas)
    states = [295.0, 990.0, 0.4] + sigmas * rng.standard_normal((10_000, 3))
    drawn = [Air(*one, 450) for one in states]
    accuracy = 4.5 / math.sqrt(2 * len(drawn))
    assert np.std([one.index for one in drawn]) == pytest.approx(air.sigma_index, rel=accuracy)
    slopes = [one.slopes.per_k for one in drawn]
    assert np.std(slopes) == pytest.approx(air.sigma_per_k, rel=accuracy)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"wavelength_nm": 200}, "wavelength_nm = 200 is outside 300 .. 1700 nm"),
        ({"humidity": 45}, "humidity = 45 is outside 0 .. 1"),
        ({"temperature_k": 20}, "temperature_k = 20 is outside 233"),
        ({"pressure_hpa": math.nan}, "pressure_hpa = nan"),
        ({"sigma_humidity": -1}, "must not be negative"),
        ({"pressure_hpa": 5}, "means 11.7 hPa of water vapour, more than pressure_hpa = 5"),
    ],
)
def test_air_out_of_range_is_said(change, sentence) -> None:
    with pytest.raises(ValueError, match=sentence):
        Air(**change)


def followed(instrument: ThreePoints, gradient, index: float = 1.00027) -> float:
    """Where a ray in the plane through lens and sensor centre meets the mask, um.

    d/ds (n dr/ds) = grad n, with n = index + gradient(z) x; mm.
    """
    a, end = instrument.mask_lens_mm, instrument.mask_lens_mm + instrument.lens_sensor_mm

    def ray(z, state):
        x, slope = state
        slowed = index + 1e-3 * gradient(z) * x
        return slope, 1e-3 * gradient(z) * (1 + slope**2) / slowed

    def path(start, to, slope):
        found = solve_ivp(ray, (start, to), (0, slope), rtol=1e-12, atol=1e-13, max_step=50)
        return found.y[0, -1]

    # by the secant method: the ray from the lens that meets the centre of the sensor
    low, high = -1e-3, 1e-3
    for _ in range(8):
        ends = [path(a, end, slope) for slope in (low, high)]
        if ends[1] == ends[0]:
            break
        low, high = high, high - ends[1] * (high - low) / (ends[1] - ends[0])
    return 1e3 * path(a, 0.0, high)


def test_a_uniform_gradient_is_that_of_a_ray_followed() -> None:
    g = -1e-6
    # the closed form takes n as 1
    assert followed(BENCH, lambda z: g) == pytest.approx(float(bending_um(BENCH, g)), rel=5e-4)
    assert bending_um(BENCH, 1e-6) == pytest.approx(1e-6 * 2.0 * 5.0 / 2 * 1e6)


def test_a_profile_is_that_of_a_ray_followed() -> None:
    def profile(z: float) -> float:
        return 1e-6 * (math.exp(-(((z - 1500) / 600) ** 2)) - 0.3 * z / 5000)

    found = bending_along_path_um(BENCH, profile)
    assert followed(BENCH, profile) == pytest.approx(found, rel=5e-4)
    z = np.linspace(0, 5000, 2001)
    weights = path_weights_um(BENCH, z)
    assert weights @ [profile(one) for one in z] == pytest.approx(found, rel=1e-5)


def test_the_error_grows_with_the_square_of_the_distance() -> None:
    long = ThreePoints(3 * BENCH.mask_lens_mm, 3 * BENCH.lens_sensor_mm)
    assert bending_um(long, 1e-6) == pytest.approx(9 * bending_um(BENCH, 1e-6))


def test_sign_the_reading_grows_towards_the_denser_air() -> None:
    assert bending_um(BENCH, 1e-6) > 0
    colder_at_the_right = air_effect(BENCH, Air(), (-1.0, 0.0))
    assert colder_at_the_right.change[0] > 0 and colder_at_the_right.change[1] == 0
    warmer_above = air_effect(BENCH, Air(), (0.0, 1.0))
    assert warmer_above.change[1] < 0


def test_weights_of_points_along_the_path() -> None:
    assert path_weights_um(BENCH, [700.0]) == pytest.approx(bending_um(BENCH, 1.0))
    z = np.array([100.0, 2000.0, 2600.0, 4400.0])
    weights = path_weights_um(BENCH, z)
    assert weights.sum() == pytest.approx(bending_um(BENCH, 1.0), rel=1e-12)
    gradients = np.array([2e-6, -1e-6, 3e-6, 1e-6])
    exact = bending_along_path_um(BENCH, lambda one: float(np.interp(one, z, gradients)))
    assert weights @ gradients == pytest.approx(exact, rel=1e-9)
    # most counts what is near the lens, nothing what is at the ends
    fine = path_weights_um(BENCH, np.linspace(0, 5000, 101))
    assert fine.argmax() == 40
    assert fine[[0, -1]].max() < 0.01 * fine.max()
    with pytest.raises(ValueError, match="grow along the light"):
        path_weights_um(BENCH, [100.0, 50.0])


def test_what_motion_reads_the_same() -> None:
    found = equivalent_motions_um(BENCH, 10.0)
    for name, value in found.items():
        assert BENCH.read({name: value}).x_um == pytest.approx(10, rel=1e-9)


def test_index_gradient_from_temperature_pressure_and_humidity() -> None:
    air = Air(293.15, 1013.25, 0, 633)
    # 1 K/m at 20 degrees: (n - 1) / T
    assert index_gradient(air, 1.0) == pytest.approx(-2.718e-4 / 293.15, rel=3e-3)
    upward = index_gradient(air, 0.0, air.hydrostatic_hpa_per_m)
    assert upward == pytest.approx(-2.718e-4 / 8.58e3, rel=3e-3)  # one scale height of 8.6 km
    assert index_gradient(air, 0.0, 0.0, 0.1) < 0  # vapour refracts less than dry air


def test_correction_of_a_reading_with_its_errors(rng) -> None:
    draws = 10_000
    air = Air(295.0, 1000.0, 0.4, 550, 3.0, 10.0, 0.1)
    gradient, sigma = np.array([0.8, -0.5]), np.array([0.01, 0.02])
    noise = np.diag([0.01, 0.02, 1e-6, 1e-6]) ** 2
    states = [295.0, 1000.0, 0.4] + np.array([3.0, 10.0, 0.1]) * rng.standard_normal((draws, 3))
    per_k = np.array([Air(*one, 550).slopes.per_k for one in np.clip(states, 0, [400, 1400, 1])])
    truth = np.array([100.0, 200.0, 1.5, 0.01])
    values = truth + rng.multivariate_normal(np.zeros(4), noise, draws)
    values[:, :2] += bending_um(BENCH, air.slopes.per_k * gradient)
    believed = gradient + sigma * rng.standard_normal((draws, 2))
    undone = values[:, :2] - bending_um(BENCH, per_k[:, None] * believed)
    effect = air_effect(BENCH, air, gradient, sigma)
    found, covariance = corrected(values[0], noise, [effect])
    assert found == pytest.approx(values[0] - effect.change)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance[:2, :2]), (undone - truth[:2]).T)
    assert np.cov(whitened) == pytest.approx(np.eye(2), abs=4.5 * math.sqrt(2 / draws))
    # the error of dn/dT makes x and y go together
    assert abs(covariance[0, 1]) > 0.05 * math.sqrt(covariance[0, 0] * covariance[1, 1])
    assert covariance[2:, 2:] == pytest.approx(noise[2:, 2:])


def test_effect_of_a_gradient_of_the_index() -> None:
    effect = bending_effect(BENCH, (1e-7, 2e-7), np.diag([1e-8, 2e-8]) ** 2)
    assert effect.change == pytest.approx([0.5, 1.0, 0, 0])
    assert np.sqrt(np.diag(effect.covariance)) == pytest.approx([0.05, 0.1, 0, 0])
