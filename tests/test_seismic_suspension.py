"""The suspended mass against what mechanics says of it."""

import math

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from rasnik.seismic.suspension import (
    Suspension,
    pendulum_frequency_hz,
    pendulum_length_m,
)

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
