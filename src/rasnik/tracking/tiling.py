"""The tiles over which a frame is summed, and second-order surfaces on them.

Tiles are as high as those of the image model and several times as wide (see
`rasnik.tracking.kernels`); what is summed over a tile goes with the monomials at its centre, or,
where that is not good enough, at the centres of its parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.moments import N_MONOMIALS, symmetric_index, tile_monomials
from rasnik.imaging import kernels
from rasnik.imaging.appearance import Camera

__all__ = ["Tiling", "tiling"]

_TILES_ACROSS = 9
_N = kernels.N_SIGNALS - 1
_EXPAND = symmetric_index(_N)


@dataclass(frozen=True, eq=False)
class Tiling:
    """Wide tiles, row by row.

    Attributes
    ----------
    count : int
        Number of tiles.
    parts : int
        Width of a tile in units of its height.
    basis : ndarray, shape (count, 6)
        Monomials at the centres of the tiles.
    squares : ndarray, shape (count, 36)
        Their products.
    mixed : ndarray, shape (count * parts, 36)
        Products of those of a tile and those of its parts.
    spread : ndarray, shape (count * parts, 36)
        Products of the differences between parts and tiles.
    """

    count: int
    parts: int
    basis: NDArray[np.float64]
    squares: NDArray[np.float64]
    mixed: NDArray[np.float64]
    spread: NDArray[np.float64]

    def summed(
        self, products: NDArray[np.float64], pairs: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """From products of signals to a matrix over (signal, monomial).

        Parameters
        ----------
        products : ndarray, shape (m, n, n) or (m, n (n + 1) / 2)
            Products of signals over tiles or parts, or their upper triangle.
        pairs : ndarray, shape (m, 36)
            `squares`, `mixed` or `spread`.

        Returns
        -------
        ndarray, shape (6 n, 6 n)
        """
        sums = products.reshape(len(products), -1).T @ pairs
        if products.ndim == 2:
            sums = sums[_EXPAND]
        n = round(len(sums) ** 0.5)
        sums = sums.reshape(n, n, N_MONOMIALS, N_MONOMIALS)
        return sums.transpose(0, 2, 1, 3).reshape(n * N_MONOMIALS, -1)


@lru_cache(maxsize=8)
def tiling(camera: Camera) -> Tiling:
    """The tiles of a camera's frames."""
    height, width = camera.shape
    parts = max(1, round(width / (kernels.TILE * _TILES_ACROSS)))
    rows, across = -(-height // kernels.TILE), -(-width // (kernels.TILE * parts))
    row, column = np.meshgrid(np.arange(rows), np.arange(across), indexing="ij")
    grid = np.stack([row.ravel(), column.ravel()], axis=-1).astype(np.int32)
    finer = np.repeat(grid * np.array([1, parts]), parts, axis=0)
    finer[:, 1] += np.tile(np.arange(parts), len(grid))
    last = -(-width // kernels.TILE) - 1
    finer[:, 1] = np.minimum(finer[:, 1], last)  # parts beyond the image hold nothing
    basis, fine = (
        tile_monomials(camera, grid, parts),
        tile_monomials(camera, finer.astype(np.int32)),
    )
    coarse = np.repeat(basis, parts, axis=0)
    return Tiling(
        count=len(grid),
        parts=parts,
        basis=basis,
        squares=_pairs(basis, basis),
        mixed=_pairs(coarse, fine),
        spread=_pairs(fine - coarse, fine - coarse),
    )


def _pairs(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    return (first[:, :, None] * second[:, None, :]).reshape(len(first), -1)
