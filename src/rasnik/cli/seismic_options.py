"""What the commands of ``rasnik seismic`` share: the suspension and the files."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rasnik.cli.common import fail

if TYPE_CHECKING:
    from rasnik.seismic.suspension import Suspension

__all__ = [
    "PLOTS",
    "Axis",
    "CouplingOption",
    "Damping",
    "DampingOption",
    "FileOption",
    "FrequencyOption",
    "JsonOption",
    "MassOption",
    "OnMass",
    "OnMassOption",
    "PlotOption",
    "QOption",
    "suspension_of",
]

PLOTS = (".png", ".pdf", ".svg")
_PANEL = "Suspension"


class Damping(StrEnum):
    viscous = "viscous"
    structural = "structural"


class OnMass(StrEnum):
    mask = "mask"
    camera = "camera"


class Axis(StrEnum):
    x = "x"
    y = "y"


FileOption = Annotated[
    Path | None,
    typer.Option(
        "--suspension",
        metavar="FILE",
        help="TOML file with a table suspension or linkage; options replace its values.",
        rich_help_panel=_PANEL,
    ),
]
FrequencyOption = Annotated[
    float | None,
    typer.Option("--frequency", metavar="HZ", help="Natural.", rich_help_panel=_PANEL),
]
QOption = Annotated[
    float | None,
    typer.Option("--q", metavar="Q", help="Quality factor.", rich_help_panel=_PANEL),
]
MassOption = Annotated[
    float | None,
    typer.Option("--mass", metavar="KG", help="For the thermal noise.", rich_help_panel=_PANEL),
]
DampingOption = Annotated[
    Damping | None,
    typer.Option(help="By velocity, or by a loss angle.", rich_help_panel=_PANEL),
]
OnMassOption = Annotated[
    OnMass | None,
    typer.Option(
        "--on-mass",
        help="What the mass carries: it sets the sign. [default: mask]",
        rich_help_panel=_PANEL,
        show_default=False,
    ),
]
CouplingOption = Annotated[
    float | None,
    typer.Option(
        metavar="C", help="Driving acceleration per that of a point mass.", rich_help_panel=_PANEL
    ),
]
PlotOption = Annotated[
    Path | None, typer.Option("--plot", metavar="FILE", help="Plot: .png, .pdf or .svg.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON.")]


def suspension_of(
    path: Path | None,
    frequency_hz: float | None,
    q: float | None,
    mass_kg: float | None,
    damping: Damping | None,
    on_mass: OnMass | None,
    coupling: float | None,
) -> Suspension:
    """The suspension of a command, or the end of it."""
    from rasnik._config import SystemConfigError
    from rasnik.seismic.suspension_file import load_suspension

    values = {
        "frequency_hz": frequency_hz,
        "q": q,
        "mass_kg": mass_kg,
        "damping": None if damping is None else damping.value,
        "on_mass": None if on_mass is None else on_mass.value,
        "coupling": coupling,
    }
    try:
        return load_suspension(path, values)
    except SystemConfigError as error:
        fail(str(error))
