"""Free decays of known f0 and Q: pulls, the Cramer-Rao bound, and what is said of bad ones."""

import json
import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter

from rasnik.characterisation.gaps import Series
from rasnik.seismic.ring_down import RingDown, ring_down

RATE_HZ = 20.0
TRUTH = {"f0": 0.5, "q": 30.0, "amplitude": 100.0, "offset": 50.0, "drift": 0.3}


def decay(seconds: float, phase: float, truth: dict[str, float] = TRUTH) -> np.ndarray:
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    w0 = 2 * np.pi * truth["f0"]
    g = w0 / (2 * truth["q"])
    swing = truth["amplitude"] * np.exp(-g * t) * np.cos(np.sqrt(w0**2 - g**2) * t + phase)
    return swing + truth["offset"] + truth["drift"] * t


def deviations(found: RingDown, phase: float, truth: dict[str, float] = TRUTH) -> np.ndarray:
    """(found - true) / sigma."""
    values = [found.frequency_hz, found.loss, found.amplitude, 0.0, found.offset, found.drift]
    wanted = [truth["f0"], 1 / truth["q"], truth["amplitude"], 0.0, truth["offset"], truth["drift"]]
    off = np.subtract(values, wanted)
    off[3] = math.remainder(found.phase_rad - phase, 2 * math.pi)
    return off / found.sigmas


@pytest.mark.parametrize("q", [0.8, 30.0, 1000.0])
def test_pulls_are_those_of_a_unit_gaussian(rng: np.random.Generator, q: float) -> None:
    truth, pulls = TRUTH | {"q": q}, []
    for k in range(60):
        phase = rng.uniform(-np.pi, np.pi)
        y = decay(60, phase, truth) + rng.normal(size=1200)
        if k % 2:  # gaps
            y[rng.random(1200) < 0.2] = np.nan
            y[400:500] = np.nan
        pulls.append(deviations(ring_down(Series(y, RATE_HZ)), phase, truth))
    # Of 60: the mean scatters by 0.13, the standard deviation by 0.09.
    assert np.abs(np.mean(pulls, axis=0)).max() < 4 * 0.13
    assert np.abs(np.std(pulls, axis=0) - 1).max() < 4 * 0.09


def test_errors_are_the_cramer_rao_bound(rng: np.random.Generator) -> None:
    """Against the information in the readings, by differences of the model."""
    sigma, phase = 2.0, 0.7
    found = ring_down(Series(decay(120, phase) + sigma * rng.normal(size=2400), RATE_HZ))
    t = np.arange(2400) / RATE_HZ

    def model(p: np.ndarray) -> np.ndarray:
        w0 = 2 * np.pi * p[0]
        g = w0 * p[1] / 2
        swing = p[2] * np.exp(-g * t) * np.cos(np.sqrt(w0**2 - g**2) * t + p[3])
        return swing + p[4] + p[5] * t

    true = np.array([0.5, 1 / 30, 100.0, phase, 50.0, 0.3])
    steps = np.array([1e-6, 1e-6, 1e-3, 1e-6, 1e-3, 1e-5])
    slopes = [(model(true + s) - model(true - s)) / (2 * s.sum()) for s in np.diag(steps)]
    bound = np.sqrt(np.diag(np.linalg.inv(np.dot(slopes, np.transpose(slopes)) / sigma**2)))
    np.testing.assert_allclose(found.sigmas, bound, rtol=0.08)  # sigma is known to 1.5 %
    assert found.rms == pytest.approx(sigma, rel=0.06)
    assert found.remarks == ()
    assert found.sigma_q == pytest.approx(found.sigmas[1] * found.q**2)
    np.testing.assert_allclose(
        found.values(t), model(true), atol=0.5
    )  # a quarter of the noise of one
    assert found.suspension(mass_kg=1.0).q == found.q


def low_noise(rng: np.random.Generator) -> np.ndarray:
    """White, and more of it below 0.3 Hz."""
    return rng.normal(size=2400) + lfilter([0.1], [1, -0.9], 20 * rng.normal(size=2400))


def driven_noise(rng: np.random.Generator) -> np.ndarray:
    """What a restless ground makes of the mass itself, seven times the noise of the readings."""
    w0 = 2 * np.pi * TRUTH["f0"] / RATE_HZ
    pole = np.exp(-w0 / (2 * TRUTH["q"]) + 1j * w0)
    driven = lfilter([1], [1, -2 * pole.real, abs(pole) ** 2], rng.normal(size=12_000))[-2400:]
    return 0.7 * rng.normal(size=2400) + 5 * driven / driven.std()


