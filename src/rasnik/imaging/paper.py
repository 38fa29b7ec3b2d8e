"""The generator of the paper, to the letter: points within the pixel, blur over 11 x 11 pixels.

It is kept to repeat what was published. A Gaussian sampled on the pixel grid and applied after
the pixels have been filled is not a Gaussian-blurred mask seen by pixels: at a blur below a
pixel the two differ by aliasing, which moves the position that an image shows by nanometres.
`rasnik.imaging.montecarlo` has no such error.

Source: van der Graaf et al., section 4, "Image simulations".
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from rasnik.imaging.deviations import Deviations
from rasnik.imaging.levels import LevelMap
from rasnik.imaging.montecarlo import grey_levels
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.instrument import System
from rasnik.mask import ChessField

__all__ = ["KERNEL_WIDTH", "POINTS", "paper_image", "paper_pattern"]

#: Points along the side of a pixel.
POINTS = 10
#: Pixels along the side of the blur.
KERNEL_WIDTH = 11

_CANNOT = {
    "transfer": "another blur than a Gaussian",
    "edges": "mask edge errors",
    "blur_ratio": "a blur that varies over the image",
    "coherent": "coherent light",
}


def paper_image(
    system: System,
    projection: Projection,
    *,
    light_map: LevelMap | float | None = None,
    dark_map: LevelMap | float | None = None,
    shape: tuple[int, int] | None = None,
    deviations: Deviations | None = None,
    points: int = POINTS,
) -> NDArray[np.float64]:
    """Expected grey level of every pixel as the paper computes it.

    Parameters
    ----------
    system, projection, light_map, dark_map, shape
        As for `rasnik.imaging.montecarlo.exact_image`.
    deviations : Deviations, optional
        Displaced pixels, dead area and illumination; the rest is not within this generator.
    points : int
        Points along the side of a pixel.

    Returns
    -------
    ndarray of float64, shape (height, width)

    Raises
    ------
    ValueError
        If a deviation is asked for that this generator does not have.
    """
    change = deviations or Deviations()
    for name, what in _CANNOT.items():
        if getattr(change, name) is not None:
            raise ValueError(f"the path 'paper' knows no {what}: use the path 'exact'")
    pattern = paper_pattern(
        system.mask,
        projection,
        system.shape if shape is None else shape,
        system.pitch_um,
        system.optics.blur_um,
        gap_um=change.gap_um,
        points_um=change.points_um,
        points=points,
    )
    return grey_levels(pattern, system, light_map, dark_map, change)


def paper_pattern(
    mask: ChessField,
    projection: Projection,
    shape: tuple[int, int],
    pitch_um: float,
    blur_um: float,
    *,
    gap_um: float = 0.0,
    points_um: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    points: int = POINTS,
) -> NDArray[np.float64]:
    """Share of the light of a wide white area that every pixel receives.

    The share of white among `points` x `points` points, evenly spread over the sensitive square
    of the pixel, is spread over `KERNEL_WIDTH` x `KERNEL_WIDTH` pixels by a Gaussian sampled
    at the pixel centres and normalised. Pixels beyond the image are computed too, so that its
    edge is like its middle.

    Parameters
    ----------
    mask, projection, shape, pitch_um, gap_um, points_um
        As for `rasnik.imaging.montecarlo.exact_pattern`.
    blur_um : float
        Standard deviation of the Gaussian; 0 for none.
    points : int
        Points along the side of a pixel.

    Returns
    -------
    ndarray of float64, shape (height, width)
        0 for black, 1 for white.
    """
    if points < 1:
        raise ValueError(f"a pixel needs at least one point, not {points}")
    if not 0 <= gap_um < pitch_um:
        raise ValueError(f"the dead area of {gap_um:g} um does not fit a {pitch_um:g} um pixel")
    border = KERNEL_WIDTH // 2 if blur_um > 0 else 0
    height, width = shape[0] + 2 * border, shape[1] + 2 * border
    if points_um is None:
        u, v = np.meshgrid(*sensor_grid_um((height, width), pitch_um))
    else:
        u, v = (_continued(part, border) for part in points_um)
    offsets = ((np.arange(points) + 0.5) / points - 0.5) * (pitch_um - gap_um)
    share = _share_of_white(mask, projection, u, v, offsets)
    if border:
        at = np.arange(-border, border + 1) * pitch_um / blur_um
        kernel = np.exp(-(at**2) / 2)
        kernel /= kernel.sum()
        for axis in (0, 1):
            share = correlate1d(share, kernel, axis=axis)
        share = share[border:-border, border:-border]
    return np.ascontiguousarray(share)


def _continued(points: NDArray[np.float64], border: int) -> NDArray[np.float64]:
    """Pixel positions with a border, whose displacements continue evenly."""
    return np.pad(points, border, mode="reflect", reflect_type="odd")


def _share_of_white(
    mask: ChessField,
    projection: Projection,
    u: NDArray[np.float64],
    v: NDArray[np.float64],
    offsets: NDArray[np.float64],
) -> NDArray[np.float64]:
    reach = np.abs(offsets).max()
    corners = [projection.to_mask(u + a, v + b) for a in (-reach, reach) for b in (-reach, reach)]
    spans = []
    for axis in (0, 1):
        low = min(float(c[axis].min()) for c in corners) / mask.field_um
        high = max(float(c[axis].max()) for c in corners) / mask.field_um
        spans += [int(np.floor(low)), int(np.floor(high)) + 1]
    fields = mask.fields(*spans)
    # In fields from the corner of the window; its place is taken off before the digits go.
    shift = np.array([[1, 0, -spans[0] * mask.field_um], [0, 1, -spans[2] * mask.field_um]])
    matrix = np.vstack([shift @ projection.matrix / mask.field_um, projection.matrix[2]])
    share = np.empty(u.shape)
    _count_white(fields, np.ascontiguousarray(matrix), u, v, offsets, share)
    return share


@njit(cache=True, nogil=True)
def _count_white(fields, matrix, u, v, offsets, out):  # type: ignore[no-untyped-def]
    """Mean of the fields' transmission over the points of each pixel."""
    rows, columns = fields.shape
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            total = 0.0
            for dv in offsets:
                y = v[row, column] + dv
                for du in offsets:
                    x = u[row, column] + du
                    w = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
                    i = int(np.floor((matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / w))
                    j = int(np.floor((matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / w))
                    # Rounding may put a point of the rim a hair outside.
                    total += fields[min(max(j, 0), rows - 1), min(max(i, 0), columns - 1)]
            out[row, column] = total / offsets.size**2
