"""Where the pixels of the sensor really lie."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rasnik.imaging.deviations import Deviations
from rasnik.imaging.effects._matrix import magnified
from rasnik.imaging.effects.base import Context, Effect, Image, check_range, effect
from rasnik.imaging.projection import Projection

__all__ = ["ColumnWidths", "DeadArea", "PixelPositions", "RowWidths", "SensorTemperature"]

_PAPER = "section 3, Pixel, row and column geometry"


def _accumulated(widths: Image) -> Image:
    """Displacement of each line from the errors of all widths; none on average."""
    at = np.cumsum(widths) - widths / 2
    return np.asarray(at - at.mean())


@effect(
    "pixel_positions",
    "every pixel lies a little off its place, Gaussian in u and v",
    unit="um rms",
    stage="geometry",
    reference=_PAPER,
)
@dataclass(frozen=True)
class PixelPositions(Effect):
    rms_um: float = 0.01

    def __post_init__(self) -> None:
        check_range("pixel_positions", self.rms_um, 0, 1e3)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        u, v = context.points(change)
        du, dv = self.rms_um * context.rng("pixel_positions").standard_normal((2, *u.shape))
        return replace(change, points_um=(u + du, v + dv))


@effect(
    "column_widths",
    "every column is a little too wide or narrow and displaces those after it",
    unit="um rms",
    stage="geometry",
    reference=_PAPER,
)
@dataclass(frozen=True)
class ColumnWidths(Effect):
    rms_um: float = 0.001

    def __post_init__(self) -> None:
        check_range("column_widths", self.rms_um, 0, 1e3)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        u, v = context.points(change)
        widths = context.rng("column_widths").standard_normal(u.shape[1:])
        return replace(change, points_um=(u + _accumulated(self.rms_um * widths), v))


@effect(
    "row_widths",
    "every row is a little too high or low and displaces those after it",
    unit="um rms",
    stage="geometry",
    reference=_PAPER,
)
@dataclass(frozen=True)
class RowWidths(Effect):
    rms_um: float = 0.001

    def __post_init__(self) -> None:
        check_range("row_widths", self.rms_um, 0, 1e3)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        u, v = context.points(change)
        heights = context.rng("row_widths").standard_normal(u.shape[:1])
        return replace(change, points_um=(u, v + _accumulated(self.rms_um * heights)[:, None]))


@effect(
    "dead_area",
    "a gap between the light-sensitive squares of neighbouring pixels",
    unit="um",
    stage="geometry",
    reference="section 4, inter-pixel dead area",
)
@dataclass(frozen=True)
class DeadArea(Effect):
    gap_um: float = 0.5

    def __post_init__(self) -> None:
        check_range("dead_area", self.gap_um, 0)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        return replace(change, gap_um=self.gap_um)


@effect(
    "sensor_temperature",
    "the sensor is warmer and has grown about its middle, pixels included",
    unit="K",
    stage="geometry",
    reference="section 3, Temperature effects: silicon 2.6e-6/K",
)
@dataclass(frozen=True)
class SensorTemperature(Effect):
    kelvin: float = 1.0
    cte_per_k: float = 2.6e-6

    def projection(self, projection: Projection, context: Context) -> Projection:
        return magnified(projection, 1 + self.kelvin * self.cte_per_k)
