"""Modulation transfer from edge profiles: the Fourier transform of their slope.

The model's part is known in closed form; what the measured profile is beyond it is a sum of
cubic B-splines, whose transform is too. No binning and no window comes in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.edge_contours import ModelEdge
from rasnik.characterisation.edge_fit import Curves, Equations
from rasnik.imaging.effects.optics import image_aperture
from rasnik.imaging.transfer import AiryTransfer
from rasnik.instrument import System

__all__ = ["Transfer", "diffraction_limit", "edge_transfer"]

Array = NDArray[np.float64]

_STEPS_PER_PIXEL_FREQUENCY = 100
_LEAST_PIXEL_TRANSFER = 0.1  # below it, dividing by it says nothing


@dataclass(frozen=True, eq=False)
class Transfer:
    """Modulation transfer across the contours of one axis.

    Attributes
    ----------
    frequency_per_um : ndarray, shape (f,)
        Cycles per um on the sensor, from 0 to one cycle per pixel.
    total, total_sigma : ndarray, shape (f,)
        As measured, the pixel included.
    pixel : ndarray, shape (f,)
        The pixel's own: the sinc of its sides, as they lie across the contour.
    model : ndarray, shape (f,)
        Of the fitted image model, the pixel included.
    diffraction : ndarray, shape (f,), or None
        Limit of an ideal lens of the system's aperture, without the pixel.
    """

    frequency_per_um: Array
    total: Array
    total_sigma: Array
    pixel: Array
    model: Array
    diffraction: Array | None

    @property
    def optical(self) -> Array:
        """Transfer of the optics, the pixel removed; NaN where the pixel transfers too little."""
        return self._without_pixel(self.total)

    @property
    def optical_sigma(self) -> Array:
        return self._without_pixel(self.total_sigma)

    def _without_pixel(self, values: Array) -> Array:
        enough = self.pixel >= _LEAST_PIXEL_TRANSFER
        return np.divide(values, self.pixel, out=np.full_like(values, np.nan), where=enough)

    def as_dict(self) -> dict[str, Any]:
        """Lists by name; None where there is no value."""
        arrays = {
            "frequency_per_um": self.frequency_per_um,
            "total": self.total,
            "total_sigma": self.total_sigma,
            "pixel": self.pixel,
            "optical": self.optical,
            "optical_sigma": self.optical_sigma,
            "model": self.model,
        }
        lists: dict[str, Any] = {
            name: [float(x) if np.isfinite(x) else None for x in values]
            for name, values in arrays.items()
        }
        lists["diffraction"] = None if self.diffraction is None else self.diffraction.tolist()
        return lists


def _model_transfer(edge: ModelEdge, frequency: Array) -> tuple[Array, Array]:
    """(optics, pixel) of a model edge without its shift."""
    angular = 2 * np.pi * frequency
    optics = np.exp(-((angular * edge.blur_um) ** 2) / 2)
    optics += edge.fourth_um4 / 24 * angular**4 * np.exp(-((angular * edge.blur_um) ** 2) / 2)
    first, second = edge.widths_um
    return optics, np.sinc(frequency * first) * np.sinc(frequency * second)


def diffraction_limit(system: System, frequency_per_um: Array) -> Array | None:
    """Transfer of an ideal round aperture on the sensor; None if the optics are not known."""
    wavelength = system.optics.wavelength_nm
    if wavelength is None:
        return None
    try:
        aperture = image_aperture(system)
    except ValueError:
        return None
    ideal = AiryTransfer(wavelength * 1e-3, aperture)
    return ideal(frequency_per_um, np.zeros_like(frequency_per_um))


def edge_transfer(equations: Equations, curves: Curves, axis: int, system: System) -> Transfer:
    """Modulation transfer across X (axis 0) or Y (axis 1), mean of both directions of contrast."""
    edge, pitch = equations.pixels.edges[axis], equations.pixels.camera.pixel_um
    frequency = np.linspace(0, 1 / pitch, _STEPS_PER_PIXEL_FREQUENCY + 1)
    optics, pixel = _model_transfer(edge, frequency)
    turn = 2j * np.pi * frequency
    change = np.zeros((len(frequency), len(curves.coefficients)), dtype=complex)
    for kind in (2 * axis, 2 * axis + 1):
        spacing = equations.spacing_um[kind]
        phase = np.exp(-np.outer(turn, equations.centres[kind] * spacing))
        spline = turn * spacing * np.sinc(frequency * spacing) ** 4
        change[:, equations.part(kind)] = spline[:, None] * phase / 2
    model = optics * pixel * (1 - turn * edge.shift_um)
    value = model + change @ curves.coefficients
    total = np.abs(value)
    slope = np.real(np.conj(value)[:, None] * change) / np.maximum(total, 1e-12)[:, None]
    variance = np.einsum("fm,mn,fn->f", slope, curves.covariance, slope)
    return Transfer(
        frequency_per_um=frequency,
        total=total,
        total_sigma=np.sqrt(np.maximum(variance, 0.0)),
        pixel=pixel,
        model=np.abs(optics * pixel),
        diffraction=diffraction_limit(system, frequency),
    )
