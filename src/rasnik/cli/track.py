"""``rasnik track``: follow a mask through a sequence of frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from rasnik.cli.analyse import Model
from rasnik.cli.common import fail, load
from rasnik.cli.files import check_folder

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["track_command"]

_TIME, _TRACKING, _OUTPUT = "Time", "Tracking", "Output"


def track_command(
    frames: Annotated[
        list[str],
        typer.Argument(
            help="Frames in their order: image files, folders, patterns, stacks "
            "(file.h5:/dataset where there are several), videos."
        ),
    ],
    system: Annotated[
        str,
        typer.Option(metavar="NAME|FILE", help="System by name (see rasnik systems) or TOML file."),
    ],
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="K=V",
            help="Change a value of the system, as in sensor.pixel_um=7.4; repeatable.",
        ),
    ] = None,
    frame_rate_hz: Annotated[
        float | None,
        typer.Option(
            "--frame-rate",
            metavar="HZ",
            help="Frames in a second; by default the system's.",
            rich_help_panel=_TIME,
        ),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Text file with the time of each frame in s, one in a line.",
            rich_help_panel=_TIME,
        ),
    ] = None,
    model: Annotated[
        Model,
        typer.Option(help="Map from mask to image that is fitted.", rich_help_panel=_TRACKING),
    ] = Model.AUTO,
    threads: Annotated[
        int,
        typer.Option(min=1, help="Frames worked on at a time.", rich_help_panel=_TRACKING),
    ] = 1,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Write the track to this HDF5 file (.h5) while it is measured. Without it only "
            "the summary is shown.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume/--overwrite",
            help="What to do with a track that is there already: continue it or replace it.",
            rich_help_panel=_OUTPUT,
        ),
    ] = True,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Draw the track; .png, .pdf or .svg.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="The summary as JSON.", rich_help_panel=_OUTPUT),
    ] = False,
) -> None:
    """Follow a mask through a sequence of frames.

    The same command again continues a track that was interrupted. Frames that cannot be read,
    or show no mask, are rows with NaN and a flag.

    Exit status: 0 all good, 1 some frames gave no position, 2 wrong usage, 130 interrupted.

    [bold]Examples[/]

    rasnik track frames/ --system solidras -o track.h5

    rasnik track run.mkv --system mine.toml --frame-rate 275 -o track.h5 --plot track.png

    rasnik track stack.h5 --system solidras --set sensor.binning=2 --json

    rasnik export track.h5 -o track.csv
    """
    if frame_rate_hz is not None and times is not None:
        fail("--frame-rate and --times exclude each other; give one of them.")
    if frame_rate_hz is not None and not 0 < frame_rate_hz <= 1e7:
        fail(f"--frame-rate must be above 0 and at most 1e7 Hz, not {frame_rate_hz:g}.")
    if output is not None and output.suffix.lower() not in (".h5", ".hdf5"):
        fail(
            f"{output}: a track is measured into HDF5; end the name in .h5, "
            "and convert it with rasnik export."
        )
    if plot is not None:
        _check_plot(plot)
    instrument = load(system, settings or ())
    time_s = _read_times(times) if times is not None else None

    from rasnik.cli.track_run import Options, run_track

    status = run_track(
        frames,
        Options(
            system=instrument,
            model=cast(Any, model.value),
            threads=threads,
            frame_rate_hz=frame_rate_hz or instrument.sensor.frame_rate_hz,
            times_s=time_s,
            file=output,
            resume=resume,
            plot=plot,
            json=as_json,
        ),
    )
    raise typer.Exit(status)


def _check_plot(path: Path) -> None:
    """A plot that cannot be written must not come out at the end of a long run."""
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        fail(f"{path}: plots are written as .png, .pdf or .svg.")
    check_folder(path)


def _read_times(path: Path) -> NDArray[np.float64]:
    import numpy as np

    try:
        # An empty file gives no values; loadtxt alone would warn and go on.
        lines = path.read_text(encoding="utf-8").splitlines()
        values = np.array([float(line) for line in lines if line.strip()], dtype=np.float64)
    except OSError as error:
        fail(f"{path} cannot be read: {error.strerror or error}.")
    except ValueError as error:
        fail(f"{path} does not hold one time in s on each line ({error}).")
    if not len(values):
        fail(f"{path} is empty; it must hold one time in s on each line.")
    return values
