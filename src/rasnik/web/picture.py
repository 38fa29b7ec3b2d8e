"""The latest frame as a picture: JPEG or PNG, the lattice that was fitted, the histogram."""

from __future__ import annotations

import io
import math
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.pose import Pose
from rasnik.imaging.projection import Projection
from rasnik.instrument import System
from rasnik.recording.sample import Sample

__all__ = ["BINS", "Picture", "Pictures", "encoded", "histogram", "lattice"]

#: Of the histogram, from 0 to full scale.
BINS = 64
#: With more fields across the view, only the lines at every code period are drawn.
MOST_LINES = 90
_MOST_CODE_FIELDS = 3000
_QUALITY = 78  # of JPEG: no blocks are seen between fields
_STEP = 3  # the histogram takes every third pixel of every third row

Image = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Picture:
    """One frame as it is sent.

    Attributes
    ----------
    number : int
        Of the sample.
    time_s : float
        When it came, in seconds since 1970 UTC.
    jpeg : bytes
    shape : tuple of int
        (height, width) of the frame itself; lines count in its pixels.
    lines : ndarray of float32, shape (n, 4)
        Borders between fields, (column, row) of their two ends. Whole numbers are corners of
        pixels, as on a screen.
    code : ndarray of float32, shape (m, 8)
        Corners of the fields that the code turned round.
    counts : ndarray of float32, shape (BINS,)
        Fraction of the pixels with so much light.
    saturated_fraction : float
    """

    number: int
    time_s: float
    jpeg: bytes
    shape: tuple[int, int]
    lines: NDArray[np.float32]
    code: NDArray[np.float32]
    counts: NDArray[np.float32]
    saturated_fraction: float


class Pictures:
    """Pictures of a channel; a frame is made into one once, whoever looks on."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._lock = threading.Lock()
        self._made: dict[int, Picture] = {}  # by width, the last only

    def of(self, sample: Sample, width: int) -> Picture:
        """The picture of a sample, at most so many pixels wide."""
        with self._lock:
            made = self._made.get(width)
            if made is None or made.number != sample.number:
                if len(self._made) > 8:  # widths that nobody asks for any more
                    self._made.clear()
                made = self._made[width] = self._make(sample, width)
            return made

    def _make(self, sample: Sample, width: int) -> Picture:
        image = sample.frame.image
        lines, code = lattice(sample.pose, self._system, image.shape)
        counts, saturated = histogram(image, self._system.full_scale)
        return Picture(
            sample.number, sample.frame.host_time_s,
            encoded(image, self._system.full_scale, "JPEG", width),
            (image.shape[0], image.shape[1]), lines, code, counts, saturated,
        )  # fmt: skip


def encoded(image: Image, full_scale: int, kind: str, width: int | None = None) -> bytes:
    """An image in 8 bits, black at 0 and white at full scale.

    Parameters
    ----------
    image : ndarray, shape (H, W)
    full_scale : int
    kind : str
        "JPEG" or "PNG".
    width : int, optional
        The picture is at most as wide; pixels are averaged by whole numbers.
    """
    from PIL import Image as PillowImage

    grey = image
    if full_scale != 255 or image.dtype != np.uint8:
        grey = np.clip(image * (255 / full_scale), 0, 255).astype(np.uint8)
    picture = PillowImage.fromarray(np.ascontiguousarray(grey))
    if width is not None and image.shape[1] > width:
        picture = picture.reduce(math.ceil(image.shape[1] / width))
    buffer = io.BytesIO()
    picture.save(buffer, kind, **({"quality": _QUALITY} if kind == "JPEG" else {}))
    return buffer.getvalue()


def histogram(image: Image, full_scale: int) -> tuple[NDArray[np.float32], float]:
    """(fraction of the pixels in each of `BINS` bins up to full scale, fraction at full scale)."""
    part = image[::_STEP, ::_STEP]
    size = (full_scale + 1) / BINS
    bins = np.clip((part / size).astype(np.intp), 0, BINS - 1)
    counts = np.bincount(bins.ravel(), minlength=BINS) / part.size
    return counts.astype(np.float32), float((part >= full_scale).mean())


def lattice(
    pose: Pose, system: System, shape: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Borders of the fields in view, and the fields that carry code; see `Picture`."""
    none = np.empty((0, 4), np.float32), np.empty((0, 8), np.float32)
    projection = _projection(pose)
    if projection is None:
        return none
    mask, pitch_um = system.mask, system.pitch_um
    height, width = shape[:2]
    u = (np.array([0, width, width, 0]) - width / 2) * pitch_um
    v = (np.array([0, 0, height, height]) - height / 2) * pitch_um
    x, y = projection.to_mask(u, v)
    first_i, last_i, first_j, last_j = mask.bounds_fields
    i0, i1 = _range(x / mask.field_um, first_i, last_i)
    j0, j1 = _range(y / mask.field_um, first_j, last_j)
    if i1 <= i0 or j1 <= j0:
        return none
    step = 1 if max(i1 - i0, j1 - j0) <= MOST_LINES else mask.period
    across = [(i, j0, i, j1) for i in range(i0 + -i0 % step, i1 + 1, step)]
    along = [(i0, j, i1, j) for j in range(j0 + -j0 % step, j1 + 1, step)]
    j, i = np.nonzero(mask.inverted(np.arange(i0, i1), np.arange(j0, j1)[:, None]))
    i, j = i[:_MOST_CODE_FIELDS] + i0, j[:_MOST_CODE_FIELDS] + j0
    corners = np.stack([i, j, i + 1, j, i + 1, j + 1, i, j + 1], axis=1)

    def pixels(fields: NDArray[Any]) -> NDArray[np.float32]:
        points = fields.reshape(-1, 2) * mask.field_um
        u, v = projection.to_sensor(points[:, 0], points[:, 1])
        at = np.stack([u / pitch_um + width / 2, v / pitch_um + height / 2], axis=1)
        return at.reshape(fields.shape).astype(np.float32)

    return pixels(np.array(across + along)), pixels(corners)


def _projection(pose: Pose) -> Projection | None:
    if not pose.ok:
        return None
    if pose.projection is not None:
        return pose.projection
    return Projection.from_pose(
        pose.x_um, pose.y_um, pose.scale, pose.theta_rad, pose.orientation or 4
    )


def _range(fields: NDArray[Any], first: int, last: int) -> tuple[int, int]:
    """Whole fields that are in view and on the mask."""
    return max(first, math.floor(fields.min())), min(last, math.ceil(fields.max()))
