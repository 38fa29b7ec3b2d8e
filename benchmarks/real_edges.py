"""Edges of real images: blur, asymmetry, and what of the image model's misfit has which cause.

    python benchmarks/real_edges.py FOLDER

The folder holds images and `reference.json`, a list of objects with `file`, `field_um`,
`pixel_um` and `bounds_left_top_right_bottom`. The numbers are printed as two Markdown tables;
nothing else is written.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image

from rasnik import Pose, analyse
from rasnik.characterisation.edges import Edges, edges
from rasnik.instrument import Optics, Sensor, System
from rasnik.mask import ChessField
from rasnik.report.numbers import with_sigma


def main() -> None:
    parser = argparse.ArgumentParser(description="Edges of real images, as Markdown tables.")
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    found = {}
    for row in json.loads((folder / "reference.json").read_text(encoding="utf-8")):
        found[Path(row["file"]).stem.removeprefix("Rasnik_")] = edges_of(folder, row)
    names = [one.name for one in next(iter(found.values())).causes]
    print("| image | blur x (px) | blur y (px) | excess kurtosis | edge shift (px) | rise |")
    print("|---|---|---|---|---|---|")
    for name, one in found.items():
        print(f"| {name} | {' | '.join(numbers(one))} |")
    print()
    print(f"| image | pose | {' | '.join(names)} |")
    print("|---|" + "---|" * (len(names) + 1))
    for name, one in found.items():
        steps = " | ".join(f"{cause.chi2_ndf:.2f}" for cause in one.causes)
        print(f"| {name} | {one.chi2_ndf:.2f} | {steps} |")


def analysed(folder: Path, row: dict) -> tuple[np.ndarray, Pose, System, tuple[int, int, int, int]]:
    """One image, its pose, system and bounds; of several positions that explain it the first."""
    with Image.open(folder / row["file"]) as opened:
        image = np.asarray(opened.convert("L"))
    system = System(
        name="image",
        mask=ChessField(field_um=row["field_um"]),
        optics=Optics(scale=1.0, blur_um=0.0),
        sensor=Sensor(
            width_px=image.shape[1],
            height_px=image.shape[0],
            pixel_um=row["pixel_um"],
            dark_level=0.0,
            light_level=255.0,
        ),
    )
    bounds = tuple(row["bounds_left_top_right_bottom"])
    pose = analyse(image, system, bounds=bounds)
    if not pose.ok:
        first = pose.candidates[0]
        prior = Pose(ok=True, x_um=first.x_um, y_um=first.y_um, orientation=first.orientation)
        pose = analyse(image, system, bounds=bounds, prior=prior)
    return image, pose, system, bounds


def edges_of(folder: Path, row: dict) -> Edges:
    return edges(*analysed(folder, row))


def numbers(one: Edges) -> list[str]:
    """Cells of the first table, in pixels."""
    pixel = one.pixel_um
    cells = [with_sigma(e.value / pixel, e.sigma / pixel) for e in (one.blur_x_um, one.blur_y_um)]
    shift = one.scale / pixel
    cells.append(with_sigma(*one.kurtosis))
    cells.append(with_sigma(one.edge_shift_um.value * shift, one.edge_shift_um.sigma * shift))
    return [*cells, f"{one.levelled:.2f}"]


if __name__ == "__main__":
    main()
