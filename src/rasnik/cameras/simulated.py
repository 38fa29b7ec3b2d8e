"""A camera that is not there: a known mask in known motion, with the sensor's noise."""

from __future__ import annotations

import math
import threading
import time
from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np

from rasnik.cameras.camera import (
    Camera,
    CameraFrame,
    CameraLostError,
    CameraMissingError,
    CameraSettings,
    SettingRefusedError,
)
from rasnik.cameras.moving_image import MovingImage
from rasnik.instrument import System

__all__ = ["SimulatedCamera"]

_USUAL_RATE_HZ = 275.0
_RATES_HZ = (0.01, 10_000.0)
_SHORTEST_US = 1.0
_GAINS_DB = (0.0, 24.0)
_PREPARED_S = 1.0
_REMEMBERED = 10_000  # changes of the settings
#: Frames that wait for a reader; older ones are lost.
_BUFFERS = 50
_GOLDEN = (math.sqrt(5) - 1) / 2
_POWERED_S = 10.0  # a camera's clock does not begin when it is opened


@dataclass(frozen=True)
class _Stretch:
    """Frames from `first` on, taken with the same settings."""

    first: int
    device_s: float
    turns: float
    rate_hz: float
    exposure_us: float
    gain_db: float
    light: float

    def device_time_s(self, index: int) -> float:
        return self.device_s + (index - self.first) / self.rate_hz


