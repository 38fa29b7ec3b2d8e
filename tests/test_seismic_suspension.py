"""The suspended mass against what mechanics says of it."""

import math
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from rasnik.instrument import SystemConfigError
from rasnik.seismic.linkage import Arm, WattLinkage
from rasnik.seismic.suspension import (
    Suspension,
    pendulum_frequency_hz,
    pendulum_length_m,
)
from rasnik.seismic.suspension_file import load_suspension

MASS = Suspension(frequency_hz=0.5, q=20.0)


def test_far_above_its_frequency_the_mass_stays_where_it_is() -> None:
    assert MASS.response(5e3) == pytest.approx(-1, abs=1e-5)


def test_far_below_the_mass_lags_by_acceleration_over_w0_squared() -> None:
    assert MASS.response(1e-5, "acceleration") == pytest.approx(-1 / MASS.omega**2, rel=1e-5)


@pytest.mark.parametrize("damping", ["viscous", "structural"])
def test_at_resonance_the_gain_is_q_a_quarter_period_late(damping: str) -> None:
    mass = Suspension(frequency_hz=0.5, q=20.0, damping=damping)
    assert mass.response(0.5) == pytest.approx(-20j, rel=1e-12)


def test_quantities_differ_by_i_w() -> None:
    f_hz = np.geomspace(1e-3, 1e2, 50)
    w = 2 * np.pi * f_hz
    for of, per in (("displacement", "velocity"), ("velocity", "acceleration")):
        np.testing.assert_allclose(
            MASS.response(f_hz, of),
            MASS.response(f_hz, per) * 1j * w,
            rtol=1e-12,
        )


@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
@pytest.mark.parametrize("q", [0.3, 0.5, 0.7, 100.0])
def test_poles_and_zeros_are_the_response(quantity: str, q: float) -> None:
    mass = Suspension(frequency_hz=2.0, q=q, coupling=1.1)
    f_hz = np.geomspace(1e-2, 1e2, 40)
    found = mass.poles_zeros(quantity)
    np.testing.assert_allclose(found.response(f_hz), mass.response(f_hz, quantity), rtol=1e-6)
    assert all(pole.real < 0 for pole in found.poles)


