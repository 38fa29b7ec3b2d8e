"""Simulated frames in one file, or a folder, with their truth and the system inside.

TIFF
    One page per frame. The description of the first page is the truth as JSON.
HDF5
    ``/frames`` of shape (frames, height, width), one chunk per frame, and ``/truth``, a table
    with one row per frame. ``/frames`` has the attributes ``software``, ``seed``, ``units``,
    ``simulation`` (JSON) and ``system_toml``, ``/truth`` those but the system.
Folder
    Images, ``truth.json`` (the same JSON, with the name of each file) and ``system.toml``.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rasnik.instrument import System

__all__ = ["Frames", "RecordedTruth", "read_truth", "truth_as_json", "write_stack"]

UNITS = "x_um, y_um: um on the mask; theta_rad: rad; scale: image size / mask size"
_POSE = np.dtype(
    [
        ("x_um", "f8"),
        ("y_um", "f8"),
        ("scale", "f8"),
        ("theta_rad", "f8"),
        ("orientation", "i8"),
    ]
)
_STACK = "/frames"
# TIFF counts bytes in 32 bits; above this, a little below the limit, it is written as BigTIFF.
_BIG_TIFF = 4_000_000_000


class Frames(Protocol):
    """What is written: a `rasnik.imaging.simulate.Simulation`, or anything like it."""

    @property
    def system(self) -> System: ...
    @property
    def truth(self) -> tuple[Any, ...]: ...
    @property
    def seed(self) -> int: ...
    @property
    def described(self) -> dict[str, Any]: ...
    @property
    def dtype(self) -> np.dtype[Any]: ...
    def __len__(self) -> int: ...
    def __iter__(self) -> Any: ...


@dataclass(frozen=True)
class RecordedTruth:
    """The truth read back.

    Attributes
    ----------
    poses : list of dict
        One per frame: x_um, y_um, scale, theta_rad, orientation; in a folder also ``file``.
    system : System
        What the frames were made with.
    seed : int
    software : str
        Name and version of the program that wrote them.
    simulation : dict
        How they were made: path, noise, and effects with their parameters.
    """

    poses: list[dict[str, Any]]
    system: System
    seed: int
    software: str
    simulation: dict[str, Any]


def _header(simulation: Frames) -> dict[str, Any]:
    from rasnik import __version__

    return {
        "software": f"rasnik {__version__}",
        "seed": simulation.seed,
        "units": UNITS,
        "simulation": simulation.described,
        "system_toml": simulation.system.to_toml(),
    }


def truth_as_json(simulation: Frames, files: Iterable[str] | None = None) -> str:
    """Truth and system as JSON; `files` names the image of each frame."""
    poses = [truth.as_dict() for truth in simulation.truth]
    if files is not None:
        poses = [{"file": name, **pose} for name, pose in zip(files, poses, strict=True)]
    return json.dumps({**_header(simulation), "frames": poses}, indent=1) + "\n"


def write_stack(path: Path | str, simulation: Frames) -> None:
    """Write all frames into one file, one at a time.

    Parameters
    ----------
    path : path
        Ends in ``.tif``, ``.tiff``, ``.h5`` or ``.hdf5``. A file of that name is replaced.
    simulation : Frames
        Frames with truth, system and seed.

    Raises
    ------
    ValueError
        If the name has another ending.
    OSError
        If the file cannot be written.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".tif" | ".tiff":
            _write_tiff(path, simulation)
        case ".h5" | ".hdf5":
            _write_hdf5(path, simulation)
        case other:
            raise ValueError(
                f"{path}: a stack is written as .tif, .tiff, .h5 or .hdf5, not {other or 'this'}"
            )


def _write_tiff(path: Path, simulation: Frames) -> None:
    import tifffile

    height, width = simulation.system.shape
    # Programs that read TIFF know floats of single precision; of double, few.
    dtype = np.dtype(np.float32) if simulation.dtype == np.float64 else simulation.dtype
    size = len(simulation) * height * width * dtype.itemsize
    description: str | None = truth_as_json(simulation)
    with tifffile.TiffWriter(path, bigtiff=size > _BIG_TIFF) as writer:
        for frame, _ in simulation:
            writer.write(
                frame.astype(dtype, copy=False),
                photometric="minisblack",
                description=description,
                metadata=None,
            )
            description = None


def _write_hdf5(path: Path, simulation: Frames) -> None:
    import h5py

    count, shape = len(simulation), simulation.system.shape
    table = np.zeros(count, _POSE)
    for row, truth in zip(table, simulation.truth, strict=True):
        for name, value in truth.as_dict().items():
            row[name] = value
    header = _header(simulation)
    with h5py.File(path, "w") as file:
        frames = file.create_dataset(
            _STACK, (count, *shape), simulation.dtype, chunks=(1, *shape), track_times=False
        )
        poses = file.create_dataset("/truth", data=table, track_times=False)
        for key, value in header.items():
            # Seeds may need all 64 bits.
            if key == "seed" and value < 2**64:
                stored: Any = np.uint64(value)
            else:
                stored = json.dumps(value) if key == "simulation" else str(value)
            frames.attrs[key] = stored
            if key != "system_toml":
                poses.attrs[key] = stored
        for k, (frame, _) in enumerate(simulation):
            frames[k] = frame


def read_truth(path: Path | str) -> RecordedTruth:
    """The truth of simulated frames, from a stack, a folder, or its ``truth.json``.

    Raises
    ------
    ValueError
        If there is no truth in it, or it is damaged.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "truth.json"
        if not path.exists():
            raise ValueError(f"{path.parent}: the folder holds no truth.json")
    match path.suffix.lower():
        case ".h5" | ".hdf5":
            return _read_hdf5(path)
        case ".tif" | ".tiff":
            import tifffile

            try:
                with tifffile.TiffFile(path) as tif:
                    text = tif.pages.first.description
            except tifffile.TiffFileError as error:
                raise ValueError(f"{path}: the TIFF file cannot be read ({error})") from None
        case _:
            text = path.read_text(encoding="utf-8")
    try:
        data = json.loads(text)
        parts = list(data["frames"]), data["system_toml"], data["seed"], data["software"]
        made = dict(data.get("simulation", {}))
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: there is no truth of simulated frames in it") from None
    return _recorded(path, *parts, made)


def _read_hdf5(path: Path) -> RecordedTruth:
    import h5py

    with h5py.File(path, "r") as file:
        frames, table = file.get(_STACK), file.get("/truth")
        if table is None or frames is None or table.dtype.names != _POSE.names:
            raise ValueError(f"{path}: there is no truth of simulated frames in it")
        rows: NDArray[Any] = table[:]
        header = {
            key: frames.attrs[key] for key in ("system_toml", "seed", "software", "simulation")
        }
    poses = [{name: row[name].item() for name in rows.dtype.names or ()} for row in rows]
    made = json.loads(header["simulation"])
    return _recorded(
        path, poses, header["system_toml"], int(header["seed"]), header["software"], made
    )


def _recorded(
    path: Path, poses: list[Any], toml: str, seed: int, software: str, made: dict[str, Any]
) -> RecordedTruth:
    try:
        system = System.model_validate(tomllib.loads(toml))
        return RecordedTruth(poses, system, int(seed), software, made)
    except ValueError as error:
        raise ValueError(f"{path}: the system in it cannot be read: {error}") from None
