"""What becomes of a frame: its pose, on the way to whoever wants it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from rasnik.analysis.pose import Pose
from rasnik.cameras.camera import CameraFrame

__all__ = ["Sample", "Sink"]


@dataclass(frozen=True, eq=False)
class Sample:
    """A frame and its pose.

    Attributes
    ----------
    frame : CameraFrame
    number : int
        Frames since the channel began, those that were lost included: never repeats.
    pose : Pose
        Its flags tell of losses, too.
    """

    frame: CameraFrame
    number: int
    pose: Pose


class Sink(Protocol):
    """Takes samples, in the thread that makes them: it must be quick, and never raise."""

    def add(self, sample: Sample) -> None: ...
