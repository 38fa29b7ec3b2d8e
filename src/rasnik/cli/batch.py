"""The loop of ``rasnik analyse``: frame by frame to poses, and where they go."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from rich.markup import escape

from rasnik.cli.common import fail, messages, output
from rasnik.cli.files import check_folder
from rasnik.io.analysed import AnalysisOptions, analysed, frame_name
from rasnik.io.images import Frame, Source, count_frames, expand_paths, iter_frames

if TYPE_CHECKING:
    from rasnik.analysis.pose import Pose
    from rasnik.instrument import System
    from rasnik.io.lwdaq_results import LwdaqWriter
    from rasnik.io.results import ResultWriter

_MOST_CANDIDATES = 4

__all__ = ["Destination", "run_batch", "system_of"]

_COUNTED_SOURCES = 200  # with more, opening each only to count its frames takes too long


@dataclass(frozen=True)
class Destination:
    """Where results go: a table on the terminal unless something else is asked for."""

    json: bool = False
    csv: bool = False
    lwdaq: bool = False
    file: Path | None = None
    overlays: Path | None = None


@dataclass
class _Outcome:
    """What the loop has seen so far."""

    good: int = 0
    failed: int = 0
    errors: list[str] = field(default_factory=list)
    """Sentences, with the candidates of ambiguous images."""
    rows: list[tuple[Frame, Pose | None, str | None]] = field(default_factory=list)


def run_batch(images: list[str], options: AnalysisOptions, destination: Destination) -> bool:
    """Analyse every frame of the images named; True if each gave a position.

    A frame that fails is a result as well: it is written with its error, and the others
    follow.
    """
    sources = expand_paths(images)
    if all(source.error for source in sources):
        fail(f"there are no images: {'; '.join(f'{s.name}: {s.error}' for s in sources)}.")
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # faults come out as errors
    outcome = _Outcome()
    as_table = destination == Destination(overlays=destination.overlays)
    with ExitStack() as opened:
        writer = _open_writer(opened, destination, options, sources)
        overlays = _Overlays(destination.overlays, options) if destination.overlays else None
        advance = opened.enter_context(_progress(sources))
        for frame in iter_frames(sources):
            pose, error = analysed(frame, options)
            outcome.good += error is None
            outcome.failed += error is not None
            if error is not None:
                outcome.errors += [error, *_candidates(pose)]
            if writer is not None:
                _write(writer, destination, frame, pose, error)
            if as_table:
                outcome.rows.append((frame, pose, error))
            if overlays is not None and pose is not None:
                overlays.draw(frame, pose)
            advance()
    _report(outcome, destination, as_table)
    return outcome.failed == 0


def _candidates(pose: Pose | None) -> list[str]:
    """Lines on the poses between which an image does not decide."""
    if pose is None:
        return []
    listed = pose.candidates[:_MOST_CANDIDATES]
    lines = [
        f"  candidate: x = {c.x_um:.3f} µm, y = {c.y_um:.3f} µm, theta = "
        f"{1e3 * c.theta_rad:.4f} mrad, orientation {c.orientation}, log-odds {c.log_odds:.1f}"
        for c in listed
    ]
    more = len(pose.candidates) - len(listed)
    return [*lines, f"  and {more} more; --json lists all"] if more else lines


# ------------------------------------------------------------------------ where results go


def _open_writer(
    opened: ExitStack, destination: Destination, options: AnalysisOptions, sources: list[Source]
) -> ResultWriter | LwdaqWriter | None:
    from rasnik.io.results import CsvWriter, JsonLinesWriter, open_results

    if destination.json:
        return JsonLinesWriter(sys.stdout)
    if destination.csv:
        return CsvWriter(sys.stdout)
    if destination.lwdaq:
        return _lwdaq_writer(sys.stdout, options)
    if destination.file is None:
        return None
    path = destination.file
    if any(source.path.exists() and _same_file(source.path, path) for source in sources):
        fail(f"{path} is one of the images and would be overwritten; name another file.")
    check_folder(path)
    try:
        if path.suffix.lower() == ".txt":
            return opened.enter_context(_lwdaq_writer(path, options))
        return opened.enter_context(open_results(path, system=options.system))
    except (ValueError, ImportError, FileExistsError) as error:
        fail(f"{error}.")
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror or error}.")


def _lwdaq_writer(target: Path | TextIO, options: AnalysisOptions) -> LwdaqWriter:
    from rasnik.io.lwdaq_results import LwdaqWriter

    if options.system is not None:
        sizes = {"square_um": options.system.mask.field_um, "pixel_um": options.system.pitch_um}
    else:
        assert options.field_um is not None
        assert options.pixel_um is not None
        sizes = {"square_um": options.field_um, "pixel_um": options.pixel_um}
    return LwdaqWriter(target, **sizes)


def _same_file(one: Path, other: Path) -> bool:
    return other.exists() and os.path.samefile(one, other)


def _write(
    writer: ResultWriter | LwdaqWriter,
    destination: Destination,
    frame: Frame,
    pose: Pose | None,
    error: str | None,
) -> None:
    from rasnik.io.columns import make_record
    from rasnik.io.icaras import IcarasWriter
    from rasnik.io.lwdaq_results import LwdaqWriter
    from rasnik.io.utc import utc_time

    own_error = None if pose is not None else error
    record = make_record(frame.file, frame.frame, pose, error=own_error, notes=frame.notes)
    try:
        if isinstance(writer, LwdaqWriter):
            shape = frame.image.shape if frame.image is not None else (0, 0)
            writer.write(frame_name(frame), pose, shape, error or "")
        elif isinstance(writer, IcarasWriter):
            writer.write(record, time=utc_time(frame.time_s))
        else:
            writer.write(record)
    except BrokenPipeError:  # whoever read the output has seen enough
        raise
    except OSError as fault:
        fail(f"{destination.file or 'the output'} cannot be written: {fault.strerror or fault}.")


class _Overlays:
    """Draws overlays into a folder, each under a name of its own."""

    def __init__(self, folder: Path, options: AnalysisOptions) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            fail(f"the folder {folder} for overlays cannot be made: {error.strerror}.")
        self._folder, self._options = folder, options
        self._used: set[str] = set()

    def draw(self, frame: Frame, pose: Pose) -> None:
        from rasnik.report.overlay import draw_overlay

        assert frame.image is not None
        system = self._options.system or system_of(frame, self._options)
        title = f"{frame.file}, frame {frame.frame}"
        try:
            draw_overlay(
                frame.image,
                pose,
                system,
                self._path(frame),
                bounds_px=frame.clip_bounds(self._options.bounds),
                title=title,
            )
        except OSError as error:
            fail(f"an overlay cannot be written to {self._folder}: {error.strerror}.")
        except Exception as error:  # a picture that fails must not end the measurement
            text = f"{title}: the overlay cannot be drawn ({type(error).__name__}: {error})."
            messages().print(escape(text))

    def _path(self, frame: Frame) -> Path:
        stem = Path(frame.file).stem
        name = f"{stem}_overlay" if frame.frame == 0 else f"{stem}_{frame.frame:05d}_overlay"
        unique, number = name, 2
        while unique in self._used:
            unique, number = f"{name}_{number}", number + 1
        self._used.add(unique)
        return self._folder / f"{unique}.png"


def system_of(frame: Frame, options: AnalysisOptions) -> System:
    """A system with the image's own size, for field and pixel sizes alone."""
    from rasnik.instrument import Optics, Sensor, System
    from rasnik.mask import ChessField

    assert frame.image is not None
    assert options.field_um is not None
    assert options.pixel_um is not None
    height, width = frame.image.shape
    return System(
        name="image",
        mask=ChessField(field_um=options.field_um),
        optics=Optics(scale=1.0, blur_um=0.0),
        sensor=Sensor(
            width_px=width,
            height_px=height,
            pixel_um=options.pixel_um,
            dark_level=0.0,
            light_level=255.0,
        ),
    )


# ------------------------------------------------------------------------ the terminal


@contextmanager
def _progress(sources: list[Source]) -> Iterator[Callable[[], None]]:
    """Something to call after each frame; a bar if somebody is looking."""
    console = messages()
    if not console.is_terminal:
        yield lambda: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    few = len(sources) <= _COUNTED_SOURCES
    total = sum(count_frames(source) for source in sources) if few else len(sources)
    columns = ("analysing", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=total)
        yield lambda: bar.advance(task)


def _report(outcome: _Outcome, destination: Destination, as_table: bool) -> None:
    if as_table:
        from rasnik.cli.table import print_table

        print_table(outcome.rows)
    console = messages()
    for error in outcome.errors:
        console.print(f"[red]{escape(error)}[/]")
    total = outcome.good + outcome.failed
    summary = f"{total} image{'s' * (total != 1)}: {outcome.good} with a position"
    if outcome.failed:
        summary += f", {outcome.failed} without"
    if destination.file is not None:
        summary += f"; results in {destination.file}"
    if destination.overlays is not None:
        summary += f"; overlays in {destination.overlays}"
    (output() if as_table else console).print(escape(summary))
