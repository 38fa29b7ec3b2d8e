"""The map from the sensor to the mask: what a pose does to coordinates.

See the conventions page (``docs/conventions.md``) for axes, signs and units.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["ORIENTATIONS", "Projection", "sensor_grid_um", "wrap_angle"]

# Direction in which mask x and mask y grow, per orientation code: +1 along u
# (right) or v (down) of the image, -1 against it.
ORIENTATIONS: dict[int, tuple[int, int]] = {1: (+1, -1), 2: (-1, -1), 3: (+1, +1), 4: (-1, +1)}


def wrap_angle(angle_rad: float) -> float:
    """The same angle in (-pi, pi]."""
    return float(np.pi - np.mod(np.pi - angle_rad, 2 * np.pi))


def sensor_grid_um(
    shape: tuple[int, int], pixel_um: float, reference_px: tuple[float, float] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sensor coordinates of the pixel centres.

    Parameters
    ----------
    shape : tuple of int
        (height, width) in pixels.
    pixel_um : float
        Pixel pitch.
    reference_px : tuple of float, optional
        (column, row) of the reference point; the geometric centre of the array by default.

    Returns
    -------
    u_um : ndarray, shape (width,)
        Right of the reference point.
    v_um : ndarray, shape (height,)
        Below the reference point.
    """
    height, width = shape
    column, row = reference_px or ((width - 1) / 2, (height - 1) / 2)
    u = (np.arange(width, dtype=np.float64) - column) * pixel_um
    v = (np.arange(height, dtype=np.float64) - row) * pixel_um
    return u, v


@dataclass(frozen=True, eq=False)
class Projection:
    """Plane projective map from sensor (u, v) to mask (X, Y), both in micrometres.

    ``(X w, Y w, w) = matrix @ (u, v, 1)`` with ``matrix[2, 2] == 1``. A similarity (what
    an aligned Rasnik shows) and an affine map have ``matrix[2, :2] == 0``.
    """

    matrix: NDArray[np.float64] = field()

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or matrix[2, 2] == 0:
            raise ValueError("a Projection needs a finite 3 x 3 matrix with matrix[2, 2] != 0")
        matrix /= matrix[2, 2]
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def from_pose(
        cls, x_um: float, y_um: float, scale: float, theta_rad: float, orientation: int
    ) -> Projection:
        """The similarity of a pose: mask (x_um, y_um) imaged on the reference point."""
        if orientation not in ORIENTATIONS:
            raise ValueError(f"orientation must be 1, 2, 3 or 4, not {orientation!r}")
        if not scale > 0:
            raise ValueError(f"scale must be positive, not {scale!r}")
        dx, dy = ORIENTATIONS[orientation]
        c, s = np.cos(theta_rad) / scale, np.sin(theta_rad) / scale
        return cls(np.array([[dx * c, -dx * s, x_um], [dy * s, dy * c, y_um], [0.0, 0.0, 1.0]]))

    @property
    def is_affine(self) -> bool:
        return not self.matrix[2, :2].any()

    @property
    def x_um(self) -> float:
        """Mask x imaged on the reference point."""
        return float(self.matrix[0, 2])

    @property
    def y_um(self) -> float:
        """Mask y imaged on the reference point."""
        return float(self.matrix[1, 2])

    @property
    def jacobian(self) -> NDArray[np.float64]:
        """d(X, Y) / d(u, v) at the reference point, shape (2, 2)."""
        return self.jacobian_at(0.0, 0.0)

    def jacobian_at(self, u_um: float, v_um: float) -> NDArray[np.float64]:
        """d(X, Y) / d(u, v) at a point of the sensor, shape (2, 2)."""
        m = self.matrix
        x, y, w = m @ (u_um, v_um, 1.0)
        jacobian: NDArray[np.float64] = (m[:2, :2] - np.outer([x / w, y / w], m[2, :2])) / w
        return jacobian

    @property
    def mirrored(self) -> bool:
        """Whether mask and image have opposite handedness as seen with v down.

        True for orientations 2 and 3, False for 1 and 4 (where y grows up).
        """
        return bool(np.linalg.det(self.jacobian) > 0)

    def similarity(self, orientation: int | None = None) -> tuple[float, float, int]:
        """Scale, rotation and orientation of the nearest similarity at the reference point.

        Parameters
        ----------
        orientation : int, optional
            One of the two codes of this handedness; theta_z then covers the full circle.
            By default the code for which ``|theta_z| <= pi / 2``.

        Returns
        -------
        scale : float
            Geometric mean of the two principal magnifications.
        theta_rad : float
            Rotation of the pattern, anticlockwise as seen on the image.
        orientation : int

        Raises
        ------
        ValueError
            If `orientation` is of the other handedness.
        """
        jac = self.jacobian
        codes = (2, 3) if self.mirrored else (1, 4)
        if orientation is not None and orientation not in codes:
            raise ValueError(f"orientation {orientation} has the other handedness: {codes}")
        code = orientation or codes[0]
        dx, dy = ORIENTATIONS[code]
        unfolded = np.diag([dx, dy]) @ jac  # [[c, -s], [s, c]] / scale for a similarity
        theta = float(np.arctan2(unfolded[1, 0] - unfolded[0, 1], unfolded[0, 0] + unfolded[1, 1]))
        if orientation is None and abs(theta) > np.pi / 2:
            code, theta = codes[1], wrap_angle(theta + np.pi)
        return 1.0 / float(np.sqrt(abs(np.linalg.det(jac)))), wrap_angle(theta), code

    def to_mask(
        self, u_um: ArrayLike, v_um: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mask coordinates (X, Y) in um of sensor points; arguments broadcast."""
        u, v = np.asarray(u_um, dtype=np.float64), np.asarray(v_um, dtype=np.float64)
        m = self.matrix
        w = m[2, 0] * u + m[2, 1] * v + 1.0
        return (
            (m[0, 0] * u + m[0, 1] * v + m[0, 2]) / w,
            (m[1, 0] * u + m[1, 1] * v + m[1, 2]) / w,
        )

    def to_sensor(
        self, x_um: ArrayLike, y_um: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Sensor coordinates (u, v) in um of mask points; arguments broadcast."""
        inverse = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        return Projection(inverse).to_mask(x_um, y_um)

    def exchanged(self) -> Projection:
        """The same image read with mask x and y exchanged (codes look alike)."""
        return Projection(self.matrix[[1, 0, 2]])
