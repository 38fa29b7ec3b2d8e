"""Refractive index of air, and how it changes with temperature, pressure and humidity.

The modified Edlen equation of Birch and Downs with the water-vapour term for temperatures other
than 20 degrees, as the National Institute of Standards and Technology (NIST) documents it. It is
for air with 450 ppm of carbon dioxide.

Sources: K. P. Birch and M. J. Downs, Metrologia 30 (1993) 155 and 31 (1994) 315; J. A. Stone and
J. H. Zimmerman, Index of Refraction of Air, NIST Engineering Metrology Toolbox, appendix A
(emtoolbox.nist.gov), also for the saturation pressure of water (IAPWS-IF97) and ice (IAPWS).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Air", "Slopes"]

_ZERO_C = 273.15
_PA_PER_HPA = 100.0
# A step along the imaginary axis: derivatives without differences, hence without their rounding.
_STEP = 1e-30
# K, hPa and share of saturation: small against the state, large against rounding.
_DIFFERENCE = 1e-4

# Birch and Downs (1994): dispersion and density.
_A, _B, _C = 8342.54, 2406147.0, 15998.0
_D, _E, _F, _G = 96095.43, 0.601, 0.00972, 0.003661

# Water: Wagner et al., IAPWS Industrial Formulation 1997, equation 30.
_WATER = (
    1.16705214528e3, -7.24213167032e5, -1.70738469401e1, 1.20208247025e4, -3.23255503223e6,
    1.49151086135e1, -4.82326573616e3, 4.05113405421e5, -2.38555575678e-1, 6.50175348448e2,
)  # fmt: skip
# Ice: Wagner, Saul and Pruss, J. Phys. Chem. Ref. Data 23 (1994) 515, sublimation pressure.
_ICE = -13.928169, 34.7078238
_TRIPLE_K, _TRIPLE_PA = 273.16, 611.657

# Dry air: Picard et al., Metrologia 45 (2008) 149, for 400 ppm of carbon dioxide; gas constant:
# CODATA 2018; standard gravity: 3rd CGPM (1901).
_MOLAR_MASS_KG, _GAS_CONSTANT, _GRAVITY = 28.96546e-3, 8.314462618, 9.80665

#: Where the equation was compared with measurements or another one (NIST, section VI).
_RANGES = {
    "temperature_k": (_ZERO_C - 40, _ZERO_C + 100, "K"),
    "pressure_hpa": (0.0, 1400.0, "hPa"),
    "humidity": (0.0, 1.0, "of saturation"),
    "wavelength_nm": (300.0, 1700.0, "nm"),
}


@dataclass(frozen=True)
class Slopes:
    """How the index changes in space or time.

    Attributes
    ----------
    per_k, per_hpa : float
        Per K and per hPa at the same share of water vapour, as in air that is well mixed.
    per_humidity : float
        From dry to saturated, at the same temperature and pressure.
    """

    per_k: float
    per_hpa: float
    per_humidity: float


@dataclass(frozen=True)
class Air:
    """Air of one state.

    Attributes
    ----------
    temperature_k : float
        233 to 373 K.
    pressure_hpa : float
        0 (vacuum) to 1400 hPa.
    humidity : float
        Relative, 0 to 1.
    wavelength_nm : float
        In vacuum, 300 to 1700 nm.
    sigma_temperature_k, sigma_pressure_hpa, sigma_humidity : float
        Standard deviations of these.

    Raises
    ------
    ValueError
        Outside the range of the equation.
    """

    temperature_k: float = 293.15
    pressure_hpa: float = 1013.25
    humidity: float = 0.5
    wavelength_nm: float = 550.0
    sigma_temperature_k: float = 0.0
    sigma_pressure_hpa: float = 0.0
    sigma_humidity: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high, unit) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(
                    f"air: {name} = {value:g} is outside {low:g} .. {high:g} {unit}, the range of "
                    "the equation for the refractive index"
                )
        for name in ("sigma_temperature_k", "sigma_pressure_hpa", "sigma_humidity"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"air: {name} = {getattr(self, name):g} must not be negative")
        vapour_hpa = self.humidity * float(_saturation_pa(self.temperature_k)) / _PA_PER_HPA
        if vapour_hpa > self.pressure_hpa:
            raise ValueError(
                f"air: humidity = {self.humidity:g} means {vapour_hpa:.3g} hPa of water vapour, "
                f"more than pressure_hpa = {self.pressure_hpa:g}; in a vacuum the humidity is 0"
            )

    @property
    def index(self) -> float:
        """Refractive index n (of the phase)."""
        return 1.0 + self.refractivity

    @property
    def refractivity(self) -> float:
        """n - 1."""
        return float(_refractivity(*self._state, self.wavelength_nm).real)

    @property
    def slopes(self) -> Slopes:
        """Partial derivatives of n."""
        return Slopes(*_well_mixed_slopes(self._state, self.wavelength_nm))

    @property
    def sigma_index(self) -> float:
        """Error of n from those of temperature, pressure and humidity, as they are measured.

        That of the equation is not in it. It and Ciddor's (Applied Optics 35 (1996) 1566) differ by
        2e-8 at most between 5 and 50 degrees for dry air of 1000 hPa, as NIST tabulates.
        """
        slopes = [
            _refractivity(*state, self.wavelength_nm).imag / _STEP
            for state in _stepped(self._state, 1j * _STEP)
        ]
        return float(np.linalg.norm(slopes * self._sigmas))

    @property
    def sigma_per_k(self) -> float:
        """Error of the change of n with temperature, for the same reasons."""
        # third derivatives are smaller by far than these differences
        changes = [
            (_well_mixed_slopes(up, self.wavelength_nm)[0] - down) / _DIFFERENCE
            for up in _stepped(self._state, _DIFFERENCE)
            for down in [_well_mixed_slopes(self._state, self.wavelength_nm)[0]]
        ]
        return float(np.linalg.norm(changes * self._sigmas))

    @property
    def _state(self) -> tuple[float, float, float]:
        return self.temperature_k, self.pressure_hpa, self.humidity

    @property
    def _sigmas(self) -> NDArray[np.float64]:
        return np.array([self.sigma_temperature_k, self.sigma_pressure_hpa, self.sigma_humidity])

    @property
    def hydrostatic_hpa_per_m(self) -> float:
        """How pressure changes upward because the air has a weight; that of dry air."""
        density = self.pressure_hpa * _MOLAR_MASS_KG / (_GAS_CONSTANT * self.temperature_k)
        return -density * _GRAVITY


def _stepped(state: tuple[float, float, float], step: Any) -> list[tuple[Any, Any, Any]]:
    """The state with a step in its first, second, third number."""
    t, p, h = state
    return [(t + step, p, h), (t, p + step, h), (t, p, h + step)]


def _well_mixed_slopes(
    state: tuple[float, float, float], wavelength_nm: float
) -> tuple[float, float, float]:
    temperature, pressure, humidity = state
    share = humidity * _saturation_pa(temperature)  # Pa at this pressure

    def at(t: Any, p: Any, h: Any) -> float:
        vapour = share * p / pressure if pressure else 0.0
        vapour += (h - humidity) * _saturation_pa(temperature)
        return float(_with_vapour(t, p, vapour, wavelength_nm).imag / _STEP)

    first, second, third = (
        at(*one) for one in _stepped((temperature, pressure, humidity), 1j * _STEP)
    )
    return first, second, third


def _refractivity(
    temperature_k: Any, pressure_hpa: Any, humidity: Any, wavelength_nm: float
) -> Any:
    """n - 1, also for complex arguments."""
    vapour = humidity * _saturation_pa(temperature_k)
    return _with_vapour(temperature_k, pressure_hpa, vapour, wavelength_nm)


def _with_vapour(
    temperature_k: Any, pressure_hpa: Any, vapour_pa: Any, wavelength_nm: float
) -> Any:
    t, p = temperature_k - _ZERO_C, pressure_hpa * _PA_PER_HPA
    s = (1e3 / wavelength_nm) ** 2  # square of the wave number, 1/um^2
    standard = 1e-8 * (_A + _B / (130 - s) + _C / (38.9 - s))
    dry = p * standard / _D * (1 + 1e-8 * (_E - _F * t) * p) / (1 + _G * t)
    return dry - 292.75e-10 / temperature_k * (3.7345 - 0.0401 * s) * vapour_pa


def _saturation_pa(temperature_k: Any) -> Any:
    """Saturation pressure of water, below its triple point of ice."""
    if temperature_k.real < _TRIPLE_K:
        a1, a2 = _ICE
        share = temperature_k / _TRIPLE_K
        return _TRIPLE_PA * np.exp(a1 * (1 - share**-1.5) + a2 * (1 - share**-1.25))
    k = _WATER
    x = temperature_k + k[8] / (temperature_k - k[9])
    a, b, c = (x**2 + k[0] * x + k[1], k[2] * x**2 + k[3] * x + k[4], k[5] * x**2 + k[6] * x + k[7])
    return 1e6 * (2 * c / (-b + (b**2 - 4 * a * c) ** 0.5)) ** 4
