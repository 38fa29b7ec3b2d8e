"""From what a caller hands over to what the analysis works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from rasnik.analysis.flags import Flag
from rasnik.imaging.appearance import Camera
from rasnik.instrument import System, load_system
from rasnik.mask import ChessField

__all__ = ["ROUNDING_VARIANCE", "Bounds", "Frame", "prepare_frame", "resolve_instrument"]

#: (left, top, right, bottom) pixel of the picture, all four included.
Bounds = tuple[int, int, int, int]

#: Of a grey level rounded to a whole number.
ROUNDING_VARIANCE = 1 / 12
_SMALLEST_PX = 16
_SATURATED_FRACTION = 0.10


@dataclass(frozen=True, eq=False)
class Frame:
    """One image as the fit takes it.

    Attributes
    ----------
    image : ndarray of float32, shape (H, W)
    valid : ndarray of uint8, shape (H, W)
        1 where a pixel may be used.
    picture : ndarray of uint8, shape (H, W)
        1 where there is picture at all, saturated or not.
    camera : Camera
    mask : ChessField
    noise : tuple of float or None
        A and B of the pixel variance A + B g, rounding included; None if unknown.
    """

    image: NDArray[np.float32]
    valid: NDArray[np.uint8]
    picture: NDArray[np.uint8]
    camera: Camera
    mask: ChessField
    noise: tuple[float, float] | None


def resolve_instrument(
    system: System | str | None, field_um: float | None, pixel_um: float | None
) -> tuple[ChessField, float, System | None]:
    """Mask and read-out pitch from a system, or from the two sizes that an analysis needs.

    Raises
    ------
    ValueError
        If neither or both are given, or a size is not positive.
    """
    if system is not None:
        if field_um is not None or pixel_um is not None:
            raise ValueError(
                "give either a system or field_um and pixel_um, not both; "
                "to change a system use an override such as mask.field_um=85"
            )
        loaded = load_system(system)
        return loaded.mask, loaded.pitch_um, loaded
    if field_um is None or pixel_um is None:
        raise ValueError(
            "the size of the fields is needed: give a system, or field_um and pixel_um"
        )
    for name, size in (("field_um", field_um), ("pixel_um", pixel_um)):
        if not (np.isfinite(size) and size > 0):
            raise ValueError(f"{name} must be a positive number of micrometres, not {size!r}")
    return ChessField(field_um=float(field_um)), float(pixel_um), None


def _picture(shape: tuple[int, int], bounds: Bounds | None) -> NDArray[np.uint8]:
    valid = np.ones(shape, dtype=np.uint8)
    if bounds is None:
        return valid
    left, top, right, bottom = (int(edge) for edge in bounds)
    if not (0 <= left < right < shape[1] and 0 <= top < bottom < shape[0]):
        raise ValueError(
            f"bounds {left},{top},{right},{bottom} (left, top, right, bottom) do not lie in order "
            f"inside an image of {shape[1]} x {shape[0]} pixels"
        )
    valid[:] = 0
    valid[top : bottom + 1, left : right + 1] = 1
    return valid


def _full_scale(image: NDArray[np.generic], system: System | None) -> float | None:
    if system is not None:
        return float(system.full_scale)
    if image.dtype.kind in "iu":
        return float(2 ** (8 * image.dtype.itemsize - (image.dtype.kind == "i")) - 1)
    return None


def _leave_out_saturated(at_top: NDArray[np.bool_], valid: NDArray[np.uint8]) -> bool:
    """Mark saturated patches as not valid; returns whether much of the image is at the top.

    Single pixels reach the top by noise; 3 x 3 of them are a glint or overexposed.
    """
    count = np.count_nonzero(at_top)
    if count < 9:
        return False
    row = at_top[:, :-2] & at_top[:, 1:-1] & at_top[:, 2:]
    patch = row[:-2] & row[1:-1] & row[2:]
    if patch.any():
        valid[ndimage.binary_dilation(np.pad(patch, 1), np.ones((3, 3)), iterations=2)] = 0
    return bool(count > _SATURATED_FRACTION * at_top.size)


def prepare_frame(
    image: NDArray[np.generic],
    mask: ChessField,
    pixel_um: float,
    system: System | None,
    bounds: Bounds | None,
) -> tuple[Frame, Flag]:
    """Check an image and mark the pixels that can be used.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Grey levels, of any integer or float type.

    Returns
    -------
    frame : Frame
    flags : Flag
        NOT_FINITE, SATURATED.

    Raises
    ------
    ValueError
        If the array is not an image, or of another size than the system's.
    """
    array = np.asarray(image)
    if array.ndim != 2 or not (
        np.issubdtype(array.dtype, np.integer) or np.issubdtype(array.dtype, np.floating)
    ):
        raise ValueError(
            f"an image is a two-dimensional array of grey levels, not {array.dtype} of shape "
            f"{array.shape}; convert colour images to grey first"
        )
    if min(array.shape) < _SMALLEST_PX:
        raise ValueError(f"an image of {array.shape[1]} x {array.shape[0]} pixels is too small")
    if system is not None and array.shape != system.shape:
        raise ValueError(
            f"the image has {array.shape[1]} x {array.shape[0]} pixels but the system "
            f"{system.name!r} reads out {system.shape[1]} x {system.shape[0]}; "
            "check sensor.width_px, sensor.height_px and sensor.binning"
        )
    valid = _picture(array.shape, bounds)
    flags = Flag.NONE
    grey = np.ascontiguousarray(array, dtype=np.float32)
    if np.issubdtype(array.dtype, np.floating):
        finite = np.isfinite(grey)
        if not finite.all():
            flags |= Flag.NOT_FINITE
            valid[~finite] = 0
            grey = np.where(finite, grey, np.float32(0.0))
    picture = valid.copy()
    full = _full_scale(array, system)
    if full is not None and _leave_out_saturated(grey >= full, valid):
        flags |= Flag.SATURATED
    noise = None if system is None else system.noise_law
    if noise is not None and np.issubdtype(array.dtype, np.integer):
        noise = (noise[0] + ROUNDING_VARIANCE, noise[1])
    return Frame(grey, valid, picture, Camera(array.shape, pixel_um), mask, noise), flags
