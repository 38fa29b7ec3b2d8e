"""GigE Vision cameras, with Aravis' own fake camera in another process."""

import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import _fake_gige
from rasnik import load_system
from rasnik.cameras import aravis
from rasnik.cameras.camera import (
    CameraFrame,
    CameraLostError,
    CameraMissingError,
    CameraSettings,
    SettingRefusedError,
)
from rasnik.cameras.exposure import ExposureKeeper
from rasnik.cameras.packed_pixels import grey_levels

SYSTEM = load_system("solidras", {"sensor.width_px": 240, "sensor.height_px": 180})
POOL = 6
RATE_HZ = 100.0
ADDRESS = "127.0.0.1"


def why_not() -> str:
    """Why there can be no fake camera here; empty if there can."""
    try:
        aravis.load_aravis()
    except CameraMissingError as error:
        return str(error)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((ADDRESS, _fake_gige.PORT))
        except OSError:
            return "another camera answers at this computer's own address"
    return ""


REASON = why_not()
needs_camera = pytest.mark.skipif(bool(REASON), reason=REASON or "a fake camera is possible")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fake") / "pictures.npy"
    _fake_gige.make_pictures(path, POOL, 2.0, SYSTEM, seed=1)
    return path


@pytest.fixture(scope="module")
def fake(pictures: Path) -> Iterator[_fake_gige.FakeCamera]:
    with _fake_gige.FakeCamera(
        pictures.with_name("sent.bin"), pictures, address=ADDRESS, serial="T1"
    ) as camera:
        yield camera


@pytest.fixture
def camera(fake: _fake_gige.FakeCamera) -> Iterator[aravis.AravisCamera]:
    settings = CameraSettings(
        frame_rate_hz=RATE_HZ, exposure_us=1000.0, region=(0, 0, 240, 180), packet_bytes=4000
    )
    one = aravis.AravisCamera(ADDRESS, settings)
    one.open()
    yield one
    one.close()


def frames(camera: aravis.AravisCamera, n: int) -> list[CameraFrame]:
    found = [camera.read(1.0) for _ in range(n)]
    assert all(found)
    return [frame for frame in found if frame is not None]


def times_us(found: list[CameraFrame]) -> list[int]:
    return [round(1e6 * frame.device_time_s) for frame in found]


@needs_camera
def test_frames_are_what_was_sent(
    camera: aravis.AravisCamera, fake: _fake_gige.FakeCamera, pictures: Path
) -> None:
    found = frames(camera, 60)
    assert camera.number_wraps_at == 65535
    sent = {int(row["time_us"]): row for row in fake.sent()}
    shown = np.load(pictures)
    for frame, time_us in zip(found, times_us(found), strict=True):
        row = sent[time_us]
        assert frame.number == row["number"]
        assert frame.image.dtype == np.uint8
        assert np.array_equal(frame.image, shown[row["phase"]])
        assert frame.exposure_us == 1000.0
        assert 0 < frame.host_time_s - frame.device_time_s < 5.0
    assert abs(found[-1].received_s - time.perf_counter()) < 5.0
    image = found[0].image
    image[0, 0] = 1  # its own, and writable: compiled functions tell these apart


@needs_camera
def test_settings_are_told_and_come_into_force(camera: aravis.AravisCamera) -> None:
    told = camera.settings
    assert told.frame_rate_hz == pytest.approx(RATE_HZ)
    assert told.region == (0, 0, 240, 180)
    assert (told.pixel_format, told.trigger, told.packet_bytes) == ("Mono8", "free", 4000)
    bright = frames(camera, 1)[0].image.mean()
    assert camera.change(CameraSettings(exposure_us=500.0)).exposure_us == 500.0
    time.sleep(0.1)
    dim = frames(camera, 20)[-1]
    assert dim.exposure_us == 500.0
    assert dim.image.mean() == pytest.approx(bright / 2, rel=0.02)


