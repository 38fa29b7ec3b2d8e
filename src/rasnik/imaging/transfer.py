"""How the optics blur, as transfer functions on the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["GaussianTransfer", "OpticalTransfer"]

# Where a Gaussian is cut: above CUTOFF_SIGMA / sigma its transfer is below 1e-6, which
# leaves an error of some 1e-8 of the step at an edge; at REACH_SIGMA * sigma from a straight
# edge its blur has faded to 4e-8 of the step.
CUTOFF_SIGMA = np.sqrt(np.log(1e6) / 2) / np.pi
REACH_SIGMA = 5.4


class OpticalTransfer(Protocol):
    """How the optics blur: the Fourier transform of the point spread on the sensor."""

    @property
    def cutoff_per_um(self) -> float:
        """Frequency (cycles/um on the sensor) beyond which nothing is transferred."""
        ...

    @property
    def reach_um(self) -> float:
        """Distance on the sensor beyond which a point spreads no light."""
        ...

    def __call__(
        self, f_u: NDArray[np.float64], f_v: NDArray[np.float64]
    ) -> NDArray[np.float64] | NDArray[np.complex128]:
        """Transfer, 1 at zero frequency, at frequencies in cycles/um on the sensor."""
        ...


@dataclass(frozen=True)
class GaussianTransfer:
    """Blur by a round Gaussian of standard deviation `sigma_um` on the sensor."""

    sigma_um: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sigma_um) and self.sigma_um > 0):
            raise ValueError(f"the blur must be a positive length, not {self.sigma_um!r} um")

    @property
    def cutoff_per_um(self) -> float:
        return float(CUTOFF_SIGMA / self.sigma_um)

    @property
    def reach_um(self) -> float:
        return REACH_SIGMA * self.sigma_um

    def __call__(self, f_u: NDArray[np.float64], f_v: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.exp(-2 * (np.pi * self.sigma_um) ** 2 * (f_u**2 + f_v**2)))
