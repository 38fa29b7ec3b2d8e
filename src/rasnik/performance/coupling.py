"""What changes along when one parameter of an instrument does.

Diffraction ties the blur to wavelength and aperture, the size of pixels ties number, well and
noise of them, the well ties grey levels to electrons. Each rule is named in `notes`.

Source: van der Graaf et al., section 6, "Improvements".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from rasnik.instrument import System, SystemConfigError, load_system

__all__ = ["EXTRA_KEYS", "Coupling", "coupled", "image_cone", "notes"]

#: Quantities that can be varied besides the fields of a system, and what they are.
EXTRA_KEYS = {
    "sensor.area_mm2": "mm^2, area of the sensor at constant pixels and shape",
    "sensor.light_factor": "light relative to the system's",
}
_BLURRING = ("optics.wavelength_nm", "optics.numerical_aperture", "optics.diaphragm_mm")


@dataclass(frozen=True)
class Coupling:
    """The choices that physics leaves open.

    Attributes
    ----------
    blur : {"diffraction", "fixed"}
        Blur on the sensor proportional to wavelength / aperture angle there, or kept.
    light : {"well", "flux"}
        With the frame rate, keep the electrons in a pixel (more light), or the light (fewer
        electrons in each image).
    well : {"area", "pixel"}
        With the pixel size, keep the full well per area or per pixel.
    pixels : {"area", "count"}
        With the pixel size, keep the area of the sensor or the number of pixels.
    """

    blur: Literal["diffraction", "fixed"] = "diffraction"
    light: Literal["well", "flux"] = "well"
    well: Literal["area", "pixel"] = "area"
    pixels: Literal["area", "count"] = "area"


def coupled(system: System, changes: Mapping[str, Any], rules: Coupling | None = None) -> System:
    """The system with some values changed and what depends on them.

    Parameters
    ----------
    system : System
    changes : mapping
        Dotted names to values; names of `EXTRA_KEYS` too.
    rules : Coupling, optional

    Raises
    ------
    SystemConfigError
        If a name or a value is impossible, or what a rule needs is not known.
    """
    rules = rules or Coupling()
    derived: dict[str, Any] = {}
    for rule in (_bit_depth, _pixel_size, _full_well, _area, _light, _frame_rate):
        derived |= rule(load_system(system, derived), changes, rules)
    native = {key: value for key, value in changes.items() if key not in EXTRA_KEYS}
    if "optics.scale" in changes:
        derived |= _distances(system, changes["optics.scale"])
    new = load_system(system, derived | native)
    if rules.blur == "diffraction" and "optics.blur_um" not in changes:
        new = load_system(new, {"optics.blur_um": _diffraction(system, new, changes)})
    return new


def image_cone(system: System) -> float | None:
    """Angle of the light's cone at the sensor, D / b or 2 NA / scale; None if not known."""
    optics = system.optics
    if optics.numerical_aperture is not None:
        return 2 * optics.numerical_aperture / optics.scale
    focal = _focal_length(system)
    if optics.diaphragm_mm is None or focal is None:
        return None
    return optics.diaphragm_mm / (focal * (1 + optics.scale))


def notes(system: System, keys: Iterable[str], rules: Coupling) -> list[str]:
    """What is assumed when the keys are varied, one sentence each."""
    keys = set(keys)
    found = []
    if keys & {*_BLURRING, "optics.scale"}:
        if rules.blur == "fixed":
            found.append("the blur on the sensor is kept")
        elif image_cone(system) is None:
            found.append("the aperture is not known: the blur on the sensor is kept")
        else:
            found.append(
                "the blur on the sensor is proportional to wavelength / angle of the cone of "
                "light there (Br = 1.22 lambda / NA)"
            )
    if "sensor.pixel_um" in keys:
        kept = "area of the sensor" if rules.pixels == "area" else "number of pixels"
        found.append(f"with the pixel size, {kept} and full well per {rules.well} are kept")
    if "sensor.frame_rate_hz" in keys:
        found.append(
            "electrons in a pixel are kept, so light grows with the frame rate"
            if rules.light == "well"
            else "the light is kept, so electrons in a pixel fall with the frame rate"
        )
    if "sensor.full_well_e" in keys:
        found.append("full scale follows the full well; electronic noise in electrons is kept")
    return found


# ------------------------------------------------------------------------- rules


def _bit_depth(system: System, changes: Mapping[str, Any], rules: Coupling) -> dict[str, Any]:
    bits = changes.get("sensor.bit_depth")
    if not isinstance(bits, int) or not 1 <= bits <= 16:  # what is wrong is reported later
        return {}
    ratio = (2**bits - 1) / system.full_scale
    sensor = system.sensor
    found: dict[str, Any] = {"sensor.bit_depth": bits}
    found["sensor.dark_level"] = sensor.dark_level * ratio
    found["sensor.light_level"] = sensor.light_level * ratio
    return found | _noise(system, ratio)


def _noise(system: System, ratio: float) -> dict[str, Any]:
    """The noise law if an electron makes `ratio` times as many grey levels."""
    a, b = system.sensor.noise_a, system.sensor.noise_b
    if a is None or b is None:
        return {}
    return {"sensor.noise_a": a * ratio**2, "sensor.noise_b": b * ratio}


