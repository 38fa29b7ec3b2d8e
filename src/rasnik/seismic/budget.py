"""Self-noise of a suspended mass with a Rasnik readout, as acceleration of the ground.

Counted are the noise of the readings, by the Cramer-Rao bound of the system or as measured, what
rounding to grey levels adds, the thermal noise of the suspension, and terms of one's own. There is
no feedback, so no electronics of one. All amplitude spectral densities are one-sided.

Thermal noise: a force with the power spectral density 4 k T m w0 / Q with viscous damping, and
4 k T m w0^2 / (w Q) with structural damping (P. R. Saulson, Phys. Rev. D 42 (1990) 2437).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.instrument import System
from rasnik.performance.bound import bound
from rasnik.seismic.ground import readout_asd
from rasnik.seismic.noise_models import RANGES_HZ, noise_model
from rasnik.seismic.suspension import Suspension

__all__ = [
    "BOLTZMANN",
    "ROOM_K",
    "Need",
    "SelfNoise",
    "Term",
    "self_noise",
    "thermal_asd",
]

#: J/K, exact in the SI of 2019.
BOLTZMANN = 1.380649e-23
#: K, 20 degrees Celsius.
ROOM_K = 293.15

_SLOW = (
    "slow drifts and tilt: what air, temperature and creep do to readout and suspension has no "
    "common law in frequency; add it as measured"
)
_LOWEST_HZ, _HIGHEST_HZ, _POINTS = 1e-3, 100.0, 601

#: White noise of the reading in pm/sqrt(Hz), or the ASD of the acceleration of the ground in
#: m/s^2/sqrt(Hz) as a function of the frequency.
Extra = float | Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Term:
    """One source of noise.

    Attributes
    ----------
    name : str
    asd : ndarray, shape (n,)
        As acceleration of the ground, m/s^2/sqrt(Hz).
    source : str
        Where the figure comes from, with its parameters.
    """

    name: str
    asd: NDArray[np.float64]
    source: str


@dataclass(frozen=True)
class Need:
    """What would bring the self-noise below the low-noise model at a frequency.

    Readout and suspension may each make up half of the model's power.

    Attributes
    ----------
    frequency_hz : float
    model, total, readout, thermal : float
        m/s^2/sqrt(Hz); thermal is NaN if it is not known.
    readout_power : float
        Factor by which the power of the reading's noise has to fall, as by so many times the
        frames in a second, each as good; 1 if it is low enough.
    mass_q : float
        Factor by which mass times Q has to grow; 1 if it is large enough, NaN if not known.
    natural_hz : tuple of float or None
        Natural frequencies with which the readout would be low enough as it is; None if there
        are none.
    """

    frequency_hz: float
    model: float
    total: float
    readout: float
    thermal: float
    readout_power: float
    mass_q: float
    natural_hz: tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class SelfNoise:
    """The budget of a seismometer.

    Attributes
    ----------
    system : System
    suspension : Suspension
    axis : {"x", "y"}
    rate_hz : float
        Frames in a second.
    reading_pm_rthz : float
        ASD of the noise of the readings, all that is white in them.
    temperature_k : float
    frequency_hz : ndarray, shape (n,)
    terms : tuple of Term
    not_counted : tuple of str
        What is not known, in sentences.
    """

    system: System
    suspension: Suspension
    axis: str
    rate_hz: float
    reading_pm_rthz: float
    temperature_k: float
    frequency_hz: NDArray[np.float64]
    terms: tuple[Term, ...]
    not_counted: tuple[str, ...]

    @property
    def exposure_s(self) -> float:
        """Of a frame, whose mean lowers what is seen of the ground; 0 where it is not known."""
        return self.system.sensor.exposure_s or 0.0

    @property
    def total(self) -> NDArray[np.float64]:
        """Root of the sum of squares of the terms, m/s^2/sqrt(Hz)."""
        return np.sqrt(np.sum([term.asd**2 for term in self.terms], axis=0))

    @property
    def model(self) -> NDArray[np.float64]:
        """The low-noise model, m/s^2/sqrt(Hz); NaN where it says nothing."""
        return np.sqrt(noise_model(self.frequency_hz, "low"))

    @property
    def quiet_hz(self) -> tuple[tuple[float, float], ...]:
        """Bands in which the total is below the low-noise model."""
        covered = np.isfinite(self.model)
        f = np.log(self.frequency_hz[covered])
        above = np.log(self.total[covered] / self.model[covered])
        crossings = np.flatnonzero(np.diff(above < 0))
        at = f[crossings] - above[crossings] * np.diff(f)[crossings] / np.diff(above)[crossings]
        edges = [float(one) for one in np.exp(at)]
        if len(f) and above[0] < 0:
            edges.insert(0, float(np.exp(f[0])))
        if len(f) and above[-1] < 0:
            edges.append(float(np.exp(f[-1])))
        return tuple(zip(edges[::2], edges[1::2], strict=True))

    def need(self, frequency_hz: float) -> Need:
        """What would have to change at a frequency.

        Raises
        ------
        ValueError
            If the low-noise model or the budget does not reach there.
        """
        if not self.frequency_hz[0] <= frequency_hz <= self.frequency_hz[-1]:
            raise ValueError(
                f"the budget goes from {self.frequency_hz[0]:g} to {self.frequency_hz[-1]:g} Hz, "
                f"not to {frequency_hz:g} Hz"
            )
        model = math.sqrt(float(noise_model(frequency_hz, "low")))
        if not math.isfinite(model):
            raise ValueError(
                f"the low-noise model says nothing at {frequency_hz:g} Hz, but from "
                f"{RANGES_HZ[0]:g} to {RANGES_HZ[1]:g} Hz"
            )
        sigma = 1e-12 * self.reading_pm_rthz * math.sqrt(self.rate_hz / 2)
        readout = float(
            readout_asd(
                frequency_hz, sigma, self.rate_hz, self.suspension, exposure_s=self.exposure_s
            )
        )
        thermal = math.nan
        if self.suspension.mass_kg is not None:
            thermal = float(thermal_asd(frequency_hz, self.suspension, self.temperature_k))
        place = np.log(self.frequency_hz)
        total = math.exp(np.interp(math.log(frequency_hz), place, np.log(self.total)))
        half = model / math.sqrt(2)
        seen = float(np.sinc(frequency_hz * self.exposure_s))
        return Need(
            frequency_hz, model, total, readout, thermal,
            max(1.0, (readout / half) ** 2),
            max(1.0, (thermal / half) ** 2) if math.isfinite(thermal) else math.nan,
            _natural_hz(frequency_hz, half, 1e-12 * self.reading_pm_rthz / seen, self.suspension),
        )  # fmt: skip

    def as_dict(self, at_hz: tuple[float, ...] = (), *, curves: bool = False) -> dict[str, Any]:
        """For JSON; with the curves if wished."""
        document: dict[str, Any] = {
            "system": self.system.name,
            "suspension": self.suspension.model_dump(),
            "axis": self.axis,
            "frame_rate_hz": self.rate_hz,
            "exposure_s": self.system.sensor.exposure_s,
            "temperature_k": self.temperature_k,
            "convention": "one-sided",
            "reading_asd_pm_rthz": self.reading_pm_rthz,
            "terms": [{"name": one.name, "source": one.source} for one in self.terms],
            "not_counted": list(self.not_counted),
            "below_low_noise_model_hz": [list(band) for band in self.quiet_hz],
            "needs": [_plain(self.need(f)) for f in at_hz],
        }
        if curves:
            document["frequency_hz"] = self.frequency_hz.tolist()
            for term, entry in zip(self.terms, document["terms"], strict=True):
                entry["asd_m_s2_rthz"] = term.asd.tolist()
            document["total_asd_m_s2_rthz"] = self.total.tolist()
        return document


def thermal_asd(
    frequency_hz: ArrayLike, suspension: Suspension, temperature_k: float = ROOM_K
) -> NDArray[np.float64]:
    """Thermal noise of the suspension as acceleration of the ground, m/s^2/sqrt(Hz), one-sided.

    Raises
    ------
    ValueError
        If the mass is not known.
    """
    if suspension.mass_kg is None:
        raise ValueError("the thermal noise needs the mass: give mass_kg")
    w, w0 = 2 * np.pi * np.asarray(frequency_hz, dtype=float), suspension.omega
    per_mass = 4 * BOLTZMANN * temperature_k / (suspension.mass_kg * suspension.q)
    with np.errstate(divide="ignore"):
        shape = w0 if suspension.damping == "viscous" else w0**2 / w
        return np.asarray(np.sqrt(per_mass * shape) / suspension.coupling + 0 * w)


def self_noise(
    system: System,
    suspension: Suspension,
    *,
    axis: Literal["x", "y"] = "x",
    rate_hz: float | None = None,
    reading_pm_rthz: float | None = None,
    temperature_k: float = ROOM_K,
    extra: Mapping[str, Extra] | None = None,
    frequency_hz: ArrayLike | None = None,
    pose: Any = None,
) -> SelfNoise:
    """The self-noise of a Rasnik that reads a suspended mass.

    Parameters
    ----------
    system : System
    suspension : Suspension
        Without `mass_kg` the thermal noise is left out, and the result says so.
    axis : {"x", "y"}
    rate_hz : float, optional
        Frames in a second, by default the system's. The light of a frame and its exposure,
        where known, are taken as the system states them.
    reading_pm_rthz : float, optional
        Noise floor of the readings as measured, one-sided ASD in pm/sqrt(Hz), in place of the
        bound and the rounding.
    temperature_k : float
    extra : mapping of str to float or callable, optional
        Further terms: white noise of the reading in pm/sqrt(Hz), or the ASD in m/s^2/sqrt(Hz)
        as a function of the frequencies.
    frequency_hz : array_like, optional
        Increasing; by default from 1 mHz to half the frame rate or 100 Hz.
    pose : optional
        Where the bound is taken, as `rasnik.performance.bound.bound` does.

    Raises
    ------
    ValueError
        If the frame rate is not known, the bound cannot be had, a value is impossible, or the
        system's exposure is longer than a frame.
    """
    rate = system.sensor.frame_rate_hz if rate_hz is None else rate_hz
    if rate is None:
        raise ValueError(
            f"the frame rate of system {system.name} is not known: give it, or sensor.frame_rate_hz"
        )
    for value, name in ((rate, "the frame rate"), (temperature_k, "the temperature")):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be above 0, not {value}")
    if frequency_hz is None:
        highest_hz = min(rate / 2, _HIGHEST_HZ)
        frequency_hz = np.geomspace(min(_LOWEST_HZ, highest_hz / 10), highest_hz, _POINTS)
    f_hz = np.asarray(frequency_hz, dtype=float)
    if f_hz.ndim != 1 or len(f_hz) < 2 or not (f_hz[0] > 0 and (np.diff(f_hz) > 0).all()):
        raise ValueError("the frequencies must be two or more, above 0 and increasing")
    if f_hz[-1] > rate / 2 * (1 + 1e-9):
        raise ValueError(f"{f_hz[-1]:g} Hz is above half the frame rate of {rate:g} Hz")

    def reading(pm_rthz: float) -> NDArray[np.float64]:
        sigma = 1e-12 * pm_rthz * math.sqrt(rate / 2)
        exposure_s = system.sensor.exposure_s or 0.0
        return readout_asd(f_hz, sigma, rate, suspension, exposure_s=exposure_s)

    white = _readout(system, axis, rate, reading_pm_rthz, pose)
    terms = [Term(name, reading(pm), source) for name, pm, source in white]
    not_counted = [_SLOW]
    if suspension.mass_kg is None:
        not_counted.append("thermal noise of the suspension: the mass is not known")
    else:
        source = (
            f"{suspension.damping} damping, Q = {suspension.q:.4g}, {suspension.mass_kg:.4g} kg, "
            f"{temperature_k:.5g} K"
        )
        terms.append(Term("thermal", thermal_asd(f_hz, suspension, temperature_k), source))
    squares = sum(pm**2 for _, pm, _ in white)
    for name, given in (extra or {}).items():
        if callable(given):
            terms.append(Term(name, np.broadcast_to(given(f_hz), f_hz.shape), "as given"))
            continue
        if not (math.isfinite(given) and given >= 0):
            raise ValueError(f"{name} must be a number of pm/sqrt(Hz), 0 or more, not {given}")
        squares += given**2
        terms.append(Term(name, reading(given), f"{given:.4g} pm/√Hz of the reading, as given"))
    return SelfNoise(
        system, suspension, axis, float(rate), math.sqrt(squares), temperature_k, f_hz,
        tuple(terms), tuple(not_counted),
    )  # fmt: skip


def _readout(
    system: System, axis: str, rate: float, measured_pm: float | None, pose: Any
) -> list[tuple[str, float, str]]:
    """(name, ASD in pm/sqrt(Hz), source) of the noise of the readings."""
    if measured_pm is not None:
        if not (math.isfinite(measured_pm) and measured_pm > 0):
            raise ValueError(f"the noise of the readings must be above 0, not {measured_pm}")
        return [("readout", measured_pm, f"{measured_pm:.4g} pm/√Hz, as measured")]
    column = {"x": 0, "y": 1}[axis]
    plain, rounded = (
        bound(system, pose, rounding=rounding).covariance[column, column]
        for rounding in (False, True)
    )
    # um per frame to pm/sqrt(Hz)
    shot, rounding_pm = (
        1e6 * math.sqrt(max(variance, 0.0) * 2 / rate) for variance in (plain, rounded - plain)
    )
    frame = f"{1e3 * math.sqrt(plain):.3g} nm per frame at {rate:g} frames/s"
    return [
        ("readout", shot, f"Cramer-Rao bound, {frame}: {shot:.3g} pm/√Hz"),
        ("rounding", rounding_pm, f"to whole grey levels: {rounding_pm:.3g} pm/√Hz more"),
    ]


def _natural_hz(
    frequency_hz: float, wanted: float, reading: float, suspension: Suspension
) -> tuple[float, float] | None:
    """Between which natural frequencies a reading's noise is below `wanted` acceleration.

    |w0^2 - w^2 + i loss| = wanted / reading is quadratic in w0^2.
    """
    w2 = (2 * math.pi * frequency_hz) ** 2
    largest = wanted * suspension.coupling / reading
    a, b, c = 1.0, -2 * w2, w2**2 - largest**2
    if suspension.damping == "viscous":
        b += w2 / suspension.q**2
    else:
        a += 1 / suspension.q**2
    inside = b * b - 4 * a * c
    if inside < 0:
        return None
    low, high = ((-b + sign * math.sqrt(inside)) / (2 * a) for sign in (-1, 1))
    if high <= 0:
        return None
    return math.sqrt(max(low, 0.0)) / (2 * math.pi), math.sqrt(high) / (2 * math.pi)


def _plain(need: Need) -> dict[str, Any]:
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in vars(need).items()
    }
