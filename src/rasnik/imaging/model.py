"""The image model: what every pixel is expected to show for a pose, and its derivatives.

One model serves simulation, analysis, prediction and tracking. The expected grey level is

    g(u, v) = dark(u, v) + (light(u, v) - dark(u, v)) P(u, v),

where P is the mask, blurred by the optics and averaged over the square pixel. In mask
coordinates the blurred mask is a sum of products of edge profiles along X and Y
(`rasnik.imaging.profile`). Each profile contains the projection of the pixel, exactly. A
rotated pixel (or blur seen through an oblique map) is not the product of its projections:
the difference is a series in the cross cumulants of the combined kernel,

    P = M + k11 M_XY + k31/6 M_XXXY + k13/6 M_XYYY + (k22/4 + k11^2/2) M_XXYY + ...,

felt at the corners of fields only. Where the next order would matter (sharp images,
rotated by tens of degrees) the pixel is divided into parts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rasnik.imaging import kernels
from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.profile import EdgeTable, edge_table
from rasnik.imaging.projection import Projection
from rasnik.mask import ChessField

__all__ = ["expected_image", "expected_signals", "make_scene", "tile_products"]

#: Largest error of the expected pattern that the choice of pixel parts allows.
PATTERN_TOLERANCE = 7e-5

#: Smallest blur that is modelled, in pixels; below it the edges are sharper than the pixel.
MIN_BLUR_PX = 0.2

_NEGLIGIBLE = 3e-4
_KURTOSIS = 6  # its row among the signals


def _pixel_parts(jacobian: NDArray[np.float64], pixel: float, blur_um: float) -> int:
    """In how many parts per side a pixel is divided so that the cumulant series suffices.

    The first neglected terms are the sixth cross cumulants of the pixel (p^6 / 252 along
    each side) times derivatives of two edges.
    """
    norm_x, norm_y = np.linalg.norm(jacobian, axis=1)
    (xu, xv), (yu, yv) = jacobian / np.array([[norm_x], [norm_y]])
    sigma = np.hypot(blur_um, pixel / np.sqrt(12))
    sixth = (pixel / sigma) ** 6 / 252
    k51 = max(abs(xu**5 * yu + xv**5 * yv), abs(yu**5 * xu + yv**5 * xv)) / 120
    k33 = abs(xu**3 * yu**3 + xv**3 * yv**3) / 36
    k42 = max(xu**4 * yu**2 + xv**4 * yv**2, xu**2 * yu**4 + xv**2 * yv**4) / 48
    # times the largest values of the Gaussian edge's derivatives
    error = 2 * sixth * (0.48 * k51 + 0.16 * k33 + 0.13 * k42)
    return 1 if error < PATTERN_TOLERANCE else 2


def make_scene(
    mask: ChessField,
    projection: Projection,
    appearance: Appearance,
    camera: Camera,
    *,
    kurtosis_signal: bool = False,
    shape_signals: bool = True,
) -> kernels.Scene:
    """Gather what the kernels need for one pose and appearance.

    Parameters
    ----------
    kurtosis_signal : bool, optional
        Whether the derivative by kurtosis is wanted; it is zero otherwise.
    shape_signals : bool, optional
        Whether the derivatives by blur and edge shift are wanted. If not, and if all
        corrections to the product of two profiles are negligible, half of the work is left out.

    Raises
    ------
    ValueError
        If more than 4 fields on either side of a corner would be felt: the blur leaves no
        contrast, or if the view would hold more than 4000 fields per side.
    """
    field = mask.field_um
    to_fields = np.diag([1 / field, 1 / field, 1.0]) @ projection.matrix
    jacobian = projection.jacobian_at(*camera.centre_um) / field
    pixel = camera.pixel_um
    blur = max(appearance.blur_um, MIN_BLUR_PX * pixel)
    parts = _pixel_parts(jacobian, pixel, blur)
    part = pixel / parts
    gx, gy = jacobian  # gradients of X and Y on the sensor, fields per um
    xx, yy, xy = gx @ gx, gy @ gy, gx @ gy
    kurtosis = appearance.kurtosis * blur**4
    tables = [
        edge_table(blur * np.sqrt(gg), (g[0] * part, g[1] * part), kurtosis * gg**2)
        for g, gg in ((gx, xx), (gy, yy))
    ]
    reach = int(np.ceil(max(table.reach for table in tables) + 0.5))
    if reach > kernels.MAX_REACH:
        raise ValueError("the blur is too wide for the fields: no contrast would be left")
    fourth = -(part**4) / 120
    k11 = (blur**2 + part**2 / 12) * xy
    k31 = fourth * (gx**3 @ gy) + kurtosis * xx * xy
    k13 = fourth * (gx @ gy**3) + kurtosis * yy * xy
    oblique = (xx * yy + 2 * xy**2) / 3
    k22 = fourth * (gx**2 @ gy**2) + kurtosis * oblique
    shape = [k11, k31 / 6, k13 / 6, k22 / 4 + k11**2 / 2]
    shape += [xx / 2, yy / 2, xy, xx**2 / 24, oblique / 4, yy**2 / 24]
    shape += [appearance.edge_shift_um / field]
    orders = 5 if kurtosis_signal else 4
    if not shape_signals and _corrections_are_negligible(shape, tables):
        orders = 3
    fields, i0, j0 = _fields_in_view(mask, to_fields, camera, reach)
    return kernels.Scene(
        to_fields,
        float(pixel),
        np.array([*camera.origin_um, *camera.half_size_um]),
        np.stack([appearance.dark, appearance.light]).astype(np.float64),
        np.array(shape, dtype=np.float64),
        parts,
        tables[0].values,
        float(tables[0].limit),
        float(tables[0].step),
        tables[1].values,
        float(tables[1].limit),
        float(tables[1].step),
        fields,
        _corner_colours(fields),
        i0,
        j0,
        reach,
        orders,
    )


def _corrections_are_negligible(shape: list[float], tables: list[EdgeTable]) -> bool:
    """Whether cross cumulants and edge shift change no pixel by more than 3e-4 of the step."""
    x, y = (np.abs(table.values).max(axis=0) for table in tables)
    largest = (
        abs(shape[0]) * x[1] * y[1]
        + abs(shape[1]) * x[3] * y[1]
        + abs(shape[2]) * x[1] * y[3]
        + abs(shape[3]) * x[2] * y[2]
        + abs(shape[10]) * (x[1] + y[1])
    )
    return bool(largest < _NEGLIGIBLE)


def _fields_in_view(
    mask: ChessField, to_fields: NDArray[np.float64], camera: Camera, reach: int
) -> tuple[NDArray[np.float32], int, int]:
    x, y = Projection(to_fields).to_mask(*camera.corners_um)
    i0, j0 = int(np.floor(x.min())) - reach - 1, int(np.floor(y.min())) - reach - 1
    i1, j1 = int(np.ceil(x.max())) + reach + 1, int(np.ceil(y.max())) + reach + 1
    if max(i1 - i0, j1 - j0) > 4000:
        raise ValueError("the pose puts more than 4000 fields per side in view")
    return np.ascontiguousarray(mask.fields(i0, i1, j0, j1), dtype=np.float32), i0, j0


def _corner_colours(fields: NDArray[np.float32]) -> NDArray[np.int32]:
    """Colours of the fields around each field's lower left corner (`kernels.Scene.corners`)."""
    white = fields.astype(np.int32)
    corners = white << 3
    corners[:, 1:] |= white[:, :-1] << 2
    corners[1:] |= white[:-1] << 1
    corners[1:, 1:] |= white[:-1, :-1]
    return corners


