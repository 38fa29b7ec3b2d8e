"""A station without cameras for tests of the page: known frames, known poses."""

from __future__ import annotations

import threading
import time
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import rasnik
from rasnik.analysis.pose import Pose
from rasnik.cameras.camera import CameraFrame, SettingRefusedError
from rasnik.imaging.projection import Projection
from rasnik.live.recent import Recent
from rasnik.live.station import ChannelConfig, StationConfig
from rasnik.live.status import ChannelStatus
from rasnik.recording.sample import Sample

SIGMAS = (0.001, 0.002, 1e-6, 1e-6)


@cache
def known_image() -> Any:
    return rasnik.simulate("solidras", [(4000.0, 5000.0, 0.002)], seed=1).frames[0]


class FakeChannel:
    """Moves along a sine of 50 nm in x; y, S and theta_z stay, but for their noise."""

    def __init__(self, name: str, folder: Path, rate_hz: float = 100.0) -> None:
        self.config = ChannelConfig(name=name)
        self.system = rasnik.load_system("solidras")
        self.recent = Recent()
        self.rate_hz = rate_hz
        self.actions: list[Any] = []
        self.alarms: tuple[str, ...] = ()
        self.recording = False
        self.recorder = SimpleNamespace(folder=folder / name, current=lambda: None)
        self._folder = folder
        self._image = known_image()
        self._latest: Sample | None = None
        self._zero = (0.0, 0.0, 1.0, 0.0)
        self._exposure_us = 500.0
        self._rng = np.random.default_rng(0)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def frame(self, host_time_s: float | None = None) -> None:
        """One more frame."""
        k = self.recent.count
        now = time.time() if host_time_s is None else host_time_s
        received_s = time.perf_counter() if host_time_s is None else host_time_s
        noise = self._rng.normal(size=4) * SIGMAS
        x, y, scale, theta = np.array([4000, 5000, 1, 0.002]) + noise
        x += 0.05 * np.sin(2 * np.pi * k / self.rate_hz)
        pose = Pose(
            ok=True, x_um=x, y_um=y, scale=scale, theta_rad=theta, orientation=4, chi2_ndf=1.0,
            covariance=np.diag(np.square(SIGMAS)), dark_level=20.0, light_level=200.0,
            projection=Projection.from_pose(x, y, scale, theta, 4), method="likelihood",
        )  # fmt: skip
        frame = CameraFrame(self._image, k + 1, now, received_s, now, self._exposure_us)
        self._latest = Sample(frame, k, pose)
        self.recent.add(self._latest, now, 0.001)

    def _run(self) -> None:
        while not self._stop.wait(1 / self.rate_hz):
            self.frame()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def latest(self) -> Sample | None:
        return self._latest

    def status(self) -> ChannelStatus:
        known: dict[str, Any] = {}
        if self._latest is not None:
            pose = self._latest.pose
            names = ("x_um", "y_um", "scale", "theta_rad", "chi2_ndf", "light_level", "dark_level")
            sigmas = ("sigma_x_um", "sigma_y_um", "sigma_scale", "sigma_theta_rad")
            known = {name: getattr(pose, name) for name in (*names, *sigmas)}
        return ChannelStatus(
            self.config.name, "running", camera="none", locked=self._latest is not None,
            frames=self.recent.count, tracked=self.recent.count, frame_rate_hz=self.rate_hz,
            exposure_us=self._exposure_us, zero_um=self._zero[:2], zero_scale=self._zero[2],
            zero_theta_rad=self._zero[3], alarms=self.alarms, recording=self.recording, **known,
        )  # fmt: skip

    def set_exposure(self, us: float) -> None:
        if us > 10_000:
            raise SettingRefusedError("The exposure must lie from 1 to 10000 us.")
        self._exposure_us = us

    def keep_exposure(self, on: bool) -> None:
        self.actions.append(("keep_exposure", on))

    def zero(self) -> None:
        status = self.status()
        self._zero = (status.x_um, status.y_um, status.scale, status.theta_rad)

    def clear_zero(self) -> None:
        self._zero = (0.0, 0.0, 1.0, 0.0)

    def start_recording(self) -> None:
        self.recording = True

    def stop_recording(self) -> None:
        self.recording = False

    def keep_frames(self) -> None:
        self.actions.append(("keep_frames", True))

    def snapshot(self) -> Path:
        path = self._folder / "snapshot.png"
        path.write_bytes(b"a picture")
        return path

    def history(self, start_s: float, end_s: float, points: int) -> dict[str, Any]:
        """Bins of one value each: x falls by 1 um over the time, with a hole in its middle."""
        time_s = start_s + (np.arange(points) + 0.5) * (end_s - start_s) / points
        found: dict[str, Any] = {"time_s": time_s, "count": np.ones(points, int)}
        for name, value in {"x_um": 4000.0, "y_um": 5000.0, "scale": 1.0, "theta_rad": 0.0}.items():
            mean = np.full(points, value) - (np.linspace(0, 1, points) if name == "x_um" else 0)
            mean[points // 2 - points // 20 : points // 2 + points // 20] = np.nan
            for kind, by in (("min", -1e-3), ("mean", 0.0), ("max", 1e-3)):
                found[f"{name}_{kind}"] = mean + by
        return found


def fake_station(folder: Path, names: tuple[str, ...] = ("top", "side")) -> Any:
    config = StationConfig(
        name="bench", folder=folder, channel=[ChannelConfig(name=name) for name in names]
    )
    channels = {name: FakeChannel(name, folder) for name in names}
    return SimpleNamespace(config=config, channels=channels)