@pytest.mark.parametrize("noise", [low_noise, driven_noise])
def test_other_noise_than_white_enlarges_the_errors(
    rng: np.random.Generator, noise: Callable[[np.random.Generator], np.ndarray]
) -> None:
    truth, pulls, colours = TRUTH | {"amplitude": 1000.0}, [], []
    for k in range(60):
        phase = rng.uniform(-np.pi, np.pi)
        y = decay(120, phase, truth) + noise(rng)
        if k % 3 == 0:
            y[500:600] = np.nan
        found = ring_down(Series(y, RATE_HZ))
        pulls.append(deviations(found, phase, truth))
        colours.append(found.colour)
        assert any("around the resonance" in one for one in found.remarks)
    assert min(colours) > 2
    # The noise is known from some tens of bins: the errors of the errors add to those of 60.
    assert np.abs(np.std(pulls, axis=0) - 1).max() < 4 * 0.09 + 0.1
    assert np.abs(np.mean(pulls, axis=0)).max() < 4 * 0.13


def test_a_decay_that_is_too_short_gives_a_lower_bound_of_q(rng: np.random.Generator) -> None:
    truth = TRUTH | {"q": 1e5}
    above = 0
    for _ in range(40):
        found = ring_down(Series(decay(60, 0.3, truth) + rng.normal(size=1200), RATE_HZ))
        assert not found.decays and math.isnan(found.q) and math.isnan(found.time_constant_s)
        assert any("too short to give Q" in one for one in found.remarks)
        above += found.least_q <= 1e5
    assert above >= 33  # 95 % of 40, less four standard deviations
    with pytest.raises(ValueError, match="Q is not known"):
        found.suspension()
    assert json.loads(json.dumps(found.as_dict()))["q"] is None


def test_a_decay_that_is_not_exponential_is_called_so(rng: np.random.Generator) -> None:
    t = np.arange(2400) / RATE_HZ
    # Dry friction: the amplitude falls along a straight line.
    dry = np.maximum(100 - t, 0) * np.cos(np.pi * t) + rng.normal(size=2400)
    found = ring_down(Series(dry, RATE_HZ))
    assert found.not_exponential < 1e-6
    assert any("not exponential" in one for one in found.remarks)
    named = 0
    for _ in range(40):
        plain = ring_down(Series(decay(60, 0.3) + rng.normal(size=1200), RATE_HZ))
        named += any("not exponential" in one for one in plain.remarks)
    assert named <= 1  # one in a thousand


def test_the_stated_noise_is_checked(rng: np.random.Generator) -> None:
    series = Series(decay(60, 0.3) + 2.0 * rng.normal(size=1200), RATE_HZ)
    good, small, none = (ring_down(series, sigma=sigma) for sigma in (2.0, 1.0, None))
    assert good.chi2_ndf == pytest.approx(1, abs=0.17)
    assert good.remarks == ()
    assert small.chi2_ndf == pytest.approx(4, abs=0.7)
    assert any("times the stated noise" in one for one in small.remarks)
    assert math.isnan(none.chi2_ndf)
    np.testing.assert_allclose(small.sigmas, none.sigmas)


def test_the_oscillation_that_is_asked_for_is_taken(rng: np.random.Generator) -> None:
    t = np.arange(1200) / RATE_HZ
    both = decay(60, 0.3) + 150 * np.exp(-t / 30) * np.cos(2 * np.pi * 3.1 * t)
    series = Series(both + rng.normal(size=1200), RATE_HZ)
    assert ring_down(series).frequency_hz == pytest.approx(3.1, abs=0.01)
    assert ring_down(series, frequency_hz=0.51).frequency_hz == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (np.ones(10), "too few"),
        (np.ones(100), "all readings are the same"),
        (np.random.default_rng(1).normal(size=1000), "no free oscillation stands out"),
        (lfilter([1], [1, -0.95], np.random.default_rng(2).normal(size=4000)), "stands out"),
        (np.cos(2 * np.pi * np.arange(100) / 80), "fewer than 2 periods"),
    ],
)
def test_what_shows_no_decay_is_refused(values: np.ndarray, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        ring_down(Series(values, RATE_HZ))


def test_wrong_arguments_are_refused(rng: np.random.Generator) -> None:
    series = Series(decay(60, 0.3) + rng.normal(size=1200), RATE_HZ)
    with pytest.raises(ValueError, match="must be above 0"):
        ring_down(series, sigma=-1.0)
    with pytest.raises(ValueError, match="cannot be seen"):
        ring_down(series, frequency_hz=40.0)
