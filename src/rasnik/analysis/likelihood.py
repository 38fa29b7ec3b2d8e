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

from rasnik.analysis.flags import Flag
from rasnik.analysis.moments import Moments, all_tiles, gather
from rasnik.analysis.outliers import estimate_noise, find_outliers
from rasnik.analysis.parameters import KURTOSIS_RANGE, POSE_SIZE, Model, State, design, stepped
from rasnik.imaging.appearance import Camera
from rasnik.imaging.kernels import TILE
from rasnik.imaging.model import MIN_BLUR_PX, expected_image, make_scene
from rasnik.imaging.projection import Projection
from rasnik.mask import ChessField

__all__ = ["Fit", "Frame", "fit", "residual_image"]

#: A step smaller than this at the corners of the image, in fields, is the last: what it
#: leaves grows as its cube and is a few picometres for 85 um fields.
LAST_STEP_FIELDS = 1.2e-3

#: Decrease of chi-square for which parameters are added to the fit of a clean image.
DEMANDED_GAIN = 20.0

_COARSE_TILES = 150
_NEGLIGIBLE = 0.05
_CLUSTER_TILES = 3
_MAX_STEP_FIELDS = 0.2


@dataclass(frozen=True, eq=False)
class Frame:
    """One image as the fit takes it.

    Attributes
    ----------
    image : ndarray of float32, shape (H, W)
    valid : ndarray of uint8, shape (H, W)
        1 where a pixel may be used.
    picture : ndarray of uint8, shape (H, W)
        1 where there is picture at all, saturated or not.
    camera : Camera
    mask : ChessField
    noise : tuple of float or None
        A and B of the pixel variance A + B g, rounding included; None if unknown.
    """

    image: NDArray[np.float32]
    valid: NDArray[np.uint8]
    picture: NDArray[np.uint8]
    camera: Camera
    mask: ChessField
    noise: tuple[float, float] | None


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
class _Solution:
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

    @property
    def chi2_ndf(self) -> float:
        return self.chi2 / self.ndf


def fit(
    frame: Frame,
    start: State,
    *,
    model: Model | Literal["auto"] = "auto",
    trust_start: bool = False,
) -> Fit:
    """Refine a pose to the maximum of the likelihood.

    Parameters
    ----------
    frame : Frame
    start : State
        Within a quarter of a field of the truth all over the image.
    model : {"auto", "similarity", "affine", "projective"}
        "auto" takes the simplest that the data allow.
    trust_start : bool
        Whether `start` is a similarity if the mask is parallel to the sensor (a previous
        result is; a first estimate from the spectrum is not exactly).

    Returns
    -------
    Fit
    """
    noise = frame.noise
    flags = Flag.NONE
    if noise is None:
        flags |= Flag.NOISE_ESTIMATED
        noise = estimate_noise(frame.image, frame.valid, start, frame.mask, frame.camera)
    chosen: Model = "affine" if model == "auto" else model
    if model == "auto" and trust_start:
        chosen = _simplest(start.projection)
    state = _restricted(start, chosen)
    tiles = all_tiles(frame.camera.shape)
    coarse = tiles[:: _coarse_stride(frame.camera.shape)]
    solution = _iterate(frame, noise, state, chosen, False, coarse, 12, trim=True)
    if model == "auto" and chosen == "affine" and not _shears_needed(solution):
        chosen = "similarity"
    state = _restricted(solution.state, chosen)
    solution = _iterate(frame, noise, state, chosen, False, tiles, 6)
    clean = _is_clean(solution)
    if not clean:
        frame, noise, solution = _without_outliers(frame, noise, solution, chosen)
    elif frame.noise is None:
        noise = estimate_noise(frame.image, frame.valid, solution.state, frame.mask, frame.camera)
        solution = _iterate(frame, noise, solution.state, chosen, False, tiles, 3)
    chosen, kurtosis, noise, solution = _add_what_is_needed(frame, noise, solution, chosen, model)
    if kurtosis:
        flags |= Flag.PROFILE_REFINED
    if solution.chi2_ndf > 1.15:
        flags |= Flag.MODEL_MISFIT
    enlarge = bool(flags & (Flag.MODEL_MISFIT | Flag.NOISE_ESTIMATED))
    return Fit(
        solution.state,
        chosen,
        _pose_covariance(solution, enlarge, frame.camera),
        solution.chi2_ndf,
        noise,
        frame.valid,
        solution.converged,
        clean,
        _explained(frame, noise, solution.chi2_ndf),
        flags,
    )


