"""The simulated camera: its pace, its light and noise, and the truth of its frames."""

import math
import threading
import time
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from rasnik import analyse, load_system
from rasnik.cameras.camera import (
    CameraLostError,
    CameraMissingError,
    CameraSettings,
    SettingRefusedError,
)
from rasnik.cameras.moving_image import MovingImage
from rasnik.cameras.opening import open_camera
from rasnik.cameras.simulated import SimulatedCamera
from rasnik.imaging.montecarlo import exact_image
from rasnik.instrument import System
from rasnik.tracking.tracker import Tracker

FULL = load_system("solidras")
SMALL = load_system("solidras", ["sensor.width_px=240", "sensor.height_px=200"])


@pytest.fixture(scope="module")
def moving() -> MovingImage:
    return MovingImage(FULL, 2.0, seed=3)


def still(system: System = SMALL, **options: object) -> SimulatedCamera:
    """An opened camera that looks at a mask at rest, 100 frames a second."""
    camera = SimulatedCamera(system, motion_um=0, frame_rate_hz=100.0, **options)  # type: ignore[arg-type]
    camera.open()
    return camera


def read(camera: SimulatedCamera, n: int) -> list:
    frames = [camera.read(1.0) for _ in range(n)]
    assert all(frame is not None for frame in frames)
    return frames


# ------------------------------------------------------------------------------- image and noise


@pytest.mark.parametrize("name", ["solidras", "microras"])
@pytest.mark.parametrize("phase", [0.3, 2.5])
def test_a_frame_shows_the_exact_image_of_its_truth(name: str, phase: float) -> None:
    quiet = load_system(
        name,
        ["sensor.noise_a=0", "sensor.noise_b=0", "sensor.width_px=240", "sensor.height_px=200"],
    )
    image = MovingImage(quiet, 2.0 / quiet.optics.scale, seed=1)
    frame = image.frame(phase, 1.0, 1.0, 0)
    exact = exact_image(quiet, image.truth(phase).projection)
    assert np.abs(frame - exact).max() < 0.5 + 1e-4 * 227 + 0.01


def test_the_motion_between_rendered_points_is_right_to_a_twentieth_of_sigma() -> None:
    image = MovingImage(FULL, 2.0, seed=1)
    for phase in (0.31, 1.23, 4.07):
        planes, weights = image._nearest(phase)
        poses = [image.truth(2 * math.pi * k / image._points) for k in planes]
        truth = image.truth(phase)
        for name in ("x_um", "y_um"):
            mean = sum(w * getattr(p, name) for w, p in zip(weights, poses, strict=True))
            assert mean == pytest.approx(getattr(truth, name), abs=2e-5)  # sigma is 4e-4


@pytest.mark.parametrize(("light", "gain"), [(0.8, 1.0), (0.3, 1.0), (0.4, 2.0)])
def test_noise_follows_the_law_of_the_sensor(light: float, gain: float) -> None:
    image = MovingImage(SMALL, 0.0, seed=5)
    frames = np.array([image.frame(0.0, light * gain, gain, k) for k in range(300)], float)
    mean, variance = frames.mean(0), frames.var(0, ddof=1)
    a, b = SMALL.noise_law
    expected = gain**2 * a + gain * b * mean + 1 / 12
    for low, high in [(0, 60), (60, 140), (140, 256)]:
        chosen = (mean >= low) & (mean < high)
        if chosen.sum() < 500:
            continue
        ratio = variance[chosen].mean() / expected[chosen].mean()
        sigma = math.sqrt(2 / 299 / chosen.sum())
        # Rounding adds 1/12 only on the average over where a level lies between whole ones.
        assert ratio == pytest.approx(1, abs=5 * sigma + 0.005)


