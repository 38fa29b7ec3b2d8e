"""The code: every position right or declared unknown, whichever way the mask is turned."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from rasnik.analysis.decode import Decoding, decode
from rasnik.analysis.flags import Flag
from rasnik.analysis.fourier import find_lattice
from rasnik.analysis.fourier_pose import fourier_pose
from rasnik.analysis.lattice import Lattice
from rasnik.analysis.readout import LLR_BOUND_BRIGHT, LLR_BOUND_DARK, Readout, read_fields
from rasnik.imaging.montecarlo import exact_pattern
from rasnik.imaging.projection import Projection, wrap_angle
from rasnik.imaging.transfer import GaussianTransfer
from rasnik.mask import ChessField

PIXEL_UM = 6.9
MASK = ChessField(field_um=85.0)
NEGATIVE = ChessField(field_um=85.0, polarity="negative")
SHAPE = (300, 400)
NO_POSITION = Flag.AMBIGUOUS | Flag.NO_CODE


def image_of(
    projection: Projection,
    rng: np.random.Generator,
    *,
    mask: ChessField = MASK,
    shape: tuple[int, int] = SHAPE,
    blur_um: float = 4.5,
    dark: float = 25.0,
    light: float = 220.0,
) -> NDArray[np.float32]:
    pattern = exact_pattern(mask, projection, shape, PIXEL_UM, GaussianTransfer(blur_um))
    expected = dark + (light - dark) * pattern
    noise = rng.normal(size=shape) * np.sqrt(0.26 + 0.011 * np.maximum(expected, 0))
    return np.rint(expected + noise).astype(np.float32)


def decoded(
    image: NDArray, mask: ChessField = MASK, orientation: int | None = None
) -> tuple[Lattice, Decoding]:
    lattice = find_lattice(image.astype(np.float32), PIXEL_UM)
    assert isinstance(lattice, Lattice), lattice
    return lattice, decode(read_fields(lattice), lattice, mask, orientation)


def assert_position(
    found: Projection | None, truth: Projection, within_fields: float = 0.1
) -> None:
    assert found is not None
    apart = np.hypot(found.x_um - truth.x_um, found.y_um - truth.y_um)
    assert apart < within_fields * MASK.field_um, apart


# ------------------------------------------------------- the search, without an image


def readout_of(
    mask: ChessField,
    truth: Projection,
    change: NDArray[np.int64],
    fields: tuple[int, int],
    rng: np.random.Generator,
    wrong: float = 0.0,
) -> tuple[Readout, SimpleNamespace]:
    """Evidence of a view of `fields` (columns, rows) about the reference point.

    The lattice's axes are those of the mask changed by `change`, its origin anywhere.
    """
    matrix = change @ (truth.matrix[:2] / mask.field_um)
    matrix[:, 2] += 2 * rng.integers(-50, 50, 2)  # keeps the parity of i + j
    first = np.floor(matrix[:, 2]).astype(int) - np.array(fields) // 2
    i = np.arange(fields[0]) + first[0]
    j = np.arange(fields[1])[:, None] + first[1]
    # centres of the lattice's fields, on the sensor and then on the mask
    inverse = np.linalg.inv(np.vstack([matrix, [0, 0, 1]]))
    p, q = np.broadcast_arrays(i + 0.5, j + 0.5)
    u, v = (row[0] * p + row[1] * q + row[2] for row in inverse[:2])
    x, y = (np.floor(c / mask.field_um).astype(int) for c in truth.to_mask(u, v))
    inverted = mask.inverted(x, y)
    inverted ^= rng.random(inverted.shape) < wrong
    llr = np.where(inverted, LLR_BOUND_DARK, -LLR_BOUND_DARK)
    there = np.ones(llr.shape, dtype=bool)
    readout = Readout(int(first[0]), int(first[1]), llr, there, 1.0 - 2 * inverted, 0.1)
    return readout, SimpleNamespace(matrix=matrix)


CHANGES = [
    np.diag(signs) @ axes
    for axes in (np.eye(2, dtype=int), np.eye(2, dtype=int)[::-1])
    for signs in itertools.product((1, -1), repeat=2)
]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("orientation", [1, 2, 3, 4])
def test_any_labelling_of_the_lattice_gives_the_same_position(orientation, change, rng) -> None:
    for _ in range(5):
        x, y = rng.uniform(2000, 190_000, 2)
        truth = Projection.from_pose(x, y, 1.0, rng.uniform(-0.6, 0.6), orientation)
        readout, lattice = readout_of(MASK, truth, change, (30, 26), rng)
        decoding = decode(readout, lattice, MASK)
        assert decoding.flags == Flag.NONE
        assert decoding.orientation == orientation
        np.testing.assert_allclose(decoding.projection.matrix, truth.matrix, atol=1e-6)
        assert decoding.lines_read == decoding.lines_in_view


def test_three_per_cent_wrong_fields_never_give_a_wrong_position(rng) -> None:
    unknown = 0
    for _ in range(150):
        x, y = rng.uniform(2000, 190_000, 2)
        truth = Projection.from_pose(x, y, 1.0, rng.uniform(-0.6, 0.6), rng.integers(1, 5))
        readout, lattice = readout_of(
            MASK, truth, CHANGES[rng.integers(8)], (24, 24), rng, wrong=0.03
        )
        decoding = decode(readout, lattice, MASK)
        if decoding.ok:
            np.testing.assert_allclose(decoding.projection.matrix, truth.matrix, atol=1e-6)
        else:
            unknown += 1
    assert unknown <= 8


@pytest.mark.parametrize("fields", [(2, 0), (0, 2), (-2, 2), (18, 0), (9, 81)])
def test_a_torn_view_reads_as_one_of_its_parts_or_not_at_all(fields, rng) -> None:
    """Two parts of one lattice, whole fields apart on the mask."""
    unknown = 0
    for _ in range(60):
        seed, orientation = rng.integers(2**32), rng.integers(1, 5)
        views = []
        x, y = rng.uniform(10_000, 180_000, 2)
        for moved in ((0, 0), fields):
            truth = Projection.from_pose(
                x + 85 * moved[0], y + 85 * moved[1], 1.0, 0.01, orientation
            )
            # the same lattice, whatever the code
            own = np.random.default_rng(seed)
            views.append((truth, *readout_of(MASK, truth, CHANGES[0], (58, 44), own)))
        (first, upper, lattice), (second, lower, _) = views
        row = rng.integers(3, 42)
        torn = replace(upper, llr=np.concatenate([upper.llr[:row], lower.llr[row:]]))
        decoding = decode(torn, lattice, MASK)
        unknown += not decoding.ok
        if decoding.ok:
            found = decoding.projection
            apart = min(
                np.hypot(found.x_um - one.x_um, found.y_um - one.y_um) for one in (first, second)
            )
            assert apart < 0.1
    assert unknown < 60


@pytest.mark.parametrize("bits", [4, 6, 10])
def test_other_code_lengths_and_extents(bits: int, rng) -> None:
    mask = ChessField(field_um=85.0, code_bits=bits, first_column=3, columns=9, first_row=5, rows=8)
    x = (3 + rng.uniform(2.5, 6.5)) * mask.period * 85.0
    y = (5 + rng.uniform(2.5, 5.5)) * mask.period * 85.0
    truth = Projection.from_pose(x, y, 1.0, 0.2, 2)
    readout, lattice = readout_of(mask, truth, CHANGES[3], (2 * bits + 4, 2 * bits + 4), rng)
    decoding = decode(readout, lattice, mask)
    assert decoding.ok
    np.testing.assert_allclose(decoding.projection.matrix, truth.matrix, atol=1e-6)
    for other in {4, 6, 8, 10} - {bits}:
        wrong = decode(readout, lattice, ChessField(field_um=85.0, code_bits=other))
        assert not wrong.ok


def test_codes_that_the_mask_does_not_have_are_not_found(rng) -> None:
    truth = Projection.from_pose(100_000, 100_000, 1.0, 0.0, 1)
    readout, lattice = readout_of(MASK, truth, CHANGES[0], (30, 30), rng)
    part = ChessField(field_um=85.0, columns=100, rows=100)
    assert not decode(readout, lattice, part).ok


def test_orientation_must_be_one_of_four(rng) -> None:
    truth = Projection.from_pose(100_000, 100_000, 1.0, 0.0, 1)
    readout, lattice = readout_of(MASK, truth, CHANGES[0], (30, 30), rng)
    with pytest.raises(ValueError, match="orientation must be 1, 2, 3 or 4"):
        decode(readout, lattice, MASK, orientation=5)


# ------------------------------------------------------------------------ from images


@pytest.mark.parametrize("mask", [MASK, NEGATIVE])
@pytest.mark.parametrize("orientation", [1, 2, 3, 4])
def test_orientation_and_polarity_are_found(orientation: int, mask: ChessField, rng) -> None:
    for theta in (-0.72, -0.2, 0.001, 0.5):
        x, y = rng.uniform(5000, 180_000, 2)
        truth = Projection.from_pose(x, y, 0.8, theta, orientation)
        _, decoding = decoded(image_of(truth, rng, mask=mask))
        assert_position(decoding.projection, truth)
        assert decoding.ok and decoding.orientation == orientation
        assert decoding.polarity == mask.polarity
        assert decoding.best.theta_rad == pytest.approx(theta, abs=1e-3)
        assert bool(decoding.flags & Flag.QUARTER_TURN) == (abs(theta) > 0.7)


@pytest.mark.parametrize("theta", np.radians([-170, -100, -60, 60, 91, 179]))
@pytest.mark.parametrize("orientation", [1, 2, 3, 4])
def test_fixed_orientation_allows_the_full_circle(orientation: int, theta: float, rng) -> None:
    x, y = rng.uniform(5000, 180_000, 2)
    truth = Projection.from_pose(x, y, 0.8, theta, orientation)
    _, decoding = decoded(image_of(truth, rng), orientation=orientation)
    assert decoding.flags == Flag.NONE
    assert_position(decoding.projection, truth)
    assert decoding.best.theta_rad == pytest.approx(theta, abs=1e-3)


def test_a_quarter_turn_reads_as_a_mirror_image_with_x_and_y_exchanged(rng) -> None:
    """Column and row codes look alike: the reading with the smaller rotation is reported."""
    truth = Projection.from_pose(50_000, 120_000, 0.8, np.pi / 2 + 0.1, 1)
    _, decoding = decoded(image_of(truth, rng))
    assert decoding.ok and decoding.orientation in (2, 3)
    assert abs(wrap_angle(decoding.best.theta_rad)) == pytest.approx(0.1, abs=1e-3)
    assert_position(decoding.projection, truth.exchanged())


@pytest.mark.parametrize("blur_fields", [1 / 3, 0.45])
def test_blur_of_a_third_of_a_field_and_more(blur_fields: float, rng) -> None:
    for _ in range(4):
        x, y = rng.uniform(5000, 180_000, 2)
        truth = Projection.from_pose(x, y, 0.8, rng.uniform(-0.7, 0.7), 4)
        blur = blur_fields * MASK.field_um * 0.8
        _, decoding = decoded(image_of(truth, rng, blur_um=blur, dark=60, light=80))
        assert decoding.ok
        assert_position(decoding.projection, truth)


def test_five_per_cent_of_dust(rng) -> None:
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for _ in range(6):
        x, y = rng.uniform(5000, 180_000, 2)
        truth = Projection.from_pose(x, y, 0.7, rng.uniform(-0.7, 0.7), 4)
        image = image_of(truth, rng, blur_um=8.0)
        dusty = np.zeros(SHAPE, dtype=bool)
        while dusty.mean() < 0.05:
            r, c = rng.uniform(0, SHAPE[0]), rng.uniform(0, SHAPE[1])
            blob = np.hypot(row - r, column - c) < np.exp(rng.uniform(0.7, 3.3))
            image[blob] = 25 + (image[blob] - 25) * rng.uniform(0, 0.5)
            dusty |= blob
        _, decoding = decoded(image)
        assert decoding.ok
        assert_position(decoding.projection, truth)


def test_evidence_is_bounded_and_blur_corrected(rng) -> None:
    truth = Projection.from_pose(50_000, 120_000, 0.8, 0.2, 4)
    lattice, _ = decoded(image_of(truth, rng, blur_um=0.3 * 85 * 0.8))
    readout = read_fields(lattice)
    assert np.abs(readout.llr).max() <= LLR_BOUND_BRIGHT + 0.1
    assert not readout.llr[~readout.present].any()
    # without correction plain fields would differ by the number of their inverted neighbours
    plain = readout.value[readout.present & (readout.llr < 0)]
    assert plain.mean() == pytest.approx(1, abs=0.03) and plain.std() < 0.1


def test_edge_of_the_mask_in_view(rng) -> None:
    """Beyond the edge all is dark, which must not be taken for inverted fields."""
    for theta, x in ((0.0, 300.0), (0.4, 0.0), (-0.7, 600.0)):
        truth = Projection.from_pose(x, 77_000.0, 0.6, theta, 3)
        _, decoding = decoded(image_of(truth, rng))
        assert decoding.ok
        assert_position(decoding.projection, truth)
    # the far corner: codes 255 and 255
    truth = Projection.from_pose(2304 * 85.0 - 700, 2304 * 85.0 - 500, 0.6, 0.1, 1)
    _, decoding = decoded(image_of(truth, rng))
    assert_position(decoding.projection, truth)


# -------------------------------------------------------------- what must not be decoded


def test_single_pivot_is_ambiguous_and_the_truth_is_among_the_candidates(rng) -> None:
    x, y = MASK.pivot_um(77, 130)
    truth = Projection.from_pose(x + 40, y + 40, 2.4, 0.03, 4)  # 13 x 10 fields
    lattice, decoding = decoded(image_of(truth, rng))
    assert decoding.flags & Flag.AMBIGUOUS and not decoding.ok
    assert len({one.orientation for one in decoding.candidates}) > 1
    assert decoding.candidates[0].log_odds == 0
    near = [
        one
        for one in decoding.candidates
        if np.hypot(one.projection.x_um - truth.x_um, one.projection.y_um - truth.y_um) < 8
        and one.orientation == 4
    ]
    assert near
    pose = fourier_pose(lattice, decoding, MASK)
    assert not pose.ok and np.isnan(pose.x_um) and len(pose.candidates) > 1


def test_chessboard_without_code(rng) -> None:
    truth = Projection.from_pose(50_000, 120_000, 0.8, 0.2, 4)
    u = (np.arange(SHAPE[1]) - 199.5) * PIXEL_UM
    v = (np.arange(SHAPE[0])[:, None] - 149.5) * PIXEL_UM
    x, y = truth.to_mask(u, v)
    wave = np.sin(np.pi * x / 85) * np.sin(np.pi * y / 85)
    for dirt in (0.0, 0.1):
        image = 128 + 100 * np.tanh(5 * wave) + rng.normal(0, 1.5, SHAPE)
        image[np.kron(rng.random((30, 40)) < dirt, np.ones((10, 10))) > 0] = 30
        _, decoding = decoded(image)
        assert decoding.flags & Flag.NO_CODE and not decoding.ok


def test_wrong_number_of_code_bits(rng) -> None:
    truth = Projection.from_pose(50_000, 120_000, 0.7, 0.2, 4)
    image = image_of(truth, rng)
    for bits in (5, 7, 9):
        _, decoding = decoded(image, ChessField(field_um=85.0, code_bits=bits))
        assert decoding.flags & NO_POSITION and not decoding.ok


# ------------------------------------------------------------------ vectors and real images


def test_vectors(shared) -> None:
    """The position from the spectrum alone is within five of its own standard deviations."""
    truth = json.loads(shared("vectors/truth.json").read_text())
    for one in truth["images"]:
        with Image.open(shared(f"vectors/{one['file']}")) as file:
            image = np.asarray(file, dtype=np.float32)
        lattice, decoding = decoded(image)
        assert decoding.ok and decoding.orientation == one["orientation"]
        assert decoding.polarity == ("negative" if one["polarity"] else "positive")
        assert decoding.lines_read >= decoding.lines_in_view - 1
        pose = fourier_pose(lattice, decoding, MASK)
        found = np.array([pose.x_um, pose.y_um, pose.scale, pose.theta_rad])
        true = np.array([one[key] for key in ("x_um", "y_um", "scale", "theta_rad")])
        sigma = np.sqrt(np.diag(pose.covariance))
        assert (np.abs(found - true) < 5 * sigma).all(), (one["file"], (found - true) / sigma)


def _real(shared, name: str) -> tuple[Decoding, dict]:
    reference = json.loads(shared("real/reference.json").read_text())
    one = next(row for row in reference if name in row["file"])
    with Image.open(shared(f"real/{one['file']}")) as file:
        image = np.asarray(file.convert("L"), dtype=np.float32)
    lattice = find_lattice(image, one["pixel_um"])
    assert isinstance(lattice, Lattice)
    mask = ChessField(field_um=one["field_um"])
    return decode(read_fields(lattice), lattice, mask), one


@pytest.mark.parametrize(
    "name", ["benchmark", "blurred", "dust", "rotated", "slanted", "small_squares"]
)
def test_real_images_decode(name: str, shared) -> None:
    decoding, one = _real(shared, name)
    assert decoding.ok, decoding.flags.names
    found = decoding.projection
    apart = np.hypot(found.x_um - one["x_um"], found.y_um - one["y_um"])
    assert apart < 0.1 * one["field_um"]
    assert decoding.orientation == one["orientation"]
    assert decoding.best.theta_rad == pytest.approx(one["rotation_mrad"] / 1e3, abs=0.005)


def test_real_contact_print_shows_one_pivot_and_is_ambiguous(shared) -> None:
    decoding, one = _real(shared, "contact")
    assert decoding.flags & Flag.AMBIGUOUS
    best = [c for c in decoding.candidates if c.log_odds > -1]
    assert {c.orientation for c in best} == {1, 2, 3, 4}
    assert any(
        np.hypot(c.projection.x_um - one["x_um"], c.projection.y_um - one["y_um"]) < 10
        for c in best
    )
