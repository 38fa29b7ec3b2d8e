"""Self-noise against the closed forms of its terms."""

import json
import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from rasnik.instrument import System, load_system
from rasnik.performance.bound import bound
from rasnik.seismic.budget import BOLTZMANN, SelfNoise, self_noise, thermal_asd
from rasnik.seismic.ground import readout_asd
from rasnik.seismic.noise_models import noise_model
from rasnik.seismic.suspension import Suspension

MASS = Suspension(frequency_hz=0.5, q=100.0, mass_kg=2.0)
SYSTEM = load_system("microras")
SLOW = load_system("microras", {"sensor.frame_rate_hz": 25.0, "sensor.exposure_s": 0.04})


@pytest.fixture(scope="module")
def budget() -> SelfNoise:
    return self_noise(SYSTEM, MASS)


@pytest.mark.parametrize("q", [0.7, 10.0])
def test_thermal_motion_has_half_k_t_for_each_degree_of_freedom(q: float) -> None:
    """The variance of the displacement is k T / stiffness, whatever Q is."""
    mass = Suspension(frequency_hz=2.0, q=q, mass_kg=0.3, coupling=1.2)

    def displacement_psd(f_hz: float) -> float:
        gain = abs(mass.response(f_hz, "acceleration"))
        return float((thermal_asd(f_hz, mass, 300.0) * gain) ** 2)

    edges = (0, 1, 1.9, 2, 2.1, 3, 10, 100, 1e4)
    variance = sum(quad(displacement_psd, a, b, limit=200)[0] for a, b in pairwise(edges))
    assert variance == pytest.approx(BOLTZMANN * 300 / (0.3 * mass.omega**2), rel=1e-4)


@pytest.mark.parametrize("damping", ["viscous", "structural"])
def test_thermal_noise_is_that_of_fluctuation_and_dissipation(damping: str) -> None:
    """S_r = -4 k T / w Im(r per force) (Saulson 1990, from Callen and Welton)."""
    mass = Suspension(frequency_hz=0.5, q=20.0, mass_kg=2.0, damping=damping)
    f_hz = np.geomspace(0.01, 10, 30)
    per_force = 1 / (mass.mass_kg * mass.stiffness(f_hz))
    wanted = -4 * BOLTZMANN * 300 / (2 * np.pi * f_hz) * per_force.imag
    found = (thermal_asd(f_hz, mass, 300.0) * np.abs(mass.response(f_hz, "acceleration"))) ** 2
    np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_thermal_noise_needs_the_mass() -> None:
    bare = Suspension(frequency_hz=0.5, q=100.0)
    with pytest.raises(ValueError, match="give mass_kg"):
        thermal_asd(1.0, bare)
    found = self_noise(SYSTEM, bare, reading_pm_rthz=5.0)
    assert [term.name for term in found.terms] == ["readout"]
    assert any("the mass is not known" in one for one in found.not_counted)
    assert math.isnan(found.need(1.0).mass_q)


def test_readout_is_the_bound_at_the_frame_rate(budget: SelfNoise) -> None:
    sigma_nm = bound(SYSTEM, rounding=True).sigma_x_nm
    rate_hz = SYSTEM.sensor.frame_rate_hz
    assert rate_hz is not None
    assert budget.reading_pm_rthz == pytest.approx(1e3 * sigma_nm * math.sqrt(2 / rate_hz))
    readout, rounding, thermal = budget.terms
    both = np.hypot(readout.asd, rounding.asd)
    wanted = readout_asd(budget.frequency_hz, 1e-9 * sigma_nm, rate_hz, MASS)
    np.testing.assert_allclose(both, wanted)
    np.testing.assert_allclose(budget.total, np.hypot(both, thermal.asd))
    # Far below the resonance acceleration is displacement times w0^2.
    assert both[0] == pytest.approx(1e-12 * budget.reading_pm_rthz * MASS.omega**2, rel=1e-4)


def test_four_times_the_frames_halve_the_noise_of_the_readings(budget: SelfNoise) -> None:
    quick = self_noise(SYSTEM, MASS, rate_hz=4 * budget.rate_hz)
    assert quick.reading_pm_rthz == pytest.approx(budget.reading_pm_rthz / 2)


def test_y_has_its_own_bound() -> None:
    wide = load_system("solidras")
    along_y = self_noise(wide, MASS, axis="y", rate_hz=100.0)
    sigma_nm = bound(wide, rounding=True).sigma_y_nm
    assert along_y.reading_pm_rthz == pytest.approx(1e3 * sigma_nm * math.sqrt(2 / 100.0))


def test_bands_below_the_low_noise_model_end_where_the_curves_cross() -> None:
    found = self_noise(SYSTEM, MASS, reading_pm_rthz=2000.0)
    assert len(found.quiet_hz) >= 1
    for low, high in found.quiet_hz:
        assert found.frequency_hz[0] < low < high
        for f_hz in (low, high):
            need = found.need(f_hz)
            assert need.total == pytest.approx(need.model, rel=2e-2)  # a bin is 2 % wide
        assert found.need(math.sqrt(low * high)).total < found.need(math.sqrt(low * high)).model
    noisy = self_noise(SYSTEM, MASS, reading_pm_rthz=1e7)
    assert noisy.quiet_hz == ()


def test_bands_reach_the_ends_of_the_budget() -> None:
    found = self_noise(SYSTEM, MASS, reading_pm_rthz=0.01, frequency_hz=np.geomspace(0.01, 5, 50))
    assert found.quiet_hz == ((pytest.approx(0.01), pytest.approx(5.0)),)


