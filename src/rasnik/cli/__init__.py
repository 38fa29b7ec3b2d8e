"""The command ``rasnik``: one module for each of its commands."""

from __future__ import annotations

from typing import Annotated

import typer

from rasnik.cli.align import align_command
from rasnik.cli.analyse import analyse_command
from rasnik.cli.archive import archive_app
from rasnik.cli.budget import budget_command
from rasnik.cli.demo import demo_command
from rasnik.cli.design import design_command
from rasnik.cli.doctor import doctor_command
from rasnik.cli.edges import edges_command
from rasnik.cli.export import export_command
from rasnik.cli.geometry import geometry_command
from rasnik.cli.linearity import linearity_command
from rasnik.cli.live import live_command
from rasnik.cli.mask import mask_command
from rasnik.cli.noise import noise_command
from rasnik.cli.paper import paper_command
from rasnik.cli.predict import predict_command
from rasnik.cli.resolution import resolution_command
from rasnik.cli.seismic import seismic_app
from rasnik.cli.simulate import simulate_command
from rasnik.cli.spectrum import spectrum_command
from rasnik.cli.systems import systems_command
from rasnik.cli.track import track_command

__all__ = ["app"]

app = typer.Typer(
    name="rasnik",
    help="Where a coded mask stands, from images of it.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from rasnik import __version__

        typer.echo(f"rasnik {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    pass


app.command("analyse")(analyse_command)
app.command("track")(track_command)
app.command("live")(live_command)
app.command("export")(export_command)
app.command("simulate")(simulate_command)
app.command("systems")(systems_command)
app.command("demo")(demo_command)
app.command("mask")(mask_command)
app.command("predict")(predict_command)
app.command("budget")(budget_command)
app.command("noise")(noise_command)
app.command("design")(design_command)
app.command("geometry")(geometry_command)
app.command("edges")(edges_command)
app.command("resolution")(resolution_command)
app.command("linearity")(linearity_command)
app.command("paper")(paper_command)
app.command("spectrum")(spectrum_command)
app.command("align")(align_command)
app.command("doctor")(doctor_command)
app.add_typer(archive_app, name="archive")
app.add_typer(seismic_app, name="seismic")
