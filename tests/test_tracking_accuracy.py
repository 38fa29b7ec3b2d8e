"""Tracked frames: at the bound, as the full fit says, without steps, and in any motion.

Short forms of `benchmarks/tracking_accuracy.py` and `benchmarks/tracking_motion.py`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.stats
from numpy.typing import NDArray

from rasnik import Tracker, analyse, bound, load_system, simulate
from rasnik.analysis.pose import PARAMETERS
from rasnik.imaging.model import expected_image
from rasnik.imaging.motion import Sine
from rasnik.imaging.projection import Projection
from rasnik.imaging.simulate import PATHS
from rasnik.instrument import System
from rasnik.performance.bound import camera_of, state_at
from rasnik.tracking.track import Track

SOLIDRAS = load_system("solidras")
POSE = (60_031.7, 70_012.3, 0.002)
# What happens by chance once in a thousand runs of a test; the seeds are fixed besides.
RARE = 1e-3


def values(source: Any) -> NDArray[np.float64]:
    """x, y, S and theta_z of a track, shape (n, 4), or of one pose or truth, shape (4,)."""
    return np.stack([getattr(source, name) for name in PARAMETERS], axis=-1)


def whitened(errors: NDArray[np.float64], covariance: NDArray[np.float64]) -> Any:
    """Errors as independent numbers, of variance 1 if the covariance is theirs."""
    return np.linalg.solve(np.linalg.cholesky(covariance), errors.T).T


@pytest.fixture(scope="module")
def still() -> tuple[list[Any], Any, Track]:
    """Noisy frames of a mask at rest, 8 bits: all of them, the truth, the track."""
    simulation = simulate(SOLIDRAS, POSE, n=500, seed=3)
    frames = [frame for frame, _ in simulation]
    track = Tracker(SOLIDRAS).run(frames)
    assert track.ok.all()
    return frames, simulation.truth[0], track


def test_noise_is_at_the_bound(still) -> None:
    _, truth, track = still
    covariance = bound(SOLIDRAS, truth, rounding=True).covariance
    unit = whitened(values(track) - values(truth), covariance)
    # 4 x 500 numbers: the ratio of all together is known to 1.6 %
    assert 0.95 < np.sqrt(np.mean(unit**2)) <= 1.05
    for ratio in np.sqrt(np.mean(unit**2, axis=0)):  # each to 3.2 %
        assert 0.9 < ratio < 1.1
    # no bias beyond what the mean of 500 frames shows by chance, some 20 pm
    bias = len(unit) * np.sum(unit.mean(axis=0) ** 2)
    assert scipy.stats.chi2.sf(bias, 4) > RARE
    # nor has one frame anything of the one before
    after = np.sum(unit[1:] * unit[:-1]) / np.sum(unit**2)
    assert abs(after) < 3.3 / math.sqrt(unit.size)


def test_stated_errors_are_those_of_the_bound(still) -> None:
    _, truth, track = still
    least = bound(SOLIDRAS, truth, rounding=True)
    assert track.sigma_x_um * 1e3 == pytest.approx(least.sigma_x_nm, rel=0.02)
    assert track.sigma_y_um * 1e3 == pytest.approx(least.sigma_y_nm, rel=0.02)
    assert track.sigma_theta_rad == pytest.approx(least.sigma_theta_rad, rel=0.02)
    assert track.sigma_scale == pytest.approx(least.sigma_scale, rel=0.02)


def test_agrees_with_the_full_fit_of_the_same_frames(still) -> None:
    frames, _, track = still
    some = slice(0, None, 20)
    fits = np.array([values(analyse(frame, SOLIDRAS)) for frame in frames[some]])
    rms_pm = 1e6 * np.sqrt(np.mean((values(track[some]) - fits)[:, :2] ** 2, axis=0))
    assert (rms_pm <= 10).all(), rms_pm


@pytest.fixture(scope="module")
def walk() -> tuple[NDArray[np.float64], list[Any]]:
    """Poses along a random walk of some 2 um, and their frames without noise and rounding."""
    rng = np.random.default_rng(5)
    steps = rng.standard_normal((26, 3)) * [0.04, 0.04, 2e-7] + [0.06, -0.04, 0.0]
    poses = POSE + np.cumsum(steps, axis=0)
    simulation = simulate(SOLIDRAS, poses, seed=1, noise=False)
    return poses, [frame.astype(np.float32) for frame, _ in simulation]


@pytest.mark.parametrize("way", ["run", "update"])
def test_no_step_along_a_walk_without_noise(way: str, walk) -> None:
    poses, frames = walk
    tracker = Tracker(SOLIDRAS)
    if way == "run":
        track = tracker.run(frames)
    else:
        track = Track.from_poses(map(tracker.update, frames))
    errors_pm = 1e6 * (values(track)[:, :2] - poses[:, :2])
    assert np.abs(np.diff(errors_pm, axis=0)).max() < 20
    assert np.abs(errors_pm).max() < 20


def model_image(system: System, projection: Projection, **_: Any) -> NDArray[np.float64]:
    """The image of the fit's model, thirty times as fast as the exact one."""
    look = state_at(system, projection).appearance
    return expected_image(system.mask, projection, look, camera_of(system)).astype(float)


@pytest.mark.parametrize(
    ("amplitude_um", "hz", "n"), [(1e-3, 10.3, 100), (1.0, 99.7, 100), (1000.0, 99.7, 20)]
)
def test_a_sine_is_followed_at_the_bound(
    amplitude_um: float, hz: float, n: int, monkeypatch
) -> None:
    monkeypatch.setitem(PATHS, "model", model_image)
    motion = Sine(hz, 0.8 * amplitude_um, 0.6 * amplitude_um, phase_rad=0.7)
    simulation = simulate(SOLIDRAS, POSE, n=n, seed=11, path="model", motion=motion)
    times = [k / 275 for k in range(n)]
    track = Tracker(SOLIDRAS).run((frame for frame, _ in simulation), times)
    assert track.ok.all()
    truth = np.array([values(t) for t in simulation.truth])
    # the bound varies by some per cent with the codes in view
    least = bound(SOLIDRAS, simulation.truth[:: n // 10], rounding=True)
    unit = whitened(values(track) - truth, least.covariance)
    assert np.abs(unit).max() < 5
    assert scipy.stats.chi2.sf(np.sum(unit**2), unit.size) > RARE
    # nothing at the frequency of the motion, twice or three times it
    phase = 2 * np.pi * hz * np.array(times)[:, None] * [1, 2, 3]
    basis = np.linalg.qr(np.hstack([np.ones((n, 1)), np.cos(phase), np.sin(phase)]))[0]
    lines = basis[:, 1:].T @ unit
    assert scipy.stats.chi2.sf(np.sum(lines**2), lines.size) > RARE
