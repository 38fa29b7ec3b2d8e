"""``rasnik simulate``: noisy images with their truth."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from rasnik.cli.common import fail, load, messages, numbers

if TYPE_CHECKING:
    from rasnik.imaging.simulate import Simulation, Truth
    from rasnik.instrument import System

__all__ = ["ImageFormat", "simulate_command"]


class ImageFormat(StrEnum):
    """Formats that simulated images are written in."""

    PNG = "png"
    TIFF = "tiff"
    NPY = "npy"
    H5 = "h5"
    LWDAQ = "lwdaq"


class PathName(StrEnum):
    """Ways to compute the expected image."""

    EXACT = "exact"
    PAPER = "paper"


_STACK_ENDINGS = {
    ".h5": ImageFormat.H5,
    ".hdf5": ImageFormat.H5,
    ".tif": ImageFormat.TIFF,
    ".tiff": ImageFormat.TIFF,
}
_POSE = "x_um,y_um,theta_rad,scale,orientation"


def _list_effects(wanted: bool) -> None:
    if not wanted:
        return
    from rich.console import Console
    from rich.table import Table

    from rasnik.imaging.effects import EFFECTS

    table = Table(title="Effects, in the order in which an image meets them", show_lines=False)
    for heading in ("stage", "name", "what it does", "parameter", "default", "unit", "more"):
        table.add_column(heading, overflow="fold")
    for info in EFFECTS.values():
        more = ", ".join(f"{name}={'system' if v is None else v}" for name, v in info.options)
        default = "system's" if info.default is None else f"{info.default:g}"
        name = f"{info.name} (on)" if info.always_on else info.name
        table.add_row(
            info.stage, name, info.summary, info.parameter, default, info.unit or "1", more
        )
    console = Console()
    if console.width < 120 and not console.is_terminal:
        console = Console(width=160)
    console.print(table)
    raise typer.Exit


def simulate_command(
    system: Annotated[str, typer.Argument(help="Name of a system, or path of a TOML file.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="Folder of images to write to, or one file that ends in .h5, .tif or .tiff.",
        ),
    ],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="K=V", help="Change a value of the system; repeatable."),
    ] = None,
    pose: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y[,THETA[,SCALE[,ORIENT]]]",
            help="Pose in um and rad; repeatable. What is left out is the system's. "
            "By default every image has a random position.",
        ),
    ] = None,
    count: Annotated[int, typer.Option("-n", min=1, help="Images of each pose.")] = 1,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Makes the same images again; random by default.")
    ] = None,
    image_format: Annotated[
        ImageFormat | None,
        typer.Option(
            "--format",
            help="Format of the images: png unless the name of the output tells. h5 is one file, "
            "lwdaq PNG with the header of LWDAQ in row 0.",
            show_default=False,
        ),
    ] = None,
    noise: Annotated[bool, typer.Option(help="With the noise of the sensor.")] = True,
    path: Annotated[
        PathName,
        typer.Option(help="How images are computed: exactly, or by points as the paper does."),
    ] = PathName.EXACT,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=VALUE[,KEY=VALUE]]",
            help="A source of error, 0 to switch it off; repeatable. See --list-effects.",
        ),
    ] = None,
    motion: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME:KEY=VALUE[,...]",
            help="drift, sine, seismic, steps, or table:FILE.csv, at the system's frame rate; "
            "repeatable, they add up. -n is then the length of the sequence.",
        ),
    ] = None,
    _list: Annotated[
        bool,
        typer.Option(
            "--list-effects",
            callback=_list_effects,
            is_eager=True,
            help="Show the table of effects and stop.",
        ),
    ] = False,
) -> None:
    """Simulate images of a mask and write them with the truth they were made from.

    A folder then holds the images, truth.json (the pose of each file) and system.toml; an HDF5
    or TIFF file holds all frames with truth and system.

    [bold]Examples[/]

    rasnik simulate solidras --pose 41000,30200 -n 10 -o sim

    rasnik simulate solidras --pose 41000,30200,0.002,1,4 --set optics.blur_um=9 --seed 1 -o sim

    rasnik simulate mine.toml -n 100 --format npy -o sim

    rasnik simulate solidras -n 1000 --motion sine:hz=2,x_um=0.5 --effect mask_edges=6 -o sim.h5
    """
    from rasnik.imaging.simulate import simulate

    instrument = load(system, settings or ())
    poses = [numbers(text, "--pose", _POSE, 2) for text in pose] if pose else None
    quantise = None if image_format is ImageFormat.NPY else True
    try:
        simulation = simulate(
            instrument,
            poses,
            n=count,
            seed=seed,
            noise=noise,
            quantise=quantise,
            path=path.value,
            effects=effect,
            motion=motion,
        )
    except ValueError as error:
        fail(f"{error}.")
    if output.suffix.lower() in _STACK_ENDINGS:
        _write_stack(output, simulation, image_format)
    elif image_format is ImageFormat.H5:
        fail(f"{output} must end in .h5 for an HDF5 file.")
    else:
        _write_folder(output, simulation, image_format or ImageFormat.PNG)


def _write_stack(path: Path, simulation: Simulation, image_format: ImageFormat | None) -> None:
    from rasnik.io.stacks import write_stack

    if image_format is not None and _STACK_ENDINGS[path.suffix.lower()] is not image_format:
        fail(f"{path} does not end as --format {image_format.value} asks for.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_stack(path, simulation)
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror or error}.")
    messages().print(
        f"{len(simulation)} images with truth and system written to {escape(str(path))}"
    )


def _write_folder(folder: Path, simulation: Simulation, image_format: ImageFormat) -> None:
    from rasnik.io.stacks import truth_as_json

    if image_format is ImageFormat.PNG and simulation.dtype.kind == "f":
        fail("png cannot hold levels that are not rounded; use --format npy, tiff or h5.")
    digits = max(4, len(str(len(simulation) - 1)))
    ending = "png" if image_format is ImageFormat.LWDAQ else image_format.value
    names = [f"frame_{k:0{digits}d}.{ending}" for k in range(len(simulation))]
    _prepare(folder, names)
    for name, (frame, truth) in zip(names, simulation, strict=True):
        if image_format is ImageFormat.LWDAQ:
            _save_for_lwdaq(folder / name, frame, truth, simulation.system)
        else:
            _save(folder / name, frame)
    text = truth_as_json(simulation, names)
    (folder / "truth.json").write_text(text, encoding="utf-8")
    (folder / "system.toml").write_text(simulation.system.to_toml(), encoding="utf-8")
    messages().print(
        f"{len(names)} images, truth.json and system.toml written to {escape(str(folder))}"
    )


def _prepare(folder: Path, names: list[str]) -> None:
    """Make the folder; refuse one in which images of another simulation would stay."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fail(f"the folder {folder} cannot be made: {error.strerror}.")
    stale = sorted(path.name for path in folder.glob("frame_*.*") if path.name not in names)
    if stale:
        fail(
            f"{folder} holds images of another simulation ({stale[0]}); "
            "name another folder or empty this one."
        )


def _save_for_lwdaq(path: Path, frame: Any, truth: Truth, system: System) -> None:
    """The header's text is the truth, as a result of LWDAQ."""
    import numpy as np

    from rasnik.analysis.pose import Pose
    from rasnik.io.lwdaq import write_lwdaq_image
    from rasnik.io.lwdaq_results import LwdaqResult

    pose = Pose(
        ok=True,
        x_um=truth.x_um,
        y_um=truth.y_um,
        scale=truth.scale,
        theta_rad=truth.theta_rad,
        orientation=truth.orientation,
        covariance=np.zeros((4, 4)),
    )
    sizes = {"square_um": system.mask.field_um, "pixel_um": system.pitch_um}
    try:
        text = LwdaqResult.from_pose(pose, shape=system.shape, **sizes).text()
        write_lwdaq_image(path, frame, text=text)
    except ValueError as error:
        fail(f"{path}: {error}.")


def _save(path: Path, frame: Any) -> None:
    match path.suffix:
        case ".npy":
            import numpy as np

            np.save(path, frame)
        case ".tiff":
            import tifffile

            tifffile.imwrite(path, frame, photometric="minisblack")
        case _:
            from PIL import Image

            Image.fromarray(frame).save(path)
