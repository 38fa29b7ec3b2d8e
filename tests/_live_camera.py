"""A camera that does what a test tells it, and what tests of channels share."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

import rasnik
from rasnik.cameras.camera import Camera, CameraFrame, CameraSettings
from rasnik.live.channel import Channel
from rasnik.live.station import ChannelConfig

SIZE = {"sensor.width_px": 240, "sensor.height_px": 200}
SYSTEM = rasnik.load_system("solidras", SIZE)
PERIOD_S = 0.01
X_UM, Y_UM = 10000.0, 7000.0
IMAGES = rasnik.simulate(SYSTEM, [(X_UM, Y_UM, 0.002)], n=4, seed=1).frames


def camera_frame(
    k: int, number: int | None = None, image: np.ndarray | None = None, **times: float
) -> CameraFrame:
    """Frame k of a regular stream; numbers from 1."""
    usual = {
        "host_time_s": 1000 + k * PERIOD_S,
        "device_time_s": 10 + k * PERIOD_S,
        "received_s": time.perf_counter(),
    }
    return CameraFrame(
        image=IMAGES[k % len(IMAGES)] if image is None else image,
        number=k + 1 if number is None else number,
        **(usual | times),
    )


class ScriptedCamera(Camera):
    """Hands out frames and raises errors, one after the other; then it is silent."""

    name = "scripted"

    def __init__(
        self,
        script: Iterable[CameraFrame | Exception] = (),
        *,
        live: bool = True,
        wraps_at: int | None = None,
        refusals: Iterable[Exception] = (),
    ) -> None:
        self.live = live
        self.number_wraps_at = wraps_at  # type: ignore[misc]
        self._script = deque(script)
        self._refusals = deque(refusals)
        self._more = threading.Condition()
        self._settings = CameraSettings(exposure_us=500.0, trigger="free")
        self.opened = self.closed = 0

    def show(self, *more: CameraFrame | Exception) -> None:
        with self._more:
            self._script.extend(more)
            self._more.notify_all()

    def open(self) -> None:
        self.opened += 1
        if self._refusals:
            raise self._refusals.popleft()

    def close(self) -> None:
        self.closed += 1

    def read(self, timeout_s: float) -> CameraFrame | None:
        with self._more:
            if not self._more.wait_for(lambda: self._script, timeout_s):
                return None
            item = self._script.popleft()
        if isinstance(item, Exception):
            raise item
        return item

    @property
    def settings(self) -> CameraSettings:
        return self._settings

    def change(self, settings: CameraSettings) -> CameraSettings:
        self._settings = CameraSettings(**{**self._settings.changed(), **settings.changed()})
        return self._settings


def write_system(folder: Path) -> str:
    path = folder / "small.toml"
    path.write_text(SYSTEM.to_toml(), encoding="utf-8")
    return str(path)


def make_channel(folder: Path, camera: Camera, **options: object) -> Channel:
    """A channel of the small system; `buffer_bytes` apart, options are those of its table."""
    buffer = {k: options.pop(k) for k in ("buffer_bytes",) if k in options}
    config = ChannelConfig.model_validate(
        {"name": "one", "system": write_system(folder), **options}
    )
    return Channel(config, folder, camera, **buffer)  # type: ignore[arg-type]


def wait_for(condition: Callable[[], object], seconds: float = 10.0) -> None:
    end_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end_s, "this should have happened by now"
        time.sleep(0.005)
