"""Ground motion from the reading of a suspended mass.

In the frequency domain the transform of the reading is divided by the response of the suspension
and multiplied by a taper that is 1 within the band: nothing is added to the response to keep the
division small, and what lies outside the band is taken away instead. The same from the equation
of motion, step by step in time: `rasnik.seismic.equation_of_motion`.

Nothing is interpolated. Every stretch without a gap is treated by itself, and its ends, where what
came before or after would count, are missing in the result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.characterisation.gaps import Series
from rasnik.seismic.equation_of_motion import inverse_gain, inverse_in_time
from rasnik.seismic.suspension import QUANTITIES, Quantity, Suspension

__all__ = ["GroundMotion", "ground_motion", "readout_asd", "readout_rms", "taper", "taper_corners"]

Method = Literal["frequency", "time"]

#: Lengths that a series of positions may be in.
_LENGTHS = ("nm", "um", "µm", "mm", "m")
#: Periods of the lower end of the band that are cut off at each end of a stretch. Half of them
#: hold the taper in time; over the rest its effect falls to some 1e-3 of the motion.
_EDGE_PERIODS = 6.0
_PER_TIME = {"displacement": "", "velocity": "/s", "acceleration": "/s^2"}


@dataclass(frozen=True, eq=False)
class GroundMotion(Series):
    """Motion of the ground along the axis of the mask that was read.

    Attributes
    ----------
    quantity : {"displacement", "velocity", "acceleration"}
    band_hz : tuple of float
        Where the motion is complete. Outside it falls to nothing.
    corners_hz : tuple of float
        Where the taper begins, is 1, ceases to be 1 and ends; for ``method="time"`` it is one
        half at the first and the last, and 0.4 % below 1 at the band's ends.
    method : {"frequency", "time"}
    edge_s : float
        What is missing at each end of a stretch without gaps.
    sigma : float
        Standard deviation of each value by the noise of the reading, in the unit of the values;
        NaN if that noise is not known.
    stretches, too_short : int
        Stretches that were used, and that are shorter than their two ends.
    exposure_s : float
        Of which the mean is undone; 0 if none is.
    """

    quantity: Quantity = "displacement"
    band_hz: tuple[float, float] = (math.nan, math.nan)
    corners_hz: tuple[float, float, float, float] = (math.nan,) * 4
    method: Method = "frequency"
    edge_s: float = math.nan
    sigma: float = math.nan
    stretches: int = 0
    too_short: int = 0
    exposure_s: float = 0.0


def ground_motion(
    series: Series,
    suspension: Suspension,
    quantity: Quantity = "velocity",
    *,
    band_hz: tuple[float, float],
    sigma: float | None = None,
    method: Method = "frequency",
    edge_s: float | None = None,
    exposure_s: float = 0.0,
) -> GroundMotion:
    """Motion of the ground in a band of frequencies.

    Parameters
    ----------
    series : Series
        Reading x or y of the Rasnik between mass and frame, a length, as `even_series` gives it.
    suspension : Suspension
        Says also which way the reading goes (``on_mass``).
    quantity : {"displacement", "velocity", "acceleration"}
    band_hz : (low, high)
        At most half the rate; a quarter of it with ``method="time"``.
    sigma : float, optional
        Noise of one reading, standard deviation in the unit of the series.
    method : {"frequency", "time"}
        Division of transforms, or the equation of motion filtered in time. The two share no
        code but the cutting of the ends, and agree within the band.
    edge_s : float, optional
        Time cut off at each end of every stretch; by default 6 periods of the lowest frequency.
    exposure_s : float
        A frame shows the mean over its exposure, which lowers the reading by sinc(f * exposure):
        1.6 % at f = 0.1 / exposure. That is undone for this exposure, with ``method="frequency"``.

    Returns
    -------
    GroundMotion
        As long as the series; positive towards the mask's own +X (or +Y).

    Raises
    ------
    ValueError
        If the series is no length, the band does not fit the rate, no stretch without a gap is
        long enough, the exposure is longer than a frame, or, for ``method="time"``, the damping is
        structural or there is an exposure to undo.

    Notes
    -----
    The mean and the slope of every stretch are taken away first.
    """
    if series.unit not in _LENGTHS:
        raise ValueError(
            f"{series.name} is in {series.unit or 'no unit'}, not a length; ground motion is read "
            "off x_um or y_um"
        )
    corners = _corners(band_hz, series.rate_hz, method)
    _check_exposure(exposure_s, series.rate_hz, method)
    edge = _edge_s(edge_s, band_hz)
    cut = math.ceil(edge * series.rate_hz)
    values = np.full(len(series), np.nan)
    stretches = too_short = 0
    for first, run in _placed_runs(series):
        if len(run) <= 2 * cut + 1:
            too_short += 1
            continue
        if method == "frequency":
            found = _divided(run, series.rate_hz, suspension, quantity, corners, cut, exposure_s)
        else:
            found = inverse_in_time(_detrended(run), series.rate_hz, suspension, quantity, band_hz)
        values[first + cut : first + len(run) - cut] = found[cut : len(run) - cut]
        stretches += 1
    if not stretches:
        longest = max((len(run) for run in series.runs()), default=0) / series.rate_hz
        raise ValueError(
            f"no stretch without a gap is longer than the {2 * edge:.4g} s that its two ends take "
            f"(the longest has {longest:.4g} s); raise the lower end of the band, or take a "
            "longer track"
        )
    noise = math.nan
    if sigma is not None:
        noise = readout_rms(
            sigma,
            series.rate_hz,
            suspension,
            quantity,
            band_hz=band_hz,
            method=method,
            exposure_s=exposure_s,
        )
    return GroundMotion(
        values, series.rate_hz, f"ground {quantity} from {series.name}",
        series.unit + _PER_TIME[quantity], series.start_s, quantity,
        (float(band_hz[0]), float(band_hz[1])), corners, method, edge, noise,
        stretches, too_short, float(exposure_s),
    )  # fmt: skip


def taper_corners(
    band_hz: tuple[float, float], rate_hz: float
) -> tuple[float, float, float, float]:
    """Where the taper begins, is 1, ceases to be 1 and ends: the ``pre_filt`` of obspy.

    It rises and falls over an octave beside the band, up to half the rate.

    Raises
    ------
    ValueError
        If the band does not fit the rate.
    """
    return _corners(band_hz, rate_hz, "frequency")


def taper(
    frequency_hz: ArrayLike, corners_hz: tuple[float, float, float, float]
) -> NDArray[np.float64]:
    """The taper: cosines of the frequency from 0 to 1 and back, 1 between the inner corners."""
    f1, f2, f3, f4 = corners_hz
    f_hz = np.abs(np.asarray(frequency_hz, dtype=float))
    rise = np.clip((f_hz - f1) / (f2 - f1), 0, 1)
    fall = np.clip((f4 - f_hz) / (f4 - f3), 0, 1) if f4 > f3 else (f_hz <= f3).astype(float)
    return np.asarray(0.25 * (1 - np.cos(np.pi * rise)) * (1 - np.cos(np.pi * fall)))


def readout_asd(
    frequency_hz: ArrayLike,
    sigma: float,
    rate_hz: float,
    suspension: Suspension,
    quantity: Quantity = "acceleration",
    *,
    exposure_s: float = 0.0,
) -> NDArray[np.float64]:
    """White noise of the readings as ground motion: one-sided ASD, per sqrt(Hz).

    Parameters
    ----------
    frequency_hz : array_like
    sigma : float
        Noise of one reading.
    rate_hz : float
        Readings in a second; their ASD is sigma sqrt(2 / rate).
    suspension : Suspension
    quantity : {"displacement", "velocity", "acceleration"}
    exposure_s : float
        A reading is the mean over it, and shows so much less of the ground.

    Returns
    -------
    ndarray, shape of the frequencies
        In the unit of sigma, per s or s^2; infinite where the ground does not move the mass.

    Raises
    ------
    ValueError
        If the exposure is longer than the time between two readings.
    """
    _check_exposure(exposure_s, rate_hz, "frequency")
    f_hz = np.asarray(frequency_hz, dtype=float)
    with np.errstate(divide="ignore"):
        per_reading = 1 / np.abs(suspension.response(f_hz, quantity) * np.sinc(f_hz * exposure_s))
    return np.asarray(sigma * math.sqrt(2 / rate_hz) * per_reading)


def readout_rms(
    sigma: float,
    rate_hz: float,
    suspension: Suspension,
    quantity: Quantity = "velocity",
    *,
    band_hz: tuple[float, float],
    method: Method = "frequency",
    exposure_s: float = 0.0,
) -> float:
    """Standard deviation that white noise of the readings gives `ground_motion` in a band."""
    from scipy.integrate import trapezoid

    if not (math.isfinite(sigma) and sigma >= 0):
        raise ValueError(f"the noise of a reading must be 0 or more, not {sigma}")
    corners = _corners(band_hz, rate_hz, method)
    # In fine steps, whatever the length of a series will be; the inverse has no narrow peaks.
    f_hz = np.geomspace(corners[0] / 8, min(corners[3] * 8, rate_hz / 2), 20_001)
    if method == "time":
        gain = inverse_gain(f_hz, rate_hz, suspension, quantity, band_hz)
    else:
        gain = np.abs(_inverse(f_hz, suspension, quantity, corners, exposure_s))
    return sigma * math.sqrt(2 / rate_hz * float(trapezoid(gain**2 * f_hz, np.log(f_hz))))


# ------------------------------------------------------------------------ frequency domain


def _inverse(
    f_hz: NDArray[np.float64],
    suspension: Suspension,
    quantity: Quantity,
    corners: tuple[float, float, float, float],
    exposure_s: float,
) -> NDArray[np.complex128]:
    """Taper over the response of suspension and exposure; 0 where the taper is."""
    inside = taper(f_hz, corners)
    found = np.zeros(len(f_hz), dtype=complex)
    used = inside > 0
    shown = suspension.reading(f_hz[used], quantity) * np.sinc(f_hz[used] * exposure_s)
    found[used] = inside[used] / shown
    return found


def _divided(
    run: NDArray[np.float64],
    rate_hz: float,
    suspension: Suspension,
    quantity: Quantity,
    corners: tuple[float, float, float, float],
    cut: int,
    exposure_s: float,
) -> NDArray[np.float64]:
    """A stretch divided by the response; its first and last `cut` values do not count."""
    from scipy import fft

    shown = _detrended(run)
    half = cut // 2
    slope = 0.5 - 0.5 * np.cos(np.pi * (np.arange(half) + 0.5) / max(half, 1))
    shown[:half] *= slope
    shown[len(run) - half :] *= slope[::-1]
    # As many zeros behind it that what the filter spreads does not come round.
    length = fft.next_fast_len(len(run) + 2 * cut, real=True)
    f_hz = fft.rfftfreq(length, 1 / rate_hz)
    spectrum = fft.rfft(shown, length) * _inverse(f_hz, suspension, quantity, corners, exposure_s)
    return np.asarray(fft.irfft(spectrum, length)[: len(run)])


def _detrended(run: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without mean and slope."""
    place = np.linspace(-1, 1, len(run))
    mean = run.mean()
    return np.asarray(run - mean - place * (place @ (run - mean)) / (place @ place))


