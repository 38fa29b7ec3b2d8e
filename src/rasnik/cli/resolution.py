"""``rasnik resolution``: the scatter from frame to frame, beside stated errors and bound."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rasnik.cli.analyse import Method
from rasnik.cli.common import fail, load, messages, output
from rasnik.cli.files import check_outputs, save_json, stored_track, system_for, written
from rasnik.cli.predict import SetOption

if TYPE_CHECKING:
    from rasnik.characterisation.resolution import Resolution
    from rasnik.instrument import System
    from rasnik.tracking.track import Track

__all__ = ["resolution_command"]

#: Shown unit and factor to it, of nm, rad and ratio.
_SHOWN = {"nm": ("nm", 1.0), "rad": ("µrad", 1e6), "": ("1e-6", 1e6)}


def resolution_command(
    source: Annotated[
        list[str],
        typer.Argument(
            metavar="TRACK|FRAMES",
            help="A track, or repeated images of one scene: files, folders, patterns, stacks, "
            "videos.",
            show_default=False,
        ),
    ],
    system_name: Annotated[
        str | None,
        typer.Option(
            "--system",
            metavar="NAME|FILE",
            help="System by name or TOML file; by default that of the track.",
        ),
    ] = None,
    overrides: SetOption = None,
    method: Annotated[
        Method | None,
        typer.Option(help="Analyse images one by one in this way; by default they are tracked."),
    ] = None,
    output_files: Annotated[
        list[Path] | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Plot (.png, .pdf, .svg) or figures (.json); repeatable.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON.")] = False,
) -> None:
    """Measure the resolution: the scatter of single frames, whatever the scene's slow motion.

    [bold]Examples[/]

    rasnik resolution track.h5 -o resolution.png

    rasnik resolution frames/ --system solidras --json
    """
    files = check_outputs(output_files, (".png", ".pdf", ".svg", ".json"))
    system = None if system_name is None else load(system_name, overrides or ())
    track = stored_track(source[0]) if len(source) == 1 else None
    if track is None:
        if system is None:
            fail("images need a --system.")
        track = _track_of(source, system, method)
    elif method is not None:
        fail("--method is for images; a track is measured already.")
    system = system or system_for(source[0], track, overrides or [])

    from rasnik.characterisation.resolution import resolution

    try:
        found = resolution(track, system)
    except ValueError as error:
        fail(f"{error}.")
    document = {"source": source, "system": system.name if system else None} | found.as_dict()
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        _print(found)
    for path in files:
        if path.suffix.lower() == ".json":
            save_json(path, document, quiet=as_json)
        else:
            from rasnik.report.resolution import plot_resolution

            draw = partial(plot_resolution, found, path, title=Path(source[0]).name)
            written(path, draw, quiet=as_json)


# ------------------------------------------------------------------------ frames


def _track_of(names: list[str], system: System, method: Method | None) -> Track:
    from contextlib import closing

    from rasnik import Tracker, analyse
    from rasnik.cli.track_terminal import progress
    from rasnik.io.images import expand_paths, iter_frames
    from rasnik.io.read_ahead import read_ahead
    from rasnik.tracking.track import Track

    sources = expand_paths(names)
    if all(one.error for one in sources):
        fail(f"there are no images: {'; '.join(f'{s.name}: {s.error}' for s in sources)}.")
    tracker, poses, reason = Tracker(system), [], ""
    with progress(sources, 0) as advance, closing(read_ahead(iter_frames(sources))) as frames:
        for number, frame in enumerate(frames):
            reason = reason or frame.error or ""
            try:
                if method is None or frame.image is None:
                    poses.append(tracker.update(frame.image, number=number))
                else:
                    poses.append(analyse(frame.image, system, method=method.value))
            except ValueError as error:
                fail(f"{frame.file}: {error}.")
            advance(1)
    if reason:
        messages().print(f"[red]{reason}[/]")
    return Track.from_poses(poses)


# ------------------------------------------------------------------------ screen


def _print(found: Resolution) -> None:
    from rich.table import Table

    from rasnik.report.numbers import with_sigma

    table = Table(box=None, pad_edge=False, header_style="bold")
    headings = ("", "resolution", "unit", "order", "stated", "/ stated", "bound", "/ bound")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for name, one in found.scatters.items():
        unit, factor = _SHOWN[one.unit]
        table.add_row(
            name,
            with_sigma(one.sigma * factor, one.sigma_error * factor),
            unit,
            str(one.order),
            *_compared(one.sigma, one.sigma_error, one.stated, factor),
            *_compared(one.sigma, one.sigma_error, one.bound, factor),
        )
    console = output()
    console.print(f"{found.frames} frames; standard deviation of a single frame")
    console.print(table)
    console.print(
        "(order: of the differences between frames; stated: error that comes with the poses; "
        "bound: Cramer-Rao, rounding counted)"
    )
    for remark in found.remarks:
        console.print(f"{remark}.", style="yellow")


def _compared(value: float, error: float, other: float, factor: float) -> tuple[str, str]:
    from rasnik.report.numbers import with_sigma

    if not other > 0:
        return "-", "-"
    return f"{other * factor:.4g}", with_sigma(value / other, error / other)
