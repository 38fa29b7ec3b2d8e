"""Edge profiles, blur, asymmetry and modulation transfer of an analysed image.

The edge spread is taken over all contours at once by sub-pixel distance from the fitted pose
(`rasnik.characterisation.edge_contours`), as a free curve and as blur, shift and kurtosis
(`rasnik.characterisation.edge_fit`), for contours across X and across Y and for the step from
black to white and back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.frame import Bounds
from rasnik.analysis.pose import Pose
from rasnik.characterisation.edge_contours import KINDS, N_KINDS, edge_pixels
from rasnik.characterisation.edge_fit import (
    Curves,
    Equations,
    Shapes,
    fit_curves,
    fit_shapes,
    make_equations,
)
from rasnik.characterisation.edge_misfit import Cause, explain
from rasnik.characterisation.edge_transfer import Transfer, edge_transfer
from rasnik.characterisation.focus import BlurMap, blur_map
from rasnik.instrument import System

__all__ = ["CURVES", "NUMBERS", "EdgeProfile", "Edges", "Estimate", "edges"]

Array = NDArray[np.float64]

_BINS_PER_PIXEL = 8
_LEVEL_PART = 0.8
_SLOPE_STEP = 0.25  # of a bin, for slopes
_AXES = ("x", "y")


class Estimate(NamedTuple):
    """A value and its standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True, eq=False)
class EdgeProfile:
    """Edge spread across the contours of one kind: 0 in black, 1 in white.

    Attributes
    ----------
    name : str
        One of `KINDS`, "towards +x" or "+y" understood.
    distance_um : ndarray, shape (d,)
        On the sensor, from the contour of the fitted pose, positive towards white; in steps of
        1/8 pixel.
    value, sigma : ndarray, shape (d,)
        Free curve (pixel included) and its error; neighbouring values are correlated.
    binned, binned_sigma : ndarray, shape (d,)
        Mean of the pixels within the step, the rest of the scene taken away; errors are
        independent. NaN where no pixel lies.
    model : ndarray, shape (d,)
        The fitted image model.
    line, line_sigma : ndarray, shape (d,)
        Line spread: slope of the free curve, 1/um, and its error.
    shift_um : Estimate
        How far black reaches beyond the contour, on the sensor.
    blur_um : Estimate
        Sigma of the optical blur on the sensor, without the pixel.
    kurtosis : Estimate
        Excess kurtosis of the optical blur.
    """

    name: str
    distance_um: Array
    value: Array
    sigma: Array
    binned: Array
    binned_sigma: Array
    model: Array
    line: Array
    line_sigma: Array
    shift_um: Estimate
    blur_um: Estimate
    kurtosis: Estimate


