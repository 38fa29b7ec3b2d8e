"""Motion of the pose: each kind against its formula or its spectrum."""

from __future__ import annotations

import numpy as np
import pytest

from rasnik import load_system, simulate
from rasnik.imaging.motion import (
    Drift,
    Seismic,
    Sine,
    Table,
    displacements,
    make_motions,
)
from rasnik.imaging.projection import Projection

SMALL = {"sensor.width_px": 96, "sensor.height_px": 64, "sensor.frame_rate_hz": 50.0}
POSE = (41000.0, 30200.0, 0.01)
RNG = np.random.default_rng(1)


@pytest.fixture(scope="module")
def system():
    return load_system("solidras", SMALL)


def xy(simulation):
    return np.array([(t.x_um, t.y_um, t.theta_rad) for t in simulation.truth])


def test_drift_is_constant_velocity(system):
    path = xy(simulate(system, POSE, n=51, seed=1, motion=Drift(0.5, -0.25, 1e-4)))
    np.testing.assert_allclose(path[0], POSE)
    np.testing.assert_allclose(path[50], np.add(POSE, (0.5, -0.25, 1e-4)), atol=1e-9)
    np.testing.assert_allclose(np.diff(path[:, 0]), 0.01, atol=1e-9)


def test_sine_and_motions_add_up(system):
    t = np.arange(30) / 50.0
    path = xy(simulate(system, POSE, n=30, seed=1, motion=[Sine(3.0, 0.2, 0.1), Drift(1.0)]))
    np.testing.assert_allclose(path[:, 0] - POSE[0], t + 0.2 * np.sin(2 * np.pi * 3 * t), atol=1e-9)
    np.testing.assert_allclose(path[:, 1] - POSE[1], 0.1 * np.sin(2 * np.pi * 3 * t), atol=1e-9)


def test_steps_at_their_times(system):
    path = xy(simulate(system, POSE, n=16, seed=1, motion="steps:every_s=0.1,x_um=2"))
    np.testing.assert_allclose(path[:, 0] - POSE[0], 2.0 * (np.arange(16) // 5), atol=1e-9)


def test_seismic_noise_has_its_spectrum():
    rate, n = 100.0, 8192
    quake = Seismic(asd_um_rthz=0.02, corner_hz=5.0)
    spectra = []
    for seed in range(12):
        x = displacements([quake], n, rate, np.random.default_rng(seed))[:, :2]
        window = np.hanning(n)[:, None]
        power = np.abs(np.fft.rfft(x * window, axis=0)) ** 2 * 2 / (rate * (window**2).sum())
        spectra.append(power.mean(axis=1))
    f, asd = np.fft.rfftfreq(n, 1 / rate), np.sqrt(np.mean(spectra, axis=0))
    for centre in (0.5, 2.0, 5.0, 10.0):
        band = (f > 0.9 * centre) & (f < 1.1 * centre)
        assert asd[band].mean() == pytest.approx(0.02 / (1 + (centre / 5) ** 2), rel=0.08)


def test_table_is_interpolated(system, tmp_path):
    file = tmp_path / "motion.csv"
    file.write_text("# recorded\nt_s,y_um\n0,0\n0.1,1\n0.2,-1\n", encoding="utf-8")
    path = xy(simulate(system, POSE, n=11, seed=1, motion=f"table:{file}"))
    np.testing.assert_allclose(
        path[:, 1] - POSE[1], [0, 0.2, 0.4, 0.6, 0.8, 1, 0.6, 0.2, -0.2, -0.6, -1], atol=1e-9
    )
    np.testing.assert_allclose(path[:, 0], POSE[0])


def test_every_frame_shows_its_own_pose(system):
    simulation = simulate(system, POSE, n=4, seed=1, noise=False, motion=Drift(300.0, 100.0, 0.5))
    for k in (0, 3):
        t = k / 50
        place = Projection.from_pose(
            POSE[0] + 300 * t, POSE[1] + 100 * t, 1.0, POSE[2] + 0.5 * t, 4
        )
        np.testing.assert_allclose(simulation.truth[k].projection.matrix, place.matrix, atol=1e-9)
        np.testing.assert_allclose(
            simulation.frames[k],
            simulate(system, [place], seed=1, noise=False).frames[0],
            atol=1e-6,
        )


def test_motion_is_seeded_and_leaves_the_noise_alone(system):
    quake = Seismic(0.1, 1.0)
    a, b, c = (simulate(system, POSE, n=5, seed=s, motion=quake) for s in (1, 1, 2))
    np.testing.assert_array_equal(a.frames, b.frames)
    assert (xy(a) != xy(c)).any()
    still = simulate(system, POSE, n=5, seed=1)
    resting = simulate(system, POSE, n=5, seed=1, motion=Drift())
    np.testing.assert_array_equal(still.frames, resting.frames)


def test_two_starts_and_a_random_one(system):
    two = simulate(system, [POSE, (7000, 8000)], n=3, seed=1, motion=Drift(50.0))
    np.testing.assert_allclose(xy(two)[:, 0], [41000, 41001, 41002, 7000, 7001, 7002])
    free = simulate(system, n=3, seed=1, motion=Drift(50.0))
    assert len(free) == 3
    np.testing.assert_allclose(np.diff(xy(free)[:, 0]), 1.0)


@pytest.mark.parametrize(
    ("motion", "sentence"),
    [
        ("drif:x_um_per_s=1", "no motion 'drif'; did you mean drift"),
        ("drift:x_um=1", "no parameter 'x_um', but x_um_per_s"),
        ("sine:hz=fast", "hz must be a number, not 'fast'"),
        ("sine:hz=inf", "hz must be finite"),
        ("steps:every_s=0", "every_s must be positive"),
        ("seismic:corner_hz=0", "corner_hz positive"),
        ("table:nowhere.csv", "nowhere.csv cannot be read"),
        (Table([0, 0.01], [0, 1]), "the table covers 0..0.01 s, but the frames 0..0.18 s"),
        (Drift(1e9), "frame 1 of the motion: .* is not on the mask"),
    ],
)
def test_what_is_refused(system, motion, sentence):
    with pytest.raises(ValueError, match=sentence):
        simulate(system, POSE, n=10, seed=1, motion=motion)


def test_tables_that_make_no_sense(tmp_path):
    for columns, sentence in (
        (([0, 0], [1, 2]), "rising"),
        (([0, 1], [1, 2, 3]), "3 values, but there are 2 times"),
        (([0, 1], [1, np.nan]), "not finite"),
    ):
        with pytest.raises(ValueError, match=sentence):
            Table(*columns)
    for text, sentence in (
        ("x,y\n1,2\n", "must name its columns"),
        ("t_s,x_um\n0,a\n", "not a number"),
        ("t_s,x_um\n0,1\n1\n", "not a number"),
    ):
        file = tmp_path / "t.csv"
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=sentence):
            Table.read(file)


def test_no_motion():
    with pytest.raises(TypeError, match="is not a motion"):
        make_motions(3)
    with pytest.raises(TypeError, match="is not a motion"):
        make_motions([3])
    system = load_system("solidras", {**SMALL, "sensor.frame_rate_hz": None})
    with pytest.raises(ValueError, match="frame rate of system solidras is not known"):
        simulate(system, POSE, n=3, motion=Drift(1.0))
