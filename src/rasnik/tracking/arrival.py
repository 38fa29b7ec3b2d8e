"""When frames come, and which are missing: their numbers and times against each other."""

from __future__ import annotations

import numpy as np

from rasnik.analysis.flags import Flag

__all__ = ["Arrivals"]

_PERIODS = 32  # frames over which the period is averaged
_SHORTEST, _LONGEST = 0.5, 1.5  # periods between frames that follow each other


class Arrivals:
    """The number and time of the last frame, and the usual time between frames.

    Attributes
    ----------
    clock : float
        Frames since the beginning, those that were lost included.
    period_s : float
        Mean time between frames; NaN if it is not known.
    """

    def __init__(self) -> None:
        self.clock = 0.0
        self._number = -1
        self._time_s = float("nan")
        self.period_s = float("nan")

    def add(self, time_s: float | None, number: int | None) -> Flag:
        """Take note of a frame; the flags say whether it follows the one before.

        Parameters
        ----------
        time_s : float or None
            NaN or None if it is not known.
        number : int or None
            None for the number after the last.
        """
        flags = Flag.NONE
        before, self._number = self._number, self._number + 1 if number is None else int(number)
        passed = self._number - before
        if before >= 0 and passed != 1:
            flags |= Flag.FRAMES_LOST if passed > 1 else Flag.TIME_IRREGULAR
        passed = max(passed, 1)
        self.clock += passed
        if time_s is None or not np.isfinite(time_s):
            return flags
        elapsed, self._time_s = float(time_s) - self._time_s, float(time_s)
        return flags | self._pace(elapsed, passed)

    def _pace(self, elapsed_s: float, frames: int) -> Flag:
        """Whether the time between two frames is what it usually is."""
        if np.isnan(elapsed_s):  # the first time
            return Flag.NONE
        if elapsed_s <= 0:
            return Flag.TIME_IRREGULAR
        period = elapsed_s / frames
        if np.isnan(self.period_s):
            self.period_s = period
        usual = _SHORTEST < period / self.period_s < _LONGEST
        self.period_s += (min(period, 2 * self.period_s) - self.period_s) / _PERIODS
        return Flag.NONE if usual else Flag.TIME_IRREGULAR
