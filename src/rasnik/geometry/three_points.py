"""Mask, lens and sensor on a line: what the motion of each does to the reading, and back.

One Rasnik reads four numbers: x, y, scale S and theta_z. Its elements have fifteen ways to move,
so a reading means a displacement only once it is said which elements stand still. The linear
matrix says what each motion does; motions whose columns depend on each other cannot be told
apart by one Rasnik, and tilts of mask and sensor are not seen to first order at all. For a
chosen set that can be told apart the exact readings are inverted, not the matrix.

Axes: x along the mask's X, y along its Y, z along the light from mask to sensor. Turns are right
handed about X, Y and X x Y; mask and sensor turn about the points that stand on the line. The
camera is lens and sensor fixed together; it turns about its pivot, and its axis sweeps over the
mask.

Source: van der Graaf et al., section "Principles" (also of the camera and its 4-D position).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.geometry.reading import (
    MOTIONS,
    Placement,
    Reading,
    derivatives,
    readings,
)
from rasnik.geometry.rigid import UM_PER_MM, left_jacobian, rotation_matrix, skew
from rasnik.imaging.projection import ORIENTATIONS
from rasnik.instrument import System, scales_contradict

__all__ = [
    "ALL_MOTIONS",
    "CAMERA_MOTIONS",
    "ThreePoints",
    "motion_index",
    "motion_unit",
    "three_points",
]

Array = NDArray[np.float64]

#: Lens and sensor moved as one body.
CAMERA_MOTIONS = tuple(f"camera_{kind}" for kind in ("x", "y", "z", "turn_x", "turn_y", "turn_z"))
#: Order of motions: shifts in um, turns in rad.
ALL_MOTIONS = MOTIONS + CAMERA_MOTIONS

# Where the motions of each body stand in ALL_MOTIONS; those of an element are so in MOTIONS too.
_MASK_SHIFT, _MASK_TURN, _LENS_SHIFT = slice(0, 3), slice(3, 6), slice(6, 9)
_SENSOR_SHIFT, _SENSOR_TURN = slice(9, 12), slice(12, 15)
_CAMERA_SHIFT, _CAMERA_TURN = slice(15, 18), slice(18, 21)


def motion_unit(name: str) -> str:
    """``"um"`` or ``"rad"``: the unit of a motion."""
    return "rad" if "_turn_" in name else "um"


@dataclass(frozen=True)
class ThreePoints:
    """A Rasnik as built: elements perpendicular to the line through their centres.

    Attributes
    ----------
    mask_lens_mm, lens_sensor_mm : float
        Distances a and b along the line, mm. S = b / a.
    theta_rad : float
        theta_z as built.
    orientation : int
        1..4; 4 for one lens and a camera that is not turned.
    x_um, y_um : float
        Point of the mask on the line as built.
    pivot_mm : float or None
        Where the camera turns, mm from the mask along the light; None: at the lens.

    Raises
    ------
    ValueError
        If a value is impossible.
    """

    mask_lens_mm: float
    lens_sensor_mm: float
    theta_rad: float = 0.0
    orientation: int = 4
    x_um: float = 0.0
    y_um: float = 0.0
    pivot_mm: float | None = None

    def __post_init__(self) -> None:
        for name in ("mask_lens_mm", "lens_sensor_mm"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(
                    f"{name} = {value:g}: distances are counted along the light, from mask to lens "
                    "and from lens to sensor, and are positive"
                )
        if self.orientation not in ORIENTATIONS:
            raise ValueError(f"orientation must be 1, 2, 3 or 4, not {self.orientation!r}")
        if not all(map(math.isfinite, (self.theta_rad, self.x_um, self.y_um, self.pivot_mm or 0))):
            raise ValueError("theta_rad, x_um, y_um and pivot_mm must be finite numbers")

    @property
    def scale(self) -> float:
        """Image size / mask size, b / a."""
        return self.lens_sensor_mm / self.mask_lens_mm

    @property
    def as_built(self) -> Reading:
        """What is read when nothing has moved."""
        return Reading(self.x_um, self.y_um, self.scale, self.theta_rad, self.orientation)

    def read(self, motions: Mapping[str, float]) -> Reading:
        """What is read, exactly, after motions of any size.

        Parameters
        ----------
        motions : mapping
            ``{"lens_x": 12.0, "mask_turn_z": 1e-3}``: um and rad; see `ALL_MOTIONS`. Turns of one
            body are the components of one rotation vector. Those of the camera come on top of
            those of its parts.

        Raises
        ------
        KeyError
            If there is no such motion.
        ValueError
            If nothing can be read there.
        """
        vector = np.zeros(len(ALL_MOTIONS))
        for name, value in motions.items():
            vector[motion_index(name)] = value
        (x, y, scale, theta), code = readings(*self._placed(vector), self.orientation)
        return Reading(
            float(x + self.x_um), float(y + self.y_um), float(scale), float(theta), int(code)
        )

    def values(self, motions: ArrayLike) -> Array:
        """What is read after each of many sets of motions.

        Parameters
        ----------
        motions : array_like, shape (..., 21)
            In the order of `ALL_MOTIONS`, um and rad.

        Returns
        -------
        ndarray, shape (..., 4)
            x (um), y (um), S, theta_z (rad); NaN where nothing can be read.
        """
        placed = self._placed(np.asarray(motions, dtype=np.float64))
        found, _ = readings(*placed, self.orientation, allow_missing=True)
        found[..., :2] += [self.x_um, self.y_um]
        return found

    def slopes(self, motions: ArrayLike) -> Array:
        """How what is read changes with each motion, around given motions.

        Parameters
        ----------
        motions : array_like, shape (..., 21)

        Returns
        -------
        ndarray, shape (..., 4, 21)
            Per um and rad; exact.
        """
        vector = np.asarray(motions, dtype=np.float64)
        placed = self._placed(vector)
        by_element = derivatives(*placed, self.orientation, allow_missing=True)
        return by_element @ self._chain(vector, placed)

    @cached_property
    def _matrix(self) -> Array:
        return self.slopes(np.zeros(len(ALL_MOTIONS)))

    def matrix(self, names: Iterable[str] = ALL_MOTIONS) -> Array:
        """The linear matrix: readings per small motion.

        Parameters
        ----------
        names : iterable of str

        Returns
        -------
        ndarray, shape (4, n)
            Rows x (um), y (um), S, theta_z (rad); columns per um or per rad.
        """
        return self._matrix[:, [motion_index(name) for name in names]]

    @property
    def natural_readings(self) -> Array:
        """Sizes of the readings that make the matrix of order one, shape (4,)."""
        a = UM_PER_MM * self.mask_lens_mm
        return np.array([a, a, self.scale, 1.0])

    def natural_motions(self, names: Sequence[str]) -> Array:
        """Sizes of the motions that make the matrix of order one, shape (n,)."""
        a = UM_PER_MM * self.mask_lens_mm
        return np.array([a if motion_unit(name) == "um" else 1.0 for name in names])

    def sagitta(
        self, x_um: float, y_um: float, scale: float, covariance: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """How far the lens is from the straight line between mask and sensor.

        The line runs from the point (`self.x_um`, `self.y_um`) of the mask to the centre of the
        sensor. Only ratios of distances matter, and S gives them: the distances may be unknown.

        Parameters
        ----------
        x_um, y_um, scale : float
            As read.
        covariance : array_like, shape (4, 4) or (3, 3), optional
            Of x, y, S (and theta_z).

        Returns
        -------
        sagitta_um : ndarray, shape (2,)
            Along the mask's X and Y.
        covariance_um2 : ndarray, shape (2, 2)
            NaN without a covariance.
        """
        share = scale / (1 + scale)
        offset = np.array([x_um - self.x_um, y_um - self.y_um])
        if covariance is None:
            return share * offset, np.full((2, 2), np.nan)
        slope = np.column_stack([share * np.eye(2), offset / (1 + scale) ** 2])
        noise = np.asarray(covariance, dtype=np.float64)[:3, :3]
        return share * offset, slope @ noise @ slope.T

    def _pivot_mm(self) -> float:
        return self.mask_lens_mm if self.pivot_mm is None else self.pivot_mm

    @cached_property
    def _along(self) -> Array:
        """Direction of the light: mirrored masks are seen from their other side."""
        dx, dy = ORIENTATIONS[self.orientation]
        return np.array([1.0, 1.0, -dx * dy])

    @cached_property
    def _sensor_axes(self) -> Array:
        dx, dy = ORIENTATIONS[self.orientation]
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return np.array([[-dx * c, dx * s, 0.0], [-dy * s, -dy * c, 0.0], [0.0, 0.0, dx * dy]])

    def _placed(self, motions: Array) -> tuple[Placement, Array, Placement]:
        """The elements in the world; its origin is the mask's point on the line as built."""

        def shift(which: slice) -> Array:
            return motions[..., which] / UM_PER_MM * self._along

        z = self._along * [0.0, 0.0, 1.0]
        pivot = self._pivot_mm() * z
        camera = rotation_matrix(motions[..., _CAMERA_TURN])

        def carried(point: Array) -> Array:
            arm = camera @ (point - pivot)[..., None]
            return np.asarray(arm[..., 0] + pivot + shift(_CAMERA_SHIFT))

        length = self.mask_lens_mm + self.lens_sensor_mm
        mask = Placement(shift(_MASK_SHIFT), rotation_matrix(motions[..., _MASK_TURN]))
        lens = carried(self.mask_lens_mm * z + shift(_LENS_SHIFT))
        axes = camera @ rotation_matrix(motions[..., _SENSOR_TURN]) @ self._sensor_axes
        return mask, lens, Placement(carried(length * z + shift(_SENSOR_SHIFT)), axes)

    def _chain(self, motions: Array, placed: tuple[Placement, Array, Placement]) -> Array:
        """d(motion of each element in the world) / d(motions), shape (..., 15, 21)."""
        _, lens, sensor = placed
        chain = np.zeros((*motions.shape[:-1], len(MOTIONS), len(ALL_MOTIONS)))
        along = np.diag(self._along)
        camera = rotation_matrix(motions[..., _CAMERA_TURN])
        turned = left_jacobian(motions[..., _CAMERA_TURN])
        pivot = self._pivot_mm() * self._along * [0.0, 0.0, 1.0]
        pivot = pivot + motions[..., _CAMERA_SHIFT] / UM_PER_MM * self._along
        chain[..., _MASK_SHIFT, _MASK_SHIFT] = along
        chain[..., _MASK_TURN, _MASK_TURN] = left_jacobian(motions[..., _MASK_TURN])
        sensor_turn = camera @ left_jacobian(motions[..., _SENSOR_TURN])
        chain[..., _SENSOR_TURN, _SENSOR_TURN] = sensor_turn
        chain[..., _SENSOR_TURN, _CAMERA_TURN] = turned
        for rows, point in ((_LENS_SHIFT, lens), (_SENSOR_SHIFT, sensor.position_mm)):
            chain[..., rows, rows] = camera @ along
            chain[..., rows, _CAMERA_SHIFT] = along
            chain[..., rows, _CAMERA_TURN] = -skew(UM_PER_MM * (point - pivot)) @ turned
        return chain


