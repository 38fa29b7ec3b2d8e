"""Following a mask from frame to frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import islice
from typing import Any, Literal

from numpy.typing import NDArray

from rasnik.analysis.analyse import analyse
from rasnik.analysis.flags import Flag
from rasnik.analysis.frame import Bounds, resolve_instrument
from rasnik.analysis.parameters import Model
from rasnik.analysis.pose import Pose
from rasnik.instrument import System
from rasnik.tracking.track import Track

__all__ = ["Tracker"]


class Tracker:
    """Follow a mask from frame to frame.

    Parameters
    ----------
    system, field_um, pixel_um, model, orientation, bounds
        As for `rasnik.analyse`.
    prior : Pose, optional
        Where to begin, from an earlier track of the same mask.
    threads : int, optional
        Number of frames worked on at a time by `run` and `blocks`.
    """

    def __init__(
        self,
        system: System | str | None = None,
        *,
        field_um: float | None = None,
        pixel_um: float | None = None,
        model: Model | Literal["auto"] = "auto",
        orientation: int | None = None,
        bounds: Bounds | None = None,
        prior: Pose | None = None,
        threads: int = 1,
    ) -> None:
        _, _, self.system = resolve_instrument(system, field_um, pixel_um)
        self._options: dict[str, Any] = {
            "system": self.system, "field_um": field_um, "pixel_um": pixel_um,
            "model": model, "orientation": orientation, "bounds": bounds,
        }  # fmt: skip
        self._last = prior

    def update(
        self, frame: NDArray[Any] | None, t: float | None = None, number: int | None = None
    ) -> Pose:
        """The pose in the next frame."""
        if frame is None:
            return Pose(flags=Flag.NO_IMAGE)
        pose = analyse(frame, prior=self._last, **self._options)
        if pose.ok:
            if self._last is None:
                pose = replace(pose, flags=pose.flags | Flag.COLD_START)
            self._last = pose
        return pose

    def blocks(
        self,
        frames: Iterable[NDArray[Any] | None],
        times: Iterable[float] | None = None,
        numbers: Iterable[int] | None = None,
        size: int = 256,
    ) -> Iterator[Track]:
        """Track a stream of any length, piece by piece."""
        frames = iter(frames)
        times_, numbers_ = iter(times or ()), iter(numbers or ())
        done = 0
        while chunk := list(islice(frames, size)):
            n = len(chunk)
            number = (
                list(islice(numbers_, n)) if numbers is not None else list(range(done, done + n))
            )
            time = list(islice(times_, n)) if times is not None else [float("nan")] * n
            done += n
            yield Track.from_poses(map(self.update, chunk, time, number), number, time)

    def run(
        self,
        frames: Iterable[NDArray[Any] | None],
        times: Iterable[float] | None = None,
        numbers: Iterable[int] | None = None,
        progress: Callable[[int], object] | None = None,
    ) -> Track:
        """Track all frames."""
        blocks = []
        for block in self.blocks(frames, times, numbers):
            blocks.append(block)
            if progress is not None:
                progress(len(block))
        return Track.concatenate(blocks)
