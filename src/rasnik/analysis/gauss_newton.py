"""Gauss-Newton on the image model: steps, their control, and where they end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.frame import Frame
from rasnik.analysis.moments import Moments, gather
from rasnik.analysis.parameters import N_LIGHT, POSE_SIZE, Model, State, design, stepped
from rasnik.imaging.kernels import TILE
from rasnik.imaging.model import MIN_BLUR_PX, make_scene

__all__ = ["SINGULAR", "Solution", "invert", "iterate", "scaled_eigenvalues", "solve"]

#: A step smaller than this at the corners of the image, in fields, is the last: what it
#: leaves grows as its cube and is a few picometres for 85 um fields.
LAST_STEP_FIELDS = 1.2e-3

#: Relative eigenvalue (of the normal matrix with unit diagonal) below which a combination of
#: parameters is not determined by the image.
SINGULAR = 1e-9

_MAX_STEP_FIELDS = 0.2
_NEGLIGIBLE = 0.05
_SETTLED = 0.02


@dataclass(frozen=True, eq=False)
class Solution:
    """Where Gauss-Newton stopped: the state after the last step, and its linearisation."""

    state: State
    design: NDArray[np.float64]
    normal: NDArray[np.float64]
    step: NDArray[np.float64]
    moments: Moments
    chi2: float
    converged: bool

    @property
    def ndf(self) -> int:
        return max(self.moments.n_pixels - len(self.normal), 1)

    @cached_property
    def inverse(self) -> NDArray[np.float64]:
        """Covariance of the parameters that the noise explains."""
        return invert(self.normal)

    @property
    def chi2_ndf(self) -> float:
        return self.chi2 / self.ndf


def iterate(
    frame: Frame,
    noise: tuple[float, float],
    state: State,
    model: Model,
    kurtosis: bool,
    tiles: NDArray[np.int32],
    limit: int,
    trim: bool = False,
    probe: bool = False,
    fixed_shape: bool = False,
) -> Solution:
    """Gauss-Newton with step control, until a step is too small to matter.

    Parameters
    ----------
    kurtosis : bool
        Whether the kurtosis of the blur is fitted.
    tiles : ndarray of int32, shape (n, 2)
        The part of the image to use.
    limit : int
        Most passes over it.
    trim : bool, optional
        Leave out tiles that fit much worse than the others.
    probe : bool, optional
        Include the signal of the kurtosis in the moments without fitting it, so that
        `rasnik.analysis.evidence.gain` can tell whether it is needed.
    fixed_shape : bool, optional
        Do not fit blur and edges; takes half the time.
    """
    camera, field, n_pose = frame.camera, frame.mask.field_um, POSE_SIZE[model]
    min_blur = MIN_BLUR_PX * camera.pixel_um
    best: Solution | None = None
    best_start = state
    damping = 1.0
    for _ in range(limit):
        try:
            scene = make_scene(
                frame.mask,
                state.projection,
                state.appearance,
                camera,
                kurtosis_signal=kurtosis or probe,
                shape_signals=not fixed_shape,
            )
        except ValueError:  # a step out of what can be modelled
            if best is None:
                raise
            damping *= 0.3
            state = stepped(best_start, damping * best.step, model, min_blur)
            continue
        moments = gather(frame.image, frame.valid, scene, noise, camera, tiles, trim)
        rows = design(state, camera, field, model, kurtosis, fixed_shape=fixed_shape)
        normal = rows @ moments.matrix @ rows.T
        gradient = rows @ moments.vector
        step = solve(normal, gradient)
        fraction = min(
            1.0, _MAX_STEP_FIELDS / max(_motion_fields(state, step, frame, n_pose), 1e-12)
        )
        per_pixel = moments.chi2 / max(moments.n_pixels, 1)
        if best is not None and per_pixel > 1.05 * best.moments.chi2 / best.moments.n_pixels:
            damping *= 0.3
            if damping < 0.02:
                best = replace(best, state=best_start, converged=False)
                break
            state = stepped(best_start, damping * best.step, model, min_blur)
            continue
        damping = 1.0
        best_start = state
        state = stepped(state, fraction * step, model, min_blur)
        still = _is_last(best_start, step, normal, frame, n_pose)
        best = Solution(
            state,
            rows,
            normal,
            fraction * step,
            moments,
            moments.chi2 - float(gradient @ step),
            still,
        )
        variance = best_start.appearance.blur_um**2
        blur_settled = fixed_shape or abs(step[n_pose + N_LIGHT]) < _SETTLED * variance
        edge_settled = fixed_shape or not kurtosis or abs(step[-1]) < _SETTLED * variance**2
        if still and blur_settled and edge_settled:
            break
    assert best is not None
    return best


def _is_last(
    state: State,
    step: NDArray[np.float64],
    normal: NDArray[np.float64],
    frame: Frame,
    n_pose: int,
) -> bool:
    """Whether what a step leaves undone is below a twentieth of the error.

    The cubic part of the error is known from the motion; the linear part, of scale and
    rotation, is the share of their information that tiles neglect by taking monomials as
    constant.
    """
    neglected = (TILE / min(frame.camera.shape)) ** 2
    sigma = 1 / np.sqrt(np.maximum(np.diag(normal)[2:4], 1e-300))
    return bool(
        _motion_fields(state, step, frame, n_pose) < LAST_STEP_FIELDS
        and (np.abs(step[2:4]) * neglected < _NEGLIGIBLE * sigma).all()
    )


def _motion_fields(state: State, step: NDArray[np.float64], frame: Frame, n_pose: int) -> float:
    """Largest motion of the pattern over the image that a step makes, in fields."""
    u, v = frame.camera.half_size_um
    reach = np.hypot(u, v) * np.sqrt(abs(np.linalg.det(state.projection.jacobian)))
    turn = np.abs(step[2:6]).sum() if n_pose > POSE_SIZE["similarity"] else np.hypot(*step[2:4])
    return float((np.hypot(*step[:2]) + reach * turn) / frame.mask.field_um)


def scaled_eigenvalues(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Eigenvalues of the normal matrix with unit diagonal, in rising order; zeros stay zero."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(np.linalg.eigvalsh(normal * np.outer(scale, scale)), dtype=np.float64)


def solve(normal: NDArray[np.float64], gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve the normal equations, leaving out what the image does not determine."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
    inverse = np.where(values > SINGULAR * values[-1], 1 / np.maximum(values, 1e-300), 0.0)
    solution: NDArray[np.float64] = scale * (vectors @ (inverse * (vectors.T @ (scale * gradient))))
    return solution


def invert(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse: NDArray[np.float64] = np.linalg.pinv(
        normal * np.outer(scale, scale), rcond=SINGULAR, hermitian=True
    ) * np.outer(scale, scale)
    return inverse
