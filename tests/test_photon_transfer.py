"""Noise of a sensor from frames of a still scene: right, with right errors, or refused."""

from __future__ import annotations

import json
import math
import tomllib
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import stats
from typer.testing import CliRunner, Result

import photon_transfer as study
from rasnik import System, load_system
from rasnik.characterisation.noise_law import fit_law
from rasnik.characterisation.photon_transfer import photon_transfer
from rasnik.characterisation.temporal_noise import StillSceneError, temporal_noise
from rasnik.cli import app
from rasnik.cli.system_file import system_text, with_values
from rasnik.report.photon_transfer import noise_figure

A, B = 0.26, 0.011
SYSTEM = study.small_system(120, 90, 235.0)


def scene(levels=(20.0, 230.0), shape=(90, 120), size=15) -> np.ndarray:
    """Blocks of the levels in turn, with a ramp between them across the whole."""
    row, column = np.indices(shape)
    blocks = (row // size + column // size) % len(levels)
    return np.take(np.array(levels), blocks) * (0.6 + 0.4 * column / shape[1])


def frames_of(expected, n, rng, a=A, b=B, top=255) -> Iterator[np.ndarray]:
    sigma = np.sqrt(a + b * np.maximum(expected, 0))
    for _ in range(n):
        frame = expected + sigma * rng.standard_normal(expected.shape)
        yield np.clip(np.rint(frame), 0, top).astype(np.uint8 if top < 256 else np.uint16)


def pulls(found, a=A, b=B) -> list[float]:
    return [(found.law.A - a) / found.law.sigma_A, (found.law.B - b) / found.law.sigma_B]


# ------------------------------------------------------------------------- statistics


@pytest.mark.parametrize("n", [12, 30, 120])
def test_variance_and_its_degrees_of_freedom(n, rng) -> None:
    """White noise: the mean of the variances is that of the noise, their scatter as stated."""
    sigma = 2.0
    noise = temporal_noise(100 + sigma * rng.standard_normal((90, 110)) for _ in range(n))
    pixels = noise.variance.size
    relative = noise.variance / sigma**2
    expected = math.sqrt(2 / noise.dof)
    assert abs(relative.mean() - 1) < 4 * expected / math.sqrt(pixels)
    # The squared scatter of chi-square variables is known to sqrt((2 + 12 / dof) / n).
    error = math.sqrt((2 + 12 / noise.dof) / pixels)
    assert abs((relative.var() / expected**2) - 1) < 5 * error
    # What successive differences and the terms taken out leave of the information.
    assert n > noise.dof > (0.2 if n < 24 else 0.4) * n


def test_fit_of_chi_square_variances(rng) -> None:
    """Within one sigma in 68 % of trials, without bias; weights by the values would be biased."""
    level, dof = np.repeat(np.linspace(20, 230, 22), 40), 12
    found = []
    for _ in range(400):
        variance = (A + B * level) * rng.chisquare(dof, level.size) / dof
        law = fit_law(level, variance, dof)
        found.append([(law.A - A) / law.sigma_A, (law.B - B) / law.sigma_B])
    found = np.array(found)
    assert np.all(np.abs(found.mean(axis=0)) < 4 / math.sqrt(400))
    assert np.all(np.abs(found.std(axis=0) - 1) < 4 / math.sqrt(800))
    inside = (np.abs(found) < 1).mean(axis=0)
    assert np.all(np.abs(inside - 0.6827) < 4 * math.sqrt(0.6827 * 0.3173 / 400))


@pytest.mark.parametrize("case", study.CASES[-2:], ids=lambda case: case[0])
def test_recordings_short(case) -> None:
    """The study in short: errors as stated with flicker, drift and shaking."""
    trials = 10
    rows = np.array([study.trial(k, case, SYSTEM, 32, 7) for k in range(trials)])
    for value, sigma, truth in ((*rows[:, :2].T, A), (*rows[:, 2:4].T, B)):
        pull = (value - truth) / sigma
        assert abs(pull.mean()) < 3.5 / math.sqrt(trials)
        low, high = stats.chi2.ppf([0.0005, 0.9995], trials)
        assert low < pull @ pull < high


def test_without_care_drift_and_flicker_spoil_the_variance() -> None:
    """The disturbances of the study are far larger than the errors that are asked for."""
    frames = np.array(list(study.recording(SYSTEM, 40, (1,), 0.01, 0.1, 0.0)), dtype=float)
    plain = fit_law(frames.mean(0).ravel(), frames.var(0, ddof=1).ravel(), 39, 1 / 12)
    assert abs(plain.A - A) > 20 * plain.sigma_A
    assert abs(plain.B - B) > 20 * plain.sigma_B


def test_many_blocks_and_few_frames_in_memory(rng) -> None:
    alive = most = 0

    def gone() -> None:
        nonlocal alive
        alive -= 1

    def watched() -> Iterator[np.ndarray]:
        nonlocal alive, most
        for frame in frames_of(scene(), 400, rng):
            alive += 1
            weakref.finalize(frame, gone)
            most = max(most, alive)
            yield frame

    found = photon_transfer(watched())
    assert found.noise.frames == 400
    assert most < 110
    assert np.all(np.abs(pulls(found)) < 3.5)


def test_ten_frames(rng) -> None:
    found = photon_transfer(frames_of(scene(), 10, rng))
    assert np.all(np.abs(pulls(found)) < 3.5)
    assert found.law.sigma_B < 0.05 * B


# ------------------------------------------------------------------------- range and rounding


def test_saturated_and_black_pixels_are_left_out(rng) -> None:
    """White at 252 of 255, as the paper's settings have it: its noise is cut off."""
    expected = np.concatenate([scene((0.5, 252.0)), scene((60.0, 150.0))])
    found = photon_transfer(frames_of(expected, 60, rng))
    assert found.saturation_level == 255
    assert np.all(np.abs(pulls(found)) < 3.5)
    assert found.noise.mean[found.used].max() < 250
    assert found.noise.mean[found.used].min() > 2
    assert found.full_well_e[0] == pytest.approx(255 / found.law.B)


def test_twelve_bits_at_the_upper_end_of_sixteen(rng) -> None:
    expected = scene((200.0, 3500.0))
    frames = (16 * frame for frame in frames_of(expected, 60, rng, a=4.0, b=0.2, top=4095))
    found = photon_transfer(frames)
    assert found.law.rounding == pytest.approx(256 / 12)
    assert np.all(np.abs(pulls(found, 256 * 4.0, 16 * 0.2)) < 3.5)
    assert found.full_scale == 4095 * 16


def test_levels_that_are_no_whole_numbers(rng) -> None:
    sigma = np.sqrt(A + B * scene())
    frames = (scene() + sigma * rng.standard_normal(sigma.shape) for _ in range(60))
    found = photon_transfer(frames)
    assert found.law.rounding == 0
    assert np.all(np.abs(pulls(found)) < 3.5)
    assert "no whole numbers" in " ".join(found.warnings)


def test_noise_below_the_steps_is_not_used(rng) -> None:
    """Where noise does not smear the steps the variance of rounding is not 1/12."""
    expected = scene((5.0, 120.0, 240.0), size=10)
    found = photon_transfer(frames_of(expected, 80, rng, a=0.02, b=0.004))
    assert "fluctuate less than the steps" in " ".join(found.warnings)
    assert np.all(np.abs(pulls(found, 0.02, 0.004)) < 3.5)
    with pytest.raises(StillSceneError, match="more bits"):
        photon_transfer(frames_of(expected, 40, rng, a=0.01, b=0.0002))


def test_full_well_below_full_scale_is_seen(rng) -> None:
    """Above a level of 190 a quarter of the fluctuation is left."""
    expected = np.tile(np.linspace(10, 235, 160), (100, 1))
    sigma = np.sqrt(A + B * expected) * np.where(expected > 190, 0.5, 1)
    frames = (
        np.rint(expected + sigma * rng.standard_normal(sigma.shape)).astype(np.uint8)
        for _ in range(80)
    )
    found = photon_transfer(frames)
    assert found.bend_level == pytest.approx(190, abs=6)
    assert np.all(np.abs(pulls(found)) < 3.5)


def test_curvature(rng) -> None:
    expected = np.tile(np.linspace(10, 235, 160), (100, 1))
    sigma = np.sqrt(0.3 + 0.01 * expected + 2e-5 * expected**2)
    frames = (
        np.rint(expected + sigma * rng.standard_normal(sigma.shape)).astype(np.uint8)
        for _ in range(100)
    )
    found = photon_transfer(frames)
    assert found.curvature == pytest.approx(2e-5, abs=4 * found.sigma_curvature)
    assert found.curvature > 5 * found.sigma_curvature


# ------------------------------------------------------------------------- pixels and lines


def test_defects_patterns_and_lines(rng) -> None:
    shape = (150, 200)
    smooth = scene((40.0, 180.0), shape, 25)
    gain, offset = 1 + 0.01 * rng.standard_normal(shape), 0.3 * rng.standard_normal(shape)
    offset += 0.4 * rng.standard_normal((1, shape[1]))
    hot, dead, noisy, stuck = (12, 13), (60, 60), (100, 37), (90, 140)
    gain[dead], offset[hot] = 0.1, offset[hot] + 50
    expected = smooth * gain + offset

    def frames() -> Iterator[np.ndarray]:
        for frame in range(150):
            lines = 0.2 * rng.standard_normal((shape[0], 1))
            levels = expected + np.sqrt(A + B * expected) * rng.standard_normal(shape) + lines
            levels[noisy] += 5 * rng.standard_normal()
            levels[stuck] = 99 + 0 * frame
            yield np.clip(np.rint(levels), 0, 255).astype(np.uint8)

    found = photon_transfer(frames())
    kinds = {(d.row, d.column): d.kind for d in found.defects}
    assert kinds.pop(hot) == "hot"
    assert kinds.pop(dead) == "dead"
    assert kinds.pop(noisy) == "noisy"
    assert kinds.pop(stuck) in ("stuck", "hot", "dead")
    assert not kinds
    row, column = found.noise.row_variance, found.noise.column_variance
    assert row[0] == pytest.approx(0.04, abs=4 * row[1])
    assert row[0] > 10 * row[1]
    assert abs(column[0]) < 4 * column[1]
    # The noise of rows is part of A.
    assert np.all(np.abs(pulls(found, A + row[0])) < 4)
    fixed = found.fixed
    assert fixed.gain == pytest.approx(0.01, rel=0.05)
    assert fixed.offset == pytest.approx(0.3, rel=0.15)
    assert fixed.column_variance == pytest.approx(0.16, abs=4 * fixed.sigma_column_variance)
    assert fixed.column_variance > 4 * fixed.sigma_column_variance
    assert abs(fixed.row_variance) < 4 * fixed.sigma_row_variance


def test_good_sensor_has_no_defects_and_no_pattern(rng) -> None:
    found = photon_transfer(frames_of(scene((40.0, 200.0), size=30), 100, rng))
    assert found.defects == ()
    assert abs(found.fixed.variance) < 5 * found.fixed.sigma_variance
    assert found.warnings == ()


# ------------------------------------------------------------------------- recordings


def test_frames_that_do_not_belong_are_left_out(rng) -> None:
    frames = list(frames_of(scene(), 60, rng))
    frames[20] = np.full_like(frames[20], 90)  # a hand before the mask
    frames[33] = (0.3 * frames[33]).astype(np.uint8)
    frames.insert(45, frames[44])
    found = photon_transfer(frames)
    assert (found.noise.left_out, found.noise.repeated, found.noise.frames) == (2, 1, 58)
    assert np.all(np.abs(pulls(found)) < 3.5)


@pytest.mark.parametrize("step_px", [0.03, 0.3, 7.0])
def test_moving_scene_is_refused(step_px, rng) -> None:
    frames = study.recording(SYSTEM, 60, (2,), 0.0, 60 * step_px, 0.0)
    with pytest.raises(StillSceneError, match="moves|not still"):
        photon_transfer(frames)


def test_slow_drift_beyond_the_promise_is_told() -> None:
    found = photon_transfer(study.recording(SYSTEM, 60, (3,), 0.0, 0.5, 0.0))
    assert "the scene moved by 0.5" in found.warnings[0]


def test_what_cannot_be_measured_is_refused(rng) -> None:
    frames = list(frames_of(scene(), 30, rng))
    with pytest.raises(StillSceneError, match="9 different frames are too few"):
        photon_transfer(frames[:9])
    with pytest.raises(StillSceneError, match="1 different frames are too few"):
        photon_transfer([frames[0]] * 30)
    with pytest.raises(StillSceneError, match="differ in size: 120 x 90 and 110 x 90"):
        photon_transfer([*frames, frames[0][:, :110]])
    with pytest.raises(StillSceneError, match="saturation"):
        photon_transfer(frames_of(np.full((50, 50), 255.0), 30, rng))


def test_dark_frames_have_no_shot_noise_to_show(rng) -> None:
    found = photon_transfer(frames_of(np.full((80, 80), 10.0), 40, rng))
    assert "no shot noise is seen" in " ".join(found.warnings)


def test_real_image_as_the_scene(shared, rng) -> None:
    """A real mask with dust and uneven light, its own noise frozen, and new noise on it."""
    file = shared("real/Rasnik_slanted.png")
    image = np.asarray(Image.open(file).convert("L"), dtype=float)[100:340, 100:420]
    found = photon_transfer(frames_of(0.8 * image + 15, 24, rng))
    assert np.all(np.abs(pulls(found)) < 3.5)


# ------------------------------------------------------------------------- command


def rasnik(*arguments: object) -> Result:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


@pytest.fixture
def stack(tmp_path: Path, rng) -> Path:
    file = tmp_path / "still.npy"
    np.save(file, np.array(list(frames_of(scene(), 30, rng))))
    return file


def test_command(stack: Path, tmp_path: Path) -> None:
    result = rasnik("noise", stack, "-o", tmp_path / "noise.png")
    assert result.exit_code == 0
    assert "electrons per grey" in result.stdout
    assert (tmp_path / "noise.png").stat().st_size > 10_000
    result = rasnik("noise", stack, "--json")
    found = json.loads(result.stdout)
    assert abs(found["A"] - A) < 4 * found["sigma_A"]
    assert abs(found["B"] - B) < 4 * found["sigma_B"]
    assert found["A_with_rounding"] == pytest.approx(found["A"] + 1 / 12)
    assert found["frames"] == 30


def test_values_go_into_a_system(stack: Path, tmp_path: Path) -> None:
    sizes = ["--set", "sensor.width_px=240", "--set", "sensor.height_px=180"]
    file = tmp_path / "mine.toml"
    setting = [*sizes, "--set", "sensor.binning=2"]
    result = rasnik("noise", stack, "--system", "solidras", *setting, "--write-system", file)
    assert result.exit_code == 0, result.stderr
    made = load_system(file)
    # The file tells of one physical pixel, of which four make one of the image.
    assert made.sensor.noise_b == pytest.approx(4 * B, rel=0.1)
    assert made.noise_law[1] == pytest.approx(B, rel=0.1)
    assert made.sensor.full_well_e == pytest.approx(255 / made.sensor.noise_b, rel=1e-3)
    file.write_text(file.read_text() + "# a remark of mine\n")
    result = rasnik("noise", stack, "--write-system", file)
    assert result.exit_code == 0, result.stderr
    assert "# a remark of mine" in file.read_text()
    assert load_system(file).sensor == made.sensor


def test_only_the_lines_of_the_values_change() -> None:
    system, text = load_system("solidras"), system_text("solidras")
    new = with_values(text, system, {"sensor.noise_a": 0.3, "sensor.exposure_s": 0.001}, "found")
    before, after = text.splitlines(), new.splitlines()
    assert [line for line in after if line not in before] == [
        "noise_a = 0.3  # found",
        "exposure_s = 0.001  # found",
    ]
    assert len(after) == len(before) + 1  # one replaced, one added
    assert load_system(system, {"sensor.noise_a": 0.3, "sensor.exposure_s": 0.001}) == (
        System.model_validate(tomllib.loads(new))
    )
    inline = 'name = "a"\nmask = {field_um = 85.0}\noptics = {scale = 1.0, blur_um = 4.5}\n'
    inline += "sensor = {width_px = 720, height_px = 540, pixel_um = 6.9, dark_level = 25.0, "
    inline += "light_level = 252.0}\n"
    small = load_system(system, {"name": "a"})
    assert "noise_a = 0.3" in with_values(inline, small, {"sensor.noise_a": 0.3}, "found")


def test_command_refuses_in_a_sentence(stack: Path, tmp_path: Path) -> None:
    for arguments, sentence in (
        ([tmp_path / "none.png"], "too few"),
        ([stack, "--system", "solidras"], "has 120 x 90 pixels"),
        ([stack, "--write-system", tmp_path / "x.toml"], "name the system to start from"),
        ([stack, "--write-system", tmp_path / "x.txt"], "end the name in .toml"),
        ([stack, "-o", tmp_path / "x.doc"], ".png, .pdf or .svg"),
        ([stack, "--set", "sensor.binning=2"], "name it with --system"),
    ):
        result = rasnik("noise", *arguments)
        assert result.exit_code == 2, arguments
        assert sentence in " ".join(result.stderr.split())
        assert result.stdout == ""


def test_plot_has_units_and_shows_the_curve(rng) -> None:
    found = photon_transfer(frames_of(scene(), 30, rng))
    figure = noise_figure(found, title="test")
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert "variance in time, grey²" in labels
    assert "variance − law, %" in labels
    drawn = figure.axes[0].lines
    fit = next(line for line in drawn if "A + B Q" in str(line.get_label()))
    x, y = fit.get_data()
    assert np.allclose(y, found.law.measured(np.asarray(x)))
