"""A channel: from a camera to its poses, through everything that may go wrong."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from _live_camera import (
    IMAGES,
    PERIOD_S,
    SIZE,
    X_UM,
    Y_UM,
    ScriptedCamera,
    camera_frame,
    make_channel,
    wait_for,
)
from rasnik import Flag, load_system
from rasnik.cameras.camera import (
    CameraLostError,
    CameraMissingError,
    SettingRefusedError,
    SourceEndedError,
)
from rasnik.cameras.simulated import SimulatedCamera
from rasnik.io import read_track
from rasnik.live.channel import Channel
from rasnik.live.losses import Losses
from rasnik.live.ring import FrameRing, Waiting
from rasnik.live.service import Station
from rasnik.live.station import StationConfig
from rasnik.recording.sample import Sample

OVER = SourceEndedError("the recording is at its end.")


class Gate:
    """A sink that is slow: it waits until it is opened."""

    def __init__(self) -> None:
        self.open = threading.Event()
        self.reached = threading.Event()
        self.samples: list[Sample] = []

    def add(self, sample: Sample) -> None:
        self.samples.append(sample)
        self.reached.set()
        assert self.open.wait(20)


class Failing:
    def __init__(self) -> None:
        self.calls = 0

    def add(self, sample: Sample) -> None:
        self.calls += 1
        raise RuntimeError("no room on the shelf")


class Collecting:
    def __init__(self) -> None:
        self.samples: list[Sample] = []

    def add(self, sample: Sample) -> None:
        self.samples.append(sample)


@pytest.fixture
def channels():
    """Channels that are stopped whatever happens."""
    made: list[Channel] = []
    yield made
    for channel in made:
        channel.stop()


def run(channel: Channel, channels: list[Channel]) -> Channel:
    channels.append(channel)
    channel.start()
    return channel


def recorded(folder: Path) -> np.ndarray:
    files = sorted((folder / "one").glob("*.h5"))
    return np.concatenate([read_track(file).frame for file in files])


def test_from_camera_to_record(tmp_path, channels):
    camera = ScriptedCamera([camera_frame(k) for k in range(30)])
    channel = run(make_channel(tmp_path, camera), channels)
    wait_for(lambda: channel.recent.count == 30)
    status = channel.status()
    assert (status.state, status.locked, status.message) == ("running", True, "")
    assert (status.frames, status.tracked, status.dropped) == (30, 30, 0)
    assert abs(status.x_um - X_UM) < 6 * status.sigma_x_um
    assert abs(status.y_um - Y_UM) < 6 * status.sigma_y_um
    wait_for(lambda: channel.status().exposure_us == 500.0)  # the camera tells, its frames do not
    sample = channel.latest()
    assert sample is not None
    assert sample.number == 29
    rows, _ = channel.recent.since(0)
    np.testing.assert_array_equal(rows["frame"], range(30))
    np.testing.assert_allclose(rows["device_time_s"], 10 + PERIOD_S * np.arange(30))
    assert (rows["latency_s"] > 0).all()
    channel.stop()
    assert channel.status().state == "stopped"
    np.testing.assert_array_equal(recorded(tmp_path), range(30))
    assert not [t for t in threading.enumerate() if t.name.startswith("one ")]


def test_stopping_before_the_start_is_harmless(tmp_path):
    channel = make_channel(tmp_path, ScriptedCamera())
    channel.stop()
    channel.stop()
    assert channel.status().state == "stopped"


def test_losses_leave_numbers_out_and_are_flagged(tmp_path, channels):
    frames = [camera_frame(k) for k in range(12)] + [camera_frame(k) for k in range(15, 20)]
    channel = run(make_channel(tmp_path, ScriptedCamera(frames)), channels)
    wait_for(lambda: channel.recent.count == 17)
    assert channel.status().lost_in_transfer == 3
    rows, _ = channel.recent.since(0)
    np.testing.assert_array_equal(rows["frame"], [*range(12), *range(15, 20)])
    flagged = (rows["flags"] & int(Flag.FRAMES_LOST)) > 0
    np.testing.assert_array_equal(rows["frame"][flagged], [15])


def test_a_tracker_that_is_slow_drops_whole_frames_and_counts_them(tmp_path, channels):
    camera = ScriptedCamera()
    channel = make_channel(tmp_path, camera, buffer_bytes=10 * IMAGES[0].nbytes)
    gate = Gate()
    channel.add_sink(gate)
    run(channel, channels)
    camera.show(camera_frame(0))
    assert gate.reached.wait(10)  # the first is worked on; ten can wait
    camera.show(*(camera_frame(k) for k in range(1, 41)))
    wait_for(lambda: channel.status().frames == 41)
    assert channel.status().dropped == 30
    gate.open.set()
    wait_for(lambda: channel.recent.count == 11)
    numbers = [sample.number for sample in gate.samples]
    assert numbers == [0, *range(31, 41)]  # the oldest made room
    assert gate.samples[1].pose.flags & Flag.FRAMES_LOST
    status = channel.status()
    assert status.frames == channel.recent.count + status.dropped
    channel.stop()
    assert recorded(tmp_path).tolist() == numbers


def test_a_recording_waits_for_a_slow_tracker(tmp_path, channels):
    frames = [camera_frame(k) for k in range(40)]
    camera = ScriptedCamera([*frames, OVER], live=False)
    channel = make_channel(tmp_path, camera, buffer_bytes=10 * IMAGES[0].nbytes)
    gate = Gate()
    channel.add_sink(gate)
    run(channel, channels)
    assert gate.reached.wait(10)
    wait_for(lambda: channel.status().frames >= 11)
    assert channel.status().state != "ended"
    gate.open.set()
    wait_for(lambda: channel.status().state == "ended")
    status = channel.status()
    assert (status.frames, status.tracked, status.dropped) == (40, 40, 0)
    assert [sample.number for sample in gate.samples] == list(range(40))
    assert not status.locked


def test_a_sink_that_fails_is_told_of_and_harms_no_other(tmp_path, channels):
    camera = ScriptedCamera([camera_frame(k) for k in range(5)])
    channel = make_channel(tmp_path, camera)
    failing, collecting = Failing(), Collecting()
    channel.add_sink(failing)
    channel.add_sink(collecting)
    run(channel, channels)
    wait_for(lambda: len(collecting.samples) == 5)
    assert failing.calls == 5
    status = channel.status()
    assert status.message == "Failing failed: unexpected RuntimeError: no room on the shelf."
    assert (status.state, status.tracked) == ("running", 5)


def test_a_camera_that_is_lost_comes_back_by_itself(tmp_path, channels):
    lost = CameraLostError("the cable was pulled.")
    began_s = time.perf_counter()
    frames = [camera_frame(k, received_s=began_s + k * PERIOD_S) for k in range(20)]
    camera = ScriptedCamera([*frames, lost])
    channel = run(make_channel(tmp_path, camera), channels)
    wait_for(lambda: channel.status().reconnects == 1)
    # It counts anew, and so does its clock.
    back = [
        camera_frame(
            49 + k, k + 1, device_time_s=0.1 + k * PERIOD_S,
            received_s=began_s + (49 + k) * PERIOD_S,
        )
        for k in range(10)
    ]  # fmt: skip
    camera.show(*back)
    wait_for(lambda: channel.recent.count == 30)
    status = channel.status()
    assert (status.state, status.message, status.reconnects) == ("running", "", 1)
    rows, _ = channel.recent.since(0)
    np.testing.assert_array_equal(rows["frame"], [*range(20), *range(49, 59)])
    assert rows["flags"][20] & int(Flag.FRAMES_LOST)
    assert status.lost_by_time == 29
    assert (camera.opened, camera.closed) == (2, 1)


def test_while_a_camera_is_away_the_channel_says_so(tmp_path, channels):
    gone = [CameraLostError("scripted does not answer."), CameraMissingError("it is not there.")]
    camera = ScriptedCamera(refusals=[*gone, *gone[1:] * 50])
    channel = run(make_channel(tmp_path, camera), channels)
    wait_for(lambda: "not there" in channel.status().message)
    assert channel.status().state == "lost"
    channel.stop()


def test_an_error_nobody_foresaw_is_like_a_loss(tmp_path, channels):
    script = [camera_frame(0), ZeroDivisionError("odd"), *(camera_frame(k) for k in range(1, 4))]
    channel = run(make_channel(tmp_path, ScriptedCamera(script)), channels)
    wait_for(lambda: channel.recent.count == 4)
    assert channel.status().reconnects == 1


def test_settings_refused_at_the_beginning_end_the_channel(tmp_path, channels):
    refusal = SettingRefusedError("gain_db must be 0 to 24, not 99.")
    channel = run(make_channel(tmp_path, ScriptedCamera(refusals=[refusal])), channels)
    wait_for(lambda: channel.status().state == "failed")
    assert channel.status().message == "gain_db must be 0 to 24, not 99."


def test_frames_of_another_size_say_what_to_change(tmp_path, channels):
    wrong = camera_frame(0, image=np.zeros((50, 60), dtype=np.uint8))
    channel = run(make_channel(tmp_path, ScriptedCamera([wrong])), channels)
    wait_for(lambda: channel.recent.count == 1)
    status = channel.status()
    assert "60 x 50 pixels, the system 240 x 200" in status.message
    assert "no_image" in status.flags
    assert not status.locked


def test_a_frame_that_breaks_the_tracker_is_a_row_without_position(tmp_path, channels, monkeypatch):
    camera = ScriptedCamera([camera_frame(0)])
    channel = make_channel(tmp_path, camera)
    run(channel, channels)
    wait_for(lambda: channel.recent.count == 1)
    monkeypatch.setattr(channel._tracker, "update", lambda *_: 1 / 0)
    camera.show(camera_frame(1), camera_frame(2))
    wait_for(lambda: channel.recent.count == 3)
    rows, _ = channel.recent.since(0)
    np.testing.assert_array_equal(np.isfinite(rows["x_um"]), [True, False, True])


def test_zero_is_the_mean_of_the_last_second(tmp_path, channels):
    camera = ScriptedCamera([camera_frame(k) for k in range(20)])
    channel = run(make_channel(tmp_path, camera), channels)
    wait_for(lambda: channel.recent.count == 20)
    channel.zero()
    rows, _ = channel.recent.since(0)
    status = channel.status()
    assert status.zero_um == pytest.approx((rows["x_um"].mean(), rows["y_um"].mean()), abs=1e-9)
    assert status.zero_scale == pytest.approx(rows["scale"].mean(), abs=1e-12)
    channel.clear_zero()
    assert channel.status().zero_um == (0.0, 0.0)


def test_without_a_position_there_is_no_zero_and_without_a_frame_no_snapshot(tmp_path):
    channel = make_channel(tmp_path, ScriptedCamera())
    with pytest.raises(ValueError, match="one has no position now"):
        channel.zero()
    with pytest.raises(ValueError, match="no frame yet"):
        channel.snapshot()
    channel.stop()


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_a_snapshot_is_the_frame_and_its_pose(tmp_path, channels, kind):
    camera = ScriptedCamera([camera_frame(0, image=IMAGES[0].astype(kind))])
    channel = run(make_channel(tmp_path, camera), channels)
    wait_for(lambda: channel.latest() is not None)
    first, second = channel.snapshot(), channel.snapshot()
    assert first != second
    assert first.suffix == {"uint8": ".png", "uint16": ".tif"}[kind]
    with Image.open(first) as image:
        np.testing.assert_array_equal(np.asarray(image), IMAGES[0])
    about = json.loads(first.with_suffix(".json").read_text(encoding="utf-8"))
    assert about["x_um"] == channel.latest().pose.x_um
    assert about["camera_number"] == 1
    assert about["exposure_us"] is None


def test_an_alarm_has_a_sentence_and_ends(tmp_path, channels):
    alarms = {"x_um": [X_UM - 1, X_UM + 1], "lost_percent": None, "unlocked_s": None}
    camera = ScriptedCamera([camera_frame(k) for k in range(5)])
    channel = run(make_channel(tmp_path, camera, alarms=alarms), channels)
    wait_for(lambda: channel.recent.count == 5)
    channel.zero()  # the position is now near zero, far below the limits
    camera.show(camera_frame(5))
    wait_for(lambda: channel.status().alarms)
    (sentence,) = channel.status().alarms
    assert sentence.startswith("x is ")
    assert sentence.endswith(f", below {X_UM - 1:.6g} um")
    channel.clear_zero()

    def shown_and_over() -> bool:
        camera.show(camera_frame(channel.status().frames))
        return not channel.status().alarms

    wait_for(shown_and_over)


def test_exposure_is_set_and_recording_starts_and_stops(tmp_path, channels):
    camera = ScriptedCamera([camera_frame(0)])
    channel = make_channel(tmp_path, camera, recording={"enabled": False})
    run(channel, channels)
    wait_for(lambda: channel.recent.count == 1)
    assert not channel.status().recording
    channel.start_recording()
    camera.show(camera_frame(1))
    wait_for(lambda: channel.recent.count == 2)
    channel.stop_recording()
    assert not channel.status().recording
    assert recorded(tmp_path).tolist() == [1]
    channel.set_exposure(250.0)
    wait_for(lambda: channel.status().exposure_us == 250.0)


def test_the_exposure_is_kept_just_below_full_scale(tmp_path, channels):
    """Ten times too much light at first; the simulated camera obeys."""
    system = load_system("solidras", SIZE)
    nominal_us = SimulatedCamera(system, frame_rate_hz=100).settings.exposure_us
    assert nominal_us is not None
    camera = SimulatedCamera(system, frame_rate_hz=100, motion_um=0.1, light=10.0)
    channel = make_channel(tmp_path, camera, recording={"enabled": False})
    channel.keep_exposure(True)
    run(channel, channels)
    assert channel.keeps_exposure
    wait_for(lambda: 0.92 * 255 < channel.status().light_level < 0.99 * 255, 30)
    wait_for(lambda: channel.status().locked)
    assert channel.status().exposure_us < 0.2 * nominal_us
    channel.set_exposure(nominal_us / 20)  # by hand: it stays
    wait_for(lambda: channel.status().exposure_us == pytest.approx(nominal_us / 20))
    assert not channel.keeps_exposure


def test_two_channels_of_a_station_and_one_that_is_lost(tmp_path):
    config = StationConfig.model_validate(
        {
            "folder": tmp_path,
            "channel": [
                {
                    "name": name,
                    "camera": {"frame_rate_hz": 40},
                    "recording": {"enabled": False},
                }
                for name in ("one", "two")
            ],
        }
    )
    with Station(config) as station:
        one, two = station.channels.values()
        wait_for(lambda: one.recent.count > 3 and two.recent.count > 3, 30)
        camera = one._camera
        assert isinstance(camera, SimulatedCamera)
        camera.fail(away_s=0.4)
        wait_for(lambda: one.status().state == "lost")
        seen = one.recent.count
        wait_for(lambda: one.recent.count > seen and one.status().state == "running", 5)
        assert one.status().reconnects == 1
        assert two.status().reconnects == two.status().lost_in_transfer == 0
        assert one.latest().pose.x_um != two.latest().pose.x_um
    assert {channel.status().state for channel in station.channels.values()} == {"stopped"}
    alive = [t.name for t in threading.enumerate() if t.name.startswith(("one", "two"))]
    assert not alive


def test_a_ring_gives_frames_back_in_their_order():
    losses, ring = Losses(), FrameRing(1)
    for k in range(12):
        frame = camera_frame(k)
        ring.put(Waiting(frame, losses.add(frame)))
    assert (len(ring), ring.dropped) == (8, 4)  # eight find room, however large
    ring.close()
    numbers = []
    while (waiting := ring.get(0)) is not None:
        numbers.append(waiting.arrival.number)
    assert numbers == list(range(4, 12))
    assert ring.finished


def test_a_disk_that_hangs_at_a_snapshot_does_not_hold_up_the_end(tmp_path, monkeypatch):
    camera = ScriptedCamera([camera_frame(0)])
    channel = make_channel(tmp_path, camera)
    channel.start()
    wait_for(lambda: channel.recent.count == 1)
    began, goes_on = threading.Event(), threading.Event()

    def hang(*_):
        began.set()
        goes_on.wait(60)

    monkeypatch.setattr("rasnik.live.channel.save_snapshot", hang)
    saving = threading.Thread(target=channel.snapshot)
    saving.start()
    assert began.wait(10)
    ending = threading.Thread(target=channel.stop, daemon=True)
    ending.start()
    ending.join(30)
    ended = not ending.is_alive()
    goes_on.set()
    saving.join(10)
    ending.join(30)
    assert ended


def test_an_exposure_that_is_refused_is_kept_as_before(tmp_path, channels, monkeypatch):
    camera = ScriptedCamera([camera_frame(0)])
    channel = run(make_channel(tmp_path, camera), channels)
    channel.keep_exposure(True)
    wait_for(lambda: channel.recent.count == 1)

    def refuse(_):
        raise SettingRefusedError("the exposure can be 10 to 20 us.")

    with monkeypatch.context() as refusing:
        refusing.setattr(camera, "change", refuse)
        with pytest.raises(SettingRefusedError):
            channel.set_exposure(5.0)
    assert channel.keeps_exposure
    channel.set_exposure(15.0)
    assert not channel.keeps_exposure


def test_frames_around_a_moment_are_kept_without_a_recording(tmp_path, channels):
    camera = ScriptedCamera()
    raw = {"before_s": 10.0, "after_s": 0.0}
    channel = make_channel(tmp_path, camera, recording={"enabled": False, "raw": raw})
    with pytest.raises(ValueError, match="no frame yet to keep"):
        channel.keep_frames()
    run(channel, channels)
    camera.show(*(camera_frame(k) for k in range(5)))
    wait_for(lambda: channel.recent.count == 5)
    channel.keep_frames()
    channel.stop()
    (path,) = (tmp_path / "one" / "frames").glob("*_asked-for.h5")
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["frames"][:], [IMAGES[k % 4] for k in range(5)])
