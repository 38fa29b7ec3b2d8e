"""The columns of a table of results: name, unit, meaning; defined once for every format.

A *record* is a mapping with these keys. Missing keys stand for what is not known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rasnik.analysis.flags import FLAGS, Flag

if TYPE_CHECKING:
    from rasnik.analysis.pose import Pose

__all__ = ["COLUMNS", "CONVENTIONS", "Column", "flag_value", "make_record"]

Kind = Literal["float", "int", "bool", "flags", "word", "text", "list"]

CONVENTIONS = (
    "x_um, y_um: mask coordinate (x right, y up on the mask, from the corner of the first pivot "
    "field) imaged on the centre of the sensor. scale: image size / mask size. theta_rad: rotation "
    "of the pattern, anticlockwise as seen on the image. orientation: 1 nominal, 2 mirrored "
    "left-right, 3 mirrored up-down, 4 turned by 180 degrees. sigma_*: one standard deviation "
    "from pixel noise."
)


@dataclass(frozen=True)
class Column:
    """One column: its kind says how it is stored, its unit and description what it means."""

    name: str
    kind: Kind
    unit: str
    description: str


COLUMNS: tuple[Column, ...] = (
    Column("file", "text", "", "file the image came from"),
    Column("frame", "int", "", "index of the image in its file, from 0"),
    Column("ok", "bool", "", "whether there is a position"),
    Column("flags", "flags", "", "conditions met, see the table of flags"),
    Column("error", "text", "", "why there is no position, and what to do"),
    Column("x_um", "float", "um", "mask x imaged on the sensor's centre"),
    Column("y_um", "float", "um", "mask y imaged on the sensor's centre"),
    Column("scale", "float", "", "image size / mask size"),
    Column("theta_rad", "float", "rad", "rotation, anticlockwise as seen on the image"),
    Column("orientation", "int", "", "orientation code 1..4, 0 if unknown"),
    Column("sigma_x_um", "float", "um", "standard deviation of x_um"),
    Column("sigma_y_um", "float", "um", "standard deviation of y_um"),
    Column("sigma_scale", "float", "", "standard deviation of scale"),
    Column("sigma_theta_rad", "float", "rad", "standard deviation of theta_rad"),
    Column("chi2_ndf", "float", "", "chi-square per degree of freedom"),
    Column("blur_um", "float", "um", "Gaussian sigma of the blur on the sensor, without the pixel"),
    Column("contrast", "float", "", "(light - dark) / (light + dark)"),
    Column("dark_level", "float", "grey", "grey level of black at the centre"),
    Column("light_level", "float", "grey", "grey level of white at the centre"),
    Column("edge_shift_um", "float", "um", "by how much black fields are larger, on the mask"),
    Column("scale_x", "float", "", "magnification along mask x"),
    Column("scale_y", "float", "", "magnification along mask y"),
    Column("polarity", "word", "", "positive, negative, or nothing if unknown"),
    Column("code_lines_read", "int", "", "code lines with a certain reading"),
    Column("code_lines_in_view", "int", "", "code lines in view"),
    Column("masked_fraction", "float", "", "fraction of the pixels left out"),
    Column("method", "word", "", "likelihood, fourier, lwdaq (read from its lines), or none"),
    Column("model", "word", "", "similarity, affine or projective"),
    Column("notes", "list", "", "what was done to the image on reading it"),
    Column("candidates", "list", "", "poses that explain an ambiguous image, best first"),
)

_BITS = {info.name: info.flag for info in FLAGS}


def flag_value(flags: Any) -> Flag:
    """`Flag` from itself, an integer, or a list of names (unknown names raise ValueError)."""
    if isinstance(flags, int | np.integer):
        return Flag(int(flags))
    value = Flag.NONE
    for name in flags.split() if isinstance(flags, str) else flags or ():
        if name not in _BITS:
            raise ValueError(f"{name!r} is not a flag; the flags are {', '.join(_BITS)}")
        value |= _BITS[name]
    return value


def make_record(
    file: str,
    frame: int = 0,
    pose: Pose | None = None,
    *,
    error: str | None = None,
    notes: tuple[str, ...] = (),
) -> dict[str, Any]:
    """The record of one image, in the order of `COLUMNS`.

    Parameters
    ----------
    file, frame
        Where the image came from.
    pose : Pose, optional
        Its analysis. None if there was none; `error` then says why.
    error : str, optional
        Takes the place of the pose's own error.
    notes : tuple of str
        Stored if there are any; so are the candidates of an ambiguous pose.
    """
    from rasnik.analysis.pose import Pose

    result = pose or Pose()
    values = {"file": file, "frame": frame, **result.as_dict()}
    values["error"] = error or (values["error"] if pose else "No result.")
    record = {c.name: plain(values[c.name]) for c in COLUMNS if c.name in values}
    for key in ("file", "error"):  # file names need not be valid text
        if record[key] is not None:
            record[key] = record[key].encode(errors="backslashreplace").decode()
    if notes:
        record["notes"] = list(notes)
    if result.candidates:
        record["candidates"] = [
            {key: plain(value) for key, value in vars(candidate).items()}
            for candidate in result.candidates
        ]
    return record


def plain(value: Any) -> Any:
    """A Python scalar in place of numpy's; NaN and infinities become None."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def check_record(record: Mapping[str, Any]) -> None:
    """Refuse keys that no column holds, which would be lost silently in a table.

    Raises
    ------
    ValueError
    """
    names = {column.name for column in COLUMNS}
    unknown = [key for key in record if key not in names]
    if unknown:
        raise ValueError(f"no column for {', '.join(unknown)}; the columns are in COLUMNS")
