"""How much the ground moves at the quietest and the noisiest of seismic stations.

The new low- and high-noise models: the envelopes of the spectra of 75 stations, given as
10 log10 of the power spectral density of the acceleration, A + B log10(T), in ranges of the
period T. They are the convention to compare an instrument's self-noise with.

Source: J. Peterson, Observations and modeling of seismic background noise, U.S. Geological Survey
Open-File Report 93-322 (1993), tables 3 and 4.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.seismic.suspension import QUANTITIES, Quantity

__all__ = ["RANGES_HZ", "noise_model"]

# Beginning of each range of the period in s, A and B in dB relative to 1 (m/s^2)^2/Hz; the last
# range ends at 1e5 s.
_LOW = (
    (0.10, -162.36, 5.64),
    (0.17, -166.70, 0.00),
    (0.40, -170.00, -8.30),
    (0.80, -166.40, 28.90),
    (1.24, -168.60, 52.48),
    (2.40, -159.98, 29.81),
    (4.30, -141.10, 0.00),
    (5.00, -71.36, -99.77),
    (6.00, -97.26, -66.49),
    (10.00, -132.18, -31.57),
    (12.00, -205.27, 36.16),
    (15.60, -37.65, -104.33),
    (21.90, -114.37, -47.10),
    (31.60, -160.58, -16.28),
    (45.00, -187.50, 0.00),
    (70.00, -216.47, 15.70),
    (101.00, -185.00, 0.00),
    (154.00, -168.34, -7.61),
    (328.00, -217.43, 11.90),
    (600.00, -258.28, 26.60),
    (10000.00, -346.88, 48.75),
)
_HIGH = (
    (0.10, -108.73, -17.23),
    (0.22, -150.34, -80.50),
    (0.32, -122.31, -23.87),
    (0.80, -116.85, 32.51),
    (3.80, -108.48, 18.08),
    (4.60, -74.66, -32.95),
    (6.30, 0.66, -127.18),
    (7.90, -93.37, -22.42),
    (15.40, 73.54, -162.98),
    (20.00, -151.52, 10.01),
    (354.80, -206.66, 31.63),
)
_TABLES = {"low": np.array(_LOW), "high": np.array(_HIGH)}
_LONGEST_S = 1e5

#: Frequencies that both models cover.
RANGES_HZ = (1 / _LONGEST_S, 10.0)


def noise_model(
    frequency_hz: ArrayLike,
    model: Literal["low", "high"] = "low",
    quantity: Quantity = "acceleration",
) -> NDArray[np.float64]:
    """Power spectral density of the ground's motion by a noise model of Peterson.

    Parameters
    ----------
    frequency_hz : array_like
    model : {"low", "high"}
        NLNM or NHNM.
    quantity : {"displacement", "velocity", "acceleration"}

    Returns
    -------
    ndarray, shape of the frequencies
        One-sided, in m^2/Hz, (m/s)^2/Hz or (m/s^2)^2/Hz; NaN outside 1e-5 to 10 Hz, where the
        models say nothing.
    """
    f_hz = np.asarray(frequency_hz, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        period_s = np.where(f_hz > 0, 1 / f_hz, np.nan)
    table = _TABLES[model]
    begins = table[:, 0]
    # 1/10 s must lie in the first range whatever the last bit of 1/f.
    covered = (period_s >= begins[0] * (1 - 1e-12)) & (period_s <= _LONGEST_S * (1 + 1e-12))
    place = np.clip(np.searchsorted(begins, period_s, side="right") - 1, 0, len(begins) - 1)
    decibel = table[place, 1] + table[place, 2] * np.log10(np.where(covered, period_s, 1.0))
    acceleration = np.where(covered, 10 ** (decibel / 10), np.nan)
    integrations = 2 - QUANTITIES[quantity]
    with np.errstate(divide="ignore"):
        return np.asarray(acceleration / (2 * np.pi * f_hz) ** (2 * integrations))
