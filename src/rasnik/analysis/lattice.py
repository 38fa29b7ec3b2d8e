"""The chess lattice of an image: where its fields lie, before any code is read."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.analysis.levels import Levels
from rasnik.analysis.picture import Picture
from rasnik.analysis.sampling import FieldSamples
from rasnik.analysis.tones import ToneLattice

__all__ = ["Lattice"]

Array = NDArray[np.float64]


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
        Gaussian sigma of the blur on the sensor without the pixel, from how fast the harmonics
        fade or, where there are none, from the mixing of neighbouring fields; good to some ten
        per cent.
    noise_variance : float
        Variance of a pixel (grey levels squared) behind `covariance`.
    score : float
        Fraction of the fields that are brighter or darker than their neighbours as the
        chessboard demands: 0.5 by chance, near 0.9 for a clean coded mask.
    coverage : float
        Fraction of the picture that shows the mask.
    shape : tuple of int
        (height, width) of the image.
    pixel_um : float
    tones : ToneLattice
        The spectral lines behind `matrix`.
    picture : Picture
        The part of the image and the window used.
    samples : FieldSamples
        Grey levels of the field centres.
    levels : Levels
        Dark and light grey levels fitted to them.
    """

    matrix: Array
    covariance: Array
    pixels_per_field: float
    blur_um: float
    noise_variance: float
    score: float
    coverage: float
    shape: tuple[int, int]
    pixel_um: float
    tones: ToneLattice = field(repr=False)
    picture: Picture = field(repr=False)
    samples: FieldSamples = field(repr=False)
    levels: Levels = field(repr=False)

    @property
    def bounds_px(self) -> tuple[int, int, int, int]:
        """(left, top, right, bottom) of the picture, right and bottom exclusive."""
        return self.picture.bounds_px

    @property
    def dark(self) -> Array:
        """Grey level of wide black areas, shape (6,).

        Coefficients of ``1, u, v, u^2, u v, v^2`` (`rasnik.imaging.appearance.surface`), with
        the sensor coordinates divided by half the image's width and height.
        """
        return self.levels.middle - self.levels.half

    @property
    def light(self) -> Array:
        """Grey level of wide white areas, as `dark`."""
        return self.levels.middle + self.levels.half

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
