"""What gets between a mask and its image: hands, flashes, dust, and nothing to see at all.

Each change takes expected grey levels (H, W), a random generator, and how far the disturbance has
got (0..1); it returns other levels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Levels = NDArray[np.float32]
Change = Callable[[Levels, np.random.Generator, float], Levels]


def _soft_step(distance_px: Levels, soft_px: float) -> Levels:
    """1 where the distance is well below zero, 0 where it is well above."""
    return 0.5 - 0.5 * np.tanh(distance_px / np.float32(2 * soft_px))


def _distance(shape: tuple[int, ...], row: float, column: float, aspect: float = 1.0) -> Levels:
    rows = (np.arange(shape[0], dtype=np.float32)[:, None] - np.float32(row)) * np.float32(aspect)
    columns = np.arange(shape[1], dtype=np.float32) - np.float32(column)
    return np.hypot(rows, columns)


def _hand(levels: Levels, rng: np.random.Generator, phase: float) -> Levels:
    """A soft dark shape that passes; when in the middle it covers 5 to 80 % of the image."""
    height, width = levels.shape
    aspect = rng.uniform(0.6, 1.6)
    radius = np.sqrt(rng.uniform(0.05, 0.8) * height * width * aspect / np.pi)
    angle, depth, soft = rng.uniform(0, 2 * np.pi), rng.uniform(0.7, 1.0), rng.uniform(3, 50)
    way = (phase - 0.5) * rng.uniform(0.2, 1.0) * width
    row, column = height / 2 + way * np.sin(angle), width / 2 + way * np.cos(angle)
    distance = _distance(levels.shape, row, column, aspect) - np.float32(radius)
    return levels * (1 - np.float32(depth) * _soft_step(distance, soft))


def _flash(levels: Levels, rng: np.random.Generator, phase: float) -> Levels:
    return levels + np.float32(np.exp(rng.uniform(np.log(5), np.log(400))))


def _half_flash(levels: Levels, rng: np.random.Generator, phase: float) -> Levels:
    """Light from a side: brighter up to a soft line across the image."""
    height, width = levels.shape
    angle, soft = rng.uniform(0, 2 * np.pi), rng.uniform(2, 60)
    rows = (np.arange(height, dtype=np.float32)[:, None] - height / 2) * np.float32(np.sin(angle))
    columns = (np.arange(width, dtype=np.float32) - width / 2) * np.float32(np.cos(angle))
    side = _soft_step(rows + columns, soft)
    return levels + np.float32(np.exp(rng.uniform(np.log(5), np.log(400)))) * side


def _saturated(levels: Levels, rng: np.random.Generator, phase: float) -> Levels:
    return levels * np.float32(np.exp(rng.uniform(np.log(1.3), np.log(30))))


def _dark(levels: Levels, rng: np.random.Generator, phase: float) -> Levels:
    return np.full_like(levels, rng.uniform(0, 20))


def _grey(levels: Levels, rng: np.random.Generator, phase: float) -> Levels:
    return np.full_like(levels, rng.uniform(20, 260))


def _noise(levels: Levels, rng: np.random.Generator, phase: float) -> Levels:
    return rng.normal(rng.uniform(20, 200), rng.uniform(2, 80), levels.shape).astype(np.float32)


def dust_map(shape: tuple[int, int], rng: np.random.Generator) -> Levels:
    """Share of the light that a few specks of 5 to 30 pixels let pass."""
    passed = np.ones(shape, np.float32)
    for _ in range(rng.integers(1, 6)):
        distance = _distance(shape, rng.uniform(0, shape[0]), rng.uniform(0, shape[1]))
        speck = _soft_step(distance - np.float32(rng.uniform(2.5, 15)), 0.7)
        passed *= 1 - np.float32(rng.uniform(0.3, 0.95)) * speck
    return passed


#: Disturbances through which (a part of) the mask may still be seen, in its place.
PARTS: dict[str, Change] = {
    "hand": _hand, "flash": _flash, "half flash": _half_flash, "saturated": _saturated,
}  # fmt: skip
#: Frames without a mask.
BLANKS: dict[str, Change] = {"dark": _dark, "grey": _grey, "noise": _noise}
