"""Edge profiles: what the optics and the square pixel make of a straight contour.

Across a contour the expected pixel value rises from 0 to 1 as

    E(d) = integral of the line spread function up to d,

where the line spread function is a Gaussian (optics) folded with the projection of the
square pixel on the edge normal. A rotated pixel projects as a trapezoid: the folding of
two boxes, one per side of the pixel. A fourth cumulant describes edges that are not
Gaussian (defocus, diffraction, scattered light).

The profile and its derivatives are tabulated; the kernels read the nearest entry and
continue from it with a Taylor series, which is both fast and accurate to 1e-7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["REACH_SIGMAS", "TABLE_ORDERS", "EdgeTable", "edge_table"]

#: Derivatives of the profile that a table holds: E, E', ... E''''.
TABLE_ORDERS = 5

#: A contour further away than this many sigmas (plus half the pixel) is not felt: 2e-5.
REACH_SIGMAS = 4.1

_TABLE_SIGMAS = 5.3  # where the table ends: E < 6e-8
_STEPS_PER_SIGMA = 16
_LEGENDRE = [np.polynomial.legendre.leggauss(count) for count in (1, 2, 4, 7)]


@dataclass(frozen=True, eq=False)
class EdgeTable:
    """A tabulated edge profile; distances in chess fields.

    Attributes
    ----------
    values : ndarray of float32, shape (n, TABLE_ORDERS)
        E and its derivatives at ``-limit, -limit + step, ...``.
    limit, step : float
        Half length and spacing of the table.
    reach : float
        Distance beyond which a contour changes nothing.
    """

    values: NDArray[np.float32]
    limit: float
    step: float
    reach: float


def _nodes(width: float, sigma: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gauss-Legendre nodes and weights for the mean of a Gaussian over a box."""
    ratio = width / sigma
    nodes, weights = _LEGENDRE[0 if ratio < 1e-4 else 1 if ratio < 0.1 else 2 if ratio < 1.2 else 3]
    return nodes * width / 2, weights / 2


@njit(cache=True)
def _fill(table, nodes, weights, sigma, limit, step, kurtosis):  # type: ignore[no-untyped-def]
    """Profile derivatives 1..4 from Hermite functions, the profile by integrating them."""
    count, orders = table.shape
    hermite = np.empty(10)
    for n in range(count):
        d = -limit + n * step
        for k in range(1, orders):
            table[n, k] = 0.0
        for q in range(nodes.size):
            z = (d - nodes[q]) / sigma
            # derivative k of a Gaussian is (-1/sigma)^k He_k(z) times it
            density = weights[q] * np.exp(-0.5 * z * z) / (2.5066282746310002 * sigma)
            hermite[0] = density
            hermite[1] = -z / sigma * density
            for k in range(2, 9):
                hermite[k] = -(z * hermite[k - 1] + (k - 1) / sigma * hermite[k - 2]) / sigma
            for k in range(1, orders):
                table[n, k] += hermite[k - 1] + kurtosis / 24.0 * hermite[k + 3]
    # Euler-Maclaurin to the third derivative: error far below float32
    table[0, 0] = 0.0
    for n in range(1, count):
        table[n, 0] = (
            table[n - 1, 0]
            + 0.5 * step * (table[n - 1, 1] + table[n, 1])
            + step * step / 12.0 * (table[n - 1, 2] - table[n, 2])
        )


def edge_table(sigma: float, pixel_widths: tuple[float, float], kurtosis: float = 0.0) -> EdgeTable:
    """Tabulate the edge profile along one axis of the mask.

    Parameters
    ----------
    sigma : float
        Width of the optical blur along the edge normal, in fields.
    pixel_widths : tuple of float
        Projections of the two sides of the pixel on the edge normal, in fields.
    kurtosis : float, optional
        Fourth cumulant of the blur along the edge normal, in fields**4.

    Returns
    -------
    EdgeTable
    """
    first, second = (abs(width) for width in pixel_widths)
    x1, w1 = _nodes(first, sigma)
    x2, w2 = _nodes(second, sigma)
    half = (first + second) / 2
    step = sigma / _STEPS_PER_SIGMA
    count = 2 * int(np.ceil((half + _TABLE_SIGMAS * sigma) / step)) + 1
    limit = (count - 1) / 2 * step
    table = np.empty((count, TABLE_ORDERS))
    _fill(
        table,
        np.add.outer(x1, x2).ravel(),
        np.outer(w1, w2).ravel(),
        sigma,
        limit,
        step,
        kurtosis,
    )
    return EdgeTable(table.astype(np.float32), limit, step, half + REACH_SIGMAS * sigma)
