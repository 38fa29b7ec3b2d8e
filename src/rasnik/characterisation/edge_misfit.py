"""What the image model leaves unexplained, cause by cause.

Each cause is given parameters of its own that are fitted to what the causes before it leave;
the chi-square per degree of freedom that remains (parameters counted) tells its share. A cause
that is absent leaves chi-square per degree of freedom as it was.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.edge_contours import EdgePixels, profile_orders
from rasnik.characterisation.edge_fit import Curves, Equations

__all__ = ["Cause", "explain"]

Array = NDArray[np.float64]

_PATCH_FIELDS = 3  # side of the patches in which light may vary freely
_LEAST_PATCH_PX = 16
_WORST_PART = 0.02


@dataclass(frozen=True)
class Cause:
    """One step of the explanation.

    Attributes
    ----------
    name : str
    parameters : int
        How many were fitted.
    chi2_ndf : float
        Per degree of freedom, when this cause and those before it are taken away.
    rms : float
        Size of what it explains: root mean square over the pixels, grey levels.
    """

    name: str
    parameters: int
    chi2_ndf: float
    rms: float

    def as_dict(self) -> dict[str, float | int | str]:
        return asdict(self)


def explain(equations: Equations, curves: Curves) -> tuple[Cause, ...]:
    """The image model's misfit on the pixels used for the edges, and what takes it away.

    The steps: the image model itself; free edge profiles; light that varies from patch to
    patch; contours that lie off, each side of a field by itself; fields of unequal brightness;
    rows and columns (interlace, read-out). Last, without parameters, the 2 % of 16 x 16 pixel
    squares that fit worst are left out: what falls then is local, as dust is.

    Returns
    -------
    tuple of Cause
    """
    pixels = equations.pixels
    used = len(pixels) - curves.ndf
    start = pixels.residual
    steps = [Cause("image model", 0, float(pixels.weight @ start**2) / len(pixels), 0.0)]

    def add(name: str, residual: Array, before: Array, parameters: int) -> Array:
        nonlocal used
        steps.append(
            Cause(
                name,
                parameters,
                float(pixels.weight @ residual**2) / max(len(pixels) - used, 1),
                float(np.sqrt(np.mean((before - residual) ** 2))),
            )
        )
        return residual

    residual = add("free edge profiles", curves.residual, start, used)
    ones = np.ones(len(pixels))
    for name, terms in (
        (
            "light in patches",
            [(_patches(pixels), 1 - pixels.white), (_patches(pixels), pixels.white)],
        ),
        ("displaced contours", _displacements(pixels)),
        ("unequal fields", [(_fields(pixels), ones)]),
        ("rows", [(pixels.row, ones)]),
        ("columns", [(pixels.column, ones)]),
    ):
        before, count = residual, 0
        for _ in range(2):  # terms of one cause overlap a little
            count = 0
            for label, column in terms:
                residual, fitted = _without(pixels, residual, label, column)
                count += fitted
        used += count
        add(name, residual, before, count)
    steps.append(_without_worst(pixels, residual, used))
    return tuple(steps)


def _without(
    pixels: EdgePixels, residual: Array, label: NDArray[np.int64], column: Array
) -> tuple[Array, int]:
    """The residual without one multiple of a column for every label; how many there were."""
    _, label = np.unique(label, return_inverse=True)
    information = np.bincount(label, pixels.weight * column**2)
    score = np.bincount(label, pixels.weight * column * residual)
    known = information > 1e-6 * information.max()
    value = np.divide(score, information, out=np.zeros_like(score), where=known)
    return residual - value[label] * column, int(known.sum())


def _patches(pixels: EdgePixels) -> NDArray[np.int64]:
    pitch = pixels.camera.pixel_um
    side = max(_LEAST_PATCH_PX, round(_PATCH_FIELDS * pixels.edges[0].field_um / pitch))
    return pixels.row // side * (pixels.camera.shape[1] // side + 1) + pixels.column // side


def _displacements(pixels: EdgePixels) -> list[tuple[NDArray[np.int64], Array]]:
    """For each axis: number of the nearest contour's side of a field, change with its place."""
    terms = []
    for axis in (0, 1):
        slope = np.zeros(len(pixels))
        for one in pixels.contours:
            if one.nearest and one.kind // 2 == axis:
                sign = 1 if one.kind % 2 == 0 else -1
                edge = pixels.edges[axis]
                slope -= sign * one.step * profile_orders(edge.table, one.distance_um)[1]
        line = pixels.corner[axis]
        across = pixels.field[1 - axis]
        terms.append((_number(line, across), pixels.amplitude * slope))
    return terms


def _fields(pixels: EdgePixels) -> NDArray[np.int64]:
    return _number(*pixels.field)


def _number(first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.int64]:
    return (first - first.min()) * int(np.ptp(second) + 1) + second - second.min()


def _without_worst(pixels: EdgePixels, residual: Array, used: int) -> Cause:
    columns = pixels.camera.shape[1] // _LEAST_PATCH_PX + 1
    square = pixels.row // _LEAST_PATCH_PX * columns + pixels.column // _LEAST_PATCH_PX
    _, square = np.unique(square, return_inverse=True)
    count = np.bincount(square)
    mean = np.bincount(square, pixels.weight * residual**2) / count
    judged = count >= _LEAST_PATCH_PX**2 / 4
    limit = np.quantile(mean[judged], 1 - _WORST_PART) if judged.any() else np.inf
    kept = mean[square] <= limit
    share = float(kept.mean())
    chi2 = float(pixels.weight[kept] @ residual[kept] ** 2)
    return Cause(
        "without the worst 2 %", 0, chi2 / max(share * (len(pixels) - used), 1.0), float("nan")
    )
