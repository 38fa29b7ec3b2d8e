"""Mask files of 10 mm x 10 mm with fields of 20 um: size, time, drawn area.

Run from the root of the checkout: ``python benchmarks/mask_files.py [field_um] [size_mm]``.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import gdstk
import klayout.db as kdb
import numpy as np

from rasnik import ChessField
from rasnik.mask_files import SUFFIXES, Plate, sized_mask, write_mask
from rasnik.mask_files.layout import LAYERS


def main(field_um: float = 20.0, size_mm: float = 10.0) -> None:
    bits = next(b for b in range(8, 24) if size_mm * 1000 / (b + 1) / field_um < 2**b)
    mask = sized_mask(ChessField(field_um=field_um, code_bits=bits), size_mm)
    plate = Plate(mask, title="benchmark")
    i0, i1, j0, j1 = mask.bounds_fields
    black = int(np.count_nonzero(mask.fields(i0, i1, j0, j1) == 0))
    area = black * round(field_um * 1000) ** 2
    print(f"{plate.label}: {i1} x {j1} fields, {black} drawn, {area / 1e12:.9f} mm^2")
    with tempfile.TemporaryDirectory() as folder:
        for suffix in SUFFIXES:
            dpi = 4 * 25_400 / field_um if suffix == ".png" else None
            seconds, path = best(lambda s=suffix, d=dpi: write_mask(f"{folder}/m{s}", plate, dpi=d))
            line = f"{suffix}  {path.stat().st_size / 1024:9.1f} KiB  {seconds:6.2f} s"
            if suffix in (".gds", ".oas"):
                line += f"  area by KLayout {klayout_area(path) - area:+d} nm^2"
                line += f", by gdstk {gdstk_area(path) - area / 1e6:+.3g} um^2"
            print(line)


def best(work, repeats: int = 3):
    """Shortest time of some, and the result."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - start)
    return min(times), result


def klayout_area(path: Path) -> int:
    layout = kdb.Layout()
    layout.read(str(path))
    shapes = layout.top_cell().begin_shapes_rec(layout.layer(LAYERS["fields"], 0))
    return kdb.Region(shapes).merged().area()


def gdstk_area(path: Path) -> float:
    library = gdstk.read_gds(path) if path.suffix == ".gds" else gdstk.read_oas(path)
    polygons = library.top_level()[0].get_polygons(layer=LAYERS["fields"], datatype=0)
    return sum(polygon.area() for polygon in polygons)


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
