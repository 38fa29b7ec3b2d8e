"""``rasnik align``: where the bodies of an installation stand, from the readings of its Rasniks."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rasnik.cli.common import fail, messages, output
from rasnik.cli.files import PlotOption, check_outputs, written

if TYPE_CHECKING:
    from rasnik.geometry.installation import Installation
    from rasnik.geometry.network import Network
    from rasnik.geometry.observations import Readings
    from rasnik.geometry.solution import Adjustment, Check

__all__ = ["align_command"]

#: Unit in which a value of a reading is shown, and the factor to it.
_SHOWN = {"x": ("µm", 1.0), "y": ("µm", 1.0), "z": ("µm", 1.0), "scale": ("", 1.0)}
_ANGLE = ("mrad", 1e3)


def align_command(
    installation: Annotated[
        str,
        typer.Argument(
            metavar="INSTALLATION",
            help="Shipped installation (atlas-tower, atlas-tower-linked) or TOML file.",
            show_default=False,
        ),
    ],
    readings: Annotated[
        Path | None,
        typer.Argument(
            metavar="[READINGS]",
            help="Table of readings: .csv, .json, .jsonl or .toml; or results of rasnik analyse. "
            "Without it: what the installation can measure.",
            show_default=False,
        ),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            "--reference", metavar="FILE", help="Readings from before: motion since then is told."
        ),
    ] = None,
    reject: Annotated[
        bool,
        typer.Option("--reject", help="Leave out values that are named as wrong, one at a time."),
    ] = False,
    every: Annotated[
        bool, typer.Option("--all", help="Show every value of every reading.")
    ] = False,
    toml: Annotated[
        bool, typer.Option("--toml", help="Print the installation's file, to start one's own from.")
    ] = False,
    plot: PlotOption = None,
    plot_file: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE", help="The same as --output.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON, with all covariances.")] = False,
) -> None:
    """Solve for the places of all bodies of an installation from all readings at once.

    Exit status 1: something is not measured, cannot be used or contradicts the rest.

    [bold]Examples[/]

    rasnik align atlas-tower

    rasnik align tower.toml today.csv --reference january.csv -o tower.png
    """
    plot = plot or plot_file
    check_outputs([plot] if plot else None, (".png", ".pdf", ".svg"))
    if toml:
        _print_file(installation)
        return
    left_out: list[str] = []
    network = _network(installation, left_out)
    if reference is not None and readings is None:
        fail("--reference needs READINGS to compare with it.")

    from rasnik.geometry.adjustment import adjust, capability

    try:
        if readings is None:
            found = capability(network)
        else:
            now = _read(network, readings)
            before = None if reference is None else _read(network, reference)
            found = adjust(network, now, before, reject=reject)
    except ValueError as error:
        fail(f"{error}.")
    problems = [*left_out, *found.problems]
    if as_json:
        typer.echo(json.dumps(found.as_dict() | {"problems": problems}, indent=2))
    else:
        _print(found, has_readings=readings is not None, every=every)
    for problem in problems:
        messages().print(f"{problem[0].upper()}{problem[1:]}.", style="yellow", markup=False)
    if plot is not None:
        from rasnik.report.installation import plot_installation

        written(plot, lambda: plot_installation(found, plot), quiet=as_json)
    if not found.consistent or not found.complete or problems:
        raise typer.Exit(1)


def _print_file(name: str) -> None:
    from importlib import resources

    loaded = _load(name, None)
    if Path(name).is_file():
        text = Path(name).read_text(encoding="utf-8")
    else:
        file = resources.files("rasnik") / "installations" / f"{loaded.name}.toml"
        text = file.read_text(encoding="utf-8")
    typer.echo(text, nl=False)


def _load(name: str, left_out: list[str] | None) -> Installation:
    from rasnik.geometry.installation import load_installation
    from rasnik.instrument import SystemConfigError

    try:
        return load_installation(name, left_out=left_out)
    except SystemConfigError as error:
        fail(str(error))


def _network(name: str, left_out: list[str]) -> Network:
    from rasnik.geometry.network import Network

    return Network(_load(name, left_out))


def _read(network: Network, path: Path) -> Readings:
    from rasnik.geometry.observations import read_readings

    try:
        return read_readings(network, path)
    except OSError as error:
        fail(f"{path} cannot be read: {error.strerror or error}.")


# ------------------------------------------------------------------------ screen


def _print(found: Adjustment, *, has_readings: bool, every: bool) -> None:
    console = output()
    installation = found.network.installation
    console.print(
        f"{installation.name}: {len(installation.bodies)} bodies, "
        f"{len(installation.rasniks)} Rasnik{'s' if len(installation.rasniks) > 1 else ''}",
        markup=False,
    )
    if not has_readings:
        console.print("no readings: what one reading of each Rasnik would tell")
    _print_bodies(found, has_readings)
    for one in found.sagittas:
        cells = [
            _cell(value, sigma, has_readings)
            for value, sigma in zip(one.value_um, one.sigma_um, strict=True)
        ]
        text = ", ".join(
            f"{axis} {cell}{' µm' if measured else ''}"
            for axis, cell, measured in zip(one.axes, cells, one.measured, strict=True)
        )
        console.print(f"sagitta {one.name}: {text}", markup=False)
    for motion in found.unmeasured:
        console.print(f"unmeasured: {motion.words}", style="yellow", markup=False)
    if has_readings:
        _print_fit(found)
    _print_checks(found, has_readings, every)


def _print_bodies(found: Adjustment, has_readings: bool) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("body")
    for axis in "xyz":
        table.add_column(f"{axis} (µm)", justify="right", no_wrap=True)
    for axis in "xyz":
        table.add_column(f"about {axis} (mrad)", justify="right", no_wrap=True)
    sigmas, from_prior = found.sigmas, False
    for b, name in enumerate(found.network.bodies):
        cells = []
        for d in range(6):
            factor = 1.0 if d < 3 else 1e3
            state = found.state(b, d)
            if state in ("held", "unmeasured"):
                cells.append("held" if state == "held" else "[yellow]unmeasured[/]")
                continue
            cell = _cell(found.motions[b, d] * factor, sigmas[b, d] * factor, has_readings)
            cells.append(f"{cell}*" if state == "prior" else cell)
            from_prior = from_prior or state == "prior"
        table.add_row(name, *cells)
    console = output()
    console.print(table)
    meaning = "motion ± standard deviation" if has_readings else "standard deviations"
    star = "; *: known from its prior alone" if from_prior else ""
    console.print(f"({meaning}, along and about each body's own axes{star})")


def _cell(value: float, sigma: float, has_readings: bool) -> str:
    from rasnik.report.numbers import rounded, with_sigma

    if not math.isfinite(sigma):
        return "unmeasured"
    return with_sigma(value, sigma) if has_readings else f"± {rounded(sigma, sigma)}"


def _print_fit(found: Adjustment) -> None:
    from rasnik.geometry.solution import LEAST_PROBABILITY

    console = output()
    if math.isfinite(found.probability):
        text = f"chi2 {found.chi2:.1f} for {found.ndf:.3g} degrees of freedom"
        likely = not found.probability < LEAST_PROBABILITY
        style = None if likely else "red"
        console.print(f"{text}, probability {found.probability:.3g}", style=style)
        if not likely and not found.outliers:
            console.print(
                "The readings contradict each other, and no single one is to blame: larger "
                "errors than stated, or bodies that are not rigid or not as described.",
                style="red",
            )
    else:
        console.print("nothing is measured twice: no reading can be checked", style="yellow")
    if not found.converged:
        console.print("The solution did not converge.", style="red")
    for one in found.outliers:
        unit, factor = _SHOWN.get(one.value, ("", 1.0) if one.value == "scale" else _ANGLE)
        text = (
            f"wrong: {one.value} of {one.rasnik} by "
            f"{_cell(one.error * factor, one.sigma * factor, True)} {unit}".rstrip()
            + f" ({abs(one.w):.1f} standard deviations)"
        )
        if one.alternatives:
            text += f", or else {' or '.join(one.alternatives)}: they cannot be told apart"
        text += "; left out" if one.left_out else "; not left out"
        console.print(text, style="red", markup=False)


def _print_checks(found: Adjustment, has_readings: bool, every: bool) -> None:
    from rich.table import Table

    console = output()
    unchecked = [one.label for one in found.checks if one.used and one.redundancy == 0]
    if unchecked:
        console.print(
            f"unchecked, an error of these would not show: {', '.join(unchecked)}",
            style="yellow",
            markup=False,
        )
    if not every:
        if not has_readings:
            _print_reliability(found)
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("value")
    for heading in ("residual", "sigma", "unit", "redundancy", "w", "detectable"):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in found.checks:
        table.add_row(one.label, *_check_cells(one))
    console.print(table)
    console.print(
        "(w: residual over its standard deviation; detectable: smallest error that is named with "
        "80 % chance)"
    )


def _check_cells(one: Check) -> list[str]:
    unit, factor = _SHOWN.get(one.value, _ANGLE)
    return [
        f"{one.residual * factor:.4g}" if math.isfinite(one.residual) else "-",
        f"{one.sigma * factor:.3g}",
        unit,
        "left out" if not one.used else f"{one.redundancy:.2f}",
        f"{one.w:.1f}" if math.isfinite(one.w) else "-",
        f"{one.detectable * factor:.3g}" if math.isfinite(one.detectable) else "-",
    ]


def _print_reliability(found: Adjustment) -> None:
    """The weakest checked reading of each kind."""
    readings = [one for one in found.checks if one.rasnik in found.network.rasniks]
    for value in ("x", "y", "scale", "theta"):
        checked = [one for one in readings if one.value == value and one.redundancy > 0]
        if checked:
            worst = max(checked, key=lambda one: one.detectable)
            unit, factor = _SHOWN.get(value, _ANGLE)
            output().print(
                f"an error of {value} is named with 80 % chance from "
                f"{worst.detectable * factor:.3g} {unit}".rstrip()
                + f" on ({worst.rasnik})",
                markup=False,
            )
