"""A Watt's linkage (folded pendulum): frequency and loss from its geometry.

The mass hangs at one end from a pendulum arm and stands at the other on an inverted one. Gravity
pulls it back with the load on the first and pushes it away with the load on the second; what is
left of the two, with the flexures, is the stiffness. Moving load from one arm to the other tunes
the frequency, as far down as the linkage stays stable.

With arms that are even rods (mass m, length l) of which one end follows the frame and the other
the mass, loads M on them, and k_theta of all flexures of an arm together, small motions have

    stiffness  k = g [(M1 + m1/2)/l1 - (M2 + m2/2)/l2] + k_theta1/l1^2 + k_theta2/l2^2
    inertia    M = M1 + M2 + (m1 + m2)/3
    driven by  M1 + M2 + (m1 + m2)/2    times the acceleration of the ground,

which follows from Lagrange's equation; an arm turned by r / l lifts its middle by half as much as
its end. Gravity loses no energy, flexures do: the loss angle is theirs times their share of k.

Sources: J. Liu, L. Ju and D. G. Blair, Phys. Lett. A 228 (1997) 243, and F. Acernese et al., Rev.
Sci. Instrum. 79 (2008) 074501, for the folded pendulum; P. R. Saulson, Phys. Rev. D 42 (1990)
2437, for the loss; van der Graaf et al., appendix "Applications", for its use with a Rasnik.
"""

from __future__ import annotations

import math
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from rasnik.seismic.suspension import STANDARD_GRAVITY, Suspension

__all__ = ["Arm", "WattLinkage"]


class Arm(BaseModel):
    """One of the two arms. The description of each field states its unit."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    length_mm: float = Field(gt=0, le=1e5, description="mm between its two joints")
    load_kg: float = Field(ge=0, le=1e5, description="kg of the mass that this arm carries")
    mass_kg: float = Field(default=0.0, ge=0, le=1e5, description="kg, of the arm, an even rod")
    flexure_nm_per_rad: float = Field(
        default=0.0, ge=0, le=1e6, description="N m/rad, of its flexures together"
    )


class WattLinkage(BaseModel):
    """Geometry of a Watt's linkage."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    pendulum: Arm
    inverted: Arm
    gravity_m_s2: float = Field(
        default=STANDARD_GRAVITY, gt=0, le=1e3, description="m/s^2; 1.62 on the Moon"
    )
    flexure_loss: float = Field(
        default=1e-3, gt=0, lt=1, description="loss angle of the flexures' material"
    )

    @property
    def flexure_n_per_m(self) -> float:
        """Stiffness of the flexures against the mass, N/m."""
        return sum(
            arm.flexure_nm_per_rad / (1e-3 * arm.length_mm) ** 2
            for arm in (self.pendulum, self.inverted)
        )

    @property
    def gravity_n_per_m(self) -> float:
        """Stiffness by gravity, N/m; below 0 where the inverted arm's part is the greater."""
        down, up = (
            (arm.load_kg + arm.mass_kg / 2) / (1e-3 * arm.length_mm)
            for arm in (self.pendulum, self.inverted)
        )
        return self.gravity_m_s2 * (down - up)

    @property
    def stiffness_n_per_m(self) -> float:
        """What pulls the mass back, N/m; below 0: it falls over."""
        return self.gravity_n_per_m + self.flexure_n_per_m

    @property
    def inertia_kg(self) -> float:
        """Mass that moves, with the share of the arms."""
        return self._loads_kg + self._arms_kg / 3

    @property
    def coupling(self) -> float:
        """Acceleration of the ground that drives the mass, per that of a point mass."""
        return (self._loads_kg + self._arms_kg / 2) / self.inertia_kg

    @property
    def frequency_hz(self) -> float:
        """Natural frequency.

        Raises
        ------
        ValueError
            If the linkage is not stable or nothing moves.
        """
        if not self._loads_kg > 0:
            raise ValueError("the linkage carries no mass: give load_kg of one arm or of both")
        if not self.stiffness_n_per_m > 0:
            raise ValueError(
                f"the linkage falls over: gravity pushes with {-self.gravity_n_per_m:.4g} N/m and "
                f"the flexures hold {self.flexure_n_per_m:.4g} N/m; move load from the inverted "
                "arm to the pendulum"
            )
        return math.sqrt(self.stiffness_n_per_m / self.inertia_kg) / (2 * math.pi)

    @property
    def q(self) -> float:
        """Quality factor that the flexures leave; falls with the square of the frequency tuned.

        Infinite without flexures. Air and eddy currents are not counted.
        """
        held = self.flexure_loss * self.flexure_n_per_m
        return self.stiffness_n_per_m / held if held else math.inf

    def tuned(self, frequency_hz: float) -> WattLinkage:
        """The same with load moved between the arms so that it has this frequency.

        Raises
        ------
        ValueError
            If no share of the load gives it.
        """
        wanted = self.inertia_kg * (2 * math.pi * frequency_hz) ** 2
        per_kg = self.gravity_m_s2 * sum(
            1e3 / arm.length_mm for arm in (self.pendulum, self.inverted)
        )
        moved = (wanted - self.stiffness_n_per_m) / per_kg
        loads = self.pendulum.load_kg + moved, self.inverted.load_kg - moved
        if min(loads) < 0:
            raise ValueError(
                f"no share of the load gives {frequency_hz:g} Hz: {moved:.4g} kg would have to "
                "move to the pendulum arm"
            )
        pendulum, inverted = (
            arm.model_copy(update={"load_kg": load})
            for arm, load in zip((self.pendulum, self.inverted), loads, strict=True)
        )
        return self.model_copy(update={"pendulum": pendulum, "inverted": inverted})

    def suspension(
        self,
        q: float | None = None,
        *,
        on_mass: Literal["mask", "camera"] = "mask",
        damping: Literal["viscous", "structural"] | None = None,
    ) -> Suspension:
        """The suspension that it is.

        Parameters
        ----------
        q : float, optional
            As measured; by default that of the flexures.
        on_mass : {"mask", "camera"}
        damping : {"viscous", "structural"}, optional
            By default structural where the flexures alone damp, else viscous.

        Raises
        ------
        ValueError
            If it is not stable, or neither `q` nor flexures are given.
        """
        frequency_hz = self.frequency_hz
        found = self.q if q is None else q
        if not math.isfinite(found):
            raise ValueError("nothing damps the linkage: give q, or flexure_nm_per_rad of the arms")
        return Suspension(
            frequency_hz=frequency_hz,
            q=found,
            mass_kg=self.inertia_kg,
            kind="watt",
            damping=damping or ("structural" if q is None else "viscous"),
            on_mass=on_mass,
            coupling=self.coupling,
        )

    @property
    def _loads_kg(self) -> float:
        return self.pendulum.load_kg + self.inverted.load_kg

    @property
    def _arms_kg(self) -> float:
        return self.pendulum.mass_kg + self.inverted.mass_kg
