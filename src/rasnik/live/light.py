"""Keeping a camera's exposure where its frames are best."""

from __future__ import annotations

import threading
from dataclasses import replace

from rasnik.cameras.camera import CameraError, CameraFrame, CameraSettings
from rasnik.cameras.exposure import ExposureKeeper
from rasnik.live.acquisition import Acquisition

__all__ = ["LightKeeper"]

_OF_A_PERIOD = 0.95  # the longest exposure that does not cost frames


class LightKeeper:
    """Sets the exposure of a camera, a few times a second at most, as long as it is asked to.

    Parameters
    ----------
    acquisition : Acquisition
    on : bool

    Attributes
    ----------
    on : bool
    message : str
        What is wrong, as a sentence; empty if nothing is.
    """

    def __init__(self, acquisition: Acquisition, on: bool) -> None:
        self._acquisition = acquisition
        self._keeper: ExposureKeeper | None = None
        self._made_for: tuple[int, float | None] = (0, None)
        self._last: CameraFrame | None = None
        self._lock = threading.Lock()  # who sets by hand is not overruled by a look under way
        self.on = on
        self.message = ""

    def set_by_hand(self, exposure_us: float) -> None:
        """Set the exposure, which is not kept any more then.

        Raises
        ------
        SettingRefusedError
            Then it is kept as before.
        """
        with self._lock:
            self._acquisition.change(CameraSettings(exposure_us=exposure_us))
            self.on = False

    def look(self, frame: CameraFrame, settings: CameraSettings, full_scale: int) -> None:
        """Judge a frame, and set the exposure if it should be another.

        Parameters
        ----------
        frame : CameraFrame
            The newest; it is judged once.
        settings : CameraSettings
            In force.
        full_scale : int
            Highest grey level.
        """
        if not self._lock.acquire(blocking=False):
            return  # the exposure is being set
        try:
            self._look(frame, settings, full_scale)
        finally:
            self._lock.release()

    def _look(self, frame: CameraFrame, settings: CameraSettings, full_scale: int) -> None:
        if not self.on:
            self._keeper, self.message = None, ""
            return
        if frame is self._last:
            return
        self._last = frame
        rate_hz = settings.frame_rate_hz
        if self._keeper is None or self._made_for != (full_scale, rate_hz):
            longest_us = 1e6 * _OF_A_PERIOD / rate_hz if rate_hz else float("inf")
            self._keeper = ExposureKeeper(full_scale, longest_us=max(longest_us, 20.0))
            self._made_for = full_scale, rate_hz
        if not frame.exposure_us > 0 and settings.exposure_us is not None:
            frame = replace(frame, exposure_us=settings.exposure_us)
        if not frame.exposure_us > 0:
            self.message = "The exposure cannot be kept: the camera does not tell what it is."
            return
        proposed_us = self._keeper.propose(frame)
        if proposed_us is None:
            return
        try:
            self._acquisition.change(CameraSettings(exposure_us=proposed_us))
        except CameraError as error:
            self.message = f"The exposure cannot be kept: {error}"
        else:
            self.message = ""
