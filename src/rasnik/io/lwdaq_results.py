"""Lines of results as the Rasnik instrument of LWDAQ prints them.

A line is a name, then numbers with blanks between; see `LWDAQ_FIELDS`. Older versions have the
code of the reference point before its place, and neither skew nor slant. A failure is the line
``ERROR: `` and a sentence.

LWDAQ and this package agree on the origin of the mask, the axes, the orientation codes, the
sense of the rotation, and the reference point where LWDAQ uses the centre of the sensor (its
code 2): w/2 pixels from the left edge of the first pixel is (w - 1)/2 from its centre. What
does not map:

* LWDAQ has two magnifications, a slant and two skews. They are taken from, and give, the map
  from sensor to mask; a skew is taken to first order. The scale of a pose is the square root of
  their product and the cosine of the slant.
* LWDAQ states one error of the position, in um on the mask, without saying for which axis. Read,
  it becomes both sigmas; written, it is their root mean square. It is LWDAQ's own estimate, and
  small beside its systematic errors.
* There is no error of scale and rotation, no chi-square, blur or contrast, no time: read, they
  are not known.
* Rotation is within a quarter turn; beyond, it is the other orientation of the same handedness.

Source: string_from_rasnik, rasnik_from_string and rasnik_from_pattern in rasnik.pas, i_from_p
and p_from_i in transforms.pas, and Rasnik.tcl, of https://github.com/OSI-INC/LWDAQ.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.pose import Pose
from rasnik.imaging.projection import ORIENTATIONS, Projection
from rasnik.io.columns import make_record
from rasnik.io.line_file import LineFile

__all__ = ["LWDAQ_FIELDS", "LwdaqResult", "LwdaqWriter", "parse_lwdaq_line", "read_lwdaq_results"]

#: Number in a line, decimals that LWDAQ writes.
LWDAQ_FIELDS: tuple[tuple[str, int], ...] = (
    ("x_um", 2),
    ("y_um", 2),
    ("magnification_x", 6),
    ("magnification_y", 6),
    ("rotation_mrad", 3),
    ("error_um", 3),
    ("square_um", 1),
    ("pixel_um", 1),
    ("orientation", 0),
    ("reference_x_um", 1),
    ("reference_y_um", 1),
    ("skew_x_rad_per_m", 3),
    ("skew_y_rad_per_m", 3),
    ("slant_mrad", 3),
)
_ORIENTATION = 8
_OLD_REFERENCE_CODE = 9
_NUMBERS = len(LWDAQ_FIELDS)
_OLD_NUMBERS = _NUMBERS - 3 + 1
#: LWDAQ's two decimals of a micrometre are coarser than what an image gives; it reads more.
_MORE_DECIMALS = 3
_ERROR = re.compile(r"(?:^|\s)ERROR: *(.*)", re.DOTALL)


@dataclass(frozen=True)
class LwdaqResult:
    """The numbers of one line.

    Attributes
    ----------
    x_um, y_um : float
        Mask coordinates of the point imaged on the reference point.
    magnification_x, magnification_y : float
        Image size / mask size along the columns and rows of the image.
    rotation_mrad : float
        Of the pattern, anticlockwise as seen on the image.
    error_um : float
        LWDAQ's estimate of its precision, on the mask.
    square_um, pixel_um : float
        Field of the mask and pixel of the sensor, as given to the analysis.
    orientation : int
        1..4 as in this package.
    reference_x_um, reference_y_um : float
        From the left edge of the first column and the upper edge of the first row.
    skew_x_rad_per_m, skew_y_rad_per_m : float
        By how much the scale on the mask changes along the image, relatively.
    slant_mrad : float
        By how much the axes of the pattern include less than a right angle in the image.
    """

    x_um: float
    y_um: float
    magnification_x: float
    magnification_y: float
    rotation_mrad: float
    error_um: float
    square_um: float
    pixel_um: float
    orientation: int
    reference_x_um: float
    reference_y_um: float
    skew_x_rad_per_m: float = 0.0
    skew_y_rad_per_m: float = 0.0
    slant_mrad: float = 0.0

    @classmethod
    def from_pose(
        cls, pose: Pose, *, square_um: float, pixel_um: float, shape: tuple[int, int]
    ) -> LwdaqResult:
        """The result that says what a pose says.

        Parameters
        ----------
        pose : Pose
            With a position.
        square_um, pixel_um : float
            Field of the mask, and pitch of the image's pixels.
        shape : tuple of int
            (height, width) of the image in pixels.

        Raises
        ------
        ValueError
            If the pose has no position.
        """
        if not pose.ok:
            raise ValueError("a pose without a position is no result of LWDAQ")
        projection = pose.projection or Projection.from_pose(
            pose.x_um, pose.y_um, pose.scale, pose.theta_rad, pose.orientation
        )
        magnifications, slant_rad, theta_rad, orientation = _decomposed(projection)
        sigmas_um = np.array([pose.sigma_x_um, pose.sigma_y_um])
        height, width = shape
        return cls(
            x_um=pose.x_um,
            y_um=pose.y_um,
            magnification_x=magnifications[0],
            magnification_y=magnifications[1],
            rotation_mrad=1e3 * theta_rad,
            error_um=float(np.sqrt(np.mean(sigmas_um**2))),
            square_um=square_um,
            pixel_um=pixel_um,
            orientation=orientation,
            reference_x_um=width / 2 * pixel_um,
            reference_y_um=height / 2 * pixel_um,
            skew_x_rad_per_m=1e6 * float(projection.matrix[2, 0]),
            skew_y_rad_per_m=1e6 * float(projection.matrix[2, 1]),
            slant_mrad=1e3 * slant_rad,
        )

    def projection(self) -> Projection:
        """The map from the sensor, its origin the reference point of this result, to the mask."""
        dx, dy = ORIENTATIONS[self.orientation]
        magnified = np.diag([1 / self.magnification_x, 1 / self.magnification_y])
        slanted = np.linalg.inv(_slant_matrix(1e-3 * self.slant_mrad))
        turned = _rotation_matrix(1e-3 * self.rotation_mrad)
        jacobian = np.diag([dx, dy]) @ turned @ magnified @ slanted
        position = np.array([self.x_um, self.y_um])
        skew = 1e-6 * np.array([self.skew_x_rad_per_m, self.skew_y_rad_per_m])
        matrix = np.eye(3)
        matrix[:2, :2] = jacobian + np.outer(position, skew)
        matrix[:2, 2], matrix[2, :2] = position, skew
        return Projection(matrix)

    def pose(self, shape: tuple[int, int] | None = None) -> Pose:
        """The pose that this result stands for.

        Parameters
        ----------
        shape : tuple of int, optional
            (height, width) of the image in pixels: the position is carried to its centre.
            Otherwise the pose is that of this result's own reference point, which by default
            of LWDAQ is the centre.
        """
        projection = self.projection()
        if shape is not None:
            to_centre = np.eye(3)
            to_centre[0, 2] = shape[1] / 2 * self.pixel_um - self.reference_x_um
            to_centre[1, 2] = shape[0] / 2 * self.pixel_um - self.reference_y_um
            projection = Projection(projection.matrix @ to_centre)
        scale, theta_rad, orientation = projection.similarity(self.orientation)
        covariance = np.full((4, 4), np.nan)
        covariance[:2, :2] = np.diag([self.error_um**2] * 2)
        is_even = math.isclose(self.magnification_x, self.magnification_y, rel_tol=1e-9)
        model = "similarity" if is_even and abs(self.slant_mrad) < 1e-6 else "affine"
        return Pose(
            ok=True,
            x_um=projection.x_um,
            y_um=projection.y_um,
            scale=scale,
            theta_rad=theta_rad,
            orientation=orientation,
            covariance=covariance,
            projection=projection,
            method="lwdaq",
            model=model if projection.is_affine else "projective",
        )

    def text(self, more_decimals: int = 0) -> str:
        """The numbers as LWDAQ writes them, or with so many decimals more."""
        words = []
        for name, decimals in LWDAQ_FIELDS:
            digits = decimals + more_decimals if decimals else 0
            words.append(f"{round(getattr(self, name), digits) + 0.0:.{digits}f}")  # no -0.000
        return " ".join(words)


def _rotation_matrix(angle_rad: float) -> NDArray[np.float64]:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def _slant_matrix(slant_rad: float) -> NDArray[np.float64]:
    """Both axes drawn towards each other by half the slant, as LWDAQ has it."""
    c, s = math.cos(slant_rad / 2), math.sin(slant_rad / 2)
    return np.array([[c, s], [s, c]])


def _decomposed(projection: Projection) -> tuple[tuple[float, float], float, float, int]:
    """(magnifications, slant, rotation, orientation) of a map at its origin.

    With K the slant, D the magnifications and R the rotation, LWDAQ's pattern lies in the image
    as K D R'. So K D (K D)' does not know of the rotation, and its trace, its difference of
    diagonal elements and its other element give slant and magnifications.
    """
    orientation = projection.similarity()[2]
    unfolded = np.diag(ORIENTATIONS[orientation]) @ projection.jacobian
    drawn = np.linalg.inv(unfolded)
    squares = drawn @ drawn.T
    trace = float(np.trace(squares))
    slant_rad = math.asin(2 * squares[0, 1] / trace)
    difference = float(squares[0, 0] - squares[1, 1]) / math.cos(slant_rad)
    first, second = math.sqrt((trace + difference) / 2), math.sqrt((trace - difference) / 2)
    turned = unfolded @ _slant_matrix(slant_rad) @ np.diag([first, second])
    theta_rad = math.atan2(turned[1, 0], turned[0, 0])
    if abs(theta_rad) > math.pi / 2:  # as far as the slant takes a quarter turn beyond
        theta_rad -= math.copysign(math.pi, theta_rad)
        orientation = 5 - orientation
    return (first, second), slant_rad, theta_rad, orientation


# ------------------------------------------------------------------------ reading


def parse_lwdaq_line(line: str) -> tuple[str, LwdaqResult | str]:
    """Name and result of a line; in place of the result the sentence of an error.

    Parameters
    ----------
    line : str
        A name, or names and a time, or nothing; then the numbers, or ``ERROR:`` and a sentence.

    Returns
    -------
    name : str
        All that stands before the numbers.
    result : LwdaqResult or str

    Raises
    ------
    ValueError
        If it is neither.
    """
    if failed := _ERROR.search(line):
        return line[: failed.start()].strip(), failed[1].strip() or "LWDAQ gave no reason."
    words = line.split()
    for count in (_NUMBERS, _OLD_NUMBERS):
        result = _from_words(words[-count:]) if len(words) >= count else None
        if result is not None:
            return " ".join(words[:-count]), result
    raise ValueError(
        f"this is no line of results of LWDAQ's Rasnik instrument, which ends in {_NUMBERS} "
        f"numbers ({_OLD_NUMBERS} in older versions): {line.strip()[:80]!r}"
    )


def _from_words(words: list[str]) -> LwdaqResult | None:
    """The result in so many words, or None if the words are not one."""
    if not re.fullmatch("[1-4]", words[_ORIENTATION]):
        return None
    if len(words) == _OLD_NUMBERS:
        if not re.fullmatch("[0-3]", words[_OLD_REFERENCE_CODE]):
            return None
        words = [*words[:_OLD_REFERENCE_CODE], *words[_OLD_REFERENCE_CODE + 1 :]]
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return None
    values: dict[str, Any] = dict(zip((name for name, _ in LWDAQ_FIELDS), numbers, strict=False))
    values["orientation"] = int(values["orientation"])
    result = LwdaqResult(**values)
    sizes = (result.magnification_x, result.magnification_y, result.square_um, result.pixel_um)
    known = all(math.isfinite(getattr(result, name)) for name in values if name != "error_um")
    return result if known and min(sizes) > 0 and abs(result.slant_mrad) < 1570 else None


def read_lwdaq_results(path: str | os.PathLike[str]) -> Iterator[dict[str, Any]]:
    """Records of a text file with lines of results; see `rasnik.io.columns.COLUMNS`.

    ``file`` is the name in the line, or that of the text file, ``frame`` then the number of the
    line from 0. Field, pixel and reference point stand in ``notes``. A line that is no result
    gives a record with an error; empty lines are passed over.

    Parameters
    ----------
    path : path-like

    Yields
    ------
    dict

    Raises
    ------
    ValueError
        If no line of the file is a result.
    OSError
        If the file cannot be read.
    """
    path, understood = Path(path), False
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file):
            if not line.strip():
                continue
            try:
                name, result = parse_lwdaq_line(line)
                understood = True
            except ValueError as error:
                name, result = "", f"{path}: line {number + 1}: {error}."
            yield _record(name, result, path, number)
    if not understood:
        raise ValueError(f"{path}: no line of this file is a result of LWDAQ's Rasnik instrument")


def _record(name: str, result: LwdaqResult | str, path: Path, number: int) -> dict[str, Any]:
    if isinstance(result, str):
        # In our own lines the name of the file stands before the reason.
        before, colon, after = result.partition(": ")
        if not name and colon and " " not in before:
            name, result = before, after
        return make_record(name or str(path), 0 if name else number, error=result)
    notes = (
        f"field {result.square_um:g} um, pixel {result.pixel_um:g} um",
        f"reference point {result.reference_x_um:g},{result.reference_y_um:g} um from the corner",
    )
    frame = 0 if name else number
    return make_record(name or str(path), frame, result.pose(), notes=notes)


# ------------------------------------------------------------------------ writing


class LwdaqWriter(LineFile):
    """Writes lines of results, each handed to the system at once; a context manager.

    Numbers have three decimals more than LWDAQ writes. It reads them.

    Parameters
    ----------
    target : path-like or open text file
    square_um, pixel_um : float
        Field of the mask, and pitch of the images' pixels.
    """

    def __init__(
        self, target: str | os.PathLike[str] | TextIO, *, square_um: float, pixel_um: float
    ) -> None:
        super().__init__(target)
        self._sizes = {"square_um": square_um, "pixel_um": pixel_um}

    def write(self, name: str, pose: Pose | None, shape: tuple[int, int], error: str = "") -> None:
        """Write one line.

        Parameters
        ----------
        name : str
            Of the image. Blanks become underscores.
        pose : Pose or None
        shape : tuple of int
            (height, width) of the image in pixels.
        error : str
            Why there is no position, if there is none; a sentence.
        """
        name = re.sub(r"\s+", "_", name.strip())
        if pose is not None and pose.ok:
            result = LwdaqResult.from_pose(pose, shape=shape, **self._sizes)
            self.put(f"{name} {result.text(_MORE_DECIMALS)}\n")
        else:
            reason = " ".join((error or (pose.error if pose else None) or "No result.").split())
            prefix = "" if reason.startswith(f"{name}: ") else f"{name}: "
            self.put(f"ERROR: {prefix}{reason}\n")
