"""Resolution by differences: Monte Carlo of the figure, its error, and what motion does to it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from rasnik import Track, Tracker, bound, load_system, simulate
from rasnik.characterisation.resolution import MOST_ORDER, difference_scatter, resolution
from rasnik.cli import app
from rasnik.io import write_track

SMALL = load_system("solidras", ["sensor.width_px=240", "sensor.height_px=180"])
SIGMA = 0.4


def track_of(x_nm: np.ndarray, system=None, **columns) -> Track:
    """A track that shows a series in x and y, with the errors of white noise elsewhere."""
    n = len(x_nm)
    ones = np.ones(n)
    values = {
        "frame": np.arange(n), "time_s": np.arange(n) / 275, "x_um": 4000 + 1e-3 * x_nm,
        "y_um": 5000 + 1e-3 * x_nm, "scale": 1 + 1e-9 * x_nm, "theta_rad": 1e-9 * x_nm,
        "sigma_x_um": 4e-4 * ones, "sigma_y_um": 4e-4 * ones, "sigma_scale": 4e-10 * ones,
        "sigma_theta_rad": 4e-10 * ones, "chi2_ndf": ones, "blur_um": 4.5 * ones,
        "dark_level": 25 * ones, "light_level": 252 * ones, "flags": 0 * ones,
    }  # fmt: skip
    metadata = {"system_toml": system.to_toml()} if system else {}
    return Track(**{**values, **columns}, metadata=metadata)


def test_every_order_and_its_error_in_repeated_runs(rng) -> None:
    runs = [
        difference_scatter(SIGMA * rng.standard_normal(400), np.arange(400)) for _ in range(600)
    ]
    for order in range(MOST_ORDER + 2):
        values = np.array([one.by_order[order] for one in runs])
        errors = np.array([one.by_order_error[order] for one in runs])
        pulls = (values - SIGMA) / errors
        # 600 runs: means of pulls to 0.04 (plus 0.05 of the skew of a root), spreads to 3 %
        assert abs(pulls.mean()) < 0.2, order
        assert pulls.std() == pytest.approx(1, abs=0.1), order
    assert np.mean([one.moved for one in runs]) < 0.03
    assert np.mean([one.order > 1 for one in runs]) < 0.01
    assert not any(one.fast_motion for one in runs[:100])


@pytest.mark.parametrize(
    ("motion", "order"),
    [
        (lambda t: 80 * t, 1),  # nm over the run: 0.04 nm a frame
        (lambda t: 8 * np.sin(2 * np.pi * 40 * t), 2),
        (lambda t: 5 * np.sin(2 * np.pi * 100 * t), 3),
    ],
)
def test_slow_motion_is_left_out_and_told(rng, motion, order) -> None:
    t = np.arange(2000) / 2000
    seen = motion(t)
    one = difference_scatter(SIGMA * rng.standard_normal(t.size) + seen, np.arange(t.size))
    assert one.moved and one.order == order
    assert one.motion == pytest.approx(seen.std(), rel=0.02)
    assert one.sigma == pytest.approx(SIGMA, abs=4 * one.sigma_error)
    assert not one.drift_left


def test_motion_that_is_too_fast_is_told(rng) -> None:
    t = np.arange(2000)
    noise = SIGMA * rng.standard_normal(t.size)
    drift = difference_scatter(noise + 5 * np.sin(2 * np.pi * t / 8), t)
    assert drift.drift_left and drift.order == MOST_ORDER
    alternating = difference_scatter(noise + 0.3 * np.sin(2 * np.pi * 0.47 * t), t)
    assert alternating.fast_motion and not alternating.drift_left


def test_first_differences_are_the_allan_deviation(rng) -> None:
    x = SIGMA * rng.standard_normal(500)
    one = difference_scatter(x, np.arange(500))
    assert one.by_order[1] == pytest.approx(np.sqrt(np.mean(np.diff(x) ** 2) / 2))


def test_gaps_failures_and_outliers(rng) -> None:
    frame = np.concatenate([np.arange(300), np.arange(1000, 1300)])
    x = SIGMA * rng.standard_normal(600)
    x[300:] += 1e5  # the mask was moved in the pause
    x[100], x[400] = np.nan, x[400] + 1e3
    found = resolution(track_of(x, frame=frame))
    one = found["x"]
    assert found.frames == 599
    assert one.outliers == 2 and one.frames == 599 - 1 - 2 - 2
    assert one.sigma == pytest.approx(SIGMA, abs=4 * one.sigma_error)
    assert one.moved and any("moved" in remark for remark in found.remarks)


def test_every_second_frame_is_no_gap(rng) -> None:
    found = difference_scatter(rng.standard_normal(100), 2 * np.arange(100))
    assert found.frames == 99


def test_too_few_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="only 3 runs of 5 successive frames"):
        resolution(track_of(np.arange(7.0)))


def test_tracked_images_lie_at_the_bound() -> None:
    frames = simulate(SMALL, (4000.0, 5000.0, 0.002), n=150, seed=4).frames
    track = Tracker(SMALL).run(frames)
    found = resolution(track, SMALL)
    least = bound(SMALL, (4000.0, 5000.0, 0.002), rounding=True)
    limits = (least.sigma_x_nm, least.sigma_y_nm, least.sigma_scale, least.sigma_theta_rad)
    for one, limit in zip(found.scatters.values(), limits, strict=True):
        assert one.bound == pytest.approx(limit, rel=1e-3)
        assert one.stated == pytest.approx(limit, rel=0.05)
        assert one.sigma == pytest.approx(limit, abs=3.5 * one.sigma_error)
        assert not one.moved


def test_command_on_a_track_and_on_images(tmp_path, rng) -> None:
    file, plot, figures = tmp_path / "t.h5", tmp_path / "r.png", tmp_path / "r.json"
    write_track(track_of(SIGMA * rng.standard_normal(300), SMALL), file)
    run = CliRunner().invoke(app, ["resolution", str(file), "-o", str(plot), "-o", str(figures)])
    assert run.exit_code == 0, run.output
    assert plot.read_bytes().startswith(b"\x89PNG")
    stored = json.loads(figures.read_text())
    assert stored["x"]["sigma_nm"] == pytest.approx(SIGMA, rel=0.2)
    assert stored["x"]["bound_nm"] == pytest.approx(bound(SMALL, rounding=True).sigma_x_nm, rel=0.1)

    frames = tmp_path / "f.npy"
    np.save(frames, simulate(SMALL, (4000.0, 5000.0, 0.002), n=16, seed=4).frames)
    toml = tmp_path / "small.toml"
    toml.write_text(SMALL.to_toml())
    command = ["resolution", str(frames), "--system", str(toml), "--json"]
    found = json.loads(CliRunner().invoke(app, command).stdout)
    assert found["frames"] == 16 and 0.3 < found["x"]["ratio_to_bound"] < 2
    fourier = json.loads(CliRunner().invoke(app, [*command, "--method", "fourier"]).stdout)
    assert fourier["x"]["sigma_nm"] > found["x"]["sigma_nm"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing.h5", "--json"], "nothing.h5"),
        (["frames/"], "images need a --system"),
        (["t.csv", "-o", "a.txt"], "must end in .png"),
    ],
)
def test_command_says_what_is_wrong(arguments, message) -> None:
    run = CliRunner().invoke(app, ["resolution", *arguments])
    assert run.exit_code == 2
    assert message in " ".join(run.stderr.split())
