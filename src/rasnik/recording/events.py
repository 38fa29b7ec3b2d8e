"""Which frames are kept: those around events, and some on schedule."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from rasnik.recording.options import RawFrames
from rasnik.recording.sample import Sample

__all__ = ["AUTOMATIC", "Event", "FrameKeeper", "Glitches"]

#: Frames before an event are held in no more memory than this.
_MOST_BYTES = 256 << 20
#: Reasons that come by themselves, and so are limited in number.
AUTOMATIC = ("lock_lost", "glitch", "alarm")
_SCHEDULE = "schedule"


@dataclass(eq=False)
class Event:
    """Something whose frames are kept.

    Attributes
    ----------
    reason : str
    time_s : float
        When it was, in seconds since 1970 UTC.
    later : list of str
        What else came before its last frame.
    """

    reason: str
    time_s: float
    later: list[str] = field(default_factory=list)


class Glitches:
    """Finds jumps between neighbouring frames.

    The sigma of the difference is that of the noise of both, or what differences have been of
    late if that is more: a mask in motion is no glitch.

    Parameters
    ----------
    sigmas : float
        How large a jump is a glitch.
    """

    _MEMORY = 1 / 64  # weight of the newest difference

    def __init__(self, sigmas: float) -> None:
        self._sigmas = sigmas
        self._last: tuple[int, tuple[tuple[float, float], ...]] | None = None
        self._usual = [0.0, 0.0, 0.0, 0.0]

    def add(self, sample: Sample) -> str:
        """What jumped with this frame; empty if nothing did."""
        pose, last = sample.pose, self._last
        if not pose.ok:
            self._last = None
            return ""
        here = (
            (pose.x_um, pose.sigma_x_um),
            (pose.y_um, pose.sigma_y_um),
            (pose.scale, pose.sigma_scale),
            (pose.theta_rad, pose.sigma_theta_rad),
        )
        self._last = sample.number, here
        if last is None or last[0] != sample.number - 1:
            return ""
        jumped = []
        names = ("x", "y", "scale", "theta")
        for k, ((value, sigma), (before, sigma_before)) in enumerate(
            zip(here, last[1], strict=True)
        ):
            square, noise = (value - before) ** 2, sigma**2 + sigma_before**2
            variance = max(noise, self._usual[k])
            if not math.isfinite(square + variance):
                continue
            if square > self._sigmas**2 * variance:
                jumped.append(names[k])
                square = self._sigmas**2 * variance
            self._usual[k] += (square - self._usual[k]) * self._MEMORY
        return ", ".join(jumped)


class FrameKeeper:
    """Holds the last frames, and hands those around events to a writer.

    Parameters
    ----------
    options : RawFrames
    write : callable
        ``write(event, sample)`` takes a frame of an event; quick, and never raises.
    end : callable
        ``end(event)`` is told after its last frame.
    most_bytes : int
        Of the frames before an event.
    """

    def __init__(
        self,
        options: RawFrames,
        write: Callable[[Event, Sample], None],
        end: Callable[[Event], None],
        most_bytes: int = _MOST_BYTES,
    ) -> None:
        self._options, self._write, self._end = options, write, end
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._ring: deque[Sample] = deque()
        self._bytes = 0
        self._event: Event | None = None
        self._until_s = 0.0
        self._was_ok = False
        self._glitches = Glitches(options.glitch_sigmas)
        self._begun_s: deque[float] = deque()  # of automatic events in the last hour
        self._scheduled_s = -math.inf
        self.refused = 0

    def add(self, sample: Sample, automatic: bool) -> None:
        """Take a frame; with `automatic`, look for events and the schedule in it."""
        options, now_s = self._options, sample.frame.received_s
        with self._lock:
            self._end_if_due(now_s)
            reason = self._reason(sample)
            if reason and automatic:
                self._begin(reason, now_s)
            if self._event is not None:
                self._write(self._event, sample)
            else:
                self._hold(sample, now_s)
            due_s = self._scheduled_s + (options.every_s or math.inf)
            if automatic and options.every_s is not None and now_s >= due_s:
                self._scheduled_s = now_s
                event = Event(_SCHEDULE, sample.frame.host_time_s)
                self._write(event, sample)
                self._end(event)

    def event(self, reason: str) -> None:
        """Keep the frames before and after this moment; from any thread."""
        kind = reason.partition(":")[0].strip()
        with self._lock:
            if kind not in AUTOMATIC or kind in self._options.on:
                self._begin(reason, time.perf_counter())

    def tick(self) -> None:
        """End an event whose time is over, also if no frames come."""
        grace_s = 0.5  # for frames that are on their way
        with self._lock:
            self._end_if_due(time.perf_counter() - grace_s)

    def finish(self) -> None:
        """End the event there may be, as no further frames come."""
        with self._lock:
            self._end_if_due(math.inf)
            self._ring.clear()
            self._bytes = 0

    def _reason(self, sample: Sample) -> str:
        """What a frame tells of itself."""
        on, was_ok = self._options.on, self._was_ok
        self._was_ok = sample.pose.ok
        jumped = self._glitches.add(sample) if "glitch" in on else ""
        if "lock_lost" in on and was_ok and not sample.pose.ok:
            return "lock_lost"
        return f"glitch: {jumped}" if jumped else ""

    def _begin(self, reason: str, now_s: float) -> None:
        """Hand over what is held; the lock is held."""
        if self._event is not None:
            self._event.later.append(reason)
            return
        if reason.partition(":")[0].strip() in AUTOMATIC:
            while self._begun_s and self._begun_s[0] < now_s - 3600:
                self._begun_s.popleft()
            if len(self._begun_s) >= self._options.most_per_hour:
                self.refused += 1
                return
            self._begun_s.append(now_s)
        self._event = Event(reason, time.time())
        self._until_s = now_s + self._options.after_s
        while self._ring:
            sample = self._ring.popleft()
            if sample.frame.received_s >= now_s - self._options.before_s:
                self._write(self._event, sample)
        self._bytes = 0

    def _end_if_due(self, now_s: float) -> None:
        if self._event is not None and now_s > self._until_s:
            self._end(self._event)
            self._event = None

    def _hold(self, sample: Sample, now_s: float) -> None:
        """Keep a frame for an event to come, and let go of those too old for it."""
        self._ring.append(sample)
        self._bytes += sample.frame.image.nbytes
        least_s = now_s - self._options.before_s
        while self._ring and (
            self._bytes > self._most_bytes or self._ring[0].frame.received_s < least_s
        ):
            self._bytes -= self._ring.popleft().frame.image.nbytes
