"""Temperature: closed forms and signs, errors by Monte Carlo."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rasnik.geometry.effects import corrected
from rasnik.geometry.reading import FACING, Placement, projection
from rasnik.geometry.thermal import (
    SILICON_PER_K,
    Expansion,
    holder_effect,
    mask_effect,
    sensor_effect,
)
from rasnik.geometry.three_points import ThreePoints
from rasnik.imaging.projection import Projection

BENCH = ThreePoints(60.0, 90.0, x_um=4000.0, y_um=5000.0)
VALUES = np.array([4000.0, 5000.0, 1.5, 0.02])
NOISE = np.diag([1e-3, 1e-3, 1e-7, 1e-7]) ** 2


def test_a_warm_mask_looks_larger_and_shows_a_point_nearer_to_its_hold() -> None:
    effect = mask_effect(VALUES, Expansion(1e-5, 10.0), (1000.0, 1000.0))
    assert effect.change == pytest.approx([-0.3, -0.4, 1.5e-4, 0], rel=1e-3)


def test_a_warm_mask_is_undone_exactly() -> None:
    # a mask drawn 1 % too large, seen by rays through a pinhole
    strain, held = 0.01, np.array([300.0, -200.0])
    seen = projection(
        Placement([0.5, -0.7, 0], np.eye(3)), [0, 0, 60.0], Placement([0, 0, 150.0], FACING)
    )
    u, v = np.array([[-900.0, 0, 900], [400, 0, -500]])
    X, Y = seen.to_mask(u, v)  # where the rays meet the glass
    label_x, label_y = (held[0] + (X - held[0]) / 1.01, held[1] + (Y - held[1]) / 1.01)
    scale, theta, code = seen.similarity()
    warm = Projection.from_pose(label_x[1], label_y[1], scale * 1.01, theta, code)
    assert np.array(warm.to_mask(u, v)) == pytest.approx(np.array([label_x, label_y]), rel=1e-9)
    values = np.array([label_x[1], label_y[1], scale * 1.01, theta])
    effect = mask_effect(values, Expansion(strain / 20, 20.0), tuple(held))
    found, _ = corrected(values, NOISE, [effect])
    assert found == pytest.approx([X[1], Y[1], scale, theta], rel=1e-12)


def test_a_warm_sensor_sees_a_smaller_image_at_the_same_place() -> None:
    effect = sensor_effect(VALUES, Expansion(SILICON_PER_K, 10.0))
    assert effect.change == pytest.approx([0, 0, -1.5 * 2.6e-5, 0], rel=1e-9)
    # pixels of 1.01 times the pitch: fewer of them to a field
    effect = sensor_effect(np.array([0, 0, 1.5 / 1.01, 0]), Expansion(0.001, 10.0))
    assert 1.5 / 1.01 - effect.change[2] == pytest.approx(1.5, rel=1e-12)


@pytest.mark.parametrize(
    ("element", "length_mm", "expected"),
    [
        ("mask", (100, 0, 0), (-1, 0, 0)),
        ("lens", (0, 100, 0), (0, 1 + 60 / 90, 0)),
        ("sensor", (0, 100, 0), (0, -60 / 90, 0)),
        ("camera", (0, 0, 100), (0, 0, -1.5 / 6e4)),
    ],
)
def test_a_holder_carries_its_element_along(element, length_mm, expected) -> None:
    # 100 mm of 1e-5 / K by 1 K: 1 um
    effect = holder_effect(BENCH, element, length_mm, Expansion(1e-5, 1.0))
    assert effect.change[:3] == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_errors_are_those_of_draws(rng) -> None:
    draws = 10_000
    mask = Expansion(5.5e-7, 4.0, 5e-8, 0.5)
    chip = Expansion(SILICON_PER_K, 10.0, 0.0, 0.7)
    arm = Expansion(1.2e-5, 0.5, 1e-6, 0.1)
    length = (10.0, -20.0, 5.0)

    def effects(mask: Expansion, chip: Expansion, arm: Expansion, values: np.ndarray) -> list:
        return [
            mask_effect(values, mask, (100.0, 200.0)),
            sensor_effect(values, chip),
            holder_effect(BENCH, "lens", length, arm),
        ]

    found, covariance = corrected(VALUES, NOISE, effects(mask, chip, arm, VALUES))
    noisy = VALUES + rng.multivariate_normal(np.zeros(4), NOISE, draws)
    factors = rng.standard_normal((draws, 3, 2))
    drawn = np.array(
        [
            corrected(
                values,
                NOISE,
                effects(
                    *(
                        Expansion(
                            one.per_k + one.sigma_per_k * a, one.kelvin + one.sigma_kelvin * b
                        )
                        for one, (a, b) in zip((mask, chip, arm), factor, strict=True)
                    ),
                    values,
                ),
            )[0]
            for values, factor in zip(noisy, factors, strict=True)
        ]
    )
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), (drawn - found).T)
    # strains are products of Gaussian numbers: their fourth moments are a little larger
    assert np.cov(whitened) == pytest.approx(np.eye(4), abs=4.5 * math.sqrt(3 / draws))


def test_what_makes_no_sense_is_said() -> None:
    with pytest.raises(ValueError, match=r"make 55 % of expansion; the coefficient is wanted per"):
        Expansion(0.55, 1.0)
    with pytest.raises(ValueError, match="not negative"):
        Expansion(1e-6, 1.0, -1e-7)
    with pytest.raises(ValueError, match="not 'table'"):
        holder_effect(BENCH, "table", (1, 0, 0), Expansion(1e-6, 1.0))
    with pytest.raises(ValueError, match="three numbers"):
        holder_effect(BENCH, "lens", (1, 0), Expansion(1e-6, 1.0))