def _pixel_size(system: System, changes: Mapping[str, Any], rules: Coupling) -> dict[str, Any]:
    new = _positive(changes, "sensor.pixel_um")
    if new is None:
        return {}
    sensor, ratio = system.sensor, new / system.sensor.pixel_um
    found: dict[str, Any] = {"sensor.pixel_um": new}
    if rules.pixels == "area":
        found |= _size(system, 1 / ratio)
    if rules.well == "area":
        found |= _noise(system, 1 / ratio**2)
        if sensor.full_well_e is not None:
            found["sensor.full_well_e"] = sensor.full_well_e * ratio**2
    return found


def _size(system: System, factor: float) -> dict[str, Any]:
    sensor = system.sensor
    b = sensor.binning
    width, height = (
        max(b, b * round(side * factor / b)) for side in (sensor.width_px, sensor.height_px)
    )
    return {"sensor.width_px": width, "sensor.height_px": height}


def _full_well(system: System, changes: Mapping[str, Any], rules: Coupling) -> dict[str, Any]:
    new = _positive(changes, "sensor.full_well_e")
    if new is None:
        return {}
    old = system.sensor.full_well_e
    if old is None:
        raise SystemConfigError(
            system.name, ["its full well is not known, so it cannot be varied: give it with --set"]
        )
    return {"sensor.full_well_e": new} | _noise(system, old / new)


def _area(system: System, changes: Mapping[str, Any], rules: Coupling) -> dict[str, Any]:
    new = _positive(changes, "sensor.area_mm2")
    if new is None:
        return {}
    sensor = system.sensor
    area = sensor.width_px * sensor.height_px * sensor.pixel_um**2 * 1e-6
    return _size(system, math.sqrt(new / area))


def _light(system: System, changes: Mapping[str, Any], rules: Coupling) -> dict[str, Any]:
    factor = _positive(changes, "sensor.light_factor")
    return {} if factor is None else _levels(system, factor)


def _levels(system: System, factor: float) -> dict[str, Any]:
    sensor = system.sensor
    return {
        "sensor.dark_level": sensor.dark_level * factor,
        "sensor.light_level": sensor.light_level * factor,
    }


def _frame_rate(system: System, changes: Mapping[str, Any], rules: Coupling) -> dict[str, Any]:
    new = _positive(changes, "sensor.frame_rate_hz")
    old = system.sensor.frame_rate_hz
    if new is None:
        return {}
    if old is None:
        raise SystemConfigError(
            system.name, ["its frame rate is not known, so it cannot be varied: give it with --set"]
        )
    found: dict[str, Any] = {"sensor.frame_rate_hz": new}
    if system.sensor.exposure_s is not None:
        found["sensor.exposure_s"] = system.sensor.exposure_s * old / new
    return found | (_levels(system, old / new) if rules.light == "flux" else {})


def _positive(changes: Mapping[str, Any], key: str) -> float | None:
    """A value to work with; what is not a positive number is left to the check of the system."""
    value = changes.get(key)
    if key in EXTRA_KEYS and value is not None and not (_is_number(value) and value > 0):
        raise SystemConfigError("design", [f"{key} = {value!r} must be a positive number"])
    return float(value) if _is_number(value) and value > 0 else None  # type: ignore[operator,arg-type]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _focal_length(system: System) -> float | None:
    """The lens's, or that of the lens equation."""
    if system.optics.focal_length_mm is not None:
        return system.optics.focal_length_mm
    a, b = system.geometry.mask_lens_mm, system.geometry.lens_sensor_mm
    return a * b / (a + b) if a is not None and b is not None else None


def _distances(system: System, scale: Any) -> dict[str, Any]:
    """The lens equation, where there is a focal length and distances to keep up."""
    focal = _focal_length(system)
    known = system.geometry.mask_lens_mm is not None and system.geometry.lens_sensor_mm is not None
    if focal is None or not known or not (_is_number(scale) and scale > 0):
        return {}
    return {
        "geometry.mask_lens_mm": focal * (1 + 1 / scale),
        "geometry.lens_sensor_mm": focal * (1 + scale),
    }


def _diffraction(old: System, new: System, changes: Mapping[str, Any]) -> float:
    blur = old.optics.blur_um
    if "optics.wavelength_nm" in changes:
        before, after = old.optics.wavelength_nm, new.optics.wavelength_nm
        if before is None or after is None:
            raise SystemConfigError(
                old.name,
                ["its wavelength is not known, so the blur cannot follow it: give "
                 "optics.wavelength_nm with --set, or keep the blur"],
            )  # fmt: skip
        blur *= after / before
    cones = image_cone(old), image_cone(new)
    if cones[0] is not None and cones[1] is not None:
        return blur * cones[0] / cones[1]
    for key in _BLURRING[1:]:
        if key in changes:
            raise SystemConfigError(
                old.name,
                [f"its aperture is not known, so the blur cannot follow {key}: give it with "
                 "--set, or keep the blur"],
            )  # fmt: skip
    return blur
