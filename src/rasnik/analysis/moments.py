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
    "symmetric_index",
    "tile_monomials",
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
    chi2 : float
        Sum of squared residuals over variance.
    chi2_per_tile, counts : ndarray, shape (n,)
        Chi-square and number of pixels of every tile.
    projections : ndarray, shape (n, 7)
        Projections of every tile's residual on the signals.
    basis : ndarray, shape (n, 6)
        Monomials at the centres of the tiles.
    products : ndarray, shape (n, 28)
        Products of the signals of every tile, the upper triangle row by row.
    """

    matrix: NDArray[np.float64]
    vector: NDArray[np.float64]
    chi2: float
    chi2_per_tile: NDArray[np.float64]
    counts: NDArray[np.float64]
    projections: NDArray[np.float64]
    basis: NDArray[np.float64]
    products: NDArray[np.float64]

    def projections_after(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """`projections` once the (signal, monomial) pairs, shape (42,), have changed."""
        amplitude = self.basis @ change.reshape(_N, N_MONOMIALS).T
        grams = self.products[:, symmetric_index(_N)].reshape(-1, _N, _N)
        after: NDArray[np.float64] = self.projections - (grams @ amplitude[:, :, None])[:, :, 0]
        return after

    @property
    def n_pixels(self) -> int:
        return int(self.counts.sum())


@lru_cache(maxsize=8)
def all_tiles(shape: tuple[int, int]) -> NDArray[np.int32]:
    """(row, column) of every tile of an image, shape (n, 2)."""
    rows, columns = (-(-size // kernels.TILE) for size in shape)
    tiles = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1)
    return np.ascontiguousarray(tiles.reshape(-1, 2), dtype=np.int32)


def tile_monomials(camera: Camera, tiles: NDArray[np.int32], parts: int = 1) -> NDArray[np.float64]:
    """Monomials at the centres of tiles, shape (n, 6).

    Parameters
    ----------
    tiles : ndarray of int32, shape (n, 2)
        (row, column) of the tiles.
    parts : int, optional
        How many times wider than high a tile is.
    """
    size = np.array([kernels.TILE, parts * kernels.TILE])
    ends = np.minimum(tiles * size + size, camera.shape)
    centre = (tiles * size + ends - 1) / 2
    (u0, v0), (hu, hv) = camera.origin_um, camera.half_size_um
    return surface(
        (u0 + centre[:, 1] * camera.pixel_um) / hu, (v0 + centre[:, 0] * camera.pixel_um) / hv
    )


@lru_cache(maxsize=8)
def _monomials(
    camera: Camera, tile_bytes: bytes
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Monomials at the centres of tiles, shape (n, 6), and their 21 products, shape (n, 21)."""
    tiles = np.frombuffer(tile_bytes, dtype=np.int32).reshape(-1, 2)
    basis = tile_monomials(camera, tiles)
    first, second = np.triu_indices(N_MONOMIALS)
    return basis, basis[:, first] * basis[:, second]


def symmetric_index(size: int) -> NDArray[np.intp]:
    """Position of element (a, b) in the packed upper triangle, shape (size * size,)."""
    index = np.zeros((size, size), dtype=np.intp)
    upper = np.triu_indices(size)
    index[upper] = index[upper[::-1]] = np.arange(len(upper[0]))
    return index.ravel()


_PRODUCT = symmetric_index(kernels.N_SIGNALS).reshape(kernels.N_SIGNALS, kernels.N_SIGNALS)
_SIGNAL_PAIRS = _PRODUCT[:_N, :_N][np.triu_indices(_N)]
_RESIDUAL_PAIRS = _PRODUCT[:_N, kernels.RESIDUAL]
_CHI2 = _PRODUCT[kernels.RESIDUAL, kernels.RESIDUAL]
_EXPAND = np.ix_(symmetric_index(_N), symmetric_index(N_MONOMIALS))


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
    basis, basis_products = _monomials(camera, tiles.tobytes())
    if trim and counts.any():
        ratio = products[:, _CHI2] / np.maximum(counts, 1)
        keep = ratio <= _TRIM * np.median(ratio[counts > 0])
        products, counts = products[keep], counts[keep]
        basis, basis_products = basis[keep], basis_products[keep]
    pairs = products[:, _SIGNAL_PAIRS]
    packed = pairs.T @ basis_products
    blocks = packed[_EXPAND].reshape(_N, _N, N_MONOMIALS, N_MONOMIALS)
    size = _N * N_MONOMIALS
    projections = products[:, _RESIDUAL_PAIRS]
    chi2 = products[:, _CHI2]
    return Moments(
        blocks.transpose(0, 2, 1, 3).reshape(size, size),
        (projections.T @ basis).ravel(),
        float(chi2.sum()),
        chi2,
        counts,
        projections,
        basis,
        pairs,
    )
