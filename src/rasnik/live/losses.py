"""Which frames are missing: the camera's numbers, and two clocks against each other.

Beside the camera's clock it is the one by which frames are received, which nobody sets. The
computer's time of day may be set at any moment, and loses no frame by that.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from statistics import median

from rasnik.analysis.flags import Flag
from rasnik.cameras.camera import CameraFrame

__all__ = ["Arrival", "Losses"]

_INTERVALS = 16  # of which the usual one is the median
_KNOWN_AFTER = 8  # intervals, before frames are missed by time
_LATE = 0.75  # periods; a frame later than that comes instead of the one that was expected
_FORGET = 1 / 8  # of the lateness, per frame: clocks drift, and the period is not known well
_REPAID_WITHIN = 64  # frames, in which frames that were thought lost may still come
_CLOCK_JUMP_S = 2.0  # by which the camera's clock gains on the computer's: it was set
_ODD_GAP = 1000  # frames, beyond twice what fits in the time: the camera began to count anew


@dataclass(frozen=True, slots=True)
class Arrival:
    """What is known of a frame before it is looked at.

    Attributes
    ----------
    number : int
        Frames since the channel began, those that were lost included: always grows.
    time_s : float or None
        By the camera's clock, or the host's if it has none; None if this frame has no time.
    flags : Flag
        What neither number nor time can tell the tracker.
    """

    number: int
    time_s: float | None
    flags: Flag


class Losses:
    """Numbers frames without end, and counts those that are missing.

    A camera that is late may skip frames without leaving numbers out; frames are therefore also
    missed by time. Frames missed by time that come after all are taken off the count again.

    Parameters
    ----------
    wraps_at : int or None
        The camera's largest number; the next is 1.
    regular : bool
        Whether frames are due at regular times. If not, none is missed by time.
    live : bool
        Whether the computer's clock runs with the camera's. It does not for recordings.

    Attributes
    ----------
    frames : int
        That came.
    lost_in_transfer, lost_by_time : int
        Missing by their numbers; by time alone.
    period_s : float
        Usual time between frames; NaN if it is not known.
    """

    def __init__(
        self, wraps_at: int | None = None, *, regular: bool = True, live: bool = True
    ) -> None:
        self._wraps_at, self._regular, self._live = wraps_at, regular, live
        self.frames = self.lost_in_transfer = self.lost_by_time = 0
        self.period_s = math.nan
        self._number = -1
        self._last: CameraFrame | None = None
        self._received_s = math.nan
        self._forget_times()
        self._continued = self._pace_changed = False

    def restart(self) -> None:
        """The camera was connected again: it may count anew, and its clock may have been set."""
        self._last = None
        self._forget_times()
        self._continued = self.frames > 0

    def change_pace(self) -> None:
        """The camera was told something that may change its rate, which is learnt anew."""
        self._pace_changed = True

    def add(self, frame: CameraFrame) -> Arrival:
        """Number a frame, and count what is missing before it."""
        flags = Flag.NONE
        if self._pace_changed:
            self._pace_changed = False
            self._forget_times()
        if self._continued:
            passed = 1 + self._missed_while_away(frame)
        else:
            counted = self._counted(frame)
            if counted is None:  # the camera counts anew, or repeats itself
                counted, flags = 1, Flag.TIME_IRREGULAR
            self.lost_in_transfer += counted - 1
            passed = counted + self._missed_by_time(frame, counted)
        if self._last is not None and frame.device_time_s == 0:
            flags |= Flag.TIME_IRREGULAR
        self._continued = False
        self.frames += 1
        self._number += passed
        self._last, self._received_s = frame, frame.received_s
        return Arrival(self._number, self._time(frame), flags)

    def _forget_times(self) -> None:
        self._intervals_s: deque[float] = deque(maxlen=_INTERVALS)
        self._late = 0.0  # periods, of the last frame
        self._thought_lost, self._since_lost = 0, 0

    @staticmethod
    def _time(frame: CameraFrame) -> float | None:
        """0 stands for no time: a camera that has a clock does not read 0 for long."""
        if not math.isfinite(frame.device_time_s):
            return frame.host_time_s
        return frame.device_time_s or None

    def _counted(self, frame: CameraFrame) -> int | None:
        """By how much the camera's number grew; None if it did not, or beyond reason."""
        last = self._last
        if last is None:
            return 1
        passed = frame.number - last.number
        if self._wraps_at is not None:
            passed %= self._wraps_at
            if passed > self._wraps_at // 2:
                return None
        possible = max(self._elapsed_s(frame), 0.0) / self.period_s
        if passed < 1 or passed > 2 * possible + _ODD_GAP:  # never true of NaN
            return None
        return passed

    def _elapsed_s(self, frame: CameraFrame) -> float:
        """Since the frame before, by the camera's clock if both have a time; NaN if unknown."""
        last = self._last
        if last is None:
            return math.nan
        received_s = frame.received_s - last.received_s
        one, other = frame.device_time_s, last.device_time_s
        if not (math.isfinite(one) and math.isfinite(other)):
            return received_s
        if one == 0 or (other == 0 and self.frames > 1):
            return received_s if self._live else math.nan
        elapsed_s = one - other
        if self._live and elapsed_s > received_s + _CLOCK_JUMP_S:
            return math.nan
        return elapsed_s

    def _missed_by_time(self, frame: CameraFrame, counted: int) -> int:
        elapsed_s = self._elapsed_s(frame)
        if not (elapsed_s > 0 and self._regular):  # the clock was set, or stands still
            return 0
        missed = 0
        if len(self._intervals_s) >= _KNOWN_AFTER:
            self._late += elapsed_s / self.period_s - counted
            missed = max(0, math.floor(self._late + 1 - _LATE))
            self._late -= missed
            self._take_back()
            self._late *= 1 - _FORGET
        if missed:
            self._thought_lost, self._since_lost = self._thought_lost + missed, 0
            self.lost_by_time += missed
        self._intervals_s.append(elapsed_s / counted)
        self.period_s = median(self._intervals_s)
        return missed

    def _take_back(self) -> None:
        """Frames that come too early are those that were thought lost."""
        self._since_lost += 1
        if self._since_lost > _REPAID_WITHIN:
            self._thought_lost = 0
        while self._late <= -_LATE and self._thought_lost:
            self._late += 1
            self._thought_lost -= 1
            self.lost_by_time -= 1
        self._late = max(self._late, -_LATE)

    def _missed_while_away(self, frame: CameraFrame) -> int:
        """By the computer's clock: the camera's may have begun anew."""
        away = (frame.received_s - self._received_s) / self.period_s
        missed = max(0, round(away) - 1) if self._regular and math.isfinite(away) else 0
        self.lost_by_time += missed
        return missed
