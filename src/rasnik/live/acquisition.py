"""The thread that takes frames off a camera, and never waits for anything else."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rasnik.cameras.camera import (
    Camera,
    CameraError,
    CameraFrame,
    CameraLostError,
    CameraSettings,
    SettingRefusedError,
    SourceEndedError,
)
from rasnik.live.losses import Losses
from rasnik.live.ring import FrameRing, Waiting
from rasnik.live.status import ChannelState

__all__ = ["Acquisition", "told"]

_POLL_S = 0.2
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.2, 2.0  # between attempts to connect again
_SILENT_S, _SILENT_PERIODS = 3.0, 10.0  # without frames: whoever is due and silent is gone


class Acquisition:
    """Reads a camera into a ring, and connects again when it is gone.

    Parameters
    ----------
    camera : Camera
        Not opened yet.
    ring : FrameRing
        Closed when no more frames come.
    prepare : callable
        Given the first frame. If it returns True it took its time: frames begin afresh.
    name : str
        Of the thread.

    Attributes
    ----------
    state : str
        As of a channel.
    message : str
        What is wrong, as a sentence; empty if nothing is.
    losses : Losses
    reconnects : int
    last_frame_s : float
        When the last frame came, by `time.perf_counter`; NaN before the first.
    """

    def __init__(
        self,
        camera: Camera,
        ring: FrameRing,
        prepare: Callable[[CameraFrame], bool] = lambda frame: False,
        name: str = "camera",
    ) -> None:
        self.camera = camera
        self.state: ChannelState = "starting"
        self.message = ""
        self.reconnects = 0
        self.last_frame_s = float("nan")
        self.losses = Losses()
        self._ring, self._prepare = ring, prepare
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name} acquisition", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Ask the thread to end; `join` waits for it."""
        self._stopping.set()

    def change(self, settings: CameraSettings) -> CameraSettings:
        """Change settings of the camera; what is in force afterwards."""
        changed = self.camera.change(settings)
        self.losses.change_pace()
        return changed

    def join(self, timeout_s: float) -> bool:
        """Whether the thread has ended within the time."""
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._keep_connected()
        except SourceEndedError as error:
            self.state, self.message = "ended", str(error)
        except Exception as error:
            self.state = "failed"
            self.message = told(error)
        finally:
            self._close()
            self._ring.close()

    def _keep_connected(self) -> None:
        wait_s, connected_before = _FIRST_WAIT_S, False
        while not self._stopping.is_set():
            try:
                self.camera.open()
                self._began(connected_before)
                connected_before = True
                wait_s = _FIRST_WAIT_S
                self._read()
                return
            except SourceEndedError:
                raise
            except Exception as error:
                # What is refused from the beginning stays so; what is absent may come.
                refused = isinstance(error, SettingRefusedError) and not self.losses.frames
                if refused or not self.camera.live:
                    raise
                self.state, self.message = "lost", told(error)
            self._close()
            self._stopping.wait(wait_s)
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S)

    def _began(self, again: bool) -> None:
        if again:
            self.reconnects += 1
            self.losses.restart()
            return
        camera = self.camera
        regular = camera.settings.trigger in (None, "free")
        self.losses = Losses(camera.number_wraps_at, regular=regular, live=camera.live)

    def _read(self) -> None:
        """Frames into the ring until somebody stops it, or the camera is gone."""
        opened_s = time.perf_counter()
        regular = self.camera.settings.trigger in (None, "free")
        while not self._stopping.is_set():
            frame = self.camera.read(_POLL_S)
            if frame is None:
                silent_s = time.perf_counter() - opened_s
                if regular and self.camera.live and silent_s > self._patience_s():
                    raise CameraLostError(
                        f"no frame has come for {silent_s:.0f} s; connecting again. "
                        "Check the cable and the power of the camera."
                    )
                continue
            if not self.losses.frames and self._prepare(frame) and self.camera.live:
                # What piled up meanwhile is old, and some of it is lost.
                self.camera.close()
                self.camera.open()
                continue
            opened_s = self.last_frame_s = frame.received_s
            self._take(frame)
            if self.state != "running":
                self.state, self.message = "running", ""

    def _patience_s(self) -> float:
        periods_s = _SILENT_PERIODS * self.losses.period_s
        rate_hz = self.camera.settings.frame_rate_hz
        slow_s = _SILENT_PERIODS / rate_hz if rate_hz else 0.0
        return max(_SILENT_S, slow_s, periods_s if periods_s > 0 else 0.0)

    def _take(self, frame: CameraFrame) -> None:
        waiting = Waiting(frame, self.losses.add(frame))
        if self.camera.live:
            self._ring.put(waiting)
            return
        while not self._ring.put_when_free(waiting, _POLL_S):
            if self._stopping.is_set():
                self._ring.put(waiting)  # counted, whatever becomes of it
                return

    def _close(self) -> None:
        try:
            self.camera.close()
        except Exception as error:
            self.message = self.message or told(error)


def told(error: Exception) -> str:
    """A sentence about an error; those that were not foreseen with their kind."""
    text = str(error).rstrip(".")
    if isinstance(error, CameraError):
        return f"{text}."
    return f"unexpected {type(error).__name__}: {text}."
