"""Least squares for edge profiles: as free curves, and as a few numbers (blur, shift, kurtosis).

What a profile is beyond that of the image model is written as a sum of cubic B-splines. One pass
over the pixels gives the normal equations of their coefficients, the levels of black and white
eliminated; both fits are then small ones. Free curves end half way to the next contour, where
the tails of two contours could not be told apart; the numbers use the tails of all that is felt,
so that they hold where fields are hardly wider than the blur.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.optimize
import scipy.sparse
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from rasnik.characterisation.edge_contours import N_KINDS, EdgePixels, ModelEdge, profile_orders

__all__ = [
    "Curves",
    "Equations",
    "Shapes",
    "blur_columns",
    "fit_curves",
    "fit_shapes",
    "make_equations",
]

Array = NDArray[np.float64]
Sparse = Any  # scipy.sparse.csr_array, which has no types

_KNOTS_PER_SIGMA = 2.5
_KNOTS_PER_PIXEL = 2.5
_ALONE_SIGMAS = 3.0
_LEAST_KNOTS = 7  # between a contour and the half way to the next
_LEAST_LENGTH_PX = 10.0
_LENGTH_SIGMAS = 10.0
_MISFIT = 1.15  # chi-square per degree of freedom beyond which scatter counts, as for poses
_KURTOSIS_RANGE = (-1.2, 6.0)  # a disc has -1
_KURTOSIS_PRIOR = 2.0
_BLUR_RANGE = (1 / 4, 4.0)  # of the model's
_LEAST_PIXELS_PER_COEFFICIENT = 4
_SINGULAR = 1e-12
_LEAST_STEP = 0.2  # of the black-white step


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations of the profiles' splines.

    Attributes
    ----------
    pixels : EdgePixels
    spacing_um : tuple of float
        Of the splines of each profile.
    centres : tuple of ndarray of int
        Of the splines of each profile, in units of the spacing.
    half_length_um : tuple of float
        How far each profile is followed as a free curve.
    design : sparse array, shape (n, m)
        Change of every pixel (grey) with the coefficients of all profiles.
    light : ndarray, shape (n, 12)
        The same for the levels.
    matrix : ndarray, shape (m, m)
    vector : ndarray, shape (m,)
        Normal equations with the levels eliminated.
    levels : ndarray, shape (12, m), and level_start, shape (12,)
        Levels that belong to coefficients c: ``level_start - levels @ c``.
    """

    pixels: EdgePixels
    spacing_um: tuple[float, ...]
    centres: tuple[NDArray[np.int64], ...]
    half_length_um: tuple[float, ...]
    design: Sparse
    light: Array
    matrix: Array
    vector: Array
    levels: Array
    level_start: Array

    def part(self, kind: int) -> slice:
        """Where the coefficients of one profile stand."""
        start = sum(len(one) for one in self.centres[:kind])
        return slice(start, start + len(self.centres[kind]))

    def basis(self, kind: int, distance_um: Array) -> Array:
        """Splines of one profile at distances, shape (len(distance_um), splines)."""
        dense = _splines(self.spacing_um[kind], self.centres[kind], distance_um).toarray()
        return np.asarray(dense, dtype=np.float64)

    def left(self, coefficients: Array) -> Array:
        """Residual of every pixel with these coefficients and the levels that go with them."""
        levels = self.level_start - self.levels @ coefficients
        return self.pixels.residual - self.design @ coefficients - self.light @ levels

    def scores(self, residual: Array) -> Array:
        """Gradient of the likelihood, summed over each cluster of pixels; levels eliminated."""
        weighted = self.pixels.weight * residual
        groups = scipy.sparse.csr_array(
            (weighted, (self.pixels.cluster, np.arange(len(weighted)))),
            shape=(int(self.pixels.cluster.max()) + 1, len(weighted)),
        )
        return np.asarray((groups @ self.design).toarray() - (groups @ self.light) @ self.levels)


@dataclass(frozen=True, eq=False)
class Curves:
    """The profiles as free curves.

    Attributes
    ----------
    coefficients : ndarray, shape (m,)
        Of what the profiles are beyond the model's; zero where they are not followed.
    covariance : ndarray, shape (m, m)
    residual : ndarray, shape (n,)
        What is left of every pixel, grey.
    chi2, ndf : float, int
    """

    coefficients: Array
    covariance: Array
    residual: Array
    chi2: float
    ndf: int


