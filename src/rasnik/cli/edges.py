"""``rasnik edges``: edge profile, blur, asymmetry, modulation transfer, focus."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.analyse import check_instrument, parse_bounds
from rasnik.cli.common import fail, load, messages, output
from rasnik.cli.files import check_outputs, save_json, stored_track, system_for, written
from rasnik.cli.predict import SetOption

if TYPE_CHECKING:
    from rasnik.characterisation.edges import Edges
    from rasnik.instrument import System
    from rasnik.io.images import Frame
    from rasnik.tracking.track import Track

__all__ = ["edges_command"]

_LEVELLED = 0.97  # of the step from black to white

_LABELS = {
    "blur_um": ("blur, all contours", "µm on the sensor"),
    "blur_x_um": ("blur across x", "µm on the sensor"),
    "blur_y_um": ("blur across y", "µm on the sensor"),
    "kurtosis": ("excess kurtosis", ""),
    "edge_shift_um": ("edge shift, black larger", "µm on the mask"),
    "lateral_x_um": ("left of the position in x", "µm on the mask"),
    "lateral_y_um": ("left of the position in y", "µm on the mask"),
}


def edges_command(
    images: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGES|TRACK",
            help="Image files, folders, patterns, stacks of one scene, which are averaged; or a "
            "track, whose blur is shown against time.",
            show_default=False,
        ),
    ],
    system_name: Annotated[
        str | None,
        typer.Option(
            "--system",
            metavar="NAME|FILE",
            help="System by name (see rasnik systems) or TOML file.",
        ),
    ] = None,
    overrides: SetOption = None,
    field_um: Annotated[
        float | None,
        typer.Option(
            metavar="F",
            help="Side of a chess field on the mask in um. With --pixel-um no system is needed.",
        ),
    ] = None,
    pixel_um: Annotated[
        float | None, typer.Option(metavar="P", help="Pitch of the sensor's pixels in um.")
    ] = None,
    bounds: Annotated[
        str | None,
        typer.Option(
            metavar="L,T,R,B", help="Use these columns and rows only, the last ones included."
        ),
    ] = None,
    best_blur_um: Annotated[
        float | None,
        typer.Option(
            "--best-blur-um",
            metavar="B",
            min=0.0,
            help="Blur in focus, from which the distance from focus is reckoned; by default "
            "the system's.",
        ),
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
    """Show how sharp the edges are: profile, blur, black and white, modulation transfer, focus.

    [bold]Examples[/]

    rasnik edges image.png --system solidras -o edges.png

    rasnik edges frames/ --field-um 120 --pixel-um 10 --json

    rasnik edges track.h5 -o blur.png
    """
    files = check_outputs(output_files, (".png", ".pdf", ".svg", ".json"))
    track = stored_track(images[0]) if len(images) == 1 else None
    if track is not None:
        system = None if system_name is None else load(system_name, overrides or ())
        system = system or system_for(images[0], track, overrides or [])
        _of_track(track, system, best_blur_um, files, as_json, images[0])
        return
    check_instrument(system_name, overrides, field_um, pixel_um)
    system = None if system_name is None else load(system_name, overrides or ())
    sizes = (field_um, pixel_um)
    found, used, count = _of_images(
        images, system, sizes, None if bounds is None else parse_bounds(bounds)
    )
    document = {"source": images, "system": system.name if system else None} | found.as_dict()
    focus = _focus(found, used, best_blur_um) if system is not None else None
    document["focus"] = focus
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        _print(found, focus, count)
    for path in files:
        if path.suffix.lower() == ".json":
            save_json(path, document, quiet=as_json)
        else:
            from rasnik.report.edges import plot_edges

            draw = partial(plot_edges, found, path, title=Path(images[0]).name)
            written(path, draw, quiet=as_json)


# ------------------------------------------------------------------------ images


def _of_images(
    names: list[str],
    system: System | None,
    sizes: tuple[float | None, float | None],
    bounds: tuple[int, int, int, int] | None,
) -> tuple[Edges, System, int]:
    """Mean over the images that can be used, the system used, and how many images there were."""
    from rasnik.characterisation.edge_mean import mean_edges
    from rasnik.cli.track_terminal import progress
    from rasnik.io.images import expand_paths, iter_frames

    sources = expand_paths(names)
    if all(one.error for one in sources):
        fail(f"there are no images: {'; '.join(f'{s.name}: {s.error}' for s in sources)}.")
    found, count, used = [], 0, system
    with progress(sources, 0) as advance:
        for frame in iter_frames(sources):
            count += 1
            try:
                one, used = _of_frame(frame, system, sizes, bounds)
                found.append(one)
            except ValueError as error:
                messages().print(f"[red]{frame.file}: {str(error).rstrip('.')}.[/]")
            advance(1)
    if not found or used is None:
        fail("none of the images shows edges that can be measured.")
    try:
        return mean_edges(found), used, count
    except ValueError as error:
        fail(f"{error}.")


def _of_frame(
    frame: Frame,
    system: System | None,
    sizes: tuple[float | None, float | None],
    bounds: tuple[int, int, int, int] | None,
) -> tuple[Edges, System]:
    """The edges of one frame. Which of several positions it shows does not matter to them."""
    from rasnik import Pose, analyse
    from rasnik.characterisation.edges import edges
    from rasnik.cli.batch import system_of
    from rasnik.io.analysed import AnalysisOptions

    if frame.image is None:
        raise ValueError(frame.error)
    used = system or system_of(frame, AnalysisOptions(None, *sizes))
    clipped = frame.clip_bounds(bounds)
    pose = analyse(frame.image, used, bounds=clipped)
    if not pose.ok and pose.candidates:
        first = pose.candidates[0]
        prior = Pose(ok=True, x_um=first.x_um, y_um=first.y_um, orientation=first.orientation)
        pose = analyse(frame.image, used, bounds=clipped, prior=prior)
    if not pose.ok:
        raise ValueError(pose.error)
    return edges(frame.image, pose, used, clipped), used


def _focus(found: Edges, system: System, best_blur_um: float | None) -> dict[str, Any] | None:
    """Distance from the focus and its tilt over the image; None if the aperture is not known."""
    from rasnik.characterisation.focus import focus

    try:
        document: dict[str, Any] = focus(*found.blur_um, system, best_blur_um).as_dict()
    except ValueError:
        return None
    try:
        plane, sigma = found.blur_map.tilt(system, best_blur_um)
    except ValueError:
        return document
    for k, name in enumerate(("centre_um", "slope_u_rad", "slope_v_rad")):
        document[name], document[f"sigma_{name}"] = float(plane[k]), float(sigma[k])
    return document


# ------------------------------------------------------------------------ tracks


def _of_track(
    track: Track,
    system: System | None,
    best_blur_um: float | None,
    files: list[Path],
    as_json: bool,
    name: str,
) -> None:
    import numpy as np

    from rasnik.characterisation.focus import focus_of_track
    from rasnik.report.numbers import with_sigma

    blur = np.where(track.ok, track.blur_um, np.nan)
    good = np.isfinite(blur)
    if np.count_nonzero(good) < 2:
        fail(f"{name} holds fewer than two frames with a blur.")
    defocus = None
    if system is not None:
        try:
            defocus = focus_of_track(track, system, best_blur_um)[0]
        except ValueError as error:
            messages().print(f"No distance from the focus: {error}.")
    scatter = float(np.std(np.diff(blur[good])) / np.sqrt(2))
    document = {
        "source": name,
        "frames": int(good.sum()),
        "blur_um": float(np.mean(blur[good])),
        "scatter_um": scatter,
        "lowest_um": float(np.min(blur[good])),
        "highest_um": float(np.max(blur[good])),
        "defocus_um": None if defocus is None else float(np.mean(defocus[good])),
    }
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        console = output()
        mean = with_sigma(document["blur_um"], scatter / np.sqrt(good.sum()))  # type: ignore[arg-type]
        console.print(f"{document['frames']} frames: blur {mean} µm on the sensor")
        console.print(
            f"from {document['lowest_um']:.4g} to {document['highest_um']:.4g} µm; scatter from "
            f"frame to frame {scatter:.2g} µm"
        )
        if defocus is not None:
            console.print(
                f"mean distance from the focus {document['defocus_um']:.4g} µm, sign not known"
            )
    timed = bool(np.isfinite(track.time_s[good]).all())
    position = track.time_s if timed else track.frame.astype(np.float64)
    for path in files:
        if path.suffix.lower() == ".json":
            save_json(path, document, quiet=as_json)
            continue
        from rasnik.report.edges import plot_blur_track

        draw = partial(
            plot_blur_track,
            position,
            blur,
            defocus,
            path,
            unit="s" if timed else "",
            title=Path(name).name,
        )
        written(path, draw, quiet=as_json)


# ------------------------------------------------------------------------ screen


def _print(found: Edges, focus: dict[str, Any] | None, count: int) -> None:
    from rich.table import Table

    from rasnik.report.numbers import with_sigma

    console = output()
    console.print(
        f"{count} image{'s' * (count != 1)}, {found.images} used; noise "
        + ("of the system" if found.noise_known else "measured where the image is flat")
    )
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column()
    table.add_column(justify="right", no_wrap=True)
    table.add_column()
    for name, one in found.numbers.items():
        label, unit = _LABELS[name]
        table.add_row(label, with_sigma(*one), unit)
    if focus is not None:
        table.add_row(
            "distance from focus",
            with_sigma(focus["defocus_um"], focus["sigma_um"]),
            f"µm, sign not known; with 95 % confidence within {focus['within_um']:.3g} µm",
        )
    console.print(table)
    steps = Table(box=None, pad_edge=False, header_style="bold")
    steps.add_column("explained by, one after the other")
    for heading in ("parameters", "chi2/ndf left", "rms (grey)"):
        steps.add_column(heading, justify="right", no_wrap=True)
    for cause in found.causes:
        size = f"{cause.rms:.3g}" if cause.rms > 0 else ""
        steps.add_row(cause.name, str(cause.parameters or ""), f"{cause.chi2_ndf:.4f}", size)
    console.print(steps)
    if found.levelled < _LEVELLED:
        console.print(
            f"Half way to the next contour the edges have risen to {found.levelled:.0%} only: blur "
            "or haze reaches farther, and the modulation transfer rests on the model's tails.",
            style="yellow",
        )
