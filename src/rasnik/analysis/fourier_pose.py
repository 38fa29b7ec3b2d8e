"""The spectrum as a method of its own: a pose from the phases of the tones and the code read.

SOAP, as in van der Graaf et al., section 4, with one addition: once the code is read, what the
inverted fields do to the phases is known and taken out. It amounts to some ten nanometres for
an 85 um field, and varies with the position.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from rasnik.analysis.decode import Decoding, LabelledLattice
from rasnik.analysis.flags import Flag
from rasnik.analysis.lattice import Lattice
from rasnik.analysis.pose import Candidate, Pose
from rasnik.analysis.tones import combine, measure, phase_errors
from rasnik.imaging.appearance import surface
from rasnik.imaging.projection import Projection
from rasnik.mask import ChessField

__all__ = ["fourier_pose"]

Array = NDArray[np.float64]

_PASSES = 2


def fourier_pose(
    lattice: Lattice | Flag,
    decoding: Decoding | None,
    mask: ChessField,
) -> Pose:
    """Pose with ``method="fourier"`` and ``model="similarity"``.

    Scale and rotation are the mean ones of the affine map found; `Pose.projection` is that map.
    The covariance covers white pixel noise (`Lattice.noise_variance`) only: neither distortion
    nor unequal scales, of which the pose gives the mean.

    Parameters
    ----------
    lattice : Lattice or Flag
        Result of `find_lattice`.
    decoding : Decoding or None
        Result of `decode`; None if there is no lattice.
    mask : ChessField

    Returns
    -------
    Pose
        Not ok if there is no lattice or no certain code.
    """
    if isinstance(lattice, Flag):
        return Pose(flags=lattice)
    if decoding is None or decoding.best is None:
        return Pose(flags=Flag.NO_CODE if decoding is None else decoding.flags)
    candidates = (
        tuple(_candidate(one) for one in decoding.candidates)
        if decoding.flags & Flag.AMBIGUOUS
        else ()
    )
    if not decoding.ok:
        return Pose(
            flags=decoding.flags,
            candidates=candidates,
            code_lines_read=decoding.lines_read,
            code_lines_in_view=decoding.lines_in_view,
        )
    best = decoding.best
    projection = _without_code(lattice, best, mask)
    scale, theta, code = projection.similarity(best.orientation)
    return Pose(
        ok=True,
        x_um=projection.x_um,
        y_um=projection.y_um,
        scale=scale,
        theta_rad=theta,
        orientation=code,
        covariance=_pose_covariance(lattice, best, mask, projection),
        blur_um=lattice.blur_um,
        dark_level=float(lattice.dark[0]),
        light_level=float(lattice.light[0]),
        polarity=best.polarity,
        code_lines_read=decoding.lines_read,
        code_lines_in_view=decoding.lines_in_view,
        flags=decoding.flags,
        projection=projection,
        method="fourier",
        model="similarity",
    )


def _candidate(one: LabelledLattice) -> Candidate:
    scale, theta, code = one.projection.similarity(one.orientation)
    return Candidate(
        x_um=one.projection.x_um,
        y_um=one.projection.y_um,
        scale=scale,
        theta_rad=theta,
        orientation=code,
        log_odds=one.log_odds,
    )


def _without_code(lattice: Lattice, best: LabelledLattice, mask: ChessField) -> Projection:
    """The map from sensor to mask with the effect of the inverted fields taken out."""
    phase, offset = code_effect(lattice, best, mask)
    picture, orders = lattice.picture, lattice.tones.orders
    start = lattice.tones.matrix
    matrix = start
    for _ in range(_PASSES):
        tones = measure(picture, np.pi * orders @ matrix[:, :2])
        error = phase_errors(tones, orders, matrix) - phase
        step, _ = combine(orders, lattice.tones.weight, error, tones.offset - offset)
        matrix = matrix + step
    # from pixels about the window's centroid to micrometres about the image's centre
    change = matrix - start
    height, width = lattice.shape
    column, row = picture.centroid_px
    change[:, 2] += change[:, :2] @ [(width - 1) / 2 - column, (height - 1) / 2 - row]
    change[:, :2] /= lattice.pixel_um
    refined = best.projection.matrix.copy()
    refined[:2] += mask.field_um * best.change @ change
    return Projection(refined)


def code_effect(lattice: Lattice, best: LabelledLattice, mask: ChessField) -> tuple[Array, Array]:
    """What the inverted fields do to the tones: see `Tones`.

    A field at c contributes s (W(c) + i grad W(c) . grad log T) T(k) exp(-i k . c) to the
    transform at k, W being window times contrast, T(k) the transform of a blurred field and s its
    colour. At the tones s exp(-i k . c) is the same for all plain fields and opposite for inverted
    ones: without gradients of W, they would make the tones weaker and not shift them at all.

    Returns
    -------
    phase : ndarray, shape (n,)
        Change of the phases of `ToneLattice.orders`, radians.
    offset : ndarray, shape (n, 2)
        Change of the wave vectors as `measure` sees them, radians per pixel.
    """
    u, v = _inverted_fields(lattice, best, mask)
    here, by_u, by_v = _weight_and_slopes(lattice, u, v)

    # all fields: sums become integrals, in which gradients cancel
    picture = lattice.picture
    gradients = lattice.matrix[:, :2] * lattice.pixel_um  # d(p, q) / d(u, v) per pixel
    per_pixel = abs(np.linalg.det(gradients))
    grid_u, grid_v = picture.u_px[2::4], picture.v_px[2::4, None]
    whole = 16 * per_pixel * picture.window[2::4, 2::4] * _contrast(lattice, grid_u, grid_v)
    total, total_u, total_v = (float((whole * factor).sum()) for factor in (1.0, grid_u, grid_v))

    orders = lattice.tones.orders
    waves = np.pi * orders @ gradients
    blur_px = np.hypot(lattice.blur_um / lattice.pixel_um, np.sqrt(1 / 12))
    slope = -(np.linalg.inv(gradients) @ (1 / (np.pi * orders)).T).T - blur_px**2 * waves
    slope_u, slope_v = slope[:, 0], slope[:, 1]
    transform = total - 2 * here.sum() - 2j * (slope_u * by_u.sum() + slope_v * by_v.sum())
    moment_u = (
        total_u
        - 2 * (u * here).sum()
        - 2j * (slope_u * (here + u * by_u).sum() + slope_v * (u * by_v).sum())
    )
    moment_v = (
        total_v
        - 2 * (v * here).sum()
        - 2j * (slope_u * (v * by_u).sum() + slope_v * (here + v * by_v).sum())
    )
    moments = np.column_stack([(moment_u / transform).imag, (moment_v / transform).imag])
    return np.angle(transform), moments @ np.linalg.inv(picture.variance)


def _inverted_fields(
    lattice: Lattice, best: LabelledLattice, mask: ChessField
) -> tuple[Array, Array]:
    """Centres of the inverted fields within the window, in pixels from its centroid."""
    height, width = lattice.shape
    samples, picture = lattice.samples, lattice.picture
    u, v = samples.u * width / 2, samples.v * height / 2  # pixels from the image's centre
    x, y = best.projection.to_mask(u * lattice.pixel_um, v * lattice.pixel_um)
    i, j = (np.floor(value / mask.field_um).astype(np.int64) for value in (x, y))
    column, row = picture.centroid_px
    u, v = u + (width - 1) / 2 - column, v + (height - 1) / 2 - row
    chosen = (
        mask.inverted(i, j)
        & (u > picture.u_px[1]) & (u < picture.u_px[-2])
        & (v > picture.v_px[1]) & (v < picture.v_px[-2])
    )  # fmt: skip
    return u[chosen], v[chosen]


def _contrast(lattice: Lattice, u: Array, v: Array) -> Array:
    """Half the black-white step at points in pixels from the window's centroid."""
    height, width = lattice.shape
    column, row = lattice.picture.centroid_px
    basis = surface(
        (u + column - (width - 1) / 2) * 2 / width, (v + row - (height - 1) / 2) * 2 / height
    )
    level: Array = basis @ lattice.levels.half
    return level


