"""The live amplitude spectrum beside the bound of the photons."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.gaps import Series
from rasnik.characterisation.spectrum import welch
from rasnik.web.quantities import QUANTITIES, Quantity
from rasnik.web.rows import last_rows

__all__ = ["Spectra", "live_spectrum"]

_WINDOWS = 12  # half overlapping: smooth enough to read, long enough to see slow motion
_LEAST_ROWS = 128
_MOST_ROWS = 2**18
_FRESH_S = 0.9

Arrays = dict[str, NDArray[np.float32]]


def live_spectrum(rows: NDArray[Any]) -> tuple[Arrays, dict[str, float]]:
    """Amplitude spectral densities of the last rows, and what noise alone would give.

    Frames that are missing stay missing. White noise of sigma at f frames a second has a
    one-sided density of 2 sigma^2 / f.

    Parameters
    ----------
    rows : structured array
        As in `Channel.recent`.

    Returns
    -------
    arrays : dict
        ``frequency_hz`` and, for every quantity, its density per root hertz.
    bounds : dict
        The density of the poses' own standard deviations.

    Raises
    ------
    ValueError
        If there are too few frames.
    """
    places, rate_hz = _places(rows)
    arrays: Arrays = {}
    bounds: dict[str, float] = {}
    for quantity in QUANTITIES:
        values = np.full(places[-1] + 1, np.nan)
        values[places] = rows[quantity.column] * quantity.factor
        spectrum = welch(Series(values, rate_hz, quantity.column, quantity.unit), windows=_WINDOWS)
        arrays["frequency_hz"] = spectrum.frequency_hz[1:].astype(np.float32)
        arrays[quantity.key] = spectrum.asd[1:].astype(np.float32)
        bounds[quantity.key] = _bound(rows, quantity, rate_hz)
    return arrays, bounds


def _bound(rows: NDArray[Any], quantity: Quantity, rate_hz: float) -> float:
    sigma = rows[quantity.sigma]
    sigma = sigma[np.isfinite(sigma)]
    if not sigma.size:
        return math.nan
    return float(np.sqrt(np.mean(sigma**2) * 2 / rate_hz) * quantity.factor)


def _places(rows: NDArray[Any]) -> tuple[NDArray[np.int64], float]:
    """(places on an even grid, frames in a second): numbers left out are frames lost."""
    rows = rows[-_MOST_ROWS:]
    places = rows["frame"] - (rows["frame"][0] if len(rows) else 0)
    if len(rows) < _LEAST_ROWS or places[-1] > 4 * len(rows):
        raise ValueError("there are too few frames for a spectrum yet")
    span_s = float(rows["received_s"][-1] - rows["received_s"][0])
    if not span_s > 0:
        raise ValueError("the times of the frames do not increase; there is no spectrum")
    return places, float(places[-1] / span_s)


class Spectra:
    """Spectra of a channel, made once a second at most, whoever looks on."""

    def __init__(self, recent: Any) -> None:
        self._recent = recent
        self._lock = threading.Lock()
        self._made: dict[float, tuple[float, Arrays, dict[str, float]]] = {}

    def last(self, seconds: float) -> tuple[Arrays, dict[str, float]]:
        """As `live_spectrum`, of so many seconds."""
        with self._lock:
            made = self._made.get(seconds)
            if made is None or time.monotonic() - made[0] > _FRESH_S:
                if len(self._made) > 8:
                    self._made.clear()
                rows, _ = last_rows(self._recent, seconds)
                made = self._made[seconds] = (time.monotonic(), *live_spectrum(rows))
            return made[1:]
