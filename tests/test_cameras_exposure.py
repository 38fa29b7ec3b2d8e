"""The exposure is kept where the brightest fields are just below full scale."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from rasnik import load_system, simulate
from rasnik.cameras.camera import CameraFrame
from rasnik.cameras.exposure import ExposureKeeper

PERIOD_US = 3600.0
SYSTEM = load_system("solidras", {"sensor.width_px": 120, "sensor.height_px": 96})


@cache
def pattern() -> NDArray[np.float64]:
    """Grey levels without noise; white fields are 1."""
    frame = simulate(SYSTEM, [(4000.0, 5000.0, 0.0)], seed=1, noise=False).frames[0]
    return frame / SYSTEM.sensor.light_level


class Bench:
    """A camera with a lamp: a Rasnik image, brighter with exposure and light, plus noise."""

    def __init__(self, exposure_us: float, bits: int = 8, step_us: float = 0.0) -> None:
        self.full = 2**bits - 1
        self.exposure_us, self.step_us = exposure_us, step_us
        self.light = 1.0  # white fields reach full scale at 1000 us
        self.rng = np.random.default_rng(3)
        self.number = 0

    def frame(self) -> CameraFrame:
        self.number += 1
        level = self.full * pattern() * self.light * self.exposure_us / 1000.0
        unit = self.full / 255
        noise = np.sqrt(0.26 * unit**2 + 0.011 * unit * level)
        noisy = np.rint(level + noise * self.rng.standard_normal(level.shape))
        image = np.clip(noisy, 0, self.full).astype(np.uint8 if self.full == 255 else np.uint16)
        return CameraFrame(image, self.number, 0.0, 0.0, exposure_us=self.exposure_us)

    def run(self, keeper: ExposureKeeper, looks: int) -> list[float]:
        """Exposures that were set."""
        proposals = []
        for _ in range(looks):
            proposal = keeper.propose(self.frame())
            if proposal is not None:
                proposals.append(proposal)
                steps = round(proposal / self.step_us) if self.step_us else 0
                self.exposure_us = steps * self.step_us if self.step_us else proposal
        return proposals

    def white(self) -> float:
        """Mean level of white fields over full scale."""
        return self.light * self.exposure_us / 1000.0

    def saturated(self) -> float:
        return float(np.mean(self.frame().image >= self.full))


@pytest.mark.parametrize("bits", [8, 12])
@pytest.mark.parametrize("exposure_us", [30.0, 300.0, 900.0, 1100.0, 3500.0])
def test_it_settles_just_below_full_scale_and_stays(bits: int, exposure_us: float) -> None:
    bench = Bench(exposure_us, bits)
    keeper = ExposureKeeper(bench.full, longest_us=PERIOD_US)
    bench.run(keeper, 100)
    assert 0.88 < bench.white() < 0.985
    assert bench.saturated() < 3e-3
    assert bench.run(keeper, 300) == []


def test_saturated_frames_are_answered_at_once() -> None:
    bench = Bench(3500.0)
    bench.light = 2.0
    keeper = ExposureKeeper(255)
    assert bench.run(keeper, 2) == [pytest.approx(0.35 * 3500.0)]


def test_single_frames_do_not_count() -> None:
    bench = Bench(950.0)
    keeper = ExposureKeeper(255)
    bench.run(keeper, 20)
    settled = bench.exposure_us
    for light in (0.2, 3.0):  # something passes by, a flash
        bench.light = light
        assert bench.run(keeper, 1) == []
        bench.light = 1.0
        assert bench.run(keeper, 5) == []
    assert bench.exposure_us == settled


def test_lamp_off_and_on_again() -> None:
    bench = Bench(950.0)
    keeper = ExposureKeeper(255, longest_us=PERIOD_US)
    bench.light = 0.0
    bench.run(keeper, 100)
    assert bench.exposure_us == PERIOD_US
    assert bench.run(keeper, 100) == []
    bench.light = 1.0
    bench.run(keeper, 100)
    assert 0.88 < bench.white() < 0.985


def test_limits_are_kept() -> None:
    bench = Bench(1000.0)
    bench.light = 50.0
    keeper = ExposureKeeper(255, shortest_us=100.0, longest_us=2000.0)
    assert min(bench.run(keeper, 200)) == 100.0
    bench.light = 0.1
    assert max(bench.run(keeper, 200)) == 2000.0


def test_slow_drift_is_followed_with_few_steps() -> None:
    bench = Bench(950.0)
    keeper = ExposureKeeper(255, longest_us=PERIOD_US)
    bench.run(keeper, 50)
    steps = []
    for light in np.linspace(1.0, 0.7, 400):
        bench.light = float(light)
        steps += bench.run(keeper, 2)
        assert bench.saturated() < 0.02
    assert 3 <= len(steps) <= 10
    assert all(late > early for early, late in zip(steps, steps[1:], strict=False))


def test_an_exposure_in_coarse_steps_does_not_make_it_hunt() -> None:
    """Settable to multiples of 300 us: 900 us is too little light, 1200 us too much."""
    bench = Bench(900.0, step_us=300.0)
    bench.light = 0.99
    steps = bench.run(ExposureKeeper(255), 2000)
    assert len(steps) < 15


def test_a_camera_that_does_not_obey_is_not_pestered() -> None:
    bench = Bench(300.0)
    keeper = ExposureKeeper(255)
    asked = [keeper.propose(bench.frame()) for _ in range(230)]
    assert 2 <= sum(one is not None for one in asked) <= 11


def test_without_a_known_exposure_nothing_is_proposed() -> None:
    keeper = ExposureKeeper(255)
    white = np.full((20, 20), 255, np.uint8)
    assert [keeper.propose(CameraFrame(white, k, 0.0, 0.0)) for k in range(10)] == [None] * 10


def test_wrong_limits_are_refused() -> None:
    with pytest.raises(ValueError, match="are no range"):
        ExposureKeeper(255, shortest_us=100.0, longest_us=10.0)
    with pytest.raises(ValueError, match="largest grey level"):
        ExposureKeeper(0)
