"""How the optics blur, as transfer functions on the sensor.

Gaussian (what a real, slightly imperfect system looks like), the diffraction limit of a
round aperture in and out of focus, and the disc of a plain defocus. All are for incoherent
light; `PupilTransfer` is the amplitude transfer of coherent light.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.special
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

__all__ = [
    "AiryTransfer",
    "DiscTransfer",
    "GaussianTransfer",
    "OpticalTransfer",
    "ProductTransfer",
    "PupilTransfer",
    "ScaledTransfer",
]

# Where a Gaussian is cut: above CUTOFF_SIGMA / sigma its transfer is below 1e-6, which
# leaves an error of some 1e-8 of the step at an edge; at REACH_SIGMA * sigma from a straight
# edge its blur has faded to 4e-8 of the step.
CUTOFF_SIGMA = np.sqrt(np.log(1e6) / 2) / np.pi
REACH_SIGMA = 5.4

# The light outside a radius r of a diffraction pattern falls only as 1/r. What lies farther
# off than the reach is seen as the periodic continuation of the window, whose mean is that of
# the mask: at this many wavelengths / NA the error is some 1e-4 of the step.
_REACH_AIRY = 60.0
# The amplitude of coherent light falls more slowly; here the error is some 1e-3.
_REACH_PUPIL = 240.0


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


@dataclass(frozen=True)
class AiryTransfer:
    """Diffraction at a round aperture, incoherent light.

    In focus ``(2 / pi) (acos(n) - n sqrt(1 - n^2))`` with n the frequency over the cutoff
    ``2 NA / wavelength``. Out of focus the exact integral over the overlap of the two
    displaced pupils (H. H. Hopkins, Proc. R. Soc. A 231, 91 (1955)), for a wave-front error
    of ``defocus NA^2 / 2`` at the rim.

    Attributes
    ----------
    wavelength_um : float
    numerical_aperture : float
        On the side of the sensor: half the diameter of the aperture over its distance.
    defocus_um : float
        Distance of the sensor from the focus.

    Source: van der Graaf et al., section 3 "Image blurring" and section 6.
    """

    wavelength_um: float
    numerical_aperture: float
    defocus_um: float = 0.0

    def __post_init__(self) -> None:
        for name in ("wavelength_um", "numerical_aperture"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, not {value!r}")
        if not np.isfinite(self.defocus_um):
            raise ValueError(f"defocus_um must be finite, not {self.defocus_um!r}")

    @property
    def cutoff_per_um(self) -> float:
        return 2 * self.numerical_aperture / self.wavelength_um

    @property
    def reach_um(self) -> float:
        airy = self.wavelength_um / self.numerical_aperture
        return _REACH_AIRY * airy + 2 * abs(self.defocus_um) * self.numerical_aperture

    @property
    def waves(self) -> float:
        """Wave-front error at the rim of the pupil, in wavelengths."""
        return self.defocus_um * self.numerical_aperture**2 / 2 / self.wavelength_um

    def __call__(self, f_u: NDArray[np.float64], f_v: NDArray[np.float64]) -> NDArray[np.float64]:
        n = np.minimum(np.hypot(f_u, f_v) / self.cutoff_per_um, 1.0)
        if self.waves == 0:
            return np.asarray((np.arccos(n) - n * np.sqrt(1 - n**2)) * (2 / np.pi))
        # As a function of sqrt(1 - n), in which it has no corner at the cutoff.
        return np.asarray(self._table(np.sqrt(1 - n)))

    @cached_property
    def _table(self) -> CubicSpline:
        root = np.linspace(0, 1, 2001 + 200 * int(abs(self.waves)))
        n = 1 - root**2
        # Over the half width of the overlap, ``sqrt(1 - y^2) - n`` at height y; with y as a
        # sine the root has no corner.
        node, weight = np.polynomial.legendre.leggauss(64 + 16 * int(abs(self.waves)))
        rim = np.arcsin(np.sqrt(1 - n**2))[:, None]
        angle = rim * node
        half = np.cos(angle) - n[:, None]
        phase = 8 * np.pi * self.waves * n[:, None] * half
        value = 2 * half * np.sinc(phase / np.pi) * np.cos(angle) * rim
        return CubicSpline(root, value @ weight / np.pi)


@dataclass(frozen=True)
class DiscTransfer:
    """An evenly filled disc: defocus in geometrical optics; ``2 J1(z) / z``, z = 2 pi f r."""

    radius_um: float

    @property
    def cutoff_per_um(self) -> float:
        return float(np.inf)

    @property
    def reach_um(self) -> float:
        return self.radius_um

    def __call__(self, f_u: NDArray[np.float64], f_v: NDArray[np.float64]) -> NDArray[np.float64]:
        z = np.maximum(2 * np.pi * self.radius_um * np.hypot(f_u, f_v), 1e-9)
        return np.asarray(2 * scipy.special.j1(z) / z)


@dataclass(frozen=True)
class PupilTransfer:
    """Amplitude transfer of a round aperture for coherent light: the pupil itself.

    Real or imaginary part of ``exp(2 pi i waves (f / cutoff)^2)`` within the pupil; the image
    is the sum of the squares of the two parts.
    """

    wavelength_um: float
    numerical_aperture: float
    defocus_um: float = 0.0
    imaginary: bool = False

    @property
    def cutoff_per_um(self) -> float:
        return self.numerical_aperture / self.wavelength_um

    @property
    def reach_um(self) -> float:
        airy = self.wavelength_um / self.numerical_aperture
        return _REACH_PUPIL * airy + 2 * abs(self.defocus_um) * self.numerical_aperture

    def __call__(self, f_u: NDArray[np.float64], f_v: NDArray[np.float64]) -> NDArray[np.float64]:
        square = (f_u**2 + f_v**2) / self.cutoff_per_um**2
        waves = self.defocus_um * self.numerical_aperture**2 / 2 / self.wavelength_um
        phase = 2 * np.pi * waves * square
        part = np.sin(phase) if self.imaginary else np.cos(phase)
        return np.asarray(np.where(square <= 1, part, 0.0))


@dataclass(frozen=True)
class ProductTransfer:
    """One blur after another."""

    first: OpticalTransfer
    second: OpticalTransfer

    @property
    def cutoff_per_um(self) -> float:
        return min(self.first.cutoff_per_um, self.second.cutoff_per_um)

    @property
    def reach_um(self) -> float:
        return self.first.reach_um + self.second.reach_um

    def __call__(
        self, f_u: NDArray[np.float64], f_v: NDArray[np.float64]
    ) -> NDArray[np.float64] | NDArray[np.complex128]:
        return self.first(f_u, f_v) * self.second(f_u, f_v)


@dataclass(frozen=True)
class ScaledTransfer:
    """The same blur, `ratio` times as wide."""

    transfer: OpticalTransfer
    ratio: float

    @property
    def cutoff_per_um(self) -> float:
        return self.transfer.cutoff_per_um / self.ratio

    @property
    def reach_um(self) -> float:
        return self.transfer.reach_um * self.ratio

    def __call__(
        self, f_u: NDArray[np.float64], f_v: NDArray[np.float64]
    ) -> NDArray[np.float64] | NDArray[np.complex128]:
        return self.transfer(f_u * self.ratio, f_v * self.ratio)
