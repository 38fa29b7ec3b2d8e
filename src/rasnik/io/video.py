"""Video files as stacks of grey images, decoded with FFmpeg through PyAV.

Grey levels are those that are stored. Of a grey video that is the whole picture, of a YUV one its
luma plane; neither is stretched to another range. Whether the codec or the range has altered
them is told in the notes of each frame.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from heapq import heappop, heappush
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.io.formats import EndOfStack, ImageFileError, Stack, from_channels

__all__ = ["open_video"]

Image = NDArray[Any]

_FULL_RANGE = 2  # AVCOL_RANGE_JPEG
#: Formats whose first plane is the picture as grey levels: grey, planar and half-planar YUV.
_LUMA_FIRST = re.compile(r"(gray|y?a(?=8|16)|ya|yuva?j?\d{3}p|nv\d\d)(\d*)(le|be)?")
#: Where luma begins in formats that interleave it with colour, two bytes to a pixel.
_LUMA_AT = {"yuyv422": 0, "yvyu422": 0, "uyvy422": 1}
#: Packets kept, at most, while waiting for the next key frame.
_LONGEST_GROUP = 512
#: Codecs of which some packets are, rightly, not shown.
_WITH_HIDDEN_FRAMES = ("vp8", "vp9", "av1")
_TRUNCATED = "the video is truncated after {} of about {} frames; copy it again"


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise ImageFileError(
            'video files are read with PyAV; install it with: pip install "rasnik[video]"'
        ) from error
    return av


@contextmanager
def open_video(path: Path) -> Iterator[Stack]:
    """Open a video as a stack of grey images, read one after the other.

    Frames are best read in order: what is skipped is not decoded where the codec allows it, and
    going back begins the file anew. `Stack.count` is what the header promises.

    Raises
    ------
    ImageFileError
        If PyAV is missing, or the file holds no video that can be read.
    """
    _av()
    video = _Video(path)
    try:
        yield Stack(video.expected, video.read, counted=False)
    finally:
        video.close()


class _Video:
    """An open file and the place it has been read to."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open()

    def _open(self) -> None:
        av = _av()
        try:
            self._container = av.open(str(self._path))
        except av.error.FFmpegError as error:
            raise ImageFileError(
                f"the video cannot be opened ({error.strerror}); it is damaged or was cut off, "
                "copy or record it again"
            ) from error
        if not self._container.streams.video:
            self._container.close()
            raise ImageFileError("there is no video in the file, only other streams")
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        # Rather no picture than one that the decoder has patched up. Few codecs can tell.
        self._stream.codec_context.options = {"err_detect": "crccheck+bitstream+buffer+explode"}
        self._next = 0
        self._packets = self._container.demux(self._stream)
        self._decoded: deque[Any] = deque()
        self._awaited: list[int] = []
        self._cut_off: set[int] = set()
        self._fault: Exception | None = None
        self._end_s = 0.0
        self.expected = self._count_expected()

    def close(self) -> None:
        self._container.close()

    def _count_expected(self) -> int:
        """Frames according to the header: its count, or its duration times the rate."""
        if self._stream.frames:
            return int(self._stream.frames)
        rate, duration = self._stream.average_rate, self._container.duration
        return max(1, round(float(rate) * duration * 1e-6)) if rate and duration else 1

    def read(self, index: int) -> tuple[Image, tuple[str, ...]]:
        if index < self._next:
            self.close()
            self._open()
        self._skip(index - self._next)
        while self._next <= index:
            frame = self._take()
            self._next += 1
        if isinstance(frame, Exception):
            raise ImageFileError(f"the frame cannot be decoded ({frame}); record it again")
        notes = _codec_notes(self._stream.codec_context.codec)
        if frame.interlaced_frame:
            notes += ("interlaced: even and odd rows are from different times",)
        image, more = _grey_levels(frame)
        return image, notes + more

    # -------------------------------------------------------------------- packets and frames

    def _skip(self, count: int) -> None:
        """Pass over frames, without decoding those on which none of the wanted ones depends.

        These are all before the last key frame. Those between it and the frame wanted go to
        the decoder, and `read` drops them.
        """
        if self._decoded or self._stream.codec_context.has_b_frames:
            return
        held: list[Any] = []
        while len(held) < min(count, _LONGEST_GROUP):
            packet = next(self._packets, None)
            if packet is None:
                break
            if packet.is_keyframe:
                self._next += len(held)
                count -= len(held)
                held = []
            held.append(packet)
            if packet.size == 0:  # stands for the end, and makes the decoder hand out what it has
                break
        for packet in held:
            self._decode(packet)

    def _take(self) -> Any:
        """The next frame, or the error in its place."""
        while not self._decoded:
            packet = next(self._packets, None)
            if packet is not None:
                self._decode(packet)
            elif self._awaited:
                self._arrived(None)
            else:
                raise EndOfStack(self._next, self._missing())
        return self._decoded.popleft()

    def _decode(self, packet: Any) -> None:
        time = packet.dts if packet.pts is None else packet.pts
        if time is not None:
            end = (time + (packet.duration or 0)) * packet.time_base
            self._end_s = max(self._end_s, float(end))
            if packet.is_corrupt:
                self._cut_off.add(time)
            if self._stream.codec_context.name not in _WITH_HIDDEN_FRAMES and not packet.is_discard:
                heappush(self._awaited, time)
        try:
            for frame in packet.decode():
                self._arrived(frame)
        except _av().error.FFmpegError as error:
            self._fault = error

    def _arrived(self, frame: Any) -> None:
        """Queue a decoded frame, or None for the end, after the errors of those before it.

        Decoders pass over what they cannot make a picture of, at once or some frames late. A
        packet whose time never comes out again was lost; the frames after it keep their numbers.
        """
        time = None if frame is None else frame.dts if frame.pts is None else frame.pts
        while self._awaited and (frame is None or (time is not None and self._awaited[0] < time)):
            heappop(self._awaited)
            self._decoded.append(self._fault or ValueError("no picture comes of its data"))
            self._fault = None
        if self._awaited and self._awaited[0] == time:
            heappop(self._awaited)
        if frame is not None:
            cut_off = time in self._cut_off or frame.is_corrupt
            self._decoded.append(ValueError("its data are cut off") if cut_off else frame)

    def _missing(self) -> str | None:
        """What is to be said if the file ends before the header says it does.

        Matroska does not count frames, but knows when the last one ends.
        """
        short = self._next < self._stream.frames
        if "matroska" in self._container.format.name and len(self._container.streams) == 1:
            rate = float(self._stream.average_rate or 1)
            short = self._end_s < (self._container.duration or 0) * 1e-6 - 1.5 / rate
        return _TRUNCATED.format(self._next, self.expected) if short else None