def test_noise_of_frames_and_of_neighbours_is_independent() -> None:
    image = MovingImage(SMALL, 0.0, seed=7)
    frames = np.array([image.frame(0.0, 0.7, 1.0, k) for k in range(100)], float)
    noise = (frames - frames.mean(0)) / frames.std(0)
    n = noise[0].size
    between = [float((noise[k] * noise[k + 1]).mean()) for k in range(99)]
    assert np.std(between) == pytest.approx(1 / math.sqrt(n), rel=0.35)
    for neighbour in (noise[:, :, 1:] * noise[:, :, :-1], noise[:, 1:] * noise[:, :-1]):
        assert abs(neighbour.mean()) < 6 / math.sqrt(n * 99)


def test_tracking_noise_is_at_the_bound(moving: MovingImage) -> None:
    tracker, n = Tracker(FULL), 400
    pulls = []
    for k in range(n):
        phase = 2 * math.pi * 0.3 * k / 275
        pose, truth = tracker.update(moving.frame(phase, 1.0, 1.0, k), k / 275), moving.truth(phase)
        pulls.append(
            [
                (pose.x_um - truth.x_um) / pose.sigma_x_um,
                (pose.y_um - truth.y_um) / pose.sigma_y_um,
                (pose.scale - truth.scale) / pose.sigma_scale,
                (pose.theta_rad - truth.theta_rad) / pose.sigma_theta_rad,
            ]
        )
    deviations = np.array(pulls)
    assert np.abs(deviations.mean(0)).max() < 5 / math.sqrt(n)
    assert deviations.std(0) == pytest.approx(1, abs=5 / math.sqrt(2 * n))
    for column in deviations.T:
        assert abs(np.corrcoef(column[:-1], column[1:])[0, 1]) < 5 / math.sqrt(n)


def test_frames_are_the_same_for_the_same_seed_alone() -> None:
    first, again, other = (MovingImage(SMALL, 1.0, seed=seed) for seed in (4, 4, 5))
    one = first.frame(1.0, 1.0, 1.0, 12)
    assert (one == again.frame(1.0, 1.0, 1.0, 12)).all()
    assert (one != other.frame(1.0, 1.0, 1.0, 12)).any()
    assert (one != first.frame(1.0, 1.0, 1.0, 13)).any()


def test_sixteen_bits_are_not_cut_to_eight() -> None:
    deep = load_system(
        SMALL, ["sensor.bit_depth=12", "sensor.dark_level=400", "sensor.light_level=4000"]
    )
    camera = still(deep)
    (frame,) = read(camera, 1)
    assert frame.image.dtype == np.uint16 and 3000 < frame.image.max() <= 4095
    assert camera.settings.pixel_format == "Mono12"


# ------------------------------------------------------------------------------------------ truth


def test_truth_is_what_the_analysis_finds() -> None:
    camera = SimulatedCamera(FULL, frame_rate_hz=20.0, motion_hz=1.0, seed=2)
    camera.open()
    try:
        frames = read(camera, 4)
        for frame in frames:
            pose = analyse(frame.image, FULL)
            x_um, y_um, scale, theta_rad = camera.truth(frame.number)
            assert abs(pose.x_um - x_um) < 5 * pose.sigma_x_um
            assert abs(pose.y_um - y_um) < 5 * pose.sigma_y_um
            assert abs(pose.scale - scale) < 5 * pose.sigma_scale
            assert abs(pose.theta_rad - theta_rad) < 5 * pose.sigma_theta_rad
            assert camera.truth_at(frame.device_time_s) == camera.truth(frame.number)
        assert np.hypot(*np.subtract(camera.truth(1)[:2], camera.truth(4)[:2])) > 1
    finally:
        camera.close()


def test_the_motion_does_not_jump_when_the_rate_changes() -> None:
    camera = SimulatedCamera(SMALL, frame_rate_hz=100.0, motion_hz=0.5)
    camera.open()
    frames = read(camera, 5)
    camera.change(CameraSettings(frame_rate_hz=50.0))
    frames += read(camera, 10)
    steps_s = np.diff([frame.device_time_s for frame in frames])
    assert set(np.round(steps_s, 9)) == {0.01, 0.02}
    places = np.array([camera.truth(frame.number)[:2] for frame in frames])
    speed = np.hypot(*np.diff(places, axis=0).T) / steps_s
    assert speed == pytest.approx(2 * math.pi * 0.5 * 2.0, rel=0.01)
    camera.close()


