"""Recordings replayed as a camera: order, pace, gaps, the end; sources that cannot be had."""

import math
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from rasnik import load_system
from rasnik.cameras.camera import (
    CameraFrame,
    CameraLostError,
    CameraMissingError,
    CameraSettings,
    SettingRefusedError,
    SourceEndedError,
)
from rasnik.cameras.opening import open_camera
from rasnik.cameras.replay import ReplayCamera
from test_cameras_simulated import Options


@pytest.fixture
def images(rng: np.random.Generator) -> NDArray[np.uint8]:
    return rng.integers(0, 256, (6, 12, 16), dtype=np.uint8)


@pytest.fixture
def folder(images: NDArray[np.uint8], tmp_path: Path) -> Path:
    """A folder of images whose names sort naturally, not by letters."""
    path = tmp_path / "frames"
    path.mkdir()
    for k, image in enumerate(images):
        Image.fromarray(image).save(path / f"frame{k + 7}.png")
    return path


def all_frames(camera: ReplayCamera) -> list[CameraFrame]:
    frames = []
    camera.open()
    with pytest.raises(SourceEndedError, match="is at its end"):
        while True:
            frame = camera.read(1.0)
            assert frame is not None
            frames.append(frame)
    with pytest.raises(SourceEndedError):
        camera.read(1.0)
    camera.close()
    return frames


def full(*sources: object, **options: object) -> ReplayCamera:
    return ReplayCamera([str(s) for s in sources], pace="full", **options)  # type: ignore[arg-type]


def test_a_folder_comes_in_order_and_ends(folder: Path, images: NDArray[np.uint8]) -> None:
    camera = full(folder, frame_rate_hz=10.0)
    frames = all_frames(camera)
    assert camera.live is False and camera.metrology
    assert "frames" in camera.name
    assert [frame.number for frame in frames] == [1, 2, 3, 4, 5, 6]
    assert [frame.device_time_s for frame in frames] == pytest.approx(np.arange(1, 7) / 10)
    for frame, image in zip(frames, images, strict=True):
        assert frame.image.dtype == np.uint8 and (frame.image == image).all()
    assert camera.counters() == {"unreadable": 0}
    assert camera.settings == CameraSettings(frame_rate_hz=10.0)


