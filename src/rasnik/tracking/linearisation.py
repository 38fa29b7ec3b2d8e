"""The fit, linearised once about a reference: what tracks frames at camera rate.

The reference is the image model at one pose and appearance, never a measured image, so that
errors do not add up from one reference to the next. About it the fit is a fixed matrix on the
sums of `rasnik.tracking.kernels`: one Gauss-Newton step with all parameters of the fit, and a
test of what it leaves unexplained.

The step is that of instrumental variables: signals times monomials that are constant over a
tile stand for the derivatives, the true derivatives for what is estimated, so that the
coarse tiles cost information on scale and rotation (0.4 %) and cause no bias.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.moments import (
    MASK_X,
    MASK_Y,
    N_MONOMIALS,
    symmetric_index,
)
from rasnik.analysis.parameters import POSE_SIZE, Model, State, design, stepped
from rasnik.imaging import kernels as model_kernels
from rasnik.imaging.appearance import Camera
from rasnik.imaging.model import MIN_BLUR_PX, make_scene
from rasnik.mask import ChessField
from rasnik.tracking import kernels
from rasnik.tracking.tiling import Tiling, tiling

__all__ = [
    "Linearisation",
    "Settings",
    "Sums",
    "estimator",
    "linearise",
    "linearise_in_parts",
    "scene_of",
]

Matrix = NDArray[np.float64]

TILE = model_kernels.TILE
_N = model_kernels.N_SIGNALS - 1
_TILE_SIGMAS = 7.0
_NEGLIGIBLE = 1e-3  # sigma


@dataclass(frozen=True, eq=False)
class Settings:
    """What a linearisation is made for.

    Attributes
    ----------
    mask : ChessField
    camera : Camera
    noise : tuple of float
        A and B of the pixel variance A + B g, rounding included.
    model : str
        "similarity", "affine" or "projective": the pose parameters that are estimated.
    free : bool
        Whether a richer map may be called for (`Estimate.surprise`).
    valid : ndarray of uint8, shape (H, W)
        1 where a pixel may be used.
    """

    mask: ChessField
    camera: Camera
    noise: tuple[float, float]
    model: Model
    free: bool
    valid: NDArray[np.uint8]


def linearise(settings: Settings, state: State) -> Linearisation:
    """Linearise the fit about a state.

    Raises
    ------
    ValueError
        If the image model cannot describe the state.
    """
    *_, linear = linearise_in_parts(settings, state)
    assert linear is not None
    return linear


def linearise_in_parts(
    settings: Settings, state: State, tiles: int | None = None
) -> Iterator[Linearisation | None]:
    """The same in pieces: None after each, and the linearisation at last.

    Parameters
    ----------
    settings, state
        As for `linearise`.
    tiles : int, optional
        So many tiles are worked on at a time.
    """
    scene = scene_of(settings, state)
    yield None
    sums = Sums.over(settings, state, scene)
    yield None
    at_once = tiles or sums.tiling.count
    for first in range(0, sums.tiling.count, at_once):
        sums.store(first, min(first + at_once, sums.tiling.count))
        yield None
    yield from estimator(sums)


def estimator(sums: Sums) -> Iterator[Linearisation | None]:
    """From the sums to the linearisation, in pieces as in `linearise_in_parts`."""
    rows, n_model = _parameters(sums.settings, sums.state)
    response, information = sums.matrices(rows)
    yield None
    gain, covariance = _solve(response, information, n_model)
    yield None
    within, curvature = sums.within(rows[: POSE_SIZE[sums.settings.model]]), _curvature(sums)
    yield None
    yield _finished(sums, rows, gain, covariance, within, curvature)


@dataclass(frozen=True, eq=False)
class Sums:
    """What `kernels.store` works out; see there."""

    settings: Settings
    state: State
    scene: model_kernels.Scene
    noise: NDArray[np.float64]
    tiling: Tiling
    level: NDArray[np.float32]
    weights: NDArray[np.int8]
    scales: NDArray[np.float32]
    products: NDArray[np.float64]
    rounding: NDArray[np.float64]
    counts: NDArray[np.float64]

    @classmethod
    def over(cls, settings: Settings, state: State, scene: model_kernels.Scene) -> Sums:
        """Room for the sums about a state."""
        camera, (a, b) = settings.camera, settings.noise
        floor = max(a, 1e-3 * b * float(np.ptp(scene.photometry[:, 0])), 1e-12)
        tiles, kept = tiling(camera), _N - 1 + (state.appearance.kurtosis != 0.0)
        size = TILE * TILE * tiles.parts
        return cls(
            settings=settings,
            state=state,
            scene=scene,
            noise=np.array([a, b, floor]),
            tiling=tiles,
            level=np.zeros(camera.shape, dtype=np.float32),
            weights=np.zeros((tiles.count, kept + 1, size), dtype=np.int8),
            scales=np.zeros((tiles.count, kept + 1), dtype=np.float32),
            products=np.zeros((tiles.count, tiles.parts, _N * (_N + 1) // 2)),
            rounding=np.zeros((tiles.count, kept, kept)),
            counts=np.zeros((tiles.count, 3)),
        )

    def store(self, first: int, last: int) -> None:
        """Work on some tiles."""
        kernels.store(
            first, last, self.tiling.parts, self.settings.valid, self.scene, self.noise,
            self.level, self.weights, self.scales, self.products, self.rounding, self.counts,
        )  # fmt: skip

    def matrices(self, rows: Matrix) -> tuple[Matrix, Matrix]:
        """How the gradient answers to parameters, and its covariance, shape (n, n) each."""
        tiles, kept = self.tiling, self.rounding.shape[1]
        plain = tiles.summed(self.products.sum(axis=1), tiles.squares)
        parts = self.products.reshape(-1, self.products.shape[2])
        mixed = tiles.summed(parts, tiles.mixed)
        rounding = tiles.summed(self.rounding, tiles.squares)
        kept_rows = rows[:, : kept * N_MONOMIALS]
        response = rows @ mixed @ rows.T + kept_rows @ rounding @ kept_rows.T
        if not np.isfinite(response).all():
            raise ValueError("the reference is out of what the image model can describe")
        return response, rows @ plain @ rows.T

    def within(self, rows: Matrix) -> Matrix:
        """Information on the pose from the variation of its signals within the tiles."""
        parts = self.products.reshape(-1, self.products.shape[2])
        motion = parts[:, symmetric_index(_N).reshape(_N, _N)[:2, :2].ravel()]
        moved = rows[:, : 2 * N_MONOMIALS]
        return moved @ self.tiling.summed(motion.reshape(-1, 2, 2), self.tiling.spread) @ moved.T


def scene_of(settings: Settings, state: State) -> model_kernels.Scene:
    return make_scene(
        settings.mask, state.projection, state.appearance, settings.camera,
        kurtosis_signal=state.appearance.kurtosis != 0.0,
    )  # fmt: skip


def _parameters(settings: Settings, state: State) -> tuple[Matrix, int]:
    """Rows of `design`: those of the model first, then those that only a richer one has."""
    arguments, kurtosis = (
        (state, settings.camera, settings.mask.field_um),
        state.appearance.kurtosis != 0.0,
    )
    rows = design(*arguments, settings.model, kurtosis)
    if not settings.free:
        return rows, len(rows)
    rich = design(*arguments, "projective", kurtosis)
    n_pose, n_rich = POSE_SIZE[settings.model], POSE_SIZE["projective"]
    return np.concatenate([rows, rich[n_pose:n_rich]]), len(rows)


def _finished(
    sums: Sums, rows: Matrix, gain: Matrix, covariance: Matrix, within: Matrix, curvature: Matrix
) -> Linearisation:
    """From the sums and the solution to what every frame needs."""
    settings, state, basis = sums.settings, sums.state, sums.tiling.basis
    kept, n_pose = sums.rounding.shape[1], POSE_SIZE[settings.model]
    shaped = rows.reshape(len(rows), _N, N_MONOMIALS)
    matrix = np.matmul(gain @ shaped[:, :kept].transpose(1, 0, 2), basis.T)  # (s, k, t)
    lever = shaped[:n_pose, [MASK_X, MASK_Y]] @ basis.T
    contrast = basis @ (state.appearance.light - state.appearance.dark)
    grams = sums.products.sum(axis=1)[:, symmetric_index(_N)].reshape(-1, _N, _N)
    return Linearisation(
        settings=settings,
        state=state,
        covariance=covariance,
        edge_width_fields=_edge_width_fields(settings, state),
        n_parameters=len(covariance),
        parts=sums.tiling.parts,
        level=sums.level,
        weights=sums.weights,
        scales=sums.scales,
        matrix=np.ascontiguousarray(
            matrix.transpose(1, 2, 0).reshape(len(rows), -1), dtype=np.float32
        ),
        lever=np.ascontiguousarray(lever.transpose(2, 1, 0)),
        basis=basis,
        contrast=np.where(np.abs(contrast) > 1e-9, contrast, 1e-9),
        units=np.array([1.0, 1 / settings.mask.field_um, 1.0][: kept - 4]),
        curvature=curvature,
        grams=np.ascontiguousarray(grams[:, :kept, :kept]),
        within=within,
        counts=sums.counts,
        limits=1 + _TILE_SIGMAS * np.sqrt(2 / np.maximum(sums.counts[:, 0], 1)),
    )


def _edge_width_fields(settings: Settings, state: State) -> float:
    """RMS width of an edge as seen by the pixels, in fields."""
    blur, pixel = state.appearance.blur_um, settings.camera.pixel_um
    size = np.sqrt(abs(np.linalg.det(state.projection.jacobian)))
    return float(np.hypot(blur, pixel / np.sqrt(12)) * size / settings.mask.field_um)


def _curvature(sums: Sums) -> Matrix:
    """What of a motion is not linear, from the edge profiles (see `kernels.estimate`).

    With E the profile, E1 and E3 its derivatives and w the weights, a motion d along X is
    estimated as d (1 + c d^2 + k e^2) where e is the motion along Y,

        c = (1/6) sum(w E1 E3) / sum(w E1^2),    k = -(1/2) sum(g1^2) / sum(g^2),

    and g = 2 E - 1 stands for the edges along Y, over one field. A blur variance b (fields^2)
    adds 3 c b + k b likewise; conversely, half of the squared motions along X and Y,
    averaged, is what blurs an edge as much.
    """
    scene, (a, b, floor) = sums.scene, sums.noise
    dark, light = scene.photometry[:, 0]
    tables = ((scene.table_x, scene.step_x), (scene.table_y, scene.step_y))
    own, cross = [], []
    for table, spacing in tables:
        profile, slope, _, third, _ = table.astype(np.float64).T
        level = dark + (light - dark) * profile
        weighted = slope / np.maximum(a + b * level, floor)
        own.append((weighted @ third) / (weighted @ slope) / 6)
        variance = 1 - spacing * (1 - (2 * profile - 1) ** 2).sum()
        cross.append(-0.5 * spacing * (2 * slope) @ (2 * slope) / max(variance, 0.1))
    # `shape` holds half the squared gradients (fields^2 / um^2) along X and Y
    blur = 1 / (4 * scene.shape[4:6])
    return np.array([[own[0], cross[1]], [cross[0], own[1]], blur])


def _solve(
    response: NDArray[np.float64], information: NDArray[np.float64], n_model: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """From the gradient to the step of the model's parameters, and to sigmas of the others.

    Parameters
    ----------
    response : ndarray, shape (n, n)
        How the gradient (rows) answers to parameters (columns).
    information : ndarray, shape (n, n)
        Covariance of the gradient.

    Returns
    -------
    gain : ndarray, shape (n, n)
    covariance : ndarray, shape (n_model, n_model)
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    response, information = (m * np.outer(scale, scale) for m in (response, information))
    inverse = np.linalg.pinv(response[:n_model, :n_model], rcond=1e-9)
    rest = np.zeros((len(scale) - n_model, len(scale)))
    rest[:, n_model:] = np.eye(len(rest))
    rest[:, :n_model] = -response[n_model:, :n_model] @ inverse
    values, vectors = np.linalg.eigh(rest @ information @ rest.T)
    usable = values > 1e-9 * max(values.max(initial=0.0), 1e-300)
    whiten = np.where(usable, 1 / np.sqrt(np.where(usable, values, 1.0)), 0.0)[:, None] * vectors.T
    gain = np.zeros_like(response)
    gain[:n_model, :n_model] = scale[:n_model, None] * inverse
    gain[n_model:] = whiten @ rest
    gain *= scale
    own = scale[:n_model, None] * inverse
    return gain, own @ information[:n_model, :n_model] @ own.T


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A fixed estimator about a reference.

    Attributes
    ----------
    settings : Settings
    state : State
        The reference.
    covariance : ndarray, shape (n_parameters, n_parameters)
        Of the parameters of `rasnik.analysis.parameters.design`.
    edge_width_fields : float
        RMS width of the edges, in fields: the scale on which a motion is small.
    n_parameters : int
    """

    settings: Settings
    state: State
    covariance: NDArray[np.float64]
    edge_width_fields: float
    n_parameters: int
    parts: int
    level: NDArray[np.float32]
    weights: NDArray[np.int8]
    scales: NDArray[np.float32]
    matrix: NDArray[np.float32]
    lever: NDArray[np.float64]
    basis: NDArray[np.float64]
    contrast: NDArray[np.float64]
    units: NDArray[np.float64]
    curvature: NDArray[np.float64]
    grams: NDArray[np.float64]
    within: NDArray[np.float64]
    counts: NDArray[np.float64]
    limits: NDArray[np.float64]

    def estimate(
        self,
        frame: NDArray[np.generic],
        step: NDArray[np.float64],
        statistics: NDArray[np.float64],
    ) -> None:
        """Estimate the step from the reference to a frame.

        Parameters
        ----------
        frame : ndarray, shape (H, W)
            C-contiguous grey levels.
        step : ndarray of float64, shape (n_steps,)
            Receives the parameters of the model, and how much others would explain.
        statistics : ndarray of float64, shape (kernels.N_STATISTICS,)
            Receives what `kernels.estimate` tells.
        """
        sums, energies = np.empty(self.matrix.shape[1]), np.empty(len(self.grams))
        kernels.sum_frame(
            frame.ravel(), frame.shape[1], self.parts, self.level.ravel(), self.weights.ravel(),
            self.scales, sums, energies,
        )  # fmt: skip
        kernels.estimate(
            sums, energies, self.matrix, POSE_SIZE[self.settings.model], self.lever, self.basis,
            self.contrast, self.units, self.curvature, self.grams, self.within, self.counts,
            self.settings.noise[1], self.limits, self._negligible, step, statistics,
        )  # fmt: skip

    @cached_property
    def _negligible(self) -> float:
        return _NEGLIGIBLE * float(np.sqrt(self.covariance[0, 0]))

    @property
    def n_steps(self) -> int:
        return len(self.matrix)

    @cached_property
    def n_pixels(self) -> int:
        """Pixels used."""
        return int(self.counts[:, 0].sum())

    @property
    def ndf(self) -> int:
        return max(self.n_pixels - self.n_parameters, 1)

    def stepped(self, step: NDArray[np.float64]) -> State:
        """The state that a step leads to."""
        settings = self.settings
        min_blur = MIN_BLUR_PX * settings.camera.pixel_um
        return stepped(self.state, step[: self.n_parameters], settings.model, min_blur)