def three_points(
    mask_lens_mm: float | None = None,
    lens_sensor_mm: float | None = None,
    scale: float | None = None,
    *,
    system: System | None = None,
    **as_built: Any,
) -> ThreePoints:
    """A Rasnik from two of its two distances and its scale, or from a system.

    Parameters
    ----------
    mask_lens_mm, lens_sensor_mm : float, optional
        mm; by default those of the system.
    scale : float, optional
        By default the ratio of the distances, or that of the system.
    system : System, optional
        Gives what is not given: distances, scale, theta_z, orientation (4 if it is open).
    **as_built
        Other attributes of `ThreePoints`.

    Raises
    ------
    ValueError
        If fewer than two are known, or if they contradict each other.
    """
    if system is not None:
        if mask_lens_mm is None and lens_sensor_mm is None:
            mask_lens_mm = system.geometry.mask_lens_mm
            lens_sensor_mm = system.geometry.lens_sensor_mm
        if mask_lens_mm is None or lens_sensor_mm is None:
            scale = system.optics.scale if scale is None else scale
        as_built = {
            "theta_rad": system.optics.theta_rad,
            "orientation": system.optics.orientation or 4,
            **as_built,
        }
    for name, value in (("mask_lens_mm", mask_lens_mm), ("lens_sensor_mm", lens_sensor_mm),
                        ("scale", scale)):  # fmt: skip
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} = {value:g} must be positive")
    if mask_lens_mm is not None and lens_sensor_mm is not None:
        ratio = lens_sensor_mm / mask_lens_mm
        if scale is not None and scales_contradict(ratio, scale):
            raise ValueError(
                f"scale = {scale:g}, but lens_sensor_mm = {lens_sensor_mm:g} and mask_lens_mm = "
                f"{mask_lens_mm:g} make a scale of {ratio:g}; give two of the three"
            )
        return ThreePoints(mask_lens_mm, lens_sensor_mm, **as_built)
    if scale is not None and mask_lens_mm is not None:
        return ThreePoints(mask_lens_mm, scale * mask_lens_mm, **as_built)
    if scale is not None and lens_sensor_mm is not None:
        return ThreePoints(lens_sensor_mm / scale, lens_sensor_mm, **as_built)
    if system is None:
        raise ValueError("give two of mask_lens_mm, lens_sensor_mm and scale, or a system")
    raise ValueError(
        f"the system {system.name} does not state its distances: give mask_lens_mm or "
        "lens_sensor_mm"
    )


def motion_index(name: str) -> int:
    """Place of a motion in `ALL_MOTIONS`."""
    try:
        return ALL_MOTIONS.index(name)
    except ValueError:
        raise KeyError(
            f"there is no motion {name!r}; an element (mask, lens, sensor, camera) moves by _x, _y "
            "or _z and, but for the lens, turns by _turn_x, _turn_y or _turn_z"
        ) from None