def residual_image(frame: Frame, state: State) -> NDArray[np.float32]:
    """Image minus expected image, shape (H, W)."""
    return frame.image - expected_image(
        frame.mask, state.projection, state.appearance, frame.camera
    )


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


def _iterate(
    frame: Frame,
    noise: tuple[float, float],
    state: State,
    model: Model,
    kurtosis: bool,
    tiles: NDArray[np.int32],
    limit: int,
    trim: bool = False,
) -> _Solution:
    """Gauss-Newton with step control, until a step is too small to matter."""
    camera, field = frame.camera, frame.mask.field_um
    min_blur = MIN_BLUR_PX * camera.pixel_um
    best: _Solution | None = None
    best_start = state
    damping = 1.0
    for _ in range(limit):
        try:
            scene = make_scene(frame.mask, state.projection, state.appearance, camera)
        except ValueError:  # a step out of what can be modelled
            if best is None:
                raise
            damping *= 0.3
            state = stepped(best_start, damping * best.step, model, min_blur, kurtosis)
            continue
        moments = gather(frame.image, frame.valid, scene, noise, camera, tiles, trim)
        rows = design(state, camera, field, model, kurtosis)
        normal = rows @ moments.matrix @ rows.T
        gradient = rows @ moments.vector
        step = _solve(normal, gradient)
        fraction = min(1.0, _MAX_STEP_FIELDS / max(_motion_fields(state, step, frame), 1e-12))
        per_pixel = moments.chi2 / max(moments.n_pixels, 1)
        if best is not None and per_pixel > 1.05 * best.moments.chi2 / best.moments.n_pixels:
            damping *= 0.3
            if damping < 0.02:
                best = replace(best, state=best_start, converged=False)
                break
            state = stepped(best_start, damping * best.step, model, min_blur, kurtosis)
            continue
        damping = 1.0
        best_start = state
        state = stepped(state, fraction * step, model, min_blur, kurtosis)
        still = _is_last(best_start, step, normal, frame)
        best = _Solution(
            state,
            rows,
            normal,
            fraction * step,
            moments,
            moments.chi2 - float(gradient @ step),
            still,
        )
        variance = best_start.appearance.blur_um**2
        if still and abs(step[POSE_SIZE[model] + 12]) < 0.02 * variance:
            break
    assert best is not None
    return best


