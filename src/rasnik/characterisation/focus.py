"""Focus as a fifth output: from blur to the distance of the sensor from the focus.

In geometrical optics a point out of focus by z becomes a disc of radius |z| NA (NA on the side
of the sensor). A disc of radius R adds R^2 / 4 to the variance of the blur along every
direction, so that

    blur^2 = best^2 + (z NA / 2)^2,

with `best` the blur in focus. The blur does not tell on which side of the focus the sensor
is: z is known up to its sign. Two images with a known step of focus between them, or the tilt of
the focus over the image, settle it up to one common sign.

Source: van der Graaf et al., section 3, "Image blurring": "could be used as fifth output
parameter"; the variance of a disc is derived.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from rasnik.characterisation.edge_contours import N_KINDS, EdgePixels
from rasnik.characterisation.edge_fit import Equations, Shapes, blur_columns
from rasnik.imaging.effects.optics import image_aperture
from rasnik.imaging.projection import sensor_grid_um
from rasnik.instrument import System
from rasnik.tracking.track import Track

__all__ = ["BlurMap", "Focus", "blur_map", "focus", "focus_of_track"]

Array = NDArray[np.float64]

_CELLS = 6  # along the longer side of the image
_LEAST_PIXELS = 200  # of a cell
_MOST_CHANGE = 0.6  # of the blur variance in a cell, beyond which a linear step says little


@dataclass(frozen=True)
class Focus:
    """How far from its focus a sensor stands; all lengths on the side of the sensor.

    Attributes
    ----------
    defocus_um : float
        Size of the distance; its sign cannot be told from one image.
    sigma_um : float
        One standard deviation, of the measured blur alone.
    within_um : float
        With 95 % confidence it is not farther from the focus.
    best_blur_um : float
        Blur in focus, taken from the system.
    aperture : float
        Numerical aperture on the side of the sensor.
    depth_um : float
        wavelength / NA^2: below it diffraction, not geometry, rules; NaN if unknown.
    """

    defocus_um: float
    sigma_um: float
    within_um: float
    best_blur_um: float
    aperture: float
    depth_um: float

    def as_dict(self) -> dict[str, float | None]:
        return {name: value if np.isfinite(value) else None for name, value in asdict(self).items()}


def focus(
    blur_um: float, sigma_blur_um: float, system: System, best_blur_um: float | None = None
) -> Focus:
    """Distance from the focus that makes a blur.

    Parameters
    ----------
    blur_um, sigma_blur_um : float
        Blur of the optics on the sensor, as a standard deviation, and its error.
    system : System
        Gives the aperture and, by default, the blur in focus.
    best_blur_um : float, optional
        Blur in focus.

    Raises
    ------
    ValueError
        If the aperture is not known.
    """
    best = system.optics.blur_um if best_blur_um is None else best_blur_um
    aperture = image_aperture(system)
    excess = blur_um**2 - best**2
    error = 2 * blur_um * sigma_blur_um
    size = 2 / aperture * np.sqrt(max(excess, 0.0))
    # near the focus the error of z is that of z^2, not of its root
    far = excess > error
    sigma = 2 / aperture**2 * error / size if far else 2 / aperture * np.sqrt(error)
    wavelength = system.optics.wavelength_nm
    return Focus(
        defocus_um=float(size),
        sigma_um=float(sigma),
        within_um=float(2 / aperture * np.sqrt(max(excess, 0.0) + 1.645 * error)),
        best_blur_um=float(best),
        aperture=float(aperture),
        depth_um=float("nan") if wavelength is None else wavelength * 1e-3 / aperture**2,
    )


# ------------------------------------------------------------------------ over the image


@dataclass(frozen=True, eq=False)
class BlurMap:
    """Blur over the image; NaN where a part of it shows too few contours.

    Attributes
    ----------
    u_um, v_um : ndarray, shape (rows, columns)
        Centres of the parts, from the middle of the sensor.
    blur_um, sigma_um : ndarray, shape (rows, columns)
        Gaussian sigma of the optical blur and its error.
    plane : ndarray, shape (6,)
        Blur^2 as a second-order surface: coefficients (um^2) of 1, u, v, u^2, uv, v^2 with u and
        v in mm.
    chi2_ndf : float
        Of the parts against that surface.
    chi2_even : float
        Of the parts against one blur all over, per degree of freedom.
    """

    u_um: Array
    v_um: Array
    blur_um: Array
    sigma_um: Array
    plane: Array
    chi2_ndf: float
    chi2_even: float

    def as_dict(self) -> dict[str, Any]:
        """Lists by name; None where there is no value."""

        def listed(values: Array) -> list[list[float | None]]:
            return [[float(x) if np.isfinite(x) else None for x in row] for row in values]

        return {
            "u_um": self.u_um.tolist(),
            "v_um": self.v_um.tolist(),
            "blur_um": listed(self.blur_um),
            "sigma_um": listed(self.sigma_um),
            "blur2_surface_um2": self.plane.tolist(),
            "chi2_ndf": self.chi2_ndf,
            "chi2_even": self.chi2_even,
        }

    def tilt(self, system: System, best_blur_um: float | None = None) -> tuple[Array, Array]:
        """Defocus over the image as a plane: z = z0 + a u + b v.

        Returns
        -------
        plane : ndarray, shape (3,)
            z0 (um), a and b (rad): distance of the sensor from the focus, up to one common sign
            (z0 is given positive).
        sigma : ndarray, shape (3,)

        Raises
        ------
        ValueError
            If the aperture is not known or too few parts of the image show a blur.
        """
        best = system.optics.blur_um if best_blur_um is None else best_blur_um
        half = image_aperture(system) / 2
        good = np.isfinite(self.blur_um)
        if np.count_nonzero(good) < 6:
            raise ValueError("too few parts of the image show a blur; no tilt can be told")
        u, v, blur, sigma = (a[good] for a in (self.u_um, self.v_um, self.blur_um, self.sigma_um))
        basis = np.stack([np.ones_like(u), u, v], axis=1)
        unit = np.array([1.0, 1 / np.ptp(u), 1 / np.ptp(v)])

        def misfit(z: Array) -> Array:
            square = best**2 + (half * (basis @ (z * unit))) ** 2
            return np.asarray((blur**2 - square) / (2 * blur * sigma))

        size = 2 * np.sqrt(max(float(np.mean(blur**2)) - best**2, 0.0)) / (2 * half)
        # a minimum for either way the focus may run through the image
        starts = [
            np.array([size, a * size, b * size])
            for a, b in ((0, 0), (2, 0), (-2, 0), (0, 2), (0, -2))
        ]
        starts += [np.array([0.1 * size, a * size, b * size]) for a, b in ((2, 0), (0, 2))]
        fits = [optimize.least_squares(misfit, start + 1e-3, x_scale="jac") for start in starts]
        found = min(fits, key=lambda one: float(one.cost))
        plane = found.x * unit
        covariance = np.linalg.pinv(found.jac.T @ found.jac)
        growth = np.sqrt(max(1.0, 2 * found.cost / max(len(u) - 3, 1)))
        return plane * np.where(plane[0] < 0, -1, 1), np.sqrt(np.diag(covariance)) * unit * growth


def blur_map(equations: Equations, shapes: Shapes) -> BlurMap:
    """Blur in parts of the image, with the edge shift and the levels of each part fitted along."""
    pixels = equations.pixels
    shift, variance = blur_columns(equations, shapes)
    dark = 1 - pixels.white
    columns = np.stack([variance, shift, dark, pixels.white], axis=1)
    cell, rows, cols = _cells(pixels)
    blur2 = np.full(rows * cols, np.nan)
    sigma2 = np.full(rows * cols, np.nan)
    weights = np.zeros(N_KINDS)
    for kind in range(N_KINDS):
        weights[kind] = float(np.sum(pixels.weight * variance**2 * (_nearest(pixels) == kind)))
    middle = float(weights @ shapes.parameters[:, 1] ** 2 / weights.sum())
    growth = np.sqrt(max(1.0, shapes.chi2 / shapes.ndf))
    for k in range(rows * cols):
        here = cell == k
        if np.count_nonzero(here) < _LEAST_PIXELS:
            continue
        design, weight = columns[here], pixels.weight[here]
        normal = design.T @ (weight[:, None] * design)
        if np.linalg.cond(normal / np.sqrt(np.outer(np.diag(normal), np.diag(normal)))) > 1e8:
            continue
        inverse = np.linalg.inv(normal)
        step = float((inverse @ (design.T @ (weight * shapes.residual[here])))[0])
        error = float(np.sqrt(inverse[0, 0])) * growth
        if abs(step) < _MOST_CHANGE * middle and error < _MOST_CHANGE * middle:
            blur2[k], sigma2[k] = middle + step, error
    return _map(pixels, blur2.reshape(rows, cols), sigma2.reshape(rows, cols))


def _nearest(pixels: EdgePixels) -> NDArray[np.int64]:
    """Kind of the contour that every pixel sees most of."""
    seen = np.zeros((N_KINDS, len(pixels)))
    for one in pixels.contours:
        if one.nearest:
            edge = pixels.edges[one.kind // 2]
            seen[one.kind] = one.step * np.exp(-0.5 * (one.distance_um / edge.sigma_um) ** 2)
    return np.argmax(seen, axis=0)


def _cells(pixels: EdgePixels) -> tuple[NDArray[np.int64], int, int]:
    height, width = pixels.camera.shape
    side = max(height, width) / _CELLS
    rows, cols = max(1, round(height / side)), max(1, round(width / side))
    row = np.minimum(pixels.row * rows // height, rows - 1)
    return row * cols + np.minimum(pixels.column * cols // width, cols - 1), rows, cols


def _map(pixels: EdgePixels, blur2: Array, sigma2: Array) -> BlurMap:
    rows, cols = blur2.shape
    u_um, v_um = sensor_grid_um(pixels.camera.shape, pixels.camera.pixel_um)
    u = np.interp((np.arange(cols) + 0.5) / cols * len(u_um) - 0.5, np.arange(len(u_um)), u_um)
    v = np.interp((np.arange(rows) + 0.5) / rows * len(v_um) - 0.5, np.arange(len(v_um)), v_um)
    u, v = np.broadcast_arrays(u, v[:, None])
    good = np.isfinite(blur2)
    x, y = u[good] * 1e-3, v[good] * 1e-3
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    plane, chi2_ndf, chi2_even = np.full(6, np.nan), float("nan"), float("nan")
    values, weight = blur2[good], 1 / sigma2[good]
    count = len(values)
    if count > 1:
        mean = float(np.sum(values * weight**2) / np.sum(weight**2))
        chi2_even = float(np.sum(((values - mean) * weight) ** 2) / (count - 1))
    if count > 6:
        plane = np.linalg.lstsq(basis * weight[:, None], values * weight, rcond=None)[0]
        chi2_ndf = float(np.sum(((values - basis @ plane) * weight) ** 2) / (count - 6))
    blur = np.sqrt(blur2)
    return BlurMap(u.copy(), v.copy(), blur, sigma2 / (2 * blur), plane, chi2_ndf, chi2_even)


# ------------------------------------------------------------------------ along a track


def focus_of_track(
    track: Track, system: System, best_blur_um: float | None = None
) -> tuple[Array, Array]:
    """Distance from the focus of every frame of a track, from its blur.

    Parameters
    ----------
    track : Track
    system : System
    best_blur_um : float, optional
        Blur in focus; by default the system's.

    Returns
    -------
    defocus_um : ndarray, shape (n,)
        Its size; the sign is not known. 0 where the blur is below that in focus, NaN where
        there is none.
    per_blur : ndarray, shape (n,)
        Its change with the blur, um per um; infinite in focus.

    Raises
    ------
    ValueError
        If the aperture is not known.
    """
    best = system.optics.blur_um if best_blur_um is None else best_blur_um
    aperture = image_aperture(system)
    blur = np.where(track.ok, track.blur_um, np.nan)
    size = 2 / aperture * np.sqrt(np.maximum(blur**2 - best**2, 0.0))
    with np.errstate(divide="ignore"):
        return size, 4 * blur / (aperture**2 * size)
