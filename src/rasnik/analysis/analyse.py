"""From a frame to its pose, in one call.

The frame's way: `prepare_frame` (what pixels there are) -> `find_lattice` (where the fields
lie) -> `read_fields` and `decode` (which fields they are) -> `fit` (where exactly). With a
prior pose the first steps are left out, as long as the result proves itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.decode import Decoding, LabelledLattice, decode
from rasnik.analysis.flags import FLAGS, Flag
from rasnik.analysis.fourier import find_lattice
from rasnik.analysis.fourier_pose import fourier_pose
from rasnik.analysis.frame import (
    ROUNDING_VARIANCE,
    Bounds,
    Frame,
    prepare_frame,
    resolve_instrument,
)
from rasnik.analysis.lattice import Lattice
from rasnik.analysis.likelihood import Fit, fit
from rasnik.analysis.parameters import Model, State
from rasnik.analysis.pose import Pose
from rasnik.analysis.readout import read_fields
from rasnik.imaging.appearance import Appearance
from rasnik.imaging.model import MIN_BLUR_PX
from rasnik.imaging.projection import ORIENTATIONS, Projection
from rasnik.instrument import System

__all__ = ["Method", "analyse"]

Method = Literal["likelihood", "fourier"]

# How far a refined pose may be from where it started, in fields: less than half a field,
# beyond which another field would be taken for this one.
_MOST_MOTION_FIELDS = 0.35
_PRIOR_MOTION_FIELDS = 0.8
_LEAST_EXPLAINED = 0.5
_PRIOR_EXPLAINED = 0.9
# There is a pattern if its amplitude is so many times what noise makes of none, and if it tells
# the position to this part of a field.
_LEAST_SIGNIFICANCE = 20.0
_MOST_SIGMA_FIELDS = 0.02
# What is left of a flash or a border does not tell whole fields apart: of the pixels that the
# prior rests on, as many must be there.
_PRIOR_PIXELS = 0.5
_HEAVILY_MASKED = 0.25
_SCALE_TOLERANCE = np.log(1.2)
_FATAL = Flag(sum(info.flag for info in FLAGS if info.fatal))


def analyse(
    image: NDArray[np.generic],
    system: System | str | None = None,
    *,
    field_um: float | None = None,
    pixel_um: float | None = None,
    method: Method = "likelihood",
    model: Model | Literal["auto"] = "auto",
    orientation: int | None = None,
    prior: Pose | None = None,
    bounds: Bounds | None = None,
) -> Pose:
    """Find where the mask is in one image.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Grey levels, integer or float. Row 0 is the top.
    system : System or str, optional
        The instrument: an object, a preset's name or a TOML file. Its grey levels, blur,
        scale and rotation are not used: they are found from the image.
    field_um, pixel_um : float, optional
        Side of the chess fields and pitch of the pixels, instead of a system; the noise
        is then estimated from the image.
    method : {"likelihood", "fourier"}
        Maximum likelihood to the bound, or the spectrum's phases alone.
    model : {"auto", "similarity", "affine", "projective"}
        Map from mask to image; "auto" takes the simplest that the image allows.
    orientation : int, optional
        How the mask's axes lie in the image (1..4); found from the image by default, or
        from the system if that has one. With it, theta_z covers the full circle.
    prior : Pose, optional
        A pose nearby (of the frame before, say); spares finding the mask from nothing.
    bounds : tuple of int, optional
        (left, top, right, bottom) pixel of the picture, all included; the rest is ignored.
        The reference point stays the centre of the whole array.

    Returns
    -------
    Pose
        With ``ok`` False, NaN values and a flag that says why if there is no position.

    Raises
    ------
    ValueError
        For arguments that contradict each other, or an image of the wrong shape or size.

    Examples
    --------
    >>> from rasnik import analyse, simulate
    >>> simulation = simulate("solidras", (4000.0, 5000.0, 0.002), seed=1)
    >>> pose = analyse(simulation.frames[0], "solidras")
    >>> pose.ok, round(pose.x_um, 2), round(pose.y_um, 2)
    (True, 4000.0, 5000.0)
    """
    mask, pitch, loaded = resolve_instrument(system, field_um, pixel_um)
    if orientation is None and loaded is not None:
        orientation = loaded.optics.orientation
    _check_options(method, model, orientation, prior)
    frame, flags = prepare_frame(image, mask, pitch, loaded, bounds)
    if prior is not None and prior.ok and method == "likelihood":
        pose = _from_prior(frame, prior, model, flags)
        if pose is not None:
            return _with_scale_checked(pose, loaded)
        flags |= Flag.PRIOR_REJECTED
    lattice = find_lattice(frame.image, pitch, _picture_mask(frame))
    if isinstance(lattice, Flag):
        return Pose(flags=flags | lattice)
    decoding = decode(read_fields(lattice), lattice, mask, orientation)
    decoding = _settled_by_prior(decoding, prior, mask.field_um)
    flags |= decoding.flags
    if method == "fourier" or not decoding.ok or decoding.best is None:
        pose = fourier_pose(lattice, decoding, mask)
        return _with_scale_checked(replace(pose, flags=pose.flags | flags), loaded)
    pose = _refined(frame, lattice, decoding, decoding.best, model, flags)
    return _with_scale_checked(pose, loaded)


def _with_scale_checked(pose: Pose, system: System | None) -> Pose:
    """The pose, flagged if its scale is not the system's: the mask may be another one."""
    if (
        system is None
        or not pose.ok
        or abs(np.log(pose.scale / system.optics.scale)) < _SCALE_TOLERANCE
    ):
        return pose
    return replace(pose, flags=pose.flags | Flag.SCALE_UNEXPECTED)


