"""What one Rasnik reads, exactly, when mask, lens and sensor stand anywhere: a pinhole in space.

A straight line runs from the centre of the sensor through the centre of the lens and crosses the
mask: x and y are where. The map around that point has a scale and a rotation, those of the
nearest similarity as everywhere (``docs/conventions.md``). With l and p the centres of lens and
sensor in the mask's own axes, the point is q = (p_z l - l_z p) / (p_z - l_z).

Axes are right-handed. The mask's X and Y are those of its print; the sensor's u points right and
v down on the image as shown, so that w = u x v points from the sensor to the lens where the
camera shows the scene as one would see it. Seen through one lens, u along X and v against Y make
the orientation code 4 (`FACING`).

Source: van der Graaf et al., section "Principles".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.geometry.rigid import UM_PER_MM
from rasnik.imaging.projection import ORIENTATIONS, Projection

__all__ = [
    "FACING",
    "MOTIONS",
    "READINGS",
    "Placement",
    "Reading",
    "derivatives",
    "projection",
    "reading",
    "readings",
]

#: Axes u, v, w (columns) of a sensor that sees an unrotated mask with code 4 and theta_z = 0.
FACING: NDArray[np.float64] = np.diag([1.0, -1.0, -1.0])
FACING.setflags(write=False)

#: Order of what is read.
READINGS = ("x_um", "y_um", "scale", "theta_rad")

#: Order of the motions in `derivatives`: shifts (um) along and turns (rad) about the axes of the
#: world; an element turns about its own position. A pinhole has no turns.
MOTIONS = (
    *(f"mask_{kind}" for kind in ("x", "y", "z", "turn_x", "turn_y", "turn_z")),
    *(f"lens_{kind}" for kind in ("x", "y", "z")),
    *(f"sensor_{kind}" for kind in ("x", "y", "z", "turn_x", "turn_y", "turn_z")),
)

# Below this cosine a ray runs along the mask, and where it crosses it says nothing.
_GRAZING = 1e-9

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a mask or a sensor stands, and how it is turned.

    Attributes
    ----------
    position_mm : ndarray, shape (..., 3)
        In the world: of the mask's origin (X = Y = 0), or of the sensor's reference point.
    rotation : ndarray, shape (..., 3, 3)
        The columns are the element's own axes in the world: X, Y, Z or u, v, w.
    """

    position_mm: Array
    rotation: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_mm", np.asarray(self.position_mm, dtype=np.float64))
        object.__setattr__(self, "rotation", np.asarray(self.rotation, dtype=np.float64))
        if self.position_mm.shape[-1:] != (3,) or self.rotation.shape[-2:] != (3, 3):
            raise ValueError(
                "a Placement needs a position of 3 numbers and a 3 x 3 rotation, not shapes "
                f"{self.position_mm.shape} and {self.rotation.shape}"
            )


@dataclass(frozen=True)
class Reading:
    """What one Rasnik reads: the meaning of each number is that of `rasnik.Pose`.

    Attributes
    ----------
    x_um, y_um : float
        Point of the mask on the line through the centres of sensor and lens, um.
    scale : float
        Image size / mask size.
    theta_rad : float
        Rotation of the pattern in the image, anticlockwise positive, rad.
    orientation : int
        1..4.
    """

    x_um: float
    y_um: float
    scale: float
    theta_rad: float
    orientation: int


def reading(
    mask: Placement, lens_mm: ArrayLike, sensor: Placement, orientation: int | None = None
) -> Reading:
    """What one Rasnik reads.

    Parameters
    ----------
    mask, sensor : Placement
    lens_mm : array_like, shape (3,)
        Centre of the lens (of its diaphragm) in the world, mm.
    orientation : int, optional
        One of the two codes of this handedness; theta_z then covers the full circle. By default
        the code of the smaller rotation.

    Returns
    -------
    Reading

    Raises
    ------
    ValueError
        If the lens is not between mask and sensor, an element is seen edge on, or the
        orientation is of the other handedness.
    """
    values, codes = readings(mask, lens_mm, sensor, orientation)
    if values.shape != (4,):
        raise ValueError(f"these are {values.shape[:-1]} Rasniks; use readings for many of them")
    x, y, scale, theta = values.tolist()
    return Reading(x, y, scale, theta, int(codes))


