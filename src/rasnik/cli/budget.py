"""``rasnik budget``: what every error source contributes."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from rasnik.cli.common import fail, load, output
from rasnik.cli.files import PlotOption, written
from rasnik.cli.predict import PoseOption, SetOption, SystemArgument, pose_of

if TYPE_CHECKING:
    from rasnik.performance.budget import Budget

__all__ = ["budget_command"]


def budget_command(
    system_name: SystemArgument,
    overrides: SetOption = None,
    assumed: Annotated[
        list[str] | None,
        typer.Option(
            "--assume", metavar="KEY=VALUE", help="Replace an assumption, as mask_edge_nm=3."
        ),
    ] = None,
    pose: PoseOption = None,
    plot: PlotOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON.")] = False,
    list_assumptions: Annotated[
        bool, typer.Option("--assumptions", help="List what can be assumed, and stop.")
    ] = False,
) -> None:
    """Tabulate every error source: its size in x and y, its kind, and where the figure is from.

    [bold]Examples[/]

    rasnik budget solidras -o budget.png

    rasnik budget solidras --assume mask_edge_samples=15000 --assume air_pressure_hpa=0.01
    """
    system = load(system_name, overrides or ())

    from rasnik.instrument import SystemConfigError
    from rasnik.performance.assumptions import assume

    try:
        assumptions = assume(assumed or ())
    except SystemConfigError as error:
        fail(str(error))
    if list_assumptions:
        for name, info in type(assumptions).model_fields.items():
            output().print(f"{name} = {getattr(assumptions, name)}  [dim]# {info.description}[/]")
        return

    from rasnik.performance.budget import budget

    try:
        found = budget(system, assumptions, pose_of(pose))
    except (ValueError, TypeError) as error:
        fail(f"{error}.")
    if as_json:
        document = {
            "system": system.name,
            "plane": "mask",
            "sigma_x_nm": found.bound.sigma_x_nm,
            "sigma_y_nm": found.bound.sigma_y_nm,
            "rounding_counted": True,
            "assumptions": assumptions.model_dump(),
            "contributions": [asdict(one) for one in found.contributions],
        }
        typer.echo(json.dumps(document, indent=2))
    else:
        _print(found)
    if plot is not None:
        from rasnik.report.budget import draw_budget

        written(plot, lambda: draw_budget(found, plot), quiet=as_json)


def _print(found: Budget) -> None:
    from rich.markup import escape
    from rich.table import Table

    console = output()
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("source", "x (nm)", "y (nm)", "kind", "in time", "from", "section"):
        table.add_column(
            heading,
            justify="right" if "nm" in heading else "left",
            no_wrap=heading not in ("from", "section"),
        )
    for one in found.contributions:
        table.add_row(
            one.source,
            *("-" if value is None else f"{value:.2g}" for value in (one.x_nm, one.y_nm)),
            one.kind,
            one.time,
            escape(one.formula),
            escape(one.reference),
        )
    console.print(table)
    console.print(
        "\nwhite: new in every image; slow: drifts; fixed: the same in every image, felt as far "
        "as the mask moves.\nK: the fit as a linear estimator; Q: grey level of a pixel."
    )
    for time, meaning in (("white", "white"), ("slow", "slow"), ("fixed", "fixed")):
        x, y = found.total_nm(time)
        console.print(f"all {meaning}, root of squares: x {x:.3g} nm, y {y:.3g} nm")
    console.print(
        f"bound with rounding: x {found.bound.sigma_x_nm:.3g} nm, y {found.bound.sigma_y_nm:.3g} "
        "nm (shot noise, electronic noise and rounding together)"
    )