def _check_options(method: str, model: str, orientation: int | None, prior: Pose | None) -> None:
    if method not in ("likelihood", "fourier"):
        raise ValueError(f"method must be 'likelihood' or 'fourier', not {method!r}")
    if model not in ("auto", "similarity", "affine", "projective"):
        raise ValueError(
            f"model must be 'auto', 'similarity', 'affine' or 'projective', not {model!r}"
        )
    if method == "fourier" and model not in ("auto", "similarity"):
        raise ValueError(f"method 'fourier' knows only the similarity, not {model!r}")
    if orientation is not None and orientation not in ORIENTATIONS:
        raise ValueError(f"orientation must be 1, 2, 3 or 4, not {orientation!r}")
    if prior is not None and prior.ok and orientation not in (None, prior.orientation):
        raise ValueError(
            f"the prior pose has orientation {prior.orientation}, but {orientation} is demanded; "
            "leave one of them out"
        )


def _with_polarity(frame: Frame, polarity: str) -> Frame:
    """The frame with the polarity that was found; masks exist as positive and negative."""
    if frame.mask.polarity == polarity:
        return frame
    return replace(frame, mask=frame.mask.model_copy(update={"polarity": polarity}))


def _picture_mask(frame: Frame) -> NDArray[np.bool_] | None:
    return None if frame.picture.all() else frame.picture > 0


# --------------------------------------------------------------------- from nothing


def _refined(
    frame: Frame,
    lattice: Lattice,
    decoding: Decoding,
    best: LabelledLattice,
    model: Model | Literal["auto"],
    flags: Flag,
) -> Pose:
    frame = _with_polarity(frame, best.polarity)
    blur = max(lattice.blur_um, 2 * MIN_BLUR_PX * frame.camera.pixel_um)
    start = State(best.projection, Appearance(lattice.dark, lattice.light, blur))
    try:
        result = fit(frame, start, model=model)
    except ValueError:
        return Pose(flags=flags | Flag.NOT_CONVERGED, method="likelihood")
    # a first estimate is affine: where a tilted mask needs more, only its centre is right
    centre_only = result.model == "projective"
    moved = _motion_fields(frame, start.projection, result.state.projection, centre_only)
    if (
        not result.converged
        or moved > _MOST_MOTION_FIELDS
        or result.explained < _LEAST_EXPLAINED
        or not _shows_pattern(frame, result)
    ):
        flags |= Flag.NOT_CONVERGED
    return replace(
        _pose(frame, result, best.orientation, flags),
        polarity=best.polarity,
        code_lines_read=decoding.lines_read,
        code_lines_in_view=decoding.lines_in_view,
    )


def _settled_by_prior(decoding: Decoding, prior: Pose | None, field_um: float) -> Decoding:
    """The candidate that a prior pose points at, if exactly one is within four fields of it."""
    if prior is None or not prior.ok or not decoding.flags & Flag.AMBIGUOUS:
        return decoding
    near = [
        one
        for one in decoding.candidates
        if one.orientation == prior.orientation
        and np.hypot(one.projection.x_um - prior.x_um, one.projection.y_um - prior.y_um)
        < 4 * field_um
    ]
    if len(near) != 1:
        return decoding
    flags = (decoding.flags & ~Flag.AMBIGUOUS) | Flag.SETTLED_BY_PRIOR
    return replace(decoding, best=near[0], flags=flags)