def test_numbers_wrap_and_truth_knows() -> None:
    camera = SimulatedCamera(
        SMALL, frame_rate_hz=200.0, motion_hz=2.0, first_number=9, number_wraps_at=10
    )
    camera.open()
    frames = read(camera, 15)
    numbers = [frame.number for frame in frames]
    assert numbers == [9, 10, *range(1, 11), 1, 2, 3]
    for frame in frames[-10:]:
        assert camera.truth(frame.number) == camera.truth_at(frame.device_time_s)
    with pytest.raises(ValueError, match="has not been read"):
        camera.truth(11)
    camera.close()


# ------------------------------------------------------------------------------------------- pace


def test_frames_come_at_the_frame_rate() -> None:
    camera = SimulatedCamera(SMALL)  # 275 Hz
    begun_s = time.perf_counter()
    camera.open()
    frames = read(camera, 200)
    camera.close()
    numbers = np.array([frame.number for frame in frames])
    device_s = np.array([frame.device_time_s for frame in frames])
    received_s = np.array([frame.received_s for frame in frames])
    assert numbers[0] == 1
    np.testing.assert_allclose(device_s - device_s[0], (numbers - 1) / 275)
    # A computer that stands still for longer than the buffers last loses frames.
    assert numbers[-1] - 200 == camera.counters()["underruns"]
    # No frame comes before it is due, and the usual one comes then.
    late_s = received_s - begun_s - (device_s - device_s[0])
    assert late_s.min() >= 0 and np.median(late_s) - late_s.min() < 0.02
    assert abs(frames[0].host_time_s - time.time()) < 60
    assert device_s[0] > 0


def test_a_frame_is_made_in_a_third_of_its_time(moving: MovingImage) -> None:
    moving.prepare(0.0, 60.0)
    shortest_s = math.inf
    for _ in range(5):
        begun_s = time.thread_time()
        for k in range(40):
            moving.frame(0.1 * k, 1.0, 1.0, k)
        shortest_s = min(shortest_s, (time.thread_time() - begun_s) / 40)
    assert shortest_s < 0.3 / 275


def test_a_wide_motion_opens_quickly_all_the_same() -> None:
    """Points of the loop that are not rendered in time are when a frame needs them."""
    image = MovingImage(SMALL, 60.0, seed=1)
    begun_s = time.perf_counter()
    image.prepare(1.0, 0.0)
    assert time.perf_counter() - begun_s < 1
    assert image._ready.sum() < image._points / 2
    late = image.frame(4.0, 1.0, 1.0, 0)
    image.prepare(1.0, 60.0)
    assert image._ready.all()
    assert (image.frame(4.0, 1.0, 1.0, 0) == late).all()


def test_what_is_not_read_in_time_is_lost_whole() -> None:
    camera = SimulatedCamera(SMALL, frame_rate_hz=1000.0)
    camera.open()
    (before,) = read(camera, 1)
    time.sleep(0.3)
    after = read(camera, 2)
    gap = after[0].number - before.number - 1
    assert gap >= 0.3 * 1000 - 60
    assert camera.counters()["underruns"] >= gap
    assert after[1].number == after[0].number + 1
    camera.close()


def test_a_reader_is_told_when_nothing_came() -> None:
    camera = SimulatedCamera(SMALL, frame_rate_hz=1.0)
    camera.open()
    read(camera, 1)
    begun_s = time.perf_counter()
    assert camera.read(0.05) is None
    assert 0.04 < time.perf_counter() - begun_s < 0.5
    camera.close()


# ------------------------------------------------------------------------------- settings and light


