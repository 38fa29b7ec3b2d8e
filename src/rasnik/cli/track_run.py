"""The loop of ``rasnik track``: frames are read ahead, tracked, and stored as they come."""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape

from rasnik.cli.common import fail, messages
from rasnik.cli.files import check_folder
from rasnik.cli.track_summary import Summary
from rasnik.cli.track_terminal import Interrupts, progress
from rasnik.io.analysed import frame_name
from rasnik.io.file_lock import FileLock
from rasnik.io.images import Frame, Source, expand_paths, iter_frames
from rasnik.io.read_ahead import read_ahead

if TYPE_CHECKING:
    from rasnik.instrument import System
    from rasnik.io.track_file import TrackWriter
    from rasnik.tracking.track import Track
    from rasnik.tracking.tracker import Tracker

__all__ = ["Options", "run_track"]

INTERRUPTED = 130  # 128 + SIGINT, as shells count

_NAMED_SOURCES = 10
#: Frames tracked at a time: at most as many as take this long, and this much memory.
_BLOCK_S = 0.4
_BLOCK_BYTES = 64 << 20
_MOST_FRAMES = 256
_STORED_ROWS = 65_536


@dataclass(frozen=True)
class Options:
    """How frames are tracked, and where the track goes."""

    system: System
    model: Literal["auto", "similarity", "affine", "projective"]
    threads: int
    frame_rate_hz: float | None
    times_s: NDArray[np.float64] | None
    file: Path | None
    resume: bool
    plot: Path | None
    json: bool

    def times(self, numbers: range) -> list[float]:
        """Times of frames in s; NaN where they are not known."""
        if self.times_s is not None:
            known = self.times_s[numbers.start : numbers.stop].tolist()
            return [*known, *[math.nan] * (len(numbers) - len(known))]
        rate_hz = self.frame_rate_hz or math.nan
        return [number / rate_hz for number in numbers]

    def metadata(self, frames: list[str]) -> dict[str, str]:
        """What a track says of its origin. All of it must be the same to continue it."""
        names = [os.path.abspath(name) for name in frames[:_NAMED_SOURCES]]
        if len(frames) > _NAMED_SOURCES:
            names = [names[0], "and others"]
        about = {"source": "; ".join(names), "model": self.model}
        if self.times_s is not None:
            about["times"] = f"a list, beginning with {self.times_s[0]:.17g} s"
        elif self.frame_rate_hz is not None:
            about["frame_rate_hz"] = repr(self.frame_rate_hz)
        return about


def run_track(frames: list[str], options: Options) -> int:
    """Track every frame of the images named; returns the status the command exits with."""
    sources = expand_paths(frames)
    if all(source.error for source in sources):
        fail(f"there are no images: {'; '.join(f'{s.name}: {s.error}' for s in sources)}.")
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # faults come out as errors
    run = _Run(options)
    try:
        interrupted = _track_all(run, frames, sources, options)
    except OSError as error:  # of the file of the track; those of frames are rows
        fail(f"{str(error).rstrip('.')}.")
    return _finish(run, options, interrupted)


def _track_all(run: _Run, frames: list[str], sources: list[Source], options: Options) -> bool:
    """Track all frames, or until Ctrl-C; returns whether it was that."""
    with ExitStack() as opened:
        stop = opened.enter_context(Interrupts())
        try:
            first = _prepare_file(frames, sources, options)
            stream = opened.enter_context(closing(read_ahead(iter_frames(sources, first))))
            head = _first_frames(stream, first)
            run.open(opened, frames, first)
            if head:
                if first:
                    messages().print(escape(f"{options.file} is continued at frame {first}"))
                bounds = next((f.bounds_px for f in head if f.image is not None), None)
                advance = opened.enter_context(progress(sources, first))
                run.track(chain(head, stream), bounds, first, stop, advance)
        except KeyboardInterrupt:
            return True
    return False


# ------------------------------------------------------------------------ before the first frame


