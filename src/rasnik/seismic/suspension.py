"""A proof mass on a pendulum or a Watt's linkage, and what its Rasnik reads of the ground.

The frame stands on the ground, which moves by x_g; r is where the mass is, less where the frame
is. With the coupling c (1 for a point mass) the equation of motion is

    r'' + (w0 / Q) r' + w0^2 r = -c x_g'',    w0 = 2 pi f0.

So r / x_g = c w^2 / (w0^2 - w^2 + i w w0 / Q) with times exp(+i w t): far above f0 the mass stays
where it is and r = -c x_g, far below it follows an acceleration a with r = -c a / w0^2.

Directions are those of the mask's own axes. A mask that moves by d along +X lowers the reading
by d (docs/conventions.md), so a mask on the mass reads -r, and a camera on the mass +r.

Sources: van der Graaf et al., appendix "Applications"; F. Wielandt, chapter 5 of the New Manual of
Seismological Observatory Practice (2012), for the equation; P. R. Saulson, Phys. Rev. D 42 (1990)
2437, for viscous and structural damping.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field

__all__ = [
    "QUANTITIES",
    "STANDARD_GRAVITY",
    "PolesZeros",
    "Quantity",
    "Suspension",
    "pendulum_frequency_hz",
    "pendulum_length_m",
]

Quantity = Literal["displacement", "velocity", "acceleration"]

#: How often each quantity differentiates the displacement.
QUANTITIES: dict[str, int] = {"displacement": 0, "velocity": 1, "acceleration": 2}

#: m/s^2, standard acceleration of gravity (3rd CGPM, 1901).
STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class PolesZeros:
    """A response as gain * prod(s - zero) / prod(s - pole), s = i w in rad/s.

    Attributes
    ----------
    zeros, poles : tuple of complex
        In rad/s, as StationXML's "LAPLACE (RADIANS/SECOND)" has them.
    gain : float
    """

    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    gain: float

    def response(self, frequency_hz: ArrayLike) -> NDArray[np.complex128]:
        """The response at frequencies, shape as given."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=float)
        value = np.full(s.shape, complex(self.gain))
        for zero in self.zeros:
            value = value * (s - zero)
        for pole in self.poles:
            value = value / (s - pole)
        return value