@dataclass(frozen=True, eq=False)
class Shapes:
    """Shift, blur and kurtosis of each profile.

    Attributes
    ----------
    edges : tuple of ModelEdge
        One for each kind.
    parameters : ndarray, shape (4, 3)
        Shift (um on the sensor), sigma of the optical blur (um), its excess kurtosis.
    covariance : ndarray, shape (12, 12)
    residual : ndarray, shape (n,)
    chi2, ndf : float, int
    """

    edges: tuple[ModelEdge, ...]
    parameters: Array
    covariance: Array
    residual: Array
    chi2: float
    ndf: int


# ------------------------------------------------------------------------ equations


def make_equations(pixels: EdgePixels) -> Equations:
    """Gather the normal equations of the pixels that are not at a corner.

    Raises
    ------
    ValueError
        If there are too few pixels.
    """
    pitch = pixels.camera.pixel_um
    lengths = [_half_length(pixels.edges[kind // 2], pitch) for kind in range(N_KINDS)]
    pixels = pixels.select(pixels.clear & _near(pixels, lengths))
    spacings, centres, columns = [], [], []
    for kind, length in enumerate(lengths):
        edge = pixels.edges[kind // 2]
        spacing = length / np.ceil(_knots(edge, length, pitch))
        reach = int(np.ceil(max(length, 1.3 * edge.table.reach) / spacing))
        spacings.append(spacing)
        centres.append(np.arange(-reach, reach + 1))
        columns.append(_columns(pixels, kind, spacing, centres[-1]))
    design = scipy.sparse.csr_array(scipy.sparse.hstack(columns))
    light = np.hstack(
        [pixels.surface * (1 - pixels.white[:, None]), pixels.surface * pixels.white[:, None]]
    )
    if len(pixels) < _LEAST_PIXELS_PER_COEFFICIENT * (design.shape[1] + light.shape[1]):
        raise ValueError(
            f"{len(pixels)} pixels about the contours are too few for an edge profile; "
            "the image is too small or too much of it is covered"
        )
    weighted = scipy.sparse.csr_array(scipy.sparse.diags_array(pixels.weight) @ design)
    cross = light.T @ weighted
    inner = np.linalg.inv(light.T @ (pixels.weight[:, None] * light))
    score = light.T @ (pixels.weight * pixels.residual)
    return Equations(
        pixels=pixels,
        spacing_um=tuple(spacings),
        centres=tuple(centres),
        half_length_um=tuple(lengths),
        design=design,
        light=light,
        matrix=(weighted.T @ design).toarray() - cross.T @ inner @ cross,
        vector=weighted.T @ pixels.residual - cross.T @ inner @ score,
        levels=inner @ cross,
        level_start=inner @ score,
    )


def _half_length(edge: ModelEdge, pixel_um: float) -> float:
    """How far a profile is followed, um: at most half way to the next contour."""
    return min(edge.field_um / 2, max(_LENGTH_SIGMAS * edge.sigma_um, _LEAST_LENGTH_PX * pixel_um))


def _knots(edge: ModelEdge, length_um: float, pixel_um: float) -> float:
    """Between a contour and the end of its profile."""
    count = max(_LEAST_KNOTS, _KNOTS_PER_SIGMA * length_um / edge.sigma_um)
    if length_um > _ALONE_SIGMAS * edge.sigma_um:  # a contour alone: fringes are resolved
        count = max(count, _KNOTS_PER_PIXEL * length_um / pixel_um)
    return count


def _near(pixels: EdgePixels, lengths: list[float]) -> NDArray[np.bool_]:
    """Pixels that see a contour within the length of its profile.

    The others are in the middle of fields of one colour side by side. Left out, they cannot set
    the levels: these are those about the contours, whatever haze lies over the image.
    """
    near = np.zeros(len(pixels), dtype=bool)
    for one in pixels.contours:
        near |= (np.abs(one.distance_um) <= lengths[one.kind]) & (one.step > _LEAST_STEP)
    return near


def _splines(spacing: float, centres: NDArray[np.int64], distance_um: Array) -> Sparse:
    """Cubic B-splines centred on multiples of the spacing, at distances."""
    knots = np.arange(centres[0] - 2 - 3, centres[-1] + 3 + 3) * spacing
    inside = (distance_um > knots[3]) & (distance_um < knots[-4])
    clipped = np.clip(distance_um, knots[3], knots[-4])
    design = scipy.sparse.csr_array(BSpline.design_matrix(clipped, knots, 3))
    design = scipy.sparse.diags_array(inside.astype(float)) @ design
    return scipy.sparse.csr_array(design)[:, 3:-3]


def _columns(pixels: EdgePixels, kind: int, spacing: float, centres: NDArray[np.int64]) -> Sparse:
    total = scipy.sparse.csr_array((len(pixels), len(centres)))
    for one in pixels.contours:
        if one.kind == kind:
            step = scipy.sparse.diags_array(pixels.amplitude * one.step)
            total = total + step @ _splines(spacing, centres, one.distance_um)
    return total


def _enlarged(covariance: Array, scatter: Array, chi2_ndf: float, noise_known: bool) -> Array:
    """Covariance from the noise and, where that does not explain all, from the scatter.

    The scatter between clusters of pixels counts what lies on the image (dust, uneven light,
    displaced contours) as it is correlated. The larger of both is taken per parameter.
    """
    if noise_known and chi2_ndf <= _MISFIT:
        return covariance
    ratio = np.sqrt(np.diag(scatter) / np.diag(covariance))
    growth = np.maximum(np.sqrt(max(1.0, chi2_ndf)), ratio)
    return np.asarray(covariance * np.outer(growth, growth))


# ------------------------------------------------------------------------ curves


def fit_curves(equations: Equations) -> Curves:
    """The four profiles as free curves that join the model's half way to the next contour."""
    free = np.concatenate(
        [
            (np.abs(centres) + 1) * spacing <= length * (1 + 1e-9)
            for centres, spacing, length in zip(
                equations.centres, equations.spacing_um, equations.half_length_um, strict=True
            )
        ]
    )
    chosen = np.ix_(free, free)
    # a profile is known beforehand to within the step from black to white
    inverse = np.linalg.inv(equations.matrix[chosen] + np.eye(int(free.sum())))
    coefficients = np.zeros(len(free))
    coefficients[free] = inverse @ equations.vector[free]
    pixels = equations.pixels
    residual = equations.left(coefficients)
    chi2 = float(pixels.weight @ residual**2)
    ndf = len(pixels) - int(free.sum()) - equations.light.shape[1]
    scores = equations.scores(residual)[:, free]
    scatter = inverse @ (scores.T @ scores) @ inverse
    covariance = np.zeros_like(equations.matrix)
    covariance[chosen] = _enlarged(inverse, scatter, chi2 / ndf, pixels.noise_known)
    return Curves(coefficients, covariance, residual, chi2, ndf)


# ------------------------------------------------------------------------ shapes


def fit_shapes(equations: Equations, kurtosis: bool = True) -> Shapes:
    """Shift, blur and (if wanted) excess kurtosis of the four profiles.

    Excess kurtosis is taken as known beforehand to 0 +- 2, which matters only where the image
    does not determine it.

    Raises
    ------
    ValueError
        If no shape can be found.
    """
    base = [equations.pixels.edges[kind // 2] for kind in range(N_KINDS)]
    value, vectors = np.linalg.eigh(equations.matrix)
    known = value > _SINGULAR * value[-1]
    root = np.sqrt(value[known])[:, None] * vectors[:, known].T
    target = (vectors[:, known].T @ equations.vector) / np.sqrt(value[known])
    start = np.array([[e.shift_um, e.blur_um, e.fourth_um4 / e.blur_um**4] for e in base])
    free = np.array([k for k in range(3 * N_KINDS) if kurtosis or k % 3 != 2])
    prior = np.zeros((N_KINDS * kurtosis, 3 * N_KINDS))
    if kurtosis:
        prior[np.arange(N_KINDS), 3 * np.arange(N_KINDS) + 2] = 1 / _KURTOSIS_PRIOR

    def full(values: Array) -> Array:
        parameters = start.ravel().copy()
        parameters[free] = values
        return parameters

    def misfit(values: Array) -> Array:
        parameters = full(values)
        coefficients = _coefficients(equations, base, parameters)[0]
        return np.concatenate([root @ coefficients - target, prior @ parameters])

    def slopes(values: Array) -> Array:
        change = _coefficients(equations, base, full(values))[1]
        return np.vstack([root @ change, prior])[:, free]

    low = np.array(
        [[-e.field_um / 4, e.blur_um * _BLUR_RANGE[0], _KURTOSIS_RANGE[0]] for e in base]
    )
    high = np.array(
        [[e.field_um / 4, e.blur_um * _BLUR_RANGE[1], _KURTOSIS_RANGE[1]] for e in base]
    )
    first = np.clip(start, low + 1e-6, high - 1e-6).ravel()[free]
    found = scipy.optimize.least_squares(
        misfit, first, slopes, bounds=(low.ravel()[free], high.ravel()[free]), x_scale="jac"
    )
    if not found.success:
        raise ValueError("no blur could be fitted to the edges of this image")
    parameters = full(found.x)
    coefficients, change = _coefficients(equations, base, parameters)
    jacobian = slopes(found.x)
    inverse: Array = np.asarray(np.linalg.inv(jacobian.T @ jacobian), dtype=np.float64)
    pixels = equations.pixels
    residual = equations.left(coefficients)
    chi2, ndf = float(pixels.weight @ residual**2), len(pixels) - len(free) - 12
    scores = equations.scores(residual) @ change[:, free]
    scatter = np.asarray(inverse @ (scores.T @ scores) @ inverse, dtype=np.float64)
    covariance = np.zeros((3 * N_KINDS, 3 * N_KINDS))
    covariance[np.ix_(free, free)] = _enlarged(inverse, scatter, chi2 / ndf, pixels.noise_known)
    parameters = parameters.reshape(N_KINDS, 3)
    edges = tuple(_shaped(e, *p) for e, p in zip(base, parameters, strict=True))
    return Shapes(edges, parameters, covariance, residual, chi2, ndf)


def _shaped(edge: ModelEdge, shift: float, blur: float, kurtosis: float) -> ModelEdge:
    return replace(
        edge,
        shift_um=float(shift),
        blur_um=float(blur),
        fourth_um4=float(kurtosis * blur**4),
    )


def _coefficients(
    equations: Equations, base: list[ModelEdge], parameters: Array
) -> tuple[Array, Array]:
    """Splines of profiles of given shapes less the model's, and their change with the shapes.

    Returns
    -------
    coefficients : ndarray, shape (m,)
    change : ndarray, shape (m, 12)
    """
    size = equations.matrix.shape[0]
    coefficients, change = np.zeros(size), np.zeros((size, 3 * N_KINDS))
    for kind, (edge, values) in enumerate(zip(base, parameters.reshape(N_KINDS, 3), strict=True)):
        shift, blur, kurtosis = values
        shaped = _shaped(edge, *values)
        points: Array = equations.centres[kind].astype(np.float64) * equations.spacing_um[kind]
        orders = profile_orders(shaped.table, points - shift)
        fourth = profile_orders(replace(shaped, fourth_um4=0.0).table, points - shift)[4] / 24
        rows = np.stack(
            [
                orders[0] - edge(points),
                -orders[1],
                blur * orders[2] + 4 * kurtosis * blur**3 * fourth,
                blur**4 * fourth,
            ],
            axis=1,
        )
        part = equations.part(kind)
        splines = np.linalg.solve(equations.basis(kind, points), rows)
        coefficients[part] = splines[:, 0]
        change[part, 3 * kind : 3 * kind + 3] = splines[:, 1:]
    return coefficients, change


def blur_columns(equations: Equations, shapes: Shapes) -> tuple[Array, Array]:
    """Change of every pixel with the edge shift (um) and with the blur variance (um^2) of all."""
    base = [equations.pixels.edges[kind // 2] for kind in range(N_KINDS)]
    change = _coefficients(equations, base, shapes.parameters.ravel())[1]
    shift = equations.design @ change[:, ::3].sum(axis=1)
    per_blur = change[:, 1::3] - change[:, 2::3] * (
        4 * shapes.parameters[:, 2] / shapes.parameters[:, 1]
    )
    variance = equations.design @ (per_blur / (2 * shapes.parameters[:, 1])).sum(axis=1)
    return np.asarray(shift), np.asarray(variance)