def expected_image(
    mask: ChessField, projection: Projection, appearance: Appearance, camera: Camera
) -> NDArray[np.float32]:
    """Expected grey level of every pixel.

    Agrees with the exact integral over the pixel to 1e-4 of the step from black to white,
    for blur from 0.3 pixel to half a field, at any rotation.

    Returns
    -------
    ndarray of float32, shape (H, W)
    """
    return expected_signals(mask, projection, appearance, camera, (kernels.LEVEL,))[0]


def expected_signals(
    mask: ChessField,
    projection: Projection,
    appearance: Appearance,
    camera: Camera,
    signals: tuple[int, ...] = (*range(kernels.N_SIGNALS - 1), kernels.LEVEL),
) -> NDArray[np.float32]:
    """Expected grey level of every pixel and its derivatives.

    The derivatives by mask position leave out that the pixel turns and scales about its
    own centre with the pose: a relative error of 1e-3 at most.

    Parameters
    ----------
    signals : tuple of int, optional
        Which ones; all by default.

    Returns
    -------
    ndarray of float32, shape (len(signals), H, W)
        Derivatives by mask X and Y (grey per field), by dark and by light level (1), by blur
        variance (grey per um^2 on the sensor), by edge shift (grey per field), by the
        fourth cumulant of the blur (grey per um^4); and the grey level itself.
    """
    wide = _KURTOSIS in signals
    scene = make_scene(mask, projection, appearance, camera, kurtosis_signal=wide)
    planes: NDArray[np.float32] = kernels.render(*camera.shape, scene, np.array(signals))
    return planes


def tile_products(
    image: NDArray[np.float32],
    valid: NDArray[np.uint8],
    scene: kernels.Scene,
    noise: tuple[float, float],
    tiles: NDArray[np.int32],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Noise-weighted products of all signals and the residual, summed per tile.

    Parameters
    ----------
    image, valid : ndarray, shape (H, W)
        Frame, and 1 where a pixel may be used.
    scene : Scene
    noise : tuple of float
        A and B of the pixel variance A + B g.
    tiles : ndarray of int32, shape (n, 2)
        (row, column) of the tiles, in tiles of ``kernels.TILE`` pixels.

    Returns
    -------
    products : ndarray, shape (n, 36)
        Upper triangle, row by row, of the 8 x 8 products of the signals in the order of
        `expected_signals`, the residual last.
    counts : ndarray, shape (n,)
        Pixels used.
    """
    floor = max(noise[0], 1e-3 * noise[1] * float(np.ptp(scene.photometry[:, 0])), 1e-12)
    tiles = np.ascontiguousarray(tiles)  # for any other layout the kernel is compiled again
    packed = kernels.gram(image, valid, tiles, np.array([*noise, floor]), scene)
    return packed[:, :-1], packed[:, -1]
