"""The exact generator against brute-force quadrature, closed forms and reference images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial.hermite_e import hermegauss
from numpy.polynomial.legendre import leggauss
from PIL import Image
from scipy.special import ndtr

from rasnik.imaging import nufft
from rasnik.imaging.levels import QuadraticLevel
from rasnik.imaging.montecarlo import ACCURACY, exact_image, exact_pattern
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.imaging.transfer import GaussianTransfer
from rasnik.instrument import load_system
from rasnik.mask import ChessField

MASK = ChessField(field_um=85.0)
PITCH = 6.9
SHAPE = (140, 180)
VECTORS = Path(__file__).parents[1].parent / "shared" / "vectors"


def blurred_mask(mask, x, y, sigma_um):
    """Mask blurred by a round Gaussian (in mask coordinates), field by field."""
    a = mask.field_um
    i0, i1, j0, j1 = (
        int(f(v / a))
        for f, v in (
            (np.floor, x.min() - 9 * sigma_um),
            (np.ceil, x.max() + 9 * sigma_um),
            (np.floor, y.min() - 9 * sigma_um),
            (np.ceil, y.max() + 9 * sigma_um),
        )
    )
    along_x = np.diff(ndtr((np.arange(i0, i1 + 1) * a - x[..., None]) / sigma_um))
    along_y = np.diff(ndtr((np.arange(j0, j1 + 1) * a - y[..., None]) / sigma_um))
    return np.einsum("...j,ji,...i->...", along_y, mask.fields(i0, i1, j0, j1), along_x)


def pixel_by_quadrature(mask, projection, shape, pitch_um, sigma_um, pixel, points=32):
    """Grey level of one pixel: Gauss-Legendre over its area.

    The round Gaussian of the sensor is an ellipse on the mask: its round part is done in
    closed form, what it is longer than wide by Gauss-Hermite quadrature.
    """
    node, weight = leggauss(points)
    u, v = sensor_grid_um(shape, pitch_um)
    u = u[pixel[1]] + node[None, :] * pitch_um / 2
    v = v[pixel[0]] + node[:, None] * pitch_um / 2
    x, y = projection.to_mask(u, v)
    h = 0.5
    jacobian = np.array(
        [
            [np.mean(b - a) for a, b in zip(*ends, strict=True)]
            for ends in (
                (projection.to_mask(u - h, v), projection.to_mask(u + h, v)),
                (projection.to_mask(u, v - h), projection.to_mask(u, v + h)),
            )
        ]
    ).T
    (narrow, wide), axes = np.linalg.eigh(sigma_um**2 * jacobian @ jacobian.T)
    if wide - narrow < 1e-9 * wide:
        value = blurred_mask(mask, x, y, np.sqrt(narrow))
    else:
        t, share = hermegauss(40)
        t = t * np.sqrt(wide - narrow)
        share = share / share.sum()
        value = sum(
            s * blurred_mask(mask, x + d * axes[0, 1], y + d * axes[1, 1], np.sqrt(narrow))
            for d, s in zip(t, share, strict=True)
        )
    return weight @ value @ weight / 4


def corners_and_others(shape, count, seed=0):
    rng = np.random.default_rng(seed)
    height, width = shape
    corners = [(0, 0), (0, width - 1), (height - 1, 0), (height - 1, width - 1)]
    return corners + [(int(rng.integers(height)), int(rng.integers(width))) for _ in range(count)]


def worst_error(projection, sigma_um, *, mask=MASK, shape=SHAPE, pitch_um=PITCH, count=8):
    image = exact_pattern(mask, projection, shape, pitch_um, GaussianTransfer(sigma_um))
    return max(
        abs(image[p] - pixel_by_quadrature(mask, projection, shape, pitch_um, sigma_um, p))
        for p in corners_and_others(shape, count)
    )


# ------------------------------------------------------------------ against quadrature


@pytest.mark.parametrize("theta_rad", [0.0, 0.002, 0.02, 0.3, np.pi / 4, -2.1])
@pytest.mark.parametrize(
    ("sigma_px", "scale"), [(0.3, 1.0), (0.65, 1.0), (0.65, 0.3), (2.0, 1.7), (6.16, 1.0)]
)
def test_similarity_agrees_with_quadrature(sigma_px, scale, theta_rad):
    # From 0.3 pixel to half a field (6.16 pixels at scale 1).
    projection = Projection.from_pose(68912.3, 76543.2, scale, theta_rad, 4)
    assert worst_error(projection, sigma_px * PITCH) < ACCURACY


@pytest.mark.parametrize("orientation", [1, 2, 3])
def test_other_orientations_agree_with_quadrature(orientation):
    projection = Projection.from_pose(1234.5, 2345.6, 0.9, 0.1, orientation)
    assert worst_error(projection, 4.5) < ACCURACY


def test_affine_map_agrees_with_quadrature():
    # Magnifications 1.20 and 0.90, axes 40 mrad off the right angle.
    projection = Projection([[-0.83, 0.05, 5000.0], [0.007, 1.1, 7000.0], [0, 0, 1]])
    assert worst_error(projection, 4.5) < ACCURACY


def test_projective_map_agrees_with_quadrature():
    # The scale changes by 1 % from left to right.
    projection = Projection([[-0.9, 0.05, 5000.0], [0.04, 0.95, 7000.0], [8e-6, -3e-6, 1]])
    assert worst_error(projection, 4.5, count=30) < 1e-4


@pytest.mark.parametrize("pitch_um", [85 / 2.5, 85 / 46.0, 85 / 200.0])
def test_small_and_large_fields_agree_with_quadrature(pitch_um):
    projection = Projection.from_pose(4000.0, 5000.0, 1.0, 0.4, 2)
    assert worst_error(projection, 0.65 * pitch_um, pitch_um=pitch_um) < ACCURACY


def test_mask_ends_in_opaque_glass():
    mask = ChessField(field_um=85.0, columns=1, rows=1)
    projection = Projection.from_pose(0.0, 765.0, 1.0, 0.2, 4)
    assert worst_error(projection, 4.5, mask=mask, count=30) < ACCURACY
    far = Projection.from_pose(-1e4, 1e4, 1.0, 0.2, 4)
    assert abs(exact_pattern(mask, far, SHAPE, PITCH, GaussianTransfer(4.5))).max() < ACCURACY


def test_far_from_the_origin_no_digits_are_lost():
    # The same fields near and far: a mask of few codes against the last cell of a large one.
    near = ChessField(field_um=85.0, code_bits=2, first_column=0)
    far = Projection.from_pose(195840.0, 195840.0, 1.0, 0.3, 4)
    assert worst_error(far, 4.5, count=20) < ACCURACY
    assert worst_error(Projection.from_pose(0, 0, 1.0, 0.3, 4), 4.5, mask=near) < ACCURACY


# ------------------------------------------------------------------- against closed forms


@pytest.mark.parametrize("sigma_um", [2.07, 4.5, 20.0])
def test_single_edge_has_the_closed_form(sigma_um):
    mask = ChessField(field_um=3000.0)
    shape = (8, 60)
    # Fields (2, 2) white, (3, 2) black: mask x grows to the right, the edge 1.3 um left of centre.
    projection = Projection.from_pose(9001.3, 7500.0, 1.0, 0.0, 1)
    image = exact_pattern(mask, projection, shape, PITCH, GaussianTransfer(sigma_um))
    u = sensor_grid_um(shape, PITCH)[0] + 1.3

    def integral(t):  # of the Gaussian edge
        return t * ndtr(t / sigma_um) + sigma_um * np.exp(-((t / sigma_um) ** 2) / 2) / np.sqrt(
            2 * np.pi
        )

    expected = 1 - (integral(u + PITCH / 2) - integral(u - PITCH / 2)) / PITCH
    assert abs(image - expected).max() < ACCURACY


def test_a_superpixel_is_the_mean_of_its_pixels():
    projection = Projection.from_pose(68912.3, 76543.2, 1.0, 0.35, 3)
    transfer = GaussianTransfer(4.5)
    fine = exact_pattern(MASK, projection, (120, 160), PITCH, transfer)
    coarse = exact_pattern(MASK, projection, (60, 80), 2 * PITCH, transfer)
    assert abs(coarse - fine.reshape(60, 2, 80, 2).mean(axis=(1, 3))).max() < 2 * ACCURACY


def test_tiles_of_a_whole_image_join():
    # A large image is computed in tiles, its middle part alone in one.
    projection = Projection.from_pose(68912.3, 76543.2, 1.0, 0.785, 4)
    transfer = GaussianTransfer(4.5)
    whole = exact_pattern(MASK, projection, (400, 400), PITCH, transfer)
    part = exact_pattern(MASK, projection, (60, 60), PITCH, transfer)
    assert abs(whole[170:230, 170:230] - part).max() < 2 * ACCURACY
    threaded = exact_pattern(MASK, projection, (400, 400), PITCH, transfer, workers=2)
    np.testing.assert_array_equal(whole, threaded)


def test_any_transfer_function_can_be_put_in():
    class Diffraction:
        """Round aperture in incoherent light."""

        cutoff_per_um = 0.12
        reach_um = 60.0

        def __call__(self, f_u, f_v):
            s = np.clip(np.hypot(f_u, f_v) / self.cutoff_per_um, 0, 1)
            return 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))

    projection = Projection.from_pose(4000.0, 5000.0, 1.0, 0.1, 4)
    image = exact_pattern(MASK, projection, SHAPE, PITCH, Diffraction())
    # Light is kept, and of about the width of a Gaussian of the same slope at the edge.
    gauss = exact_pattern(MASK, projection, SHAPE, PITCH, GaussianTransfer(4.5))
    assert abs(image.mean() - gauss.mean()) < 1e-3
    assert abs(image - gauss).max() < 0.1


def test_series_equals_its_direct_sum():
    rng = np.random.default_rng(3)
    ky, kx = 20, 30
    k, m = np.arange(kx + 1), np.r_[0 : ky + 1, -ky:0]
    c = rng.standard_normal((m.size, k.size)) + 1j * rng.standard_normal((m.size, k.size))
    c[0, 0] = c[0, 0].real
    c[ky + 1 :, 0] = c[ky:0:-1, 0].conj()
    lengths = nufft.grid_lengths((ky, kx))
    kernel = (
        nufft.kernel_transform(k / lengths[1]) * nufft.kernel_transform(m / lengths[0])[:, None]
    )
    matrix = np.array([[0.9, -0.3, 40.3], [0.3, 1.1, 21.2], [1e-3, 2e-3, 1]])
    image = nufft.evaluate_series(c / kernel, lengths, matrix, (20, 30))
    column, row = np.meshgrid(np.arange(30.0), np.arange(20.0))
    x, y, w = np.einsum("ab,brc->arc", matrix, np.stack([column, row, np.ones_like(row)]))
    x, y = x / w / lengths[1], y / w / lengths[0]
    wave_x = np.exp(2j * np.pi * k * x[..., None]) * np.where(k == 0, 1, 2)
    wave_y = np.exp(2j * np.pi * m * y[..., None])
    direct = np.einsum("rcm,mk,rck->rc", wave_y, c, wave_x).real
    # A flat spectrum is the hardest for the interpolation.
    assert abs(image - direct).max() < 5e-8 * abs(direct).max()


def test_series_refuses_points_outside_the_period():
    lengths = nufft.grid_lengths((4, 4))
    matrix = np.array([[1.0, 0, 0], [0, 1.0, 20.0], [0, 0, 1]])
    with pytest.raises(ValueError, match="outside the window"):
        nufft.evaluate_series(np.ones((9, 5), complex), lengths, matrix, (2, 2))


# ------------------------------------------------------------------------ grey levels


def test_grey_levels_of_the_system():
    system = load_system("solidras", {"sensor.width_px": 160, "sensor.height_px": 120})
    projection = Projection.from_pose(4000.0, 5000.0, 1.0, 0.01, 4)
    image = exact_image(system, projection)
    pattern = exact_pattern(system.mask, projection, (120, 160), 6.9, GaussianTransfer(4.5))
    np.testing.assert_allclose(image, 25 + 227 * pattern, rtol=1e-14)
    assert image.dtype == np.float64
    assert exact_image(system, projection, shape=(50, 70)).shape == (50, 70)


def test_binned_system_has_superpixels():
    options = {"sensor.width_px": 160, "sensor.height_px": 120}
    projection = Projection.from_pose(4000.0, 5000.0, 1.0, 0.01, 4)
    full = exact_image(load_system("solidras", options), projection)
    binned = exact_image(load_system("solidras", {**options, "sensor.binning": 2}), projection)
    assert binned.shape == (60, 80)
    assert abs(binned - full.reshape(60, 2, 80, 2).mean(axis=(1, 3))).max() < 227 * 2 * ACCURACY


def test_uneven_light():
    system = load_system("solidras", {"sensor.width_px": 160, "sensor.height_px": 120})
    projection = Projection.from_pose(4000.0, 5000.0, 1.0, 0.01, 4)
    plain = exact_image(system, projection)
    light = QuadraticLevel(200.0, slope_u_per_mm=0.3, curve_vv_per_mm2=-0.5)
    image = exact_image(system, projection, light_map=light, dark_map=20.0)
    u, v = sensor_grid_um((120, 160), 6.9)
    level = 200 * (1 + 0.3e-3 * u - 0.5e-6 * v[:, None] ** 2)
    pattern = (plain - 25) / 227
    np.testing.assert_allclose(image, 20 + (level - 20) * pattern, rtol=1e-12)


@pytest.mark.parametrize(
    ("light_map", "sentence"),
    [(lambda u, v: np.zeros(3), "light_map gives an array of shape"), (np.nan, "not finite")],
)
def test_bad_level_map(light_map, sentence):
    system = load_system("solidras")
    projection = Projection.from_pose(4000.0, 5000.0, 1.0, 0.01, 4)
    with pytest.raises(ValueError, match=sentence):
        exact_image(system, projection, light_map=light_map, shape=(20, 20))


@pytest.mark.parametrize(
    ("blur_um", "shape", "matrix", "sentence"),
    [
        (0.0, (20, 20), np.eye(3), "blur must be a positive length"),
        (0.1, (20, 20), np.eye(3), "blur is too small"),
        (4.5, (0, 20), np.eye(3), "must have pixels"),
        (4.5, (20, 20), [[1, 0, 0], [0, 1, 0], [0.02, 0, 1]], "to infinity"),
        (4.5, (20, 20), [[1, 1, 0], [1, 1, 0], [0, 0, 1]], "singular"),
        (4.5, (540, 720), [[1, 0, 0], [0, 1, 0], [3e-4, 0, 1]], "too strong"),
    ],
)
def test_impossible_images(blur_um, shape, matrix, sentence):
    with pytest.raises(ValueError, match=sentence):
        exact_pattern(MASK, Projection(matrix), shape, PITCH, GaussianTransfer(blur_um))


# --------------------------------------------------------------------- reference images


def vector_images():
    truth = VECTORS / "truth.json"
    return json.loads(truth.read_text())["images"] if truth.exists() else [None]


@pytest.mark.parametrize("vector", vector_images(), ids=lambda v: v["file"] if v else "absent")
def test_reference_images_hold_nothing_but_noise(vector):
    if vector is None:
        pytest.skip("the reference images (shared/vectors) are not there")
    frame = np.asarray(Image.open(VECTORS / vector["file"]), dtype=np.float64)
    polarity = ("positive", "negative")[vector["polarity"]]
    system = load_system("solidras", {"mask.polarity": polarity})
    projection = Projection.from_pose(
        *(vector[k] for k in ("x_um", "y_um", "scale", "theta_rad", "orientation"))
    )
    expected = exact_image(system, projection)
    sigma = np.sqrt(0.26 + 0.011 * expected + 1 / 12)
    pull = (frame - expected) / sigma
    # White pixels whose noise is cut off at 255 are no test of the expected level.
    free = expected + 5 * sigma < 255
    n = free.sum()
    assert n > 1e5
    assert np.sqrt((pull[free] ** 2).mean()) == pytest.approx(1, abs=0.01)
    # No structure: not with the grey level, along rows or columns, between neighbours, nor
    # with what a shift of the image would change.
    level = np.digitize(expected[free], np.linspace(25, 245, 12))
    for k in np.unique(level):
        own = pull[free][level == k]
        assert abs(own.mean()) < 5 / np.sqrt(own.size)
    pull[~free] = 0
    for axis in (0, 1):
        lines = pull.sum(axis) / np.sqrt(np.maximum(free.sum(axis), 1))
        assert abs(lines).max() < 5.5
        neighbours = np.diff(free.astype(int), axis=axis) == 0
        shifted = np.roll(pull, 1, axis)
        assert abs((pull * shifted).sum()) < 5 * np.sqrt(neighbours.sum())
        slope = np.gradient(expected, axis=axis) / sigma * free
        assert abs((pull * slope).sum()) < 5 * np.sqrt((slope**2).sum())
