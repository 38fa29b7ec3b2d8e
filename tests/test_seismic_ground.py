"""Ground motion there and back: the response, the equation of motion, gaps, noise, signs."""

import math

import numpy as np
import pytest

from rasnik.characterisation.gaps import Series
from rasnik.seismic.equation_of_motion import reading_of_ground
from rasnik.seismic.ground import (
    GroundMotion,
    ground_motion,
    readout_asd,
    readout_rms,
    taper,
    taper_corners,
)
from rasnik.seismic.noise_models import noise_model
from rasnik.seismic.suspension import Suspension

RATE_HZ = 50.0
BAND_HZ = (0.1, 8.0)
MASS = Suspension(frequency_hz=0.5, q=30.0, on_mass="camera", coupling=1.02)
ORDER = {"displacement": 0, "velocity": 1, "acceleration": 2}


class Sines:
    """A ground motion that is known at any time, with its derivatives."""

    def __init__(self, rng: np.random.Generator, low_hz: float, high_hz: float) -> None:
        self.f_hz = np.exp(rng.uniform(math.log(low_hz), math.log(high_hz), 60))
        self.amplitude = rng.normal(size=60) / self.f_hz
        self.phase = rng.uniform(0, 2 * np.pi, 60)

    def at(self, t: np.ndarray, order: int) -> np.ndarray:
        w = 2 * np.pi * self.f_hz
        angle = np.outer(t, w) + self.phase + order * np.pi / 2
        return np.sin(angle) @ (self.amplitude * w**order)


def read(ground: Sines, seconds: float, mass: Suspension = MASS) -> tuple[Series, np.ndarray]:
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return reading_of_ground(Series(ground.at(t, 0), RATE_HZ), mass), t


@pytest.mark.parametrize("method", ["frequency", "time"])
@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
def test_motion_in_the_band_comes_back(
    rng: np.random.Generator, method: str, quantity: str
) -> None:
    ground = Sines(rng, 0.12, 7.0)
    series, t = read(ground, 300)
    found = ground_motion(series, MASS, quantity, band_hz=BAND_HZ, method=method)
    true = ground.at(t, ORDER[quantity])
    there = np.isfinite(found.values)
    error = (found.values - true)[there]
    assert found.unit == {0: "nm", 1: "nm/s", 2: "nm/s^2"}[ORDER[quantity]]
    assert there.sum() == len(t) - 2 * math.ceil(found.edge_s * RATE_HZ)
    assert error.std() < 4e-3 * true[there].std()  # the Butterworth filters: 0.4 % at the ends


def test_the_mean_over_the_exposure_is_undone(rng: np.random.Generator) -> None:
    """Of a sine the mean is known in closed form, and where it is."""
    f_hz, exposure_s = 5.0, 0.018
    t = np.arange(round(300 * RATE_HZ)) / RATE_HZ
    shown = np.sin(2 * np.pi * f_hz * t) * np.sinc(f_hz * exposure_s)
    series = reading_of_ground(Series(shown, RATE_HZ), MASS)
    left_in, undone = (
        ground_motion(series, MASS, "displacement", band_hz=BAND_HZ, exposure_s=one).values
        for one in (0.0, exposure_s)
    )
    there = np.isfinite(undone)
    true = np.sin(2 * np.pi * f_hz * t)[there]
    assert (undone[there] @ true) / (true @ true) == pytest.approx(1, abs=2e-4)
    assert (left_in[there] @ true) / (true @ true) == pytest.approx(0.987, abs=1e-3)
    plain, raised = (
        readout_rms(1.0, RATE_HZ, MASS, "displacement", band_hz=(4.9, 5.1), exposure_s=one)
        for one in (0.0, exposure_s)
    )
    assert 1.005 < raised / plain < 1.03
    for wrong, method, sentence in (
        (0.021, "frequency", "does not fit between frames"),
        (0.01, "time", "in the frequency domain only"),
    ):
        with pytest.raises(ValueError, match=sentence):
            ground_motion(series, MASS, band_hz=BAND_HZ, exposure_s=wrong, method=method)


def test_the_two_ways_agree_on_noise_with_drift(rng: np.random.Generator) -> None:
    """Nothing is known of this motion, and most of it lies outside the band."""
    n = round(600 * RATE_HZ)
    drift = np.cumsum(rng.normal(size=n)) + np.linspace(0, 300, n)
    series = Series(drift, RATE_HZ)
    mass = Suspension(frequency_hz=0.7, q=5.0)
    one, other = (
        ground_motion(series, mass, "velocity", band_hz=(0.2, 6.0), method=method)
        for method in ("frequency", "time")
    )
    # What both let through unchanged.
    there = np.isfinite(one.values)
    assert (there == np.isfinite(other.values)).all()
    f_hz = np.fft.rfftfreq(there.sum(), 1 / RATE_HZ)
    inner = (f_hz > 0.3) & (f_hz < 4.0)
    window = np.hanning(there.sum())
    a, b = (np.fft.rfft(window * m.values[there])[inner] for m in (one, other))
    assert np.linalg.norm(a - b) < 3e-3 * np.linalg.norm(a)


