"""Where the mask will be: extrapolation of the last poses."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

__all__ = ["Motion"]

_KEPT = 3
_LONGEST_GAP = 8  # frames; what was before says nothing about now


class Motion:
    """The last poses of a mask, and a parabola through them.

    Poses are (x_um, y_um, ln S, theta_rad); times are in frames.
    """

    def __init__(self) -> None:
        self._last: deque[tuple[float, NDArray[np.float64]]] = deque(maxlen=_KEPT)

    def add(self, time: float, pose: NDArray[np.float64]) -> None:
        """Take note of a pose; times that do not grow start anew."""
        if self._last and not 0 < time - self._last[-1][0] <= _LONGEST_GAP:
            self._last.clear()
        self._last.append((time, pose))

    def predict(self, time: float) -> NDArray[np.float64] | None:
        """The pose at a time, shape (4,); None if there is nothing to extrapolate from."""
        if not self._last or time - self._last[-1][0] > _LONGEST_GAP:
            return None
        times = np.array([one for one, _ in self._last]) - self._last[-1][0]
        ahead = time - self._last[-1][0]
        weights = np.ones(len(times))  # of Lagrange's polynomial
        for k, own in enumerate(times):
            others = np.delete(times, k)
            weights[k] = np.prod((ahead - others) / (own - others))
        return np.array([pose for _, pose in self._last]).T @ weights
