"""``rasnik noise``: how a sensor fluctuates, from frames of a still scene."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, load, messages, output
from rasnik.cli.files import PlotOption, check_folder, written
from rasnik.cli.predict import SetOption

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rasnik.characterisation.photon_transfer import PhotonTransfer
    from rasnik.instrument import System

__all__ = ["noise_command"]

_LOSSY = (".jpg", ".jpeg")


def noise_command(
    frames: Annotated[
        list[str],
        typer.Argument(
            help="Frames of one still scene, at least 10, better 100 or more: files, folders, "
            "patterns, stacks, videos."
        ),
    ],
    system: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="System by name or TOML file: says how many bits and pixels the sensor has, and "
            "is what --write-system starts from.",
        ),
    ] = None,
    overrides: SetOption = None,
    full_scale: Annotated[
        float | None,
        typer.Option(
            metavar="LEVEL",
            help="Highest grey level of the format. By default that of the system, or of the "
            "least of 8, 10, 12, 14 and 16 bits that holds all levels seen.",
        ),
    ] = None,
    plot: PlotOption = None,
    system_file: Annotated[
        Path | None,
        typer.Option(
            "--write-system",
            "--toml",
            metavar="FILE",
            help="Write noise_a, noise_b and full_well_e into this system file: that of --system "
            "with the values replaced, or, without --system, the file itself.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON, with more figures.")] = False,
) -> None:
    """Measure the noise of a sensor: photon-transfer curve, full well, fixed pattern, defects.

    Any still scene with dark and bright parts will do, the mask itself for one. Drift by some
    tenths of a pixel and flicker of the light are taken out.

    [bold]Examples[/]

    rasnik noise frames/ -o noise.png

    rasnik noise still.h5 --json

    rasnik noise frames/ --system solidras --write-system mine.toml
    """
    _check_writable(plot, system_file)
    source = system if system is not None else (str(system_file) if system_file else None)
    if system is None and system_file is not None and not system_file.exists():
        fail(
            f"there is no {system_file} to write into; name the system to start from, as in "
            "--system solidras."
        )
    instrument = load(source, overrides or ()) if source is not None else None
    if instrument is None and overrides:
        fail("--set changes a system; name it with --system.")
    if full_scale is None and instrument is not None:
        full_scale = float(instrument.full_scale)
    remarks: list[str] = []
    found = _measure(frames, instrument, full_scale, remarks)
    if as_json:
        document = {**found.as_dict(), "remarks": remarks}
        typer.echo(json.dumps(document, indent=2))
    else:
        _print(found, remarks)
    if plot is not None:
        from rasnik.report.photon_transfer import plot_noise

        title = Path(frames[0]).name if len(frames) == 1 else ""
        written(plot, lambda: plot_noise(found, plot, title=title), quiet=as_json)
    if system_file is not None:
        assert source is not None and instrument is not None
        _write_system(system_file, source, overrides, instrument, found, quiet=as_json)


def _check_writable(plot: Path | None, system_file: Path | None) -> None:
    """What cannot be written must not come out after all frames have been read."""
    if plot is not None and plot.suffix.lower() not in (".png", ".pdf", ".svg"):
        fail(f"{plot}: plots are written as .png, .pdf or .svg.")
    if system_file is not None and system_file.suffix.lower() != ".toml":
        fail(f"{system_file}: systems are written as TOML; end the name in .toml.")
    for path in (plot, system_file):
        if path is not None:
            check_folder(path)


def _measure(
    names: list[str], system: System | None, full_scale: float | None, remarks: list[str]
) -> PhotonTransfer:
    from rasnik.characterisation.photon_transfer import photon_transfer
    from rasnik.characterisation.temporal_noise import StillSceneError

    try:
        return photon_transfer(_images(names, system, remarks), full_scale=full_scale)
    except StillSceneError as error:
        for remark in remarks:
            messages().print(remark, markup=False)
        fail(f"{error}.")


def _images(
    names: list[str], system: System | None, remarks: list[str]
) -> Iterator[NDArray[np.generic]]:
    """The frames without header and margins; what is odd about them goes to the remarks."""
    from rasnik.io.images import iter_frames

    faults, notes = 0, set()
    for frame in iter_frames(names):
        if frame.image is None:
            faults += 1
            if faults <= 3:
                remarks.append(f"left out: {frame.error}")
            continue
        image = frame.image
        if system is not None and image.shape != system.shape:
            fail(
                f"{frame.file} has {image.shape[1]} x {image.shape[0]} pixels, but images of "
                f"system {system.name} have {system.shape[1]} x {system.shape[0]}."
            )
        if frame.bounds_px is not None:
            left, top, right, bottom = frame.bounds_px
            image = image[top : bottom + 1, left : right + 1]
        for note in frame.notes:
            if "header" not in note:
                notes.add(note)
        if Path(frame.file).suffix.lower() in _LOSSY:
            notes.add("JPEG images are smoothed by their compression: A and B are too small")
        yield image
    remarks.extend(sorted(notes))
    if faults > 3:
        remarks.append(f"left out: {faults - 3} more that cannot be read")


def _write_system(
    path: Path,
    source: str,
    overrides: list[str] | None,
    system: System,
    found: PhotonTransfer,
    *,
    quiet: bool,
) -> None:
    from rasnik.cli.system_file import system_text, with_values
    from rasnik.instrument import SystemConfigError

    law, pixels = found.law, system.sensor.binning**2
    if law.B <= 0 or law.A < 0:
        fail(f"{path} is not written: A = {law.A:.3g}, B = {law.B:.3g} are no noise of a sensor.")
    # The file describes one physical pixel; the images may be means of several.
    values: dict[str, Any] = {
        "sensor.noise_a": _digits(law.A * pixels, law.sigma_A * pixels),
        "sensor.noise_b": _digits(law.B * pixels, law.sigma_B * pixels),
    }
    electrons = system.full_scale / (law.B * pixels)
    values["sensor.full_well_e"] = _digits(electrons, electrons * law.sigma_B / law.B)
    remark = f"measured by rasnik noise in {found.noise.frames} frames"
    try:
        if overrides:
            text = with_values(system.to_toml(), system, values, remark)
        else:
            text = with_values(system_text(source), system, values, remark)
        path.write_text(text, encoding="utf-8")
    except SystemConfigError as error:
        fail(str(error))
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror or error}.")
    if not quiet:
        output().print(f"written: {path}", markup=False)


def _digits(value: float, sigma: float) -> float:
    """Rounded to a hundredth of its error or finer."""
    return round(value, 2 - math.floor(math.log10(sigma))) if sigma > 0 else value


# ---------------------------------------------------------------- the screen


def _print(found: PhotonTransfer, remarks: list[str]) -> None:
    from rich.table import Table

    console = output()
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column()
    for row in _rows(found):
        table.add_row(*row)
    console.print(table)
    for text in (*remarks, *found.warnings):
        console.print(f"note: {text}", markup=False)


def _rows(found: PhotonTransfer) -> Iterator[tuple[str, str, str]]:
    """(quantity, value, what it means)."""
    from rasnik.report.numbers import with_sigma

    law, noise = found.law, found.noise
    levels = noise.mean[found.used]
    yield (
        "frames",
        str(noise.frames),
        f"{noise.mean.shape[1]} x {noise.mean.shape[0]} pixels, {int(found.used.sum())} used, "
        f"levels {levels.min():.4g} to {levels.max():.4g}",
    )
    x, y = found.drift_px
    yield "motion", f"{x:.2g}, {y:.2g} px", "range in x and y, taken out"
    yield "light", f"{100 * found.flicker:.2g} %", "rms change, taken out"
    rounding = f"rounding ({law.rounding:.3g}) not counted" if law.rounding else "no rounding"
    yield "A", f"{with_sigma(law.A, law.sigma_A)} grey²", f"electronic noise, {rounding}"
    yield "B", f"{with_sigma(law.B, law.sigma_B)} grey", "shot noise: variance = A + B Q"
    yield "chi2/ndf", f"{law.chi2_ndf:.3f}", "scatter of the pixels about this law"
    per_grey, sigma = found.electrons_per_grey
    if math.isfinite(per_grey):
        yield "electrons per grey", with_sigma(per_grey, sigma), "1 / B"
        read_e = math.sqrt(max(law.A, 0.0)) * per_grey
        yield "read noise", f"{read_e:.3g} e", "sqrt(A) / B"
        well, sigma = found.full_well_e
        if math.isfinite(well):
            yield "full well", f"{with_sigma(well, sigma)} e", _well_at(found)
    if found.saturation_level is not None:
        yield "saturation", f"{found.saturation_level:g}", "grey level that is not exceeded"
    if math.isfinite(found.curvature):
        span = float(levels.max())
        bend = 100 * found.curvature * span / law.B if law.B > 0 else math.nan
        bend_sigma = 100 * found.sigma_curvature * span / law.B if law.B > 0 else math.nan
        yield (
            "curvature",
            f"{with_sigma(bend, bend_sigma)} %",
            f"of the shot noise at level {span:.4g}; 0 for a linear sensor",
        )
    yield from _pattern_rows(found)
    counts = Counter(defect.kind for defect in found.defects)
    kinds = ", ".join(f"{number} {kind}" for kind, number in counts.items())
    yield "defects", str(len(found.defects)), kinds or "no pixel is out of the ordinary"


def _well_at(found: PhotonTransfer) -> str:
    if found.bend_level is not None:
        return f"where the variance bends, at grey level {found.bend_level:.4g}"
    if found.saturation_level is not None:
        return f"at saturation, grey level {found.saturation_level:g}"
    return f"at full scale, {found.full_scale:g}; no pixel reached it"


def _pattern_rows(found: PhotonTransfer) -> Iterator[tuple[str, str, str]]:
    noise, fixed = found.noise, found.fixed
    for name, (value, sigma) in (
        ("row noise", noise.row_variance),
        ("column noise", noise.column_variance),
    ):
        yield name, _root(value, sigma), "rms, common to a line in one frame; part of A"
    if not math.isfinite(fixed.variance):
        yield "fixed pattern", "-", "the scene has too few flat parts"
        return
    share = f", over {fixed.pixels} pixels in flat parts"
    if math.isfinite(fixed.gain):
        share = f": offset {fixed.offset:.2g} grey, gain {100 * fixed.gain:.2g} %{share}"
    yield "fixed pattern", _root(fixed.variance, fixed.sigma_variance), f"rms of pixels{share}"
    for name, value, sigma in (
        ("  of rows", fixed.row_variance, fixed.sigma_row_variance),
        ("  of columns", fixed.column_variance, fixed.sigma_column_variance),
    ):
        if math.isfinite(value):
            yield name, _root(value, sigma), "rms of whole lines"


def _root(variance: float, sigma: float) -> str:
    """Root of a variance with its error, or what it is below where it is not seen."""
    from rasnik.report.numbers import with_sigma

    if variance > 3 * sigma:
        root = math.sqrt(variance)
        return f"{with_sigma(root, sigma / (2 * root))} grey"
    return f"< {math.sqrt(max(variance, 0.0) + 2 * sigma):.2g} grey"
