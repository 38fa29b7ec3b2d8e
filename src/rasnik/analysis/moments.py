"""Normal equations of the fit, from sums over small tiles of the image.

Every parameter changes the expected image by a few per-pixel signals (the derivatives by
mask X and Y, dark level, light level, blur variance, edge shift, kurtosis) times functions
of position that are smooth over the image: monomials up to second order. The kernels sum
products of signals over tiles of 16 x 16 pixels; within a tile the monomials are taken as
constant. All that a fit needs of an image is then one 42 x 42 matrix, from which any
choice of parameters is a linear combination.

Constant monomials within a tile cost (16 / 720)^2 of the information on scale and rotation,
and cause no bias: the residuals have mean zero at the truth whatever they are weighted with.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rasnik.imaging import kernels
from rasnik.imaging.appearance import Camera, surface
from rasnik.imaging.model import tile_products

__all__ = [
    "BLUR_VARIANCE",
    "DARK",
    "EDGE_SHIFT",
    "KURTOSIS",
    "LIGHT",
    "MASK_X",
    "MASK_Y",
    "N_MONOMIALS",
    "Moments",
    "all_tiles",
    "gather",
    "tile_basis",
]

MASK_X, MASK_Y, DARK, LIGHT, BLUR_VARIANCE, EDGE_SHIFT, KURTOSIS = range(7)
N_MONOMIALS = 6
_N = kernels.N_SIGNALS - 1
_TRIM = 5.0


@dataclass(frozen=True, eq=False)
class Moments:
    """What a fit needs of an image at one pose and appearance.

    Attributes
    ----------
    matrix : ndarray, shape (42, 42)
        Information on (signal, monomial) pairs.
    vector : ndarray, shape (42,)
        Their projections of the residual.
    per_tile : ndarray, shape (n, 42)
        The same for every tile.
    chi2 : float
        Sum of squared residuals over variance.
    chi2_per_tile, counts : ndarray, shape (n,)
        Chi-square and number of pixels of every tile.
    """

    matrix: NDArray[np.float64]
    vector: NDArray[np.float64]
    per_tile: NDArray[np.float64]
    chi2: float
    chi2_per_tile: NDArray[np.float64]
    counts: NDArray[np.float64]

    @property
    def n_pixels(self) -> int:
        return int(self.counts.sum())


@lru_cache(maxsize=8)
def all_tiles(shape: tuple[int, int]) -> NDArray[np.int32]:
    """(row, column) of every tile of an image, shape (n, 2)."""
    rows, columns = (-(-size // kernels.TILE) for size in shape)
    tiles = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1)
    return np.ascontiguousarray(tiles.reshape(-1, 2), dtype=np.int32)


def tile_basis(camera: Camera, tiles: NDArray[np.int32]) -> NDArray[np.float64]:
    """Monomials at the centres of tiles, shape (n, 6)."""
    height, width = camera.shape
    ends = np.minimum(tiles * kernels.TILE + kernels.TILE, [height, width])
    centre = (tiles * kernels.TILE + ends - 1) / 2
    (u0, v0), (hu, hv) = camera.origin_um, camera.half_size_um
    return surface(
        (u0 + centre[:, 1] * camera.pixel_um) / hu, (v0 + centre[:, 0] * camera.pixel_um) / hv
    ).T


def gather(
    image: NDArray[np.float32],
    valid: NDArray[np.uint8],
    scene: kernels.Scene,
    noise: tuple[float, float],
    camera: Camera,
    tiles: NDArray[np.int32],
    trim: bool = False,
) -> Moments:
    """Sum an image against the model over the given tiles.

    Parameters
    ----------
    image, valid : ndarray, shape (H, W)
    scene : Scene
        The model at the current pose and appearance.
    noise : tuple of float
        A and B of the pixel variance A + B g.
    camera : Camera
    tiles : ndarray of int32, shape (n, 2)
    trim : bool, optional
        Leave out tiles that fit much worse than the median tile (borders, dirt).
    """
    products, counts = tile_products(image, valid, scene, noise, tiles)
    if trim:
        ratio = products[:, kernels.RESIDUAL, kernels.RESIDUAL] / np.maximum(counts, 1)
        keep = ratio <= _TRIM * np.median(ratio[counts > 0])
        products, counts, tiles = products[keep], counts[keep], tiles[keep]
    basis = tile_basis(camera, tiles)
    pairs = np.einsum("tk,tl->tkl", basis, basis).reshape(len(tiles), -1)
    signals = np.ascontiguousarray(products[:, :_N, :_N]).reshape(len(tiles), -1)
    matrix = (signals.T @ pairs).reshape(_N, _N, N_MONOMIALS, N_MONOMIALS)
    residual = products[:, :_N, kernels.RESIDUAL]
    per_tile = np.einsum("ts,tk->tsk", residual, basis).reshape(len(tiles), -1)
    chi2 = products[:, kernels.RESIDUAL, kernels.RESIDUAL]
    size = _N * N_MONOMIALS
    return Moments(
        matrix.transpose(0, 2, 1, 3).reshape(size, size),
        per_tile.sum(axis=0),
        per_tile,
        float(chi2.sum()),
        chi2,
        counts,
    )