def test_the_mean_over_a_long_exposure_hides_the_ground() -> None:
    """A sine of the ground at 10 Hz, averaged over 40 ms, is sin(0.4 pi) / (0.4 pi) of itself."""
    f_hz = np.array([1e-3, 10.0])
    whole, instant = (
        self_noise(one, MASS, reading_pm_rthz=5.0, frequency_hz=f_hz)
        for one in (SLOW, load_system("microras", {"sensor.frame_rate_hz": 25.0}))
    )
    lower = math.sin(0.4 * math.pi) / (0.4 * math.pi)
    found = whole.terms[0].asd / instant.terms[0].asd
    assert found == pytest.approx([1, 1 / lower], rel=1e-7)
    np.testing.assert_array_equal(whole.terms[1].asd, instant.terms[1].asd)  # moves the mass
    assert whole.need(10.0).readout == pytest.approx(whole.terms[0].asd[1])
    with pytest.raises(ValueError, match=r"exposure of 0.04 s does not fit between frames at 50"):
        self_noise(SLOW, MASS, reading_pm_rthz=5.0, rate_hz=50.0)


@pytest.mark.parametrize("system", [SYSTEM, SLOW], ids=["instant", "exposure"])
@pytest.mark.parametrize("f_hz", [0.01, 0.1, 3.0, 10.0])
def test_what_is_needed_is_enough(f_hz: float, system: System) -> None:
    found = self_noise(system, MASS, reading_pm_rthz=500.0, temperature_k=3e5)
    need = found.need(f_hz)
    half = math.sqrt(float(noise_model(f_hz)) / 2)
    # More frames, each as good, and a heavier mass:
    better = self_noise(
        system,
        MASS.model_copy(update={"mass_kg": 2.0 * need.mass_q}),
        reading_pm_rthz=500.0 / math.sqrt(need.readout_power),
        temperature_k=3e5,
    )
    now = better.need(f_hz)
    assert max(now.readout, now.thermal) <= half * (1 + 1e-9)
    if need.readout_power > 1 and need.mass_q > 1:
        assert now.total == pytest.approx(now.model, rel=1e-2)
    # Or another frequency, at its edges just enough:
    if need.natural_hz is not None:
        for edge in need.natural_hz:
            if edge > 0:
                tuned = MASS.model_copy(update={"frequency_hz": edge})
                other = self_noise(system, tuned, reading_pm_rthz=500.0)
                assert other.need(f_hz).readout == pytest.approx(half, rel=1e-6)


def test_no_frequency_helps_where_q_is_too_low() -> None:
    damped = Suspension(frequency_hz=0.5, q=0.1, mass_kg=2.0)
    need = self_noise(SYSTEM, damped, reading_pm_rthz=1e5).need(5.0)
    assert need.natural_hz is None
    assert need.readout_power > 1


def test_further_terms_are_added(budget: SelfNoise) -> None:
    found = self_noise(SYSTEM, MASS, extra={"air": 3.0, "tilt": lambda f_hz: 1e-9 / f_hz})
    air, tilt = found.terms[-2:]
    np.testing.assert_allclose(tilt.asd, 1e-9 / found.frequency_hz)
    white = readout_asd(
        found.frequency_hz, 3e-12 * math.sqrt(found.rate_hz / 2), found.rate_hz, MASS
    )
    np.testing.assert_allclose(air.asd, white)
    np.testing.assert_allclose(found.total**2, budget.total**2 + white**2 + tilt.asd**2)
    assert found.reading_pm_rthz == pytest.approx(math.hypot(budget.reading_pm_rthz, 3.0))


def test_the_document_is_json(budget: SelfNoise) -> None:
    document = json.loads(json.dumps(budget.as_dict((0.1, 1.0), curves=True)))
    assert document["suspension"]["q"] == 100
    assert len(document["total_asd_m_s2_rthz"]) == len(document["frequency_hz"])
    assert document["needs"][1]["frequency_hz"] == 1


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"rate_hz": -1.0}, "the frame rate must be above 0"),
        ({"temperature_k": 0.0}, "the temperature must be above 0"),
        ({"reading_pm_rthz": 0.0}, "the noise of the readings must be above 0"),
        ({"extra": {"air": -1.0}}, "air must be a number"),
        ({"frequency_hz": [1.0]}, "two or more"),
        ({"frequency_hz": [1.0, 500.0]}, "above half the frame rate"),
    ],
)
def test_impossible_values_are_refused(options: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        self_noise(SYSTEM, MASS, **({"reading_pm_rthz": 5.0} | options))


def test_systems_without_a_rate_and_frequencies_out_of_reach_are_refused(
    budget: SelfNoise,
) -> None:
    slow = load_system("microras", {"sensor.frame_rate_hz": None, "sensor.exposure_s": None})
    with pytest.raises(ValueError, match="frame rate of system microras is not known"):
        self_noise(slow, MASS)
    hourly = self_noise(slow, MASS, reading_pm_rthz=5.0, rate_hz=1 / 3600)
    assert hourly.frequency_hz[-1] == pytest.approx(1 / 7200)
    with pytest.raises(ValueError, match="the budget goes from"):
        budget.need(1e-4)
    with pytest.raises(ValueError, match="says nothing at 20 Hz"):
        budget.need(20.0)
