"""Errors of the mask: contours, scale, temperature."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

from rasnik.imaging.deviations import Deviations, EdgeErrors
from rasnik.imaging.effects._matrix import magnified
from rasnik.imaging.effects.base import Context, Effect, check_range, effect
from rasnik.imaging.projection import Projection

__all__ = ["MaskEdges", "MaskScale", "MaskTemperature"]


@effect(
    "mask_edges",
    "every segment of a contour of the mask lies a little off, Gaussian",
    unit="nm rms",
    stage="mask",
    reference="section 3, Errors in the coded mask: 6 nm",
)
@dataclass(frozen=True)
class MaskEdges(Effect):
    """`segments` independent segments along each side of a field."""

    rms_nm: float = 6.0
    segments: int = 1

    def __post_init__(self) -> None:
        check_range("mask_edges", self.rms_nm, 0)
        check_range("mask_edges: segments", self.segments, 1, 100)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        seed = zlib.crc32(b"mask_edges") ^ context.seed
        return replace(change, edges=EdgeErrors(self.rms_nm * 1e-3, seed, int(self.segments)))


@effect(
    "mask_scale",
    "the mask is larger by this part, about the point on the optical axis",
    unit="ppm",
    stage="mask",
    reference="section 3, Errors in the coded mask",
)
@dataclass(frozen=True)
class MaskScale(Effect):
    ppm: float = 1.0

    def projection(self, projection: Projection, context: Context) -> Projection:
        return magnified(projection, 1 / (1 + self.ppm * 1e-6))


@effect(
    "mask_temperature",
    "the mask is warmer and has grown, about the point on the optical axis",
    unit="K",
    stage="mask",
    reference="section 3, Temperature effects; fused silica 0.55e-6/K, Zerodur below 1e-9/K",
)
@dataclass(frozen=True)
class MaskTemperature(Effect):
    kelvin: float = 1.0
    cte_per_k: float = 0.55e-6

    def projection(self, projection: Projection, context: Context) -> Projection:
        return magnified(projection, 1 / (1 + self.kelvin * self.cte_per_k))
