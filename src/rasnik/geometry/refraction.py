"""Light bent by air whose refractive index changes across the path.

A ray curves towards the denser air by dn/dx per length. The ray through the centres of lens and
sensor is fixed there; traced back to the mask it arrives beside the straight line by

    e = integral of w(z) dn/dx dz,   w = z up to the lens, then (a / b) (a + b - z),

with z from the mask on and a, b the distances before and behind the lens: what happens near the
lens counts most. A uniform gradient makes e = dn/dx a (a + b) / 2: the square of the distance. The
reading grows towards the denser air. Scale and rotation do not change in a uniform gradient;
blurring and deformation by uneven gradients are not treated.

Source: van der Graaf et al., section "The propagation of light through air"; the curvature of
rays: Born and Wolf, Principles of Optics, section 3.2. Derived: the weights, from x'' = dn/dx with
x = 0 at lens and sensor.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.geometry.air import Air
from rasnik.geometry.effects import Effect
from rasnik.geometry.three_points import ThreePoints

__all__ = [
    "air_effect",
    "bending_along_path_um",
    "bending_effect",
    "bending_um",
    "equivalent_motions_um",
    "index_gradient",
    "path_weights_um",
]

Array = NDArray[np.float64]


def bending_um(instrument: ThreePoints, gradient_per_m: ArrayLike) -> Array:
    """What a uniform gradient of the index adds to x or y.

    Parameters
    ----------
    instrument : ThreePoints
    gradient_per_m : array_like
        dn/dX or dn/dY along the mask's axes, per m.

    Returns
    -------
    ndarray
        um, of the same shape.
    """
    a, b = instrument.mask_lens_mm, instrument.lens_sensor_mm
    # mm^2 / m are um
    return np.asarray(gradient_per_m, dtype=np.float64) * a * (a + b) / 2


def bending_along_path_um(
    instrument: ThreePoints, gradient_per_m: Callable[[float], float]
) -> float:
    """What a gradient that differs along the path adds to x or y, by numerical integration.

    Parameters
    ----------
    instrument : ThreePoints
    gradient_per_m : callable
        dn/dX (or dn/dY) per m at a distance from the mask in mm.

    Returns
    -------
    float
        um; relative error below 1e-9 for smooth profiles.
    """
    from scipy.integrate import quad

    a, end = instrument.mask_lens_mm, instrument.mask_lens_mm + instrument.lens_sensor_mm

    def weighted(z: float) -> float:
        return float(_weight(instrument, np.array(z)) * gradient_per_m(z))

    parts = [
        quad(weighted, *piece, epsabs=0, epsrel=1e-10, limit=200)[0] for piece in ((0, a), (a, end))
    ]
    return float(sum(parts))


def path_weights_um(instrument: ThreePoints, z_mm: ArrayLike) -> Array:
    """What a gradient measured at points along the path adds to x or y: weights of the points.

    Parameters
    ----------
    instrument : ThreePoints
    z_mm : array_like, shape (n,)
        Distances from the mask, mm, growing. Between points the gradient is taken as linear,
        beyond the first and the last as constant.

    Returns
    -------
    ndarray, shape (n,)
        um per (1/m); ``weights @ gradients`` is the shift, ``weights @ C @ weights`` its variance.

    Raises
    ------
    ValueError
        If the distances do not grow.
    """
    z = np.atleast_1d(np.asarray(z_mm, dtype=np.float64))
    if not (np.isfinite(z).all() and (np.diff(z) > 0).all()):
        raise ValueError("z_mm: distances from the mask must be finite and grow along the light")
    a, end = instrument.mask_lens_mm, instrument.mask_lens_mm + instrument.lens_sensor_mm
    nodes = np.unique([0.0, a, end, *z[(z > 0) & (z < end)]])
    low, high = nodes[:-1], nodes[1:]
    weights = np.zeros(len(z))
    # weight and gradient are linear between nodes: Simpson's rule is exact for their product
    for place, share in ((low, 1 / 6), ((low + high) / 2, 4 / 6), (high, 1 / 6)):
        lever = share * (high - low) * _weight(instrument, place)
        weights += [lever @ np.interp(place, z, unit) for unit in np.eye(len(z))]
    return weights


def _weight(instrument: ThreePoints, z_mm: Array) -> Array:
    """mm of shift at the mask per rad of bending at a place of the path."""
    a, b = instrument.mask_lens_mm, instrument.lens_sensor_mm
    return np.where(z_mm <= a, z_mm, (a / b) * (a + b - z_mm))


def equivalent_motions_um(instrument: ThreePoints, shift_um: float) -> dict[str, float]:
    """The motion of each element along the same axis that would read the same, um."""
    names = ("mask_x", "lens_x", "sensor_x")
    parts = instrument.matrix(names)[0]
    return {name: float(shift_um / part) for name, part in zip(names, parts, strict=True)}


def index_gradient(
    air: Air,
    kelvin_per_m: ArrayLike,
    hpa_per_m: ArrayLike = 0.0,
    humidity_per_m: ArrayLike = 0.0,
) -> Array:
    """Gradient of the index from those of temperature, pressure and humidity, per m.

    Colder air is denser: the gradient of the index points against that of the temperature. Upward,
    pressure changes by `Air.hydrostatic_hpa_per_m`.
    """
    slopes = air.slopes
    return np.asarray(
        slopes.per_k * np.asarray(kelvin_per_m, dtype=np.float64)
        + slopes.per_hpa * np.asarray(hpa_per_m, dtype=np.float64)
        + slopes.per_humidity * np.asarray(humidity_per_m, dtype=np.float64)
    )


def air_effect(
    instrument: ThreePoints,
    air: Air,
    kelvin_per_m: ArrayLike,
    sigma_kelvin_per_m: ArrayLike = 0.0,
) -> Effect:
    """What a uniform temperature gradient adds to a reading.

    Parameters
    ----------
    instrument : ThreePoints
    air : Air
        On the path, with its errors.
    kelvin_per_m : array_like, shape (2,)
        Along the mask's X and Y.
    sigma_kelvin_per_m : array_like, shape (2,) or a number
        Standard deviations of these, independent of each other.

    Returns
    -------
    Effect
    """
    gradient = np.broadcast_to(np.asarray(kelvin_per_m, dtype=np.float64), 2)
    sigma = np.broadcast_to(np.asarray(sigma_kelvin_per_m, dtype=np.float64), 2)
    # the error of dn/dT is common to both axes; it and those of the gradient also multiply
    per_k, sigma_per_k = air.slopes.per_k, air.sigma_per_k
    covariance = sigma_per_k**2 * np.outer(gradient, gradient)
    covariance += (per_k**2 + sigma_per_k**2) * np.diag(sigma**2)
    return bending_effect(instrument, index_gradient(air, gradient), covariance)


def bending_effect(
    instrument: ThreePoints, gradient_per_m: ArrayLike, covariance: ArrayLike | None = None
) -> Effect:
    """What a uniform gradient of the index adds to a reading.

    Parameters
    ----------
    instrument : ThreePoints
    gradient_per_m : array_like, shape (2,)
        dn/dX and dn/dY, per m.
    covariance : array_like, shape (2, 2), optional
        Of these; by default they are exact.

    Returns
    -------
    Effect
    """
    change, noise = np.zeros(4), np.zeros((4, 4))
    change[:2] = bending_um(instrument, gradient_per_m)
    if covariance is not None:
        noise[:2, :2] = bending_um(instrument, 1.0) ** 2 * np.asarray(covariance)
    return Effect("light bent in air", change, noise)
