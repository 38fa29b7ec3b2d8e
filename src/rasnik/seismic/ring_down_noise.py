"""The noise in which a ring-down is seen, and what it does to the fit's errors.

A least-squares fit weighs all readings alike. If the noise is not white, its parameters scatter by

    C = B M B,   B = (J^T J)^-1,   M = sum over frequencies of |J(f)|^2 S(f),

with J the slopes of the model and S the spectrum of the noise. S is taken from what remains of the
fit: white, but for a band around the resonance and the lowest frequencies where they stand out. In
that band it is a constant and the response of the suspension to the ground's acceleration; the
middle, from which the fit has taken its share, is left out when it is found.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Rest", "covariance"]

_LEAST_BINS = 10  # on either side of the resonance, and of frequency 0
_WIDTHS = 8  # of the resonance, that the band reaches on either side
_TAKEN_BINS = 2  # on either side of the resonance that a fit flattens at least
_SURE = 4.0  # standard deviations by which noise is above white to be called so
_ITERATIONS = 12


@dataclass(frozen=True, eq=False)
class Rest:
    """What remains of a fit, on the grid of the series.

    Attributes
    ----------
    places : ndarray of int, shape (n,)
        Of the readings on the grid.
    rest : ndarray, shape (n,)
    length : int
        Places of the grid.
    frequency, loss : float
        Of the resonance, in cycles per place, and 1 / Q.
    """

    places: NDArray[np.int64]
    rest: NDArray[np.float64]
    length: int
    frequency: float
    loss: float

    def transform(self, values: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Of columns of values at the readings, 0 at other places; shape (m, columns)."""
        from scipy import fft

        shown = np.zeros((self.length, *values.shape[1:]))
        shown[self.places] = values
        return np.asarray(fft.rfft(shown, axis=0))

    def spectrum(self) -> tuple[NDArray[np.float64], float, float]:
        """(S at the frequencies of the transform, power around the resonance, the same over white).

        The first two in units of the mean. Around the resonance all are 1 where chance explains
        what is seen.
        """
        power = np.abs(self.transform(self.rest)) ** 2
        f = np.arange(len(power)) / self.length
        width = max(abs(self.loss) * self.frequency, 1 / self.length)
        reach = max(_LEAST_BINS / self.length, _WIDTHS * width)
        near = (np.abs(f - self.frequency) <= reach) & (f > 0)
        below = (np.arange(len(power)) <= _LEAST_BINS) & ~near & (f > 0)
        others = ~near & ~below & (f > 0)
        white = float(power[others].mean()) if others.sum() > _LEAST_BINS else 0.0
        whole = float(power[1:].mean())
        shape = np.ones(len(power))
        if white == 0.0:
            return shape, 1.0, 1.0
        colour = float(power[near].sum() / max(near.sum() - 2, 1)) / white
        if colour > 1 + _SURE / math.sqrt(near.sum()):
            shape[near] = self._resonant(f, power, near, width) / white
        else:
            colour = 1.0
        if below.sum() > 2:
            low = float(power[below].sum() / (below.sum() - 1)) / white
            if low > 1 + _SURE / math.sqrt(below.sum()):
                shape[below] = shape[0] = low
        level = colour * white / whole if colour > 1 else 1.0
        return shape * (white / whole), level, colour

    def _resonant(
        self,
        f: NDArray[np.float64],
        power: NDArray[np.float64],
        near: NDArray[np.bool_],
        width: float,
    ) -> NDArray[np.float64]:
        """Spectrum within the band: a constant and a resonance, of the greatest likelihood."""
        from scipy.optimize import nnls

        peak = self.frequency**2 / ((self.frequency**2 - f**2) ** 2 + (f * width) ** 2)
        columns = np.stack([np.ones(len(f)), peak * width**2], axis=1)
        seen = near & (np.abs(f - self.frequency) > max(_TAKEN_BINS / self.length, width))
        if seen.sum() < _LEAST_BINS:
            return np.full(int(near.sum()), float(power[near].mean()))
        level = np.full(int(seen.sum()), float(power[seen].mean()))
        for _ in range(_ITERATIONS):  # periodograms scatter by as much as they are
            found, _ = nnls(columns[seen] / level[:, None], power[seen] / level)
            level = np.maximum(columns[seen] @ found, 1e-6 * power[seen].mean())
        return np.asarray(columns[near] @ found)


def covariance(
    rest: Rest, jacobian: NDArray[np.float64], variance: float
) -> tuple[NDArray[np.float64], float, float]:
    """(covariance of the parameters, power around the resonance over the mean, and over white)."""
    norm = np.linalg.norm(jacobian, axis=0)
    slopes = jacobian / norm
    inverse = np.linalg.inv(slopes.T @ slopes)
    shape, level, colour = rest.spectrum()
    if (shape == shape[0]).all():
        middle = slopes.T @ slopes
    else:
        transform = rest.transform(slopes)
        twice = np.full(len(shape), 2.0)  # for the frequencies below 0
        twice[0] = 1.0
        if rest.length % 2 == 0:
            twice[-1] = 1.0
        weighted = transform.conj().T * (shape * twice)
        middle = np.real(weighted @ transform) / rest.length
    found = variance * inverse @ middle @ inverse
    return found / np.outer(norm, norm), level, colour
