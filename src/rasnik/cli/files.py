"""Files of commands: tracks that are read, results that are written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from rasnik.cli.common import fail, output

if TYPE_CHECKING:
    from rasnik.instrument import System
    from rasnik.tracking.track import Track

__all__ = [
    "TRACK_FILES",
    "PlotOption",
    "check_folder",
    "check_frames",
    "check_outputs",
    "exposure_of",
    "read_stored",
    "save_json",
    "stored_track",
    "system_for",
    "written",
]

#: Endings of names that may be those of a track.
TRACK_FILES = (".h5", ".hdf5", ".csv", ".parquet")

PlotOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="FILE", help="Plot: .png, .pdf or .svg."),
]


def check_outputs(paths: list[Path] | None, suffixes: tuple[str, ...]) -> list[Path]:
    """The files to be written; a wrong name must not come out at the end of a long run."""
    for path in paths or ():
        if path.suffix.lower() not in suffixes:
            fail(f"{path}: the name must end in {', '.join(suffixes)}.")
        check_folder(path)
    return list(paths or ())


def check_folder(path: Path) -> None:
    """End the command if there is no folder for a file that is to be written."""
    if not path.parent.is_dir():
        fail(f"{path} cannot be written: there is no folder {path.parent}.")


def check_frames(path: Path, track: Track, what: str) -> None:
    """End the command if a track is too short for what is to be made of it."""
    if len(track) < 2:
        fail(f"{path}: {what} takes two frames at least; the track has {len(track)}.")


def read_stored(path: Path) -> Track:
    """A track from a file, or the end of the command."""
    from rasnik.io import read_track

    try:
        return read_track(path)
    except (ValueError, OSError, ImportError) as error:
        fail(f"{str(error).rstrip('.')}.")


def stored_track(name: str) -> Track | None:
    """The track in a file; None if the file holds images."""
    from rasnik.io import read_track

    if not name.lower().endswith(TRACK_FILES):
        return None
    if not name.lower().endswith((".h5", ".hdf5")):
        return read_stored(Path(name))
    try:
        return read_track(name)
    except ValueError:  # maybe images
        return None
    except (OSError, ImportError) as error:
        fail(f"{str(error).rstrip('.')}.")


def system_for(path: Path | str, track: Track, overrides: list[str]) -> System | None:
    """The system that is stored with a track, if there is one."""
    import tomllib

    from rasnik.instrument import System, SystemConfigError, load_system

    text = track.metadata.get("system_toml")
    if not text:
        if overrides:
            fail(f"{path} holds no system that --set could change; give --system.")
        return None
    try:
        return load_system(System.model_validate(tomllib.loads(text)), overrides)
    except (SystemConfigError, ValueError) as error:
        fail(f"{path}: the system stored with the track cannot be read: {error}")


def exposure_of(path: Path | str, track: Track) -> float:
    """Exposure of a frame in s, by the system stored with a track; 0 if it is not known."""
    system = system_for(path, track, [])
    return 0.0 if system is None else system.sensor.exposure_s or 0.0


def save_json(path: Path, document: dict[str, Any], *, quiet: bool) -> None:
    """Write a document, and say so."""
    text = json.dumps(document, indent=2) + "\n"
    written(path, lambda: cast(None, path.write_text(text, encoding="utf-8")), quiet=quiet)


def written(path: Path, draw: Callable[[], None], quiet: bool = False) -> None:
    """Draw a plot into a file, and say so or why not."""
    try:
        draw()
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror or error}.")
    except ValueError as error:  # a format that is not known
        fail(f"{path} cannot be written: {error}.")
    if not quiet:
        output().print(f"written: {path}", markup=False)
