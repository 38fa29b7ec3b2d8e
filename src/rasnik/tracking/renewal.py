"""New references for a mask that moves on: in one go, or in parts that a stream has time for."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil

import numpy as np

from rasnik.tracking.arrival import Arrivals
from rasnik.tracking.linearisation import Linearisation, linearise, linearise_in_parts
from rasnik.tracking.reference import NEAR, Reading, Reference
from rasnik.tracking.tiling import tiling

__all__ = ["Renewal"]

_WORK_S = 0.12  # of a stream, over which the work on a new reference is spread
_STEPS = 6  # of that work beside those on tiles
_EARLY = 0.5  # of the range of a reference: where a stream begins to work on the next
_SOON = 32  # frames; a reference that lasts as long need not be set ahead
_AHEAD = 0.7  # of the range, where the mask moves fast


class Renewal:
    """Makes the next reference out of the present one."""

    def __init__(self) -> None:
        self._work: Iterator[Linearisation | None] | None = None

    def stop(self) -> None:
        """Forget what has been begun."""
        self._work = None

    def at_once(self, reference: Reference, reading: Reading, clock: float) -> Reference | None:
        """A reference where the mask is, or ahead of it if it moves fast.

        None if the model cannot describe what is there; the next frame decides.
        """
        self.stop()
        velocity = reference.velocity(reading, clock)
        speed = float(np.hypot(*velocity[:2]))
        fast = speed > reference.near_um / _SOON
        frames = _AHEAD * reference.near_um / speed if fast else 0.0
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
        period = arrivals.period_s
        share = 1 / _SOON if np.isnan(period) else min(period / _WORK_S, 1.0)  # of the work
        try:
            if self._work is None:
                self._work = _begun(reference, reading, arrivals.clock, share)
                return None
            for _ in range(ceil(share * _STEPS)):
                linear = next(self._work)
                if linear is not None:
                    self.stop()
                    return _if_nearer(reference, reading, reference.moved_to(linear))
        except ValueError:  # a state that cannot be modelled
            self.stop()
        return None


def _begun(
    reference: Reference, reading: Reading, clock: float, share: float
) -> Iterator[Linearisation | None] | None:
    """The work on a new reference, if one will be wanted; early, as the mask moves on meanwhile."""
    if reference.near(reading) and reference.motion(reading) <= _EARLY * NEAR:
        return None
    state, settings = reference.ahead(reading, clock, 1 / share), reference.linear.settings
    return linearise_in_parts(settings, state, ceil(share * tiling(settings.camera).count))


def _if_nearer(reference: Reference, reading: Reading, moved: Reference) -> Reference | None:
    step = reading.step[:4]
    off = reference.vector + step - moved.vector
    return moved if np.hypot(*off[:2]) < np.hypot(*step[:2]) else None
