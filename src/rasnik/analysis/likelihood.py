"""Maximum-likelihood refinement: from an approximate pose to the bound.

Gauss-Newton on the image model with photon-noise weights. Light (two second-order
surfaces), blur and edge shift are estimated with the pose, so that its uncertainty
includes not knowing them. One pass over the image yields everything a step needs
(`rasnik.analysis.moments`), including whether more parameters would explain it better:
an affine or projective map, a profile that is not Gaussian. They are used only when the
data demand them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.evidence import (
    DEMANDED_GAIN,
    LEAST_PIXELS,
    demanded,
    explained,
    gain,
    is_clean,
    is_determined,
    is_needless,
    makes_sense,
    pose_covariance,
    scatter,
    shears_needed,
)
from rasnik.analysis.flags import Flag
from rasnik.analysis.frame import Frame
from rasnik.analysis.gauss_newton import Solution, iterate
from rasnik.analysis.moments import all_tiles
from rasnik.analysis.outliers import estimate_noise, find_outliers
from rasnik.analysis.parameters import Model, State
from rasnik.imaging.kernels import TILE
from rasnik.imaging.projection import Projection

__all__ = ["Fit", "fit"]

_COARSE_TILES = 150
_MISFIT = 1.15  # chi-square per degree of freedom


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted image.

    Attributes
    ----------
    state : State
    model : str
    covariance : ndarray, shape (4, 4)
        Of x (um), y (um), scale, theta_z (rad).
    chi2_ndf : float
    noise : tuple of float
        The noise law used.
    valid : ndarray of uint8, shape (H, W)
        The pixels used.
    converged : bool
        False also if the pixels used do not determine every parameter.
    clean : bool
        Whether no part of the image stands out of the others.
    explained : float
        Fraction of the variance over the image, less the noise, that the model explains.
    flags : Flag
    """

    state: State
    model: Model
    covariance: NDArray[np.float64]
    chi2_ndf: float
    noise: tuple[float, float]
    valid: NDArray[np.uint8]
    converged: bool
    clean: bool
    explained: float
    flags: Flag


@dataclass(frozen=True, eq=False)
class _Task:
    """What is fitted, and with which parameters."""

    frame: Frame
    noise: tuple[float, float]
    model: Model
    kurtosis: bool
    probe: bool

    def run(self, state: State, limit: int = 6, fixed_shape: bool = False) -> Solution:
        """Gauss-Newton on the whole image."""
        tiles = all_tiles(self.frame.camera.shape)
        return iterate(
            self.frame, self.noise, state, self.model, self.kurtosis, tiles, limit,
            probe=self.probe, fixed_shape=fixed_shape,
        )  # fmt: skip

    def run_coarse(self, state: State, fixed_shape: bool = False) -> Solution:
        """Gauss-Newton on a part of the image, robust against dirt in it."""
        shape = self.frame.camera.shape
        tiles = all_tiles(shape)[:: _coarse_stride(shape)]
        return iterate(
            self.frame, self.noise, state, self.model, self.kurtosis, tiles, 12,
            trim=True, fixed_shape=fixed_shape,
        )  # fmt: skip

    def with_noise_at(self, state: State) -> _Task:
        """The task with the noise measured on the image at this state, if it is not known."""
        frame = self.frame
        if frame.noise is not None:
            return self
        noise = estimate_noise(frame.image, frame.valid, state, frame.mask, frame.camera)
        return replace(self, noise=noise)


def fit(
    frame: Frame,
    start: State,
    *,
    model: Model | Literal["auto"] = "auto",
    previous_chi2_ndf: float | None = None,
) -> Fit:
    """Refine a pose to the maximum of the likelihood.

    Parameters
    ----------
    frame : Frame
    start : State
        Within a quarter of a field of the truth all over the image.
    model : {"auto", "similarity", "affine", "projective"}
        "auto" takes the simplest that the data allow.
    previous_chi2_ndf : float, optional
        Says that `start` is a previous result, and how well that one fitted. Its model and
        its blur and edges are kept as long as the image is fitted as well with them and no
        simpler model would do, which takes half the time. (The position does not depend on
        blur and edges.) By default `start` is a first estimate.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        If hardly a pixel can be used, or `start` is out of what can be modelled.
    """
    _demand_pixels(frame)
    if previous_chi2_ndf is not None and frame.noise is not None:
        kept = _simplest(start.projection) if model == "auto" else model
        kurtosis = start.appearance.kurtosis != 0.0
        task = _Task(frame, frame.noise, kept, kurtosis, False)
        quick = _as_before(task, _restricted(start, kept), model, previous_chi2_ndf)
        if quick is not None:
            return _result(task, quick, clean=True)
    chosen: Model = "affine" if model == "auto" else model
    start = _restricted(start, chosen)
    start = replace(start, appearance=replace(start.appearance, kurtosis=0.0))
    task = _Task(frame, frame.noise or (1.0, 0.0), chosen, False, True)
    task = task.with_noise_at(start)
    coarse = task.run_coarse(start)
    if model == "auto" and chosen == "affine" and not shears_needed(coarse):
        task = replace(task, model="similarity")
    solution = task.run(_restricted(coarse.state, task.model))
    clean = is_clean(solution)
    if not clean:
        task, solution = _without_outliers(task, solution)
    elif frame.noise is None:
        task = task.with_noise_at(solution.state)
        solution = task.run(solution.state, 3)
    task, solution = _add_what_is_needed(task, solution, model)
    return _result(task, solution, clean)


