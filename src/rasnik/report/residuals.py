"""What an image shows beyond the mask at the pose that was found in it."""

from __future__ import annotations

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
_MOST_KURTOSIS = 2.0
_STEPS = 3
_LEVEL_0, _LEVEL_1 = np.zeros(6), np.eye(6)[0]


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
) -> tuple[NDArray[np.float32], list[tuple[str, NDArray[np.float32]]]]:
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
        changes.append((name, slope))
    return level, changes


def _fitted_look(
    image: NDArray[np.float32], valid: Any, mask: ChessField, pose: Pose, camera: Camera
) -> Appearance:
    """Light and edges that explain the image best at this pose."""
    blur = pose.blur_um if np.isfinite(pose.blur_um) else camera.pixel_um
    shift = pose.edge_shift_um if np.isfinite(pose.edge_shift_um) else 0.0
    look = Appearance.uniform(0.0, 1.0, max(blur, MIN_BLUR_PX * camera.pixel_um))
    look = look.with_(edge_shift_um=shift)
    for _ in range(_STEPS):
        look = _better_look(image, valid, mask, pose, camera, look)
    return look


def _better_look(
    image: NDArray[np.float32],
    valid: Any,
    mask: ChessField,
    pose: Pose,
    camera: Camera,
    look: Appearance,
) -> Appearance:
    """One Gauss-Newton step: the light at once, the edges by their slopes."""
    edges = look.with_(dark=_LEVEL_0, light=_LEVEL_1)
    level, changes = _slopes(mask, pose, edges, camera)
    rows, columns = np.nonzero(valid)
    stride = 1 + len(rows) // _MOST_PIXELS
    rows, columns = rows[::stride], columns[::stride]
    height, width = camera.shape
    u, v = (2 * columns - width + 1) / width, (2 * rows - height + 1) / height
    light, white = surface(u, v).T, level[rows, columns]
    terms = [*(light * (1 - white)), *(light * white)]
    terms += [slope[rows, columns] for _, slope in changes]
    found = _robust_solution(np.array(terms, dtype=np.float64).T, image[rows, columns])
    contrast = float(found[6] - found[0]) or 1.0
    names = (name for name, _ in changes)
    step = {name: float(slope) / contrast for name, slope in zip(names, found[12:], strict=True)}
    blur = max(look.blur_um + step["blur_um"], 0.5 * look.blur_um)
    kurtosis = np.clip(look.kurtosis + step["kurtosis"], -_MOST_KURTOSIS, _MOST_KURTOSIS)
    return look.with_(
        dark=found[:6],
        light=found[6:12],
        blur_um=max(blur, MIN_BLUR_PX * camera.pixel_um),
        edge_shift_um=look.edge_shift_um + step["edge_shift_um"],
        kurtosis=float(kurtosis),
    )


def _robust_solution(
    basis: NDArray[np.float64], values: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Least squares, with dirt left out as it shows."""
    used = np.ones(len(values), dtype=bool)
    for _ in range(4):
        found = np.linalg.lstsq(basis[used], values[used], rcond=1e-10)[0]
        residual = values - basis @ found
        spread = 1.4826 * float(np.median(np.abs(residual[used])))
        used = np.abs(residual) <= 5 * spread
    return np.asarray(found, dtype=np.float64)


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
