"""The equation of motion of the mass in time, both ways, by filters of scipy.signal.

Backward, a_ground = -(r'' + (w0 / Q) r' + w0^2 r) / c and its integrals, made stable by Butterworth
filters outside the band: independent of the division of transforms in `rasnik.seismic.ground`.
Forward, what a ground motion makes of the reading, for simulations: by the exact solution between
samples of an acceleration that is taken as straight lines.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.gaps import Series
from rasnik.seismic.suspension import QUANTITIES, Quantity, Suspension

__all__ = ["inverse_gain", "inverse_in_time", "reading_of_ground"]

#: Order of each of the Butterworth filters; both pass forward and backward.
_ORDER = 4
#: Highest frequency, as a fraction of the rate of the filters: the bilinear rule is off by
#: (2 pi 0.02)^2 / 12 = 0.13 % there for each derivative.
_FINE = 0.02
#: Images of a frequency that are counted on either side; those beyond are below 1e-5 of it.
_IMAGES = 3
#: Steps of the forward solution between two samples.
_STEPS = 16


def inverse_in_time(
    run: NDArray[np.float64],
    rate_hz: float,
    suspension: Suspension,
    quantity: Quantity,
    band_hz: tuple[float, float],
) -> NDArray[np.float64]:
    """Ground motion from a stretch of readings without gaps or trend.

    Its ends are wrong and are to be cut off. The gain is one half of the true one an octave
    beside the band.

    Raises
    ------
    ValueError
        If the damping is structural.
    """
    from scipy import signal

    steps = _steps(rate_hz, band_hz)
    there, back = _filters(rate_hz * steps, suspension, quantity, band_hz)
    fine = _between(run, steps, 0)
    fine = signal.sosfilt(there, fine)
    fine = signal.sosfilt(back, fine[::-1])[::-1]
    return np.asarray(fine[::steps])


def inverse_gain(
    frequency_hz: NDArray[np.float64],
    rate_hz: float,
    suspension: Suspension,
    quantity: Quantity,
    band_hz: tuple[float, float],
) -> NDArray[np.float64]:
    """What `inverse_in_time` makes of the amplitude of a reading.

    A spline through the readings has images of each frequency beside the multiples of the rate. The
    filters let them through in part, and at the readings they count as the frequency itself.
    """
    from scipy import signal

    fine_hz = rate_hz * _steps(rate_hz, band_hz)
    there, back = _filters(fine_hz, suspension, quantity, band_hz)
    gain = np.zeros(len(frequency_hz), dtype=complex)
    for image in range(-_IMAGES, _IMAGES + 1):
        f_hz = frequency_hz + image * rate_hz
        forward, backward = (signal.sosfreqz(s, f_hz, fs=fine_hz)[1] for s in (there, back))
        gain += _of_spline(f_hz / rate_hz) * forward * np.conj(backward)
    return np.abs(gain)


def _of_spline(cycles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform of the spline of fifth order through 1 at one place and 0 at all others.

    Source: M. Unser, IEEE Signal Processing Magazine 16 (1999) 22, for cardinal splines.
    """
    angle = 2 * np.pi * cycles
    at_places = (66 + 52 * np.cos(angle) + 2 * np.cos(2 * angle)) / 120
    return np.asarray(np.sinc(cycles) ** 6 / at_places)


def reading_of_ground(
    ground: Series, suspension: Suspension, quantity: Quantity = "displacement"
) -> Series:
    """What the Rasnik reads while the ground moves.

    The mass begins at rest beside the frame, at reading 0.

    Parameters
    ----------
    ground : Series
        Motion along the mask's own +X (or +Y), without gaps; a length, per s or s^2 if
        `quantity` is a velocity or an acceleration. Its content should lie well below half its
        rate: between the samples it is a spline of fifth order.
    suspension : Suspension
    quantity : {"displacement", "velocity", "acceleration"}
        Which the series is.

    Returns
    -------
    Series
        The reading, on the same grid.

    Raises
    ------
    ValueError
        If the series has gaps or is too short, or the damping is structural.
    """
    from scipy import signal

    suspension.poles_zeros()  # refuses structural damping
    if ground.missing:
        raise ValueError(
            f"{ground.missing} values of the ground motion are missing; simulate a motion without "
            "gaps, and take readings away from the result"
        )
    acceleration = _between(ground.values, _STEPS, 2 - QUANTITIES[quantity]) * ground.rate_hz ** (
        2 - QUANTITIES[quantity]
    )
    w0 = suspension.omega
    system = (
        np.array([[0.0, 1.0], [-(w0**2), -w0 / suspension.q]]),
        np.array([[0.0], [-suspension.coupling]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
    )
    discrete = signal.cont2discrete(system, 1 / (ground.rate_hz * _STEPS), method="foh")
    numerator, denominator = signal.ss2tf(*discrete[:4])
    moved = signal.lfilter(numerator[0], denominator, acceleration)[::_STEPS]
    unit = ground.unit.partition("/")[0]
    return Series(suspension.sign * moved, ground.rate_hz, "x_um", unit, ground.start_s)


def _between(run: NDArray[np.float64], steps: int, derivative: int) -> NDArray[np.float64]:
    """Derivative of the spline of fifth order, `steps` times as dense; time in samples."""
    from scipy.interpolate import make_interp_spline

    if len(run) < 6:
        raise ValueError(f"{len(run)} values are too few for a motion; take 6 or more")
    spline = make_interp_spline(np.arange(len(run)), run, k=5)
    return np.asarray(spline(np.arange((len(run) - 1) * steps + 1) / steps, derivative))


def _steps(rate_hz: float, band_hz: tuple[float, float]) -> int:
    return max(1, math.ceil(band_hz[1] / (_FINE * rate_hz)))


def _filters(
    fine_hz: float, suspension: Suspension, quantity: Quantity, band_hz: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sections of the filter that runs forward, and of that which runs backward.

    Butterworth filters an octave beside the band; the zeros at 0 of the high pass cancel the
    integrations, and what drifts does not grow.
    """
    from scipy import signal

    low, high = (2 * math.pi * f for f in (band_hz[0] / 2, 2 * band_hz[1]))
    z_high, p_high, _ = signal.butter(_ORDER, low, "highpass", analog=True, output="zpk")
    _, p_low, k_low = signal.butter(_ORDER, high, "lowpass", analog=True, output="zpk")
    poles = np.concatenate([p_high, p_low])
    motion = suspension.poles_zeros(quantity)
    zeros = np.concatenate([motion.poles, z_high[len(motion.zeros) :]])
    gain = k_low / (motion.gain * suspension.sign)
    sections = []
    for z, k in ((zeros, gain), (z_high, k_low)):
        sections.append(signal.zpk2sos(*signal.bilinear_zpk(z, poles, k, fine_hz)))
    return sections[0], sections[1]
