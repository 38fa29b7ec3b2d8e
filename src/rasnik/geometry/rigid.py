"""Rigid bodies: six degrees of freedom each, and how far a point of one moves.

A body moves from its nominal place by a translation and a turn, both in its own nominal axes: a
point q of the body (mm, in its frame) stands at

    p0 + R0 (t + exp(r) q)

with p0 and R0 the nominal position and rotation, t the translation and r the rotation vector,
whose direction is the axis and whose length the angle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "DOFS",
    "DOF_WORDS",
    "UM_PER_MM",
    "axes_along",
    "left_jacobian",
    "rotation_matrix",
    "skew",
]

Array = NDArray[np.float64]

#: The degrees of freedom of a body, in the order of all arrays.
DOFS = ("x_um", "y_um", "z_um", "rx_rad", "ry_rad", "rz_rad")

#: What they are called.
DOF_WORDS = (
    *(f"translation along {axis}" for axis in "xyz"),
    *(f"rotation about {axis}" for axis in "xyz"),
)

UM_PER_MM = 1e3

# Below this angle the series of the left Jacobian are exact to the last digit.
_SMALL_RAD = 1e-2


def skew(vector: ArrayLike) -> Array:
    """Matrix of the cross product: ``skew(a) @ b == cross(a, b)``.

    Parameters
    ----------
    vector : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    v = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def rotation_matrix(vector_rad: ArrayLike) -> Array:
    """Rotation of rotation vectors.

    Parameters
    ----------
    vector_rad : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    from scipy.spatial.transform import Rotation

    vectors = np.asarray(vector_rad, dtype=np.float64)
    flat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return np.asarray(flat).reshape(*vectors.shape, 3)


def left_jacobian(vector_rad: ArrayLike) -> Array:
    """How a rotation turns when its vector changes: exp(r + dr) = exp(J dr) exp(r).

    Parameters
    ----------
    vector_rad : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3, 3)

    Notes
    -----
    J = 1 + (1 - cos a) / a^2 K + (a - sin a) / a^3 K^2, with a the angle and K the matrix of the
    cross product. Source: Chirikjian, "Stochastic Models, Information Theory, and Lie Groups",
    volume 2, section 10.6.
    """
    vector = np.asarray(vector_rad, dtype=np.float64)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    small = angle < _SMALL_RAD
    a = np.where(small, 1.0, angle)
    first = np.where(small, 1 / 2 - angle**2 / 24 + angle**4 / 720, (1 - np.cos(a)) / a**2)
    second = np.where(small, 1 / 6 - angle**2 / 120 + angle**4 / 5040, (a - np.sin(a)) / a**3)
    cross = skew(vector)
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def axes_along(forward: ArrayLike, right: ArrayLike) -> Array:
    """Axes whose third points forward and whose first lies as near to `right` as it can.

    Parameters
    ----------
    forward : array_like, shape (3,)
    right : array_like, shape (3,)
        Not along `forward`.

    Returns
    -------
    ndarray, shape (3, 3)
        The axes are the columns; right-handed.
    """
    z = np.asarray(forward, dtype=np.float64)
    z = z / np.linalg.norm(z)
    x = np.asarray(right, dtype=np.float64)
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
