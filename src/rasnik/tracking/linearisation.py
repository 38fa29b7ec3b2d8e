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

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.moments import (
    MASK_X,
    MASK_Y,
    N_MONOMIALS,
    symmetric_index,
    tile_monomials,
)
from rasnik.analysis.parameters import POSE_SIZE, Model, State, design, stepped
from rasnik.imaging import kernels as model_kernels
from rasnik.imaging.appearance import Camera
from rasnik.imaging.model import MIN_BLUR_PX, make_scene
from rasnik.mask import ChessField
from rasnik.tracking import kernels

__all__ = ["Builder", "Linearisation", "Settings"]

Matrix = NDArray[np.float64]

TILE = model_kernels.TILE
_TILES_ACROSS = 9
_N = model_kernels.N_SIGNALS - 1
_PAIRS = _N * (_N + 1) // 2
_EXPAND = symmetric_index(_N)
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


class Builder:
    """Makes a linearisation, all at once or a few tiles at a time.

    Parameters
    ----------
    settings : Settings
    state : State
        The reference.

    Raises
    ------
    ValueError
        If the model cannot describe the state.
    """

    def __init__(self, settings: Settings, state: State) -> None:
        self.settings, self.state = settings, state
        self.kurtosis = state.appearance.kurtosis != 0.0
        camera, noise = settings.camera, settings.noise
        self._scene = make_scene(
            settings.mask, state.projection, state.appearance, camera,
            kurtosis_signal=self.kurtosis,
        )  # fmt: skip
        floor = max(noise[0], 1e-3 * noise[1] * float(np.ptp(self._scene.photometry[:, 0])), 1e-12)
        self._noise = np.array([*noise, floor])
        height, width = camera.shape
        self.parts = max(1, round(width / (TILE * _TILES_ACROSS)))
        self._rows, self._across = -(-height // TILE), -(-width // (TILE * self.parts))
        self.tiles, kept = self._rows * self._across, _N - 1 + self.kurtosis
        self.level = np.zeros(camera.shape, dtype=np.float32)
        self.weights = np.zeros((self.tiles, kept + 1, TILE * TILE * self.parts), dtype=np.int8)
        self.scales = np.zeros((self.tiles, kept + 1), dtype=np.float32)
        self.products = np.zeros((self.tiles, self.parts, _PAIRS))
        self.rounding = np.zeros((self.tiles, kept, kept))
        self.counts = np.zeros((self.tiles, 3))
        self._next = 0
        self._solved: tuple[Matrix, Matrix, Matrix, int] | None = None

    @property
    def solved(self) -> bool:
        """Whether only `finish` is left."""
        return self._solved is not None

    def advance(self, tiles: int | None = None) -> bool:
        """Work on the next tiles, all of the rest by default; True when nothing is left."""
        last = self.tiles if tiles is None else min(self._next + tiles, self.tiles)
        kernels.store(
            self._next, last, self.parts, self.settings.valid, self._scene, self._noise,
            self.level, self.weights, self.scales, self.products, self.rounding, self.counts,
        )  # fmt: skip
        self._next = last
        return last == self.tiles

    def solve(self) -> None:
        """Once all tiles are done: from their sums to the estimator. `finish` does it if need be.

        Raises
        ------
        ValueError
            If the reference is so far out that its signals are not finite.
        """
        assert self._next == self.tiles
        kept = self.weights.shape[1] - 1
        coarse, fine = self._bases
        rows, n_model = self._parameters()
        shaped = rows.reshape(len(rows), _N, N_MONOMIALS)
        whole = self.products.sum(axis=1)
        finely = np.matmul(self.products.transpose(0, 2, 1), fine).reshape(self.tiles, -1)
        plain = _blocks(_pairs(coarse, whole, coarse))
        mixed = _blocks((coarse.T @ finely).reshape(N_MONOMIALS, _PAIRS, -1).transpose(1, 0, 2))
        rounding = _products(coarse, self.rounding)
        kept_rows = shaped[:, :kept].reshape(len(rows), -1)
        response = rows @ mixed @ rows.T + kept_rows @ rounding @ kept_rows.T
        if not np.isfinite(response).all():
            raise ValueError("the reference is out of what the image model can describe")
        self._solved = (*_solve(response, rows @ plain @ rows.T, n_model), rows, n_model)

    def finish(self) -> Linearisation:
        """The linearisation, once all tiles are done.

        Raises
        ------
        ValueError
            As `solve`.
        """
        if self._solved is None:
            self.solve()
        assert self._solved is not None
        gain, covariance, rows, n_model = self._solved
        settings, state = self.settings, self.state
        kept = self.weights.shape[1] - 1
        coarse, fine = self._bases
        shaped = rows.reshape(len(rows), _N, N_MONOMIALS)
        whole = self.products.sum(axis=1)
        matrix = np.matmul(gain @ shaped[:, :kept].transpose(1, 0, 2), coarse.T)  # (s, k, t)
        n_pose = POSE_SIZE[settings.model]
        within = self._within(rows[:n_pose], coarse, fine)
        lever = shaped[:n_pose, [MASK_X, MASK_Y]] @ coarse.T
        appearance = state.appearance
        contrast = coarse @ (appearance.light - appearance.dark)
        grams = whole[:, _EXPAND].reshape(-1, _N, _N)[:, :kept, :kept]
        return Linearisation(
            settings=settings,
            state=state,
            covariance=covariance,
            edge_width_fields=self._edge_width_fields(),
            n_parameters=n_model,
            parts=self.parts,
            level=self.level,
            weights=self.weights,
            scales=self.scales,
            matrix=np.ascontiguousarray(
                matrix.transpose(1, 2, 0).reshape(len(rows), -1), dtype=np.float32
            ),
            lever=np.ascontiguousarray(lever.transpose(2, 1, 0)),
            basis=coarse,
            contrast=np.where(np.abs(contrast) > 1e-9, contrast, 1e-9),
            units=np.array([1.0, 1 / settings.mask.field_um, 1.0][: kept - 4]),
            curvature=self._curvature(),
            grams=np.ascontiguousarray(grams),
            within=within,
            counts=self.counts,
            limits=1 + _TILE_SIGMAS * np.sqrt(2 / np.maximum(self.counts[:, 0], 1)),
        )

    @cached_property
    def _bases(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Monomials at the centres of the tiles, (tiles, 6), and of their parts, (.., parts, 6)."""
        camera = self.settings.camera
        grid = (
            np.stack(
                np.meshgrid(np.arange(self._rows), np.arange(self._across), indexing="ij"), axis=-1
            )
            .reshape(-1, 1, 2)
            .astype(np.int32)
        )
        parts = grid * [1, self.parts] + np.stack(
            [np.zeros(self.parts, dtype=int), np.arange(self.parts)], axis=-1
        )
        last = -(-camera.shape[1] // TILE) - 1
        parts[..., 1] = np.minimum(parts[..., 1], last)  # parts beyond the image hold nothing
        fine = tile_monomials(camera, parts.reshape(-1, 2)).reshape(*parts.shape[:2], -1)
        return tile_monomials(camera, grid[:, 0], self.parts), fine

    def _parameters(self) -> tuple[NDArray[np.float64], int]:
        """Rows of `design`: those of the model first, then those that only a richer one has."""
        settings = self.settings
        arguments = (self.state, settings.camera, settings.mask.field_um)
        rows = design(*arguments, settings.model, self.kurtosis)
        if not settings.free:
            return rows, len(rows)
        rich = design(*arguments, "projective", self.kurtosis)
        n_pose, n_rich = POSE_SIZE[settings.model], POSE_SIZE["projective"]
        return np.concatenate([rows, rich[n_pose:n_rich]]), len(rows)

    def _within(
        self, rows: NDArray[np.float64], coarse: NDArray[np.float64], fine: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Information on the pose from the variation of its signals within the tiles."""
        flat = (fine - coarse[:, None]).reshape(-1, N_MONOMIALS)
        pairs = self.products.reshape(len(flat), -1)[:, _EXPAND.reshape(_N, _N)[0:2, 0:2].ravel()]
        sums = _products(flat, pairs.reshape(-1, 2, 2))
        moved = rows.reshape(len(rows), _N, N_MONOMIALS)[:, :2].reshape(len(rows), -1)
        return moved @ sums @ moved.T

    def _edge_width_fields(self) -> float:
        """RMS width of an edge as seen by the pixels, in fields."""
        blur, pixel = self.state.appearance.blur_um, self.settings.camera.pixel_um
        size = np.sqrt(abs(np.linalg.det(self.state.projection.jacobian)))
        return float(np.hypot(blur, pixel / np.sqrt(12)) * size / self.settings.mask.field_um)

    def _curvature(self) -> NDArray[np.float64]:
        """What of a motion is not linear, from the edge profiles (see `kernels.estimate`).

        With E the profile, E1 and E3 its derivatives and w the weights, a motion d along X is
        estimated as d (1 + c d^2 + k e^2) where e is the motion along Y,

            c = (1/6) sum(w E1 E3) / sum(w E1^2),    k = -(1/2) sum(g1^2) / sum(g^2),

        and g = 2 E - 1 stands for the edges along Y, over one field. A blur variance b (fields^2)
        adds 3 c b + k b likewise; conversely, half of the squared motions along X and Y,
        averaged, is what blurs an edge as much.
        """
        scene, (a, b, floor) = self._scene, self._noise
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


def _pairs(
    first: NDArray[np.float64], values: NDArray[np.float64], second: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sum over tiles of first (tiles, 6) x values (tiles, k) x second, shape (k, 6, 6)."""
    return np.matmul(values.T[:, None, :] * first.T, second)


def _blocks(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """From pairs of signals (28, 6, 6) to a matrix over (signal, monomial), shape (42, 42)."""
    full = sums[_EXPAND].reshape(_N, _N, N_MONOMIALS, N_MONOMIALS)
    return full.transpose(0, 2, 1, 3).reshape(_N * N_MONOMIALS, -1)


def _products(basis: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same of products (tiles, n, n) that are not symmetric, shape (n 6, n 6)."""
    tiles, n, _ = values.shape
    sums = _pairs(basis, values.reshape(tiles, -1), basis)
    sums = sums.reshape(n, n, N_MONOMIALS, N_MONOMIALS)
    return sums.transpose(0, 2, 1, 3).reshape(n * N_MONOMIALS, -1)


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
        sums, energies = np.empty(self.grams.shape[:2]), np.empty(len(self.grams))
        kernels.sum_frame(frame, self.parts, self.level, self.weights, self.scales, sums, energies)
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