def test_forward_motion_at_one_frequency_is_the_response() -> None:
    """Long after its beginning the reading of a sine is the response times the sine."""
    mass = Suspension(frequency_hz=1.0, q=2.0)
    t = np.arange(3000) / RATE_HZ
    for f_hz in (0.2, 1.0, 6.0):
        ground = Series(np.exp(2j * np.pi * f_hz * t).real, RATE_HZ)
        found = reading_of_ground(ground, mass).values
        wanted = (mass.reading(f_hz) * np.exp(2j * np.pi * f_hz * t)).real
        np.testing.assert_allclose(found[2000:], wanted[2000:], atol=2e-3 * abs(mass.reading(f_hz)))


def test_forward_quantities_agree(rng: np.random.Generator) -> None:
    ground, t = Sines(rng, 0.2, 3.0), np.arange(3000) / RATE_HZ
    first, second, third = (
        reading_of_ground(Series(ground.at(t, k), RATE_HZ), MASS, name).values
        for name, k in ORDER.items()
    )
    np.testing.assert_allclose(second, first, atol=1e-3 * first.std())
    np.testing.assert_allclose(third, first, atol=1e-3 * first.std())


def test_sign_of_a_slow_push() -> None:
    """The ground accelerates to +X: the mass lags, and a mask on it moves to -X: x rises."""
    t = np.arange(2000) / RATE_HZ
    push = Series(np.full(len(t), 3.0), RATE_HZ, "ground", "nm/s^2")
    mass = Suspension(frequency_hz=0.5, q=0.7)
    x = reading_of_ground(push, mass, "acceleration")
    assert x.unit == "nm"
    assert x.values[-1] == pytest.approx(3.0 / mass.omega**2, rel=1e-3)
    camera = mass.model_copy(update={"on_mass": "camera"})
    np.testing.assert_array_equal(reading_of_ground(push, camera, "acceleration").values, -x.values)


def test_gaps_divide_and_nothing_is_filled_in(rng: np.random.Generator) -> None:
    ground = Sines(rng, 0.3, 7.0)
    series, t = read(ground, 300)
    values = series.values.copy()
    values[5000] = np.nan
    values[6000:6100] = np.nan  # the stretch before it is shorter than its ends
    band = (0.25, 8.0)
    found = ground_motion(
        Series(values, RATE_HZ, start_s=7.0), MASS, "velocity", band_hz=band, sigma=1.0
    )
    edge = math.ceil(24 * RATE_HZ)
    wanted = np.zeros(len(t), dtype=bool)
    wanted[edge : 5000 - edge] = wanted[6100 + edge : len(t) - edge] = True
    assert isinstance(found, GroundMotion) and found.start_s == 7.0
    np.testing.assert_array_equal(np.isfinite(found.values), wanted)
    assert (found.stretches, found.too_short) == (2, 1)
    true = ground.at(t, 1)[wanted]
    assert (found.values[wanted] - true).std() < 5e-3 * true.std()


@pytest.mark.parametrize("method", ["frequency", "time"])
@pytest.mark.parametrize(
    ("quantity", "high_hz"), [("displacement", 8.0), ("acceleration", 8.0), ("acceleration", 12.5)]
)
def test_noise_of_the_readings_is_as_stated(
    rng: np.random.Generator, method: str, quantity: str, high_hz: float
) -> None:
    band = (0.5, high_hz)
    runs = [
        ground_motion(
            Series(0.3 * rng.normal(size=8000), RATE_HZ), MASS, quantity,
            band_hz=band, method=method, sigma=0.3,
        )
        for _ in range(12)
    ]  # fmt: skip
    variance = np.mean([np.nanmean(one.values**2) for one in runs])
    # Independent values of displacement: twice the half hertz or so where most of it lies.
    independent = 12 * 136 * 2 * (0.4 if quantity == "displacement" else 4.0)
    tolerance = 4 / math.sqrt(2 * independent)
    assert math.sqrt(variance) / runs[0].sigma == pytest.approx(1, abs=tolerance)


