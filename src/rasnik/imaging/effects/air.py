"""Air between mask and sensor: gradients of its refractive index, and fans against them.

A ray curves by the gradient g of the refractive index across it: along the path z it lies at
``slope z + g z^2 / 2`` about the centre of the lens. The ray that ends on the reference point
of the sensor, at a distance b behind the lens, has left the mask, a distance in front, at
``g a (a + b) / 2``: the shift grows as the square of the distances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.imaging.effects.base import Context, Effect, Image, check_range, effect
from rasnik.instrument import System

__all__ = ["AirFluctuation", "AirGradient", "FanMixing", "bending_um", "relaxing_noise"]

#: Change of the refractive index of air with temperature, 1/K, at 20 C, 1 bar, visible light.
INDEX_PER_KELVIN = -0.93e-6


def bending_um(system: System, kelvin_per_m: float) -> float:
    """Shift on the mask of the point seen, towards which the temperature falls if negative.

    Raises
    ------
    ValueError
        If the system does not state its distances.
    """
    a, b = system.geometry.mask_lens_mm, system.geometry.lens_sensor_mm
    if a is None or b is None:
        raise ValueError(
            f"the distances of system {system.name} are not known: give geometry.mask_lens_mm "
            "and geometry.lens_sensor_mm for effects of the air"
        )
    gradient_per_m = INDEX_PER_KELVIN * kelvin_per_m
    return float(gradient_per_m * (a * 1e-3) * (a + b) * 1e-3 / 2 * 1e6)


def relaxing_noise(
    frames: int, rate_hz: float, relaxation_s: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Random walk on a spring: unit variance, forgotten as ``exp(-t / relaxation_s)``."""
    keep = np.exp(-1 / (rate_hz * relaxation_s)) if relaxation_s > 0 else 0.0
    out = rng.standard_normal(frames)
    fresh = np.sqrt(1 - keep**2)
    for k in range(1, frames):
        out[k] = keep * out[k - 1] + fresh * out[k]
    return out


def _along(direction_deg: float) -> NDArray[np.float64]:
    angle = np.deg2rad(direction_deg)
    return np.array([np.cos(angle), np.sin(angle)])


@effect(
    "air_gradient",
    "a steady gradient of the temperature of the air across the light bends the rays",
    unit="K/m",
    stage="air",
    reference="section 3, The propagation of light through air: error ~ distance squared",
)
@dataclass(frozen=True)
class AirGradient(Effect):
    """`direction_deg`: where it grows warmer on the mask, from x towards y."""

    kelvin_per_m: float = 1.0
    direction_deg: float = 90.0

    def shifts_um(self, context: Context) -> Image:
        shift = bending_um(context.system, self.kelvin_per_m) * _along(self.direction_deg)
        return np.tile(shift, (context.frames, 1))


@effect(
    "air_fluctuation",
    "the gradient of the air's temperature wanders, in both directions",
    unit="K/m rms",
    stage="air",
    reference="section 3, The propagation of light through air: density fluctuations",
)
@dataclass(frozen=True)
class AirFluctuation(Effect):
    """`relaxation_s`: time in which it forgets."""

    kelvin_per_m: float = 0.5
    relaxation_s: float = 10.0

    def __post_init__(self) -> None:
        check_range("air_fluctuation", self.kelvin_per_m, 0)
        check_range("air_fluctuation: relaxation_s", self.relaxation_s, 0)

    def shifts_um(self, context: Context) -> Image:
        rms = abs(bending_um(context.system, self.kelvin_per_m))
        return rms * np.stack(
            [
                relaxing_noise(
                    context.frames,
                    context.rate_hz,
                    self.relaxation_s,
                    context.rng("air_fluctuation", axis),
                )
                for axis in (0, 1)
            ],
            axis=1,
        )


@effect(
    "fan_mixing",
    "fans mix the air: this part of the other effects of the air is left, and noise is added",
    unit="",
    stage="air",
    reference="section 3, The propagation of light through air: less bias, more noise",
)
@dataclass(frozen=True)
class FanMixing(Effect):
    """`noise_kelvin_per_m`: rms of the gradient that the fans make, forgotten in `relaxation_s`."""

    left: float = 0.1
    noise_kelvin_per_m: float = 0.5
    relaxation_s: float = 0.05

    def __post_init__(self) -> None:
        check_range("fan_mixing", self.left, 0, 1)
        check_range("fan_mixing: noise_kelvin_per_m", self.noise_kelvin_per_m, 0)
        check_range("fan_mixing: relaxation_s", self.relaxation_s, 0)

    def shift_factor(self) -> float:
        return self.left

    def shifts_um(self, context: Context) -> Image:
        rms = abs(bending_um(context.system, self.noise_kelvin_per_m))
        walk = [
            relaxing_noise(
                context.frames, context.rate_hz, self.relaxation_s, context.rng("fan_mixing", axis)
            )
            for axis in (0, 1)
        ]
        return rms * np.stack(walk, axis=1)