class SimulatedCamera(Camera):
    """Frames of a system's mask at a steady rate, with the poses they were made with.

    Frames exist when they are due, whether they are read or not: what waits longer than a few
    dozen frames is lost, and the numbers go on. Each is made when it is read, from its index and
    the seed alone.

    Parameters
    ----------
    system : System
        Gives mask, optics, sensor, noise and, at its nominal exposure, the grey levels.
    frame_rate_hz : float, optional
        By default the system's, or 275 Hz.
    motion_um, motion_hz : float
        Amplitude on the mask, and how often the mask goes round in a second.
    seed : int
        Of noise and losses.
    exposure_us : float, optional
        By default the nominal one: the system's, or half a frame at its rate.
    gain_db : float
    light : float
        Brightness of the lamp; 1 gives the system's grey levels at the nominal exposure.
    loss : float
        Probability that a frame gets lost on its way.
    first_number : int
        Of the first frame after opening.
    number_wraps_at : int, optional
        The largest frame number; the next is 1.
    settings : CameraSettings, optional
        What else is asked for; refused at opening if it cannot be had.
    """

    def __init__(
        self,
        system: System,
        *,
        frame_rate_hz: float | None = None,
        motion_um: float = 2.0,
        motion_hz: float = 0.3,
        seed: int = 0,
        exposure_us: float | None = None,
        gain_db: float = 0.0,
        light: float = 1.0,
        loss: float = 0.0,
        first_number: int = 1,
        number_wraps_at: int | None = None,
        settings: CameraSettings | None = None,
    ) -> None:
        if not 0 <= loss < 1:
            raise ValueError(f"loss is a probability below 1, not {loss:g}")
        if not (math.isfinite(motion_hz) and motion_hz > 0):
            raise ValueError(f"motion_hz must be positive, not {motion_hz:g}")
        self.name = f"simulated {system.name}, seed {seed}"
        self.number_wraps_at = number_wraps_at
        self._system = system
        self._motion_um, self._motion_hz = motion_um, motion_hz
        self._seed, self._loss, self._first_number = seed, loss, first_number
        rate_hz = system.sensor.frame_rate_hz or _USUAL_RATE_HZ
        self._nominal_us = (system.sensor.exposure_s or 0.5 / rate_hz) * 1e6
        self._asked = settings or CameraSettings()
        rate_hz = self._asked.frame_rate_hz or frame_rate_hz or rate_hz
        exposure_us = exposure_us or min(self._nominal_us, 1e6 / rate_hz)
        _check_light(light)
        # Cameras of one station are not to move as one.
        turns = _GOLDEN * seed % 1.0
        self._begun = _Stretch(0, _POWERED_S, turns, rate_hz, exposure_us, gain_db, light)
        self._stretches = [self._begun]
        self._image: MovingImage | None = None
        self._changed = threading.Condition()
        self._open = self._lost = False
        self._away_until_s = 0.0
        self._powered_s = math.nan
        self._started_s = math.nan
        self._next = 0
        self._handed = -1
        self._failures = self._underruns = 0

    # --------------------------------------------------------------------- what every camera has

    def open(self) -> None:
        if self._image is None:
            try:
                self._image = MovingImage(self._system, self._motion_um, self._seed)
            except ValueError as error:
                raise SettingRefusedError(f"the camera cannot be simulated: {error}.") from None
            self._image.prepare(self._phase(_POWERED_S), _PREPARED_S)
        with self._changed:
            if self._open and not self._lost:
                return
            now_s = time.perf_counter()
            if now_s < self._away_until_s:
                raise CameraMissingError(f"{self.name} is not there; connect it again.")
            last, begun = self._stretches[-1], self._begun
            if math.isnan(self._powered_s):
                self._powered_s, device_s = now_s, _POWERED_S
            else:
                device_s = _POWERED_S + now_s - self._powered_s
            turns = begun.turns + (device_s - begun.device_s) * self._motion_hz
            asked = self._accepted(last, self._asked)
            self._begun = replace(asked, first=0, device_s=device_s, turns=turns)
            self._stretches = [self._begun]
            self._started_s, self._next, self._handed = now_s, 0, -1
            self._open, self._lost = True, False

    def close(self) -> None:
        with self._changed:
            self._open = self._lost = False
            self._changed.notify_all()

    def read(self, timeout_s: float) -> CameraFrame | None:
        end_s = time.perf_counter() + timeout_s
        with self._changed:
            index = self._wait(end_s)
            if index is None:
                return None
            stretch = self._stretch(index)
            phase = self._phase(stretch.device_time_s(index))
            image, number = self._image, self._number(index)
            self._handed = index
        assert image is not None
        gain = 10 ** (stretch.gain_db / 20)
        brightness = stretch.light * gain * stretch.exposure_us / self._nominal_us
        pixels = image.frame(phase, brightness, gain, index)
        return CameraFrame(
            image=pixels,
            number=number,
            host_time_s=time.time(),
            received_s=time.perf_counter(),
            device_time_s=stretch.device_time_s(index),
            exposure_us=stretch.exposure_us,
            gain_db=stretch.gain_db,
        )

    @property
    def settings(self) -> CameraSettings:
        with self._changed:
            last = self._stretches[-1]
        height, width = self._system.shape
        return CameraSettings(
            frame_rate_hz=last.rate_hz,
            exposure_us=last.exposure_us,
            gain_db=last.gain_db,
            pixel_format=self._pixel_format,
            region=(0, 0, width, height),
            trigger="free",
        )

    def change(self, settings: CameraSettings) -> CameraSettings:
        with self._changed:
            self._begin(self._accepted(self._stretches[-1], settings))
            self._asked = replace(self._asked, **settings.changed())  # also after reconnection
        return self.settings

    def counters(self) -> dict[str, int]:
        """ "failures": lost on their way; "underruns": not read in time."""
        return {"failures": self._failures, "underruns": self._underruns}

    # ---------------------------------------------------------------------- what only this one has

    @property
    def light(self) -> float:
        """Brightness of the lamp; may be set while frames are taken."""
        with self._changed:
            return self._stretches[-1].light

    @light.setter
    def light(self, light: float) -> None:
        _check_light(light)
        with self._changed:
            self._begin(replace(self._stretches[-1], light=light))

    def fail(self, away_s: float = 0.0) -> None:
        """Lose the connection; the camera can be opened again after so many seconds."""
        with self._changed:
            self._lost = True
            self._away_until_s = time.perf_counter() + away_s
            self._changed.notify_all()

    def truth(self, number: int) -> tuple[float, float, float, float]:
        """(x_um, y_um, scale, theta_rad) that a frame was made with.

        Parameters
        ----------
        number : int
            Of a frame since the last opening; where numbers wrap, the latest that bore it.

        Raises
        ------
        ValueError
            If no such frame has been read yet, or settings have changed too often since.
        """
        with self._changed:
            index = number - self._first_number
            wraps_at = self.number_wraps_at
            if wraps_at is not None and 1 <= number <= wraps_at:
                index += (self._handed - index) // wraps_at * wraps_at
            first = self._stretches[0].first
            if not first <= index <= self._handed or number > (wraps_at or number):
                raise ValueError(f"frame {number} has not been read, or too long ago")
            device_s = self._stretch(index).device_time_s(index)
        return self.truth_at(device_s)

    def truth_at(self, device_time_s: float) -> tuple[float, float, float, float]:
        """The same at a time of the camera's clock, of any frame since the last opening."""
        if self._image is None:
            raise ValueError("the camera has not been opened yet")
        with self._changed:
            phase = self._phase(device_time_s)
        pose = self._image.truth(phase)
        return pose.x_um, pose.y_um, pose.scale, pose.theta_rad

    # --------------------------------------------------------------------------- under the lock

    def _wait(self, end_s: float) -> int | None:
        """Index of the next frame that is not lost, once it is due; None at the time given."""
        while True:
            if self._lost:
                raise CameraLostError(f"{self.name} does not answer any more.")
            if not self._open:
                raise CameraLostError(f"{self.name} is not open.")
            now_s = time.perf_counter()
            overdue = self._due(now_s) - _BUFFERS - self._next
            if overdue > 0:
                self._underruns += overdue
                self._next += overdue
            due_s = self._due_s(self._next)
            if due_s <= now_s:
                index = self._next
                self._next += 1
                if not self._gets_lost(index):
                    return index
                self._failures += 1
            elif now_s >= end_s:
                return None
            else:
                self._changed.wait(min(due_s, end_s) - now_s)

    def _due_s(self, index: int) -> float:
        """When a frame comes, by `time.perf_counter`."""
        since_s = self._stretch(index).device_time_s(index) - self._begun.device_s
        return self._started_s + since_s

    def _due(self, now_s: float) -> int:
        """Number of frames that have come until now, those lost included."""
        last = self._stretches[-1]
        elapsed_s = now_s - self._started_s + self._begun.device_s - last.device_s
        return max(last.first, last.first + math.floor(elapsed_s * last.rate_hz) + 1)

    def _stretch(self, index: int) -> _Stretch:
        at = bisect_right(self._stretches, index, key=lambda stretch: stretch.first)
        return self._stretches[at - 1]

    def _phase(self, device_time_s: float) -> float:
        begun = self._begun
        turns = begun.turns + (device_time_s - begun.device_s) * self._motion_hz
        return 2 * math.pi * (turns % 1.0)

    def _number(self, index: int) -> int:
        number = self._first_number + index
        wraps_at = self.number_wraps_at
        return number if wraps_at is None else (number - 1) % wraps_at + 1

    def _gets_lost(self, index: int) -> bool:
        if not self._loss:
            return False
        return bool(np.random.default_rng((self._seed, index, 1)).random() < self._loss)

    def _begin(self, changed: _Stretch) -> None:
        """Take the frames that are not due yet with other settings."""
        if not self._open:
            self._stretches[-1] = changed
            return
        last = self._stretches[-1]
        first = max(self._due(time.perf_counter()), self._next)
        begun = replace(changed, first=first, device_s=last.device_time_s(first))
        if first == last.first:
            self._stretches[-1] = begun
        else:
            self._stretches.append(begun)
            del self._stretches[:-_REMEMBERED]

    # --------------------------------------------------------------------------------- limits

    @property
    def _pixel_format(self) -> str:
        return f"Mono{max(8, self._system.sensor.bit_depth)}"

    def _accepted(self, last: _Stretch, asked: CameraSettings) -> _Stretch:
        """The settings with what is asked for, which must be possible."""
        rate_hz = last.rate_hz if asked.frame_rate_hz is None else asked.frame_rate_hz
        exposure_us = last.exposure_us if asked.exposure_us is None else asked.exposure_us
        gain_db = last.gain_db if asked.gain_db is None else asked.gain_db
        _check("frame rate", rate_hz, *_RATES_HZ, "Hz")
        _check("exposure", exposure_us, _SHORTEST_US, 1e6 / rate_hz, "us")
        _check("gain", gain_db, *_GAINS_DB, "dB")
        height, width = self._system.shape
        possible = {
            "pixel_format": self._pixel_format,
            "region": (0, 0, width, height),
            "trigger": "free",
            "packet_bytes": None,
        }
        for name, value in possible.items():
            wanted = asked.changed().get(name, value)
            if wanted != value:
                only = "has none" if value is None else f"has only {value}"
                raise SettingRefusedError(
                    f"{name} cannot be {wanted}: this simulated camera {only}."
                )
        return replace(last, rate_hz=rate_hz, exposure_us=exposure_us, gain_db=gain_db)


def _check_light(light: float) -> None:
    if not (math.isfinite(light) and light >= 0):
        raise ValueError(f"light must be 0 or more, not {light:g}")


def _check(name: str, value: float, least: float, most: float, unit: str) -> None:
    # Limits that were worked out are rounded.
    if not least * (1 - 1e-9) <= value <= most * (1 + 1e-9):
        raise SettingRefusedError(
            f"the {name} cannot be {value:g} {unit}; it can be {least:g} to {most:g} {unit}."
        )
