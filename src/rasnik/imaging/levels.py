"""Grey levels of black and white that vary over the sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["LevelMap", "QuadraticLevel", "level_at"]

LevelMap = Callable[[NDArray[np.float64], NDArray[np.float64]], ArrayLike]
"""Grey level as a function of the sensor point: (u_um, v_um) -> level, broadcasting."""


@dataclass(frozen=True)
class QuadraticLevel:
    """A grey level that varies over the sensor to second order, e.g. uneven light.

    ``level * (1 + u s_u + v s_v + u^2 c_uu + u v c_uv + v^2 c_vv)``, u and v in millimetres
    from the middle of the sensor (u right, v down).
    """

    level: float
    slope_u_per_mm: float = 0.0
    slope_v_per_mm: float = 0.0
    curve_uu_per_mm2: float = 0.0
    curve_uv_per_mm2: float = 0.0
    curve_vv_per_mm2: float = 0.0

    def __call__(self, u_um: NDArray[np.float64], v_um: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = u_um * 1e-3, v_um * 1e-3
        return np.asarray(
            self.level
            * (
                1
                + u * self.slope_u_per_mm
                + v * self.slope_v_per_mm
                + u**2 * self.curve_uu_per_mm2
                + u * v * self.curve_uv_per_mm2
                + v**2 * self.curve_vv_per_mm2
            )
        )


def level_at(
    name: str,
    level: LevelMap | float | None,
    default: float,
    u: NDArray[np.float64],
    v: NDArray[np.float64],
) -> NDArray[np.float64] | float:
    """A level (the `default` if None) at sensor points u, v that broadcast; `name` for messages.

    Raises
    ------
    ValueError
        If a map gives levels of a wrong shape, or not finite ones.
    """
    if level is None:
        return default
    value = np.asarray(level(u, v) if callable(level) else level, dtype=np.float64)
    try:
        value = np.broadcast_to(value, np.broadcast_shapes(u.shape, v.shape))
    except ValueError:
        raise ValueError(
            f"{name} gives an array of shape {value.shape} for the sensor points of shapes "
            f"{u.shape} and {v.shape}; it must broadcast with them"
        ) from None
    if not np.isfinite(value).all():
        raise ValueError(f"{name} gives grey levels that are not finite")
    return value
