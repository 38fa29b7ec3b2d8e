"""Uneven light, dust and stains: factors on the light that reaches a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rasnik.imaging.deviations import Deviations
from rasnik.imaging.effects.base import Context, Effect, Image, check_range, effect

__all__ = ["Dust", "Stains", "UnevenLight"]


def _lit(change: Deviations, factor: Image) -> Deviations:
    before = change.illumination
    return replace(change, illumination=factor if before is None else before * factor)


@effect(
    "uneven_light",
    "the light falls off from the middle to the corner by this part, as the square of the radius",
    unit="",
    stage="light",
    reference="section 2, illumination of the mask",
)
@dataclass(frozen=True)
class UnevenLight(Effect):
    """`slope`: relative change from the left to the right edge on top of it."""

    fall: float = 0.2
    slope: float = 0.0

    def __post_init__(self) -> None:
        check_range("uneven_light", self.fall, -1, 1)
        check_range("uneven_light: slope", self.slope, -1.9, 1.9)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        u, v = context.points(replace(change, points_um=None))
        square = u**2 + v**2
        factor = 1 - self.fall * square / square.max() + self.slope * u / np.ptp(u)
        return _lit(change, np.maximum(factor, 0.0))


def _blots(
    context: Context, name: str, count: float, radius_px: float, depth: float, soft: float
) -> Image:
    """1 - depth within `count` discs, Poisson in number, exponential in radius."""
    rng = context.rng(name)
    height, width = context.shape
    factor = np.ones((height, width))
    for _ in range(int(rng.poisson(count))):
        row, column = rng.uniform(0, height), rng.uniform(0, width)
        radius = radius_px * max(rng.exponential(), 0.2)
        reach = int(np.ceil(radius + 4 * soft * radius + 1))
        r0, r1 = max(int(row) - reach, 0), min(int(row) + reach + 1, height)
        c0, c1 = max(int(column) - reach, 0), min(int(column) + reach + 1, width)
        distance = np.hypot(np.arange(r0, r1)[:, None] - row, np.arange(c0, c1) - column)
        edge = (distance - radius) / max(soft * radius, 0.25)
        factor[r0:r1, c0:c1] *= 1 - depth / (1 + np.exp(np.clip(edge, -50, 50)))
    return factor


@effect(
    "dust",
    "opaque specks on the sensor's window, this many on average",
    unit="specks",
    stage="light",
    reference="not in the paper; seen on real images",
)
@dataclass(frozen=True)
class Dust(Effect):
    """`radius_px`: mean radius in pixels; `depth`: part of the light that a speck takes."""

    count: float = 10.0
    radius_px: float = 3.0
    depth: float = 0.8

    def __post_init__(self) -> None:
        check_range("dust", self.count, 0, 1e5)
        check_range("dust: radius_px", self.radius_px, 0.1, 1e4)
        check_range("dust: depth", self.depth, 0, 1)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        return _lit(
            change, _blots(context, "dust", self.count, self.radius_px, self.depth, soft=0.1)
        )


@effect(
    "stains",
    "large faint stains out of focus, this many on average",
    unit="stains",
    stage="light",
    reference="not in the paper; seen on real images",
)
@dataclass(frozen=True)
class Stains(Effect):
    """`radius_px`: mean radius in pixels; `depth`: part of the light that a stain takes."""

    count: float = 5.0
    radius_px: float = 30.0
    depth: float = 0.1

    def __post_init__(self) -> None:
        check_range("stains", self.count, 0, 1e5)
        check_range("stains: radius_px", self.radius_px, 0.1, 1e4)
        check_range("stains: depth", self.depth, 0, 1)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        return _lit(
            change, _blots(context, "stains", self.count, self.radius_px, self.depth, soft=0.4)
        )
