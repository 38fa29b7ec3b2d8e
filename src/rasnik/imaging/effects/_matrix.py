"""Small changes of a projection."""

from __future__ import annotations

import numpy as np

from rasnik.imaging.projection import Projection

__all__ = ["magnified", "shifted"]


def magnified(projection: Projection, factor: float) -> Projection:
    """The view of a sensor that is `factor` times as large, about its reference point."""
    return Projection(projection.matrix @ np.diag([factor, factor, 1.0]))


def shifted(projection: Projection, x_um: float, y_um: float) -> Projection:
    """The same view of the mask, moved on it by (x, y)."""
    move = np.array([[1, 0, x_um], [0, 1, y_um], [0, 0, 1.0]])
    return Projection(move @ projection.matrix)
