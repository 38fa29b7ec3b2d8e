"""Frames that are missing: by their numbers, by time, and what only looks like it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from _live_camera import PERIOD_S, camera_frame
from rasnik import Flag
from rasnik.live.losses import Losses

BLANK = np.zeros((1, 1), dtype=np.uint8)
CLOCKS_S = {"host_time_s": 1000, "device_time_s": 10, "received_s": 5}


def frame(k: float, number: int, **times: float):
    """At k periods of all clocks."""
    at = {name: start + k * PERIOD_S for name, start in CLOCKS_S.items()}
    return camera_frame(0, number, BLANK, **(at | times))


def steady(losses: Losses, count: int = 20, first: int = 1) -> int:
    """A regular stream; the number of its last frame."""
    for k in range(count):
        losses.add(frame(k, first + k))
    assert (losses.lost_in_transfer, losses.lost_by_time) == (0, 0)
    return count - 1


def test_numbers_begin_at_0_and_count_on():
    losses = Losses()
    assert [losses.add(frame(k, 65400 + k)).number for k in range(5)] == [0, 1, 2, 3, 4]
    assert losses.frames == 5


def test_numbers_wrap_and_skip_0():
    losses = Losses(65535)
    raw = [65533, 65534, 65535, 1, 2, 3]
    assert [losses.add(frame(k, n)).number for k, n in enumerate(raw)] == list(range(6))
    assert losses.lost_in_transfer == 0


@pytest.mark.parametrize("wraps_at", [None, 65535])
def test_a_gap_in_the_numbers_is_lost_in_transfer(wraps_at):
    losses = Losses(wraps_at)
    last = steady(losses, first=65535 - 25)
    # Five are lost; with a number that wraps the end of the numbers is among them.
    after = 65535 - 25 + last + 6
    if wraps_at and after > wraps_at:
        after -= wraps_at
    assert losses.add(frame(last + 6, after)).number == last + 6
    assert (losses.lost_in_transfer, losses.lost_by_time) == (5, 0)


def test_a_gap_over_the_wrap():
    losses = Losses(65535)
    last = steady(losses, first=65535 - 20)  # up to 65534
    assert losses.add(frame(last + 4, 3)).number == last + 4  # without 65535, 1 and 2
    assert (losses.lost_in_transfer, losses.lost_by_time) == (3, 0)


@pytest.mark.parametrize("missing", [1, 2, 100])
def test_a_gap_in_time_alone_is_lost_by_time(missing):
    losses = Losses(65535)
    last = steady(losses)
    arrival = losses.add(frame(last + 1 + missing, last + 2))
    assert arrival.number == last + 1 + missing
    assert (losses.lost_in_transfer, losses.lost_by_time) == (0, missing)
    assert losses.add(frame(last + 2 + missing, last + 3)).number == last + 2 + missing


def test_a_gap_in_both_is_counted_once_each():
    losses = Losses()
    last = steady(losses)
    losses.add(frame(last + 6, last + 4))  # two missing by their numbers, three more by time
    assert (losses.lost_in_transfer, losses.lost_by_time) == (2, 3)


def test_without_a_device_clock_the_host_is_asked():
    losses = Losses()
    for k in range(20):
        losses.add(frame(k, k + 1, device_time_s=math.nan))
    arrival = losses.add(frame(22, 21, device_time_s=math.nan))
    assert losses.lost_by_time == 2
    assert arrival.time_s == pytest.approx(1000 + 22 * PERIOD_S)


def test_jitter_and_a_frame_that_comes_late_are_no_losses(rng):
    losses = Losses()
    late = rng.uniform(0, 0.3, 500)
    late[200] = 0.7
    for k in range(500):
        assert losses.add(frame(k + late[k], k + 1)).number == k
    assert losses.lost_by_time == 0


def test_clocks_that_drift_are_no_losses():
    """A period that creeps by a part in 100 000 per frame, for 20 000 frames."""
    losses = Losses()
    periods = np.cumsum(1 + 1e-5 * np.arange(20_000))
    for k, at in enumerate(periods):
        losses.add(frame(float(at), k + 1))
    assert losses.lost_by_time == 0


def test_frames_thought_lost_that_come_after_all_are_taken_off():
    losses = Losses()
    last = steady(losses)
    numbers = [losses.add(frame(last + 4, last + 2)).number]  # nothing for four periods
    assert losses.lost_by_time == 3
    for k in range(3):  # then all at once
        numbers.append(losses.add(frame(last + 4 + 0.01 * (k + 1), last + 3 + k)).number)
    losses.add(frame(last + 5, last + 6))
    assert losses.lost_by_time == 0
    assert np.all(np.diff(numbers) > 0)


def test_a_new_frame_rate_is_learnt():
    losses = Losses()
    last = steady(losses, 40)
    for k in range(100):  # half as many
        losses.add(frame(last + 2 * (k + 1), last + 2 + k))
    assert losses.lost_by_time <= 9
    assert losses.period_s == pytest.approx(2 * PERIOD_S)


def test_a_new_frame_rate_that_was_asked_for_is_no_loss():
    losses = Losses()
    last = steady(losses, 40)
    losses.change_pace()
    for k in range(100):
        losses.add(frame(last + 2 * (k + 1), last + 2 + k))
    assert losses.lost_by_time == 0


def test_triggered_frames_are_not_missed_by_time():
    losses = Losses(regular=False)
    for k, at in enumerate([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 50, 51, 90]):
        assert losses.add(frame(at, k + 1)).number == k
    assert losses.lost_by_time == 0


def test_zero_device_time_is_flagged_and_counts_by_the_host():
    losses = Losses()
    last = steady(losses)
    arrival = losses.add(frame(last + 1, last + 2, device_time_s=0.0))
    assert arrival.flags == Flag.TIME_IRREGULAR
    assert arrival.time_s is None
    assert arrival.number == last + 1
    after = losses.add(frame(last + 2, last + 3))
    assert after.flags == Flag.NONE
    assert losses.lost_by_time == 0


def test_a_clock_may_begin_at_zero():
    losses = Losses()
    arrival = losses.add(frame(0, 1, device_time_s=0.0))
    assert (arrival.flags, arrival.number) == (Flag.NONE, 0)


@pytest.mark.parametrize("jump_s", [-5.0, 1e6])
def test_a_clock_that_was_set_loses_nothing(jump_s):
    losses = Losses()
    last = steady(losses)
    for k in range(1, 20):
        device_time_s = 10 + (last + k) * PERIOD_S + jump_s
        arrival = losses.add(frame(last + k, last + 1 + k, device_time_s=device_time_s))
        assert arrival.number == last + k
    assert (losses.lost_in_transfer, losses.lost_by_time) == (0, 0)


@pytest.mark.parametrize("wraps_at", [None, 65535])
@pytest.mark.parametrize("number", [1, 20])
def test_a_number_that_falls_or_repeats_is_flagged_and_not_lost(wraps_at, number):
    losses = Losses(wraps_at)
    last = steady(losses)
    arrival = losses.add(frame(last + 1, number))
    assert arrival.flags == Flag.TIME_IRREGULAR
    assert arrival.number == last + 1
    assert losses.lost_in_transfer == 0


def test_a_number_that_leaps_beyond_what_time_allows_is_a_new_count():
    losses = Losses()
    last = steady(losses)
    assert losses.add(frame(last + 1, 10**9)).number == last + 1
    assert losses.lost_in_transfer == 0


def test_after_a_reconnection_numbers_go_on_with_the_gap():
    losses = Losses(65535)
    last = steady(losses)
    losses.restart()
    # The camera was away for 50 periods; its number and clock begin anew.
    arrival = losses.add(frame(last + 50, 1, device_time_s=0.5))
    assert arrival.number == last + 50
    assert (losses.lost_in_transfer, losses.lost_by_time) == (0, 49)
    assert losses.add(frame(last + 51, 2, device_time_s=0.5 + PERIOD_S)).number == last + 51


def test_every_frame_is_accounted_for(rng):
    """Random losses of both kinds: they are counted exactly, and numbers tell the true time."""
    losses = Losses(65535)
    slot, number, in_transfer, by_time = 0, 65000, 0, 0
    for k in range(5000):
        if k > 20 and rng.random() < 0.02:
            lost = int(rng.integers(1, 4))
            in_transfer, slot, number = in_transfer + lost, slot + lost, number + lost
        if k > 20 and rng.random() < 0.02:
            skipped = int(rng.integers(1, 4))
            by_time, slot = by_time + skipped, slot + skipped
        at = slot + rng.uniform(0, 0.1)
        assert losses.add(frame(at, (number - 1) % 65535 + 1)).number == slot
        slot, number = slot + 1, number + 1
    assert (losses.lost_in_transfer, losses.lost_by_time) == (in_transfer, by_time)


@pytest.mark.parametrize("away", [False, True])
@pytest.mark.parametrize("device", [{}, {"device_time_s": math.nan}])
@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_a_time_of_day_that_is_set_loses_no_frame(step_s, device, away):
    """Also of a camera without a clock, and while it is connected again."""
    losses = Losses()
    for k in range(40):
        after = k >= 20
        if away and k == 20:
            losses.restart()
        set_to = {"host_time_s": 1000 + k * PERIOD_S + step_s * after}
        assert losses.add(frame(k, k + 1, **set_to, **device)).number == k
    assert (losses.lost_in_transfer, losses.lost_by_time) == (0, 0)