def _solve(normal: NDArray[np.float64], gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve the normal equations, leaving out what the image does not determine."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
    inverse = np.where(values > 1e-9 * values[-1], 1 / np.maximum(values, 1e-300), 0.0)
    solution: NDArray[np.float64] = scale * (vectors @ (inverse * (vectors.T @ (scale * gradient))))
    return solution


def _inverse(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse: NDArray[np.float64] = np.linalg.pinv(
        normal * np.outer(scale, scale), rcond=1e-9, hermitian=True
    ) * np.outer(scale, scale)
    return inverse


def _motion_fields(state: State, step: NDArray[np.float64], frame: Frame) -> float:
    """Largest motion of the pattern over the image that a step makes, in fields."""
    u, v = frame.camera.half_size_um
    reach = np.hypot(u, v) * np.sqrt(abs(np.linalg.det(state.projection.jacobian)))
    turn = (
        np.abs(step[2:6]).sum() if len(step) >= POSE_SIZE["affine"] + 14 else np.hypot(*step[2:4])
    )
    return float((np.hypot(*step[:2]) + reach * turn) / frame.mask.field_um)


def _is_last(
    state: State, step: NDArray[np.float64], normal: NDArray[np.float64], frame: Frame
) -> bool:
    """Whether what a step leaves undone is below a twentieth of the error.

    The cubic part of the error is known from the motion; the linear part is the share of the
    information that tiles neglect by taking monomials as constant.
    """
    neglected = (TILE / min(frame.camera.shape)) ** 2
    sigma = 1 / np.sqrt(np.maximum(np.diag(normal)[:4], 1e-300))
    return bool(
        _motion_fields(state, step, frame) < LAST_STEP_FIELDS
        and (np.abs(step[:4]) * neglected < _NEGLIGIBLE * sigma).all()
    )


def _shears_needed(solution: _Solution) -> bool:
    """Whether the affine fit differs from a similarity by more than it can by chance."""
    inverse = _inverse(solution.normal)[4:6, 4:6] * max(1.0, solution.chi2_ndf)
    jacobian = solution.state.projection.jacobian
    gram = jacobian.T @ jacobian / np.trace(jacobian.T @ jacobian)
    shear = np.array([gram[0, 0] - gram[1, 1], 2 * gram[0, 1]]) / 2
    return float(shear @ np.linalg.solve(inverse, shear)) > DEMANDED_GAIN


def _is_clean(solution: _Solution) -> bool:
    """No tile's chi-square stands out: 6 sigma above the noise, or above the median tile."""
    counts = solution.moments.counts
    full = counts >= 32
    ratio = solution.moments.chi2_per_tile[full] / counts[full]
    limit = max(1.0, float(np.median(ratio))) * (1 + 6 * np.sqrt(2 / counts[full]))
    return bool((ratio < limit).all())


def _without_outliers(
    frame: Frame, noise: tuple[float, float], solution: _Solution, model: Model
) -> tuple[Frame, tuple[float, float], _Solution]:
    """Leave out what does not fit, fit the rest; twice, as the first fit was disturbed."""
    allowed, tiles = frame.valid, all_tiles(frame.camera.shape)
    for _ in range(3):
        state = solution.state
        valid = find_outliers(frame.image, allowed, state, frame.mask, frame.camera, frame.noise)
        changed = np.count_nonzero(valid != frame.valid)
        frame = replace(frame, valid=valid)
        if frame.noise is None:
            noise = estimate_noise(frame.image, valid, state, frame.mask, frame.camera)
        solution = _iterate(frame, noise, state, model, False, tiles, 6)
        if changed < 1e-3 * valid.size:
            break
    return frame, noise, solution


def _add_what_is_needed(
    frame: Frame,
    noise: tuple[float, float],
    solution: _Solution,
    chosen: Model,
    model: Model | Literal["auto"],
) -> tuple[Model, bool, tuple[float, float], _Solution]:
    """Add parameters while the data demand them (score tests at the present solution).

    They stay only if the fit with them converges to something that makes sense.
    """
    tiles = all_tiles(frame.camera.shape)
    kurtosis = False
    refused: set[tuple[Model, bool]] = set()
    for _ in range(4):
        options: list[tuple[Model, bool]] = [] if kurtosis else [(chosen, True)]
        if model == "auto" and chosen != "projective":
            options.append(("affine" if chosen == "similarity" else "projective", kurtosis))
        options = [option for option in options if option not in refused]
        gains = [_gain(frame, solution, *option) for option in options]
        if not gains or max(gains) < DEMANDED_GAIN * max(1.0, solution.chi2_ndf):
            break
        best = options[int(np.argmax(gains))]
        trial = _iterate(frame, noise, solution.state, *best, tiles, 8)
        if _makes_sense(solution, trial) and max(gains) > _demanded(trial, frame.camera):
            (chosen, kurtosis), solution = best, trial
            if frame.noise is None:
                state = solution.state
                noise = estimate_noise(frame.image, frame.valid, state, frame.mask, frame.camera)
                solution = _iterate(frame, noise, state, chosen, kurtosis, tiles, 3)
        else:
            refused.add(best)
    return chosen, kurtosis, noise, solution


def _demanded(trial: _Solution, camera: Camera) -> float:
    """By how much chi-square must fall for more parameters to be believed.

    Dirt and distortion that are still there make it fall for no reason, the more so the more
    they scatter the parts of the image.
    """
    growth = _scatter_growth(trial, _inverse(trial.normal), camera)
    inflation = max(trial.chi2_ndf, float((growth**2).max()))
    return DEMANDED_GAIN + 3 * DEMANDED_GAIN * max(0.0, inflation - 1.5)


def _makes_sense(before: _Solution, after: _Solution) -> bool:
    """Whether a richer model still describes one edge, seen less than half as sharp."""
    old, new = before.state.appearance, after.state.appearance
    low, high = KURTOSIS_RANGE
    return (
        after.converged
        and after.chi2 < before.chi2
        and low < new.kurtosis < high
        and new.blur_um < 1.5 * old.blur_um
    )


def _gain(frame: Frame, solution: _Solution, model: Model, kurtosis: bool) -> float:
    """By how much chi-square would fall with the parameters of another model."""
    rows = design(solution.state, frame.camera, frame.mask.field_um, model, kurtosis)
    moments = solution.moments
    gradient = rows @ moments.vector
    total = gradient @ _solve(rows @ moments.matrix @ rows.T, gradient)
    return float(total - (moments.chi2 - solution.chi2))


def _pose_covariance(solution: _Solution, enlarge: bool, camera: Camera) -> NDArray[np.float64]:
    """Covariance of x, y, S, theta_z from the information, and from the scatter if asked.

    The scatter between clusters of tiles (48 x 48 pixels) counts what the noise law does
    not: a wrong profile, dirt, distortion. The larger of both is taken per parameter.
    """
    inverse = _inverse(solution.normal)
    covariance = inverse[:4, :4].copy()
    if enlarge:
        growth = np.maximum(
            np.sqrt(max(1.0, solution.chi2_ndf)), _scatter_growth(solution, inverse, camera)
        )
        covariance *= np.outer(growth, growth)
    scale = solution.state.projection.similarity()[0]
    unit = np.diag([1.0, 1.0, scale, 1.0])
    result: NDArray[np.float64] = unit @ covariance @ unit
    return result


def _scatter_growth(
    solution: _Solution, inverse: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
    """Scatter of the pose between clusters of tiles, relative to what the noise explains.

    Returns
    -------
    ndarray, shape (4,)
    """
    cluster = all_tiles(camera.shape) // _CLUSTER_TILES
    label = cluster[:, 0] * (cluster[:, 1].max() + 1) + cluster[:, 1]
    gradient = solution.moments.per_tile @ solution.design.T
    gradient -= gradient.mean(axis=0)
    sums = np.zeros((label.max() + 1, gradient.shape[1]))
    np.add.at(sums, label, gradient)
    scatter = (inverse @ (sums.T @ sums) @ inverse)[:4, :4]
    growth: NDArray[np.float64] = np.sqrt(np.diag(scatter) / np.diag(inverse)[:4])
    return growth


def _explained(frame: Frame, noise: tuple[float, float], chi2_ndf: float) -> float:
    """Fraction of the variance over the used pixels, apart from their noise, that is modelled."""
    used = frame.image[::3, ::3][frame.valid[::3, ::3] > 0]
    variance = noise[0] + noise[1] * max(float(used.mean()), 0.0)
    return 1.0 - max(chi2_ndf - 1.0, 0.0) * variance / max(float(used.var()), 1e-12)
