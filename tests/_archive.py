"""Small archives, made once and copied."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from rasnik import System, load_system, simulate
from rasnik.archive.cluster import Here
from rasnik.archive.dataset import Dataset, open_dataset
from rasnik.archive.plan import Limits
from rasnik.archive.run import ArchiveRun, absolute_sources
from rasnik.archive.sources import Item
from rasnik.archive.systems_table import InstrumentSettings, SystemsTable

#: Small, and with enough of the mask in view to tell the position everywhere.
CHANGES = {
    "sensor.width_px": 200,
    "sensor.height_px": 152,
    "mask.field_um": 60.0,
    "optics.blur_um": 8.0,
    "optics.orientation": 4,
}
SMALL: System = load_system("atlas-ccd", CHANGES)
SETTINGS = InstrumentSettings(SMALL)
#: Arguments of the command for the same.
INSTRUMENT = [
    "--system",
    "atlas-ccd",
    *(word for key, value in CHANGES.items() for word in ("--set", f"{key}={value}")),
]
NOON_S = 1_770_000_000.0 - 1_770_000_000.0 % 86400 + 43200
POSES = [(4000.0 + 0.2 * k, 5000.0 - 0.1 * k, 0.002) for k in range(12)]
FRAMES = np.stack([frame for frame, _ in simulate(SMALL, POSES, seed=2)])


def save(path: Path, frame: np.ndarray, time_s: float = NOON_S) -> Path:
    """An image file with a time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(frame).save(path)
    os.utime(path, (time_s, time_s))
    return path


def save_folder(folder: Path, n: int = 4, every_s: float = 60.0) -> Path:
    """The first n frames as PNG files."""
    for k in range(n):
        save(folder / f"image{k}.png", FRAMES[k % len(FRAMES)], NOON_S + k * every_s)
    return folder


def item(name: str, instrument: str = "a", size: int = 1000, modified_s: float = NOON_S) -> Item:
    return Item(name, None, instrument, size, modified_s)


def analyse_archive(
    source: Path | Iterable[Path],
    dataset: Path,
    *,
    table: SystemsTable | None = None,
    limits: Limits | None = None,
    pool: Callable[[], object] = Here,
    **options: object,
) -> ArchiveRun:
    """Analyse what is new in a source; the run."""
    sources = [source] if isinstance(source, Path) else list(source)
    with Dataset(dataset) as opened:
        run = ArchiveRun(
            absolute_sources(map(str, sources)),
            table or SystemsTable.for_all(SMALL),
            opened,
            limits=limits or Limits(),
            **options,
        )
        run.run(pool())
    return run


def rows(dataset: Path, columns: list[str] | None = None) -> list[dict[str, object]]:
    """All rows, ordered by instrument, file and frame."""
    table = open_dataset(dataset).to_table(columns=columns)
    return sorted(table.to_pylist(), key=lambda row: (row["instrument"], row["file"], row["frame"]))


def keys(dataset: Path) -> list[tuple[str, str, int]]:
    """(instrument, name of the file, frame) of all rows, in order."""
    found = rows(dataset, ["instrument", "file", "frame"])
    return [(row["instrument"], Path(row["file"]).name, row["frame"]) for row in found]