@pytest.mark.parametrize("q", [0.3, 0.5, 0.7, 10.0])
def test_impulse_response_is_the_motion_after_a_step_of_velocity(q: float) -> None:
    mass = Suspension(frequency_hz=1.0, q=q)
    t = np.linspace(0, 3, 61)

    def motion(_: float, state: np.ndarray) -> list[float]:
        return [state[1], -mass.omega / q * state[1] - mass.omega**2 * state[0]]

    # The frame moves off at 1 m/s: seen from it, the mass at first moves at -1 m/s.
    solved = solve_ivp(motion, (0, 3), [0.0, -1.0], t_eval=t, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(mass.impulse_response(t), solved.y[0], atol=1e-7)
    assert mass.impulse_response(-1.0) == 0


def test_signs_of_the_reading() -> None:
    """A mask that moves to +X lowers x; the ground under a camera on the mass raises it."""
    # Quick motion of the ground to +X: the mass lags, to -X as seen from the frame.
    mask = Suspension(frequency_hz=0.5, q=20.0, on_mass="mask")
    assert mask.reading(5e3).real == pytest.approx(1, abs=1e-5)
    camera = Suspension(frequency_hz=0.5, q=20.0, on_mass="camera")
    assert camera.reading(5e3).real == pytest.approx(-1, abs=1e-5)


def test_time_constant_is_that_of_the_decay() -> None:
    one, later = np.abs(MASS.impulse_response([0.5, 0.5 + 2 * 10]))  # ten periods of nearly 2 s
    assert math.log(one / later) == pytest.approx(20 / MASS.time_constant_s, rel=2e-2)


def test_a_second_pendulum_is_a_metre_long() -> None:
    assert pendulum_length_m(0.5) == pytest.approx(0.99362, abs=1e-5)
    assert pendulum_frequency_hz(pendulum_length_m(0.37)) == pytest.approx(0.37)
    assert MASS.pendulum_length_m == pendulum_length_m(0.5)
    with pytest.raises(ValueError, match="length and gravity above 0"):
        pendulum_frequency_hz(-1.0)


def test_structural_damping_has_no_poles() -> None:
    mass = Suspension(frequency_hz=0.5, q=20.0, damping="structural")
    with pytest.raises(ValueError, match="no poles"):
        mass.poles_zeros()
    with pytest.raises(ValueError, match="no poles"):
        mass.impulse_response([0.0])


def test_impossible_values_are_refused() -> None:
    for wrong in ({"frequency_hz": 0.0}, {"q": -1.0}, {"mass_kg": 0.0}, {"damping": "none"}):
        with pytest.raises(ValidationError):
            Suspension(**({"frequency_hz": 0.5, "q": 20.0} | wrong))


# ------------------------------------------------------------------------ Watt's linkage

LINKAGE = WattLinkage(
    pendulum=Arm(length_mm=100.0, load_kg=0.6, mass_kg=0.05, flexure_nm_per_rad=0.02),
    inverted=Arm(length_mm=80.0, load_kg=0.4, mass_kg=0.08, flexure_nm_per_rad=0.03),
)


def energy_of_linkage(r_m: float, ground_m_s: float, mass_m_s: float) -> tuple[float, float]:
    """(potential, kinetic) energy by adding up the parts of each arm."""
    potential = kinetic = 0.0
    share = (np.arange(20_000) + 0.5) / 20_000  # along an arm, from the end on the frame
    for arm, up in ((LINKAGE.pendulum, 1), (LINKAGE.inverted, -1)):
        length = arm.length_mm / 1e3
        sink = length - math.sqrt(length**2 - r_m**2)
        height = up * sink
        potential += LINKAGE.gravity_m_s2 * (
            arm.load_kg * height + arm.mass_kg * height * share.mean()
        )
        potential += 0.5 * arm.flexure_nm_per_rad * math.asin(r_m / length) ** 2
        speed = ground_m_s + share * (mass_m_s - ground_m_s)
        kinetic += 0.5 * arm.load_kg * mass_m_s**2 + 0.5 * arm.mass_kg * np.mean(speed**2)
    return potential, kinetic


def test_linkage_has_the_stiffness_and_inertia_of_its_parts() -> None:
    d = 1e-4  # m, small beside the arms
    potential = [energy_of_linkage(r, 0.0, 0.0)[0] for r in (-d, 0.0, d)]
    assert np.dot(potential, [1, -2, 1]) / d**2 == pytest.approx(
        LINKAGE.stiffness_n_per_m, rel=1e-5
    )
    assert 2 * energy_of_linkage(0.0, 0.0, 1.0)[1] == pytest.approx(LINKAGE.inertia_kg, rel=1e-6)
    # d2T / dr' dx_g' with the mass moving at x_g' + r' is what the ground's acceleration drives.
    mixed = sum(
        s * energy_of_linkage(0.0, g, g + v)[1]
        for s, g, v in ((1, 1, 1), (-1, 1, -1), (-1, -1, 1), (1, -1, -1))
    )
    drive = mixed / 4
    assert drive / LINKAGE.inertia_kg == pytest.approx(LINKAGE.coupling, rel=1e-6)


def test_linkage_of_one_pendulum_is_a_pendulum() -> None:
    one = WattLinkage(
        pendulum=Arm(length_mm=993.62, load_kg=1.0), inverted=Arm(length_mm=500.0, load_kg=0.0)
    )
    assert one.frequency_hz == pytest.approx(0.5, abs=1e-5)
    assert one.coupling == 1
    assert math.isinf(one.q)
    with pytest.raises(ValueError, match="nothing damps the linkage"):
        one.suspension()
    assert one.suspension(50.0).q == 50


def test_tuning_lowers_frequency_and_q() -> None:
    low, high = LINKAGE.tuned(0.25), LINKAGE.tuned(0.5)
    assert low.frequency_hz == pytest.approx(0.25, rel=1e-9)
    assert low.inertia_kg == pytest.approx(LINKAGE.inertia_kg)
    # Only the flexures lose energy, and their loss stays: Q falls with the square of f0.
    assert high.q / low.q == pytest.approx(4, rel=1e-9)
    assert low.suspension().damping == "structural"
    assert low.suspension(30.0).damping == "viscous"
    assert low.suspension().mass_kg == pytest.approx(low.inertia_kg)
    with pytest.raises(ValueError, match="no share of the load"):
        LINKAGE.tuned(20.0)


def test_unstable_and_empty_linkages_are_refused() -> None:
    heavy = Arm(length_mm=100.0, load_kg=1.0)
    light = Arm(length_mm=100.0, load_kg=0.5, flexure_nm_per_rad=0.01)
    with pytest.raises(ValueError, match="falls over: gravity pushes with 49.03 N/m"):
        _ = WattLinkage(pendulum=light, inverted=heavy).frequency_hz
    none = Arm(length_mm=100.0, load_kg=0.0, mass_kg=0.1)
    with pytest.raises(ValueError, match="carries no mass"):
        _ = WattLinkage(pendulum=none, inverted=none).frequency_hz


# ------------------------------------------------------------------------ files

LINKAGE_TOML = """
[linkage]
flexure_loss = 1e-3
[linkage.pendulum]
length_mm = 100.0
load_kg = 0.6
flexure_nm_per_rad = 0.02
[linkage.inverted]
length_mm = 100.0
load_kg = 0.4
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "mass.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_suspension_from_a_file_with_values_replaced(tmp_path: Path) -> None:
    path = write(tmp_path, "[suspension]\nfrequency_hz = 0.5\nq = 100\non_mass = 'camera'\n")
    found = load_suspension(path, {"q": 80.0, "mass_kg": None})
    assert found == Suspension(frequency_hz=0.5, q=80.0, on_mass="camera")


def test_suspension_from_a_linkage(tmp_path: Path) -> None:
    path = write(tmp_path, LINKAGE_TOML)
    found = load_suspension(path)
    linkage = WattLinkage(
        pendulum=Arm(length_mm=100.0, load_kg=0.6, flexure_nm_per_rad=0.02),
        inverted=Arm(length_mm=100.0, load_kg=0.4),
    )
    assert found == linkage.suspension()
    measured = load_suspension(write(tmp_path, "[suspension]\nq = 40.0\n" + LINKAGE_TOML))
    assert (measured.q, measured.damping, measured.kind) == (40, "viscous", "watt")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[suspension]\nfrequency_hz = 0.5\n", "q is missing"),
        ("[suspension]\nfrequency_hz = 0.5\nq = 100\nmass = 1\n", "there is no field mass"),
        ("[suspension]\nfrequency_hz = -1\nq = 100\n", "frequency_hz = -1"),
        ("frequency_hz = 0.5\n", "there is no field frequency_hz"),
        ("", "neither a table"),
        ("suspension = 3\n", "suspension = 3: it should be a table of fields"),
        ("[suspension]\nfrequency_hz = 0.5\n" + LINKAGE_TOML, "follows from .linkage."),
        (LINKAGE_TOML.replace("0.4", "0.9"), "falls over"),
        (LINKAGE_TOML.replace("100.0", "-100.0"), "length_mm"),
    ],
)
def test_faults_of_files_are_named(tmp_path: Path, text: str, sentence: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(SystemConfigError, match=sentence) as raised:
        load_suspension(path)
    assert str(path) in str(raised.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(SystemConfigError, match="there is no such file"):
        load_suspension(tmp_path / "none.toml")
    with pytest.raises(SystemConfigError, match="frequency_hz is missing"):
        load_suspension()
