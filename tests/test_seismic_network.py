"""Networks of stations: plane waves with known strain, clocks, what singular places leave open."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal

from rasnik.characterisation.gaps import Series
from rasnik.seismic.clocks import on_one_clock, resampled
from rasnik.seismic.network import (
    GRADIENTS,
    SingularNetworkError,
    differential,
    strain,
    strain_tensor,
    transfer,
    without_common_mode,
)

START_S = 1_790_000_000.0


def series(values, name="a", rate_hz=20.0, start_s=START_S, unit="nm") -> Series:
    return Series(np.asarray(values, float), rate_hz, name, unit, start_s)


# ------------------------------------------------------------------------ clocks


def test_shared_time_and_shared_gaps(rng):
    a, b, c = (series(rng.normal(size=n), "abc"[k]) for k, n in enumerate((100, 90, 120)))
    b = series(b.values, "b", start_s=START_S + 10 / 20)
    a.values[20] = np.nan
    c.values[50] = np.nan
    one, two, three = on_one_clock([a, b, c])
    assert len(one) == len(two) == len(three) == 90
    assert one.start_s == two.start_s == START_S + 0.5
    for found, full, shift in ((one, a, 10), (two, b, 0), (three, c, 10)):
        expected = full.values[shift : shift + 90].copy()
        expected[[10, 40]] = np.nan
        np.testing.assert_array_equal(found.values, expected)


@pytest.mark.parametrize(
    ("other", "sentence"),
    [
        (series(np.zeros(100), "b", rate_hz=20.1), "rates differ .* give a rate to resample to"),
        (
            series(np.zeros(100), "b", start_s=START_S + 0.02),
            "beside those of the other; .* give a",
        ),
        (series(np.zeros(100), "b", start_s=START_S + 99), "no time in common"),
    ],
)
def test_different_clocks_are_refused(other, sentence):
    with pytest.raises(ValueError, match=sentence):
        on_one_clock([series(np.zeros(100)), other])
    with pytest.raises(ValueError, match="two stations at least"):
        on_one_clock([other])


@pytest.mark.parametrize("rate_hz", [20.0, 17.3, 50.0, 5.0])
def test_resampling_of_a_sine_is_exact_in_the_band(rate_hz):
    """A sinusoid at a phase between the samples; up to 0.4 of the slower rate."""
    n, slower = 2000, min(rate_hz, 20.0)
    for f_hz in (0.1 * slower, 0.4 * slower):
        one = series(np.sin(2 * np.pi * f_hz * np.arange(n) / 20.0 + 0.3))
        found = resampled(one, rate_hz, START_S + 0.0137)
        t_s = 0.0137 + np.arange(len(found)) / rate_hz
        error = found.values - np.sin(2 * np.pi * f_hz * t_s + 0.3)
        assert np.nanmax(np.abs(error)) < 1e-4
        missing = np.isnan(found.values).sum() / rate_hz  # 24 intervals at each end
        assert missing == pytest.approx(2 * 24 / slower, rel=0.1)


def test_resampling_folds_nothing_in():
    one = series(np.sin(2 * np.pi * 3.1 * np.arange(4000) / 20.0))
    assert np.nanmax(np.abs(resampled(one, 5.0).values)) < 1e-4


def test_resampling_leaves_gaps_and_refuses_nonsense():
    one = series(np.ones(400))
    one.values[200] = np.nan
    found = resampled(one, 20.0, START_S + 0.01)
    assert np.isnan(found.values[200 - 24 : 200 + 24]).all()
    assert np.nanmax(np.abs(found.values - 1)) < 1e-12
    with pytest.raises(ValueError, match="above 0"):
        resampled(one, -1.0)
    with pytest.raises(ValueError, match="has ended"):
        resampled(one, 20.0, START_S + 100)


def test_stations_of_different_rates_on_one_clock():
    def station(rate_hz, start_s, name):
        t_s = start_s + np.arange(round(100 * rate_hz)) / rate_hz
        return series(np.sin(2 * np.pi * 0.7 * (t_s - START_S)), name, rate_hz, start_s)

    one, other = on_one_clock(
        [station(20.0, START_S, "a"), station(27.5, START_S + 0.123, "b")], resample_hz=10.0
    )
    assert one.rate_hz == other.rate_hz == 10 and one.start_s == other.start_s
    assert one.valid > 900
    assert np.nanmax(np.abs(one.values - other.values)) < 2e-4


# ------------------------------------------------------------------------ two stations


def plane_wave(place_m, t_s, wavelength_m, f_hz=0.3, amplitude_nm=50.0):
    """Displacement along the way of a wave that runs along it, nm."""
    return amplitude_nm * np.sin(2 * np.pi * (place_m / wavelength_m - f_hz * t_s))


@pytest.mark.parametrize("wavelength_m", [200.0, 5000.0, 1e6])
def test_strain_of_a_plane_wave(wavelength_m):
    """(u(d/2) - u(-d/2)) / d = du/dx(0) sin(kd/2) / (kd/2)."""
    t_s, d = np.arange(400) / 20.0, 100.0
    a, b = (series(plane_wave(x, t_s, wavelength_m), n) for x, n in ((-50, "a"), (50, "b")))
    found, sigma = strain(a, b, d, (3.0, 4.0))
    k = 2 * np.pi / wavelength_m
    derivative = 50e-9 * k * np.cos(-2 * np.pi * 0.3 * t_s)
    np.testing.assert_allclose(
        found.values, derivative * math.sin(k * d / 2) / (k * d / 2), atol=1e-9 * 50e-9 * k
    )
    assert sigma == pytest.approx(5e-9 / 100)
    assert found.unit == "" and found.name == "strain from a to b"


def test_sigma_of_strain_is_its_scatter(rng):
    a, b = (series(rng.normal(0, s, 20_000)) for s in (3.0, 4.0))
    found, sigma = strain(a, b, 1e4, (3.0, 4.0))
    assert found.values.std() == pytest.approx(sigma, rel=0.03)


def test_pairs_that_cannot_be():
    a, b = series(np.zeros(10)), series(np.zeros(10), "b", unit="nm/s")
    with pytest.raises(ValueError, match="a is in nm, b in nm/s"):
        differential(a, b)
    with pytest.raises(ValueError, match="strain needs nm"):
        strain(b, b, 10.0)
    with pytest.raises(ValueError, match="above 0 m"):
        strain(a, a, 0.0)


def test_transfer_and_its_error(rng):
    """A delayed, halved copy with noise: closed form; its error by Monte Carlo."""
    pulls = []
    for _ in range(40):
        ground = rng.normal(size=4100)
        values = 0.5 * ground[:4096] + rng.normal(0, 0.5, 4096)
        values[1000] = np.nan  # two stretches
        one, other = series(ground[4:][:4096]), series(values, "b")  # b sees it 4 samples later
        found = transfer(one, other, length_s=128 / 20)
        expected = 0.5 * np.exp(-2j * np.pi * found.frequency_hz * 4 / 20)
        inside = slice(2, -2)
        off = (found.value - expected)[inside] / found.sigma[inside]
        pulls.append(off)
    # the window sees 4 samples of 128 of the copy outside of it, which weakens it by 0.2 %
    pulls = np.array(pulls)
    assert np.std([pulls.real, pulls.imag]) == pytest.approx(1, abs=0.1)
    assert abs(pulls.mean()) < 0.1


def test_transfer_without_gaps_is_that_of_scipy(rng):
    a, b = rng.normal(size=(2, 2000))
    found = transfer(series(a), series(b, "b"), length_s=10.0)
    options = (20.0, "hann", 200)
    expected = signal.csd(a, b, *options)[1] / signal.welch(a, *options)[1]
    np.testing.assert_allclose(found.value, expected, rtol=1e-12)


# ------------------------------------------------------------------------ common mode


def test_common_motion_is_taken_away(rng):
    common = rng.normal(0, 100, 5000)
    own = rng.normal(0, 1, (4, 5000))
    stations = [series(common + one, f"s{k}") for k, one in enumerate(own)]
    mean, left = without_common_mode(stations)
    np.testing.assert_allclose(mean.values, common + own.mean(axis=0))
    assert np.std([one.values for one in left]) == pytest.approx(math.sqrt(1 - 1 / 4), rel=0.02)
    np.testing.assert_allclose(np.sum([one.values for one in left], axis=0), 0, atol=1e-9)
    weighted, _ = without_common_mode(stations, [1, 0, 0, 0])
    np.testing.assert_allclose(weighted.values, stations[0].values)
    with pytest.raises(ValueError, match="4 weights of 0 or more"):
        without_common_mode(stations, [1, 2, 3])
    with pytest.raises(ValueError, match="one weight at least"):
        without_common_mode(stations, [0, 0, 0, 0])
    with pytest.raises(ValueError, match="not on one clock"):
        without_common_mode([stations[0], series(own[0], start_s=START_S + 1)])


# ------------------------------------------------------------------------ strain tensor

TRIANGLE = np.array([[0.0, 0.0], [800.0, 100.0], [300.0, 900.0]])
SQUARE = np.array([[0.0, 0.0], [800.0, 100.0], [300.0, 900.0], [1000.0, 1000.0]])
#: u0, v0 in nm; e_east, e_north, e_east_north, rotation
TRUTH = np.array([120.0, -40.0, 3e-9, -1e-9, 2e-9, 5e-9])


def moved(places_m, truth, origin_m):
    """Displacements (stations, 2) in nm of a homogeneous deformation, written out."""
    u0, v0, ee, nn, en, w = truth
    x, y = 1e9 * (places_m - origin_m).T
    return np.stack([u0 + ee * x + (en - w) * y, v0 + (en + w) * x + nn * y], axis=1)


@pytest.mark.parametrize("places_m", [TRIANGLE, SQUARE])
def test_homogeneous_deformation_is_found(places_m):
    u = moved(places_m, TRUTH, places_m.mean(axis=0))
    east, north = ([series([value] * 3) for value in column] for column in u.T)
    found = strain_tensor(east, north, places_m, 0.1)
    values = [found.series[name].values[0] for name in GRADIENTS]
    np.testing.assert_allclose(values, TRUTH, rtol=1e-10)
    assert found.degrees_of_freedom == 2 * len(places_m) - 6
    assert np.isnan(found.chi2).all() == (len(places_m) == 3)
    assert 1 < found.condition < 3


def test_rotation_is_that_of_a_turn():
    """Turned by a small angle anticlockwise from above: nothing but rotation."""
    angle = 1e-9
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    u = 1e9 * (TRIANGLE @ (turn - np.eye(2)).T)
    found = strain_tensor(*([series([v]) for v in column] for column in u.T), TRIANGLE)
    assert found.series["rotation"].values[0] == pytest.approx(angle, rel=1e-6)
    for name in ("e_east", "e_north", "e_east_north"):
        assert abs(found.series[name].values[0]) < 1e-6 * angle


def test_strain_tensor_of_a_plane_wave():
    """A shear wave that runs north-east, much longer than the network: du_i/dx_j = k_j a_i cos."""
    wavelength_m, t_s = 1e6, np.arange(200) / 20.0
    way, swing = np.array([1, 1]) / math.sqrt(2), np.array([1, -1]) / math.sqrt(2)
    k = 2 * np.pi / wavelength_m
    places_m = np.array([[0, 0], [800, 100], [300, 900], [1100, 1000]])  # a parallelogram
    middle = places_m.mean(axis=0)
    u = [plane_wave(way @ (p - middle), t_s, wavelength_m)[:, None] * swing for p in places_m]
    found = strain_tensor([series(v[:, 0]) for v in u], [series(v[:, 1]) for v in u], places_m)
    slope = 50e-9 * k * np.cos(-2 * np.pi * 0.3 * t_s)
    gradient = slope[:, None, None] * swing[:, None] * way
    expected = {
        "e_east": gradient[:, 0, 0],
        "e_north": gradient[:, 1, 1],
        "e_east_north": (gradient[:, 0, 1] + gradient[:, 1, 0]) / 2,
        "rotation": (gradient[:, 1, 0] - gradient[:, 0, 1]) / 2,
    }
    for name, values in expected.items():
        # (kd)^2 / 6 with d = 0.75 km, half the extent along the way, and terms of fourth order
        np.testing.assert_allclose(found.series[name].values, values, atol=5e-6 * 50e-9 * k)


def test_covariance_and_chi2_by_monte_carlo(rng):
    sigma = np.array([[1.0, 2.0], [0.5, 1.5], [3.0, 1.0], [2.0, 2.0]])
    u = moved(SQUARE, TRUTH, SQUARE.mean(axis=0))
    noisy = u[..., None] + sigma[..., None] * rng.normal(size=(4, 2, 40_000))
    east, north = ([series(v) for v in noisy[:, axis]] for axis in (0, 1))
    found = strain_tensor(east, north, SQUARE, sigma)
    values = np.array([found.series[name].values for name in GRADIENTS])
    spread = np.array(list(found.sigma.values()))
    np.testing.assert_allclose(
        np.cov(values) / np.outer(spread, spread),
        found.covariance / np.outer(spread, spread),
        atol=0.025,
    )
    assert np.all(np.abs(values.mean(axis=1) - TRUTH) < 5 * spread / math.sqrt(40_000))
    assert found.degrees_of_freedom == 2 and found.chi2.mean() == pytest.approx(2, rel=0.03)


def test_singular_networks_are_named():
    def flat(n):
        return [series(np.zeros(5), f"s{k}") for k in range(n)]

    line = np.array([[0.0, 0.0], [100.0, 100.0], [250.0, 250.0]])
    with pytest.raises(SingularNetworkError, match="on one line, 45 degrees clockwise from north"):
        strain_tensor(flat(3), flat(3), line)
    with pytest.raises(SingularNetworkError, match="at one place"):
        strain_tensor(flat(3), flat(3), np.zeros((3, 2)))
    with pytest.raises(SingularNetworkError, match="three stations, not 2; two give the strain"):
        strain_tensor(flat(2), flat(2), line[:2])
    with pytest.raises(ValueError, match="3 series to the east and 2 to the north"):
        strain_tensor(flat(3), flat(2), TRIANGLE)
    with pytest.raises(ValueError, match="sigma should be one number above 0, or 3, or 3 x 2"):
        strain_tensor(flat(3), flat(3), TRIANGLE, [1.0, 2.0])


def test_gaps_stay_gaps():
    east = [series(np.ones(5)) for _ in range(3)]
    east[1].values[2] = np.nan
    found = strain_tensor(east, [series(np.ones(5)) for _ in range(3)], TRIANGLE)
    assert np.isnan(found.series["e_east"].values).tolist() == [False, False, True, False, False]