@needs_camera
@pytest.mark.parametrize("exposure_us", [150.0, 3000.0])
def test_exposure_is_kept_below_full_scale(camera: aravis.AravisCamera, exposure_us: float) -> None:
    keeper = ExposureKeeper(255, longest_us=1e6 / RATE_HZ)
    camera.change(CameraSettings(exposure_us=exposure_us))
    for _ in range(80):
        proposed_us = keeper.propose(frames(camera, 1)[0])
        if proposed_us is not None:
            camera.change(CameraSettings(exposure_us=proposed_us))
    settled = frames(camera, 5)[-1].image
    assert 0.92 * 255 <= np.quantile(settled, 0.999) <= 0.99 * 255
    assert np.mean(settled == 255) < 2e-3
    assert 900.0 < camera.settings.exposure_us < 1000.0  # the pictures' own is 1000 us


@needs_camera
def test_region_changes_under_way(camera: aravis.AravisCamera, pictures: Path) -> None:
    before = frames(camera, 2)
    told = camera.change(CameraSettings(region=(20, 10, 100, 80)))
    assert told.region == (20, 10, 100, 80)
    image = frames(camera, 3)[-1].image
    assert image.shape == (80, 100)
    assert any(np.array_equal(image, one[10:90, 20:120]) for one in np.load(pictures))
    assert before[0].image.shape == (180, 240)


@needs_camera
@pytest.mark.parametrize(
    ("refused", "sentence"),
    [
        (CameraSettings(exposure_us=1.0), r"exposure_us .* can be 10 to .* us, not 1\."),
        (CameraSettings(frame_rate_hz=1e6), r"frame_rate_hz .* to 1000 Hz"),
        (CameraSettings(gain_db=99.0), r"gain_db .* 0 to 10 dB"),
        (CameraSettings(pixel_format="Mono12"), r"pixel_format .* can be Mono8, Mono16, not"),
        (CameraSettings(region=(0, 0, 3000, 10)), "within its 2048 x 2048 pixels"),
        (CameraSettings(trigger="Line7"), r"can be free, Line0, Software; not Line7"),
    ],
)
def test_what_is_not_possible_is_refused_with_the_range(
    camera: aravis.AravisCamera, refused: CameraSettings, sentence: str
) -> None:
    before = camera.settings
    with pytest.raises(SettingRefusedError, match=sentence):
        camera.change(refused)
    assert camera.settings == before
    frames(camera, 2)


@needs_camera
def test_a_region_that_is_refused_from_the_beginning_leaves_the_camera_free(
    fake: _fake_gige.FakeCamera,
) -> None:
    wrong = aravis.AravisCamera(ADDRESS, CameraSettings(region=(0, 0, 9999, 10)))
    with pytest.raises(SettingRefusedError):
        wrong.open()
    right = aravis.AravisCamera(ADDRESS, CameraSettings(frame_rate_hz=RATE_HZ))
    right.open()
    frames(right, 2)
    right.close()


@needs_camera
def test_cameras_are_found_by_serial_number(fake: _fake_gige.FakeCamera) -> None:
    one = aravis.AravisCamera("T1", CameraSettings(frame_rate_hz=RATE_HZ))
    one.open()
    assert one.name == "Aravis Fake T1"
    frames(one, 1)
    one.close()
    one.close()
    with pytest.raises(
        CameraMissingError, match=rf"camera nix does not answer; seen: .*T1, {ADDRESS}"
    ):
        aravis.AravisCamera("nix").open()


@needs_camera
def test_a_camera_under_control_of_another_is_not_taken(camera: aravis.AravisCamera) -> None:
    frames(camera, 1)
    with pytest.raises(CameraMissingError, match="controlled by another program"):
        aravis.AravisCamera(ADDRESS).open()
    frames(camera, 2)


@needs_camera
def test_without_a_trigger_no_frame_comes_and_nothing_is_lost(
    fake: _fake_gige.FakeCamera,
) -> None:
    one = aravis.AravisCamera(ADDRESS, CameraSettings(trigger="Software"))
    one.open()
    assert [one.read(0.3) for _ in range(5)] == [None] * 5
    one.change(CameraSettings(trigger="free", frame_rate_hz=RATE_HZ))
    frames(one, 2)
    one.close()


# Last: these need the address for themselves.


