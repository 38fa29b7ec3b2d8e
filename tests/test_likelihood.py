"""The fit: at the bound, honest about its errors, not fooled by dirt, light or edges.

Images come from the exact generator, which shares no formula with the model that is fitted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rasnik.analysis.flags import Flag
from rasnik.analysis.frame import Frame, prepare_frame
from rasnik.analysis.likelihood import Fit, fit
from rasnik.analysis.moments import all_tiles, gather
from rasnik.analysis.outliers import estimate_noise
from rasnik.analysis.parameters import POSE_SIZE, State, design, stepped
from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.levels import QuadraticLevel
from rasnik.imaging.model import expected_image, make_scene
from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.noise import ReadOut
from rasnik.imaging.projection import Projection
from rasnik.instrument import System, load_system

SMALL = load_system("solidras", ["sensor.width_px=240", "sensor.height_px=180"])
START = Appearance.uniform(40.0, 230.0, 5.5)


def frame_of(image: NDArray, system: System = SMALL) -> Frame:
    return prepare_frame(image, system.mask, system.pitch_um, system, None)[0]


def near(projection: Projection, rng: np.random.Generator, by_um: float = 3.0) -> State:
    matrix = projection.matrix.copy()
    matrix[:2, 2] += rng.uniform(-by_um, by_um, 2)
    return State(Projection(matrix), START)


def pulls(result: Fit, truth: tuple[float, float, float, float]) -> NDArray[np.float64]:
    p = result.state.projection
    scale, theta, _ = p.similarity()
    found = np.array([p.x_um, p.y_um, scale, theta])
    return (found - truth) / np.sqrt(np.diag(result.covariance))


@pytest.mark.parametrize("theta", [0.0, 0.002, 0.02])
def test_noise_free_image_gives_the_position_to_50_picometres(theta: float, rng) -> None:
    system = load_system("solidras")
    x, y = rng.uniform(10_000, 150_000, 2)
    truth = Projection.from_pose(x, y, 1.0, theta, 4)
    result = fit(frame_of(exact_image(system, truth), system), near(truth, rng))
    found = result.state.projection
    assert result.converged and result.model == "similarity"
    assert abs(found.x_um - x) < 0.05e-3 and abs(found.y_um - y) < 0.05e-3
    assert result.chi2_ndf < 1e-6


def test_errors_are_as_large_as_stated(rng) -> None:
    values, chi2 = [], []
    for _ in range(8):
        x, y, theta = rng.uniform(1e4, 1e5), rng.uniform(1e4, 1e5), rng.uniform(-0.3, 0.3)
        truth = Projection.from_pose(x, y, 0.9, theta, 4)
        noisy = ReadOut(exact_image(SMALL, truth), SMALL)
        for _ in range(25):
            result = fit(frame_of(noisy.frame(rng)), near(truth, rng))
            assert result.converged and result.clean and result.model == "similarity"
            values.append(pulls(result, (x, y, 0.9, theta)))
            chi2.append(result.chi2_ndf)
    spread = np.std(values, axis=0)
    # 200 images: the standard deviation is known to 5 %
    assert np.all(np.abs(spread - 1) < 0.16), spread
    assert np.all(np.abs(np.mean(values, axis=0)) < 4 / np.sqrt(200))
    # white pixels are cut off at full scale, hence a little less than 1
    assert 0.96 < np.mean(chi2) < 1.005


def test_the_step_is_the_change_of_parameters(rng) -> None:
    # one Gauss-Newton step from a known displacement of every parameter brings it back
    camera, mask = Camera((180, 240), 6.9), SMALL.mask
    appearance = Appearance.uniform(25.0, 252.0, 5.0).with_(edge_shift_um=0.3, kurtosis=0.2)
    state = State(Projection.from_pose(5000.0, 6000.0, 1.0, 0.1, 4), appearance)
    moved = np.zeros(POSE_SIZE["projective"] + 15)
    moved[:8] = 0.05, -0.04, 1e-5, 2e-5, -1e-5, 1.5e-5, 2e-8, -2e-8
    moved[8:20] = rng.uniform(-0.5, 0.5, 12)
    moved[20:23] = 0.1, 0.02, 2.0
    truth = stepped(state, moved, "projective", 1.0)
    image = expected_image(mask, truth.projection, truth.appearance, camera)
    scene = make_scene(mask, state.projection, state.appearance, camera, kurtosis_signal=True)
    valid = np.ones(camera.shape, dtype=np.uint8)
    moments = gather(image, valid, scene, (0.3, 0.01), camera, all_tiles(camera.shape))
    rows = design(state, camera, mask.field_um, "projective", True)
    found = np.linalg.solve(rows @ moments.matrix @ rows.T, rows @ moments.vector)
    # tiles of 16 pixels of 240 and the second order of the step are what is left
    assert found[:6] == pytest.approx(moved[:6], rel=0.05)
    assert found[8:20] == pytest.approx(moved[8:20], abs=0.03)
    assert found[20:22] == pytest.approx(moved[20:22], rel=0.1)


def test_uneven_light_is_fitted(rng) -> None:
    light = QuadraticLevel(200.0, slope_u_per_mm=0.3, slope_v_per_mm=-0.2, curve_uv_per_mm2=0.1)
    truth = Projection.from_pose(20_000.0, 30_000.0, 1.0, 0.05, 1)
    image = exact_image(SMALL, truth, light_map=light)
    result = fit(frame_of(image), near(truth, rng))
    assert abs(result.state.projection.x_um - 20_000.0) < 1e-4
    assert abs(result.state.projection.y_um - 30_000.0) < 1e-4
    assert result.state.appearance.light[0] == pytest.approx(200.0, abs=0.01)


def test_unequal_scales_demand_an_affine_map(rng) -> None:
    truth = Projection.from_pose(20_000.0, 30_000.0, 1.0, 0.05, 4)
    matrix = truth.matrix.copy()
    matrix[:2, :2] = matrix[:2, :2] @ np.diag([1.001, 0.999])
    sheared = Projection(matrix)
    noisy = ReadOut(exact_image(SMALL, sheared), SMALL).frame(rng)
    result = fit(frame_of(noisy), near(sheared, rng))
    assert result.model == "affine"
    assert np.abs(pulls(result, (20_000.0, 30_000.0, *sheared.similarity()[:2]))).max() < 5
    forced = fit(frame_of(noisy), near(sheared, rng), model="similarity")
    assert forced.model == "similarity" and forced.flags & Flag.MODEL_MISFIT


def test_a_tilt_demands_a_projective_map(rng) -> None:
    matrix = Projection.from_pose(20_000.0, 30_000.0, 1.0, 0.05, 4).matrix.copy()
    tilt = np.array([4e-6, -3e-6])  # per um: 0.3 % of scale over half the image
    matrix[:2, :2] += np.outer(matrix[:2, 2], tilt)
    matrix[2, :2] = tilt
    tilted = Projection(matrix)
    noisy = ReadOut(exact_image(SMALL, tilted), SMALL).frame(rng)
    result = fit(frame_of(noisy), near(tilted, rng))
    assert result.model == "projective"
    assert np.abs(pulls(result, (20_000.0, 30_000.0, *tilted.similarity()[:2]))).max() < 5
    assert result.state.projection.matrix[2, :2] == pytest.approx(tilt, rel=0.05)


def test_dust_is_left_out(rng) -> None:
    truth = Projection.from_pose(20_000.0, 30_000.0, 1.0, 0.05, 4)
    image = ReadOut(exact_image(SMALL, truth), SMALL).frame(rng).astype(float)
    rows, columns = np.mgrid[:180, :240]
    covered = np.zeros(image.shape, dtype=bool)
    for _ in range(25):
        row, column, radius = rng.uniform(0, 180), rng.uniform(0, 240), rng.uniform(2, 7)
        covered |= np.hypot(rows - row, columns - column) < radius
    image[covered] *= 0.4
    result = fit(frame_of(np.rint(image).astype(np.uint8)), near(truth, rng))
    assert not result.clean and result.converged
    assert np.abs(pulls(result, (20_000.0, 30_000.0, 1.0, 0.05))).max() < 5
    # black fields under dust look black: about half of it can be seen at all
    assert result.valid[covered].mean() < 0.5
    assert result.valid[~covered].mean() > 0.85


def test_noise_is_estimated_when_unknown(rng) -> None:
    truth = Projection.from_pose(20_000.0, 30_000.0, 1.0, 0.05, 4)
    image = ReadOut(exact_image(SMALL, truth), SMALL).frame(rng)
    frame = replace(frame_of(image), noise=None)
    result = fit(frame, near(truth, rng))
    assert result.flags & Flag.NOISE_ESTIMATED
    dark, light = (result.noise[0] + result.noise[1] * level for level in (25.0, 252.0))
    assert dark == pytest.approx(0.26 + 1 / 12 + 0.011 * 25, rel=0.15)
    assert light == pytest.approx(0.26 + 1 / 12 + 0.011 * 252, rel=0.15)
    assert np.abs(pulls(result, (20_000.0, 30_000.0, 1.0, 0.05))).max() < 5


def test_estimated_noise_follows_the_noise(rng) -> None:
    truth = Projection.from_pose(20_000.0, 30_000.0, 1.0, 0.05, 4)
    state = State(truth, Appearance.uniform(25.0, 252.0, 4.5))
    expected = exact_image(SMALL, truth)
    for sigma in (1.0, 3.0):
        image = (expected + rng.normal(0, sigma, expected.shape)).astype(np.float32)
        valid = np.ones(image.shape, dtype=np.uint8)
        a, b = estimate_noise(image, valid, state, SMALL.mask, Camera(image.shape, 6.9))
        assert a + b * 140 == pytest.approx(sigma**2, rel=0.1)


def test_edge_shift_and_kurtosis_are_recovered(rng) -> None:
    camera = Camera((180, 240), 6.9)
    appearance = Appearance.uniform(25.0, 200.0, 6.0).with_(edge_shift_um=0.8, kurtosis=-0.4)
    truth = Projection.from_pose(20_000.0, 30_000.0, 1.0, 0.05, 4)
    expected = expected_image(SMALL.mask, truth, appearance, camera).astype(float)
    result = fit(frame_of(ReadOut(expected, SMALL).frame(rng)), near(truth, rng))
    found = result.state.appearance
    assert result.flags & Flag.PROFILE_REFINED
    assert found.edge_shift_um == pytest.approx(0.8, abs=0.02)
    assert found.kurtosis == pytest.approx(-0.4, abs=0.06)
    assert found.blur_um == pytest.approx(6.0, abs=0.03)
    assert np.abs(pulls(result, (20_000.0, 30_000.0, 1.0, 0.05))).max() < 5
