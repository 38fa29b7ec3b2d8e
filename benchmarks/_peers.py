"""Other packages that measure a displacement between images, where they are installed.

OpenCV does not know the code: it gets a plain chessboard of the same fields, blur, light and
noise, whole in view with a white border, and must be told how many corners to look for. The
displacement is the mean over all corners. scikit-image registers two frames of the coded mask
by their cross-correlation, to 1/100 pixel. Both give a displacement and no position.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import _study
from rasnik import ChessField, System
from rasnik.imaging.projection import Projection

#: frame -> displacement of the pattern since the first frame, (right, down) in pixels
Displacement = Callable[[np.ndarray], np.ndarray]


class PlainBoard(ChessField):
    """A chessboard of columns x rows fields, without code, on clear glass."""

    @property
    def bounds_fields(self) -> tuple[int, int, int, int]:
        return 0, self.columns or 0, 0, self.rows or 0

    def is_white(self, i: Any, j: Any) -> np.ndarray:
        i, j = np.asarray(i), np.asarray(j)
        return ((i & 1) == (j & 1)) | ~self.inside(i, j)


def shifts_px(projections: list[Projection], pitch_um: float) -> np.ndarray:
    """How far the image of the first frame's central mask point lies from the centre.

    Returns
    -------
    ndarray, shape (n, 2)
        (right, down) in pixels; (0, 0) for the first frame.
    """
    first = projections[0]
    points = [p.to_sensor(first.x_um, first.y_um) for p in projections]
    return np.array(points, dtype=float) / pitch_um


def board_frames(
    system: System, poses: np.ndarray, seed: int
) -> tuple[np.ndarray, list[Projection], tuple[int, int]]:
    """Frames of a plain board that moves like `poses`, projections, corners (across, down).

    Parameters
    ----------
    poses : ndarray, shape (n, 5)
        x_um, y_um, scale, theta_rad, orientation; the first puts the board in the middle.
    """
    height, width = system.shape
    size_px = system.pixels_per_field
    columns, rows = (int(side / size_px) // 2 * 2 - 6 for side in (width, height))
    board = PlainBoard(field_um=system.mask.field_um, columns=columns, rows=rows)
    centre = np.array([columns, rows]) * board.field_um / 2
    moved = poses[:, :2] - poses[0, :2] + centre
    projections = [
        Projection.from_pose(x, y, scale, theta, int(orientation))
        for (x, y), (scale, theta, orientation) in zip(moved, poses[:, 2:], strict=True)
    ]
    frames = _study.frame_pool(system, projections, seed=seed, mask=board)
    return frames, projections, (columns - 1, rows - 1)


def chessboard(
    first: np.ndarray, corners: tuple[int, int], accurate: bool
) -> tuple[str, Displacement] | None:
    """OpenCV's findChessboardCornersSB in one thread; None if it is not installed.

    The corners of the first frame are found once: a stream has one new frame at a time.
    """
    try:
        import cv2
    except ImportError:
        return None
    cv2.setNumThreads(1)
    flags = cv2.CALIB_CB_ACCURACY if accurate else 0

    def find(frame: np.ndarray) -> np.ndarray:
        found, points = cv2.findChessboardCornersSB(frame, corners, flags=flags)
        if not found:
            raise RuntimeError("OpenCV did not find the chessboard")
        return np.asarray(points, dtype=float).reshape(-1, 2)

    start = find(first)
    name = "OpenCV findChessboardCornersSB" + (", accurate" if accurate else "")
    return name, lambda frame: (find(frame) - start).mean(axis=0)


def correlation(first: np.ndarray, upsample: int = 100) -> tuple[str, Displacement] | None:
    """scikit-image's phase_cross_correlation; None if it is not installed.

    Its usual normalisation, to phases alone, errs by a fifth of a pixel on this periodic
    pattern; it is left out, which makes the error ten times smaller.
    """
    try:
        from skimage.registration import phase_cross_correlation
    except ImportError:
        return None

    def displacement(frame: np.ndarray) -> np.ndarray:
        # the shift that would bring the frame back onto the first, (down, right)
        back = phase_cross_correlation(first, frame, upsample_factor=upsample, normalization=None)
        return -np.asarray(back[0])[::-1]

    return "scikit-image phase_cross_correlation", displacement