class Suspension(BaseModel):
    """A suspended proof mass. The description of each field states its unit."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    frequency_hz: float = Field(ge=1e-5, le=1e5, description="Hz, f0: natural frequency undamped")
    q: float = Field(gt=0, le=1e12, description="quality factor; 1/2: critically damped")
    mass_kg: float | None = Field(
        default=None, gt=0, le=1e6, description="kg, needed for the thermal noise alone"
    )
    kind: Literal["pendulum", "watt"] = Field(
        default="pendulum", description="pendulum, or watt for a Watt's linkage"
    )
    damping: Literal["viscous", "structural"] = Field(
        default="viscous",
        description="viscous: by the velocity; structural: a loss angle 1/Q of the stiffness",
    )
    on_mass: Literal["mask", "camera"] = Field(
        default="mask", description="what the mass carries: the mask, or lens and sensor together"
    )
    coupling: float = Field(
        default=1.0,
        gt=0,
        le=10,
        description="acceleration of the ground that drives the mass, per that of a point mass",
    )

    @property
    def omega(self) -> float:
        """w0 in rad/s."""
        return 2 * math.pi * self.frequency_hz

    @property
    def sign(self) -> int:
        """Reading per relative displacement of the mass: -1 with the mask on it, else +1."""
        return -1 if self.on_mass == "mask" else 1

    @property
    def time_constant_s(self) -> float:
        """Time in which a free oscillation falls by e, Q / (pi f0)."""
        return self.q / (math.pi * self.frequency_hz)

    def stiffness(self, frequency_hz: ArrayLike) -> NDArray[np.complex128]:
        """w0^2 - w^2 + i w w0 / Q in (rad/s)^2: -c times the ground acceleration, per r.

        With structural damping i w w0 / Q is i w0^2 / Q, the same at the resonance.
        """
        f_hz = np.asarray(frequency_hz, dtype=float)
        w, w0 = 2 * np.pi * f_hz, self.omega
        loss = w * w0 if self.damping == "viscous" else np.sign(w) * w0**2
        return np.asarray(w0**2 - w**2 + 1j * loss / self.q)

    def response(
        self, frequency_hz: ArrayLike, quantity: Quantity = "displacement"
    ) -> NDArray[np.complex128]:
        """Displacement of the mass relative to the frame, per motion of the ground.

        Parameters
        ----------
        frequency_hz : array_like
        quantity : {"displacement", "velocity", "acceleration"}
            Of the ground; the response is in m per m, m per m/s or m per m/s^2.

        Returns
        -------
        ndarray of complex, shape as given
            For times exp(+i w t).
        """
        f_hz = np.asarray(frequency_hz, dtype=float)
        power = 2 - QUANTITIES[quantity]
        s = 2j * np.pi * f_hz
        return np.asarray(-self.coupling * s**power / self.stiffness(f_hz))

    def reading(
        self, frequency_hz: ArrayLike, quantity: Quantity = "displacement"
    ) -> NDArray[np.complex128]:
        """Change of the reading x (or y) per motion of the ground: `sign` times `response`."""
        return np.asarray(self.sign * self.response(frequency_hz, quantity))

    def poles_zeros(self, quantity: Quantity = "displacement") -> PolesZeros:
        """The `response` by its poles and zeros.

        Raises
        ------
        ValueError
            If the damping is structural: a loss angle has no poles.
        """
        if self.damping != "viscous":
            raise ValueError(
                "structural damping has no poles and no motion in time that goes with it; take "
                "damping = 'viscous', which differs by 1/Q at most"
            )
        w0, damped = self.omega, self._damped
        rate = w0 / (2 * self.q)
        poles = (complex(-rate + 1j * damped), complex(-rate - 1j * damped))
        zeros = (0j,) * (2 - QUANTITIES[quantity])
        return PolesZeros(zeros, poles, -self.coupling)

    def impulse_response(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Relative displacement in m after the ground's velocity rises by 1 m/s at time 0.

        The transform of the response to acceleration, in s; 0 before time 0.

        Raises
        ------
        ValueError
            As `poles_zeros`.
        """
        self.poles_zeros()
        t = np.maximum(np.asarray(time_s, dtype=float), 0.0)
        decay = np.exp(-self.omega * t / (2 * self.q))
        damped = self._damped
        if abs(damped) < 1e-9 * self.omega:
            swing: Any = t
        else:  # of a sine, and of a hyperbolic one beyond critical damping
            swing = np.real(np.sin(damped * t) / damped)
        return np.asarray(-self.coupling * decay * swing)

    @property
    def _damped(self) -> complex:
        """Angular frequency of the free oscillation; imaginary beyond critical damping."""
        return self.omega * complex(1 - 1 / (4 * self.q**2)) ** 0.5

    @property
    def pendulum_length_m(self) -> float:
        """Length of the simple pendulum of this frequency on Earth."""
        return pendulum_length_m(self.frequency_hz)


def pendulum_length_m(frequency_hz: float, gravity_m_s2: float = STANDARD_GRAVITY) -> float:
    """Length in m of a simple pendulum: g / w0^2."""
    return gravity_m_s2 / (2 * math.pi * frequency_hz) ** 2


def pendulum_frequency_hz(length_m: float, gravity_m_s2: float = STANDARD_GRAVITY) -> float:
    """Natural frequency in Hz of a simple pendulum.

    Raises
    ------
    ValueError
        If the length or gravity is not above 0.
    """
    if not (length_m > 0 and gravity_m_s2 > 0):
        raise ValueError(f"a pendulum needs a length and gravity above 0, not {length_m:g} m")
    return math.sqrt(gravity_m_s2 / length_m) / (2 * math.pi)
