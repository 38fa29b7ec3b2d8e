"""Webcams, with a module in the place of OpenCV that behaves as it does."""

import sys
import types
from typing import Any

import numpy as np
import pytest

from rasnik import load_system
from rasnik.cameras.camera import (
    CameraLostError,
    CameraMissingError,
    CameraSettings,
    SettingRefusedError,
)
from rasnik.cameras.opencv import OpenCvCamera
from rasnik.cameras.opening import open_camera
from test_cameras_simulated import Options

FPS, AUTO, EXPOSURE = 5, 21, 15


class Capture:
    """As `cv2.VideoCapture`: never raises, returns False."""

    opened: list[Any] = []

    def __init__(self, device: int | str) -> None:
        self.device, self.released = device, False
        self.values = {FPS: 30.0, AUTO: 3.0, EXPOSURE: 157.0}
        self.picture: Any = np.zeros((4, 6, 3), np.uint8)
        self.picture[...] = (30, 200, 10)  # blue, green, red
        self.opened.append(self)

    def isOpened(self) -> bool:
        return self.device in (0, "/dev/video2")

    def release(self) -> None:
        self.released = True

    def read(self) -> tuple[bool, Any]:
        return self.picture is not None, self.picture

    def get(self, name: int) -> float:
        return self.values.get(name, 0.0)

    def set(self, name: int, value: float) -> bool:
        if name == EXPOSURE and (self.values[AUTO] != 1 or self.device == "/dev/video2"):
            return False
        self.values[name] = float(value)
        return True


@pytest.fixture(autouse=True)
def cv2(monkeypatch: pytest.MonkeyPatch) -> type[Capture]:
    module = types.ModuleType("cv2")
    vars(module).update(
        VideoCapture=Capture,
        CAP_PROP_FPS=FPS,
        CAP_PROP_AUTO_EXPOSURE=AUTO,
        CAP_PROP_EXPOSURE=EXPOSURE,
    )
    monkeypatch.setitem(sys.modules, "cv2", module)
    monkeypatch.setattr(Capture, "opened", [])
    return Capture


def test_frames_are_grey_and_numbered() -> None:
    camera = open_camera(Options(kind="opencv"), load_system("solidras"))
    assert isinstance(camera, OpenCvCamera) and not camera.metrology
    camera.open()
    frames = [camera.read(1.0) for _ in range(3)]
    assert [frame.number for frame in frames if frame] == [1, 2, 3]
    assert frames[0] is not None and frames[0].image.dtype == np.uint8
    assert set(frames[0].image.ravel()) == {round(0.299 * 10 + 0.587 * 200 + 0.114 * 30)}
    assert np.isnan(frames[0].device_time_s) and np.isnan(frames[0].exposure_us)
    camera.close()


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 1), (4, 6, 3), (4, 6, 4)])
def test_pictures_of_any_kind_are_owned_by_their_frame(
    shape: tuple[int, ...], cv2: type[Capture]
) -> None:
    camera = OpenCvCamera("0")
    camera.open()
    picture = cv2.opened[0].picture = np.full(shape, 77, np.uint8)
    frame = camera.read(1.0)
    picture[...] = 0
    assert frame is not None and frame.image.shape == (4, 6) and (frame.image == 77).all()
    camera.close()


def test_rate_and_exposure_are_set(cv2: type[Capture]) -> None:
    camera = OpenCvCamera("0", CameraSettings(frame_rate_hz=15.0))
    assert camera.settings == CameraSettings()
    camera.open()
    assert camera.settings == CameraSettings(frame_rate_hz=15.0)
    assert camera.change(CameraSettings(exposure_us=5010.0)).exposure_us == 5000.0
    assert cv2.opened[0].values == {FPS: 15.0, AUTO: 1.0, EXPOSURE: 50.0}
    frame = camera.read(1.0)
    assert frame is not None and frame.exposure_us == 5000.0
    camera.open()  # a new connection asks for the same
    assert cv2.opened[0].released and camera.settings.exposure_us == 5000.0
    camera.close()


def test_what_a_webcam_cannot_do_is_refused(cv2: type[Capture]) -> None:
    with pytest.raises(SettingRefusedError, match="gain_db of a webcam cannot be set"):
        OpenCvCamera("0", CameraSettings(gain_db=2.0)).open()
    assert cv2.opened[0].released
    camera = OpenCvCamera("/dev/video2")
    with pytest.raises(SettingRefusedError, match="is not open"):
        camera.change(CameraSettings(frame_rate_hz=5.0))
    camera.open()
    with pytest.raises(SettingRefusedError, match="does not let its exposure be set"):
        camera.change(CameraSettings(exposure_us=100.0))
    camera.close()
    camera.close()


def test_a_webcam_that_is_not_there(cv2: type[Capture]) -> None:
    with pytest.raises(CameraMissingError, match="there is no webcam 7, or another program"):
        OpenCvCamera("7").open()
    assert cv2.opened[0].released


def test_a_webcam_that_goes(cv2: type[Capture]) -> None:
    camera = OpenCvCamera("0")
    with pytest.raises(CameraLostError, match="is not open"):
        camera.read(1.0)
    camera.open()
    cv2.opened[0].picture = None
    with pytest.raises(CameraLostError, match="check its cable"):
        camera.read(1.0)
    camera.close()
    camera.open()
    assert camera.read(1.0).number == 1  # type: ignore[union-attr]
    camera.close()


def test_opencv_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(CameraMissingError, match="pip install opencv-python-headless"):
        OpenCvCamera("0").open()
