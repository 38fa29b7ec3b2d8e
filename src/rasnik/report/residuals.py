"""What an image shows beyond the mask at the pose that was found in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.outliers import find_outliers
from rasnik.analysis.parameters import State
from rasnik.analysis.pose import Pose
from rasnik.imaging.appearance import Appearance, Camera, surface
from rasnik.imaging.model import MIN_BLUR_PX, expected_image
from rasnik.instrument import System
from rasnik.mask import ChessField

__all__ = ["residual_image"]

_MOST_PIXELS = 60_000  # that the light is fitted to
_LARGEST_KURTOSIS = 2.0


def _valid(image: NDArray[np.float32], bounds_px: tuple[int, int, int, int] | None) -> Any:
    valid = np.isfinite(image)
    if bounds_px is not None:
        left, top, right, bottom = bounds_px
        inside = np.zeros_like(valid)
        inside[top : bottom + 1, left : right + 1] = True
        valid &= inside
    return valid


def _slopes(
    mask: ChessField, pose: Pose, look: Appearance, camera: Camera
) -> tuple[NDArray[np.float32], list[tuple[str, float, NDArray[np.float32]]]]:
    """The pattern (0 black, 1 white), and its change with each parameter of the edges."""
    projection = pose.projection
    assert projection is not None

    def pattern(**changes: float) -> NDArray[np.float32]:
        return expected_image(mask, projection, look.with_(**changes), camera)

    steps = {
        "blur_um": 0.01 * camera.pixel_um,
        "edge_shift_um": 0.01 * camera.pixel_um / pose.scale,
        "kurtosis": 0.01,
    }
    level = pattern()
    changes = []
    for name, step in steps.items():
        slope = (pattern(**{name: getattr(look, name) + step}) - level) / step
        changes.append((name, step, slope))
    return level, changes


def _fitted_look(
    image: NDArray[np.float32], valid: Any, mask: ChessField, pose: Pose, camera: Camera
) -> Appearance:
    """Light, and small corrections of the edges, that explain the image best at this pose."""
    blur = pose.blur_um if np.isfinite(pose.blur_um) else camera.pixel_um
    shift = pose.edge_shift_um if np.isfinite(pose.edge_shift_um) else 0.0
    look = Appearance.uniform(0.0, 1.0, max(blur, MIN_BLUR_PX * camera.pixel_um))
    look = look.with_(edge_shift_um=shift)
    level, changes = _slopes(mask, pose, look, camera)
    rows, columns = np.nonzero(valid)
    stride = 1 + len(rows) // _MOST_PIXELS
    rows, columns = rows[::stride], columns[::stride]
    height, width = camera.shape
    light = surface(
        2 * columns / width - (width - 1) / width, 2 * rows / height - (height - 1) / height
    )
    white = level[rows, columns]
    terms = [*(light * (1 - white)), *(light * white)]
    terms += [slope[rows, columns] for _, _, slope in changes]
    basis, values = np.array(terms, dtype=np.float64).T, image[rows, columns].astype(np.float64)
    used = np.ones(len(values), dtype=bool)
    for _ in range(4):  # dirt is left out as it shows
        found = np.asarray(np.linalg.lstsq(basis[used], values[used], rcond=1e-10)[0], np.float64)
        residual = values - basis @ found
        spread = 1.4826 * float(np.median(np.abs(residual[used])))
        used = np.abs(residual) <= 5 * spread
    step = float(found[6] - found[0]) or 1.0
    corrections = dict(zip((name for name, _, _ in changes), found[12:] / step, strict=True))
    return replace(
        look,
        dark=found[:6],
        light=found[6:12],
        blur_um=max(look.blur_um + corrections["blur_um"], MIN_BLUR_PX * camera.pixel_um),
        edge_shift_um=look.edge_shift_um + corrections["edge_shift_um"],
        kurtosis=float(np.clip(corrections["kurtosis"], -_LARGEST_KURTOSIS, _LARGEST_KURTOSIS)),
    )


def residual_image(
    image: NDArray[Any],
    pose: Pose,
    system: System,
    bounds_px: tuple[int, int, int, int] | None = None,
) -> NDArray[np.float32]:
    """Image minus the image expected at a pose.

    The appearance is that of the pose or, where it has none (it was found from the spectrum),
    the one that fits the image best.

    Parameters
    ----------
    image : ndarray, shape (H, W)
    pose : Pose
        With a projection.
    system : System
        Its mask, pitch and noise are used.
    bounds_px : tuple of int, optional
        (left, top, right, bottom), the last ones included.

    Returns
    -------
    ndarray of float32, shape (H, W)
        NaN where a pixel is not finite, outside the bounds, or not of the mask: border, dust,
        glint.

    Raises
    ------
    ValueError
        If the pose has no projection.
    """
    if pose.projection is None:
        raise ValueError("the pose has no projection, so no image can be expected from it")
    image = np.asarray(image, dtype=np.float32)
    valid = _valid(image, bounds_px)
    mask = system.mask
    if pose.polarity:
        mask = mask.model_copy(update={"polarity": pose.polarity})
    camera = Camera((image.shape[0], image.shape[1]), system.pitch_um)
    look = pose.appearance or _fitted_look(image, valid, mask, pose, camera)
    state = State(pose.projection, look)
    law = system.noise_law
    noise = (law[0] + 1 / 12, law[1]) if law is not None else None
    finite = np.where(valid, image, 0.0).astype(np.float32)
    kept = find_outliers(finite, valid.astype(np.uint8), state, mask, camera, noise)
    residual = image - expected_image(mask, pose.projection, look, camera)
    return np.where(kept > 0, residual, np.nan).astype(np.float32)
