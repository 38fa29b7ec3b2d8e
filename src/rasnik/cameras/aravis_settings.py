"""Settings of GenICam cameras: asked for within their range, and told as they are in force."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from rasnik.cameras.camera import CameraSettings, SettingRefusedError
from rasnik.cameras.packed_pixels import PIXEL_FORMATS

__all__ = ["apply", "in_force", "prepare"]

# The same levels in fewer bytes, for cameras that send only these.
_PACKED = {"Mono10": ("Mono10p", "Mono10Packed"), "Mono12": ("Mono12p", "Mono12Packed")}
_SMALLEST_PACKET = 576


def prepare(camera: Any, arv: Any, *, negotiate: bool) -> None:
    """What every measurement wants: frame after frame, nothing automatic, large packets.

    Parameters
    ----------
    camera : Aravis.Camera
    arv : module
        Aravis.
    negotiate : bool
        Whether the largest packets that arrive are looked for; some cameras cannot.
    """
    from gi.repository import GLib

    camera.set_acquisition_mode(arv.AcquisitionMode.CONTINUOUS)
    if camera.is_exposure_auto_available():
        camera.set_exposure_time_auto(arv.Auto.OFF)
    if camera.is_gain_auto_available():
        with suppress(GLib.Error):  # some announce it and have it not
            camera.set_gain_auto(arv.Auto.OFF)
    if negotiate and camera.is_gv_device():
        with suppress(GLib.Error):  # it keeps the size it has
            camera.gv_auto_packet_size()


def apply(camera: Any, settings: CameraSettings, name: str) -> None:
    """Set what is not None.

    Raises
    ------
    SettingRefusedError
        With the range that is possible.
    """
    if settings.trigger is not None:
        _set_trigger(camera, settings.trigger, name)
    if settings.pixel_format is not None:
        _set_pixel_format(camera, settings.pixel_format, name)
    elif camera.get_pixel_format_as_string() not in PIXEL_FORMATS:
        raise SettingRefusedError(
            f"{name} sends {camera.get_pixel_format_as_string()}, which are not plain grey levels; "
            f"set pixel_format to one of {_listed(_formats(camera))}."
        )
    if settings.region is not None:
        _set_region(camera, settings.region, name)
    if settings.packet_bytes is not None:
        _set_packet_size(camera, settings.packet_bytes, name)
    if settings.frame_rate_hz is not None:
        if not camera.is_frame_rate_available():
            raise SettingRefusedError(f"the frame rate of {name} cannot be set.")
        bounds = camera.get_frame_rate_bounds()
        _check("frame_rate_hz", settings.frame_rate_hz, bounds, "Hz", name)
        camera.set_frame_rate(settings.frame_rate_hz)
    if settings.exposure_us is not None:
        if not camera.is_exposure_time_available():
            raise SettingRefusedError(f"the exposure of {name} cannot be set.")
        _check("exposure_us", settings.exposure_us, camera.get_exposure_time_bounds(), "us", name)
        camera.set_exposure_time(settings.exposure_us)
    if settings.gain_db is not None:
        if not camera.is_gain_available():
            raise SettingRefusedError(f"the gain of {name} cannot be set.")
        _check("gain_db", settings.gain_db, camera.get_gain_bounds(), "dB", name)
        camera.set_gain(settings.gain_db)


def in_force(camera: Any, trigger: str | None) -> CameraSettings:
    """As the camera tells.

    Parameters
    ----------
    camera : Aravis.Camera
    trigger : str or None
        As it was asked for; cameras tell it in many ways.
    """
    region = camera.get_region()
    return CameraSettings(
        frame_rate_hz=camera.get_frame_rate() if camera.is_frame_rate_available() else None,
        exposure_us=camera.get_exposure_time() if camera.is_exposure_time_available() else None,
        gain_db=camera.get_gain() if camera.is_gain_available() else None,
        pixel_format=_unpacked(camera.get_pixel_format_as_string()),
        region=(region.x, region.y, region.width, region.height),
        trigger=trigger or "free",
        packet_bytes=camera.gv_get_packet_size() if camera.is_gv_device() else None,
    )


def _check(what: str, value: float, bounds: Any, unit: str, name: str) -> None:
    if not bounds.min <= value <= bounds.max:
        raise SettingRefusedError(
            f"{what} of {name} can be {bounds.min:g} to {bounds.max:g} {unit}, not {value:g}."
        )


def _set_trigger(camera: Any, trigger: str, name: str) -> None:
    if trigger == "free":
        camera.clear_triggers()
        return
    inputs = list(camera.dup_available_trigger_sources() or [])
    if trigger not in inputs:
        raise SettingRefusedError(
            f"trigger of {name} can be free, {_listed(inputs)}; not {trigger}."
        )
    camera.set_trigger(trigger)


def _formats(camera: Any) -> list[str]:
    """Those of the camera that can be read."""
    return [one for one in camera.dup_available_pixel_formats_as_strings() if one in PIXEL_FORMATS]


def _set_pixel_format(camera: Any, wanted: str, name: str) -> None:
    possible = _formats(camera)
    for chosen in (wanted, *_PACKED.get(wanted, ())):
        if chosen in possible:
            camera.set_pixel_format_from_string(chosen)
            return
    raise SettingRefusedError(
        f"pixel_format of {name} can be {_listed(possible) or 'none of grey levels'}, not {wanted}."
    )


def _unpacked(pixel_format: str) -> str:
    for name, packed in _PACKED.items():
        if pixel_format in packed:
            return name
    return pixel_format


def _set_region(camera: Any, region: tuple[int, int, int, int], name: str) -> None:
    left, top, width, height = region
    sensor_width, sensor_height = camera.get_sensor_size()
    inside = left >= 0 and top >= 0 and width >= 1 and height >= 1
    if not inside or left + width > sensor_width or top + height > sensor_height:
        raise SettingRefusedError(
            f"region of {name} has to lie within its {sensor_width} x {sensor_height} pixels; "
            f"left {left}, top {top}, width {width}, height {height} does not."
        )
    steps = (
        camera.get_x_offset_increment(),
        camera.get_y_offset_increment(),
        camera.get_width_increment(),
        camera.get_height_increment(),
    )
    if any(value % max(step, 1) for value, step in zip(region, steps, strict=True)):
        raise SettingRefusedError(
            f"region of {name}: left, top, width and height have to be multiples of "
            f"{', '.join(map(str, steps))}; {left}, {top}, {width}, {height} are not."
        )
    camera.set_region(left, top, width, height)


def _set_packet_size(camera: Any, size: int, name: str) -> None:
    if not camera.is_gv_device():
        raise SettingRefusedError(f"{name} is not a network camera; it has no packet size.")
    camera.gv_set_packet_size(size)
    told = camera.gv_get_packet_size()
    if told != size:
        raise SettingRefusedError(
            f"packet_bytes of {name} cannot be {size}; the nearest is {told} "
            f"(at least {_SMALLEST_PACKET}, at most what the network's MTU allows)."
        )


def _listed(names: list[str]) -> str:
    return ", ".join(names)