def readings(
    mask: Placement,
    lens_mm: ArrayLike,
    sensor: Placement,
    orientation: ArrayLike | None = None,
    *,
    allow_missing: bool = False,
) -> tuple[Array, NDArray[np.int64]]:
    """What many Rasniks read; all arguments broadcast against each other.

    Parameters
    ----------
    mask, sensor : Placement
        Positions of shape (..., 3), rotations of shape (..., 3, 3).
    lens_mm : array_like, shape (..., 3)
    orientation : array_like of int, shape (...), optional
        As in `reading`.
    allow_missing : bool
        Where nothing can be read, NaN and orientation 0 instead of an error.

    Returns
    -------
    values : ndarray, shape (..., 4)
        In the order of `READINGS`.
    orientation : ndarray of int, shape (...)

    Raises
    ------
    ValueError
        As `reading`, if it is so for any of them.
    """
    lens, centre, axes = _checked(*_in_mask(mask, lens_mm, sensor), allow_missing)
    depth = centre[..., 2] - lens[..., 2]
    point = (centre[..., 2:] * lens - lens[..., 2:] * centre)[..., :2] / depth[..., None]
    jacobian = _jacobian(lens, centre, axes)
    codes = _codes(jacobian, orientation, allow_missing)
    across, along = _turned(jacobian, codes)
    scale = 1 / np.sqrt(np.abs(_determinant(jacobian)))
    theta = np.arctan2(across, along)
    theta = np.where(theta == -np.pi, np.pi, theta)
    values = np.stack([*np.moveaxis(UM_PER_MM * point, -1, 0), scale, theta], axis=-1)
    return np.where(codes[..., None] > 0, values, np.nan), codes


def derivatives(
    mask: Placement,
    lens_mm: ArrayLike,
    sensor: Placement,
    orientation: ArrayLike | None = None,
    *,
    allow_missing: bool = False,
) -> Array:
    """How readings change with small motions of the elements, in closed form.

    Parameters
    ----------
    mask, lens_mm, sensor, orientation, allow_missing
        As in `readings`.

    Returns
    -------
    ndarray, shape (..., 4, 15)
        d(`READINGS`) / d(`MOTIONS`); shifts in um, turns in rad. Their unit is that of what is
        read per um or rad: um/um, 1/um, rad/um; um/rad, 1/rad, rad/rad.

    Raises
    ------
    ValueError
        As `readings`.
    """
    lens, centre, axes = _checked(*_in_mask(mask, lens_mm, sensor), allow_missing)
    d_lens, d_centre, d_axes = _motions(mask, lens_mm, sensor)
    # one axis more: the motions
    L, P, A = lens[..., None, :], centre[..., None, :], axes[..., None, :, :]
    depth = (P - L)[..., 2:]
    t = L[..., 2:] / depth  # object distance / image distance
    dt = (d_lens[..., 2:] * P[..., 2:] - L[..., 2:] * d_centre[..., 2:]) / depth**2
    d_point = UM_PER_MM * (d_lens + dt * (L - P) + t * (d_lens - d_centre))
    slope = (L - P) / depth
    d_slope = ((d_lens - d_centre) - slope * (d_centre - d_lens)[..., 2:]) / depth
    fan = A[..., :2, :] + slope[..., :2, None] * A[..., 2:, :]
    d_fan = (
        d_axes[..., :2, :]
        + d_slope[..., :2, None] * A[..., 2:, :]
        + slope[..., :2, None] * d_axes[..., 2:, :]
    )
    d_jacobian = -dt[..., None] * fan - t[..., None] * d_fan

    jacobian = _jacobian(lens, centre, axes)
    codes = _codes(jacobian, orientation, allow_missing)
    scale = 1 / np.sqrt(np.abs(_determinant(jacobian)))
    d_scale = -0.5 * scale[..., None] * _relative_growth(jacobian[..., None, :, :], d_jacobian)
    across, along = (one[..., None] for one in _turned(jacobian, codes))
    d_across, d_along = _turned(d_jacobian, codes[..., None])
    d_theta = (along * d_across - across * d_along) / (across**2 + along**2)
    slopes = np.stack([d_point[..., 0], d_point[..., 1], d_scale, d_theta], axis=-2)
    return np.where(codes[..., None, None] > 0, slopes, np.nan)


