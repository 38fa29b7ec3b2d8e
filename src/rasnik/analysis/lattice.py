"""The chess lattice of an image: where its fields lie, before any code is read."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["FieldSamples", "Lattice", "quadratic_basis"]

Array = NDArray[np.float64]


def quadratic_basis(u: ArrayLike, v: ArrayLike) -> Array:
    """The terms 1, u, v, u^2, u v, v^2 in the last axis; `u` and `v` broadcast."""
    u, v = np.broadcast_arrays(np.asarray(u, float), np.asarray(v, float))
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """Grey levels at the field centres of a lattice.

    Attributes
    ----------
    first_i, first_j : int
        Lattice indices of element [0, 0].
    grey : ndarray, shape (nj, ni), float64
        Mean grey level of the central part of field (first_i + column, first_j + row).
    present : ndarray of bool, shape (nj, ni)
        Whether the central part of the field is in view.
    u, v : ndarray, shape (nj, ni)
        Field centre on the sensor in units of half the image width and height.
    """

    first_i: int
    first_j: int
    grey: Array
    present: NDArray[np.bool_]
    u: Array
    v: Array

    @property
    def chess(self) -> Array:
        """+1 where the chessboard is bright (i + j even), -1 where it is dark."""
        rows, columns = self.grey.shape
        parity = np.add.outer(
            np.arange(rows) + self.first_j, np.arange(columns) + self.first_i
        )
        return 1.0 - 2.0 * (parity % 2)


@dataclass(frozen=True, eq=False)
class Lattice:
    """Chess fields found in an image, with an arbitrary origin.

    ``(p, q) = matrix @ (u_um, v_um, 1)`` are field coordinates: contours lie at the integers and
    field (i, j) covers [i, i+1) x [j, j+1). Before code inversion the fields with even i + j are
    the bright ones. p grows to the right and q upward of the image, within 45 degrees; which
    fields of the mask these are is for the code to tell.

    Attributes
    ----------
    matrix : ndarray, shape (2, 3)
    covariance : ndarray, shape (6, 6)
        Of ``matrix.ravel()``, from pixel noise alone.
    pixels_per_field : float
        Side of a field on the sensor (root of its area) in pixels.
    blur_um : float
        Gaussian sigma of the blur on the sensor without the pixel, estimated from how fast the
        harmonics fade; good to some ten per cent, NaN if it cannot be told.
    dark, light : ndarray, shape (6,)
        Grey levels of wide black and white areas: coefficients of `quadratic_basis` in sensor
        coordinates divided by half the image width and height.
    noise_variance : float
        Variance of a pixel (grey levels squared) behind `covariance`.
    score : float
        Fraction of the fields that are brighter or darker than their neighbours as the
        chessboard demands: 0.5 by chance, near 0.9 for a clean coded mask.
    shape : tuple of int
        (height, width) of the image.
    pixel_um : float
    bounds_px : tuple of int
        (left, top, right, bottom) of the picture inside dark borders, right and bottom exclusive.
    samples : FieldSamples
    """

    matrix: Array
    covariance: Array
    pixels_per_field: float
    blur_um: float
    dark: Array
    light: Array
    noise_variance: float
    score: float
    shape: tuple[int, int]
    pixel_um: float
    bounds_px: tuple[int, int, int, int]
    samples: FieldSamples = field(repr=False)

    def to_field(self, u_um: ArrayLike, v_um: ArrayLike) -> tuple[Array, Array]:
        """Field coordinates (p, q) of sensor points in micrometres; arguments broadcast."""
        u, v = np.asarray(u_um, float), np.asarray(v_um, float)
        m = self.matrix
        return m[0, 0] * u + m[0, 1] * v + m[0, 2], m[1, 0] * u + m[1, 1] * v + m[1, 2]

    def to_sensor(self, p: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
        """Sensor coordinates (u, v) in micrometres of field coordinates; arguments broadcast."""
        inverse = np.linalg.inv(self.matrix[:, :2])
        dp = np.asarray(p, float) - self.matrix[0, 2]
        dq = np.asarray(q, float) - self.matrix[1, 2]
        return (
            inverse[0, 0] * dp + inverse[0, 1] * dq,
            inverse[1, 0] * dp + inverse[1, 1] * dq,
        )
