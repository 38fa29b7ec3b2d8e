"""From light to numbers: fluctuations, full wells, rounding, range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from rasnik.imaging.effects.base import Context, Effect, Image, check_range, effect
from rasnik.instrument import System

__all__ = ["Blooming", "ElectronicNoise", "Rounding", "Saturation", "ShotNoise"]


def _with_noise(system: System, name: str, value: float | None) -> System:
    """The system with another A or B of its noise; one that was not known counts as none."""
    if value is None:
        return system
    sensor = system.sensor
    law = {"noise_a": sensor.noise_a or 0.0, "noise_b": sensor.noise_b or 0.0, name: value}
    return system.model_copy(update={"sensor": sensor.model_copy(update=law)})


@effect(
    "shot_noise",
    "quantum fluctuations of the light: variance B Q at grey level Q, per physical pixel",
    unit="grey, B",
    stage="noise",
    reference="section 3, Quantum fluctuations: shot noise; section 4: B = 0.011",
    always_on=True,
)
@dataclass(frozen=True)
class ShotNoise(Effect):
    """0 switches it off; by default the system's."""

    noise_b: float | None = None

    def __post_init__(self) -> None:
        check_range("shot_noise", self.noise_b or 0.0, 0)

    def system(self, system: System) -> System:
        return _with_noise(system, "noise_b", self.noise_b)


@effect(
    "electronic_noise",
    "noise of a physical pixel in the dark: variance A",
    unit="grey^2, A",
    stage="noise",
    reference="section 3, Quantum fluctuations: shot noise; section 4: A = 0.26",
    always_on=True,
)
@dataclass(frozen=True)
class ElectronicNoise(Effect):
    """0 switches it off; by default the system's."""

    noise_a: float | None = None

    def __post_init__(self) -> None:
        check_range("electronic_noise", self.noise_a or 0.0, 0)

    def system(self, system: System) -> System:
        return _with_noise(system, "noise_a", self.noise_a)


@effect(
    "blooming",
    "charge above the full well spills along the columns; this part of it, the rest is drained",
    unit="",
    stage="read-out",
    reference="section 3, Quantum fluctuations: charge leaks away from the wells",
)
@dataclass(frozen=True)
class Blooming(Effect):
    """`full_grey`: level of a full well, by default full scale. Half spills to either side,
    as far as the next well with room; what reaches the end of the column is lost."""

    share: float = 1.0
    full_grey: float | None = None

    def __post_init__(self) -> None:
        check_range("blooming", self.share, 0, 1)

    def read_out(self, levels: Image, context: Context) -> Image:
        full = context.system.full_scale if self.full_grey is None else self.full_grey
        out = np.ascontiguousarray(levels)
        _spill(out, float(full), self.share)
        return out


@njit(cache=True, nogil=True)
def _spill(levels, full, share):  # type: ignore[no-untyped-def]
    """Excess over `full` moves up and down its column at the same pace, filling what has room."""
    rows = levels.shape[0]
    down, up = np.empty(rows), np.empty(rows)
    for column in range(levels.shape[1]):
        moving = False
        for row in range(rows):
            excess = max(levels[row, column] - full, 0.0)
            levels[row, column] -= excess
            down[row] = up[row] = share * excess / 2
            moving = moving or excess > 0
        while moving:
            moving = False
            for row in range(rows - 1, 0, -1):
                down[row] = down[row - 1]
            for row in range(rows - 1):
                up[row] = up[row + 1]
            down[0] = up[rows - 1] = 0.0
            for row in range(rows):
                arriving = down[row] + up[row]
                if arriving == 0:
                    continue
                taken = min(arriving, max(full - levels[row, column], 0.0))
                levels[row, column] += taken
                left = (arriving - taken) / arriving
                down[row] *= left
                up[row] *= left
                moving = moving or left > 0


@effect(
    "rounding",
    "grey levels are rounded to multiples of this step",
    unit="grey",
    stage="read-out",
    reference="section 3: the 8-bit conversion of the sensor",
    always_on=True,
)
@dataclass(frozen=True)
class Rounding(Effect):
    """0 switches it off; frames are then floating point."""

    step_grey: float = 1.0

    def __post_init__(self) -> None:
        check_range("rounding", self.step_grey, 0)


@effect(
    "saturation",
    "grey levels are limited to 0 and this level",
    unit="grey",
    stage="read-out",
    reference="section 3: full wells at the highest number",
    always_on=True,
)
@dataclass(frozen=True)
class Saturation(Effect):
    """0 switches it off; frames are then floating point. By default full scale."""

    top_grey: float | None = None

    def __post_init__(self) -> None:
        check_range("saturation", self.top_grey or 0.0, 0)
