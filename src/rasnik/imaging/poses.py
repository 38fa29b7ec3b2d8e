"""Poses to simulate, in whatever form they are given."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np

from rasnik.imaging.projection import Projection, wrap_angle
from rasnik.instrument import System

__all__ = ["Truth", "check_on_mask", "parse_pose", "parse_poses"]

# A mask seen through one lens is turned by 180 degrees.
_USUAL_ORIENTATION = 4
_POSE_NAMES = ("x_um", "y_um", "theta_rad", "scale", "orientation")


@dataclass(frozen=True, eq=False)
class Truth:
    """The pose a frame was made with; conventions as for an analysed pose.

    For a pose given as an affine or projective `Projection`, scale, rotation and orientation
    are those of the nearest similarity.
    """

    x_um: float
    y_um: float
    scale: float
    theta_rad: float
    orientation: int
    projection: Projection = field(repr=False)

    def as_dict(self) -> dict[str, float | int]:
        """The five numbers of the pose by name."""
        return {
            "x_um": self.x_um,
            "y_um": self.y_um,
            "scale": self.scale,
            "theta_rad": self.theta_rad,
            "orientation": self.orientation,
        }

    def moved(self, x_um: float, y_um: float, theta_rad: float) -> Truth:
        """The pose after a displacement on the mask and a turn about the reference point."""
        c, s = math.cos(theta_rad), math.sin(theta_rad)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        move = np.array([[1, 0, x_um], [0, 1, y_um], [0, 0, 1.0]])
        return Truth(
            self.x_um + x_um,
            self.y_um + y_um,
            self.scale,
            wrap_angle(self.theta_rad + theta_rad),
            self.orientation,
            Projection(move @ self.projection.matrix @ turn),
        )


def parse_poses(system: System, poses: Any) -> list[Truth]:
    """All poses in full; one pose gives a list of one.

    Raises
    ------
    ValueError, TypeError
        As `rasnik.imaging.simulate.simulate`.
    """
    if _is_one_pose(poses):
        return [parse_pose(system, poses, "pose")]
    if isinstance(poses, str) or not isinstance(poses, Iterable):
        raise TypeError(f"poses must be a pose or a sequence of poses, not {poses!r}")
    truths = [parse_pose(system, pose, f"pose {k}") for k, pose in enumerate(poses)]
    if not truths:
        raise ValueError("poses is empty: give at least one pose, or None for random positions")
    return truths


def _is_one_pose(poses: Any) -> bool:
    if isinstance(poses, Projection | Mapping) or hasattr(poses, "x_um"):
        return True
    if isinstance(poses, np.ndarray):
        return poses.ndim == 1 and poses.dtype != object
    return (
        isinstance(poses, list | tuple)
        and len(poses) > 0
        and all(value is None or isinstance(value, Real) for value in poses)
    )


def parse_pose(system: System, pose: Any, label: str) -> Truth:
    """The pose in full; `label` names it in messages."""
    # A `Truth` and an analysed pose may hold more than a similarity.
    projection = pose if isinstance(pose, Projection) else getattr(pose, "projection", None)
    if isinstance(projection, Projection):
        known = getattr(pose, "orientation", None) or None
        x_um, y_um = projection.x_um, projection.y_um
        truth = Truth(x_um, y_um, *projection.similarity(known), projection)
    else:
        truth = _similarity_truth(system, _pose_values(pose, label), label)
    check_on_mask(system, truth, label)
    return truth


def check_on_mask(system: System, truth: Truth, label: str) -> None:
    """Refuse a pose whose reference point is not on the mask."""
    x0, x1, y0, y1 = system.mask.bounds_um
    if not (x0 <= truth.x_um <= x1 and y0 <= truth.y_um <= y1):
        raise ValueError(
            f"{label}: ({truth.x_um:g}, {truth.y_um:g}) um is not on the mask, which covers "
            f"x {x0:g}..{x1:g} um and y {y0:g}..{y1:g} um"
        )


def _pose_values(pose: Any, label: str) -> dict[str, Any]:
    """The values given, by name; None where left out."""
    if isinstance(pose, Mapping):
        for key in pose:
            if key not in _POSE_NAMES:
                near = difflib.get_close_matches(str(key), _POSE_NAMES, n=1)
                hint = f"; did you mean {near[0]}?" if near else ""
                raise ValueError(
                    f"{label}: unknown key {key!r}, a pose has {', '.join(_POSE_NAMES)}{hint}"
                )
        given = dict(pose)
    elif hasattr(pose, "x_um"):
        given = {name: getattr(pose, name, None) for name in _POSE_NAMES}
    else:
        try:
            values = list(pose)
        except TypeError:
            raise TypeError(f"{label}: {pose!r} is not a pose (x_um, y_um, ...)") from None
        if not 2 <= len(values) <= len(_POSE_NAMES):
            raise ValueError(
                f"{label}: a pose has 2 to {len(_POSE_NAMES)} values, {', '.join(_POSE_NAMES)}, "
                f"not {len(values)}"
            )
        given = dict(zip(_POSE_NAMES, values, strict=False))
    values_by_name = {name: given.get(name) for name in _POSE_NAMES}
    for name in ("x_um", "y_um"):
        if values_by_name[name] is None:
            raise ValueError(f"{label}: {name} is missing")
    return values_by_name


def _similarity_truth(system: System, values: Mapping[str, Any], label: str) -> Truth:
    optics = system.optics
    defaults = {
        "theta_rad": optics.theta_rad,
        "scale": optics.scale,
        "orientation": optics.orientation or _USUAL_ORIENTATION,
    }
    number: dict[str, float] = {}
    for name in _POSE_NAMES:
        value = defaults[name] if values[name] is None else values[name]
        try:
            number[name] = float(value)
        except (TypeError, ValueError):
            raise TypeError(f"{label}: {name} must be a number, not {value!r}") from None
        if not math.isfinite(number[name]):
            raise ValueError(f"{label}: {name} must be finite, not {number[name]}")
    if number["scale"] <= 0:
        raise ValueError(f"{label}: scale must be positive, not {number['scale']:g}")
    if number["orientation"] not in (1, 2, 3, 4):
        raise ValueError(f"{label}: orientation must be 1, 2, 3 or 4, not {values['orientation']}")
    pose = (number["x_um"], number["y_um"], number["scale"], number["theta_rad"])
    orientation = int(number["orientation"])
    return Truth(*pose, orientation, Projection.from_pose(*pose, orientation))
