"""``rasnik spectrum``: spectra of tracks, their noise floors and lines."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, load, messages, numbers, output
from rasnik.cli.files import check_outputs, read_stored, system_for, written
from rasnik.cli.predict import SetOption

if TYPE_CHECKING:
    from rasnik.characterisation.spectrum import Coherence
    from rasnik.characterisation.track_spectrum import TrackSpectrum

__all__ = ["spectrum_command"]

_SUFFIXES = (".png", ".pdf", ".svg", ".json")
#: Short names of columns.
_SHORT = {"x": "x_um", "y": "y_um", "theta": "theta_rad", "blur": "blur_um"}


def spectrum_command(
    tracks: Annotated[
        list[Path],
        typer.Argument(metavar="TRACK...", help="Tracks, as rasnik track writes them."),
    ],
    columns: Annotated[
        str, typer.Option("--columns", "-c", help="Columns, as x,y,theta,scale,light_level.")
    ] = "x,y",
    windows: Annotated[
        int | None,
        typer.Option(metavar="N", help="Number of windows [default: 100]; the paper has 5000."),
    ] = None,
    length_s: Annotated[
        float | None, typer.Option("--length", metavar="S", help="Length of a window instead.")
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option("--frame-rate", metavar="HZ", help="Of tracks that have no times."),
    ] = None,
    floor_range: Annotated[
        str | None,
        typer.Option("--floor", metavar="LOW,HIGH", help="Where the noise floor is, Hz."),
    ] = None,
    mains: Annotated[
        str, typer.Option(metavar="HZ,...", help="Mains whose harmonics are named.")
    ] = "50,60",
    coherent: Annotated[
        bool,
        typer.Option(
            "--coherence", help="Of the columns of each track, and of the tracks column by column."
        ),
    ] = False,
    logarithmic: Annotated[
        bool, typer.Option("--log", help="Draw the PSD at logarithmic frequencies (speckit).")
    ] = False,
    irregular: Annotated[
        bool,
        typer.Option("--irregular", help="Irregular times: the periodogram of Lomb and Scargle."),
    ] = False,
    system_name: Annotated[
        str | None,
        typer.Option(
            "--system",
            metavar="NAME|FILE",
            help="For the bound; by default the system stored with each track.",
        ),
    ] = None,
    overrides: SetOption = None,
    output_files: Annotated[
        list[Path] | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Plot (.png, .pdf, .svg), or figures and curves (.json); repeatable.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON, without the curves.")] = False,
) -> None:
    """Spectra of tracks: amplitude spectral density, noise floor, lines, Allan deviation, bound.

    Welch's method with Hann windows half overlapping, one-sided. Windows with a missing frame are
    left out; nothing is interpolated.

    [bold]Examples[/]

    rasnik spectrum track.h5 -o spectrum.png

    rasnik spectrum full.h5 half.h5 --columns x --windows 5000 -o light.png -o light.json
    """
    from rasnik.characterisation.track_spectrum import bound_of, track_spectrum

    files = check_outputs(output_files, _SUFFIXES)
    chosen = [_SHORT.get(name.strip(), name.strip()) for name in columns.split(",")]
    limits = numbers(floor_range, "--floor", "LOW,HIGH", least=2) if floor_range else None
    mains_hz = _mains(mains)
    system = None if system_name is None else load(system_name, overrides or ())
    found: list[TrackSpectrum] = []
    labels = _labels(tracks)
    for path, label in zip(tracks, labels, strict=True):
        track = read_stored(path)
        if not track.ok.any():
            fail(f"{path}: no frame of the track has a position.")
        try:
            limit = bound_of(track, system or system_for(path, track, overrides or []))
        except ValueError as error:
            limit = None
            messages().print(f"{path}: no bound: {error}", markup=False)
        for column in chosen:
            try:
                found.append(
                    track_spectrum(
                        track,
                        column,
                        label=label,
                        rate_hz=rate_hz,
                        windows=windows,
                        length_s=length_s,
                        irregular=irregular,
                        floor_range_hz=(limits[0], limits[1]) if limits else None,
                        mains_hz=mains_hz,
                        limit=limit,
                    )
                )
            except ValueError as error:
                fail(f"{path}: {str(error).rstrip('.')}.")
    coherences = _coherences(found, windows, length_s) if coherent else []
    document: dict[str, Any] = {
        "convention": "one-sided: white noise of sigma per frame lies at sigma*sqrt(2/f)",
        "spectra": [one.as_dict() for one in found],
        "coherence": [_coherence_dict(name, one) for name, one in coherences],
    }
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        _print(found, coherences)
    curves = _logarithmic(found) if logarithmic else []
    for path in files:
        if path.suffix.lower() == ".json":
            document["spectra"] = [one.as_dict(curves=True) for one in found]
            for k, (frequency_hz, psd) in enumerate(curves):
                document["spectra"][k]["logarithmic"] = {
                    "frequency_hz": frequency_hz.tolist(),
                    "asd": [math.sqrt(value) for value in psd],
                }
            document["coherence"] = [
                _coherence_dict(name, one, curves=True) for name, one in coherences
            ]
            text = json.dumps(document, indent=1) + "\n"
            written(path, lambda to=path, text=text: _write(to, text), quiet=as_json)  # type: ignore[misc]
        else:
            from rasnik.report.spectrum import plot_spectra

            written(
                path,
                lambda to=path: plot_spectra(  # type: ignore[misc]
                    found, to, coherences=coherences, logarithmic=curves
                ),
                quiet=as_json,
            )


# ------------------------------------------------------------------------ what comes in


def _mains(text: str) -> tuple[float, ...]:
    values = numbers(text, "--mains", ",".join(["HZ"] * (1 + text.count(","))), least=1)
    if min(values) <= 0:
        fail(f"--mains {text!r}: frequencies must be above 0.")
    return tuple(values)


def _labels(paths: list[Path]) -> list[str]:
    """Names of the tracks; with folders where those alone do not differ."""
    if len(paths) == 1:
        return [""]
    stems = [path.stem for path in paths]
    return stems if len(set(stems)) == len(stems) else [str(path) for path in paths]


# ------------------------------------------------------------------------ further curves


def _coherences(
    found: list[TrackSpectrum], windows: int | None, length_s: float | None
) -> list[tuple[str, Coherence]]:
    """Of different columns of one track, and of one column of different tracks."""
    from rasnik.characterisation.spectrum import coherence

    coherences = []
    for k, one in enumerate(found):
        for other in found[k + 1 :]:
            columns = one.spectrum.name, other.spectrum.name
            if (one.label == other.label) == (columns[0] == columns[1]):
                continue
            if one.series is None or other.series is None:
                fail("--coherence needs regular times.")
            name = f"{one.label} {columns[0]} and {other.label} {columns[1]}".strip()
            try:
                both = coherence(one.series, other.series, windows=windows, length_s=length_s)
            except ValueError as error:
                fail(f"{name}: {error}.")
            coherences.append((" ".join(name.split()), both))
    if not coherences:
        fail("--coherence needs two columns or two tracks.")
    return coherences


def _logarithmic(found: list[TrackSpectrum]) -> list[tuple[Any, Any]]:
    from rasnik.characterisation.spectrum import logarithmic

    curves = []
    for one in found:
        if one.series is None:
            fail("--log needs regular times.")
        try:
            curves.append(logarithmic(one.series))
        except (ValueError, ImportError) as error:
            fail(f"{str(error).rstrip('.')}.")
    return curves


def _coherence_dict(name: str, one: Coherence, *, curves: bool = False) -> dict[str, Any]:
    import numpy as np

    inside = slice(1, -1)
    peak = 1 + int(np.nanargmax(one.coherence[inside]))
    document: dict[str, Any] = {
        "of": name,
        "effective_averages": one.averages,
        "threshold_1_percent": one.threshold(),
        "share_above_threshold": float(np.mean(one.coherence[inside] > one.threshold())),
        "highest": float(one.coherence[peak]),
        "highest_at_hz": float(one.frequency_hz[peak]),
    }
    if curves:
        document["frequency_hz"] = one.frequency_hz.tolist()
        document["coherence"] = np.nan_to_num(one.coherence).tolist()
    return document


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


# ------------------------------------------------------------------------ screen


def _print(found: list[TrackSpectrum], coherences: list[tuple[str, Coherence]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from rasnik.report.numbers import with_sigma
    from rasnik.report.spectrum import shown_unit

    console = output()
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("", no_wrap=True)
    for heading in (
        "floor, one-sided", "σ/√f", "unit", "from Hz", "to Hz", "bound, one-sided", "/ bound",
        "rms", "unit",
    ):  # fmt: skip
        table.add_column(heading, justify="right", no_wrap=True)
    for one in found:
        floor, spectrum = one.floor, one.spectrum
        size = floor.asd if floor else (one.bound_asd if math.isfinite(one.bound) else 1.0)
        unit, factor = shown_unit(spectrum.unit, size)
        rms_unit, rms_factor = shown_unit(spectrum.unit, spectrum.rms())
        known = math.isfinite(one.bound)
        cells = ["-"] * 2 + [f"{unit or '1'}/√Hz"] + ["-"] * 2
        if floor:
            cells = [
                with_sigma(floor.asd * factor, floor.sigma * factor),
                f"{floor.as_paper * factor:.4g}",
                f"{unit or '1'}/√Hz",
                f"{floor.low_hz:.4g}",
                f"{floor.high_hz:.4g}",
            ]
        table.add_row(
            escape(_title(one)),
            *cells,
            f"{one.bound_asd * factor:.4g}" if known else "-",
            with_sigma(floor.asd / one.bound_asd, floor.sigma / one.bound_asd)
            if floor and known
            else "-",
            f"{spectrum.rms() * rms_factor:.4g}",
            rms_unit or "1",
        )
    console.print(table)
    console.print(
        "One-sided: white noise of sigma per frame at f frames/s lies at sigma √(2/f). The paper "
        "quotes sigma/√f (second column)."
    )
    for one in found:
        _print_remarks(one)
    _print_lines(found)
    for name, both in coherences:
        values = _coherence_dict(name, both)
        console.print(
            f"coherence of {name}: {100 * values['share_above_threshold']:.1f} % of bins above "
            f"{values['threshold_1_percent']:.3g} (1 % by chance), highest "
            f"{values['highest']:.3f} at {values['highest_at_hz']:.4g} Hz",
            markup=False,
        )


def _title(one: TrackSpectrum) -> str:
    return f"{one.label} {one.spectrum.name}".strip()


def _print_remarks(one: TrackSpectrum) -> None:
    spectrum, console = one.spectrum, output()
    console.print(
        f"{_title(one)}: {spectrum.segments} windows of {spectrum.window} frames "
        f"({spectrum.window / spectrum.rate_hz:.3g} s) at {spectrum.rate_hz:.6g} Hz, bins of "
        f"{spectrum.resolution_hz:.3g} Hz"
        + (", Lomb-Scargle periodogram" if spectrum.method != "welch" else ""),
        markup=False,
    )
    if spectrum.missing:
        console.print(
            f"{_title(one)}: {spectrum.missing} frames are missing or have no position; "
            f"{spectrum.left_out} windows left out for it, {spectrum.unused} frames lie in none.",
            style="yellow",
            markup=False,
        )
    if one.no_floor:
        console.print(f"{_title(one)}: no floor: {one.no_floor}.", style="yellow", markup=False)


def _print_lines(found: list[TrackSpectrum]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from rasnik.report.numbers import with_sigma
    from rasnik.report.spectrum import shown_unit

    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("lines of", "Hz", "rms", "unit", "significance", "width Hz", "maybe"):
        table.add_column(heading, justify="left" if heading in ("lines of", "maybe") else "right")
    for one in found:
        for line in one.lines:
            unit, factor = shown_unit(one.spectrum.unit, line.rms)
            table.add_row(
                escape(_title(one)),
                f"{line.frequency_hz:.5g}",
                with_sigma(line.rms * factor, line.rms_error * factor),
                unit or "1",
                f"{line.significance:.3g}",
                f"{line.width_hz:.2g}" if line.width_hz else "narrow",
                line.name,
            )
    if table.row_count:
        output().print(table)