def test_exposure_gain_and_light_are_obeyed() -> None:
    camera = still(exposure_us=1000.0)
    dark, light = SMALL.sensor.dark_level, SMALL.sensor.light_level
    nominal_us = 0.5e6 / 275

    def settled() -> float:
        """Level of the brightest fields, once frames with new settings have come."""
        return float(np.percentile(read(camera, 3)[-1].image, 95))

    at_first = settled()
    assert at_first == pytest.approx(light * 1000 / nominal_us, rel=0.05)
    told = camera.change(CameraSettings(exposure_us=500.0))
    assert told.exposure_us == 500.0
    assert settled() == pytest.approx(at_first / 2, rel=0.05)
    camera.change(CameraSettings(gain_db=6.0206))
    assert settled() == pytest.approx(at_first, rel=0.05)
    camera.light = 1.5
    assert settled() == pytest.approx(1.5 * at_first, rel=0.05)
    frame = read(camera, 1)[0]
    assert (frame.exposure_us, frame.gain_db) == (500.0, 6.0206)
    camera.light = 10
    settled()
    overexposed = read(camera, 1)[0].image
    assert (overexposed == 255).mean() > 0.3 and overexposed.min() < 3 * dark * 10
    camera.light = 0
    settled()
    assert read(camera, 1)[0].image.max() < 6
    camera.close()


def test_settings_that_change_for_ever_take_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rasnik.cameras.simulated._REMEMBERED", 3)
    camera = SimulatedCamera(SMALL, frame_rate_hz=100.0)
    camera.open()
    for k in range(6):
        (frame,) = read(camera, 1)
        camera.change(CameraSettings(frame_rate_hz=100.0 + k))
    assert len(camera._stretches) == 3
    assert camera.truth(frame.number) == camera.truth_at(frame.device_time_s)
    with pytest.raises(ValueError, match="frame 1 has not been read, or too long ago"):
        camera.truth(1)
    camera.close()


def test_frames_that_were_due_keep_the_exposure_they_were_taken_with() -> None:
    camera = still(exposure_us=1000.0)
    read(camera, 1)
    time.sleep(0.1)
    camera.change(CameraSettings(exposure_us=400.0))
    exposures = [frame.exposure_us for frame in read(camera, 20)]
    assert exposures[0] == 1000.0 and exposures[-1] == 400.0
    assert exposures == sorted(exposures, reverse=True)
    camera.close()


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (CameraSettings(exposure_us=20_000.0), "exposure cannot be 20000 us; it can be 1 to 10000"),
        (CameraSettings(exposure_us=float("nan")), "exposure cannot be nan"),
        (CameraSettings(gain_db=40.0), "gain cannot be 40 dB; it can be 0 to 24 dB"),
        (CameraSettings(frame_rate_hz=1e6), "frame rate cannot be 1e\\+06 Hz"),
        (CameraSettings(frame_rate_hz=400.0, exposure_us=5000.0), "it can be 1 to 2500 us"),
        (CameraSettings(pixel_format="Mono12"), "has only Mono8"),
        (CameraSettings(region=(0, 0, 8, 8)), "has only \\(0, 0, 240, 200\\)"),
        (CameraSettings(trigger="Line0"), "has only free"),
        (CameraSettings(packet_bytes=1500), "has none"),
    ],
)
def test_what_cannot_be_set_is_refused_with_the_range(
    settings: CameraSettings, sentence: str
) -> None:
    camera = still()
    before = camera.settings
    with pytest.raises(SettingRefusedError, match=sentence):
        camera.change(settings)
    assert camera.settings == before
    read(camera, 1)
    camera.close()
    with pytest.raises(SettingRefusedError):
        SimulatedCamera(SMALL, settings=replace(settings, exposure_us=1e9)).open()