# --------------------------------------------------------------------- from a prior


def _from_prior(
    frame: Frame, prior: Pose, model: Model | Literal["auto"], flags: Flag
) -> Pose | None:
    """Refine a prior pose; None unless the result proves itself.

    A prior that is off by whole fields fits the chessboard but not the code: parts of the
    image then stand out, or much is left unexplained.
    """
    if prior.projection is None or prior.appearance is None:
        return None
    if frame.valid.mean() < _PRIOR_PIXELS * (1.0 - prior.masked_fraction):
        return None
    frame = _with_polarity(frame, prior.polarity)
    start = State(prior.projection, prior.appearance)
    try:
        result = fit(frame, start, model=model, previous_chi2_ndf=prior.chi2_ndf)
    except ValueError:
        return None
    moved = _motion_fields(frame, start.projection, result.state.projection)
    if (
        not (result.converged and result.clean)
        or moved > _PRIOR_MOTION_FIELDS
        or result.explained < _PRIOR_EXPLAINED
        or not _shows_pattern(frame, result)
    ):
        return None
    pose = _pose(frame, result, prior.orientation, flags)
    if not pose.ok:
        return None
    return replace(
        pose,
        polarity=prior.polarity,
        code_lines_read=prior.code_lines_read,
        code_lines_in_view=prior.code_lines_in_view,
    )


# --------------------------------------------------------------------- results


def _shows_pattern(frame: Frame, result: Fit) -> bool:
    """Whether the image says where the mask is. Of one without a pattern a fit leaves nothing
    unexplained either, and stays where it began.
    """
    appearance = result.state.appearance
    dark, light = float(appearance.dark[0]), float(appearance.light[0])
    variance = result.noise[0] + result.noise[1] * max(light, 0.0)
    sample = frame.image[::3, ::3]
    if (sample == np.rint(sample)).all():  # clipped noise may seem to be none
        variance = max(variance, ROUNDING_VARIANCE)
    variance *= max(result.chi2_ndf, 1.0)
    significance = 0.5 * (light - dark) * np.sqrt(np.count_nonzero(result.valid) / variance)
    sigma_um = np.sqrt(np.diag(result.covariance)[:2].max())
    return bool(
        significance > _LEAST_SIGNIFICANCE and sigma_um < _MOST_SIGMA_FIELDS * frame.mask.field_um
    )


def _motion_fields(
    frame: Frame, before: Projection, after: Projection, centre_only: bool = False
) -> float:
    """Largest motion of the pattern at the centre and the corners of the image, in fields."""
    u, v = (np.append(0.0, corners) for corners in frame.camera.corners_um)
    if centre_only:
        u, v = u[:1], v[:1]
    (x0, y0), (x1, y1) = before.to_mask(u, v), after.to_mask(u, v)
    return float(np.hypot(x1 - x0, y1 - y0).max() / frame.mask.field_um)


def _pose(frame: Frame, result: Fit, orientation: int, flags: Flag) -> Pose:
    state = result.state
    projection, appearance = state.projection, state.appearance
    masked = 1.0 - np.count_nonzero(result.valid) / result.valid.size
    flags |= result.flags
    if masked > _HEAVILY_MASKED:
        flags |= Flag.HEAVILY_MASKED
    if result.model != "similarity":
        flags |= Flag.AFFINE if result.model == "affine" else Flag.PROJECTIVE
    dark, light = float(appearance.dark[0]), float(appearance.light[0])
    if light - dark < 5 * np.sqrt(max(result.noise[0] + result.noise[1] * light, 0.0)):
        flags |= Flag.LOW_CONTRAST
    if not light > dark:
        flags |= Flag.NOT_CONVERGED
    if flags & _FATAL:
        return Pose(flags=flags, method="likelihood", masked_fraction=masked)
    scale, theta, _ = projection.similarity(orientation)
    return Pose(
        ok=True,
        x_um=projection.x_um,
        y_um=projection.y_um,
        scale=scale,
        theta_rad=theta,
        orientation=orientation,
        covariance=result.covariance,
        chi2_ndf=result.chi2_ndf,
        blur_um=appearance.blur_um,
        dark_level=dark,
        light_level=light,
        edge_shift_um=appearance.edge_shift_um,
        masked_fraction=masked,
        flags=flags,
        projection=projection,
        appearance=appearance,
        method="likelihood",
        model=result.model,
    )
