"""Sizes of the error sources that a system file does not state; each can be replaced.

Defaults are the paper's where it gives one, otherwise usual values, to be replaced by those of
the parts in hand.
"""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rasnik._config import SystemConfigError, apply_overrides, parse_overrides, sentences

__all__ = ["Assumptions", "assume"]


class Assumptions(BaseModel):
    """What a budget assumes. The description of each field states its unit."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    mask_edge_nm: float = Field(
        default=6.0, ge=0, le=1e5, description="nm rms, error of a contour's position (paper)"
    )
    mask_edge_samples: float | None = Field(
        default=None,
        gt=0,
        le=1e12,
        description="independent samples of contour in view (paper: 1.5e4); unset: one per row "
        "or column of physical pixels that a contour crosses",
    )
    mask_scale_error: float = Field(
        default=1e-7, ge=0, le=0.1, description="relative error of the mask's scale as printed"
    )
    mask_expansion_per_k: float = Field(
        default=5.5e-7, ge=0, le=1e-3, description="1/K, of the mask (fused silica)"
    )
    mask_temperature_k: float = Field(
        default=0.1, ge=0, le=1e3, description="K, change of the mask's temperature"
    )
    mask_distance_mm: float = Field(
        default=1.0, ge=0, le=1e4, description="mm, from where the mask is held to where it is read"
    )
    sensor_expansion_per_k: float = Field(
        default=2.6e-6, ge=0, le=1e-3, description="1/K, of silicon (paper)"
    )
    sensor_temperature_k: float = Field(
        default=1.0, ge=0, le=1e3, description="K, change of the sensor's temperature"
    )
    gain_spread: float = Field(
        default=0.01, ge=0, le=1, description="relative rms spread of the pixels' gain"
    )
    pedestal_grey: float = Field(
        default=0.3, ge=0, le=1e4, description="grey rms spread of the pixels' pedestal"
    )
    flicker: float = Field(
        default=1e-4, ge=0, le=1, description="relative rms slow change of each pixel's gain"
    )
    crosstalk: float = Field(
        default=0.01, ge=0, le=0.5, description="share of a pixel's signal that its 4 sides get"
    )
    pixel_place_nm: float = Field(
        default=5.0, ge=0, le=1e5, description="nm rms on the sensor, place of each pixel"
    )
    column_place_nm: float = Field(
        default=5.0, ge=0, le=1e5, description="nm rms on the sensor, place of columns and rows"
    )
    distortion: float = Field(
        default=1e-4, ge=0, le=0.1, description="radial: displacement / radius at the corners"
    )
    light_third_order: float = Field(
        default=0.01, ge=0, le=1, description="relative uneven light beyond second order, at edges"
    )
    dust_fraction: float = Field(
        default=0.01, ge=0, lt=1, description="share of the pixels lost to dust and stains"
    )
    air_gradient_k_per_m: float = Field(
        default=1.0, ge=0, le=1e4, description="K/m, steady temperature gradient across the light"
    )
    air_turbulence_k_per_m: float = Field(
        default=0.1, ge=0, le=1e4, description="K/m rms, changing temperature gradient"
    )
    air_pressure_hpa: float = Field(default=1013.25, ge=0, le=1e5, description="hPa; 0: vacuum")
    air_temperature_k: float = Field(default=293.15, gt=0, le=2e3, description="K")
    arm_mm: float = Field(
        default=10.0, ge=0, le=1e5, description="mm, holders between parts and what is measured"
    )
    arm_expansion_per_k: float = Field(
        default=1.2e-5, ge=0, le=1e-3, description="1/K, of the holders (steel)"
    )
    arm_temperature_k: float = Field(
        default=0.01, ge=0, le=1e3, description="K, uneven change of the holders' temperature"
    )


def assume(overrides: Iterable[str] = ()) -> Assumptions:
    """Assumptions with some values replaced: ``["mask_edge_nm=3"]``.

    Raises
    ------
    SystemConfigError
        If a name is unknown or a value impossible.
    """
    label = "assumptions"
    data = apply_overrides(Assumptions, label, {}, parse_overrides(label, overrides))
    try:
        return Assumptions.model_validate(data)
    except ValidationError as error:
        raise SystemConfigError(label, sentences(Assumptions, error)) from None