# ------------------------------------------------------------------------ stretches and bands


def _placed_runs(series: Series) -> list[tuple[int, NDArray[np.float64]]]:
    """Stretches without anything missing, each with where it begins."""
    valid = np.isfinite(series.values)
    begins = np.flatnonzero(valid & ~np.concatenate([[False], valid[:-1]]))
    return list(zip((int(first) for first in begins), series.runs(), strict=True))


def _corners(
    band_hz: tuple[float, float], rate_hz: float, method: Method
) -> tuple[float, float, float, float]:
    low, high = (float(f) for f in band_hz)
    if not (0 < low < high < math.inf):
        raise ValueError(
            f"{low:g} to {high:g} Hz is no band: give two frequencies above 0, the lower one first"
        )
    most, share = (rate_hz / 2, "half") if method == "frequency" else (rate_hz / 4, "a quarter of")
    if high > most:
        raise ValueError(
            f"the band ends at {high:g} Hz, above {most:g} Hz, {share} the rate of {rate_hz:g} Hz"
        )
    return low / 2, low, high, min(2 * high, rate_hz / 2)


def _check_exposure(exposure_s: float, rate_hz: float, method: Method) -> None:
    # a little longer than a frame is how a rate was rounded
    if not 0 <= exposure_s * rate_hz <= 1.001:
        raise ValueError(
            f"an exposure of {exposure_s:g} s does not fit between frames at {rate_hz:g} Hz; give "
            "seconds from 0 to one over the rate"
        )
    if exposure_s and method == "time":
        raise ValueError(
            "the exposure is undone in the frequency domain only; take that method, or no exposure"
        )


def _edge_s(edge_s: float | None, band_hz: tuple[float, float]) -> float:
    if edge_s is None:
        return _EDGE_PERIODS / band_hz[0]
    if not (math.isfinite(edge_s) and edge_s >= 0):
        raise ValueError(f"the time cut off at an end must be 0 s or more, not {edge_s}")
    return float(edge_s)


assert set(_PER_TIME) == set(QUANTITIES)
