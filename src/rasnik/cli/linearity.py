"""``rasnik linearity``: the error along a motion, of a simulated system or of a real track."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, load, messages, output
from rasnik.cli.files import (
    TRACK_FILES,
    check_outputs,
    save_json,
    stored_track,
    system_for,
    written,
)
from rasnik.cli.predict import SetOption

if TYPE_CHECKING:
    from rasnik.characterisation.folding import Folding
    from rasnik.characterisation.linearity import Axis, Linearity, Scan
    from rasnik.tracking.track import Track

__all__ = ["linearity_command"]

_SIMULATED, _MEASURED, _OUTPUT = "Simulated system", "Measured track", "Output"
_UNITS_UM = {"nm": 1e-3, "um": 1.0, "µm": 1.0, "mm": 1e3}
_THETAS_MRAD, _RANGES = "0,2,20", "50nm,2um"
_PLOTS = (".png", ".pdf", ".svg")


def linearity_command(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SYSTEM|TRACK",
            help="Shipped system or TOML file, which is simulated; or a track "
            "(.h5, .csv, .parquet).",
            show_default=False,
        ),
    ],
    overrides: SetOption = None,
    theta: Annotated[
        str | None,
        typer.Option(
            metavar="MRAD,...",
            help="Rotations in mrad; with --range every combination. By default the paper's "
            "scans: 0 and 20 mrad over 50 nm, 2 mrad over 2 um.",
            rich_help_panel=_SIMULATED,
        ),
    ] = None,
    ranges: Annotated[
        str | None,
        typer.Option(
            "--range",
            metavar="LENGTH,...",
            help="Lengths of the motion, as 50nm,2um.",
            rich_help_panel=_SIMULATED,
        ),
    ] = None,
    positions: Annotated[
        int,
        typer.Option(
            "-n", "--positions", min=2, max=100_000, help="In a scan.", rich_help_panel=_SIMULATED
        ),
    ] = 51,
    axis: Annotated[
        str, typer.Option(metavar="x|y", help="Of the motion.", rich_help_panel=_SIMULATED)
    ] = "x",
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="likelihood, fourier, tracker; repeatable. All by default.",
            rich_help_panel=_SIMULATED,
        ),
    ] = None,
    path: Annotated[
        str,
        typer.Option(
            metavar="exact|paper", help="Generator of the frames.", rich_help_panel=_SIMULATED
        ),
    ] = "exact",
    rounded: Annotated[
        bool,
        typer.Option(
            "--rounded", help="Whole grey levels, as in files.", rich_help_panel=_SIMULATED
        ),
    ] = False,
    effects: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            metavar="NAME[=VALUE]",
            help="A source of error, as for rasnik simulate; repeatable.",
            rich_help_panel=_SIMULATED,
        ),
    ] = None,
    system_name: Annotated[
        str | None,
        typer.Option(
            "--system",
            metavar="NAME|FILE",
            help="System of the track; by default the one stored with it.",
            rich_help_panel=_MEASURED,
        ),
    ] = None,
    periods: Annotated[
        str | None,
        typer.Option(
            "--period",
            metavar="LENGTH,...",
            help="Fold modulo these, as 85um,170um, instead of two fields, one field and a pixel.",
            rich_help_panel=_MEASURED,
        ),
    ] = None,
    apply: Annotated[
        Path | None,
        typer.Option(
            metavar="TABLE",
            help="Take the errors of a table off the track; -o names the corrected track.",
            rich_help_panel=_MEASURED,
        ),
    ] = None,
    output_files: Annotated[
        list[Path] | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Plot (.png, .pdf, .svg) or figures, with the correction table of a track "
            "(.json); repeatable.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON.", rich_help_panel=_OUTPUT)] = False,
) -> None:
    """Find the error of the position along a motion.

    Of a [bold]system[/], noise-free frames are simulated in known steps. Of a [bold]track[/] of a
    mask that moves over many fields, errors that repeat with field or pixel are found in the
    density of positions, and can be corrected.

    [bold]Examples[/]

    rasnik linearity solidras --theta 0,2,20 --range 50nm,2um -o linearity.png

    rasnik linearity solidras --path paper --method fourier -o paper.png

    rasnik linearity track.h5 -o table.json -o folded.png

    rasnik linearity track.h5 --apply table.json -o corrected.h5
    """
    if apply is not None:
        _apply(source, apply, check_outputs(output_files, TRACK_FILES))
        return
    files = check_outputs(output_files, (*_PLOTS, ".json"))
    document: dict[str, Any]
    if source.lower().endswith(TRACK_FILES):
        folding, document = _folded(source, system_name, overrides or [], periods)
        if not as_json:
            _print_folding(folding, document)
    else:
        scans = _scans(theta, ranges, positions, axis)
        system = load(source, overrides or ())
        options = {"methods": method, "path": path, "rounded": rounded, "effects": effects}
        found = _simulated(system, scans, {k: v for k, v in options.items() if v is not None})
        document = found.as_dict()
        if not as_json:
            _print_scans(found)
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    for file in files:
        if file.suffix.lower() == ".json":
            save_json(file, document, quiet=as_json)
            continue
        from rasnik.report.linearity import plot_folding, plot_linearity

        if source.lower().endswith(TRACK_FILES):
            draw = partial(plot_folding, folding, file, title=Path(source).name)
        else:
            draw = partial(plot_linearity, found, file)
        written(file, draw, quiet=as_json)


# ------------------------------------------------------------------------ options


def _lengths_um(text: str, option: str) -> list[float]:
    found = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(nm|um|µm|mm)\s*", part)
        try:
            value = float(match[1]) * _UNITS_UM[match[2]] if match else 0.0
        except ValueError:
            value = 0.0
        if not 0 < value < 1e7:
            fail(f"{option} {text!r} must be lengths above 0 with their unit, as 50nm,2um.")
        found.append(value)
    return found


def _scans(theta: str | None, ranges: str | None, positions: int, axis: str) -> list[Scan]:
    from rasnik.characterisation.linearity import PAPER_SCANS, Scan

    if axis not in ("x", "y"):
        fail(f"--axis must be x or y, not {axis!r}.")
    along: Axis = "x" if axis == "x" else "y"
    if theta is None and ranges is None:
        return [Scan(one.theta_rad, one.range_um, positions, along) for one in PAPER_SCANS]
    try:
        thetas = [float(part) * 1e-3 for part in (theta or _THETAS_MRAD).split(",")]
    except ValueError:
        fail(f"--theta {theta!r} must be numbers in mrad, as {_THETAS_MRAD}.")
    lengths = _lengths_um(ranges or _RANGES, "--range")
    return [Scan(angle, length, positions, along) for length in lengths for angle in thetas]


# ------------------------------------------------------------------------ simulated


def _simulated(system: Any, scans: list[Scan], options: dict[str, Any]) -> Linearity:
    from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

    from rasnik.characterisation.linearity import linearity

    console = messages()
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task("frames", total=sum(scan.positions for scan in scans))
        try:
            return linearity(
                system, scans, progress=lambda frames: bar.advance(task, frames), **options
            )
        except (ValueError, TypeError) as error:
            fail(f"{str(error).rstrip('.')}.")


def _print_scans(found: Linearity) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in (
        "theta (mrad)", "range", "method", "peak to peak (nm)", "rms (nm)", "mean (nm)",
        "largest (nm)", "slope error", "failed",
    ):  # fmt: skip
        table.add_column(heading, justify="right", no_wrap=True)
    for one in found.errors:
        figures, length = one.figures, one.scan.range_um
        table.add_row(
            f"{1e3 * one.scan.theta_rad:g}",
            f"{length:g} µm" if length >= 1 else f"{1e3 * length:g} nm",
            one.method,
            *(f"{figures[k]:.3g}" for k in ("peak_to_peak_nm", "rms_nm", "mean_nm", "largest_nm")),
            f"{100 * figures['slope']:.2g} %",
            str(one.failed),
        )
    console = output()
    x, y = found.start_um
    console.print(
        f"{found.system.name}: found minus true {found.errors[0].scan.axis}, from "
        f"({x:g}, {y:g}) µm on; {found.path} frames without noise"
        f"{', whole grey levels' if found.rounded else ''}"
    )
    console.print(table)
    console.print("(rms: about the mean; slope error: largest of d(found)/d(true) - 1)")


# ------------------------------------------------------------------------ measured


def _track(name: str) -> Track:
    track = stored_track(name)
    if track is None:
        fail(f"{name} holds no track; rasnik track makes one.")
    return track


def _folded(
    name: str, system_name: str | None, overrides: list[str], periods: str | None
) -> tuple[Folding, dict[str, Any]]:
    track = _track(name)
    system = load(system_name, overrides) if system_name else system_for(name, track, overrides)
    if system is None:
        fail(f"{name} does not say of what system it is; give --system.")
    lengths = None if periods is None else tuple(_lengths_um(periods, "--period"))

    from rasnik.characterisation.correction import correction_of
    from rasnik.characterisation.folding import fold_track

    try:
        found = fold_track(track, system, lengths)
    except ValueError as error:
        fail(f"{error}.")
    about = {"source": name, "system": system.name}
    return found, about | correction_of(found).as_dict() | found.as_dict()


def _print_folding(found: Folding, document: dict[str, Any]) -> None:
    from rich.table import Table

    console = output()
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in (
        "", "modulo", "period (µm)", "rms (nm)", "peak to peak (nm)", "sigma (nm)", "p", "error",
    ):  # fmt: skip
        table.add_column(heading, justify="right", no_wrap=True)
    for one in found.folds:
        table.add_row(
            one.axis,
            one.name,
            f"{one.period_um:.6g}",
            f"{one.rms_nm:.3g}",
            f"{one.peak_to_peak_nm:.3g}",
            f"{one.sigma_rms_nm:.2g}",
            f"{one.p_value:.2g}",
            "detected" if one.detected else "-",
        )
    console.print(table)
    console.print(
        "(p: probability that a track without an error looks as uneven; sigma: of the error curve)"
    )
    for one in found.folds:
        if one.remark:
            console.print(f"{one.axis} modulo {one.name}: {one.remark}.", style="yellow")
    for where, reason in found.refused.items():
        console.print(f"{where}: {reason}.", style="yellow")
    terms = [f"{term['axis']} modulo {term['name']}" for term in document["terms"]]
    console.print(f"correction: {', '.join(terms) if terms else 'none, no error was detected'}")


def _apply(name: str, table: Path, files: list[Path]) -> None:
    from rasnik.characterisation.correction import Correction, apply_correction
    from rasnik.io import write_track

    if len(files) != 1:
        fail("--apply needs one -o, the corrected track (.h5, .csv, .parquet).")
    try:
        correction = Correction.from_dict(json.loads(table.read_text(encoding="utf-8")))
    except OSError as error:
        fail(f"{table} cannot be read: {error.strerror or error}.")
    except (ValueError, AttributeError) as error:  # JSON of another kind too
        fail(f"{table}: {error}.")
    if not correction.terms:
        fail(f"{table} corrects nothing: no error was detected in the track it is from.")
    try:
        write_track(apply_correction(_track(name), correction), files[0])
    except (ValueError, ImportError, OSError) as error:
        fail(f"{str(error).rstrip('.')}.")
    messages().print(f"corrected track written to {files[0]}", markup=False)
