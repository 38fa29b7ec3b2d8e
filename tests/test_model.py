"""The image model against brute force, finite differences and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.special import ndtr

from rasnik.imaging import kernels
from rasnik.imaging.appearance import Appearance, Camera, surface
from rasnik.imaging.model import expected_image, expected_signals, make_scene, tile_products
from rasnik.imaging.profile import edge_table
from rasnik.imaging.projection import ORIENTATIONS, Projection
from rasnik.mask import ChessField

PIXEL = 6.9
MASK = ChessField(field_um=85.0)
CAMERA = Camera((70, 90), PIXEL)
BLACK_WHITE = (0.0, 1.0)


def pattern(projection: Projection, blur_px: float, camera: Camera = CAMERA) -> NDArray[np.float32]:
    appearance = Appearance.uniform(*BLACK_WHITE, blur_px * PIXEL)
    return expected_image(MASK, projection, appearance, camera)


def brute_force(
    projection: Projection, blur_px: float, rows: NDArray, columns: NDArray
) -> NDArray[np.float64]:
    """The blurred mask, summed field by field with exact error functions, over each pixel."""
    nodes, weights = leggauss(14)
    offsets, weights = nodes / 2 * PIXEL, weights / 2
    sigma = blur_px * PIXEL * np.sqrt(abs(np.linalg.det(projection.jacobian))) / MASK.field_um
    u0, v0 = CAMERA.origin_um
    values = np.empty(len(rows))
    for k, (row, column) in enumerate(zip(rows, columns, strict=True)):
        u, v = np.meshgrid(u0 + column * PIXEL + offsets, v0 + row * PIXEL + offsets)
        x, y = (coordinate / MASK.field_um for coordinate in projection.to_mask(u, v))
        i0, j0 = int(x.min()) - 7, int(y.min()) - 7
        lines_i, lines_j = np.arange(i0, i0 + 17), np.arange(j0, j0 + 17)
        wx = -np.diff(ndtr((x[..., None] - lines_i) / sigma))
        wy = -np.diff(ndtr((y[..., None] - lines_j) / sigma))
        fields = MASK.fields(i0, i0 + 16, j0, j0 + 16)
        blurred = np.einsum("abi,abj,ji->ab", wx, wy, fields)
        values[k] = np.einsum("ab,a,b", blurred, weights, weights)
    return values


@pytest.mark.parametrize("theta", [0.0, 0.002, 0.02, 0.2, 0.39, np.pi / 4])
@pytest.mark.parametrize(
    ("scale", "blur_px"),
    [(1.0, 0.3), (1.0, 0.45), (1.0, 0.65), (0.3, 0.3), (0.3, 0.65), (0.3, 1.8), (1.0, 6.0)],
)
def test_agrees_with_quadrature(scale: float, blur_px: float, theta: float, rng) -> None:
    projection = Projection.from_pose(4017.0, 5011.0, scale, theta, 4)
    rows, columns = rng.integers(0, 70, 150), rng.integers(0, 90, 150)
    expected = brute_force(projection, blur_px, rows, columns)
    found = pattern(projection, blur_px)[rows, columns]
    assert np.abs(found - expected).max() < 1e-4


def test_quadrature_test_can_fail(rng) -> None:
    # 5 % more blur is seen
    projection = Projection.from_pose(4017.0, 5011.0, 1.0, 0.02, 4)
    rows, columns = rng.integers(0, 70, 150), rng.integers(0, 90, 150)
    expected = brute_force(projection, 0.65, rows, columns)
    assert np.abs(pattern(projection, 0.65 * 1.05)[rows, columns] - expected).max() > 1e-3


def test_oblique_affine_map(rng) -> None:
    # blur is round on the sensor; seen on the mask it is not
    matrix = Projection.from_pose(4017.0, 5011.0, 1.0, 0.1, 1).matrix.copy()
    matrix[:2, :2] = matrix[:2, :2] @ [[1.1, 0.04], [0.02, 0.9]]
    projection = Projection(matrix)
    fine, weights = 9, np.full((9, 9), 1 / 81)
    # the same pixel, made of 9 x 9 small ones, each of which hardly needs the series
    small = Camera((CAMERA.shape[0] * fine, CAMERA.shape[1] * fine), PIXEL / fine)
    appearance = Appearance.uniform(*BLACK_WHITE, 0.65 * PIXEL)
    averaged = expected_image(MASK, projection, appearance, small).reshape(70, fine, 90, fine)
    averaged = np.einsum("iajb,ab->ij", averaged, weights)
    assert np.abs(pattern(projection, 0.65) - averaged).max() < 2e-4


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("polarity", ["positive", "negative"])
def test_white_where_the_mask_is_white(orientation: int, polarity: str) -> None:
    mask = MASK.model_copy(update={"polarity": polarity})
    projection = Projection.from_pose(30_000.0, 47_000.0, 1.2, 0.3, orientation)
    appearance = Appearance.uniform(10.0, 210.0, 0.3 * PIXEL)
    image = expected_image(mask, projection, appearance, CAMERA)
    (u0, v0), (height, width) = CAMERA.origin_um, CAMERA.shape
    u, v = u0 + np.arange(width) * PIXEL, v0 + np.arange(height)[:, None] * PIXEL
    x, y = projection.to_mask(u, v)
    white = mask.transmission(x, y)
    distance = [np.abs(c / 85 - np.round(c / 85)) for c in (x, y)]
    inside = np.minimum(*distance) > 0.2
    assert np.abs(image - (10 + 200 * white))[inside].max() < 0.1


def test_uneven_light() -> None:
    dark, light = np.array([20, 3, -2, 1, 2, -1.0]), np.array([200, 20, -30, 10, 5, -15.0])
    projection = Projection.from_pose(4017.0, 5011.0, 1.0, 0.02, 4)
    image = expected_image(MASK, projection, Appearance(dark, light, 4.5), CAMERA)
    white = pattern(projection, 4.5 / PIXEL)
    (u0, v0), (hu, hv) = CAMERA.origin_um, CAMERA.half_size_um
    basis = surface((u0 + np.arange(90) * PIXEL) / hu, (v0 + np.arange(70)[:, None] * PIXEL) / hv)
    expected = (basis @ dark) * (1 - white) + (basis @ light) * white
    assert np.abs(image - expected).max() < 1e-3


def _central_difference(change, step: float) -> NDArray[np.float64]:
    return (change(step).astype(float) - change(-step)) / (2 * step)


def test_derivatives() -> None:
    appearance = Appearance(
        np.array([20, 1, 2, 0, 0, 0.0]), np.array([200, 5, -9, 0, 3, 0.0]), 5.0, 1.5, 0.4
    )
    pose = (4017.0, 5011.0, 1.1, 0.05)

    def image(x=0.0, y=0.0, **changes) -> NDArray[np.float32]:
        projection = Projection.from_pose(pose[0] + x, pose[1] + y, *pose[2:], 4)
        return expected_image(MASK, projection, appearance.with_(**changes), CAMERA)

    field = MASK.field_um
    projection = Projection.from_pose(*pose, 4)
    signals = expected_signals(MASK, projection, appearance, CAMERA)
    ones = np.eye(6)[0]
    # by X and Y the change of the corrections (shift, kurtosis at corners) is left out
    appearance = appearance.with_(edge_shift_um=0.0, kurtosis=0.0)
    signals[:2] = expected_signals(MASK, projection, appearance, CAMERA, (0, 1))
    for k, direction in enumerate(("x", "y")):
        found = _central_difference(lambda d, at=direction: image(**{at: d}), 0.3) * field
        assert np.abs(signals[k] - found).max() < 0.005 * np.abs(found).max()
    appearance = appearance.with_(edge_shift_um=1.5, kurtosis=0.4)
    for k, name in ((2, "dark"), (3, "light")):
        old = getattr(appearance, name)
        found = _central_difference(lambda d, n=name, o=old: image(**{n: o + d * ones}), 1.0)
        assert np.abs(signals[k] - found).max() < 1e-4

    appearance = appearance.with_(edge_shift_um=0.0)
    signals[4] = expected_signals(MASK, projection, appearance, CAMERA, (4,))[0]

    def by_variance(d: float) -> NDArray[np.float32]:
        blur = np.sqrt(5.0**2 + d)
        return image(blur_um=blur, kurtosis=0.4 * (5.0 / blur) ** 4)

    found = _central_difference(by_variance, 0.5)
    assert np.abs(signals[4] - found).max() < 0.06 * np.abs(found).max()
    appearance = appearance.with_(edge_shift_um=1.5)
    found = _central_difference(lambda d: image(edge_shift_um=1.5 + d), 0.1) * field
    assert np.abs(signals[5] - found).max() < 1e-3 * np.abs(found).max()
    appearance = appearance.with_(edge_shift_um=0.0)
    found = _central_difference(lambda d: image(kurtosis=0.4 + d / 5.0**4), 20.0)
    # from the nearest entry of the table, not continued from there: it only steers the fit
    assert np.abs(signals[6] - found).max() < 0.25 * np.abs(found).max()


def test_edge_shift_makes_black_larger_by_its_length() -> None:
    # a plain chessboard has contours of length 2 per field: the white area shrinks by 2 e / a
    plain = ChessField(field_um=85.0, code_bits=24)
    projection = Projection.from_pose(85.0 * 12, 85.0 * 12, 7 * PIXEL / 85, 0.0, 1)
    camera = Camera((98, 98), PIXEL)  # 14 x 14 fields of 7 pixels: whole fields only

    def white(shift: float) -> float:
        appearance = Appearance.uniform(0.0, 1.0, 4.0).with_(edge_shift_um=shift)
        return float(expected_image(plain, projection, appearance, camera).mean())

    assert white(0.0) == pytest.approx(0.5, abs=1e-4)
    assert white(1.0) - white(0.0) == pytest.approx(-2 * 1.0 / 85, rel=0.02)


def test_one_corner_is_a_case_of_many() -> None:
    projection = Projection.from_pose(4017.0, 5011.0, 1.0, 0.1, 4)
    appearance = Appearance.uniform(20, 200, 4.5).with_(edge_shift_um=1.0, kurtosis=0.5)
    scene = make_scene(MASK, projection, appearance, CAMERA, kurtosis_signal=True)
    assert scene.reach == 1
    wanted = np.arange(kernels.N_SIGNALS - 1)
    near = kernels.render(*CAMERA.shape, scene, wanted)
    fields, i0, j0 = scene.fields, scene.i0, scene.j0
    wide = MASK.fields(i0 - 3, i0 + fields.shape[1] + 3, j0 - 3, j0 + fields.shape[0] + 3)
    far = kernels.render(
        *CAMERA.shape, scene._replace(reach=3, fields=wide, i0=i0 - 3, j0=j0 - 3), wanted
    )
    size = np.abs(near).max(axis=(1, 2), keepdims=True)
    assert (np.abs(near - far) / size).max() < 2e-4  # what lies beyond the reach


def test_products_are_sums_over_pixels(rng) -> None:
    projection = Projection.from_pose(4017.0, 5011.0, 1.0, 0.1, 4)
    appearance = Appearance.uniform(20, 200, 4.5)
    signals = expected_signals(MASK, projection, appearance, CAMERA).astype(float)
    level = signals[7]
    image = (level + rng.normal(0, 2, level.shape)).astype(np.float32)
    valid = (rng.random(level.shape) < 0.9).astype(np.uint8)
    tiles = np.array([[0, 0], [2, 3], [4, 5]], dtype=np.int32)  # the last one is cut off
    scene = make_scene(MASK, projection, appearance, CAMERA, kurtosis_signal=True)
    products, counts = tile_products(image, valid, scene, (0.3, 0.01), tiles)
    upper = np.triu_indices(8)
    for (row, column), product, count in zip(tiles, products, counts, strict=True):
        here = slice(16 * row, 16 * row + 16), slice(16 * column, 16 * column + 16)
        s = signals[(slice(None), *here)].copy()
        s[7] = image[here] - level[here]
        weight = valid[here] / (0.3 + 0.01 * level[here])
        assert count == valid[here].sum()
        expected = np.einsum("aij,bij,ij->ab", s, s, weight)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.abs((product - expected[upper]) / scale[upper]).max() < 1e-4


def test_profile_table_is_the_folded_gaussian() -> None:
    table = edge_table(0.05, (0.08, 0.02))
    nodes, weights = leggauss(40)
    d = np.arange(len(table.values)) * table.step - table.limit
    expected = sum(
        wa * wb / 4 * ndtr((d - 0.04 * a - 0.01 * b) / 0.05)
        for a, wa in zip(nodes, weights, strict=True)
        for b, wb in zip(nodes, weights, strict=True)
    )
    assert np.abs(table.values[:, 0] - expected).max() < 1e-6
    slope = np.gradient(expected, d)
    assert np.abs(table.values[1:-1, 1] - slope[1:-1]).max() < 2e-3 * slope.max()


def test_too_much_blur_is_refused() -> None:
    projection = Projection.from_pose(4017.0, 5011.0, 1.0, 0.0, 4)
    with pytest.raises(ValueError, match="no contrast would be left"):
        pattern(projection, 12.0)
