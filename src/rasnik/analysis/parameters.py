"""Parameters of the fit: what they do to the image, and how a step in them is taken.

The pose part is hierarchical. With L the local map from sensor to mask at the reference
point,

    (X, Y) = (x, y) + L E (u, v) / (1 + g (u, v)),

a similarity has only a scale and a rotation in E; an affine map adds two shears (unequal
scales, slant); a projective map adds the two components of g (tilt). Position, scale and
rotation mean the same in all three.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
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
    old, light = state.appearance, step[n_pose : n_pose + N_LIGHT]
    blur, shift, excess = _reshaped(old, step[n_pose + N_LIGHT :].tolist(), min_blur_um)
    appearance = Appearance(old.dark + light[:6], old.light + light[6:], blur, shift, excess)
    return State(_moved(state.projection, step[:n_pose]), appearance)


def _reshaped(old: Appearance, step: list[float], min_blur_um: float) -> tuple[float, float, float]:
    """Blur, edge shift and kurtosis after a step."""
    if not step:
        return old.blur_um, old.edge_shift_um, old.kurtosis
    variance = max(old.blur_um**2 + step[0], (old.blur_um / 1.5) ** 2)
    blur = max(min(sqrt(variance), 1.5 * old.blur_um), min_blur_um)
    excess = old.kurtosis * (old.blur_um / blur) ** 4
    if len(step) == 3:
        low, high = KURTOSIS_RANGE
        excess = min(max(excess + step[2] / blur**4, low), high)
    return blur, old.edge_shift_um + step[1], excess


def _moved(projection: Projection, step: NDArray[np.float64]) -> Projection:
    """In plain numbers, as every frame of a stream takes a step."""
    (a, b, x), (c, d, y), (tilt_u, tilt_v, _) = projection.matrix.tolist()
    a, b, c, d = a - x * tilt_u, b - x * tilt_v, c - y * tilt_u, d - y * tilt_v  # L
    dx, dy, log_scale, angle, *rest = step.tolist()
    p, q, du, dv = (*rest, 0.0, 0.0, 0.0, 0.0)[:4]
    size = np.exp(-log_scale)
    cos, sin = float(size * np.cos(angle)), float(size * np.sin(angle))
    right = cos * (1 + p) - sin * q, cos * q - sin * (1 - p)  # E, row by row
    down = sin * (1 + p) + cos * q, sin * q + cos * (1 - p)
    x, y, tilt_u, tilt_v = x + dx, y + dy, tilt_u + du, tilt_v + dv
    return Projection(
        np.array(
            [
                [
                    a * right[0] + b * down[0] + x * tilt_u,
                    a * right[1] + b * down[1] + x * tilt_v,
                    x,
                ],
                [
                    c * right[0] + d * down[0] + y * tilt_u,
                    c * right[1] + d * down[1] + y * tilt_v,
                    y,
                ],
                [tilt_u, tilt_v, 1.0],
            ]
        )
    )