def test_what_cannot_be_simulated_is_said() -> None:
    silent = load_system(SMALL, {"sensor.noise_a": None, "sensor.noise_b": None})
    with pytest.raises(SettingRefusedError, match="noise of system solidras is not known"):
        SimulatedCamera(silent).open()
    with pytest.raises(SettingRefusedError, match="give motion_um of .* at most"):
        SimulatedCamera(FULL, motion_um=5000.0).open()
    with pytest.raises(ValueError, match="loss is a probability"):
        SimulatedCamera(SMALL, loss=1.5)
    with pytest.raises(ValueError, match="light must be"):
        SimulatedCamera(SMALL).light = -1


# ------------------------------------------------------------------------------------------ faults


def test_a_lost_camera_says_so_and_comes_back() -> None:
    camera = still()
    before = read(camera, 3)[-1]
    threading.Timer(0.05, camera.fail, (0.2,)).start()
    with pytest.raises(CameraLostError, match="does not answer"):
        while True:
            camera.read(1.0)
    with pytest.raises(CameraLostError):
        camera.read(1.0)
    camera.close()
    with pytest.raises(CameraMissingError, match="is not there"):
        camera.open()
    time.sleep(0.25)
    camera.open()
    (after,) = read(camera, 1)
    assert after.number == 1 and after.device_time_s > before.device_time_s + 0.2
    camera.close()


def test_a_changed_exposure_is_in_force_after_reconnection() -> None:
    camera = still()
    camera.change(CameraSettings(exposure_us=321.0))
    camera.fail()
    camera.close()
    camera.open()
    assert read(camera, 1)[0].exposure_us == 321.0
    camera.close()


def test_reading_ends_when_the_camera_is_closed() -> None:
    camera = SimulatedCamera(SMALL, frame_rate_hz=0.1)
    camera.open()
    read(camera, 1)
    threading.Timer(0.05, camera.close).start()
    begun_s = time.perf_counter()
    with pytest.raises(CameraLostError, match="not open"):
        camera.read(5.0)
    assert time.perf_counter() - begun_s < 2
    camera.close()


def test_frames_get_lost_as_often_as_asked_and_always_the_same() -> None:
    def numbers() -> list[int]:
        camera = SimulatedCamera(SMALL, frame_rate_hz=500.0, motion_um=0, loss=0.2, seed=8)
        camera.open()
        seen = [frame.number for frame in read(camera, 150)]
        missing = seen[-1] - len(seen)
        counted = camera.counters()
        camera.close()
        assert missing == counted["failures"] + counted["underruns"]
        return seen if not counted["underruns"] else []

    first = numbers()
    if not first:
        pytest.skip("this machine is too busy to read 500 frames a second")
    lost = first[-1] - len(first)
    assert lost / first[-1] == pytest.approx(0.2, abs=5 * math.sqrt(0.16 / first[-1]))
    assert (numbers() or first) == first


# ----------------------------------------------------------------------------------------- opening


@dataclass(frozen=True)
class Options:
    kind: str = "simulated"
    device: str = ""
    source: list[str] = field(default_factory=list)
    pace: str = "original"
    repeat: bool = False
    motion_um: float = 1.0
    motion_hz: float = 0.5
    seed: int = 3
    settings: CameraSettings = field(default_factory=CameraSettings)


def test_cameras_of_a_station_move_apart() -> None:
    asked = CameraSettings(frame_rate_hz=860.0)
    cameras = [open_camera(Options(settings=asked), SMALL, index) for index in range(2)]
    for camera in cameras:
        assert isinstance(camera, SimulatedCamera)
        camera.open()
        read(camera, 1)
    assert cameras[0].settings.frame_rate_hz == 860.0
    places = [camera.truth_at(10.0)[:2] for camera in cameras]  # type: ignore[attr-defined]
    assert np.hypot(*np.subtract(*places)) > 0.5
    for camera in cameras:
        camera.close()


def test_an_unknown_kind_is_said() -> None:
    with pytest.raises(CameraMissingError, match="no cameras of the kind 'rascam'; there are sim"):
        open_camera(Options(kind="rascam"), SMALL)
