"""``rasnik seismic ground`` and ``ring-down``: from the track of a suspended mass."""

from __future__ import annotations

import json
import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, messages, output
from rasnik.cli.files import check_frames, check_outputs, exposure_of, read_stored, written
from rasnik.cli.seismic_options import (
    PLOTS,
    Axis,
    CouplingOption,
    FileOption,
    FrequencyOption,
    JsonOption,
    OnMassOption,
    PlotOption,
    QOption,
    suspension_of,
)

if TYPE_CHECKING:
    from rasnik.characterisation.gaps import Series
    from rasnik.seismic.ground import GroundMotion
    from rasnik.seismic.ring_down import RingDown
    from rasnik.seismic.suspension import Suspension
    from rasnik.tracking.track import Track

__all__ = ["ground_command", "ring_down_command"]

_COLUMNS = {"x": "x_um", "y": "y_um"}


class _Quantity(StrEnum):
    displacement = "displacement"
    velocity = "velocity"
    acceleration = "acceleration"


class _Method(StrEnum):
    frequency = "frequency"
    time = "time"


RateOption = Annotated[
    float | None,
    typer.Option("--frame-rate", metavar="HZ", help="Of a track that has no times."),
]
SigmaOption = Annotated[
    float | None,
    typer.Option(
        "--sigma", metavar="NM", help="Noise of one reading; by default the track's own errors."
    ),
]


# ------------------------------------------------------------------------ ground motion


def ground_command(
    track_file: Annotated[Path, typer.Argument(metavar="TRACK", help="As rasnik track writes it.")],
    band: Annotated[
        tuple[float, float], typer.Option(metavar="LOW HIGH", help="Hz, where it is complete.")
    ],
    suspension_file: FileOption = None,
    frequency_hz: FrequencyOption = None,
    q: QOption = None,
    on_mass: OnMassOption = None,
    coupling: CouplingOption = None,
    quantity: Annotated[_Quantity, typer.Option(help="Of the ground.")] = _Quantity.velocity,
    columns: Annotated[str, typer.Option("--columns", "-c", help="x, y or both.")] = "x,y",
    method: Annotated[
        _Method, typer.Option(help="Transforms, or the equation of motion in time.")
    ] = _Method.frequency,
    exposure_s: Annotated[
        float | None,
        typer.Option(
            "--exposure",
            metavar="S",
            help="Of a frame, whose mean is undone; by default that of the track's system. Not "
            "with --method time.",
        ),
    ] = None,
    rate_hz: RateOption = None,
    sigma_nm: SigmaOption = None,
    output_file: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="File: .h5, .csv or .parquet."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a file that is there already.")
    ] = False,
    plot: PlotOption = None,
    as_json: JsonOption = False,
) -> None:
    """Ground motion from the track of a suspended mass, with the error that the readout leaves.

    Directions are those of the mask's axes. Frames that are missing divide the track; the ends
    of each stretch are cut off.

    [bold]Examples[/]

    rasnik seismic ground track.h5 --suspension watt.toml --band 0.05 20 -o ground.h5 --plot g.png

    rasnik seismic ground track.h5 --frequency 0.5 --q 100 --band 0.1 10 --quantity displacement
    """
    check_outputs([plot] if plot else None, PLOTS)
    if output_file is not None:
        from rasnik.io.ground_file import GROUND_SUFFIXES

        check_outputs([output_file], GROUND_SUFFIXES)
        if output_file.exists() and not overwrite:
            fail(f"{output_file} exists already; give another name, or --overwrite to replace it.")
    suspension = suspension_of(suspension_file, frequency_hz, q, None, None, on_mass, coupling)
    names = _axes(columns)
    from rasnik.characterisation.gaps import even_series
    from rasnik.seismic.ground import ground_motion

    track = _track(track_file)
    if exposure_s is None:
        exposure_s = _exposure_s(track_file, track, method, band[1])
    motions: dict[str, GroundMotion] = {}
    sigmas = {name: _sigma_nm(track, name, sigma_nm) for name in names}
    for name in names:
        try:
            motions[name] = ground_motion(
                even_series(track, _COLUMNS[name], rate_hz=rate_hz),
                suspension,
                quantity.value,
                band_hz=band,
                sigma=sigmas[name] if math.isfinite(sigmas[name]) else None,
                method=method.value,
                exposure_s=exposure_s,
            )
        except ValueError as error:
            fail(f"{track_file}, {name}: {str(error).rstrip('.')}.")
    if as_json:
        typer.echo(json.dumps(_ground_dict(track_file, suspension, motions), indent=2))
    else:
        _print_ground(motions)
    if output_file is not None:
        from rasnik.io.ground_file import write_ground

        try:
            write_ground(motions, suspension, output_file, overwrite=overwrite)
        except (ValueError, OSError, ImportError) as error:
            fail(f"{str(error).rstrip('.')}.")
        messages().print(f"written: {output_file}", markup=False)
    if plot is not None:
        from rasnik.report.seismic import draw_ground

        written(
            plot,
            lambda: draw_ground(motions, suspension, plot, sigmas=sigmas, title=track_file.name),
            quiet=as_json,
        )