@dataclass(frozen=True, eq=False)
class Edges:
    """What the contours of one image, or of several of one scene, show.

    Attributes
    ----------
    images : int
    pixel_um, scale : float
        Pitch as read out; image size / mask size.
    profiles : tuple of EdgeProfile
        In the order of `KINDS`.
    blur_um, kurtosis : Estimate
        Of all profiles together.
    blur_x_um, blur_y_um : Estimate
        Across contours in X and in Y.
    edge_shift_um : Estimate
        How far black reaches beyond its nominal edge, on the mask.
    lateral_x_um, lateral_y_um : Estimate
        Displacement of black-to-white against white-to-black contours, halved, towards +X and
        +Y on the mask: what the fitted position leaves, 0 within its error.
    transfer : tuple of Transfer
        Across X and across Y.
    blur_map : BlurMap
    causes : tuple of Cause
        Chi-square per degree of freedom, cause by cause.
    chi2_ndf : float
        Of the image model, as stated with the pose.
    levelled : float
        Rise of the profiles over the middle 80 % of their length, mean: below 1 where the edge
        goes on beyond the half way to the next contour, by blur or by haze. The transfer then
        rests on the model's tails, and ripples where these do not join.
    noise_known : bool
        Whether chi-square refers to the system's noise; else to that where the image is flat.
    """

    images: int
    pixel_um: float
    scale: float
    profiles: tuple[EdgeProfile, ...]
    blur_um: Estimate
    kurtosis: Estimate
    blur_x_um: Estimate
    blur_y_um: Estimate
    edge_shift_um: Estimate
    lateral_x_um: Estimate
    lateral_y_um: Estimate
    transfer: tuple[Transfer, Transfer]
    blur_map: BlurMap
    causes: tuple[Cause, ...]
    chi2_ndf: float
    levelled: float
    noise_known: bool

    @property
    def numbers(self) -> dict[str, Estimate]:
        """The single numbers by name."""
        return {name: getattr(self, name) for name in NUMBERS}

    def as_dict(self) -> dict[str, Any]:
        """Everything by name, for JSON; None where there is no value."""
        found: dict[str, Any] = {
            "images": self.images,
            "pixel_um": self.pixel_um,
            "scale": self.scale,
            "chi2_ndf": self.chi2_ndf,
            "levelled": self.levelled,
            "noise_known": self.noise_known,
        }
        for name, one in self.numbers.items():
            found[name], found[f"sigma_{name}"] = _finite(one.value), _finite(one.sigma)
        found["causes"] = [
            {key: _finite(value) for key, value in one.as_dict().items()} for one in self.causes
        ]
        found["profiles"] = [_profile_dict(one) for one in self.profiles]
        found["transfer"] = dict(zip(_AXES, (one.as_dict() for one in self.transfer), strict=True))
        found["blur_map"] = self.blur_map.as_dict()
        return found


#: Names of the arrays of a profile.
CURVES = (
    "distance_um",
    "value",
    "sigma",
    "binned",
    "binned_sigma",
    "model",
    "line",
    "line_sigma",
)
#: Names of the single numbers of an image.
NUMBERS = (
    "blur_um",
    "blur_x_um",
    "blur_y_um",
    "kurtosis",
    "edge_shift_um",
    "lateral_x_um",
    "lateral_y_um",
)


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _profile_dict(one: EdgeProfile) -> dict[str, Any]:
    found: dict[str, Any] = {"name": one.name}
    for name in ("shift_um", "blur_um", "kurtosis"):
        estimate = getattr(one, name)
        found[name], found[f"sigma_{name}"] = estimate.value, estimate.sigma
    for name in CURVES:
        found[name] = [_finite(float(x)) for x in getattr(one, name)]
    return found


# ------------------------------------------------------------------------ one image


def edges(
    image: NDArray[np.generic],
    pose: Pose,
    system: System,
    bounds_px: Bounds | None = None,
) -> Edges:
    """Edge profiles, blur, asymmetry and modulation transfer of an analysed image.

    Errors cover the noise of the pixels and, where the noise is not known or does not explain
    the residuals, their scatter between parts of the image. They do not cover light that varies
    over the reach of an edge in the same way at all contours.

    Parameters
    ----------
    image : ndarray, shape (H, W)
    pose : Pose
        As found in this image by the likelihood analysis.
    system : System
    bounds_px : tuple of int, optional
        (left, top, right, bottom), the last ones included.

    Returns
    -------
    Edges

    Raises
    ------
    ValueError
        If the pose has no fitted image, or the image shows too few contours.
    """
    pixels = edge_pixels(image, pose, system, bounds_px)
    equations = make_equations(pixels)
    curves, shapes = fit_curves(equations), fit_shapes(equations)
    scale = pixels.scale
    ones = np.ones(N_KINDS)
    profiles = tuple(_profile(equations, curves, shapes, kind) for kind in range(N_KINDS))
    x, y = np.array([1.0, 1, 0, 0]), np.array([0, 0, 1.0, 1])
    return Edges(
        images=1,
        pixel_um=pixels.camera.pixel_um,
        scale=scale,
        profiles=profiles,
        blur_um=_mean(shapes, 1, ones),
        kurtosis=_mean(shapes, 2, ones),
        blur_x_um=_mean(shapes, 1, x),
        blur_y_um=_mean(shapes, 1, y),
        edge_shift_um=_scaled(_mean(shapes, 0, ones), 1 / scale),
        lateral_x_um=_scaled(_combined(shapes, 0, np.array([0.5, -0.5, 0, 0])), 1 / scale),
        lateral_y_um=_scaled(_combined(shapes, 0, np.array([0, 0, 0.5, -0.5])), 1 / scale),
        transfer=(
            edge_transfer(equations, curves, 0, system),
            edge_transfer(equations, curves, 1, system),
        ),
        blur_map=blur_map(equations, shapes),
        causes=explain(equations, curves),
        chi2_ndf=pose.chi2_ndf,
        levelled=float(np.mean([_rise(one) for one in profiles])),
        noise_known=pixels.noise_known,
    )