def projection(mask: Placement, lens_mm: ArrayLike, sensor: Placement) -> Projection:
    """The whole map from sensor to mask, projective where they are tilted.

    Raises
    ------
    ValueError
        As `reading`.
    """
    lens, centre, axes = _checked(*_in_mask(mask, lens_mm, sensor), allow_missing=False)
    # columns: what u, v (um) and 1 contribute to the sensor's point, in mm
    columns = np.column_stack([axes / UM_PER_MM, centre])
    numerators = np.outer(lens, columns[2]) - lens[2] * columns
    denominator = columns[2] - [0.0, 0.0, lens[2]]
    return Projection(np.vstack([UM_PER_MM * numerators[:2], denominator]))


def _in_mask(mask: Placement, lens_mm: ArrayLike, sensor: Placement) -> tuple[Array, Array, Array]:
    """Lens (..., 3), sensor (..., 3) and its u and v (..., 3, 2) in the mask's own axes."""
    back = np.swapaxes(mask.rotation, -1, -2)
    lens = _times(back, np.asarray(lens_mm, dtype=np.float64) - mask.position_mm)
    centre = _times(back, sensor.position_mm - mask.position_mm)
    axes = back @ sensor.rotation[..., :2]
    shape = np.broadcast_shapes(lens.shape[:-1], centre.shape[:-1], axes.shape[:-2])
    return (
        np.broadcast_to(lens, (*shape, 3)),
        np.broadcast_to(centre, (*shape, 3)),
        np.broadcast_to(axes, (*shape, 3, 2)),
    )


def _times(matrix: Array, vector: Array) -> Array:
    return (matrix @ vector[..., None])[..., 0]


def _checked(
    lens: Array, centre: Array, axes: Array, allow_missing: bool
) -> tuple[Array, Array, Array]:
    """The same, NaN where nothing can be read; raises if that is not allowed."""
    known = (
        np.isfinite(lens).all(-1) & np.isfinite(centre).all(-1) & np.isfinite(axes).all((-2, -1))
    )
    line = lens - centre
    length = np.linalg.norm(line, axis=-1)
    normal = np.cross(axes[..., 0], axes[..., 1])
    faults = {
        "a position or rotation of mask, lens or sensor is not a finite number": ~known,
        "lens and sensor are at the same place": length == 0,
        "the line from sensor through lens runs along the mask and never meets it": (
            np.abs(line[..., 2]) <= _GRAZING * length
        ),
        "the lens is not between mask and sensor; check the positions and the order mask, lens, "
        "sensor": lens[..., 2] * line[..., 2] >= 0,
        "the sensor is seen edge on from the lens: no light falls on it": (
            np.abs(np.sum(normal * line, axis=-1)) <= _GRAZING * length
        ),
    }
    missing = np.zeros(length.shape, dtype=bool)
    for sentence, where in faults.items():
        if where.any() and not allow_missing:
            raise ValueError(sentence)
        missing |= where
    if not missing.any():
        return lens, centre, axes
    gone = missing[..., None]
    return (
        np.where(gone, np.nan, lens),
        np.where(gone, np.nan, centre),
        np.where(gone[..., None], np.nan, axes),
    )


def _jacobian(lens: Array, centre: Array, axes: Array) -> Array:
    """d(X, Y) / d(u, v) at the reference point, shape (..., 2, 2)."""
    depth = (centre - lens)[..., 2]
    slope = (lens - centre)[..., :2] / depth[..., None]
    fan = axes[..., :2, :] + slope[..., :, None] * axes[..., 2:, :]
    return -(lens[..., 2] / depth)[..., None, None] * fan