def _prepare_file(frames: list[str], sources: list[Source], options: Options) -> int:
    """Number of the first frame to be tracked; what must not be lost is not touched."""
    path = options.file
    if path is None or not path.exists():
        if path is not None:
            check_folder(path)
        return 0
    if any(source.path.exists() and os.path.samefile(source.path, path) for source in sources):
        fail(f"{path} is one of the images and would be overwritten; name another file.")
    from rasnik.io import read_track

    try:
        stored = read_track(path, stop=0).metadata
    except (ValueError, OSError) as error:
        fail(f"{error}; it is neither continued nor overwritten, name another file.")
    if not options.resume:
        return 0
    for key, value in options.metadata(frames).items():
        # The source is compared, as the system is, when the file is opened.
        if key != "source" and stored.get(key, "") != value:
            fail(
                f"{path} cannot be continued: {key} is {stored.get(key) or 'not given'} in it, "
                f"{value} now. Give --overwrite, or name another file."
            )
    last = read_track(path, start=-1).frame
    return int(last[-1]) + 1 if len(last) else 0


def _first_frames(stream: Iterator[Frame], first: int) -> list[Frame]:
    """Frames up to the first that can be read; a run that has none ends here."""
    head: list[Frame] = []
    for frame in stream:
        head.append(frame)
        if frame.image is not None or len(head) == _MOST_FRAMES:
            return head
    if first == 0:
        why = head[0].error if head else "The files hold no frames."
        more = f" And {len(head) - 1} more." if len(head) > 1 else ""
        fail(f"no image can be read. {why}{more}")
    return head


# ------------------------------------------------------------------------ tracking


class _Run:
    """Tracker, file and summary of one run."""

    def __init__(self, options: Options) -> None:
        self._options = options
        self.summary = Summary()
        self.first = 0
        self.done = 0
        """Frames of this run."""
        self.frames_per_s = math.nan
        """Without the first block, in which the mask is found and compiled code is loaded."""
        self.blocks: list[Track] = []
        """Kept for the plot if there is no file to read them from again."""
        self._writer: TrackWriter | None = None

    def open(self, opened: ExitStack, frames: list[str], first: int) -> None:
        """Open the file, and count what is in it already."""
        from rasnik.io import TrackWriter

        options, self.first = self._options, first
        if options.file is None:
            return
        if not options.resume and options.file.exists():
            lock = FileLock(options.file)  # not while another program writes it
            options.file.unlink()
            lock.release()
        try:
            self._writer = opened.enter_context(
                TrackWriter(
                    options.file,
                    system=options.system,
                    metadata=options.metadata(frames),
                    resume=options.resume,
                )
            )
        except (ValueError, FileExistsError) as error:
            fail(f"{str(error).rstrip('.')}.")
        if first:
            self._count_stored()

    def _count_stored(self) -> None:
        """Take the rows of the file into the summary, piece by piece."""
        from rasnik.io import read_track

        assert self._options.file is not None
        row = 0
        while len(block := read_track(self._options.file, row, row + _STORED_ROWS)):
            self.summary.add(block)
            row += len(block)

    def track(
        self,
        frames: Iterator[Frame],
        bounds: tuple[int, int, int, int] | None,
        first: int,
        stop: Interrupts,
        advance: Callable[[int], None],
    ) -> None:
        from rasnik.tracking.tracker import Tracker

        options = self._options
        tracker = Tracker(
            options.system, model=options.model, bounds=bounds, threads=options.threads
        )
        number, size = first, 1
        last_s = time.monotonic()
        begun: tuple[int, float] | None = None
        while chunk := list(islice(frames, size)):
            numbers = range(number, number + len(chunk))
            images, reasons = _images(chunk, numbers, options.system)
            if begun is None and images[0] is not None:
                _compile(images[0], options.system)
            block = _track(tracker, images, options.times(numbers), numbers, reasons)
            with stop.held():
                if self._writer is not None:
                    self._writer.write(block)
                elif options.plot is not None:
                    self.blocks.append(block)
                self.summary.add(block, _named(block, chunk, reasons))
                self.done += len(chunk)
            advance(len(chunk))
            number = numbers.stop
            now_s = time.monotonic()
            size = _next_size(len(chunk), now_s - last_s, images)
            last_s = now_s
            if begun is None:
                begun = self.done, now_s
            else:
                self.frames_per_s = (self.done - begun[0]) / max(now_s - begun[1], 1e-9)


def _compile(image: NDArray[Any], system: System) -> None:
    """What the first start on a machine takes long for."""
    from rasnik.tracking import warm_up

    if not warm_up.is_compiled():
        messages().print("Compiling for this machine; only the first start has to.")
        warm_up.prepare(image, system)


