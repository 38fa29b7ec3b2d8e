"""``rasnik design``: the best value of a parameter, and the steps the paper proposes."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rasnik.cli.common import fail, load, messages, output
from rasnik.cli.files import PlotOption, written
from rasnik.cli.predict import SetOption

if TYPE_CHECKING:
    from rasnik.performance.coupling import Coupling
    from rasnik.performance.design import Curve, Design, Variation

__all__ = ["design_command"]


def design_command(
    system_name: Annotated[
        str | None,
        typer.Argument(metavar="SYSTEM", help="Shipped system or TOML file.", show_default=False),
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            "--vary",
            metavar="KEY=LOW:HIGH[:N]",
            help="What to vary: a field of the system, sensor.area_mm2 or sensor.light_factor; "
            "KEY=A,B,C for single values. Twice for a map.",
        ),
    ] = None,
    overrides: SetOption = None,
    figure: Annotated[
        str | None, typer.Option("--figure", help="What to make small: sigma_x_nm, asd_x_pm_rthz.")
    ] = None,
    best_fields: Annotated[
        bool, typer.Option("--best-fields", help="The best field size at every point.")
    ] = False,
    rounding: Annotated[bool, typer.Option(help="Count the rounding to whole grey levels.")] = True,
    blur: Annotated[
        str, typer.Option(help="diffraction: follows wavelength and aperture; or fixed.")
    ] = "diffraction",
    light: Annotated[
        str, typer.Option(help="With the frame rate, keep electrons per image (well) or flux.")
    ] = "well",
    well: Annotated[
        str, typer.Option(help="With the pixel size, keep the full well per area or per pixel.")
    ] = "area",
    pixels: Annotated[
        str, typer.Option(help="With the pixel size, keep the sensor's area or pixel count.")
    ] = "area",
    improvements: Annotated[
        bool, typer.Option("--improvements", help="Only the table of the paper's proposals.")
    ] = False,
    plot: PlotOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON.")] = False,
) -> None:
    """Find the best value of one or two parameters of an instrument, by the Cramer-Rao bound.

    [bold]Examples[/]

    rasnik design solidras --vary mask.field_um=15:200 -o field.png

    rasnik design solidras --vary optics.wavelength_nm=200:600 --best-fields

    rasnik design microras --vary optics.scale=10:60:9 --vary mask.field_um=0.8:6:9 -o map.png

    rasnik design --improvements
    """
    if improvements:
        if system_name is not None or vary:
            fail("--improvements is a table of its own: give neither SYSTEM nor --vary.")
        _improvements(as_json)
        return
    if system_name is None:
        fail(
            "which system? Give its name, as in: rasnik design solidras --vary mask.field_um=20:99"
        )
    if not vary or len(vary) > 2:
        fail(
            "--vary is needed once for a curve or twice for a map, as --vary mask.field_um=20:200."
        )
    rules = _rules({"blur": blur, "light": light, "well": well, "pixels": pixels})
    system = load(system_name, overrides or ())

    from rasnik.performance.design import explore, parse_variation

    points = (21 if not best_fields else 9) if len(vary) == 1 else 9
    try:
        variations = [parse_variation(text, points) for text in vary]
        design = explore(
            system, variations, figure, rules, best_fields=best_fields, rounding=rounding
        )
        if len(variations) == 1:
            _curve(design, variations[0], plot, as_json)
        else:
            _map(design, variations, plot, as_json)
    except (ValueError, TypeError) as error:
        text = str(error)
        fail(text if text.endswith((".", "?")) else f"{text}.")


def _rules(chosen: dict[str, str]) -> Coupling:
    from rasnik.performance.coupling import Coupling

    choices = {
        "blur": ("diffraction", "fixed"),
        "light": ("well", "flux"),
        "well": ("area", "pixel"),
        "pixels": ("area", "count"),
    }
    for name, value in chosen.items():
        if value not in choices[name]:
            fail(f"--{name} must be {' or '.join(choices[name])}, not {value!r}.")
    return Coupling(**chosen)  # type: ignore[arg-type]


def _curve(design: Design, variation: Variation, plot: Any, as_json: bool) -> None:
    curve = design.curve(variation)
    if as_json:
        typer.echo(json.dumps(_curve_document(design, curve), indent=2))
    else:
        _print_curve(design, curve)
    if plot is not None:
        from rasnik.report.design import curve_figure, save_figure

        written(plot, lambda: save_figure(curve_figure(design, curve), plot), quiet=as_json)


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _curve_document(design: Design, curve: Curve) -> dict[str, Any]:
    key = curve.variation.key
    return {
        "system": design.system.name,
        "plane": "mask",
        "figure": design.figure,
        "rounding_counted": design.rounding,
        "best_fields": design.best_fields,
        "vary": key,
        "points": [
            {key: value, design.figure: _number(f), "field_um": _number(a)}
            | {"contour_mm": _number(length), "contrast": _number(contrast)}
            for value, f, a, length, contrast in zip(
                curve.variation.values,
                curve.figure.tolist(),
                curve.field_um.tolist(),
                curve.contour_mm.tolist(),
                curve.contrast.tolist(),
                strict=True,
            )
        ],
        "optimum": curve.optimum,
        "best": curve.best,
        "within_5_percent": list(curve.wide),
        "exponent": _number(curve.exponent),
    }


def _print_curve(design: Design, curve: Curve) -> None:
    from rich.table import Table

    from rasnik.performance.coupling import notes

    console = output()
    key = curve.variation.key
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in (key, design.figure, "field (µm)", "contours (mm)", "contrast"):
        table.add_column(heading, justify="right")
    for value, *rest in zip(
        curve.variation.values,
        curve.figure,
        curve.field_um,
        curve.contour_mm,
        curve.contrast,
        strict=True,
    ):
        cells = ("-" if math.isnan(one) else f"{one:.3g}" for one in rest)
        table.add_row(f"{value:.4g}", *cells)
    console.print(table)
    ends = curve.variation.values[0], curve.variation.values[-1]
    edge = ", the end of the range" if curve.optimum in ends else ""
    console.print(
        f"\nbest: {design.figure} = {curve.best:.4g} at {key} = {curve.optimum:.4g}{edge}"
    )
    console.print(f"within 5 % of it from {curve.wide[0]:.4g} to {curve.wide[1]:.4g}")
    if math.isfinite(curve.exponent):
        console.print(f"fitted over the range: {design.figure} ~ {key}^{curve.exponent:.2f}")
    for sentence in notes(design.system, [key], design.rules):
        console.print(f"({sentence})")
    _print_rest(design)


def _print_rest(design: Design) -> None:
    console = output()
    console.print(
        f"(rounding to whole grey levels {'counted' if design.rounding else 'not counted'})"
    )
    if design.failures:
        reason = next(iter(design.failures.values()))
        count = len(design.failures)
        points = "1 point" if count == 1 else f"{count} points, the first"
        console.print(f"(left out: {points}: {reason})", markup=False)


def _map(design: Design, variations: list[Variation], plot: Any, as_json: bool) -> None:
    import numpy as np

    first, second = variations
    figure = design.map(first, second)
    row, column = np.unravel_index(np.nanargmin(figure), figure.shape)
    best = {first.key: first.values[column], second.key: second.values[row]}
    if as_json:
        document = {
            "system": design.system.name,
            "plane": "mask",
            "figure": design.figure,
            "rounding_counted": design.rounding,
            first.key: list(first.values),
            second.key: list(second.values),
            "values": [[_number(one) for one in line] for line in figure.tolist()],
            "optimum": best,
            "best": float(figure[row, column]),
        }
        typer.echo(json.dumps(document, indent=2))
    else:
        _print_map(design, variations, figure.tolist())
        at = ", ".join(f"{key} = {value:.4g}" for key, value in best.items())
        output().print(f"\nbest: {design.figure} = {figure[row, column]:.4g} at {at}")
        _print_rest(design)
    if plot is not None:
        from rasnik.report.design import map_figure, save_figure

        drawing = map_figure(design, first, second, figure)
        written(plot, lambda: save_figure(drawing, plot), quiet=as_json)


def _print_map(design: Design, variations: list[Variation], figure: list[list[float]]) -> None:
    from rich.table import Table

    first, second = variations
    output().print(f"{design.figure}: {first.key} to the right, {second.key} down\n")
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("", justify="right", style="bold")
    for value in first.values:
        table.add_column(f"{value:.3g}", justify="right")
    for value, line in zip(second.values, figure, strict=True):
        table.add_row(f"{value:.3g}", *("-" if math.isnan(v) else f"{v:.3g}" for v in line))
    output().print(table)


def _improvements(as_json: bool) -> None:
    from dataclasses import asdict

    from rich.table import Table

    from rasnik.performance.improvements import improvements

    with messages().status("working out the bounds") as status:
        count = iter(range(1, 100))
        rows = improvements(lambda: status.update(f"working out the bounds: {next(count)} rows"))
    if as_json:
        typer.echo(json.dumps([asdict(row) for row in rows], indent=2))
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("step", "the paper says", "factor", "bound", "bound, best fields", "floor",
                    "floor, best fields"):  # fmt: skip
        table.add_column(
            heading, justify="left" if heading in ("step", "the paper says") else "right"
        )
    for row in rows:
        best = row.bound_factor_best
        floor = row.floor_best_pm_rthz
        table.add_row(
            row.step,
            row.paper,
            "-" if row.paper_factor is None else f"{row.paper_factor:.2f}",
            f"{row.bound_factor:.2f}",
            "-" if best is None else f"{best:.2f}",
            f"{row.floor_pm_rthz:.3g}",
            "-" if floor is None else f"{floor:.3g}",
        )
    output().print(table)
    output().print(
        "\nfactor: by how much the noise floor falls (below 1: rises). floor: sigma/√f in pm/√Hz "
        "on the mask after\nthe step, rounding counted. best fields: before and after, each with "
        "the field size that is best for it."
    )
