"""New references for a mask that moves on: in one go, or in parts that a stream has time for."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil

import numpy as np

from rasnik.tracking.arrival import Arrivals
from rasnik.tracking.linearisation import Linearisation, linearise, linearise_in_parts
from rasnik.tracking.reference import NEAR, USABLE, Reading, Reference
from rasnik.tracking.tiling import tiling

__all__ = ["Renewal"]

_WORK_S = 0.12  # of a stream, over which the work on a new reference is spread
_STEPS = 7  # of that work beside those on tiles
_EARLY = 0.5  # of the range of a reference: where a stream begins to work on the next
_SOON = 32  # frames; a reference that lasts as long need not be set ahead
_AHEAD = 0.7  # of the range, where the mask moves fast


class Renewal:
    """Makes the next reference out of the present one."""

    def __init__(self) -> None:
        self._work: Iterator[Linearisation | None] | None = None
        self._share = 1.0  # of the work, done with a frame

    def stop(self) -> None:
        """Forget what has been begun."""
        self._work = None

    def at_once(self, reference: Reference, reading: Reading, clock: float) -> Reference | None:
        """A reference where the mask is, or ahead of it if it moves fast.

        None if the model cannot describe what is there; the next frame decides.
        """
        self.stop()
        frames = _frames_ahead(reference, _speed_um(reference, reading, clock))
        try:
            state = reference.ahead(reading, clock, frames)
            return reference.moved_to(linearise(reference.linear.settings, state))
        except ValueError:
            return None

    def in_parts(
        self, reference: Reference, reading: Reading, arrivals: Arrivals
    ) -> Reference | None:
        """Do a part of the work, in a stream that must not wait.

        A reference once it is done, if the mask is nearer to it than to the present one.
        """
        try:
            if self._work is None and not self._begin(reference, reading, arrivals):
                return None
            assert self._work is not None
            for _ in range(ceil(self._share * _STEPS)):
                linear = next(self._work)
                if linear is not None:
                    self.stop()
                    return _if_nearer(reference, reading, reference.moved_to(linear))
        except ValueError:  # a state that cannot be modelled
            self.stop()
        return None

    def _begin(self, reference: Reference, reading: Reading, arrivals: Arrivals) -> bool:
        """Begin if a new reference will be wanted; early, as the mask moves on meanwhile."""
        if reference.near(reading) and reference.motion(reading) <= _EARLY * NEAR:
            return False
        period_s = arrivals.period_s
        share = 1 / _SOON if np.isnan(period_s) else period_s / _WORK_S
        # It has to be done before the mask is out of the present one's reach.
        speed_um = _speed_um(reference, reading, arrivals.clock)
        left_um = (USABLE / NEAR) * reference.near_um - float(np.hypot(*reading.step[:2]))
        self._share = min(1.0, max(share, 2 * speed_um / max(left_um, 1e-9)))
        frames = 1 / self._share + _frames_ahead(reference, speed_um)
        state, settings = (
            reference.ahead(reading, arrivals.clock, frames),
            reference.linear.settings,
        )
        tiles = ceil(self._share * tiling(settings.camera).count)
        self._work = linearise_in_parts(settings, state, tiles)
        return True


def _speed_um(reference: Reference, reading: Reading, clock: float) -> float:
    """Motion on the mask from frame to frame."""
    return float(np.hypot(*reference.velocity(reading, clock)[:2]))


def _frames_ahead(reference: Reference, speed_um: float) -> float:
    """How far a reference is set ahead of a mask that would soon be out of its range."""
    fast = speed_um > reference.near_um / _SOON
    return _AHEAD * reference.near_um / speed_um if fast else 0.0


def _if_nearer(reference: Reference, reading: Reading, moved: Reference) -> Reference | None:
    step = reading.step[:4]
    off = reference.vector + step - moved.vector
    return moved if np.hypot(*off[:2]) < np.hypot(*step[:2]) else None
