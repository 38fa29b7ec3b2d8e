"""Frequency and quality factor of a suspension from its free decay.

    reading = A exp(-g t) cos(w t + phi) + offset + drift t,   w0^2 = w^2 + g^2,  Q = w0 / (2 g)

is fitted to the readings themselves by least squares, whatever is missing among them. With white
noise no unbiased estimate is better (Cramer and Rao). Noise that is stronger around the resonance,
such as the ground's motion, enlarges the errors (`rasnik.seismic.ring_down_noise`).

One decay at one frequency does not tell viscous from structural damping.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.characterisation.gaps import Series
from rasnik.seismic.ring_down_noise import Rest, covariance
from rasnik.seismic.suspension import Suspension

__all__ = ["RingDown", "ring_down"]

_Values = NDArray[np.float64]

_LEAST_VALUES = 24
_LEAST_PERIODS = 2.0
#: Drop of chi-square by an oscillation below which it may be noise: in four parameters, with the
#: choice of a million frequencies, noise reaches it less than once in 10^4 times.
_LEAST_DROP = 60.0
#: Standard deviations by which a decay must be seen for a Q to be given.
_LEAST_DECAY = 5.0
#: Chance of calling an exponential decay something else.
_CHANCE = 1e-3
#: 95 % of a Gaussian lie below so many standard deviations above its mean.
_ONE_SIDED_95 = 1.645
_REACH = 0.1  # of a frequency given, within which the oscillation is looked for
_DECAYS = (0.0, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # tried first, per length of the series


@dataclass(frozen=True, eq=False)
class RingDown:
    """A free decay.

    Attributes
    ----------
    frequency_hz : float
        f0, the natural frequency without damping.
    loss : float
        1 / Q, which is what has a Gaussian error; below 0 for an oscillation that grows.
    amplitude, phase_rad : float
        At the first place of the series, in its unit and of a cosine.
    offset, drift : float
        In the unit of the series, and per second.
    covariance : ndarray, shape (6, 6)
        In the order above.
    rms : float
        Standard deviation of what remains.
    chi2_ndf : float
        NaN if the noise of the readings was not given.
    colour : float
        Power of what remains around the resonance, over that of white noise; 1 where chance
        explains it, else the covariance counts it.
    not_exponential : float
        Chance of so much departure from an exponential decay at one frequency.
    decays : bool
        Whether the decay is seen well enough for a Q.
    remarks : tuple of str
        What to know before the figures are used.
    series : Series
    """

    frequency_hz: float
    loss: float
    amplitude: float
    phase_rad: float
    offset: float
    drift: float
    covariance: NDArray[np.float64]
    rms: float
    chi2_ndf: float
    colour: float
    not_exponential: float
    decays: bool
    remarks: tuple[str, ...]
    series: Series

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Standard deviations, in the order of the covariance."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def q(self) -> float:
        """Quality factor; NaN if the decay is not seen well enough."""
        return 1 / self.loss if self.decays else math.nan

    @property
    def sigma_q(self) -> float:
        """Of Q, to first order."""
        return float(self.sigmas[1]) * self.q**2

    @property
    def least_q(self) -> float:
        """What Q exceeds with 95 % confidence; infinite where even growth is compatible."""
        most = self.loss + _ONE_SIDED_95 * float(self.sigmas[1])
        return 1 / most if most > 0 else math.inf

    @property
    def time_constant_s(self) -> float:
        """Time in which the amplitude falls by e; NaN as `q`."""
        return self.q / (math.pi * self.frequency_hz)

    def values(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """The fitted reading at times after the first place of the series."""
        t = np.asarray(time_s, dtype=float)
        w0 = 2 * math.pi * self.frequency_hz
        g = w0 * self.loss / 2
        swing = np.cos(math.sqrt(w0**2 - g**2) * t + self.phase_rad)
        return np.asarray(self.amplitude * np.exp(-g * t) * swing + self.offset + self.drift * t)

    def suspension(self, **fields: Any) -> Suspension:
        """A suspension of this frequency and Q; other fields as those of `Suspension`.

        Raises
        ------
        ValueError
            If the decay does not give a Q.
        """
        if not self.decays:
            raise ValueError(f"Q is not known, only that it is above {self.least_q:.4g}")
        return Suspension(frequency_hz=self.frequency_hz, q=self.q, **fields)

    def as_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        end = f"_{self.series.unit}"
        fitted = {
            "frequency_hz": self.frequency_hz, "loss": self.loss,
            f"amplitude{end}": self.amplitude, "phase_rad": self.phase_rad,
            f"offset{end}": self.offset, f"drift{end}_per_s": self.drift,
        }  # fmt: skip
        sigmas = zip(fitted, self.sigmas.tolist(), strict=True)
        document: dict[str, Any] = fitted | {f"sigma_{name}": sigma for name, sigma in sigmas}
        others = {
            "q": self.q,
            "sigma_q": self.sigma_q,
            "least_q_95_percent": self.least_q,
            "time_constant_s": self.time_constant_s,
            f"rms{end}": self.rms,
            "chi2_ndf": self.chi2_ndf,
            "colour": self.colour,
            "chance_if_exponential": self.not_exponential,
        }
        document |= {k: v if math.isfinite(v) else None for k, v in others.items()}
        return document | {"covariance": self.covariance.tolist(), "remarks": list(self.remarks)}


def ring_down(
    series: Series, *, sigma: float | None = None, frequency_hz: float | None = None
) -> RingDown:
    """Fit a free decay.

    Parameters
    ----------
    series : Series
        Reading of the mass while it swings freely. Gaps are left out.
    sigma : float, optional
        Noise of one reading in the unit of the series; by default what remains of the fit.
    frequency_hz : float, optional
        The oscillation is looked for within 10 % of it; by default where the spectrum is highest.

    Raises
    ------
    ValueError
        If there are too few readings or periods, or no oscillation stands out.
    """
    if series.valid < _LEAST_VALUES:
        raise ValueError(
            f"{series.valid} readings are too few for a ring-down; {_LEAST_VALUES} are the least"
        )
    if sigma is not None and not (math.isfinite(sigma) and sigma > 0):
        raise ValueError(f"the noise of a reading must be above 0, not {sigma}")
    places = np.flatnonzero(np.isfinite(series.values))
    span_s = (places[-1] - places[0]) / series.rate_hz
    t, y = places / series.rate_hz, series.values[places]
    if not y.std() > 0:
        raise ValueError("all readings are the same; nothing swings")
    fit = _Decay(t, y, span_s)
    found, rest = fit.solve(_start(series, fit, frequency_hz))
    if found[0] * span_s < 2 * math.pi * _LEAST_PERIODS:
        raise ValueError(
            f"{span_s:.4g} s hold fewer than {_LEAST_PERIODS:g} periods of the oscillation; take "
            "a longer track"
        )
    return _result(series, fit, found, rest, sigma)


# ------------------------------------------------------------------------ fit


class _Decay:
    """Readings at times t, scaled to mean 0 and size 1, and the model.

    The model is in (w, g, a, b, offset, drift).
    """

    def __init__(self, t: _Values, y: _Values, span_s: float) -> None:
        self.level, self.size = float(y.mean()), float(y.std())
        y = (y - self.level) / self.size
        self.t, self.y, self.span_s = t, y, span_s
        self.steady = np.stack([np.ones(len(t)), t / span_s], axis=1)
        self.flat = y - self.steady @ np.linalg.lstsq(self.steady, y, rcond=None)[0]

    def swings(self, w: float, g: float) -> _Values:
        """exp(-g t) cos(w t) and exp(-g t) sin(w t), shape (n, 2)."""
        # A wild step of the solver must not overflow.
        decay = np.exp(np.clip(-g * self.t, -700, 60))
        return np.stack([decay * np.cos(w * self.t), decay * np.sin(w * self.t)], axis=1)

    def linear(self, w: float, g: float) -> tuple[_Values, float]:
        """Best (a, b, offset, drift) with this w and g, and the sum of squares that remains."""
        columns = np.concatenate([self.swings(w, g), self.steady], axis=1)
        norm = np.linalg.norm(columns, axis=0)
        columns /= norm  # rows are many: the normal equations are far quicker
        found = np.linalg.lstsq(columns.T @ columns, columns.T @ self.y, rcond=None)[0]
        return found / norm, float(np.sum((self.y - columns @ found) ** 2))

    def rest(self, p: _Values) -> _Values:
        columns = np.concatenate([self.swings(p[0], p[1]), self.steady], axis=1)
        return np.asarray(columns @ p[2:] - self.y)

    def jacobian(self, p: _Values) -> _Values:
        swings = self.swings(p[0], p[1])
        turned = swings @ np.array([p[3], -p[2]])  # d/d(w t)
        whole = swings @ p[2:4]
        slopes = np.stack([self.t * turned, -self.t * whole], axis=1)
        return np.concatenate([slopes, swings, self.steady], axis=1)

    def bends(self, p: _Values) -> _Values:
        """What a decay and a frequency that change along the way would add, shape (n, 2)."""
        swings, t2 = self.swings(p[0], p[1]), (self.t / self.span_s) ** 2
        both = [swings @ p[2:4], swings @ np.array([p[3], -p[2]])]
        return np.stack([t2 * one for one in both], axis=1)

    def solve(self, start: tuple[float, float]) -> tuple[_Values, _Values]:
        """(parameters, what remains)."""
        from scipy.optimize import least_squares

        linear, _ = self.linear(*start)
        p0 = np.concatenate([start, linear])
        solved = least_squares(
            self.rest, p0, self.jacobian, method="lm", x_scale="jac",
            xtol=1e-12, ftol=1e-14, gtol=1e-14,
        )  # fmt: skip
        p = np.asarray(solved.x)
        if p[0] < 0:  # the same oscillation
            p[0], p[3] = -p[0], -p[3]
        return p, -self.rest(p)


def _start(series: Series, fit: _Decay, frequency_hz: float | None) -> tuple[float, float]:
    """(w, g) near enough for the fit: the highest peak, and the best of several decays."""
    w = 2 * math.pi * _peak_hz(series, fit, frequency_hz)
    tries = [(w, decay / fit.span_s) for decay in _DECAYS]
    return min(tries, key=lambda one: fit.linear(*one)[1])


def _peak_hz(series: Series, fit: _Decay, about_hz: float | None) -> float:
    """Where the transform of the readings, less mean and slope, is largest."""
    from scipy import fft

    shown = np.zeros(len(series))
    shown[np.isfinite(series.values)] = fit.flat
    length = fft.next_fast_len(4 * len(shown), real=True)
    power = np.abs(fft.rfft(shown, length)) ** 2
    f_hz = fft.rfftfreq(length, 1 / series.rate_hz)
    inside = f_hz * fit.span_s >= _LEAST_PERIODS / 2
    if about_hz is not None:
        inside &= np.abs(f_hz - about_hz) <= max(_REACH * about_hz, 2 / fit.span_s)
    if not inside.any():
        raise ValueError(
            f"an oscillation of {about_hz:g} Hz cannot be seen in these readings, which show "
            f"{_LEAST_PERIODS / fit.span_s:.3g} to {series.rate_hz / 2:.5g} Hz"
        )
    return float(f_hz[inside][np.argmax(power[inside])])


# ------------------------------------------------------------------------ what it is worth


def _result(
    series: Series, fit: _Decay, p: _Values, rest: _Values, sigma: float | None
) -> RingDown:
    """The decay in the units of the series, with its errors and what to know of it."""
    freedom = len(rest) - 6
    variance = float(rest @ rest) / freedom

    def left(values: _Values) -> Rest:
        frequency = math.hypot(p[0], p[1]) / (2 * math.pi * series.rate_hz)
        loss = 2 * p[1] / math.hypot(p[0], p[1])
        return Rest(
            np.flatnonzero(np.isfinite(series.values)), values, len(series), frequency, loss
        )

    jacobian = fit.jacobian(p)
    stated = 0.0 if sigma is None else (sigma / fit.size) ** 2
    spread, level, colour = covariance(left(rest), jacobian, max(variance, stated))
    if not float(fit.flat @ fit.flat - rest @ rest) > _LEAST_DROP * variance * level:
        raise ValueError("no free oscillation stands out of what else is in the readings")
    bent, stat = _bending(fit, p, jacobian, rest, variance)
    chance = math.exp(-0.5 * stat / left(bent).spectrum()[1])  # of chi-square with 2 degrees
    values, turn = _physical(p, fit)
    spread = turn @ spread @ turn.T
    decays = values[1] > _LEAST_DECAY * math.sqrt(spread[1, 1])
    found = RingDown(
        *values, spread, math.sqrt(variance) * fit.size,
        variance / stated if stated else math.nan, colour, chance, decays, (), series,
    )  # fmt: skip
    return replace(found, remarks=_remarks(found, freedom))


def _bending(
    fit: _Decay, p: _Values, jacobian: _Values, rest: _Values, variance: float
) -> tuple[_Values, float]:
    """What remains with a changing decay and frequency, and how much that takes off chi-square.

    To first order: the score test, with two degrees of freedom.
    """
    extra = fit.bends(p)
    norm = np.linalg.norm(jacobian, axis=0)
    extra = extra - jacobian / norm @ np.linalg.lstsq(jacobian / norm, extra, rcond=None)[0]
    size = np.linalg.lstsq(extra, rest, rcond=None)[0]
    bent = rest - extra @ size
    return bent, float(rest @ rest - bent @ bent) / variance


def _physical(
    p: _Values, fit: _Decay
) -> tuple[tuple[float, float, float, float, float, float], _Values]:
    """(f0, 1/Q, A, phi, offset, drift) in the units of the series, and their derivatives."""
    w, g, a, b, offset, drift = (float(value) for value in p)
    w0, amplitude = math.hypot(w, g), math.hypot(a, b)
    turn = np.zeros((6, 6))
    turn[0, :2] = np.array([w, g]) / w0 / (2 * math.pi)
    turn[1, :2] = 2 * np.array([-g * w, w * w]) / w0**3
    turn[2, 2:4] = np.array([a, b]) / amplitude * fit.size
    turn[3, 2:4] = np.array([b, -a]) / amplitude**2
    turn[4, 4] = fit.size
    turn[5, 5] = fit.size / fit.span_s
    values = (
        w0 / (2 * math.pi),
        2 * g / w0,
        amplitude * fit.size,
        math.atan2(-b, a),
        fit.level + offset * fit.size,
        drift * fit.size / fit.span_s,
    )
    return values, turn


def _remarks(found: RingDown, freedom: int) -> tuple[str, ...]:
    """Sentences on a decay that is too short, not exponential, or not alone."""
    said = []
    if not found.decays:
        said.append(
            f"the decay is too short to give Q: 1/Q = {found.loss:.3g} with a standard deviation "
            f"of {found.sigmas[1]:.2g}, so Q is above {found.least_q:.4g} (95 %); take a longer "
            "track"
        )
    if found.not_exponential < _CHANCE:
        said.append(
            "the decay is not exponential at one frequency (chance "
            f"{max(found.not_exponential, 1e-99):.1g}): damping or stiffness depend on the "
            "amplitude, or two oscillations beat; Q and its error are those of no one decay"
        )
    if math.isfinite(found.chi2_ndf) and found.chi2_ndf > 1 + 5 * math.sqrt(2 / freedom):
        said.append(
            f"what remains is {math.sqrt(found.chi2_ndf):.3g} times the stated noise of the "
            "readings; the errors are enlarged by as much"
        )
    if found.colour > 1:
        said.append(
            f"around the resonance what remains is {found.colour:.3g} times as strong in power as "
            "elsewhere: something else moves the mass; the errors are enlarged for it"
        )
    return tuple(said)