def _mean(shapes: Shapes, column: int, among: Array) -> Estimate:
    """Mean of some profiles with equal weights: they rest on equally many contours."""
    return _combined(shapes, column, among / among.sum())


def _combined(shapes: Shapes, column: int, weights: Array) -> Estimate:
    covariance = shapes.covariance[column::3, column::3]
    return Estimate(
        float(weights @ shapes.parameters[:, column]),
        float(np.sqrt(weights @ covariance @ weights)),
    )


def _rise(one: EdgeProfile) -> float:
    """How much a profile rises over the middle of its length."""
    cut = round((1 - _LEVEL_PART) / 2 * len(one.value))
    return float(one.value[-1 - cut] - one.value[cut])


def _scaled(one: Estimate, factor: float) -> Estimate:
    return Estimate(one.value * factor, one.sigma * factor)


def _profile(equations: Equations, curves: Curves, shapes: Shapes, kind: int) -> EdgeProfile:
    pixels = equations.pixels
    edge, half = pixels.edges[kind // 2], equations.half_length_um[kind]
    step = pixels.camera.pixel_um / _BINS_PER_PIXEL
    bins = int(half / step)
    distance: Array = np.arange(-bins, bins + 1, dtype=np.float64) * step
    part = equations.part(kind)
    basis = equations.basis(kind, distance)
    model = edge(distance)
    value = model + basis @ curves.coefficients[part]
    ends = (distance - _SLOPE_STEP * step, distance + _SLOPE_STEP * step)
    low, high = (equations.basis(kind, end) for end in ends)
    slope = (high - low) / (2 * _SLOPE_STEP * step)
    line = (edge(ends[1]) - edge(ends[0])) / (2 * _SLOPE_STEP * step)
    variance, line_variance = (
        np.einsum("dm,mn,dn->d", rows, curves.covariance[part, part], rows)
        for rows in (basis, slope)
    )
    information, offset = np.zeros(len(distance)), np.zeros(len(distance))
    for one in pixels.contours:
        if one.kind == kind and one.nearest:
            index = np.rint(one.distance_um / step).astype(np.int64) + bins
            inside = (index >= 0) & (index < len(distance))
            height = (pixels.amplitude * one.step)[inside]
            weight = pixels.weight[inside] * height
            information += np.bincount(index[inside], weight * height, len(distance))
            offset += np.bincount(index[inside], weight * curves.residual[inside], len(distance))
    seen = information > 0
    mean = np.divide(offset, information, out=np.full_like(offset, np.nan), where=seen)
    growth = np.sqrt(1.0 if pixels.noise_known else curves.chi2 / curves.ndf)
    spread = np.divide(growth, np.sqrt(information), out=np.full_like(offset, np.nan), where=seen)
    sigma = np.sqrt(np.diag(shapes.covariance)).reshape(N_KINDS, 3)[kind]
    shift, blur, kurtosis = (
        Estimate(float(a), float(b)) for a, b in zip(shapes.parameters[kind], sigma, strict=True)
    )
    return EdgeProfile(
        name=KINDS[kind],
        distance_um=distance,
        value=value,
        sigma=np.sqrt(np.maximum(variance, 0.0)),
        binned=value + mean,
        binned_sigma=spread,
        model=model,
        line=line + slope @ curves.coefficients[part],
        line_sigma=np.sqrt(np.maximum(line_variance, 0.0)),
        shift_um=shift,
        blur_um=blur,
        kurtosis=kurtosis,
    )
