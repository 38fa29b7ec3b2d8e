"""What an analysis by Fourier transform reaches: the phases of the tones under a Hann window.

Not the bound: the window discards the outer contours and the tones hold part of the information
on an edge. The noise is propagated by the formulas that `rasnik.analysis.tones` uses for its
own errors, on the expected image.

Source: van der Graaf et al., section 4, "Image analysis".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.picture import Picture, prepare
from rasnik.analysis.tones import chess_lattice, combine, measure
from rasnik.imaging.model import expected_image
from rasnik.imaging.projection import Projection
from rasnik.instrument import System
from rasnik.performance.bound import camera_of, noise_of, state_at

__all__ = ["FourierNoise", "fourier_noise"]

_PRIMARIES = np.array([[1, -1], [1, 1]])


@dataclass(frozen=True)
class FourierNoise:
    """Standard deviation of a position by Fourier analysis, per image, on the mask.

    Attributes
    ----------
    primary_nm : float
        From the two primary tones alone, rms of x and y.
    harmonics_nm : float
        With all harmonics that stand out of the noise.
    """

    primary_nm: float
    harmonics_nm: float


def fourier_noise(system: System, projection: Projection, *, rounding: bool = True) -> FourierNoise:
    """Noise of the Fourier method at a pose.

    Parameters
    ----------
    system : System
        With a noise law; the mean variance of its pixels counts.
    projection : Projection
        From sensor to mask.
    rounding : bool
        Count the variance 1/12 of rounding to whole grey levels.

    Raises
    ------
    ValueError
        If the noise of the system is not known or its fields cannot be seen.
    """
    a, b = noise_of(system, rounding)
    state = state_at(system, projection)
    image = expected_image(system.mask, projection, state.appearance, camera_of(system))
    picture = prepare(image)
    variance = a + b * float(image.mean())
    fields = _fields_per_pixel(system, projection, picture)
    waves = np.pi * _PRIMARIES @ fields[:, :2]
    power = np.abs(measure(picture, waves).transform) ** 2
    weight = 2 * power / (variance * picture.noise_moments[2, 2])
    _, primary = combine(_PRIMARIES, weight, np.zeros(2), np.zeros((2, 2)))
    harmonics = chess_lattice(picture, fields, variance).covariance[np.ix_([2, 5], [2, 5])]
    unit = 1e3 * system.mask.field_um
    return FourierNoise(
        unit * math.sqrt(np.trace(primary) / 2), unit * math.sqrt(np.trace(harmonics) / 2)
    )


def _fields_per_pixel(
    system: System, projection: Projection, picture: Picture
) -> NDArray[np.float64]:
    """(X, Y) in fields = result @ (column, row, 1) from the window's centroid, shape (2, 3)."""
    matrix = projection.matrix[:2].copy() / system.mask.field_um
    matrix[:, :2] *= system.pitch_um
    height, width = system.shape
    column, row = picture.centroid_px
    matrix[:, 2] += matrix[:, :2] @ [column - (width - 1) / 2, row - (height - 1) / 2]
    return np.asarray(matrix)
