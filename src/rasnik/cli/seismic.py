"""``rasnik seismic``: a Rasnik that reads a suspended mass, as a seismometer."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, load, numbers, output
from rasnik.cli.files import check_outputs, written
from rasnik.cli.predict import PoseOption, SetOption, SystemArgument, pose_of
from rasnik.cli.seismic_motion import ground_command, ring_down_command
from rasnik.cli.seismic_options import (
    PLOTS,
    Axis,
    CouplingOption,
    DampingOption,
    FileOption,
    FrequencyOption,
    JsonOption,
    MassOption,
    OnMassOption,
    PlotOption,
    QOption,
    suspension_of,
)

if TYPE_CHECKING:
    from rasnik.seismic.budget import Need, SelfNoise

__all__ = ["seismic_app"]

seismic_app = typer.Typer(
    help="Ground motion from a suspended mass, and what limits it.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
seismic_app.command("ground")(ground_command)
seismic_app.command("ring-down")(ring_down_command)

#: Frequencies at which a budget says what is missing, unless others are asked.
_AT_HZ = "0.01,0.1,1,10"


@seismic_app.command("budget")
def budget_command(
    system_name: SystemArgument,
    suspension_file: FileOption = None,
    frequency_hz: FrequencyOption = None,
    q: QOption = None,
    mass_kg: MassOption = None,
    damping: DampingOption = None,
    on_mass: OnMassOption = None,
    coupling: CouplingOption = None,
    rate_hz: Annotated[
        float | None,
        typer.Option("--frame-rate", metavar="HZ", help="By default the system's."),
    ] = None,
    axis: Annotated[Axis, typer.Option(help="Coordinate that is read.")] = Axis.x,
    reading: Annotated[
        float | None,
        typer.Option(metavar="PM", help="Measured floor, one-sided pm/√Hz, in place of the bound."),
    ] = None,
    temperature_k: Annotated[
        float, typer.Option("--temperature", metavar="K", help="Of the suspension.")
    ] = 293.15,
    extra: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=PM", help="Further white noise of the reading, pm/√Hz; repeatable."
        ),
    ] = None,
    at: Annotated[
        str, typer.Option(metavar="HZ,...", help="Where to say what is missing.")
    ] = _AT_HZ,
    overrides: SetOption = None,
    pose: PoseOption = None,
    plot: PlotOption = None,
    as_json: JsonOption = False,
) -> None:
    """Self-noise as ground acceleration: readout, rounding, thermal noise; against Peterson's
    low-noise model.

    [bold]Examples[/]

    rasnik seismic budget microras --frequency 0.5 --q 100 --mass 1 --plot budget.png

    rasnik seismic budget solidras --suspension watt.toml --frame-rate 100 --json
    """
    check_outputs([plot] if plot else None, PLOTS)
    system = load(system_name, overrides or ())
    suspension = suspension_of(
        suspension_file, frequency_hz, q, mass_kg, damping, on_mass, coupling
    )
    places = tuple(numbers(at, "--at", ",".join(["HZ"] * (1 + at.count(","))), least=1))
    from rasnik.seismic.budget import self_noise

    try:
        found = self_noise(
            system,
            suspension,
            axis=axis.value,
            rate_hz=rate_hz,
            reading_pm_rthz=reading,
            temperature_k=temperature_k,
            extra=_extra(extra or ()),
            pose=pose_of(pose),
        )
        if at == _AT_HZ:  # of the default those that the frame rate reaches
            places = tuple(f for f in places if f <= found.frequency_hz[-1])
        document = found.as_dict(places, curves=True)
    except (ValueError, TypeError) as error:
        fail(f"{str(error).rstrip('.')}.")
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        _print_budget(found, places)
    if plot is not None:
        from rasnik.report.seismic import draw_budget

        written(plot, lambda: draw_budget(found, plot), quiet=as_json)


def _extra(texts: Any) -> dict[str, float]:
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name.strip() and equals):
            fail(f"--extra {text!r} is not of the form NAME=PM.")
        found[name.strip()] = numbers(value, f"--extra {name}=", "PM", least=1)[0]
    return found


def _print_budget(found: SelfNoise, places: tuple[float, ...]) -> None:
    from rich.markup import escape
    from rich.table import Table

    console, suspension = output(), found.suspension
    mass = f", {suspension.mass_kg:.4g} kg" if suspension.mass_kg else ""
    console.print(
        f"{found.system.name}, {found.axis} at {found.rate_hz:g} frames/s, {suspension.kind} of "
        f"{suspension.frequency_hz:.4g} Hz, Q = {suspension.q:.4g}{mass}",
        markup=False,
    )
    for term in found.terms:
        console.print(f"  {term.name}: {term.source}", markup=False)
    for sentence in found.not_counted:
        console.print(f"  not counted: {sentence}", style="yellow", markup=False)
    console.print("\nAs ground acceleration, one-sided, nm/s²/√Hz")
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in (
        "Hz", "readout", "thermal", "self-noise", "NLNM", "self-noise / NLNM",
        "to be below it",
    ):  # fmt: skip
        table.add_column(heading, justify="left" if heading.startswith("to") else "right")
    for frequency_hz in places:
        need = found.need(frequency_hz)
        table.add_row(
            f"{frequency_hz:g}",
            *(_nano(one) for one in (need.readout, need.thermal, need.total, need.model)),
            f"{need.total / need.model:.3g}",
            escape(_wish(need)),
        )
    console.print(table)
    bands = ", ".join(f"{low:.3g} to {high:.3g} Hz" for low, high in found.quiet_hz)
    console.print(f"below the low-noise model: {bands or 'nowhere'}")


def _nano(value: float) -> str:
    return f"{1e9 * value:.3g}" if math.isfinite(value) else "-"


def _wish(need: Need) -> str:
    """What would have to change, in words."""
    if need.total <= need.model:
        return "it is"
    said = []
    if need.readout_power > 1:
        ways = [f"{need.readout_power:.3g} x the frames/s"]
        if need.natural_hz is not None:
            low, high = need.natural_hz
            ways.append(
                f"f0 below {high:.3g} Hz" if low == 0 else f"f0 of {low:.3g} to {high:.3g} Hz"
            )
        said.append(" or ".join(ways))
    if need.mass_q > 1:
        said.append(f"{need.mass_q:.3g} x mass times Q")
    return "; ".join(said) or "less of the further terms"
