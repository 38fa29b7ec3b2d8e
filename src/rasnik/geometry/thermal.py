"""What temperature does to mask, sensor and holders, and to the reading.

A mask that grows by a share e about the point where it is held shows, on the line of sight, a
point nearer to that point by the same share, and looks larger: S grows by e. A sensor that grows
about its centre has larger pixels than are reckoned with: S shrinks, x and y stay. A lens does
nothing: its centre stays, and the scale hangs on distances alone. Holders carry their element
along.

Source: van der Graaf et al., section "Temperature effects".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.geometry.effects import Effect
from rasnik.geometry.rigid import UM_PER_MM
from rasnik.geometry.three_points import ThreePoints

__all__ = ["SILICON_PER_K", "Expansion", "holder_effect", "mask_effect", "sensor_effect"]

#: Expansion of a sensor's silicon, 1/K: van der Graaf et al., "Temperature effects".
SILICON_PER_K = 2.6e-6


@dataclass(frozen=True)
class Expansion:
    """How much longer something is than at the temperature it was measured at.

    Attributes
    ----------
    per_k : float
        Coefficient of linear expansion, 1/K.
    kelvin : float
        Change of the temperature, K.
    sigma_per_k, sigma_kelvin : float
        Standard deviations, independent of each other.
    """

    per_k: float
    kelvin: float
    sigma_per_k: float = 0.0
    sigma_kelvin: float = 0.0

    def __post_init__(self) -> None:
        values = (self.per_k, self.kelvin, self.sigma_per_k, self.sigma_kelvin)
        if not all(map(math.isfinite, values)) or min(values[2:]) < 0:
            raise ValueError("an Expansion needs finite numbers, and errors that are not negative")
        if abs(self.strain) > 0.01:
            raise ValueError(
                f"{self.per_k:g} per K and {self.kelvin:g} K make {100 * self.strain:.3g} % of "
                "expansion; the coefficient is wanted per K, as 5.5e-7 for fused silica"
            )

    @property
    def strain(self) -> float:
        """Relative growth."""
        return self.per_k * self.kelvin

    @property
    def sigma_strain(self) -> float:
        """Its standard deviation (that of a product of independent numbers)."""
        return math.sqrt(
            (self.per_k * self.sigma_kelvin) ** 2
            + (self.kelvin * self.sigma_per_k) ** 2
            + (self.sigma_per_k * self.sigma_kelvin) ** 2
        )


def mask_effect(
    values: ArrayLike, expansion: Expansion, fixed_um: tuple[float, float] = (0.0, 0.0)
) -> Effect:
    """What the expansion of the mask has added to a reading.

    Parameters
    ----------
    values : array_like, shape (4,)
        As read: x (um), y (um), S, theta_z (rad).
    expansion : Expansion
        Of the mask.
    fixed_um : tuple of float
        Point of the mask that is held in its place.

    Returns
    -------
    Effect
        Its errors in x, y and S go together.
    """
    x, y, scale, _ = np.asarray(values, dtype=np.float64)
    growth = 1 + expansion.strain
    offset = np.array([x - fixed_um[0], y - fixed_um[1]])
    change = np.array([*(-expansion.strain * offset), scale * expansion.strain / growth, 0.0])
    slope = np.array([*(-offset), scale / growth**2, 0.0])
    return _effect("mask expansion", change, slope, expansion.sigma_strain)


def sensor_effect(values: ArrayLike, expansion: Expansion) -> Effect:
    """What the expansion of the sensor, held at its centre, has added to a reading.

    Parameters
    ----------
    values : array_like, shape (4,)
        As read: x (um), y (um), S, theta_z (rad).
    expansion : Expansion
        Of the sensor; `SILICON_PER_K` if it is not glued to something else.

    Returns
    -------
    Effect
        Of S only.
    """
    scale = float(np.asarray(values, dtype=np.float64)[2])
    change = np.array([0.0, 0.0, -scale * expansion.strain, 0.0])
    return _effect("sensor expansion", change, np.array([0, 0, -scale, 0]), expansion.sigma_strain)


def holder_effect(
    instrument: ThreePoints, element: str, length_mm: ArrayLike, expansion: Expansion
) -> Effect:
    """What the expansion of a holder adds to a reading.

    Parameters
    ----------
    instrument : ThreePoints
    element : str
        What it holds: ``"mask"``, ``"lens"``, ``"sensor"`` or ``"camera"``.
    length_mm : array_like, shape (3,)
        From where it is fastened to the element, mm: along the mask's X and Y, and the light.
    expansion : Expansion

    Returns
    -------
    Effect
        To first order in the displacement.
    """
    if element not in ("mask", "lens", "sensor", "camera"):
        raise ValueError(f"a holder holds a mask, lens, sensor or camera, not {element!r}")
    length = np.asarray(length_mm, dtype=np.float64)
    if length.shape != (3,):
        raise ValueError("length_mm needs three numbers: along X, along Y, along the light")
    slope = instrument.matrix([f"{element}_{axis}" for axis in "xyz"]) @ (UM_PER_MM * length)
    cause = f"holder of the {element}"
    return _effect(cause, expansion.strain * slope, slope, expansion.sigma_strain)


def _effect(
    cause: str, change: NDArray[np.float64], slope: NDArray[np.float64], sigma_strain: float
) -> Effect:
    return Effect(cause, change, sigma_strain**2 * np.outer(slope, slope))