# ------------------------------------------------------------------------ grey levels


def _codec_notes(codec: Any) -> tuple[str, ...]:
    if not codec.lossy:
        return ()
    has = "may have" if codec.lossless else "has"
    return (f"{codec.name} compression {has} altered the grey levels",)


def _grey_levels(frame: Any) -> tuple[Image, tuple[str, ...]]:
    """Grey image of a decoded frame, levels as stored, and notes on it."""
    name = frame.format.name
    if name in _LUMA_AT:
        luma = _plane(frame, np.dtype(np.uint8), 2 * frame.width)[:, _LUMA_AT[name] :: 2]
        return np.ascontiguousarray(luma), (_luma_note(frame),)
    if _LUMA_FIRST.fullmatch(name):
        return _first_plane(frame)
    if frame.format.is_rgb or frame.format.has_palette or name in ("monob", "monow"):
        deep = max(component.bits for component in frame.format.components) > 8
        return from_channels(frame.to_ndarray(format="rgb48le" if deep else "rgb24"))
    raise ImageFileError(
        f"pixels in the format {name} are not read; convert the video to grey, as with: "
        "ffmpeg -i IN -c:v ffv1 -pix_fmt gray OUT.mkv"
    )


def _first_plane(frame: Any) -> tuple[Image, tuple[str, ...]]:
    name, bits = frame.format.name, frame.format.components[0].bits
    dtype: np.dtype[Any] = np.dtype("u1" if bits <= 8 else ">u2" if name.endswith("be") else "<u2")
    samples = 2 if name.startswith("ya") else 1  # grey with transparency beside it
    levels = _plane(frame, dtype, samples * frame.width)[:, ::samples]
    notes = () if name.startswith(("gray", "ya")) else (_luma_note(frame),)
    return np.array(levels, dtype=dtype.newbyteorder("="), order="C"), notes


def _plane(frame: Any, dtype: np.dtype[Any], columns: int) -> Image:
    """The first plane without the bytes that fill up its rows; a view of the frame."""
    plane = frame.planes[0]
    row_bytes = plane.line_size
    if row_bytes < columns * dtype.itemsize:  # negative: stored from the bottom up
        raise ImageFileError(
            f"pixels in the format {frame.format.name} are stored in a way not read here; "
            "convert the video, as with: ffmpeg -i IN -c:v ffv1 OUT.mkv"
        )
    rows = np.frombuffer(plane, np.uint8)[: row_bytes * frame.height]
    rows = rows.reshape(frame.height, row_bytes)[:, : columns * dtype.itemsize]
    return np.ascontiguousarray(rows).view(dtype)


def _luma_note(frame: Any) -> str:
    note = f"luma of {frame.format.name} as stored, colour ignored"
    if frame.color_range == _FULL_RANGE or frame.format.name.startswith("yuvj"):
        return note
    scale = 1 << (frame.format.components[0].bits - 8)
    return f"{note}; levels in limited range ({16 * scale} to {235 * scale}) unless recorded full"