@needs_camera
def test_lost_packets_are_counted_and_a_killed_camera_is_missed(
    fake: _fake_gige.FakeCamera, pictures: Path
) -> None:
    fake.close()
    log = pictures.with_name("lossy.bin")
    settings = CameraSettings(frame_rate_hz=RATE_HZ, packet_bytes=2000)
    with _fake_gige.FakeCamera(log, pictures, address=ADDRESS, lost_ratio=0.02) as lossy:
        one = aravis.AravisCamera(ADDRESS, settings)
        one.open()
        until_s = time.perf_counter() + 2.0
        got = []
        while time.perf_counter() < until_s:
            frame = one.read(0.2)
            if frame is not None:
                got.append(frame)
        sent = lossy.sent()
        received = np.isin(sent["time_us"], times_us(got))
        assert received.sum() == len(got)
        first, last = np.flatnonzero(received)[[0, -1]]
        missing = last - first + 1 - len(got)
        numbers = np.array([frame.number for frame in got])
        by_number = int(((np.diff(numbers) - 1) % 65535).sum())
        assert missing == by_number > 0
        counters = one.counters()
        assert counters["missing_packets"] >= counters["incomplete"] > 0
        assert counters["underruns"] == 0

        lossy.kill()
        killed_s = time.perf_counter()
        with pytest.raises(CameraLostError, match="cable and power"):
            while time.perf_counter() < killed_s + 5.0:
                one.read(0.2)
        assert time.perf_counter() - killed_s < 3.0
        closing_s = time.perf_counter()
        one.close()
        assert time.perf_counter() - closing_s < 0.5
        assert one.counters()["missing_packets"] >= counters["missing_packets"]
    with _fake_gige.FakeCamera(log, pictures, address=ADDRESS):
        one.open()
        frames(one, 10)
        one.close()


@pytest.mark.parametrize(
    ("code", "data", "levels"),
    [
        (0x01080001, [1, 255], [1, 255]),
        (0x01100005, [0x34, 0x02, 0xFF, 0x0F], [0x234, 0xFFF]),
        (0x010C0047, [0xBC, 0xFA, 0xDE], [0xABC, 0xDEF]),  # Mono12p
        (0x010C0006, [0xAB, 0xFC, 0xDE], [0xABC, 0xDEF]),  # Mono12Packed
        (0x010C0004, [0xAB, 0x32, 0xFF], [0x2AE, 0x3FF]),  # Mono10Packed
    ],
)
def test_packed_pixels(code: int, data: list[int], levels: list[int]) -> None:
    assert grey_levels(bytes(data), code, 2, 1).tolist() == [levels]


def test_ten_bits_in_a_row() -> None:
    levels = np.random.default_rng(1).integers(0, 1024, (3, 4))
    stream = sum(int(level) << 10 * k for k, level in enumerate(levels.ravel()))
    found = grey_levels(stream.to_bytes(15, "little"), 0x010A0046, 4, 3)
    assert found.tolist() == levels.tolist()
    assert found.dtype == np.uint16


def test_colours_and_short_data_are_refused() -> None:
    with pytest.raises(ValueError, match="0x01080009 cannot be read"):
        grey_levels(b"1234", 0x01080009, 2, 2)
    with pytest.raises(ValueError, match="3 bytes are too few for 2 x 2 pixels in Mono8"):
        grey_levels(b"123", 0x01080001, 2, 2)


def test_without_aravis_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "gi", None)
    with pytest.raises(CameraMissingError, match=re.escape("pip install 'rasnik[camera]'")):
        aravis.AravisCamera("any")


@needs_camera
def test_who_asks_for_counters_does_not_wait_for_a_camera_that_is_connected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It takes seconds if nothing answers; rates and alarms are looked at by who asks."""
    camera = aravis.AravisCamera("127.0.0.99")
    connecting, goes_on = threading.Event(), threading.Event()

    def connect() -> None:
        connecting.set()
        goes_on.wait(30)
        raise CameraMissingError("it does not answer.")

    def attempt() -> None:
        with pytest.raises(CameraMissingError):
            camera.open()

    monkeypatch.setattr(camera, "_connected", connect)
    thread = threading.Thread(target=attempt)
    thread.start()
    assert connecting.wait(10)
    asking = threading.Thread(target=camera.counters, daemon=True)
    asking.start()
    asking.join(20)
    waited = asking.is_alive()
    goes_on.set()
    thread.join(10)
    assert not waited
