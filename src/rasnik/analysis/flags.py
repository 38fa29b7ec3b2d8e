"""What can be said of a result besides its numbers: one table of flags.

Messages, documentation and stored results are made from this table.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

__all__ = ["FLAGS", "Flag", "FlagInfo", "info_of"]


class Flag(IntFlag):
    """Conditions met while a frame was analysed; stored as one integer."""

    NONE = 0
    NO_MASK = 1 << 0
    BLANK = 1 << 1
    SATURATED = 1 << 2
    FIELD_TOO_SMALL = 1 << 3
    NO_CODE = 1 << 4
    AMBIGUOUS = 1 << 5
    QUARTER_TURN = 1 << 6
    NOT_CONVERGED = 1 << 7
    MODEL_MISFIT = 1 << 8
    NOISE_ESTIMATED = 1 << 9
    HEAVILY_MASKED = 1 << 10
    AFFINE = 1 << 11
    PROJECTIVE = 1 << 12
    PROFILE_REFINED = 1 << 13
    NOT_FINITE = 1 << 14
    PRIOR_REJECTED = 1 << 15
    LOW_CONTRAST = 1 << 16
    SCALE_UNEXPECTED = 1 << 17
    NO_IMAGE = 1 << 18
    REFITTED = 1 << 19
    COLD_START = 1 << 20
    MOVED = 1 << 21
    LIGHT_CHANGED = 1 << 22
    OBSTRUCTED = 1 << 23
    FRAMES_LOST = 1 << 24
    TIME_IRREGULAR = 1 << 25
    SETTLED_BY_PRIOR = 1 << 26

    @property
    def names(self) -> list[str]:
        """Lower-case names of the flags set, in the order of the table."""
        return [info.name for info in FLAGS if self & info.flag]


@dataclass(frozen=True)
class FlagInfo:
    """One row of the table: what it means and what to do about it."""

    flag: Flag
    fatal: bool
    sentence: str
    remedy: str

    @property
    def name(self) -> str:
        return (self.flag.name or "").lower()


FLAGS: tuple[FlagInfo, ...] = (
    FlagInfo(
        Flag.NO_MASK,
        True,
        "No chess pattern was found in the image.",
        "Check light, focus and that the mask is in view; give bounds to leave out borders.",
    ),
    FlagInfo(
        Flag.BLANK,
        True,
        "The image has no contrast: every pixel has nearly the same value.",
        "Check the light source, the exposure and the lens cap.",
    ),
    FlagInfo(
        Flag.SATURATED,
        False,
        "Many pixels are at the top of the range, which moves edges and hides noise.",
        "Lower the light or the exposure until the white fields stay below full scale.",
    ),
    FlagInfo(
        Flag.FIELD_TOO_SMALL,
        True,
        "A chess field covers fewer than 2.5 pixels.",
        "Use a larger magnification, larger fields or smaller pixels.",
    ),
    FlagInfo(
        Flag.NO_CODE,
        True,
        "A chess pattern is seen, but no code lines in it; the position is not known.",
        "Check the field size, the number of code bits and that code lines are in view.",
    ),
    FlagInfo(
        Flag.AMBIGUOUS,
        True,
        "Several positions explain the image; they are listed as candidates.",
        "Show more of the mask, fix the orientation, or give a prior pose.",
    ),
    FlagInfo(
        Flag.QUARTER_TURN,
        False,
        "The mask is turned by more than 40 degrees: a quarter turn looks like a mirror "
        "image with x and y exchanged, and the smaller rotation was reported.",
        "Fix the orientation if the mask can be turned this far.",
    ),
    FlagInfo(
        Flag.NOT_CONVERGED,
        True,
        "The fit did not converge.",
        "Look at the overlay; give bounds or a prior pose.",
    ),
    FlagInfo(
        Flag.MODEL_MISFIT,
        False,
        "The image differs from the model by more than its noise; "
        "the errors were enlarged to cover the scatter seen between parts of the image.",
        "Look at the residuals; check the sensor's noise figures and the image for distortion.",
    ),
    FlagInfo(
        Flag.NOISE_ESTIMATED,
        False,
        "The sensor's noise is not known and was estimated from this image.",
        "Give sensor.noise_a and sensor.noise_b to have it tested instead.",
    ),
    FlagInfo(
        Flag.HEAVILY_MASKED,
        False,
        "More than a quarter of the image was left out as border, dust, glint or saturated.",
        "Clean the optics or give bounds.",
    ),
    FlagInfo(
        Flag.AFFINE,
        False,
        "The image has unequal scales or a slant, and an affine map was fitted.",
        "Check that mask and sensor are parallel.",
    ),
    FlagInfo(
        Flag.PROJECTIVE,
        False,
        "The scale varies over the image, and a projective map was fitted.",
        "Check that mask and sensor are parallel.",
    ),
    FlagInfo(
        Flag.PROFILE_REFINED,
        False,
        "The edges are not Gaussian; their profile was estimated from the image.",
        "None needed.",
    ),
    FlagInfo(
        Flag.NOT_FINITE,
        False,
        "The image holds NaN or infinite values; those pixels were left out.",
        "Check how the image was made.",
    ),
    FlagInfo(
        Flag.PRIOR_REJECTED,
        False,
        "The prior pose did not fit the image, which was analysed from nothing instead.",
        "None needed; give a closer prior to save time.",
    ),
    FlagInfo(
        Flag.LOW_CONTRAST,
        False,
        "The fields differ by less than five times the noise of a pixel.",
        "Raise the light, improve the focus.",
    ),
    FlagInfo(
        Flag.SCALE_UNEXPECTED,
        False,
        "The scale differs from the system's by more than 20 %. If the mask has another field "
        "size than the system says, the position is wrong by the same factor.",
        "Check mask.field_um, sensor.pixel_um, sensor.binning and optics.scale.",
    ),
    FlagInfo(
        Flag.NO_IMAGE,
        True,
        "There is no image for this frame, or it is not of the instrument's size.",
        "Check the file or the camera, and sensor.width_px, height_px and binning.",
    ),
    FlagInfo(
        Flag.REFITTED,
        False,
        "While tracking, this frame had to be fitted on its own; other flags say why.",
        "None needed.",
    ),
    FlagInfo(
        Flag.COLD_START,
        False,
        "Tracking began here, or began again: the mask was found from nothing.",
        "None needed.",
    ),
    FlagInfo(
        Flag.MOVED,
        False,
        "The mask moved further between frames than tracking follows.",
        "None needed; a higher frame rate makes the steps smaller.",
    ),
    FlagInfo(
        Flag.LIGHT_CHANGED,
        False,
        "The light changed by more than tracking allows.",
        "Check the light source and the exposure.",
    ),
    FlagInfo(
        Flag.OBSTRUCTED,
        False,
        "A part of the image differs from what was tracked: something is in the way.",
        "Check that the view is free and the optics are clean.",
    ),
    FlagInfo(
        Flag.FRAMES_LOST,
        False,
        "Frames are missing just before this one.",
        "Check the camera's connection, and that frames are taken off it fast enough.",
    ),
    FlagInfo(
        Flag.TIME_IRREGULAR,
        False,
        "The time of this frame does not follow that of the frame before.",
        "Check the camera's clock.",
    ),
    FlagInfo(
        Flag.SETTLED_BY_PRIOR,
        False,
        "Several positions explain the image; the one near the prior pose was taken.",
        "Show more of the mask if the mask may have moved by several fields.",
    ),
)


def info_of(flag: Flag) -> FlagInfo:
    """The row of a single flag."""
    return next(info for info in FLAGS if info.flag is flag)
