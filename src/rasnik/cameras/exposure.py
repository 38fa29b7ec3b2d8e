"""Exposure such that the brightest fields stay just below full scale.

Noise falls with the light that is collected, until pixels are saturated: the more light the
better, up to full scale. The paper works with the largest grey level just below it.

Source: van der Graaf et al., section "Results of the SolidRas and MicroRas systems".
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.cameras.camera import CameraFrame

__all__ = ["ExposureKeeper"]

# Of full scale: where the brightest pixels are put, and where they may be.
_AIM, _LEAST, _MOST = 0.97, 0.92, 0.99
_BRIGHTEST = 0.999  # quantile: single hot pixels do not count
_SATURATED = 2e-3  # part of the pixels that may be
# Beyond full scale one does not see how far; steps by the part of the pixels that are there.
_TOO_BRIGHT = ((0.3, 0.35), (0.1, 0.6), (0.02, 0.8), (0.0, 0.93))
_LARGEST_STEP = 3.0
_LOOKS, _MOST_LOOKS = 3, 192  # in a row outside the limits, before there is a step up
_LOOKS_DOWN = 2
_QUIET_LOOKS = 400  # within the limits, after which earlier reversals are forgotten
_SMALLEST_STEP = 0.01  # cameras do not set an exposure more finely
_PATIENCE = 20  # frames looked at for a new exposure to come into force
_PIXELS = 20_000


class ExposureKeeper:
    """Proposes exposures from frames; whoever has the camera sets them.

    It looks at a few thousand pixels of each frame that it is given; a few frames a second will
    do. It steps down at once where pixels are saturated, and up with patience; whenever a step up
    had to be taken back, or was not taken, it doubles its patience, so that it never hunts.

    Parameters
    ----------
    full_scale : int
        Largest grey level.
    shortest_us, longest_us : float
        Limits. An exposure longer than the time between frames costs frames.

    Examples
    --------
    >>> import numpy as np
    >>> from rasnik.cameras.camera import CameraFrame
    >>> keeper = ExposureKeeper(255)
    >>> white = np.full((20, 20), 255, np.uint8)
    >>> proposals = [
    ...     keeper.propose(CameraFrame(white, k, 0.0, 0.0, exposure_us=1000.0)) for k in range(2)
    ... ]
    >>> proposals
    [None, 350.0]
    """

    def __init__(
        self, full_scale: int, *, shortest_us: float = 10.0, longest_us: float = math.inf
    ) -> None:
        if not 0 < shortest_us <= longest_us:
            raise ValueError(
                f"exposures from {shortest_us:g} to {longest_us:g} us are no range; the shortest "
                "has to be positive and not above the longest"
            )
        if full_scale < 1:
            raise ValueError(f"full_scale is the largest grey level, not {full_scale}")
        self._full_scale = full_scale
        self._shortest_us, self._longest_us = shortest_us, longest_us
        self._patience = _LOOKS
        self._odd = self._quiet = 0  # looks outside the limits, and within
        self._direction = 0  # of the last step
        self._expected_us = math.nan  # proposed, and not seen yet
        self._waited = 0

    def propose(self, frame: CameraFrame) -> float | None:
        """An exposure in microseconds; None if that of the frame is right.

        Parameters
        ----------
        frame : CameraFrame
            With the exposure it was taken with; without one there is no proposal.
        """
        exposure_us = frame.exposure_us
        if not exposure_us > 0 or self._is_old(exposure_us):
            return None
        brightest, saturated = self._look(frame.image)
        factor = _factor(brightest, saturated)
        if factor == 1:
            self._odd = 0
            self._quiet += 1
            if self._quiet >= _QUIET_LOOKS:
                self._patience, self._direction = _LOOKS, 0
            return None
        direction = 1 if factor > 1 else -1
        self._quiet = 0
        self._odd = self._odd + direction if self._odd * direction >= 0 else direction
        if abs(self._odd) < (self._patience if direction > 0 else _LOOKS_DOWN):
            return None
        return self._step(exposure_us, factor, direction)

    def _step(self, exposure_us: float, factor: float, direction: int) -> float | None:
        proposed = min(max(exposure_us * factor, self._shortest_us), self._longest_us)
        if abs(proposed / exposure_us - 1) < _SMALLEST_STEP:
            return None  # at a limit, or as near as a camera can be set
        if self._direction > 0 > direction:
            self._patience = min(2 * self._patience, _MOST_LOOKS)
        self._direction = direction
        self._odd, self._waited, self._expected_us = 0, 0, proposed
        return proposed

    def _is_old(self, exposure_us: float) -> bool:
        """Whether a frame was taken before the last proposal came into force."""
        if math.isnan(self._expected_us):
            return False
        self._waited += 1
        there = abs(exposure_us / self._expected_us - 1) < _SMALLEST_STEP
        if there or self._waited > _PATIENCE:
            # The frame may have been under way when the setting changed: the next one counts.
            self._expected_us = math.nan
            if not there:  # cameras round, and callers may refuse
                self._patience = min(2 * self._patience, _MOST_LOOKS)
        return True

    def _look(self, image: NDArray[Any]) -> tuple[float, float]:
        """Brightest level over full scale, and part of the pixels that are saturated."""
        flat = image.reshape(-1)
        # Steps of an odd number do not stay on the same columns.
        some = flat[:: max(1, flat.size // _PIXELS) | 1]
        brightest = float(np.quantile(some, _BRIGHTEST)) / self._full_scale
        return brightest, float(np.mean(some >= self._full_scale))


def _factor(brightest: float, saturated: float) -> float:
    """By which the exposure should change; 1 within the limits."""
    if saturated > _SATURATED or brightest > _MOST:
        return next(factor for least, factor in _TOO_BRIGHT if saturated >= least)
    if brightest >= _LEAST:
        return 1.0
    return min(_AIM / max(brightest, 1e-6), _LARGEST_STEP)
