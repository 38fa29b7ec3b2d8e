"""The bound: how well a position can be known from one image, whatever the analysis.

The Fisher information of the image model is what the fit inverts for its errors; evaluated on
the expected image it says beforehand what no unbiased analysis can beat (Cramer and Rao). Model,
parameters and sums are those of the fit (`rasnik.analysis`).

Source: van der Graaf et al., section 3 "Quantum fluctuations: shot noise", and section 4, where
the resolution is said to have been predicted by Cramer-Rao simulations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.fourier import LEAST_PIXELS_PER_FIELD
from rasnik.analysis.moments import all_tiles, gather
from rasnik.analysis.parameters import POSE_SIZE, State, design
from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.model import make_scene
from rasnik.imaging.projection import Projection
from rasnik.imaging.simulate import simulate
from rasnik.instrument import System

__all__ = [
    "ROUNDING_VARIANCE",
    "Bound",
    "bound",
    "camera_of",
    "noise_of",
    "pose_information",
    "positions",
    "reference_pose",
    "state_at",
]

#: Variance that rounding to whole grey levels adds.
ROUNDING_VARIANCE = 1 / 12

# The paper's first position, (4000, 5000) um with fields of 85 um, in fields.
_REFERENCE_FIELDS = (4000 / 85, 5000 / 85)

# The information of a good image, parameters scaled to one, has a condition number of some tens;
# above this some combination of parameters is not seen.
_WORST_CONDITION = 1e9

_N_POSE = POSE_SIZE["similarity"]


@dataclass(frozen=True, eq=False)
class Bound:
    """Smallest standard deviations of a pose from one image, and what they become in time.

    Attributes
    ----------
    system : System
    covariance : ndarray, shape (4, 4)
        Of x (um), y (um), scale, theta_z (rad), on the mask, with light, dark, blur and
        edge shift unknown as in the fit. The mean over the poses.
    covariance_known : ndarray, shape (4, 4)
        The same if light, dark, blur and edge shift were known.
    rounding : bool
        Whether the variance 1/12 of rounding to whole grey levels is counted.
    poses : tuple of Projection
        Where it was evaluated.
    """

    system: System
    covariance: NDArray[np.float64]
    covariance_known: NDArray[np.float64]
    rounding: bool
    poses: tuple[Projection, ...]

    @property
    def sigma_x_nm(self) -> float:
        """Of x, referred to the mask, per image."""
        return 1e3 * math.sqrt(self.covariance[0, 0])

    @property
    def sigma_y_nm(self) -> float:
        """Of y, referred to the mask, per image."""
        return 1e3 * math.sqrt(self.covariance[1, 1])

    @property
    def sigma_scale(self) -> float:
        """Of the scale S, per image."""
        return math.sqrt(self.covariance[2, 2])

    @property
    def sigma_theta_rad(self) -> float:
        """Of theta_z, per image."""
        return math.sqrt(self.covariance[3, 3])

    @property
    def sigma_nm(self) -> float:
        """Root mean square of those of x and y: one figure for a design."""
        return math.hypot(self.sigma_x_nm, self.sigma_y_nm) / math.sqrt(2)

    def figures(self) -> dict[str, Any]:
        """All figures by name, units in the names.

        ``sigma_*``: per image. ``floor_*``: sigma / sqrt(f), as the paper quotes noise floors.
        ``asd_*``: one-sided amplitude spectral density, sigma * sqrt(2 / f). Referred to the
        mask, but for those that begin with ``image_``; None where the frame rate is not known.
        """
        known = np.sqrt(np.diag(self.covariance_known))
        scale = self.system.optics.scale
        per_image = {
            "sigma_x_nm": self.sigma_x_nm,
            "sigma_y_nm": self.sigma_y_nm,
            "sigma_theta_rad": self.sigma_theta_rad,
            "sigma_scale": self.sigma_scale,
            "sigma_x_known_nm": 1e3 * float(known[0]),
            "sigma_y_known_nm": 1e3 * float(known[1]),
            "sigma_theta_known_rad": float(known[3]),
            "sigma_scale_known": float(known[2]),
            "image_sigma_x_nm": self.sigma_x_nm * scale,
            "image_sigma_y_nm": self.sigma_y_nm * scale,
        }
        return per_image | self._in_time()

    def _in_time(self) -> dict[str, float | None]:
        rate, scale = self.system.sensor.frame_rate_hz, self.system.optics.scale
        quantities = (
            ("x_pm_rthz", 1e3 * self.sigma_x_nm),
            ("y_pm_rthz", 1e3 * self.sigma_y_nm),
            ("theta_rad_rthz", self.sigma_theta_rad),
            ("scale_rthz", self.sigma_scale),
        )
        found: dict[str, float | None] = {}
        for kind, factor in (("floor", 1.0), ("asd", math.sqrt(2.0))):
            for name, sigma in quantities:
                found[f"{kind}_{name}"] = factor * sigma / math.sqrt(rate) if rate else None
        for name in ("x_pm_rthz", "y_pm_rthz"):
            asd = found[f"asd_{name}"]
            found[f"image_asd_{name}"] = None if asd is None else asd * scale
        return found


def bound(
    system: System,
    poses: Any = None,
    *,
    rounding: bool = False,
    count: int = 0,
    seed: int = 1,
) -> Bound:
    """The Cramer-Rao bound of a system.

    Parameters
    ----------
    system : System
        With a noise law.
    poses : optional
        One pose or several, as `rasnik.simulate` takes them; by default `reference_pose`.
    rounding : bool
        Count the variance 1/12 of rounding to whole grey levels.
    count, seed : int
        Without poses: number of random positions on the mask over which the covariance is
        averaged instead, and their seed. Codes with more set bits have less contour: over a
        mask of 256 x 256 codes the bound varies by some per cent.

    Returns
    -------
    Bound

    Raises
    ------
    ValueError
        If the noise of the system is not known, its fields are too small for its pixels or
        its blur, or a pose is not on the mask.

    Notes
    -----
    Noise counts by its variance alone: that the variance itself depends on the position adds
    one part in twice the number of electrons in a pixel, which is not counted.
    """
    noise = noise_of(system, rounding)
    chosen = positions(system, poses, count=count, seed=seed)
    covariance = np.zeros((_N_POSE, _N_POSE))
    known = np.zeros_like(covariance)
    for projection in chosen:
        normal = pose_information(system, state_at(system, projection), noise)
        covariance += _inverse(normal)[:_N_POSE, :_N_POSE] / len(chosen)
        known += _inverse(normal[:_N_POSE, :_N_POSE]) / len(chosen)
    unit = np.diag([1.0, 1.0, system.optics.scale, 1.0])  # from ln S to S
    return Bound(system, unit @ covariance @ unit, unit @ known @ unit, rounding, chosen)


def camera_of(system: System) -> Camera:
    """The pixel grid of the system's images."""
    return Camera(system.shape, system.pitch_um)


