"""The generator of the paper: each of its steps against a value worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from rasnik import load_system, simulate
from rasnik.imaging.deviations import CoherentLight, Deviations, EdgeErrors
from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.paper import KERNEL_WIDTH, paper_image, paper_pattern
from rasnik.imaging.projection import Projection
from rasnik.imaging.transfer import AiryTransfer
from rasnik.mask import ChessField

MASK = ChessField(field_um=70.0)
PITCH = 10.0
# Field (4, 4) of code cell (5, 3) is white, with its lower-left corner at this point.
CORNER = ((9 * 5 + 4) * 70.0, (9 * 3 + 4) * 70.0)


def at(x, y, theta=0.0, scale=1.0):
    return Projection.from_pose(x, y, scale, theta, 1)


def test_points_within_the_pixel_without_blur():
    # The middle of a 3 x 3 image is 3 um left of a vertical contour, in the height of a field:
    # of the ten columns of points at -4.5 .. 4.5 um, two lie to the right of it.
    assert MASK.is_white((9 * 5 + 4), (9 * 3 + 4))
    pattern = paper_pattern(MASK, at(CORNER[0] - 3, CORNER[1] + 35), (3, 3), PITCH, 0.0, points=10)
    np.testing.assert_allclose(pattern[1], [0, 0.2, 1], atol=1e-12)
    coarse = paper_pattern(MASK, at(CORNER[0] - 3, CORNER[1] + 35), (3, 3), PITCH, 0, points=2)
    np.testing.assert_allclose(coarse[1], [0, 0, 1], atol=1e-12)  # points at -2.5, 2.5 um


def test_dead_area_leaves_the_middle_of_the_pixel():
    # Half of the pixel is left: points at -2.25 .. 2.25 um, none beyond 3 um.
    pattern = paper_pattern(MASK, at(CORNER[0] - 3, CORNER[1] + 35), (3, 3), PITCH, 0.0, gap_um=5.0)
    assert pattern[1, 1] == 0
    nearer = paper_pattern(MASK, at(CORNER[0] - 2, CORNER[1] + 35), (3, 3), PITCH, 0, gap_um=5)
    assert nearer[1, 1] == pytest.approx(0.1)  # the point at 2.25 um


def test_blur_is_a_sampled_gaussian_over_eleven_pixels():
    sigma = 14.0
    offset = np.arange(-(KERNEL_WIDTH // 2), KERNEL_WIDTH // 2 + 1)
    kernel = np.exp(-((offset * PITCH / sigma) ** 2) / 2)
    kernel /= kernel.sum()
    assert kernel.size == 11
    place = at(CORNER[0] + 13, CORNER[1] + 21, 0.1)
    sharp = paper_pattern(MASK, place, (31, 41), PITCH, 0.0)
    blurred = paper_pattern(MASK, place, (31, 41), PITCH, sigma)
    by_hand = kernel @ sharp[10:21, 15:26] @ kernel
    assert blurred[15, 20] == pytest.approx(by_hand, abs=1e-12)


def test_the_edge_of_the_image_is_like_its_middle():
    place = at(CORNER[0] + 13, CORNER[1] + 21, 0.1)
    small = paper_pattern(MASK, place, (21, 21), PITCH, 12.0)
    large = paper_pattern(MASK, place, (41, 41), PITCH, 12.0)
    np.testing.assert_allclose(small, large[10:-10, 10:-10], atol=1e-12)


def test_the_difference_from_the_exact_image_is_aliasing():
    # It fades as the blur becomes wide against the pixel, however many points there are.
    difference = []
    for blur_um in (4.5, 7.0, 10.0):
        system = load_system(
            "solidras",
            {"sensor.width_px": 48, "sensor.height_px": 40, "optics.blur_um": blur_um},
        )
        place = Projection.from_pose(4100.0, 5000.0, 1.0, 0.02, 4)
        paper = paper_image(system, place, points=64)
        difference.append(np.abs(paper - exact_image(system, place)).max() / 227)
    assert 0.03 < difference[0] < 0.1
    assert difference[2] < difference[0] / 4
    assert difference[0] > difference[1] > difference[2]


def test_named_path_with_noise_levels_and_light():
    system = load_system("solidras", {"sensor.width_px": 96, "sensor.height_px": 64})
    simulation = simulate(system, (4000, 5000, 0.01), n=2, seed=3, path="paper")
    expected = paper_image(system, simulation.truth[0].projection)
    np.testing.assert_array_equal(simulation.expected(0), expected)
    assert expected.min() == pytest.approx(25, abs=0.5)
    assert expected.max() == pytest.approx(252, abs=0.5)
    pull = (simulation.frames[0] - expected) / np.sqrt(0.26 + 0.011 * expected + 1 / 12)
    assert pull[expected < 200].std() == pytest.approx(1, abs=0.03)
    lit = simulate(system, (4000, 5000, 0.01), seed=3, path="paper", effects={"uneven_light": 0.5})
    corner = lit.expected(0)[0, 0] / expected[0, 0]
    assert corner == pytest.approx(0.5, abs=1e-9)


def test_displaced_pixels_move_with_their_points():
    system = load_system("solidras", {"sensor.width_px": 48, "sensor.height_px": 40})
    place = Projection.from_pose(4100.0, 5000.0, 1.0, 0.02, 1)
    u, v = np.meshgrid(
        (np.arange(48) - 23.5) * system.pitch_um, (np.arange(40) - 19.5) * system.pitch_um
    )
    moved = paper_image(system, place, deviations=Deviations(points_um=(u + 6.9, v)))
    np.testing.assert_allclose(moved[:, :-1], paper_image(system, place)[:, 1:], atol=1e-9)


@pytest.mark.parametrize(
    ("deviations", "what"),
    [
        (Deviations(transfer=AiryTransfer(0.45, 0.03)), "another blur than a Gaussian"),
        (Deviations(edges=EdgeErrors(0.006)), "mask edge errors"),
        (Deviations(blur_ratio=np.ones((64, 96))), "blur that varies"),
        (Deviations(coherent=CoherentLight(0.5, 0.45, 0.03)), "coherent light"),
    ],
)
def test_what_it_does_not_have_is_refused(deviations, what):
    system = load_system("solidras", {"sensor.width_px": 96, "sensor.height_px": 64})
    with pytest.raises(ValueError, match=what):
        paper_image(system, at(4000, 5000), deviations=deviations)


def test_impossible_points_and_gaps():
    with pytest.raises(ValueError, match="at least one point"):
        paper_pattern(MASK, at(*CORNER), (3, 3), PITCH, 4.0, points=0)
    with pytest.raises(ValueError, match="does not fit"):
        paper_pattern(MASK, at(*CORNER), (3, 3), PITCH, 4.0, gap_um=10.0)
