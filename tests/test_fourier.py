"""The lattice from the spectrum: right for any rotation, scale, blur and light, or a reason.

Images come from the exact generator, which shares no formula with the analysis.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rasnik.analysis.decode import decode
from rasnik.analysis.flags import Flag
from rasnik.analysis.fourier import find_lattice
from rasnik.analysis.fourier_pose import fourier_pose
from rasnik.analysis.lattice import Lattice
from rasnik.analysis.picture import picture_bounds
from rasnik.analysis.pose import Pose
from rasnik.analysis.readout import read_fields
from rasnik.imaging.montecarlo import exact_pattern
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.imaging.transfer import GaussianTransfer
from rasnik.mask import ChessField

PIXEL_UM = 6.9
MASK = ChessField(field_um=85.0)
SMALL = (300, 400)

Image = NDArray[np.float64]


def picture(projection: Projection, shape: tuple[int, int] = SMALL, blur_um: float = 4.5) -> Image:
    """Transmission, 0 to 1."""
    return exact_pattern(MASK, projection, shape, PIXEL_UM, GaussianTransfer(blur_um))


def noisy(expected: Image, rng: np.random.Generator) -> NDArray[np.float32]:
    variance = 0.26 + 0.011 * np.maximum(expected, 0)
    return np.rint(expected + rng.normal(size=expected.shape) * np.sqrt(variance)).astype("f4")


def lattice_of(image: NDArray, **options: object) -> Lattice:
    lattice = find_lattice(image.astype(np.float32), PIXEL_UM, **options)
    assert isinstance(lattice, Lattice), lattice
    return lattice


def misfit_fields(lattice: Lattice, truth: Projection, positive: bool = True) -> float:
    """Largest distance in fields between lattice and mask, at the corners of the picture.

    The lattice may be turned by quarters, mirrored and shifted by whole fields, as long as the
    bright fields stay those with even i + j.
    """
    left, top, right, bottom = lattice.bounds_px
    u, v = sensor_grid_um(lattice.shape, PIXEL_UM)
    u, v = u[[left, right - 1, left, right - 1]], v[[top, top, bottom - 1, bottom - 1]]
    found = np.stack(lattice.to_field(u, v))
    true = np.stack(truth.to_mask(u, v)) / MASK.field_um
    change = true[:, 1:] - true[:, :1]
    change = change @ np.linalg.pinv(found[:, 1:] - found[:, :1])
    turn = np.rint(change)
    assert np.abs(turn).sum() == 2 and abs(np.linalg.det(turn)) == 1, change
    offset = (true - turn @ found).mean(axis=1)
    shift = np.rint(offset)
    # centre (1/2, 1/2) of the bright field (0, 0) must come to lie in a bright field
    i, j = np.floor(turn @ [0.5, 0.5] + shift).astype(int)
    assert ((i + j) % 2 == 0) == positive
    return float(np.abs(true - turn @ found - shift[:, None]).max())


@pytest.mark.parametrize("orientation", [1, 2, 3, 4])
@pytest.mark.parametrize("theta", np.radians([0, 17, 45, 100, 163, -135, -80, -30]))
def test_lattice_is_right_through_the_full_circle(orientation: int, theta: float, rng) -> None:
    x, y = rng.uniform(10_000, 150_000, 2)
    truth = Projection.from_pose(x, y, rng.uniform(0.6, 1.2), theta, orientation)
    lattice = lattice_of(noisy(30 + 150 * picture(truth), rng))
    assert misfit_fields(lattice, truth) < 0.01
    assert lattice.score > 0.85 and lattice.coverage > 0.95


def test_p_grows_to_the_right_and_q_upward(rng) -> None:
    for theta in (-2.5, -0.7, 0.1, 0.7, 1.5):
        truth = Projection.from_pose(50_000, 60_000, 1.0, theta, 2)
        matrix = lattice_of(200 * picture(truth)).matrix
        assert matrix[0, 0] >= abs(matrix[0, 1]) and -matrix[1, 1] >= abs(matrix[1, 0])


@pytest.mark.parametrize("pixels_per_field", [2.5, 2.9, 4.0, 7.0, 20.0, 30.0])
def test_any_scale_is_found_without_being_told(pixels_per_field: float, rng) -> None:
    scale = pixels_per_field * PIXEL_UM / MASK.field_um * 1.001
    truth = Projection.from_pose(70_000, 40_000, scale, 0.3, 4)
    image = noisy(20 + 200 * picture(truth, blur_um=3.0), rng)
    lattice = lattice_of(image)
    assert lattice.pixels_per_field == pytest.approx(pixels_per_field, rel=2e-3)
    assert misfit_fields(lattice, truth) < 0.02


def test_fields_below_two_and_a_half_pixels_are_refused(rng) -> None:
    truth = Projection.from_pose(70_000, 40_000, 2.3 * PIXEL_UM / MASK.field_um, 0.3, 4)
    image = noisy(20 + 200 * picture(truth, blur_um=3.0), rng)
    assert find_lattice(image, PIXEL_UM) == Flag.FIELD_TOO_SMALL


def test_two_hundred_pixels_per_field() -> None:
    truth = Projection.from_pose(70_000, 40_000, 200 * PIXEL_UM / MASK.field_um, 0.2, 4)
    image = 20 + 200 * picture(truth, shape=(2000, 2600), blur_um=30.0)
    assert misfit_fields(lattice_of(image), truth) < 0.02


@pytest.mark.parametrize("blur_fields", [0.05, 0.2, 1 / 3, 0.45])
def test_blur_is_estimated_and_does_no_harm(blur_fields: float, rng) -> None:
    truth = Projection.from_pose(30_000, 20_000, 1.0, -0.2, 1)
    blur = blur_fields * MASK.field_um
    lattice = lattice_of(noisy(30 + 60 * picture(truth, blur_um=blur), rng))
    assert misfit_fields(lattice, truth) < 0.03
    assert lattice.blur_um == pytest.approx(blur, rel=0.15)


def test_twenty_grey_levels_and_light_falling_to_a_third(rng) -> None:
    truth = Projection.from_pose(30_000, 20_000, 1.0, 1.0, 3)
    light = np.linspace(1, 1 / 3, SMALL[1]) * np.linspace(1, 0.8, SMALL[0])[:, None]
    image = noisy((60 + 20 * picture(truth, blur_um=25.0)) * light, rng)
    assert misfit_fields(lattice_of(image), truth) < 0.05


def test_dark_borders_are_found_and_left_out(rng) -> None:
    truth = Projection.from_pose(30_000, 20_000, 1.0, 0.05, 4)
    image = 30 + 150 * picture(truth)
    image[:, :23] = 12
    image[:9] = 12
    image[:, -5:] = 12
    image = noisy(image, rng)
    assert picture_bounds(image) == (23, 9, SMALL[1] - 5, SMALL[0])
    lattice = lattice_of(image)
    assert lattice.bounds_px == (23, 9, SMALL[1] - 5, SMALL[0])
    assert misfit_fields(lattice, truth) < 0.01


def test_unequal_scales_and_slant(rng) -> None:
    upright = Projection.from_pose(30_000, 20_000, 1.0, 0.4, 4).matrix
    slant = np.array([[1.15, 0.06, 0.0], [0.0, 0.86, 0.0], [0.0, 0.0, 1.0]])
    truth = Projection(upright @ slant)
    assert misfit_fields(lattice_of(noisy(30 + 100 * picture(truth), rng)), truth) < 0.01


@pytest.mark.parametrize("theta", [0.0, 0.6])
def test_mask_in_a_third_of_the_view(theta: float, rng) -> None:
    """Beyond its edge the mask is opaque; the lattice must be right where it is seen."""
    truth = Projection.from_pose(-300, 300 * 85.0, 0.8, theta, 1)
    lattice = lattice_of(noisy(30 + 150 * picture(truth), rng))
    assert 0.2 < lattice.coverage < 0.5
    # at the centroid of the part seen
    column, row = lattice.picture.centroid_px
    u, v = (column - 199.5) * PIXEL_UM, (row - 149.5) * PIXEL_UM
    found, true = np.stack(lattice.to_field(u, v)), np.stack(truth.to_mask(u, v)) / MASK.field_um
    assert true[0] > 2  # it lies on the mask
    apart = np.rint(found - true) - (found - true)
    assert np.abs(apart).max() < 0.01


def test_invalid_and_not_finite_pixels_are_left_out(rng) -> None:
    truth = Projection.from_pose(30_000, 20_000, 1.0, 0.05, 4)
    image = noisy(30 + 150 * picture(truth), rng)
    valid = np.ones(SMALL, dtype=bool)
    image[50:110, 60:150] = 5000
    valid[50:110, 60:150] = False
    image[200:220, 300:320] = np.nan
    lattice = lattice_of(image, valid=valid)
    assert misfit_fields(lattice, truth) < 0.01
    assert lattice.light[0] == pytest.approx(180, abs=5)


def test_dark_and_light_levels_follow_the_light(rng) -> None:
    truth = Projection.from_pose(30_000, 20_000, 1.0, 0.3, 4)
    u = np.linspace(-1, 1, SMALL[1])
    v = np.linspace(-1, 1, SMALL[0])[:, None]
    dark, light = 20 + 3 * u, 180 + 20 * u - 10 * v + 15 * u * v
    pattern = picture(truth, blur_um=20.0)
    lattice = lattice_of(noisy(dark + (light - dark) * pattern, rng))
    assert lattice.dark == pytest.approx([20, 3, 0, 0, 0, 0], abs=4)
    assert lattice.light == pytest.approx([180, 20, -10, 0, 15, 0], abs=6)


def test_noise_is_estimated_from_the_image(rng) -> None:
    truth = Projection.from_pose(30_000, 20_000, 1.0, 0.3, 4)
    image = 100 * picture(truth) + rng.normal(0, 3.0, SMALL)
    assert lattice_of(image).noise_variance == pytest.approx(9.0, rel=0.08)


# ------------------------------------------------------------------ nothing to find


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("constant", Flag.BLANK),
        ("flat field", Flag.BLANK),
        ("dark frame", Flag.BLANK),
        ("white noise", Flag.NO_MASK),
        ("clouds", Flag.NO_MASK),
        ("gradient", Flag.NO_MASK),
        ("stripes", Flag.NO_MASK),
        ("random squares", Flag.NO_MASK),
        ("a few pixels", Flag.NO_MASK),
        ("nothing valid", Flag.NO_MASK),
    ],
)
def test_no_pattern_gives_the_reason(name: str, reason: Flag, rng) -> None:
    u, v = np.arange(SMALL[1]), np.arange(SMALL[0])[:, None]
    image = {
        "constant": lambda: np.full(SMALL, 77.0),
        "flat field": lambda: np.rint(128 + rng.normal(0, 1.3, SMALL)),
        "dark frame": lambda: np.rint(np.abs(rng.normal(2, 1, SMALL))),
        "white noise": lambda: np.clip(rng.normal(128, 20, SMALL), 0, 255),
        "clouds": lambda: 128 + 500 * gaussian_filter(rng.normal(size=SMALL), 5),
        "gradient": lambda: 20 + 0.5 * u + 0.1 * v + rng.normal(0, 1, SMALL),
        "stripes": lambda: 128 + 100 * np.sign(np.sin((u + 0.2 * v) / 4)),
        "random squares": lambda: 200 * np.kron(rng.random((30, 40)) > 0.5, np.ones((10, 10))),
        "a few pixels": lambda: rng.normal(size=(9, 9)),
        "nothing valid": lambda: np.full(SMALL, np.nan),
    }[name]()
    assert find_lattice(image.astype(np.float32), PIXEL_UM) == reason


# --------------------------------------------------------- the spectrum as a method


def pose_of(image: NDArray, **options: object) -> Pose:
    lattice = lattice_of(image, **options)
    return fourier_pose(lattice, decode(read_fields(lattice), lattice, MASK), MASK)


@pytest.mark.parametrize("theta", [0.0, 0.002, 0.02, 0.3])
def test_position_from_the_spectrum_is_linear_to_half_a_nanometre(theta: float, rng) -> None:
    x, y = rng.uniform(10_000, 150_000, 2)
    truth = Projection.from_pose(x, y, 1.0, theta, 4)
    image = 25 + 227 * picture(truth, (540, 720))
    pose = pose_of(image, noise_variance=1.8)
    assert pose.ok and pose.method == "fourier" and pose.orientation == 4
    assert abs(pose.x_um - x) < 0.5e-3 and abs(pose.y_um - y) < 0.5e-3
    assert abs(pose.theta_rad - theta) < 0.2e-6
    assert abs(pose.scale - 1) < 2e-6


def test_code_would_shift_the_phases() -> None:
    """What is taken out for the code matters: several nanometres at this place."""
    truth = Projection.from_pose(12_345.678, 23_456.789, 1.0, 0.002, 4)
    lattice = lattice_of(25 + 227 * picture(truth, (540, 720)), noise_variance=1.8)
    decoding = decode(read_fields(lattice), lattice, MASK)
    assert decoding.projection is not None
    assert abs(decoding.projection.y_um - truth.y_um) > 5e-3
    assert abs(fourier_pose(lattice, decoding, MASK).y_um - truth.y_um) < 0.5e-3


def test_stated_errors_are_those_seen(rng) -> None:
    """Monte Carlo: pulls of all four parameters, about 0.8 nm in x and y."""
    truth = np.array([23_000.4, 51_000.7, 1.0, 0.02])
    expected = 25 + 227 * picture(Projection.from_pose(*truth, 4), (540, 720))
    poses = [pose_of(noisy(expected, rng)) for _ in range(25)]
    found = np.array([[p.x_um, p.y_um, p.scale, p.theta_rad] for p in poses])
    sigma = np.array([np.sqrt(np.diag(p.covariance)) for p in poses])
    pulls = (found - truth) / sigma
    # 100 numbers: the rms is uncertain by 7 per cent
    assert 0.78 < np.sqrt((pulls**2).mean()) < 1.25
    assert np.abs(pulls).max() < 4.5
    assert sigma[:, :2].mean() == pytest.approx(0.82e-3, rel=0.1)


def test_ambiguous_or_absent_gives_no_numbers(rng) -> None:
    nothing = fourier_pose(Flag.NO_MASK, None, MASK)
    assert not nothing.ok and np.isnan(nothing.x_um) and nothing.flags == Flag.NO_MASK
    # 11 x 8 fields: one pivot at most
    truth = Projection.from_pose(50_123, 60_321, 3.0, 0.0, 4)
    pose = pose_of(noisy(25 + 227 * picture(truth), rng))
    assert not pose.ok and np.isnan(pose.x_um) and pose.error
