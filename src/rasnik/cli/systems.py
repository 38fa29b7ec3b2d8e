"""``rasnik systems``: what instruments are shipped."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rasnik.cli.common import load, output

__all__ = ["systems_command"]


def systems_command(
    name: Annotated[
        str | None,
        typer.Argument(
            help="Print this system's TOML file, with the sources of its values, "
            "to start one of your own from."
        ),
    ] = None,
) -> None:
    """List the systems shipped with the package, or print one of them.

    [bold]Examples[/]

    rasnik systems

    rasnik systems solidras > mine.toml
    """
    if name is not None:
        _print_file(name)
        return
    from rich.table import Table

    from rasnik.instrument import load_system, system_names

    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("name", "field", "scale", "pixels", "pixel", "px/field", "description"):
        table.add_column(heading, justify="left" if heading in "name description" else "right")
    for each in system_names():
        system = load_system(each)
        height, width = system.shape
        table.add_row(
            each,
            f"{system.mask.field_um:g} µm",
            f"{system.optics.scale:g}",
            f"{width} x {height}",
            f"{system.pitch_um:g} µm",
            f"{system.pixels_per_field:.1f}",
            system.description,
        )
    output().print(table)


def _print_file(name: str) -> None:
    from importlib import resources

    system = load(name, ())
    if Path(name).is_file():
        text = Path(name).read_text(encoding="utf-8")
    else:
        file = resources.files("rasnik") / "systems" / f"{system.name}.toml"
        text = file.read_text(encoding="utf-8")
    typer.echo(text, nl=False)
