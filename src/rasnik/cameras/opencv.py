"""Webcams through OpenCV: to look at a mask, not to measure with.

Webcams compress, sharpen and set their exposure themselves; the noise of their pixels is not
what a system file states.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rasnik.cameras.camera import (
    NAN,
    Camera,
    CameraFrame,
    CameraLostError,
    CameraMissingError,
    CameraSettings,
    SettingRefusedError,
)
from rasnik.io.formats import to_grey

__all__ = ["OpenCvCamera"]

# V4L2 counts exposure in units of 100 us, and wants its automatic set to 1 ("manual") first.
_EXPOSURE_UNIT_US = 100.0
_MANUAL = 1
_POSSIBLE = {"frame_rate_hz", "exposure_us"}


class OpenCvCamera(Camera):
    """A webcam.

    Parameters
    ----------
    device : str
        Number of the camera, or its path such as ``/dev/video0``.
    settings : CameraSettings, optional
        Frame rate and exposure are asked for; webcams do what they can.
    """

    metrology: ClassVar[bool] = False

    def __init__(self, device: str = "0", settings: CameraSettings | None = None) -> None:
        self.name = f"webcam {device}"
        self._device: int | str = int(device) if device.strip().isdecimal() else device
        self._asked = settings or CameraSettings()
        self._cv2: Any = None
        self._capture: Any = None
        self._lock = threading.Lock()  # OpenCV does not keep threads apart
        self._number = 0
        self._exposure_us = NAN

    def open(self) -> None:
        try:
            import cv2
        except ImportError:
            raise CameraMissingError(
                "webcams need OpenCV, which is not installed; install it with: "
                "pip install opencv-python-headless"
            ) from None
        self.close()
        with self._lock:
            self._cv2 = cv2
            capture = cv2.VideoCapture(self._device)
            if not capture.isOpened():
                capture.release()
                raise CameraMissingError(
                    f"there is no webcam {self._device}, or another program uses it; connected "
                    "ones are /dev/video0 and so on."
                )
            self._capture, self._number, self._exposure_us = capture, 0, NAN
            try:
                self._set(self._asked)
            except SettingRefusedError:
                self._release()
                raise

    def close(self) -> None:
        with self._lock:
            self._release()

    def read(self, timeout_s: float) -> CameraFrame | None:
        """As for every camera; how long OpenCV waits for a frame cannot be set."""
        with self._lock:
            if self._capture is None:
                raise CameraLostError(f"{self.name} is not open.")
            came, picture = self._capture.read()
            received_s, host_s = time.perf_counter(), time.time()
            if not came or picture is None:
                raise CameraLostError(f"{self.name} gives no more frames; check its cable.")
            self._number += 1
            number, exposure_us = self._number, self._exposure_us
        return CameraFrame(_grey(picture), number, host_s, received_s, exposure_us=exposure_us)

    @property
    def settings(self) -> CameraSettings:
        with self._lock:
            return self._in_force()

    def change(self, settings: CameraSettings) -> CameraSettings:
        with self._lock:
            if self._capture is None:
                raise SettingRefusedError(f"{self.name} is not open; it has no settings yet.")
            self._set(settings)
            self._asked = replace(self._asked, **settings.changed())  # also after reconnection
            return self._in_force()

    # --------------------------------------------------------------------------- under the lock

    def _release(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _in_force(self) -> CameraSettings:
        if self._capture is None:
            return CameraSettings()
        rate_hz = float(self._capture.get(self._cv2.CAP_PROP_FPS))
        return CameraSettings(
            frame_rate_hz=rate_hz if rate_hz > 0 else None,
            exposure_us=self._exposure_us if self._exposure_us > 0 else None,
        )

    def _set(self, settings: CameraSettings) -> None:
        asked = settings.changed()
        for name in asked:
            if name not in _POSSIBLE:
                raise SettingRefusedError(
                    f"{name} of a webcam cannot be set; frame_rate_hz and exposure_us can."
                )
        if "frame_rate_hz" in asked:
            self._capture.set(self._cv2.CAP_PROP_FPS, asked["frame_rate_hz"])
        if "exposure_us" in asked:
            self._set_exposure(asked["exposure_us"])

    def _set_exposure(self, exposure_us: float) -> None:
        cv2, capture = self._cv2, self._capture
        units = max(1, round(exposure_us / _EXPOSURE_UNIT_US))
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)
        if not capture.set(cv2.CAP_PROP_EXPOSURE, units):
            raise SettingRefusedError(f"{self.name} does not let its exposure be set.")
        told = float(capture.get(cv2.CAP_PROP_EXPOSURE))
        self._exposure_us = told * _EXPOSURE_UNIT_US if told > 0 else NAN


def _grey(picture: NDArray[Any]) -> NDArray[Any]:
    """Luminance of a picture, whose colours are blue, green, red; owned by the caller."""
    if picture.ndim == 3 and picture.shape[2] == 1:
        picture = picture[:, :, 0]
    if picture.ndim == 2:
        return np.array(picture)
    return np.rint(to_grey(picture[:, :, 2::-1])).astype(picture.dtype)
