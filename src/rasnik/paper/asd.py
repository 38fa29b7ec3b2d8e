"""Amplitude spectral density of a column of a track, with its lines and its noise floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.floor import NoiseFloor, noise_floor
from rasnik.characterisation.gaps import even_series
from rasnik.characterisation.lines import Line, find_lines
from rasnik.characterisation.spectrum import Spectrum, welch
from rasnik.paper.outcome import Value
from rasnik.tracking.track import Track

__all__ = ["WINDOW_S", "Asd", "asd_of"]

#: The paper's windows: an hour at 275 Hz divided into 5000 windows that overlap by half.
WINDOW_S = 2 * 3600 / 5001
# The simulated motions end below; a camera of 100 Hz leaves room only from half of that on.
_FLOOR_FROM_HZ = 60.0


@dataclass(frozen=True, eq=False)
class Asd:
    """A one-sided amplitude spectral density in units of choice.

    Attributes
    ----------
    spectrum : Spectrum
        In the unit of the track's series (nm, rad).
    lines : tuple of Line
    level : NoiseFloor
    factor : float
        From that unit to the one of choice.
    """

    spectrum: Spectrum
    lines: tuple[Line, ...]
    level: NoiseFloor
    factor: float

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Without zero."""
        return self.spectrum.frequency_hz[1:]

    @property
    def density(self) -> NDArray[np.float64]:
        """At `frequency_hz`."""
        return self.factor * self.spectrum.asd[1:]

    @property
    def floor(self) -> Value:
        """Noise floor with its standard deviation."""
        return Value(self.factor * self.level.asd, self.factor * self.level.sigma)

    @property
    def floor_range_hz(self) -> tuple[float, float]:
        """Where the floor was taken."""
        return self.level.low_hz, self.level.high_hz


def asd_of(track: Track, column: str, factor: float = 1.0) -> Asd:
    """Welch's spectrum of a column with the paper's windows; `factor` for the unit."""
    spectrum = welch(even_series(track, column), length_s=WINDOW_S)
    lines = find_lines(spectrum)
    nyquist_hz = spectrum.rate_hz / 2
    range_hz = min(_FLOOR_FROM_HZ, 0.6 * nyquist_hz), nyquist_hz
    return Asd(spectrum, lines, noise_floor(spectrum, lines, range_hz=range_hz), factor)