def _weight_and_slopes(lattice: Lattice, u: Array, v: Array) -> tuple[Array, Array, Array]:
    """Window times contrast at points in pixels from the centroid, and its slopes per pixel."""
    picture = lattice.picture
    column, row = u - picture.u_px[0], v - picture.v_px[0]

    def weight(du: int, dv: int) -> Array:
        window = map_coordinates(picture.window, [row + dv, column + du], order=1)
        product: Array = window * _contrast(lattice, u + du, v + dv)
        return product

    by_u, by_v = (weight(1, 0) - weight(-1, 0)) / 2, (weight(0, 1) - weight(0, -1)) / 2
    return weight(0, 0), by_u, by_v


def _pose_covariance(
    lattice: Lattice, best: LabelledLattice, mask: ChessField, projection: Projection
) -> Array:
    """Covariance of (x, y, scale, theta) from that of the lattice, by its derivatives."""
    change = np.kron(best.change, np.eye(3)) * mask.field_um
    covariance = change @ lattice.covariance @ change.T  # of the first two rows of the projection
    derivative = np.zeros((4, 6))
    derivative[0, 2] = derivative[1, 5] = 1.0
    size = np.sqrt(abs(np.linalg.det(projection.jacobian)))
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        step = 1e-6 * size
        ends = []
        for sign in (1, -1):
            moved = projection.matrix.copy()
            moved[row, column] += sign * step
            ends.append(Projection(moved).similarity(best.orientation)[:2])
        index = 3 * row + column
        derivative[2, index] = (ends[0][0] - ends[1][0]) / (2 * step)
        turn = np.mod(ends[0][1] - ends[1][1] + np.pi, 2 * np.pi) - np.pi
        derivative[3, index] = turn / (2 * step)
    result: Array = derivative @ covariance @ derivative.T
    return result