def test_stacks_and_datasets(images: NDArray[np.uint8], tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", images)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["raw/frames"] = images[::-1].astype(np.uint16) * 16
    frames = all_frames(full(tmp_path / "a.tif", f"{tmp_path}/b.h5:/raw/frames", bit_depth=12))
    assert len(frames) == 12
    assert (frames[2].image == images[2]).all()
    assert frames[6].image.dtype == np.uint16
    assert (frames[6].image == images[5].astype(np.uint16) * 16).all()
    assert math.isnan(frames[0].device_time_s)


def test_frames_that_were_kept_beside_their_poses(
    images: NDArray[np.uint8], tmp_path: Path
) -> None:
    with h5py.File(tmp_path / "event.h5", "w") as file:
        file["frames"] = images
        file["poses"] = np.zeros(6, [("frame", np.int64), ("x_um", float)])
    frames = all_frames(full(tmp_path / "event.h5"))
    assert [(f.image == i).all() for f, i in zip(frames, images, strict=True)] == [True] * 6


def test_a_video(images: NDArray[np.uint8], tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "v.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 16, 12, "gray"
        for image in images:
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, "gray")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    frames = all_frames(full(tmp_path / "v.mkv"))
    assert [(f.image == i).all() for f, i in zip(frames, images, strict=True)] == [True] * 6


def test_the_original_pace(folder: Path) -> None:
    camera = ReplayCamera([str(folder)], frame_rate_hz=50.0)
    begun_s = time.perf_counter()
    frames = all_frames(camera)
    assert camera.live
    assert time.perf_counter() - begun_s >= 5 / 50
    received_s = np.array([frame.received_s for frame in frames])
    due_s = np.arange(6) / 50
    assert (received_s - received_s[0] - due_s).min() > -0.02
    assert received_s[-1] - received_s[0] < 5 / 50 + 1


def test_a_slow_reader_loses_no_frame_of_a_recording(folder: Path) -> None:
    camera = ReplayCamera([str(folder)], frame_rate_hz=500.0)
    camera.open()
    time.sleep(0.1)
    numbers = [camera.read(1.0).number for _ in range(6)]  # type: ignore[union-attr]
    assert numbers == [1, 2, 3, 4, 5, 6]
    camera.close()


def test_no_frame_before_its_time(folder: Path) -> None:
    camera = ReplayCamera([str(folder)], frame_rate_hz=5.0)
    camera.open()
    assert camera.read(1.0).number == 1  # type: ignore[union-attr]
    assert camera.read(0.02) is None
    assert camera.read(1.0).number == 2  # type: ignore[union-attr]
    camera.close()


def test_repeated_from_the_beginning(folder: Path, images: NDArray[np.uint8]) -> None:
    camera = full(folder, repeat=True, frame_rate_hz=100.0)
    camera.open()
    frames = [camera.read(1.0) for _ in range(20)]
    assert [frame.number for frame in frames if frame] == list(range(1, 21))
    assert frames[19] is not None and (frames[19].image == images[19 % 6]).all()
    assert frames[19].device_time_s == pytest.approx(0.2)
    camera.close()


def test_an_unreadable_frame_leaves_a_gap(folder: Path) -> None:
    (folder / "frame9.png").write_bytes(b"\x89PNG\r\n\x1a\nno image")
    camera = full(folder)
    assert [frame.number for frame in all_frames(camera)] == [1, 2, 4, 5, 6]
    assert camera.counters() == {"unreadable": 1}
    assert "frame9.png" in camera.last_error


def test_images_too_bright_for_the_sensor_are_unreadable(tmp_path: Path) -> None:
    levels = np.array([[[0, 255]], [[0, 256]]], np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", np.repeat(np.repeat(levels, 8, 1), 4, 2))
    camera = full(tmp_path / "a.tif", bit_depth=8)
    (frame,) = all_frames(camera)
    assert frame.image.dtype == np.uint8 and frame.image.max() == 255
    assert "from 0 to 256 are not those of 8 bits; change sensor.bit_depth" in camera.last_error


@pytest.mark.parametrize(
    ("image", "sentence"),
    [
        (np.linspace(0, 1, 96).reshape(8, 12), "not those of a camera"),
        (np.full((8, 12), -3.0), "from -3 to -3 are not those of 16 bits"),
        (np.full((8, 12), np.nan), "NaN"),
    ],
)
def test_what_no_camera_took(image: NDArray[np.float64], sentence: str, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", image)
    with pytest.raises(CameraMissingError, match=f"no image that can be read.*{sentence}"):
        full(tmp_path / "a.npy").open()


def test_luminance_of_colours_is_rounded(tmp_path: Path) -> None:
    colours = np.zeros((8, 12, 3), np.uint8)
    colours[...] = (10, 200, 30)
    Image.fromarray(colours).save(tmp_path / "a.png")
    (frame,) = all_frames(full(tmp_path, bit_depth=8))
    assert frame.image.dtype == np.uint8
    assert set(frame.image.ravel()) == {round(0.299 * 10 + 0.587 * 200 + 0.114 * 30)}


def test_bad_sources(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "empty").mkdir()
    for sources, sentence in [
        ([tmp_path / "gone.tif"], "gone.tif: there is no such file or folder"),
        ([folder, tmp_path / "empty"], "the folder holds no images"),
        ([tmp_path / "*.tif"], "no file matches"),
        ([], "no source is named"),
    ]:
        with pytest.raises(CameraMissingError, match=sentence):
            full(*sources).open()
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(CameraMissingError, match="no image that can be read.*text.png"):
        full(tmp_path / "text.png", repeat=True).open()
    with pytest.raises(ValueError, match="original or full, not 'slow'"):
        ReplayCamera([str(folder)], pace="slow")
    with pytest.raises(SettingRefusedError, match="give frame_rate_hz"):
        ReplayCamera([str(folder)]).open()


def test_a_recording_cannot_be_exposed_anew(folder: Path) -> None:
    camera = full(folder)
    camera.open()
    with pytest.raises(SettingRefusedError, match="has no exposure_us"):
        camera.change(CameraSettings(exposure_us=100.0))
    with pytest.raises(SettingRefusedError, match="frame rate of a recording"):
        camera.change(CameraSettings(frame_rate_hz=100.0))
    camera.close()
    with pytest.raises(SettingRefusedError, match="has no gain_db"):
        full(folder, settings=CameraSettings(gain_db=1.0)).open()


def test_closing_ends_a_wait_and_its_threads(folder: Path) -> None:
    before = threading.active_count()
    camera = ReplayCamera([str(folder)], frame_rate_hz=0.1)
    with pytest.raises(CameraLostError, match="not open"):
        camera.read(0.1)
    camera.open()
    camera.read(1.0)
    threading.Timer(0.05, camera.close).start()
    begun_s = time.perf_counter()
    with pytest.raises(CameraLostError, match="closed"):
        camera.read(5.0)
    assert time.perf_counter() - begun_s < 2
    camera.close()
    time.sleep(0.1)
    assert threading.active_count() <= before
    camera.open()  # and from the beginning again
    assert camera.read(1.0).number == 1  # type: ignore[union-attr]
    camera.close()


def test_a_station_names_a_replay(folder: Path) -> None:
    options = Options(kind="replay", source=[str(folder)], repeat=True)
    camera = open_camera(options, load_system("solidras"))
    assert isinstance(camera, ReplayCamera)
    assert camera.settings.frame_rate_hz == 275
    camera.open()
    assert camera.read(1.0).number == 1  # type: ignore[union-attr]
    camera.close()
