"""Frames of a recording, as if a camera took them."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Generator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.cameras.camera import (
    Camera,
    CameraFrame,
    CameraLostError,
    CameraMissingError,
    CameraSettings,
    SettingRefusedError,
    SourceEndedError,
)
from rasnik.io.images import Frame, Source, expand_paths, iter_frames
from rasnik.io.read_ahead import read_ahead

__all__ = ["ReplayCamera"]

_NAMED = 3


class ReplayCamera(Camera):
    """Images of files, folders, stacks and videos, in order.

    A frame that cannot be read keeps its number and is left out, so that it shows as a gap;
    `counters` counts it as "unreadable", and `last_error` says what is wrong with it.

    Parameters
    ----------
    sources : sequence of str
        Files, folders and patterns, as for `rasnik.io.images.iter_frames`.
    pace : {"original", "full"}
        At the frame rate, or as fast as frames are asked for.
    repeat : bool
        From the beginning again at the end; numbers and times go on.
    frame_rate_hz : float, optional
        Of the recording. Needed for the original pace; gives the times of frames.
    bit_depth : int
        Of the camera that took the images; a brighter one is unreadable.
    settings : CameraSettings, optional
        Refused at opening if they ask for what a recording cannot do.

    Raises
    ------
    ValueError
        If `pace` is neither.
    """

    def __init__(
        self,
        sources: Sequence[str],
        *,
        pace: str = "original",
        repeat: bool = False,
        frame_rate_hz: float | None = None,
        bit_depth: int = 16,
        settings: CameraSettings | None = None,
    ) -> None:
        if pace not in ("original", "full"):
            raise ValueError(f"the pace of a recording is original or full, not {pace!r}")
        self.live = pace == "original"
        self.last_error = ""
        self._names = list(sources)
        named = ", ".join(self._names[:_NAMED])
        self.name = f"replay of {named}{', ...' if len(self._names) > _NAMED else ''}"
        self._repeat, self._bit_depth = repeat, bit_depth
        self._asked = settings or CameraSettings()
        self._rate_hz = frame_rate_hz
        self._changed = threading.Condition()
        self._frames: Generator[Frame, None, None] | None = None
        self._waiting: tuple[NDArray[Any], int] | None = None
        self._index = self._readable = self._unreadable = 0
        self._start_s, self._start_index = 0.0, 0
        self._sources: list[Source] = []

    def open(self) -> None:
        self._check(self._asked)
        if self.live and not self._rate_hz:
            raise SettingRefusedError(
                "the original pace of the recording is not known: give frame_rate_hz, or the "
                'pace "full".'
            )
        self.close()
        self._sources = expand_paths(self._names)
        faults = [f"{s.name}: {s.error}" for s in self._sources if s.error]
        faults += [
            f"{s.name}: there is no such file or folder"
            for s in self._sources
            if not s.error and s.url is None and not s.path.exists()
        ]
        if faults or not self._sources:
            raise CameraMissingError(
                f"the recording cannot be replayed: {'; '.join(faults) or 'no source is named'}."
            )
        self._frames = read_ahead(iter_frames(self._sources))
        self._waiting, self._index, self._readable = None, 0, 0
        try:
            self._fetch()
        except SourceEndedError:
            self.close()
            raise CameraMissingError(
                "the recording holds no image that can be read. "
                f"{self.last_error or 'It is empty.'}"
            ) from None
        self._pace_from_here()

    def close(self) -> None:
        with self._changed:
            frames, self._frames = self._frames, None
            self._changed.notify_all()
        if frames is not None:
            try:
                frames.close()
            except ValueError:
                pass  # it is being read, and ends when the reader lets go of it

    def read(self, timeout_s: float) -> CameraFrame | None:
        end_s = time.perf_counter() + timeout_s
        if self._frames is None:
            raise CameraLostError(f"the {self.name} is not open.")
        image, index = self._fetch()
        if not self._wait_until_due(index, end_s):
            return None
        self._waiting = None
        now_s = time.perf_counter()
        return CameraFrame(
            image=image,
            number=index + 1,
            host_time_s=time.time(),
            received_s=now_s,
            # Not from zero on, which cameras without a clock give.
            device_time_s=(index + 1) / self._rate_hz if self._rate_hz else math.nan,
        )

    @property
    def settings(self) -> CameraSettings:
        return CameraSettings(frame_rate_hz=self._rate_hz)

    def change(self, settings: CameraSettings) -> CameraSettings:
        self._check(settings)
        if settings.frame_rate_hz is not None:
            raise SettingRefusedError("the frame rate of a recording cannot be changed.")
        return self.settings

    def counters(self) -> dict[str, int]:
        """ "unreadable": frames of the recording that could not be read."""
        return {"unreadable": self._unreadable}

    def _check(self, settings: CameraSettings) -> None:
        """Refuse what only a camera can do."""
        names = sorted(set(settings.changed()) - {"frame_rate_hz"})
        if names:
            raise SettingRefusedError(f"a recording has no {names[0]} that could be set.")

    def _fetch(self) -> tuple[NDArray[Any], int]:
        """The next frame that can be read, and its index; the same until it is taken."""
        while self._waiting is None:
            frames = self._frames
            if frames is None:
                raise CameraLostError(f"the {self.name} was closed.")
            frame = next(frames, None)
            if frame is None:
                self._begin_again()
                continue
            try:
                self._waiting = _as_taken(frame, self._bit_depth), self._index
                self._readable += 1
            except ValueError as error:
                self._unreadable += 1
                self.last_error = str(error)
            self._index += 1
        return self._waiting

    def _begin_again(self) -> None:
        with self._changed:
            # Without a readable frame it would go round for ever.
            if self._frames is None or not self._repeat or not self._readable:
                raise SourceEndedError(f"the {self.name} is at its end.")
            self._frames = read_ahead(iter_frames(self._sources))
            self._readable = 0

    def _pace_from_here(self) -> None:
        self._start_s, self._start_index = time.perf_counter(), self._index - 1

    def _wait_until_due(self, index: int, end_s: float) -> bool:
        if not self.live or not self._rate_hz:
            return True
        due_s = self._start_s + (index - self._start_index) / self._rate_hz
        with self._changed:
            while (now_s := time.perf_counter()) < due_s:
                if now_s >= end_s:
                    return False
                if self._frames is None:
                    raise CameraLostError(f"the {self.name} was closed.")
                self._changed.wait(min(due_s, end_s) - now_s)
        return True


def _as_taken(frame: Frame, bit_depth: int) -> NDArray[Any]:
    """The image as a camera hands it out: uint8 or uint16.

    Raises
    ------
    ValueError
        With a sentence, if it could not be read or no camera of this depth took it.
    """
    if frame.image is None:
        raise ValueError(frame.error or f"{frame.file}: there is no image.")
    image = frame.image
    if image.dtype == np.uint8 and bit_depth >= 8:
        return image
    lowest, highest = float(image.min()), float(image.max())
    if not (lowest >= 0 and highest <= 2**bit_depth - 1):
        raise ValueError(
            f"{frame.file}: grey levels from {lowest:g} to {highest:g} are not those of "
            f"{bit_depth} bits; change sensor.bit_depth of the system."
        )
    if image.dtype.kind == "f":
        if highest <= 1:
            raise ValueError(
                f"{frame.file}: grey levels from {lowest:g} to {highest:g} are not those of a "
                "camera; save the image with whole grey levels."
            )
        image = np.rint(image)  # the luminance of colours is not whole
    return image.astype(np.uint8 if bit_depth <= 8 else np.uint16)