def _as_before(
    task: _Task, start: State, model: Model | Literal["auto"], previous_chi2_ndf: float
) -> Solution | None:
    """The solution with the previous blur and edges; None if another model is to be tried.

    Whether a kurtosis is still needed can only be told by fitting it.
    """
    fixed = not task.kurtosis
    solution = task.run(start, 1 if fixed else 3, fixed_shape=fixed)
    if not solution.converged:
        coarse = task.run_coarse(solution.state, fixed_shape=fixed)
        solution = task.run(coarse.state, 3, fixed_shape=fixed)
    allowed = max(previous_chi2_ndf, 1.0) * 5 * np.sqrt(2 / solution.ndf)
    if not solution.converged or not solution.chi2_ndf < previous_chi2_ndf + allowed:
        return None
    if not is_clean(solution):
        return None
    if model == "auto" and task.model != "projective":
        richer: Model = "affine" if task.model == "similarity" else "projective"
        if gain(task.frame, solution, richer, task.kurtosis, fixed_shape=fixed) > DEMANDED_GAIN:
            return None
    if is_needless(solution, task.model if model == "auto" else "similarity", task.kurtosis):
        return None
    return solution


def _result(task: _Task, solution: Solution, clean: bool) -> Fit:
    flags = Flag.NONE
    if task.frame.noise is None:
        flags |= Flag.NOISE_ESTIMATED
    if task.kurtosis:
        flags |= Flag.PROFILE_REFINED
    growth, by_chance = scatter(solution, task.frame.camera)
    if solution.chi2_ndf > _MISFIT or not growth.max() < by_chance:
        flags |= Flag.MODEL_MISFIT
    enlarge = bool(flags & (Flag.MODEL_MISFIT | Flag.NOISE_ESTIMATED))
    return Fit(
        state=solution.state,
        model=task.model,
        covariance=pose_covariance(solution, growth if enlarge else None),
        chi2_ndf=solution.chi2_ndf,
        noise=task.noise,
        valid=task.frame.valid,
        converged=solution.converged and is_determined(solution),
        clean=clean,
        explained=explained(task.frame, task.noise, solution.chi2_ndf),
        flags=flags,
    )


def _demand_pixels(frame: Frame) -> None:
    count = np.count_nonzero(frame.valid)
    if count < LEAST_PIXELS:
        raise ValueError(f"{count} pixels can be used, {LEAST_PIXELS} are needed")


def _coarse_stride(shape: tuple[int, int]) -> int:
    """Take every n-th tile; not a divisor of the tiles per row, so that columns mix."""
    count = len(all_tiles(shape))
    per_row = -(-shape[1] // TILE)
    stride = max(1, count // _COARSE_TILES)
    while stride > 1 and np.gcd(stride, per_row) > 1:
        stride -= 1
    return stride


def _simplest(projection: Projection) -> Model:
    if not projection.is_affine:
        return "projective"
    jacobian = projection.jacobian
    gram = jacobian.T @ jacobian
    sheared = np.hypot(gram[0, 0] - gram[1, 1], 2 * gram[0, 1]) > 1e-9 * np.trace(gram)
    return "affine" if sheared else "similarity"


def _restricted(state: State, model: Model) -> State:
    """The nearest state that the model can describe."""
    projection = state.projection
    if model == "projective":
        return state
    if model == "affine":
        matrix = np.eye(3)
        matrix[:2, :2] = projection.jacobian
        matrix[:2, 2] = projection.matrix[:2, 2]
        return replace(state, projection=Projection(matrix))
    scale, theta, orientation = projection.similarity()
    return replace(
        state,
        projection=Projection.from_pose(
            projection.x_um, projection.y_um, scale, theta, orientation
        ),
    )


def _without_outliers(task: _Task, solution: Solution) -> tuple[_Task, Solution]:
    """Leave out what does not fit, fit the rest; again while that changes what fits."""
    allowed = task.frame.valid
    for _ in range(3):
        frame, state = task.frame, solution.state
        valid = find_outliers(frame.image, allowed, state, frame.mask, frame.camera, frame.noise)
        changed = np.count_nonzero(valid != frame.valid)
        task = replace(task, frame=replace(frame, valid=valid))
        _demand_pixels(task.frame)
        task = task.with_noise_at(state)
        solution = task.run(state)
        if changed < 1e-3 * valid.size:
            break
    return task, solution


def _add_what_is_needed(
    task: _Task, solution: Solution, model: Model | Literal["auto"]
) -> tuple[_Task, Solution]:
    """Add parameters while the data demand them (score tests at the present solution).

    They stay only if the fit with them converges to something that makes sense.
    """
    refused: set[tuple[Model, bool]] = set()
    for _ in range(4):
        options: list[tuple[Model, bool]] = []
        if task.probe and not task.kurtosis:
            options.append((task.model, True))
        if model == "auto" and task.model != "projective":
            richer: Model = "affine" if task.model == "similarity" else "projective"
            options.append((richer, task.kurtosis))
        options = [option for option in options if option not in refused]
        gains = [gain(task.frame, solution, *option) for option in options]
        if not gains or max(gains) < DEMANDED_GAIN * max(1.0, solution.chi2_ndf):
            break
        best = options[int(np.argmax(gains))]
        trial_task = replace(task, model=best[0], kurtosis=best[1])
        trial = trial_task.run(solution.state, 8)
        if not makes_sense(solution, trial) or max(gains) < demanded(trial, task.frame.camera):
            refused.add(best)
            continue
        task, solution = trial_task, trial
        if task.frame.noise is None:
            task = task.with_noise_at(solution.state)
            solution = task.run(solution.state, 3)
    return task, solution
