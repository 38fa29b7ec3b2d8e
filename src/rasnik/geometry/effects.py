"""What falsifies a reading, each with its errors, and the reading without it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Effect", "corrected"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Effect:
    """What one cause adds to a reading.

    Attributes
    ----------
    cause : str
    change : ndarray, shape (4,)
        Added to x (um), y (um), S, theta_z (rad).
    covariance : ndarray, shape (4, 4)
        Of the change.
    """

    cause: str
    change: Array
    covariance: Array


def corrected(
    values: ArrayLike, covariance: ArrayLike, effects: Iterable[Effect]
) -> tuple[Array, Array]:
    """A reading without some effects.

    Parameters
    ----------
    values : array_like, shape (4,)
        x (um), y (um), S, theta_z (rad).
    covariance : array_like, shape (4, 4)
    effects : iterable of Effect
        Their errors are taken as independent of each other and of the reading's.

    Returns
    -------
    values : ndarray, shape (4,)
    covariance : ndarray, shape (4, 4)
        What is not known of the effects is added.
    """
    found = np.array(values, dtype=np.float64)
    noise = np.array(covariance, dtype=np.float64)
    for effect in effects:
        found -= effect.change
        noise += effect.covariance
    return found, noise
