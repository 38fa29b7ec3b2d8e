"""The fit as a linear estimator: what an error of the pixels does to the pose.

Near the truth the fit answers to a small change e of the image with

    (x, y, ln S, theta_z) = K e,   K = (J^T W J)^-1 J^T W,

where J holds the derivatives of the image model and W the weights 1 / (A + B g). A random
error of independent pixels with standard deviations s makes sqrt(sum (K s)^2), one that is the
same in every image makes sum K e. The rows of K keep clear of light, dark, blur and edge shift,
which are fitted along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.moments import BLUR_VARIANCE, LIGHT, MASK_X, MASK_Y, N_MONOMIALS
from rasnik.analysis.parameters import design
from rasnik.imaging.appearance import surface
from rasnik.imaging.model import expected_signals
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.instrument import System
from rasnik.performance.bound import camera_of, noise_of, state_at

__all__ = ["Estimator", "estimator"]

Plane = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Estimator:
    """The linear estimator of a pose, and the image it belongs to.

    Attributes
    ----------
    gain : ndarray of float32, shape (2, H, W)
        K for x and y: um on the mask per grey level.
    expected : ndarray of float32, shape (H, W)
        Expected grey level.
    white : ndarray of float32, shape (H, W)
        Share of white in every pixel.
    slope_u, slope_v : ndarray of float32, shape (H, W)
        Grey levels per um on the sensor.
    by_blur : ndarray of float32, shape (H, W)
        Grey levels per um^2 of blur variance on the sensor.
    u_um, v_um : ndarray, shapes (W,) and (H,)
        Sensor coordinates of columns and rows.
    noise : tuple of float
        (A, B), rounding included.
    """

    gain: Plane
    expected: Plane
    white: Plane
    slope_u: Plane
    slope_v: Plane
    by_blur: Plane
    u_um: NDArray[np.float64]
    v_um: NDArray[np.float64]
    noise: tuple[float, float]

    def random_nm(self, sigma: NDArray[np.floating] | float) -> tuple[float, float]:
        """Standard deviation of x and y, in nm, from independent pixel errors (grey levels)."""
        x, y = (float(np.sqrt(np.sum((k * sigma) ** 2, dtype=np.float64))) for k in self.gain)
        return 1e3 * x, 1e3 * y

    def shift_nm(self, error: NDArray[np.floating]) -> tuple[float, float]:
        """Change of x and y, in nm, from a small change of the image (grey levels)."""
        x, y = (float(np.sum(k * error, dtype=np.float64)) for k in self.gain)
        return 1e3 * x, 1e3 * y

    def displaced_nm(
        self, du_um: NDArray[np.floating], dv_um: NDArray[np.floating]
    ) -> tuple[float, float]:
        """Change of x and y, in nm, if the picture is displaced by (du, dv) on the sensor."""
        return self.shift_nm(-(self.slope_u * du_um + self.slope_v * dv_um))


def estimator(system: System, projection: Projection) -> Estimator:
    """Linearise the fit at a pose.

    Parameters
    ----------
    system : System
        With a noise law.
    projection : Projection
        From sensor to mask.

    Raises
    ------
    ValueError
        If the noise of the system is not known or its fields cannot be seen.
    """
    noise = noise_of(system, True)
    state, camera = state_at(system, projection), camera_of(system)
    planes = expected_signals(system.mask, projection, state.appearance, camera)
    signals, expected = planes[:-1], planes[-1]
    u, v = sensor_grid_um(system.shape, system.pitch_um)
    half_u, half_v = camera.half_size_um
    monomials = surface(u / half_u, (v / half_v)[:, None]).astype(np.float32)
    rows = design(state, camera, system.mask.field_um, "similarity", False)
    rows = rows.reshape(len(rows), -1, N_MONOMIALS)
    derivatives = np.empty((len(rows), expected.size), dtype=np.float32)
    for row, out in zip(rows, derivatives, strict=True):
        total = np.zeros(expected.shape, dtype=np.float32)
        for signal, monomial in zip(*np.nonzero(row), strict=True):
            total += np.float32(row[signal, monomial]) * signals[signal] * monomials[..., monomial]
        out[:] = total.ravel()
    weight = (1 / (noise[0] + noise[1] * expected)).ravel()
    size = np.sqrt((derivatives**2 @ weight).astype(np.float64))
    derivatives /= size[:, None].astype(np.float32)
    inverse = np.linalg.inv(((derivatives * weight) @ derivatives.T).astype(np.float64))
    chosen = (inverse[:2] / size[:2, None]).astype(np.float32)
    gain = (chosen @ derivatives) * weight
    per_um = projection.jacobian / system.mask.field_um  # d(X, Y) in fields / d(u, v)
    return Estimator(
        gain.reshape(2, *expected.shape),
        expected,
        signals[LIGHT],
        np.asarray(signals[MASK_X] * per_um[0, 0] + signals[MASK_Y] * per_um[1, 0], np.float32),
        np.asarray(signals[MASK_X] * per_um[0, 1] + signals[MASK_Y] * per_um[1, 1], np.float32),
        signals[BLUR_VARIANCE],
        u,
        v,
        noise,
    )
