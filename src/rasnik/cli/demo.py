"""``rasnik demo``: simulate, analyse, compare."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from rasnik.cli.common import fail, messages, output

if TYPE_CHECKING:
    from rasnik.report.demo import Demo

__all__ = ["demo_command"]

_ROWS = 6


def demo_command(
    folder: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the plots.")
    ] = Path("demo"),
    count: Annotated[int, typer.Option("-n", min=1, help="Images to simulate.")] = 30,
    seed: Annotated[int, typer.Option(min=0, help="Other images with another seed.")] = 1,
) -> None:
    """Simulate a SolidRas, find the mask in its images, and compare with the truth.

    Images of the mask at random poses, with the noise of the sensor, are analysed without
    knowing anything but field and pixel size.

    [bold]Example[/]

    rasnik demo -o demo
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fail(f"the folder {folder} cannot be made: {error.strerror}.")

    from rasnik.report.demo import run_demo, save_plots

    console = messages()
    if console.is_terminal:
        from rich.progress import track

        steps = iter(track(range(count), "simulating and analysing", console=console))
        next(steps)
        demo = run_demo(count=count, seed=seed, advance=lambda: next(steps, None))
    else:
        demo = run_demo(count=count, seed=seed)
    _print_rows(demo)
    _print_summary(demo)
    for path in save_plots(demo, folder):
        output().print(escape(f"written: {path}"))
    if not demo.found.all():
        raise typer.Exit(1)


def _print_rows(demo: Demo) -> None:
    """The first images: truth, what was found, difference, and predicted error."""
    from rich.table import Table

    from rasnik.report.numbers import rounded

    height, width = demo.system.shape
    output().print(
        f"{demo.system.name}: {len(demo.poses)} simulated images of {width} x {height} pixels "
        f"of {demo.system.pitch_um:g} µm, fields of {demo.system.mask.field_um:g} µm\n"
    )
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("image", "", "truth (µm)", "found (µm)", "difference (nm)", "sigma (nm)"):
        table.add_column(heading, justify="right")
    for k, (pose, truth) in enumerate(zip(demo.poses, demo.simulation.truth, strict=True)):
        if k == _ROWS:
            break
        for symbol, name in (("x", "x_um"), ("y", "y_um")):
            sigma = getattr(pose, f"sigma_{name}")
            table.add_row(
                str(k) if symbol == "x" else "",
                symbol,
                rounded(getattr(truth, name), sigma),
                rounded(getattr(pose, name), sigma) if pose.ok else ", ".join(pose.flags.names),
                f"{1e3 * demo.errors(name)[k]:+.2f}",
                f"{1e3 * sigma:.2f}",
            )
    output().print(table)
    if len(demo.poses) > _ROWS:
        output().print(f"... and {len(demo.poses) - _ROWS} more\n")


def _print_summary(demo: Demo) -> None:
    """Errors of all images against the bound."""
    from rich.table import Table

    from rasnik.report.demo import PARAMETERS

    found = int(demo.found.sum())
    output().print(f"{found} of {len(demo.poses)} positions found")
    if not found:
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    headings = ("parameter", "rms error", "Cramer-Rao bound", "ratio", "unit")
    for heading in headings:
        table.add_column(heading, justify="right" if heading != "unit" else "left")
    for parameter in PARAMETERS:
        rms, bound = demo.rms(parameter.name), demo.bound(parameter.name)
        table.add_row(
            parameter.symbol,
            f"{rms * parameter.factor:.3f}",
            f"{bound * parameter.factor:.3f}",
            f"{rms / bound:.2f}",
            parameter.unit,
        )
    output().print(table)
    chance = 100 / (2 * found) ** 0.5
    output().print(f"(of {found} images, the ratio varies by {chance:.0f} % by chance)\n")