def _images(
    chunk: list[Frame], numbers: range, system: System
) -> tuple[list[NDArray[Any] | None], dict[int, str]]:
    """Images of frames, None for those that cannot be used, and why they cannot."""
    images: list[NDArray[Any] | None] = []
    reasons: dict[int, str] = {}
    for number, frame in zip(numbers, chunk, strict=True):
        image = frame.image
        if image is None:
            reasons[number] = str(frame.error)
        elif image.shape != system.shape:
            height, width = image.shape
            reasons[number] = (
                f"{frame_name(frame)}: the image has {width} x {height} pixels, the system "
                f"{system.shape[1]} x {system.shape[0]}; change sensor.width_px, height_px or "
                "binning."
            )
            image = None
        images.append(image)
    return images, reasons


def _track(
    tracker: Tracker,
    images: list[NDArray[Any] | None],
    times: list[float],
    numbers: range,
    reasons: dict[int, str],
) -> Track:
    """Track some frames. A frame that cannot be tracked must not lose the others."""
    from rasnik.tracking.track import Track

    try:
        return Track.concatenate(tracker.blocks(images, times, numbers, size=len(images)))
    except Exception as error:
        if len(images) == 1:
            if images[0] is None:
                raise
            kind = "" if isinstance(error, ValueError) else f"unexpected {type(error).__name__}: "
            reasons[numbers[0]] = f"{kind}{str(error).rstrip('.')}."
            return _track(tracker, [None], times, numbers, reasons)
    return Track.concatenate(
        _track(tracker, images[k : k + 1], times[k : k + 1], numbers[k : k + 1], reasons)
        for k in range(len(images))
    )


def _next_size(frames: int, seconds: float, images: list[NDArray[Any] | None]) -> int:
    """How many frames to take next: progress and file are kept up to date, memory bounded."""
    fast_enough = int(frames * _BLOCK_S / max(seconds, 1e-6))
    frame_bytes = max((image.nbytes for image in images if image is not None), default=1)
    most = min(_MOST_FRAMES, max(1, _BLOCK_BYTES // frame_bytes))
    return min(most, 4 * frames, max(1, fast_enough))


def _named(block: Track, chunk: list[Frame], reasons: dict[int, str]) -> dict[int, str]:
    """Reasons of all failures, each with the name of the file."""
    from rasnik.analysis.flags import FLAGS

    named = dict(reasons)
    for row in np.flatnonzero(~block.ok):
        number, flags, name = int(block.frame[row]), int(block.flags[row]), frame_name(chunk[row])
        if number in named:
            if name not in named[number]:
                named[number] = f"{name}: {named[number]}"
            continue
        told = [f"{i.sentence} {i.remedy}" for i in FLAGS if i.fatal and flags & i.flag]
        named[number] = f"{name}: {told[0] if told else 'There is no position.'}"
    return named


# ------------------------------------------------------------------------ the end


def _finish(run: _Run, options: Options, interrupted: bool) -> int:
    """Show what came out; returns the exit status."""
    console, path = messages(), options.file
    nothing_new = not run.done and not interrupted
    rate = run.frames_per_s
    if options.plot is not None and not interrupted:
        _plot(run, options)
    if options.json:
        about = {
            **run.summary.as_dict(),
            "frames_per_s": rate if math.isfinite(rate) else None,
            "continued_at": run.first or None,
            "interrupted": interrupted,
            "file": None if path is None else str(path),
        }
        typer.echo(json.dumps(about))
    else:
        run.summary.print_table(rate)
    run.summary.print_failures()
    if options.times_s is not None and not interrupted:
        expected, found = len(options.times_s), run.summary.frames
        if expected != found:
            console.print(f"--times holds {expected} times for {found} frames")
    if interrupted:
        kept = f"after {run.summary.frames} frames" if run.done else "before the first frame"
        hint = "" if path is None else f"; the same command continues {path}"
        console.print(escape(f"interrupted {kept}{hint}"))
        return INTERRUPTED
    if nothing_new:
        console.print(escape(f"{path} holds all {run.summary.frames} frames; nothing to do"))
    elif path is not None:
        console.print(escape(f"track in {path}"))
    return 1 if run.summary.failed else 0


def _plot(run: _Run, options: Options) -> None:
    from rasnik.io import read_track
    from rasnik.report.track import plot_track
    from rasnik.tracking.track import Track

    assert options.plot is not None
    track = read_track(options.file) if options.file else Track.concatenate(run.blocks)
    if not len(track):
        return
    try:
        plot_track(track, options.plot, title=options.system.name)
    except OSError as error:
        fail(f"{options.plot} cannot be written: {error.strerror or error}.")
    messages().print(escape(f"plot in {options.plot}"))