def _track(path: Path) -> Track:
    """A track that has frames, or the end of the command."""
    track = read_stored(path)
    check_frames(path, track, "a motion")
    return track


def _exposure_s(path: Path, track: Track, method: _Method, highest_hz: float) -> float:
    """Of which the mean is undone: as the track's system states it, where the method can."""
    import numpy as np

    stated_s = exposure_of(path, track)
    if not stated_s or method is _Method.frequency:
        return stated_s
    messages().print(
        f"--method time leaves the mean over the exposure of {stated_s:g} s in: the motion is too "
        f"small by {100 * (1 - np.sinc(highest_hz * stated_s)):.2g} % at {highest_hz:g} Hz.",
        style="yellow",
    )
    return 0.0


def _axes(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if not set(names) <= set(_COLUMNS) or len(set(names)) < len(names):
        fail(f"--columns {text!r}: ground motion is read off x, y or x,y.")
    return names


def _sigma_nm(track: Track, name: str, given: float | None) -> float:
    """Noise of one reading in nm: as given, else the median of the track's own errors."""
    import numpy as np

    if given is not None:
        if not (math.isfinite(given) and given > 0):
            fail(f"--sigma {given:g}: the noise of a reading must be above 0.")
        return given
    stated = getattr(track, f"sigma_{name}_um")[track.ok]
    stated = stated[np.isfinite(stated) & (stated > 0)]
    return 1e3 * float(np.median(stated)) if len(stated) else math.nan


def _rms(motion: GroundMotion) -> float:
    import numpy as np

    return float(np.sqrt(np.nanmean(motion.values**2)))


def _ground_dict(
    path: Path, suspension: Suspension, motions: dict[str, GroundMotion]
) -> dict[str, Any]:
    return {
        "track": str(path),
        "suspension": suspension.model_dump(),
        "motions": [
            {
                "direction": name,
                "quantity": one.quantity,
                "unit": one.unit,
                "band_hz": list(one.band_hz),
                "corners_hz": list(one.corners_hz),
                "method": one.method,
                "exposure_s": one.exposure_s,
                "rate_hz": one.rate_hz,
                "rms": _rms(one),
                "sigma_readout": one.sigma if math.isfinite(one.sigma) else None,
                "values": one.valid,
                "missing": one.missing,
                "stretches": one.stretches,
                "stretches_too_short": one.too_short,
                "edge_s": one.edge_s,
            }
            for name, one in motions.items()
        ],
    }


def _print_ground(motions: dict[str, GroundMotion]) -> None:
    from rich.table import Table

    console = output()
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("", "rms", "by the readout", "unit", "from Hz", "to Hz", "values", "missing"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, one in motions.items():
        table.add_row(
            name,
            f"{_rms(one):.4g}",
            f"{one.sigma:.3g}" if math.isfinite(one.sigma) else "-",
            one.unit,
            *(f"{edge:g}" for edge in one.band_hz),
            f"{one.valid}",
            f"{one.missing}",
        )
    console.print(table)
    one = next(iter(motions.values()))
    short = f", {one.too_short} too short for it and left out" if one.too_short else ""
    console.print(
        f"{one.edge_s:.4g} s are cut off at each end of a stretch without gaps: {one.stretches} "
        f"used{short}. Outside the band the motion falls to nothing within an octave."
    )
    if one.exposure_s:
        console.print(f"The mean over an exposure of {one.exposure_s:g} s is undone.")


# ------------------------------------------------------------------------ ring-down


def ring_down_command(
    track_file: Annotated[Path, typer.Argument(metavar="TRACK", help="As rasnik track writes it.")],
    column: Annotated[Axis, typer.Option("--column", "-c", help="That swings.")] = Axis.x,
    about_hz: Annotated[
        float | None,
        typer.Option(
            "--frequency", metavar="HZ", help="About where; by default the strongest oscillation."
        ),
    ] = None,
    start_s: Annotated[
        float | None,
        typer.Option(
            "--from", metavar="S", help="Begin of the free decay, as the track counts time."
        ),
    ] = None,
    stop_s: Annotated[float | None, typer.Option("--to", metavar="S", help="Its end.")] = None,
    rate_hz: RateOption = None,
    sigma_nm: SigmaOption = None,
    plot: PlotOption = None,
    as_json: JsonOption = False,
) -> None:
    """Natural frequency and Q of a suspension from its free decay.

    [bold]Examples[/]

    rasnik seismic ring-down decay.h5 --plot decay.png

    rasnik seismic ring-down track.h5 --from 120 --to 900 --frequency 0.5 --json
    """
    check_outputs([plot] if plot else None, PLOTS)
    from rasnik.characterisation.gaps import even_series
    from rasnik.seismic.ring_down import ring_down

    track = _track(track_file)
    sigma = _sigma_nm(track, column.value, sigma_nm)
    try:
        series = even_series(track, _COLUMNS[column.value], rate_hz=rate_hz)
        series = _between(series, start_s, stop_s)
        found = ring_down(
            series, sigma=sigma if math.isfinite(sigma) else None, frequency_hz=about_hz
        )
    except ValueError as error:
        fail(f"{track_file}: {str(error).rstrip('.')}.")
    if as_json:
        document = {"track": str(track_file), "column": _COLUMNS[column.value]} | found.as_dict()
        typer.echo(json.dumps(document, indent=2))
    else:
        _print_ring_down(found)
    if plot is not None:
        from rasnik.report.seismic import draw_ring_down

        written(plot, lambda: draw_ring_down(found, plot, title=track_file.name), quiet=as_json)


def _between(series: Series, start_s: float | None, stop_s: float | None) -> Series:
    """The part of a series between two times.

    Raises
    ------
    ValueError
        If nothing lies between them, or they do not count from where the times of the track do.
    """
    from rasnik.characterisation.gaps import Series
    from rasnik.io.utc import EARLIEST_S

    stop = series.start_s + (len(series) - 1) / series.rate_hz
    whole = f"it goes from {round(series.start_s, 6):.13g} to {round(stop, 6):.13g} s"
    given = [time_s for time_s in (start_s, stop_s) if time_s is not None]
    if not all(math.isfinite(time_s) for time_s in given):
        raise ValueError(f"--from and --to are times of the track in s; {whole}")
    if series.start_s >= EARLIEST_S and any(time_s < EARLIEST_S for time_s in given):
        raise ValueError(f"the times of the track count from 1970, so do --from and --to; {whole}")

    def place(time_s: float | None, default: int) -> int:
        if time_s is None:
            return default
        return min(max(math.ceil((time_s - series.start_s) * series.rate_hz), 0), len(series))

    first, end = place(start_s, 0), place(stop_s, len(series))
    if not first < end:
        raise ValueError(f"nothing of the track lies between --from and --to; {whole}")
    return Series(
        series.values[first:end], series.rate_hz, series.name, series.unit,
        series.start_s + first / series.rate_hz,
    )  # fmt: skip


def _print_ring_down(found: RingDown) -> None:
    from rasnik.report.numbers import with_sigma

    console, unit = output(), found.series.unit
    sigmas = [float(one) for one in found.sigmas]
    q = (
        f"{with_sigma(found.q, found.sigma_q)}, amplitude falls by e in "
        f"{found.time_constant_s:.4g} s"
        if found.decays
        else f"above {found.least_q:.4g} (95 %)"
    )
    console.print(f"f0         {with_sigma(found.frequency_hz, sigmas[0])} Hz")
    console.print(f"Q          {q}")
    console.print(f"1/Q        {1e3 * found.loss:.5g} ± {1e3 * sigmas[1]:.2g} 1e-3")
    console.print(
        f"amplitude  {with_sigma(found.amplitude, sigmas[2])} {unit} at the first reading"
    )
    console.print(f"phase      {with_sigma(found.phase_rad, sigmas[3])} rad")
    console.print(f"offset     {with_sigma(found.offset, sigmas[4])} {unit}")
    console.print(f"drift      {with_sigma(found.drift, sigmas[5])} {unit}/s")
    chi2 = f", chi2/ndf {found.chi2_ndf:.4g}" if math.isfinite(found.chi2_ndf) else ""
    console.print(f"remainder  {found.rms:.4g} {unit} rms{chi2}")
    for remark in found.remarks:
        console.print(f"{remark[0].upper()}{remark[1:]}.", style="yellow", markup=False)
    console.print("One decay at one frequency does not tell viscous from structural damping.")
