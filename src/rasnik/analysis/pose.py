"""The result of an analysis: where the mask is, how sure that is, and what was seen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.flags import FLAGS, Flag
from rasnik.imaging.appearance import Appearance
from rasnik.imaging.projection import Projection

__all__ = ["PARAMETERS", "Candidate", "Pose"]

NAN = float("nan")

#: Order of the pose parameters in `Pose.covariance`.
PARAMETERS = ("x_um", "y_um", "scale", "theta_rad")


def _unknown_covariance() -> NDArray[np.float64]:
    return np.full((4, 4), NAN)


@dataclass(frozen=True)
class Candidate:
    """One of several poses that explain an image."""

    x_um: float
    y_um: float
    scale: float
    theta_rad: float
    orientation: int
    log_odds: float
    """Log-likelihood relative to the best candidate (0 for the best, negative for others)."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Position, scale and rotation of the mask as seen in one image.

    Conventions (axes, signs, orientation codes) are those of ``docs/conventions.md``.
    The uncertainties cover pixel noise and, where the flag ``MODEL_MISFIT`` is set, the
    scatter between parts of the image. They do not cover errors of the mask, the lens or
    a wrong field or pixel size.

    Attributes
    ----------
    ok : bool
        Whether position, scale and rotation can be used. If not, they are NaN and `flags`
        and `error` say why.
    x_um, y_um : float
        Mask coordinate imaged on the reference point.
    scale : float
        Image size / mask size (geometric mean of both directions).
    theta_rad : float
        Rotation of the pattern, anticlockwise as seen on the image.
    orientation : int
        1..4; 0 if unknown.
    covariance : ndarray, shape (4, 4)
        Of (x_um, y_um, scale, theta_rad).
    chi2_ndf : float
        Chi-square of the image against the model per degree of freedom.
    blur_um : float
        Gaussian sigma of the optical blur on the sensor, without the pixel itself.
    dark_level, light_level : float
        Grey levels of black and white at the reference point.
    edge_shift_um : float
        By how much black fields are larger than nominal at each edge, on the mask.
    polarity : str
        ``"positive"``, ``"negative"`` or ``""`` if unknown.
    code_lines_read, code_lines_in_view : int
        Columns and rows of code with a certain reading, and those in view.
    masked_fraction : float
        Fraction of the pixels left out (borders, dust, glints, saturation).
    flags : Flag
    candidates : tuple of Candidate
        The poses that explain the image, best first, when it is ambiguous.
    projection : Projection or None
        The full map from sensor to mask.
    appearance : Appearance or None
        Light, blur and edges as fitted (a prior for the next frame).
    method : str
        ``"likelihood"``, ``"fourier"``, or ``"none"`` if nothing was found.
    model : str
        ``"similarity"``, ``"affine"`` or ``"projective"``.
    """

    ok: bool = False
    x_um: float = NAN
    y_um: float = NAN
    scale: float = NAN
    theta_rad: float = NAN
    orientation: int = 0
    covariance: NDArray[np.float64] = field(default_factory=_unknown_covariance)
    chi2_ndf: float = NAN
    blur_um: float = NAN
    dark_level: float = NAN
    light_level: float = NAN
    edge_shift_um: float = NAN
    polarity: str = ""
    code_lines_read: int = 0
    code_lines_in_view: int = 0
    masked_fraction: float = 0.0
    flags: Flag = Flag.NONE
    candidates: tuple[Candidate, ...] = ()
    projection: Projection | None = None
    appearance: Appearance | None = None
    method: str = "none"
    model: str = "similarity"

    def _sigma(self, index: int) -> float:
        return float(np.sqrt(self.covariance[index, index]))

    @property
    def sigma_x_um(self) -> float:
        return self._sigma(0)

    @property
    def sigma_y_um(self) -> float:
        return self._sigma(1)

    @property
    def sigma_scale(self) -> float:
        return self._sigma(2)

    @property
    def sigma_theta_rad(self) -> float:
        return self._sigma(3)

    @property
    def contrast(self) -> float:
        """Michelson contrast of the fields, (light - dark) / (light + dark)."""
        return (self.light_level - self.dark_level) / (self.light_level + self.dark_level)

    @property
    def scale_xy(self) -> tuple[float, float]:
        """Magnifications along mask x and mask y (equal for a similarity)."""
        if self.projection is None:
            return NAN, NAN
        inverse = np.linalg.inv(self.projection.jacobian)
        return float(np.hypot(*inverse[:, 0])), float(np.hypot(*inverse[:, 1]))

    @property
    def error(self) -> str | None:
        """Why there is no position, as a sentence with its remedy; None if there is one."""
        if self.ok:
            return None
        rows = [info for info in FLAGS if info.fatal and self.flags & info.flag]
        return " ".join(f"{info.sentence} {info.remedy}" for info in rows) or "No result."

    def as_dict(self) -> dict[str, Any]:
        """The scalar results by name, as written to JSON lines, tables and HDF5.

        NaN stands for what is not known (null in JSON).
        """
        return {
            "ok": self.ok,
            "flags": self.flags.names,
            "error": self.error,
            "x_um": self.x_um,
            "y_um": self.y_um,
            "scale": self.scale,
            "theta_rad": self.theta_rad,
            "orientation": self.orientation,
            "sigma_x_um": self.sigma_x_um,
            "sigma_y_um": self.sigma_y_um,
            "sigma_scale": self.sigma_scale,
            "sigma_theta_rad": self.sigma_theta_rad,
            "chi2_ndf": self.chi2_ndf,
            "blur_um": self.blur_um,
            "contrast": self.contrast,
            "dark_level": self.dark_level,
            "light_level": self.light_level,
            "edge_shift_um": self.edge_shift_um,
            "scale_x": self.scale_xy[0],
            "scale_y": self.scale_xy[1],
            "polarity": self.polarity,
            "code_lines_read": self.code_lines_read,
            "code_lines_in_view": self.code_lines_in_view,
            "masked_fraction": self.masked_fraction,
            "method": self.method,
            "model": self.model,
        }