def _determinant(matrix: Array) -> Array:
    # numpy's own warns of NaN
    return matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]


def _relative_growth(matrix: Array, change: Array) -> Array:
    """Relative change of a determinant."""
    (a, b), (c, d) = ([matrix[..., i, j] for j in (0, 1)] for i in (0, 1))
    (da, db), (dc, dd) = ([change[..., i, j] for j in (0, 1)] for i in (0, 1))
    return (da * d + a * dd - db * c - b * dc) / (a * d - b * c)


def _codes(
    jacobian: Array, orientation: ArrayLike | None, allow_missing: bool
) -> NDArray[np.int64]:
    """Codes: those given if they are possible, else those of the smaller rotation; 0 for none."""
    determinant = _determinant(jacobian)
    first = np.where(determinant > 0, 2, 1)
    if orientation is None:
        _, along = _turned(jacobian, first)
        # 1 and 4, 2 and 3 are half a turn apart
        codes = np.where(along >= 0, first, 5 - first)
    else:
        codes = np.broadcast_to(np.asarray(orientation, dtype=np.int64), first.shape)
    possible = np.isfinite(determinant) & ((codes == first) | (codes == 5 - first))
    if not (possible.all() or allow_missing):
        pairs = " or ".join({1: "1 and 4", 2: "2 and 3"}[one] for one in np.unique(first))
        raise ValueError(
            f"orientation {orientation!r} is not possible here: the elements as placed give {pairs}"
        )
    return np.where(possible, codes, 0)


def _turned(jacobian: Array, codes: NDArray[np.int64]) -> tuple[Array, Array]:
    """Twice the sine and cosine of theta_z, times 1 / S for a similarity."""
    directions = np.array([(0, 0), *(ORIENTATIONS[code] for code in (1, 2, 3, 4))])[codes]
    dx, dy = directions[..., 0], directions[..., 1]
    across = dy * jacobian[..., 1, 0] - dx * jacobian[..., 0, 1]
    along = dx * jacobian[..., 0, 0] + dy * jacobian[..., 1, 1]
    return across, along


def _motions(mask: Placement, lens_mm: ArrayLike, sensor: Placement) -> tuple[Array, Array, Array]:
    """What a unit of each of `MOTIONS` does in the mask's own axes, mm per um or rad.

    Returns
    -------
    d_lens, d_centre : ndarray, shape (..., 15, 3)
    d_axes : ndarray, shape (..., 15, 3, 2)
    """
    back = np.swapaxes(mask.rotation, -1, -2)
    lens = np.asarray(lens_mm, dtype=np.float64) - mask.position_mm
    centre = sensor.position_mm - mask.position_mm
    axes = sensor.rotation[..., :2]
    shape = np.broadcast_shapes(
        lens.shape[:-1], centre.shape[:-1], axes.shape[:-2], back.shape[:-2]
    )
    d_lens, d_centre = np.zeros((*shape, 15, 3)), np.zeros((*shape, 15, 3))
    d_axes = np.zeros((*shape, 15, 3, 2))
    for k, unit in enumerate(np.eye(3)):
        shift = back[..., :, k] / UM_PER_MM
        d_lens[..., k, :] = d_centre[..., k, :] = -shift
        d_lens[..., 6 + k, :] = d_centre[..., 9 + k, :] = shift
        # a turn of the mask turns all the rest the other way
        turn = np.cross(unit, np.eye(3)).T
        d_lens[..., 3 + k, :] = -_times(back, _times(turn, lens))
        d_centre[..., 3 + k, :] = -_times(back, _times(turn, centre))
        d_axes[..., 3 + k, :, :] = -back @ (turn @ axes)
        d_axes[..., 12 + k, :, :] = back @ (turn @ axes)
    return d_lens, d_centre, d_axes
