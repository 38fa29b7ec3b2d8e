"""A frame from a file, and its pose or the sentence that says why there is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from rasnik.io.images import Frame

if TYPE_CHECKING:
    from rasnik.analysis.pose import Pose
    from rasnik.instrument import System

__all__ = ["AnalysisOptions", "analysed", "frame_name"]


@dataclass(frozen=True)
class AnalysisOptions:
    """How images are analysed: the instrument or the two sizes, and what `analyse` takes."""

    system: System | None
    field_um: float | None = None
    pixel_um: float | None = None
    method: Literal["likelihood", "fourier"] = "likelihood"
    model: Literal["auto", "similarity", "affine", "projective"] = "auto"
    orientation: int | None = None
    bounds: tuple[int, int, int, int] | None = None


def frame_name(frame: Frame) -> str:
    """File, and the index of the frame in it unless that is the first."""
    return f"{frame.file}[{frame.frame}]" if frame.frame else frame.file


def analysed(frame: Frame, options: AnalysisOptions) -> tuple[Pose | None, str | None]:
    """Pose of a frame, and the sentence that says why there is no position.

    Nothing that is wrong with a frame raises: it must not lose the others.

    Parameters
    ----------
    frame : Frame
    options : AnalysisOptions

    Returns
    -------
    pose : Pose or None
        None if the frame could not be analysed at all.
    error : str or None
        None if there is a position.
    """
    from rasnik.analysis.analyse import analyse

    name = frame_name(frame)
    if frame.image is None:
        return None, frame.error
    try:
        pose = analyse(
            frame.image,
            options.system,
            field_um=options.field_um,
            pixel_um=options.pixel_um,
            method=options.method,
            model=options.model,
            orientation=options.orientation,
            bounds=frame.clip_bounds(options.bounds),
        )
    except ValueError as error:
        return None, f"{name}: {str(error).rstrip('.')}."
    except Exception as error:
        kind = type(error).__name__
        return None, f"{name}: unexpected {kind} ({error}); please report it."
    return pose, None if pose.ok else f"{name}: {pose.error}"
