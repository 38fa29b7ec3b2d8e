"""From expected grey levels to what the sensor hands out: fluctuations, range, rounding.

The fluctuation of a pixel of expected grey level Q has the variance A + B Q: electronic noise
A, and shot noise B Q, where B is the grey level made by one electron.

Source: van der Graaf et al., section 3 "Quantum fluctuations: shot noise" and section 4,
``Q_fluc = sqrt(A + B Q)``.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rasnik.instrument import System

__all__ = ["ReadOut", "Statistics", "add_noise", "frame_dtype", "quantise_levels"]

Statistics = Literal["gaussian", "poisson"]


def frame_dtype(system: System) -> np.dtype[Any]:
    """Type of the frames of a system: uint8 up to 8 bits, else uint16."""
    return np.dtype(np.uint8 if system.sensor.bit_depth <= 8 else np.uint16)


def quantise_levels(levels: NDArray[np.floating[Any]], system: System) -> NDArray[Any]:
    """Grey levels limited to 0 .. full scale and rounded to the nearest whole number.

    Parameters
    ----------
    levels : ndarray of float, any shape
        Changed in place.
    system : System
        Gives full scale and data type.

    Returns
    -------
    ndarray of uint8 or uint16
    """
    np.rint(levels, out=levels)
    np.clip(levels, 0, system.full_scale, out=levels)
    return levels.astype(frame_dtype(system))


class ReadOut:
    """Noisy frames of one expected image; what they have in common is worked out once.

    Parameters
    ----------
    expected : ndarray of float, shape (H, W)
        Expected grey levels.
    system : System
        Gives the noise law (A, B) of its images, and their range.
    statistics : {"gaussian", "poisson"}
        Distribution of the shot noise: as the paper has it, or that of whole electrons
        (1 / B of them per grey level; of a superpixel: in all its pixels together). The
        variance is the same.

    Raises
    ------
    ValueError
        If the system does not state its noise, or a grey level is not finite.
    """

    def __init__(
        self,
        expected: NDArray[np.floating[Any]],
        system: System,
        statistics: Statistics = "gaussian",
    ) -> None:
        if statistics not in ("gaussian", "poisson"):
            raise ValueError(f"statistics must be 'gaussian' or 'poisson', not {statistics!r}")
        if system.noise_law is None:
            raise ValueError(
                f"the noise of system {system.name} is not known: give sensor.noise_a and "
                "sensor.noise_b, or simulate without noise"
            )
        levels = np.asarray(expected, dtype=np.float64)
        if not np.isfinite(levels).all():
            raise ValueError("the expected image holds grey levels that are not finite")
        self.system = system
        electronic, self._grey_per_electron = system.noise_law
        # An expected level below zero (black of a level map) has no shot noise.
        light = np.maximum(levels, 0.0)
        self._poisson = statistics == "poisson" and self._grey_per_electron > 0
        if self._poisson:
            self._electrons = light / self._grey_per_electron
            levels = levels - light
            self._sigma = np.full(levels.shape, np.sqrt(electronic), dtype=np.float32)
        else:
            shot = self._grey_per_electron * light
            self._sigma = np.sqrt(electronic + shot).astype(np.float32)
        self._levels = levels
        self._levels32 = levels.astype(np.float32)

    def frame(self, rng: np.random.Generator, *, quantise: bool = True) -> NDArray[Any]:
        """One noisy frame.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of the fluctuations; two frames from generators in the same state are equal.
        quantise : bool
            Limit to the range of the sensor and round to whole grey levels.

        Returns
        -------
        ndarray, shape (H, W)
            uint8 or uint16; float64 if not quantised.
        """
        # Single precision: its rounding is below 1/100 of a grey level, even of 16 bits, and
        # it halves the time. Unrounded frames keep the expected level in double precision.
        noise = rng.standard_normal(self._levels.shape, dtype=np.float32)
        noise *= self._sigma
        if self._poisson:
            noise += self._grey_per_electron * rng.poisson(self._electrons)
        if not quantise:
            return np.asarray(self._levels + noise)
        noise += self._levels32
        return quantise_levels(noise, self.system)


def add_noise(
    expected: NDArray[np.floating[Any]],
    system: System,
    rng: np.random.Generator | int | None = None,
    *,
    quantise: bool = True,
    statistics: Statistics = "gaussian",
) -> NDArray[Any]:
    """One noisy frame of an expected image; for many of the same image see `ReadOut`.

    Parameters
    ----------
    expected : ndarray of float, shape (H, W)
        Expected grey levels. Not changed.
    system : System
        Gives the noise law (A, B) of its images, and their range.
    rng : numpy.random.Generator or int, optional
        Source of the fluctuations, or its seed.
    quantise : bool
        Limit to the range of the sensor and round to whole grey levels.
    statistics : {"gaussian", "poisson"}
        Distribution of the shot noise.

    Returns
    -------
    ndarray, shape (H, W)
        uint8 or uint16 by the system's bit depth; float64 if not quantised.

    Raises
    ------
    ValueError
        If the system does not state its noise, or a grey level is not finite.
    """
    readout = ReadOut(expected, system, statistics)
    return readout.frame(np.random.default_rng(rng), quantise=quantise)
