"""``rasnik simulate``: noisy images with their truth."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from rasnik.cli.common import fail, load, messages, numbers

if TYPE_CHECKING:
    from rasnik.imaging.simulate import Simulation

__all__ = ["ImageFormat", "simulate_command"]

_POSE = "x_um,y_um,theta_rad,scale,orientation"


class ImageFormat(StrEnum):
    """Formats that simulated images are written in."""

    PNG = "png"
    TIFF = "tiff"
    NPY = "npy"


def simulate_command(
    system: Annotated[str, typer.Argument(help="Name of a system, or path of a TOML file.")],
    folder: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to write to.")
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
        ImageFormat, typer.Option("--format", help="Format of the images.")
    ] = ImageFormat.PNG,
    noise: Annotated[bool, typer.Option(help="With the noise of the sensor.")] = True,
) -> None:
    """Simulate images of a mask and write them with the truth they were made from.

    The folder then holds the images, truth.json (the pose of each file) and system.toml.

    [bold]Examples[/]

    rasnik simulate solidras --pose 41000,30200 -n 10 -o sim

    rasnik simulate solidras --pose 41000,30200,0.002,1,4 --set optics.blur_um=9 --seed 1 -o sim

    rasnik simulate mine.toml -n 100 --format npy -o sim
    """
    from rasnik.imaging.simulate import simulate

    instrument = load(system, settings or ())
    poses = [numbers(text, "--pose", _POSE, 2) for text in pose] if pose else None
    quantise = None if image_format is ImageFormat.NPY else True
    try:
        simulation = simulate(instrument, poses, n=count, seed=seed, noise=noise, quantise=quantise)
    except ValueError as error:
        fail(f"{error}.")
    digits = max(4, len(str(len(simulation) - 1)))
    names = [f"frame_{k:0{digits}d}.{image_format.value}" for k in range(len(simulation))]
    _prepare(folder, names)
    for name, (frame, _) in zip(names, simulation, strict=True):
        _save(folder / name, frame)
    _save_truth(folder, names, simulation)
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


def _save_truth(folder: Path, names: list[str], simulation: Simulation) -> None:
    from rasnik import __version__

    system = simulation.system.to_toml()
    truth = {
        "software": f"rasnik {__version__}",
        "seed": simulation.seed,
        "units": "x_um, y_um: um on the mask; theta_rad: rad; scale: image size / mask size",
        "system_toml": system,
        "frames": [
            {"file": name, **pose.as_dict()}
            for name, pose in zip(names, simulation.truth, strict=True)
        ],
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    (folder / "system.toml").write_text(system, encoding="utf-8")