def noise_of(system: System, rounding: bool) -> tuple[float, float]:
    """(A, B) of the variance A + B g of a pixel of the image, with rounding or without.

    Raises
    ------
    ValueError
        If the system does not state its noise, or states that there is none.
    """
    if system.noise_law is None:
        raise ValueError(
            f"the noise of system {system.name} is not known: give sensor.noise_a and "
            "sensor.noise_b"
        )
    a, b = system.noise_law
    a += ROUNDING_VARIANCE if rounding else 0.0
    if a + b * system.sensor.dark_level <= 0:
        raise ValueError(
            f"system {system.name} has no noise in black fields (sensor.noise_a = 0 and no "
            "shot noise there), so nothing bounds its resolution: give a noise"
        )
    return a, b


def positions(
    system: System, poses: Any = None, *, count: int = 0, seed: int = 1
) -> tuple[Projection, ...]:
    """The poses given, `count` seeded random ones or the reference, as maps to the mask."""
    if poses is None and count < 1:
        poses = reference_pose(system)
    n = count if poses is None else 1
    simulation = simulate(system, poses, n=n, seed=seed, noise=False)
    return tuple(truth.projection for truth in simulation.truth)


def reference_pose(system: System) -> tuple[float, float]:
    """(x, y) in um where a system is evaluated by default: the paper's (4000, 5000) um.

    In fields, so that every system is compared at the same code. Where the view would reach
    beyond the mask it is moved by 16 codes, which leaves their lower four bits; on a mask too
    small for that it is the middle.
    """
    field, (height, width) = system.mask.field_um, system.shape
    half = math.hypot(height, width) * system.pitch_um / system.optics.scale / 2
    x0, x1, y0, y1 = system.mask.bounds_um
    found = []
    for fields, low, high in zip(_REFERENCE_FIELDS, (x0, y0), (x1, y1), strict=True):
        stride = 16 * system.mask.period
        moves = math.ceil(max(0.0, half / field - fields) / stride)
        place = low + (fields + moves * stride) * field
        found.append(place if place + half <= high else (low + high) / 2)
    return found[0], found[1]


