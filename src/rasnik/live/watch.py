"""What is told of a channel beside its poses: rates, latency, saturation, alarms."""

from __future__ import annotations

import time
from collections import deque
from contextlib import suppress

import numpy as np

from rasnik.cameras.camera import CameraFrame, CameraSettings
from rasnik.live.acquisition import Acquisition
from rasnik.live.alarms import AlarmWatch, Condition
from rasnik.live.recent import Recent
from rasnik.live.ring import FrameRing
from rasnik.live.station import Alarms

__all__ = ["Watch"]

_RATE_S = 3.0  # over which frames are counted
_LOSSES_S = _LATENCY_S = 10.0
_SELDOM_S = 1.0  # between questions to the camera, and percentiles
_BITS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16}
_NAN = float("nan")


class Watch:
    """Looks at a channel a few times a second, so that the tracker need not.

    Parameters
    ----------
    alarms : Alarms
    full_scale : int
        Highest grey level, where the camera does not tell.
    acquisition : Acquisition
    ring : FrameRing
    recent : Recent

    Attributes
    ----------
    frame_rate_hz, latency_median_ms, latency_p99_ms, saturated_fraction : float
    alarms : tuple of str
    settings : CameraSettings
        As the camera told last.
    driver_counters : dict of str to int
    """

    def __init__(
        self,
        alarms: Alarms,
        full_scale: int,
        acquisition: Acquisition,
        ring: FrameRing,
        recent: Recent,
    ) -> None:
        self._acquisition, self._ring, self._recent = acquisition, ring, recent
        self._full_scale = full_scale
        self._alarm_watch = AlarmWatch(alarms)
        self._seen: deque[tuple[float, int]] = deque()  # last frame's time, frames
        self._lost: deque[tuple[float, int, int]] = deque()  # time, frames, lost
        self._next_row = 0
        self._began_s = time.perf_counter()
        self._locked_s = _NAN
        self._asked_s = -_SELDOM_S
        self.frame_rate_hz = self.latency_median_ms = self.latency_p99_ms = _NAN
        self.saturated_fraction = _NAN
        self.alarms: tuple[str, ...] = ()
        self.settings = CameraSettings()
        self.driver_counters: dict[str, int] = {}

    def tick(self, frame: CameraFrame | None, zero_um: tuple[float, float]) -> tuple[str, ...]:
        """Look at what has come since the last tick; the sentences of alarms that are new.

        Parameters
        ----------
        frame : CameraFrame or None
            The newest.
        zero_um : tuple of float
            Taken off the positions before they are judged.
        """
        now_s = time.perf_counter()
        rows, self._next_row = self._recent.since(self._next_row)
        if len(rows) and np.isfinite(rows["x_um"][-1]):
            self._locked_s = now_s
        self.frame_rate_hz = self._rate(now_s)
        if frame is not None:
            self.saturated_fraction = float(np.mean(frame.image >= self.full_scale))
        if now_s - self._asked_s >= _SELDOM_S:
            self._asked_s = now_s
            self._ask()
        state = self._acquisition.state
        condition = Condition(
            now_s=now_s,
            frame_rate_hz=self.frame_rate_hz,
            lost_percent=self._lost_percent(now_s),
            unlocked_s=self._unlocked(now_s, state),
        )
        if state == "ended":  # a recording that is over does not raise alarms by its silence
            condition = Condition(now_s=now_s)
        new = self._alarm_watch.look(rows, zero_um, condition)
        self.alarms = self._alarm_watch.sentences
        return new

    @property
    def full_scale(self) -> int:
        """Highest grey level: of the camera's pixel format, or the system's."""
        bits = _BITS.get(self.settings.pixel_format or "")
        return self._full_scale if bits is None else 2**bits - 1

    def light_settings(self, frame: CameraFrame | None) -> tuple[float, float]:
        """Exposure and gain of a frame; as the camera told last, if the frame does not."""
        told = [self.settings.exposure_us, self.settings.gain_db]
        exposure_us, gain_db = (_NAN if value is None else value for value in told)
        if frame is not None and np.isfinite(frame.exposure_us):
            exposure_us = frame.exposure_us
        if frame is not None and np.isfinite(frame.gain_db):
            gain_db = frame.gain_db
        return exposure_us, gain_db

    def _rate(self, now_s: float) -> float:
        """Frames in a second, from the times of the frames; 0 when they cease."""
        last_s, frames = self._acquisition.last_frame_s, self._acquisition.losses.frames
        if frames and (not self._seen or frames != self._seen[-1][1]):
            self._seen.append((last_s, frames))
        while len(self._seen) > 2 and self._seen[1][0] < now_s - _RATE_S:
            self._seen.popleft()
        if len(self._seen) < 2:
            return _NAN
        (first_s, first), (last_s, last) = self._seen[0], self._seen[-1]
        rate_hz = (last - first) / max(last_s - first_s, 1e-9)
        return rate_hz if now_s - last_s < _RATE_S + 3 / rate_hz else 0.0

    def _lost_percent(self, now_s: float) -> float:
        losses = self._acquisition.losses
        lost = losses.lost_in_transfer + losses.lost_by_time + self._ring.dropped
        self._lost.append((now_s, losses.frames, lost))
        while self._lost[0][0] < now_s - _LOSSES_S:
            self._lost.popleft()
        _, frames_before, lost_before = self._lost[0]
        missing = lost - lost_before
        # Frames that were dropped had come before; the others never came.
        expected = losses.frames - frames_before + missing
        return 100 * missing / expected if expected > 0 else _NAN

    def _unlocked(self, now_s: float, state: str) -> float:
        if state == "starting":
            self._began_s = now_s
        since_s = self._locked_s if np.isfinite(self._locked_s) else self._began_s
        return now_s - since_s

    def _ask(self) -> None:
        latency_s = self._recent.last(_LATENCY_S)["latency_s"]
        if len(latency_s):
            median, p99 = 1e3 * np.quantile(latency_s, [0.5, 0.99])
            self.latency_median_ms, self.latency_p99_ms = float(median), float(p99)
        with suppress(Exception):  # the camera may be gone; the acquisition tells of that
            self.settings = self._acquisition.camera.settings
            self.driver_counters = self._acquisition.camera.counters()
