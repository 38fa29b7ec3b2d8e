"""Overlays: the lattice lies on the image, the residuals are what is not the mask."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from rasnik import analyse, load_system, simulate
from rasnik.analysis.flags import Flag
from rasnik.analysis.pose import Candidate, Pose
from rasnik.report.numbers import concise, rounded, with_sigma
from rasnik.report.overlay import draw_overlay, overlay_figure
from rasnik.report.residuals import residual_image

SMALL = {"sensor.width_px": 320, "sensor.height_px": 240}


@pytest.fixture(scope="module")
def case():
    """(system, frame, pose found in it, expected image) with the code lines 12 to 15 or so."""
    system = load_system("solidras", SMALL)
    simulation = simulate(system, (10000.0, 7000.0, 0.01, 1.0, 4), seed=5)
    frame, _ = simulation[0]
    pose = analyse(frame, system)
    assert pose.ok
    return system, frame, pose, simulation.expected(0)


# ------------------------------------------------------------------------ residuals


def test_residuals_of_a_good_fit_are_the_noise(case):
    system, frame, pose, expected = case
    residual = residual_image(frame, pose, system)
    noise = frame - expected
    assert np.nanstd(residual) == pytest.approx(noise.std(), rel=0.03)
    assert np.isnan(residual).mean() < 0.01


def test_residuals_without_an_appearance_fit_the_light(case):
    """A pose from the spectrum, or read from a file, knows less; the image tells the rest."""
    system, frame, pose, expected = case
    bare = replace(pose, appearance=None, blur_um=1.3 * pose.blur_um, edge_shift_um=np.nan)
    residual = residual_image(frame, bare, system)
    assert np.nanstd(residual) == pytest.approx((frame - expected).std(), rel=0.05)


def test_dirt_shows_as_left_out(case):
    system, frame, pose, _ = case
    dirty = frame.copy()
    dirty[100:120, 50:80] = 0
    residual = residual_image(dirty, pose, system)
    assert np.isnan(residual[100:120, 50:80]).mean() > 0.9
    assert np.isnan(residual).mean() < 0.05


def test_residuals_outside_the_bounds_are_left_out(case):
    system, frame, pose, _ = case
    residual = residual_image(frame, pose, system, (20, 10, 299, 229))
    assert np.isnan(residual[:10]).all()
    assert np.isnan(residual[230:]).all()
    assert np.isnan(residual[:, :20]).all()
    assert np.isnan(residual[:, 300:]).all()
    assert np.isfinite(residual[10:230, 20:300]).mean() > 0.98


def test_no_projection_no_residuals(case):
    system, frame, _, _ = case
    with pytest.raises(ValueError, match="no projection"):
        residual_image(frame, Pose(), system)


# ------------------------------------------------------------------------ the figure


def label_positions(figure) -> dict[str, tuple[float, float]]:
    return {text.get_text(): text.get_position() for text in figure.axes[0].texts}


def test_code_numbers_stand_on_their_lines(case):
    """Each number lies on the column or row of fields whose code it is."""
    system, frame, pose, _ = case
    labels = label_positions(overlay_figure(frame, pose, system))
    period, field = system.mask.period, system.mask.field_um
    assert len(labels) >= 4
    height, width = frame.shape
    for text, (column, row) in labels.items():
        u = (column - (width - 1) / 2) * system.pitch_um
        v = (row - (height - 1) / 2) * system.pitch_um
        x, y = (float(c) for c in pose.projection.to_mask(u, v))
        on_column = int(text) == x // (field * period) and x / field % period < 1
        on_row = int(text) == y // (field * period) and y / field % period < 1
        assert on_column or on_row, text


def test_pivots_are_marked_where_they_are(case):
    system, frame, pose, _ = case
    figure = overlay_figure(frame, pose, system)
    squares = [line for line in figure.axes[0].lines if line.get_marker() == "s"]
    (marks,) = squares
    assert len(marks.get_xdata()) >= 2
    for column, row in zip(*marks.get_data(), strict=True):
        u = (column - (frame.shape[1] - 1) / 2) * system.pitch_um
        v = (row - (frame.shape[0] - 1) / 2) * system.pitch_um
        x, y = pose.projection.to_mask(u, v)
        fields = np.array([x, y]) / system.mask.field_um
        np.testing.assert_allclose(fields % system.mask.period, 0.5, atol=1e-6)


def test_contours_only_where_they_can_be_seen(case):
    system, frame, pose, _ = case
    few = overlay_figure(frame, pose, system)
    fine = load_system(system, {"mask.field_um": 8.5})
    many = overlay_figure(frame, pose, fine)
    assert len(few.axes[0].lines) > 30
    assert len(many.axes[0].lines) < 5
    assert len(many.axes[0].texts) <= 62


def test_caption_has_the_pose_with_its_errors(case):
    system, frame, pose, _ = case
    caption = overlay_figure(frame, pose, system, title="a.png").get_suptitle()
    assert caption.startswith("a.png\nx = ")
    assert with_sigma(pose.x_um, pose.sigma_x_um) in caption
    assert f"orientation {pose.orientation}" in caption


def test_an_image_without_position_shows_why(case):
    system, frame, _, _ = case
    candidates = tuple(Candidate(k, 2.0, 1.0, 0.1, 1, -k) for k in range(9))
    figure = overlay_figure(frame, Pose(flags=Flag.AMBIGUOUS, candidates=candidates), system)
    caption = figure.get_suptitle()
    assert "Several positions explain the image" in caption
    assert caption.count("candidate: x") == 4
    assert "5 more candidates" in caption
    assert not figure.axes[0].texts


@pytest.mark.parametrize("level", [7, np.nan])
def test_blank_images_can_be_drawn(tmp_path, case, level):
    system = case[0]
    frame = np.full(system.shape, level)
    draw_overlay(frame, Pose(flags=Flag.BLANK), system, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_overlay_file_has_two_panels(tmp_path, case):
    system, frame, pose, _ = case
    draw_overlay(frame, pose, system, tmp_path / "a.png", bounds_px=(0, 1, 319, 239))
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.width > 1.5 * picture.height
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    orange = (np.abs(colours.astype(int) - [255, 157, 46]).sum(axis=1) < 30).sum()
    assert orange > 50  # column numbers


# ------------------------------------------------------------------------ numbers


@pytest.mark.parametrize(
    ("value", "sigma", "long", "short"),
    [
        (12.345678, 0.0021, "12.3457 ± 0.0021", "12.3457(21)"),
        (12.345678, 0.00099, "12.34568 ± 0.00099", "12.34568(99)"),
        (12.345678, 0.000996, "12.3457 ± 0.0010", "12.3457(10)"),
        (-1234.5, 1.5, "-1234.5 ± 1.5", "-1234.5(15)"),
        (12345.6, 123.0, "12346 ± 123", "12346(123)"),
        (1.5, float("nan"), "1.5", "1.5"),
        (1.5, 0.0, "1.5", "1.5"),
        (float("nan"), 1.0, "-", "-"),
    ],
)
def test_numbers_are_rounded_to_their_errors(value, sigma, long, short):
    assert with_sigma(value, sigma) == long
    assert concise(value, sigma) == short


def test_rounding_to_other_digits():
    assert rounded(1.23456, 0.0123, digits=1) == "1.23"
    assert rounded(1.23456, 1e-30) == "1.234560000000"