def state_at(system: System, projection: Projection) -> State:
    """A pose of the mask with the even light and the Gaussian blur of the system."""
    sensor = system.sensor
    look = Appearance.uniform(sensor.dark_level, sensor.light_level, system.optics.blur_um)
    return State(projection, look)


def pose_information(
    system: System, state: State, noise: tuple[float, float]
) -> NDArray[np.float64]:
    """Fisher information on the parameters of the fit, from one image.

    Returns
    -------
    ndarray, shape (18, 18)
        Order and units as in `rasnik.analysis.parameters.design`: x, y (um), ln S, theta_z,
        then the nuisances.

    Raises
    ------
    ValueError
        If the fields are too small for the pixels or for the blur.
    """
    camera = camera_of(system)
    _check_resolved(system, state.projection)
    try:
        scene = make_scene(system.mask, state.projection, state.appearance, camera)
    except ValueError as error:
        raise ValueError(
            f"fields of {system.mask.field_um:g} um cannot be seen through a blur of "
            f"{system.optics.blur_um:g} um at scale {system.optics.scale:g}: {error}"
        ) from None
    # Information does not depend on what the image shows, only on what it is expected to.
    image = np.zeros(camera.shape, dtype=np.float32)
    valid = np.ones(camera.shape, dtype=np.uint8)
    moments = gather(image, valid, scene, noise, camera, all_tiles(camera.shape))
    rows = design(state, camera, system.mask.field_um, "similarity", False)
    return np.asarray(rows @ moments.matrix @ rows.T)


def _check_resolved(system: System, projection: Projection) -> None:
    field_px = system.mask.field_um / math.sqrt(abs(np.linalg.det(projection.jacobian)))
    field_px /= system.pitch_um
    if field_px < LEAST_PIXELS_PER_FIELD:
        raise ValueError(
            f"a field of {system.mask.field_um:g} um covers {field_px:.3g} pixels of the image; to "
            f"be found it must cover {LEAST_PIXELS_PER_FIELD:g}: make fields or scale larger, or "
            "pixels smaller"
        )


def _inverse(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of an information matrix whose parameters have very different sizes.

    Raises
    ------
    ValueError
        If the image does not determine them all.
    """
    diagonal = np.diag(normal)
    if (diagonal > 0).all():
        size = 1 / np.sqrt(diagonal)
        outer = np.outer(size, size)
        scaled = normal * outer
        if np.linalg.cond(scaled) < _WORST_CONDITION:
            return np.asarray(np.linalg.inv(scaled) * outer)
    raise ValueError(
        "the view holds too few contours to determine position, scale and rotation along with "
        "light and blur: make the sensor larger or the fields smaller"
    )
