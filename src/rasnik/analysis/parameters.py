"""Parameters of the fit: what they do to the image, and how a step in them is taken.

The pose part is hierarchical. With L the local map from sensor to mask at the reference
point,

    (X, Y) = (x, y) + L E (u, v) / (1 + g (u, v)),

a similarity has only a scale and a rotation in E; an affine map adds two shears (unequal
scales, slant); a projective map adds the two components of g (tilt). Position, scale and
rotation mean the same in all three.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.moments import (
    BLUR_VARIANCE,
    DARK,
    EDGE_SHIFT,
    KURTOSIS,
    LIGHT,
    MASK_X,
    MASK_Y,
    N_MONOMIALS,
)
from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.projection import Projection

__all__ = ["KURTOSIS_RANGE", "N_LIGHT", "POSE_SIZE", "Model", "State", "design", "stepped"]

Model = Literal["similarity", "affine", "projective"]

#: Number of pose parameters: x, y, ln S, theta_z; two shears; two tilts.
POSE_SIZE: dict[Model, int] = {"similarity": 4, "affine": 6, "projective": 8}

#: Coefficients of the dark and light surfaces.
N_LIGHT = 2 * N_MONOMIALS

#: Beyond this excess kurtosis the profile would not be one edge any more.
KURTOSIS_RANGE = (-0.8, 2.4)

_ONE, _U, _V, _UU, _UV, _VV = range(N_MONOMIALS)
_N_SIGNALS = 7
_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])

# generators of E on the sensor: growing scale, rotation, unequal scales, slant
_GENERATORS = (
    -np.eye(2),
    _TURN,
    np.array([[1.0, 0.0], [0.0, -1.0]]),
    np.array([[0.0, 1.0], [1.0, 0.0]]),
)


@dataclass(frozen=True, eq=False)
class State:
    """A pose and an appearance: where a fit stands."""

    projection: Projection
    appearance: Appearance


def design(
    state: State,
    camera: Camera,
    field_um: float,
    model: Model,
    kurtosis: bool,
    *,
    fixed_shape: bool = False,
) -> NDArray[np.float64]:
    """How each parameter enters the signals.

    Parameters
    ----------
    kurtosis : bool
        Whether the fourth cumulant of the blur is a parameter.
    fixed_shape : bool, optional
        Take blur, edge shift and kurtosis as known.

    Returns
    -------
    ndarray, shape (n_parameters, 42)
        Coefficients of (signal, monomial) pairs. Order: x, y (um), ln S, theta_z (rad),
        shears, tilts (1/um); dark and light surfaces (6 each, grey); blur variance
        (um^2); edge shift (um); fourth cumulant (um^4).
    """
    n_pose = POSE_SIZE[model]
    n_shape = 0 if fixed_shape else 2 + kurtosis
    rows = np.zeros((n_pose + N_LIGHT + n_shape, _N_SIGNALS, N_MONOMIALS))
    local = state.projection.jacobian / field_um
    hu, hv = camera.half_size_um
    rows[0, MASK_X, _ONE] = rows[1, MASK_Y, _ONE] = 1 / field_um
    for row, generator in zip(rows[2 : min(n_pose, 6)], _GENERATORS, strict=False):
        change = local @ generator
        for signal in (MASK_X, MASK_Y):
            row[signal, _U] = change[signal, 0] * hu
            row[signal, _V] = change[signal, 1] * hv
    if model == "projective":
        for signal in (MASK_X, MASK_Y):
            a, b = local[signal]
            rows[6, signal, [_UU, _UV]] = -a * hu * hu, -b * hu * hv
            rows[7, signal, [_UV, _VV]] = -a * hu * hv, -b * hv * hv
    for k in range(N_MONOMIALS):
        rows[n_pose + k, DARK, k] = 1
        rows[n_pose + N_MONOMIALS + k, LIGHT, k] = 1
    shape = rows[n_pose + N_LIGHT :]
    if n_shape:
        shape[0, BLUR_VARIANCE, _ONE] = 1
        shape[1, EDGE_SHIFT, _ONE] = 1 / field_um
    if n_shape == 3:
        shape[2, KURTOSIS, _ONE] = 1
    return rows.reshape(len(rows), -1)


def stepped(state: State, step: NDArray[np.float64], model: Model, min_blur_um: float) -> State:
    """The state after a step in the parameters of `design`.

    The blur changes by at most a factor of 1.5 in sigma; the excess kurtosis stays in
    `KURTOSIS_RANGE`.
    """
    n_pose = POSE_SIZE[model]
    light, shape = step[n_pose : n_pose + N_LIGHT], step[n_pose + N_LIGHT :]
    appearance = _reshaped(state.appearance, shape, min_blur_um)
    appearance = replace(
        appearance, dark=appearance.dark + light[:6], light=appearance.light + light[6:]
    )
    return State(_moved(state.projection, step[:n_pose]), appearance)


def _reshaped(old: Appearance, step: NDArray[np.float64], min_blur_um: float) -> Appearance:
    if not len(step):
        return old
    variance = old.blur_um**2 + step[0]
    blur = float(np.sqrt(np.clip(variance, (old.blur_um / 1.5) ** 2, (old.blur_um * 1.5) ** 2)))
    blur = max(blur, min_blur_um)
    excess = old.kurtosis * (old.blur_um / blur) ** 4
    if len(step) == 3:
        excess = float(np.clip(excess + step[2] / blur**4, *KURTOSIS_RANGE))
    shift = old.edge_shift_um + float(step[1])
    return replace(old, blur_um=blur, edge_shift_um=shift, kurtosis=excess)


def _moved(projection: Projection, step: NDArray[np.float64]) -> Projection:
    shift, log_scale, angle = step[:2], step[2], step[3]
    c, s = np.cos(angle), np.sin(angle)
    change = np.exp(-log_scale) * np.array([[c, -s], [s, c]])
    if len(step) > 4:
        change = change @ (np.eye(2) + step[4] * _GENERATORS[2] + step[5] * _GENERATORS[3])
    tilt = projection.matrix[2, :2] + (step[6:8] if len(step) > 6 else 0.0)
    origin = projection.matrix[:2, 2] + shift
    local = projection.jacobian @ change
    matrix = np.eye(3)
    matrix[:2, :2] = local + np.outer(origin, tilt)
    matrix[:2, 2] = origin
    matrix[2, :2] = tilt
    return Projection(matrix)
