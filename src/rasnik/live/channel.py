"""One camera's way from frames to poses, and to all who want them."""

from __future__ import annotations

import gc
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.flags import Flag
from rasnik.analysis.pose import Pose
from rasnik.cameras.camera import Camera, CameraFrame
from rasnik.instrument import load_system
from rasnik.live.acquisition import Acquisition, told
from rasnik.live.light import LightKeeper
from rasnik.live.recent import Recent
from rasnik.live.ring import FrameRing, Waiting
from rasnik.live.snapshot import save_snapshot
from rasnik.live.station import ChannelConfig
from rasnik.live.status import ChannelState, ChannelStatus
from rasnik.live.watch import Watch
from rasnik.recording.recorder import Recorder
from rasnik.recording.sample import Sample, Sink
from rasnik.tracking import warm_up
from rasnik.tracking.tracker import Tracker

__all__ = ["Channel"]

_BUFFER_BYTES = 64 << 20  # 0.6 s of 720 x 540 pixels of 8 bits at 275 Hz
_POLL_S = _WATCH_S = 0.2
_ZERO_S = 1.0  # over which positions are averaged for a zero
_NAN = float("nan")


class Channel:
    """A camera, its tracker, its record, and others that take its poses.

    Three threads work for it: one takes frames off the camera and never waits, one tracks and
    hands poses to the sinks, one looks after rates, exposure and alarms. All methods can be
    called from any thread.

    Parameters
    ----------
    config : ChannelConfig
    folder : Path
        Of the station; the record goes to the folder of the channel in it.
    camera : Camera, optional
        Instead of the one that the configuration names.
    index : int
        Which channel of the station it is; simulated cameras differ by it.
    buffer_bytes : int
        Of images that wait for the tracker; the oldest are dropped when there are more.

    Attributes
    ----------
    config : ChannelConfig
    system : System
    recorder : Recorder
    recent : Recent
        The last minutes.

    Raises
    ------
    SystemConfigError
        If there is no such system.
    CameraMissingError
        If what the camera needs is not installed.
    """

    def __init__(
        self,
        config: ChannelConfig,
        folder: Path,
        camera: Camera | None = None,
        *,
        index: int = 0,
        buffer_bytes: int = _BUFFER_BYTES,
    ) -> None:
        self.config = config
        self.system = load_system(config.system)
        if camera is None:
            from rasnik.cameras.opening import open_camera

            camera = open_camera(config.camera, self.system, index)
        self._camera = camera
        self._tracker = self._new_tracker()
        self.folder = Path(folder)
        self.recorder = Recorder(
            self.folder, config.name, self.system, config.recording, self._metadata()
        )
        self.recent = Recent()
        self._ring = FrameRing(buffer_bytes)
        self._acquisition = Acquisition(camera, self._ring, self._prepare, config.name)
        self._watch = Watch(
            config.alarms, self.system.full_scale, self._acquisition, self._ring, self.recent
        )
        self._sinks: list[Sink] = [self.recorder]
        self._sink_errors: dict[int, str] = {}
        self._latest: Sample | None = None
        self._tracked = 0
        self._zero = (0.0, 0.0), 1.0, 0.0
        self._light = LightKeeper(self._acquisition, config.camera.keep_exposure)
        self._notes: dict[str, str] = {}  # what is wrong, by what it concerns
        self._stopping = threading.Event()
        self._stopped = self._started = False
        self._lock = threading.Lock()
        self._saving = threading.Lock()  # two snapshots at a time would take the same name
        self._threads = [
            threading.Thread(target=self._track, name=f"{config.name} tracking", daemon=True),
            threading.Thread(target=self._look_after, name=f"{config.name} watch", daemon=True),
        ]

    # ------------------------------------------------------------------ what callers use

    def start(self) -> None:
        """Begin; recording too, if the configuration says so. A channel starts only once."""
        with self._lock:
            if self._started or self._stopped:
                return
            self._started = True
        if self.config.recording.enabled:
            self.recorder.start()
        for thread in self._threads:
            thread.start()
        self._acquisition.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End: frames that wait are tracked and recorded before. Harmless if it has ended."""
        end_s = time.monotonic() + timeout_s
        with self._lock:
            if self._stopped:
                return
            self._stopped = True
        self._acquisition.stop()
        if self._started:
            self._acquisition.join(max(0.0, end_s - time.monotonic()))
            self._ring.close()
            self._threads[0].join(max(0.1, end_s - time.monotonic()))
            self._ring.abandon()  # what is not tracked by now is counted as dropped
            self._threads[0].join(1.0)
            self._stopping.set()
            self._threads[1].join(max(0.1, end_s - time.monotonic()))
        self.recorder.close()

    def status(self) -> ChannelStatus:
        """The channel at this moment."""
        acquisition, watch, recorder = self._acquisition, self._watch, self.recorder.status()
        losses, sample = acquisition.losses, self._latest
        pose = Pose() if sample is None else sample.pose
        zero_um, zero_scale, zero_theta_rad = self._zero
        exposure_us, gain_db = watch.light_settings(None if sample is None else sample.frame)
        return ChannelStatus(
            name=self.config.name,
            state=self._state(),
            message=self._message(),
            camera=self._camera.name,
            metrology=self._camera.metrology,
            locked=pose.ok and self._state() == "running",
            time_s=_NAN if sample is None else sample.frame.host_time_s,
            x_um=pose.x_um,
            y_um=pose.y_um,
            scale=pose.scale,
            theta_rad=pose.theta_rad,
            sigma_x_um=pose.sigma_x_um,
            sigma_y_um=pose.sigma_y_um,
            sigma_scale=pose.sigma_scale,
            sigma_theta_rad=pose.sigma_theta_rad,
            chi2_ndf=pose.chi2_ndf,
            flags=tuple(pose.flags.names),
            frames=losses.frames,
            tracked=self._tracked,
            lost_in_transfer=losses.lost_in_transfer,
            lost_by_time=losses.lost_by_time,
            dropped=self._ring.dropped,
            reconnects=acquisition.reconnects,
            frame_rate_hz=watch.frame_rate_hz,
            latency_median_ms=watch.latency_median_ms,
            latency_p99_ms=watch.latency_p99_ms,
            exposure_us=exposure_us,
            gain_db=gain_db,
            saturated_fraction=watch.saturated_fraction,
            light_level=pose.light_level,
            dark_level=pose.dark_level,
            zero_um=zero_um,
            zero_scale=zero_scale,
            zero_theta_rad=zero_theta_rad,
            alarms=watch.alarms,
            recording=recorder.recording,
            recorded=recorder.rows,
            recording_file=recorder.file,
            recording_message=recorder.message,
            driver_counters=dict(watch.driver_counters),
        )

    def latest(self) -> Sample | None:
        """The newest frame with its pose; None before the first."""
        return self._latest

    def add_sink(self, sink: Sink) -> None:
        """Hand every further sample to a sink, in the thread that tracks."""
        self._sinks = [*self._sinks, sink]

    def set_exposure(self, us: float) -> None:
        """Set the exposure; it is no longer kept by itself.

        Raises
        ------
        SettingRefusedError
        """
        self._light.set_by_hand(us)

    def keep_exposure(self, on: bool) -> None:
        """Whether the exposure is kept where the brightest fields are just below full scale."""
        self._light.on = on

    @property
    def keeps_exposure(self) -> bool:
        return self._light.on

    def zero(self) -> None:
        """Count positions from here: the mean of the last second.

        Raises
        ------
        ValueError
            If there was no position.
        """
        rows = self.recent.last(_ZERO_S)
        rows = rows[np.isfinite(rows["x_um"])]
        if not len(rows):
            raise ValueError(
                f"{self.config.name} has no position now; a zero needs one. "
                "See what its status says."
            )
        x_um, y_um, scale, theta_rad = (
            float(rows[name].mean()) for name in ("x_um", "y_um", "scale", "theta_rad")
        )
        self._zero = (x_um, y_um), scale, theta_rad

    def clear_zero(self) -> None:
        """Count positions from the mask's origin."""
        self._zero = (0.0, 0.0), 1.0, 0.0

    def start_recording(self) -> None:
        self.recorder.start()

    def stop_recording(self) -> None:
        self.recorder.stop()

    def keep_frames(self) -> None:
        """Keep the raw frames before and after this moment, also while nothing is recorded.

        Raises
        ------
        ValueError
            If there was no frame yet.
        """
        if self._latest is None:
            raise ValueError(f"{self.config.name} has no frame yet to keep.")
        self.recorder.event("asked for")

    def snapshot(self) -> Path:
        """Save the newest frame as an image, and its pose as JSON beside it.

        Returns
        -------
        Path
            Of the image.

        Raises
        ------
        ValueError
            If there was no frame yet.
        OSError
            If it cannot be written.
        """
        sample = self._latest
        if sample is None:
            raise ValueError(f"{self.config.name} has no frame yet to save.")
        folder = self.folder / self.config.name / "snapshots"
        with self._saving:
            return save_snapshot(folder, self.config.name, self.system, sample)

    def history(self, start_s: float, end_s: float, points: int) -> dict[str, NDArray[Any]]:
        """Least, mean and largest values in bins of time, from the record."""
        return self.recorder.history(start_s, end_s, points)

    # ------------------------------------------------------------------ tracking

    def _new_tracker(self) -> Tracker:
        return Tracker(self.system, model=self.config.model, orientation=self.config.orientation)

    def _metadata(self) -> dict[str, str]:
        camera = self.config.camera
        about = {
            "source": f"{camera.kind} camera {camera.device}".rstrip(),
            "channel": self.config.name,
            "model": self.config.model,
        }
        rate_hz = camera.frame_rate_hz or self.system.sensor.frame_rate_hz
        if rate_hz:
            about["frame_rate_hz"] = repr(rate_hz)
        return about

    def _prepare(self, frame: CameraFrame) -> bool:
        """Before the first frame is taken: the first start on a machine compiles."""
        if warm_up.is_compiled() or frame.image.shape != self.system.shape:
            return False
        self._notes["start"] = "Compiling for this machine; only the first start has to."
        try:
            return warm_up.prepare(frame.image, self.system)
        finally:
            del self._notes["start"]

    def _track(self) -> None:
        """What the tracking thread does: every frame that waits, in its order."""
        while not self._ring.finished:
            waiting = self._ring.get(_POLL_S)
            if waiting is not None:
                self._take(waiting)

    def _take(self, waiting: Waiting) -> None:
        frame, arrival = waiting.frame, waiting.arrival
        pose = self._pose(waiting)
        if arrival.flags:
            pose = replace(pose, flags=pose.flags | arrival.flags)
        sample = Sample(frame, arrival.number, pose)
        self._latest = sample
        self._tracked += pose.ok
        self.recent.add(sample, frame.host_time_s, time.perf_counter() - frame.received_s)
        for k, sink in enumerate(self._sinks):
            try:
                sink.add(sample)
            except Exception as error:  # the others go on
                self._sink_errors[k] = f"{type(sink).__name__} failed: {told(error)}"
            else:
                self._sink_errors.pop(k, None)
        if self.recent.count == 1:
            # What is there now lives as long as the channel; to look through it for garbage
            # would take 50 ms each time.
            gc.collect()
            gc.freeze()

    def _pose(self, waiting: Waiting) -> Pose:
        image, arrival = waiting.frame.image, waiting.arrival
        if image.shape != self.system.shape:
            height, width = self.system.shape
            self._notes["image"] = (
                f"The image has {image.shape[1]} x {image.shape[0]} pixels, the system "
                f"{width} x {height}; change the camera's region, or sensor.width_px, height_px "
                "or binning of the system."
            )
        else:
            self._notes.pop("image", None)
        try:
            pose = self._tracker.update(image, arrival.time_s, arrival.number)
        except Exception as error:  # one frame must not end the channel
            self._notes["tracking"] = f"A frame could not be tracked: {told(error)}"
            self._tracker = self._new_tracker()
            return Pose(flags=Flag.NO_IMAGE)
        self._notes.pop("tracking", None)
        return pose

    # ------------------------------------------------------------------ looking after it

    def _look_after(self) -> None:
        while not self._stopping.wait(_WATCH_S):
            try:
                self._look()
            except Exception as error:
                self._notes["watch"] = told(error)
            else:
                self._notes.pop("watch", None)

    def _look(self) -> None:
        sample = self._latest
        frame = None if sample is None else sample.frame
        for sentence in self._watch.tick(frame, self._zero[0]):
            self.recorder.event(f"alarm: {sentence}")
        if frame is not None:
            self._light.look(frame, self._watch.settings, self._watch.full_scale)

    def _state(self) -> ChannelState:
        if self._stopped:
            return "stopped"
        state = self._acquisition.state
        if state == "running" and self._latest is None:
            return "starting"
        if state == "ended" and self._threads[0].is_alive():
            return "running"  # the last frames are still tracked
        return state

    def _message(self) -> str:
        messages = [self._acquisition.message, *list(self._notes.values())]
        messages += [self._light.message, *list(self._sink_errors.values())]
        return " ".join(message for message in messages if message)