def test_readout_noise_far_above_and_below_the_resonance() -> None:
    mass = Suspension(frequency_hz=0.5, q=30.0)
    low, high = readout_asd([1e-4, 1e3], 2.0, 100.0, mass, "acceleration")
    white = 2.0 * math.sqrt(2 / 100.0)
    assert low == pytest.approx(white * mass.omega**2, rel=1e-5)
    assert high == pytest.approx(white * (2 * math.pi * 1e3) ** 2, rel=1e-5)
    # Above the resonance a displacement is read as it is: the rms is white noise in the taper.
    band, corners = (10.0, 20.0), taper_corners((10.0, 20.0), 100.0)
    f_hz = np.linspace(0, 50, 100_001)
    wanted = white * math.sqrt(np.sum(taper(f_hz, corners) ** 2) * f_hz[1])
    found = readout_rms(2.0, 100.0, mass, "displacement", band_hz=band)
    assert found == pytest.approx(wanted, rel=1e-2)


def test_taper_is_one_in_the_band_and_nothing_outside() -> None:
    corners = taper_corners((1.0, 4.0), 100.0)
    assert corners == (0.5, 1.0, 4.0, 8.0)
    f_hz = np.array([0.2, 0.5, 0.75, 1.0, 2.0, 4.0, 6.0, 8.0, 20.0])
    np.testing.assert_allclose(taper(f_hz, corners), [0, 0, 0.5, 1, 1, 1, 0.5, 0, 0], atol=1e-12)
    assert taper_corners((1.0, 50.0), 100.0)[3] == 50.0
    assert taper(50.0, taper_corners((1.0, 50.0), 100.0)) == 1


def test_taper_is_that_of_obspy() -> None:
    pytest.importorskip("obspy")
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from obspy.signal.invsim import cosine_sac_taper
    f_hz = np.linspace(0, 50, 2001)
    corners = taper_corners((1.0, 4.0), 100.0)
    theirs = cosine_sac_taper(f_hz, flimit=corners)
    np.testing.assert_allclose(taper(f_hz, corners), theirs, atol=1e-12)


@pytest.mark.parametrize(
    ("band", "method", "sentence"),
    [
        ((0.0, 1.0), "frequency", "is no band"),
        ((2.0, 1.0), "frequency", "is no band"),
        ((1.0, 26.0), "frequency", "above 25 Hz, half the rate"),
        ((1.0, 13.0), "time", "a quarter of the rate"),
        ((0.01, 1.0), "frequency", "no stretch without a gap is longer than the 1200 s"),
    ],
)
def test_bands_that_cannot_be_are_refused(
    band: tuple[float, float], method: str, sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        ground_motion(Series(np.ones(5000), RATE_HZ), MASS, band_hz=band, method=method)


def test_other_wrong_series_are_refused() -> None:
    with pytest.raises(ValueError, match="theta_rad is in rad, not a length"):
        ground_motion(Series(np.ones(5000), RATE_HZ, "theta_rad", "rad"), MASS, band_hz=BAND_HZ)
    structural = Suspension(frequency_hz=0.5, q=30.0, damping="structural")
    series = Series(np.ones(20_000), RATE_HZ)
    with pytest.raises(ValueError, match="no poles"):
        ground_motion(series, structural, band_hz=BAND_HZ, method="time")
    with pytest.raises(ValueError, match="no poles"):
        reading_of_ground(series, structural)
    gap = Series(np.where(np.arange(100) == 50, np.nan, 1.0), RATE_HZ)
    with pytest.raises(ValueError, match="1 values of the ground motion are missing"):
        reading_of_ground(gap, MASS)
    with pytest.raises(ValueError, match="too few"):
        reading_of_ground(Series(np.ones(5), RATE_HZ), MASS)


# ------------------------------------------------------------------------ noise models


@pytest.mark.parametrize("model", ["low", "high"])
def test_noise_models_are_those_of_obspy(model: str) -> None:
    pytest.importorskip("obspy")
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from obspy.signal.spectral_estimation import get_nhnm, get_nlnm
    period_s, decibel = get_nlnm() if model == "low" else get_nhnm()
    ours = 10 * np.log10(noise_model(1 / period_s, model))
    np.testing.assert_allclose(ours, decibel, atol=1e-3)  # their periods have 6 digits


def test_noise_models_by_hand() -> None:
    assert 10 * math.log10(noise_model(10.0)) == pytest.approx(-162.36 - 5.64)
    assert 10 * math.log10(noise_model(1 / 4.5)) == pytest.approx(-141.10)
    velocity = noise_model(0.2, "high", "velocity")
    assert velocity * (2 * math.pi * 0.2) ** 2 == pytest.approx(float(noise_model(0.2, "high")))
    displacement = noise_model(0.2, "high", "displacement")
    assert displacement * (2 * math.pi * 0.2) ** 4 == pytest.approx(float(noise_model(0.2, "high")))
    assert np.isnan(noise_model([0.0, -1.0, 10.1, 0.9e-5])).all()
