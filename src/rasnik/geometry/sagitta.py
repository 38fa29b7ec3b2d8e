"""The sagitta of three bodies: how far the middle one left the line between the outer two.

It decides what a track through three chambers says about its curvature, and can be measured
where the places of the bodies themselves are not: light that is straight sees nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rasnik.geometry.observability import LEAKAGE
from rasnik.geometry.rigid import UM_PER_MM, left_jacobian, rotation_matrix, skew

if TYPE_CHECKING:
    from rasnik.geometry.installation import Sagitta
    from rasnik.geometry.network import Network

__all__ = ["SagittaResult", "sagittas"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SagittaResult:
    """Change of a sagitta.

    Attributes
    ----------
    name : str
    axes : tuple of str
        The two axes of the middle body that are most across the line.
    value_um : ndarray, shape (2,)
        Along them; NaN where unmeasured.
    covariance_um2 : ndarray, shape (2, 2)
        NaN where unmeasured.
    """

    name: str
    axes: tuple[str, str]
    value_um: Array
    covariance_um2: Array

    @property
    def sigma_um(self) -> Array:
        """Standard deviations, shape (2,)."""
        return np.sqrt(np.diag(self.covariance_um2))

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which of the two is measured, shape (2,)."""
        return np.isfinite(self.sigma_um)

    def as_dict(self) -> dict[str, Any]:
        """As plain numbers, None where unmeasured."""

        def plain(values: Array) -> list[float | None]:
            return [float(v) if np.isfinite(v) else None for v in values]

        return {
            "name": self.name,
            "axes": list(self.axes),
            "value_um": plain(self.value_um),
            "sigma_um": plain(self.sigma_um),
            "covariance_um2": [plain(row) for row in self.covariance_um2],
        }


def sagittas(
    network: Network,
    motions: Array,
    free: NDArray[np.bool_],
    covariance: Array,
    space: Array,
    ranges: Array,
    has_data: bool,
) -> tuple[SagittaResult, ...]:
    """All sagittas of an installation.

    Parameters
    ----------
    network : Network
    motions : ndarray, shape (bodies, 6)
    free : ndarray of bool, shape (bodies, 6)
    covariance : ndarray, shape (n, n)
        Of the free degrees of freedom.
    space : ndarray, shape (n, k)
        Unmeasured motions, in ranges.
    ranges : ndarray, shape (n,)
    has_data : bool
        Whether the motions come from readings.

    Returns
    -------
    tuple of SagittaResult
    """
    found = []
    for sagitta in network.installation.sagittas:
        value, slopes, axes = _sagitta(network, sagitta, motions)
        slopes = slopes[:, free]
        scaled = slopes * ranges
        length = np.linalg.norm(scaled, axis=1)
        unknown = np.linalg.norm(scaled @ space, axis=1) > LEAKAGE * length
        matrix = slopes @ covariance @ slopes.T
        matrix[unknown, :] = matrix[:, unknown] = np.nan
        value = np.where(unknown | (not has_data), np.nan, value)
        found.append(SagittaResult(sagitta.name, axes, value, matrix))
    return tuple(found)


def _sagitta(
    network: Network, sagitta: Sagitta, motions: Array
) -> tuple[Array, Array, tuple[str, str]]:
    """Value (2,), derivatives (2, bodies, 6) and axes."""
    numbers = [network.bodies.index(name) for name in sagitta.bodies]
    points = np.array(sagitta.points_mm, dtype=np.float64)
    still = np.zeros_like(motions)
    before, after = (
        np.array([network.place(m, b, p) for b, p in zip(numbers, points, strict=True)])
        for m in (still, motions)
    )
    line = before[2] - before[0]
    part = (before[1] - before[0]) @ line / (line @ line)
    weights = np.array([part - 1, 1.0, -part])
    base = network.rotations[numbers[1]]
    across = np.sort(np.argsort(np.abs(base.T @ line))[:2])
    value = UM_PER_MM * base[:, across].T @ (weights @ (after - before))
    slopes = np.zeros((2, *motions.shape))
    for weight, body, point in zip(weights, numbers, points, strict=True):
        slopes[:, body] += weight * base[:, across].T @ _moved(network, motions, body, point)
    return value, slopes, ("xyz"[across[0]], "xyz"[across[1]])


def _moved(network: Network, motions: Array, body: int, point_mm: Array) -> Array:
    """Derivatives of the place (um) of a point by the motion of its body, shape (3, 6)."""
    base, turn = network.rotations[body], motions[body, 3:]
    arm = base @ rotation_matrix(turn) @ point_mm
    by_turn = -UM_PER_MM * skew(arm) @ base @ left_jacobian(turn)
    return np.hstack([base, by_turn])
