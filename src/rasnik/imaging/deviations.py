"""How an image deviates from that of the ideal instrument, before the sensor makes it a number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.imaging.transfer import OpticalTransfer

__all__ = ["CoherentLight", "Deviations", "EdgeErrors"]


@dataclass(frozen=True)
class EdgeErrors:
    """Errors of the printed contours: every segment lies a little off, always the same.

    The errors are a function of seed and field alone, so that images of different parts or
    poses of the mask see the same mask.

    Attributes
    ----------
    rms_um : float
        Standard deviation of a segment, Gaussian.
    seed : int
    segments : int
        Independent segments along one side of a field.
    """

    rms_um: float
    seed: int = 0
    segments: int = 1

    def vertical_um(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
        """Displacement in x of segment j (counted in segments) of the contour at x = i fields."""
        return self.rms_um * _normal(2 * self.seed, i, j)

    def horizontal_um(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
        """Displacement in y of segment i (counted in segments) of the contour at y = j fields."""
        return self.rms_um * _normal(2 * self.seed + 1, i, j)


@dataclass(frozen=True)
class CoherentLight:
    """A part of the light that is coherent over the aperture.

    Attributes
    ----------
    share : float
        Part of the light, 0..1; the rest is incoherent.
    wavelength_um, numerical_aperture : float
        The latter on the side of the sensor.
    defocus_um : float
        By how far the sensor is out of focus.
    """

    share: float
    wavelength_um: float
    numerical_aperture: float
    defocus_um: float = 0.0


@dataclass(frozen=True, eq=False)
class Deviations:
    """Changes of the ideal image; what is None or 0 is ideal.

    Attributes
    ----------
    transfer : OpticalTransfer, optional
        In place of the system's Gaussian blur.
    points_um : tuple of ndarray, optional
        (u, v), each (H, W): the point of the undistorted image that each pixel sees.
    gap_um : float
        Dead area between the light-sensitive squares of neighbouring pixels.
    edges : EdgeErrors, optional
    blur_ratio : ndarray, optional
        (H, W): the blur of each pixel over that of the system.
    coherent : CoherentLight, optional
    illumination : ndarray, optional
        (H, W): factor on the light.
    """

    transfer: OpticalTransfer | None = None
    points_um: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    gap_um: float = 0.0
    edges: EdgeErrors | None = None
    blur_ratio: NDArray[np.float64] | None = None
    coherent: CoherentLight | None = None
    illumination: NDArray[np.float64] | None = None


def _mixed(value: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Scrambled bits (the finishing steps of the SplitMix64 generator)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


def _normal(seed: int, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
    """A standard normal number that belongs to (seed, i, j); i and j broadcast."""
    step = np.uint64(0x9E3779B97F4A7C15)
    state = np.atleast_1d(np.array(seed % 2**64, np.uint64))
    for index in (np.atleast_1d(i), np.atleast_1d(j)):
        state = _mixed(state * step + index.astype(np.int64).view(np.uint64) + step)
    bits = _mixed(state), _mixed(state + step)
    u, v = (((b >> np.uint64(11)).astype(np.float64) + 0.5) / 2**53 for b in bits)
    return np.asarray(np.sqrt(-2 * np.log(u)) * np.cos(2 * np.pi * v))
