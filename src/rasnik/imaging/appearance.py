"""The pixel grid of a frame, and how the mask looks on it: light, blur and edges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Appearance", "Camera", "surface"]


@dataclass(frozen=True)
class Camera:
    """The pixel grid of a frame.

    Attributes
    ----------
    shape : tuple of int
        (height, width).
    pixel_um : float
        Pitch of the pixels as read out.
    reference_px : tuple of float, optional
        (column, row) of the reference point; the centre of the array by default.
    """

    shape: tuple[int, int]
    pixel_um: float
    reference_px: tuple[float, float] | None = None

    @property
    def origin_um(self) -> tuple[float, float]:
        """(u, v) of the centre of pixel (row 0, column 0)."""
        height, width = self.shape
        column, row = self.reference_px or ((width - 1) / 2, (height - 1) / 2)
        return -column * self.pixel_um, -row * self.pixel_um

    @property
    def half_size_um(self) -> tuple[float, float]:
        """Half the width and half the height of the array."""
        return self.shape[1] * self.pixel_um / 2, self.shape[0] * self.pixel_um / 2

    @cached_property
    def corners_um(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """u and v of the outer corners of the array, shape (4,) each."""
        (u0, v0), (height, width) = self.origin_um, self.shape
        u = u0 + self.pixel_um * (np.array([0, 1, 0, 1]) * width - 0.5)
        v = v0 + self.pixel_um * (np.array([0, 0, 1, 1]) * height - 0.5)
        u.setflags(write=False)
        v.setflags(write=False)
        return u, v

    @cached_property
    def centre_um(self) -> tuple[float, float]:
        """(u, v) of the centre of the array."""
        u, v = self.corners_um
        return float(u.mean()), float(v.mean())


def surface(u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
    """Monomials 1, u, v, u^2, uv, v^2 of normalised coordinates; `u` and `v` broadcast.

    Returns
    -------
    ndarray, shape (..., 6)
    """
    u, v = np.broadcast_arrays(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


@dataclass(frozen=True, eq=False)
class Appearance:
    """How the mask looks: light, blur and edges. Nuisances to a position, all of them.

    Attributes
    ----------
    dark, light : ndarray, shape (6,)
        Grey level of black and white: coefficients of `surface`, with u and v in units of
        half the image size from the reference point.
    blur_um : float
        Gaussian sigma of the optical blur, on the sensor.
    edge_shift_um : float
        By how much black fields are larger than nominal at each edge, on the mask.
    kurtosis : float
        Excess kurtosis of the blur: 0 for a Gaussian, negative for defocus, positive
        for a halo.
    """

    dark: NDArray[np.float64]
    light: NDArray[np.float64]
    blur_um: float
    edge_shift_um: float = 0.0
    kurtosis: float = 0.0

    @classmethod
    def uniform(cls, dark: float, light: float, blur_um: float) -> Appearance:
        """Even light and Gaussian blur."""
        return cls(np.array([dark, 0.0, 0, 0, 0, 0]), np.array([light, 0.0, 0, 0, 0, 0]), blur_um)

    def with_(self, **changes: object) -> Appearance:
        """A copy with some attributes changed."""
        return replace(self, **changes)  # type: ignore[arg-type]
