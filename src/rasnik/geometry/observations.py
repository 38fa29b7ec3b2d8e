"""Readings of the Rasniks of an installation: from tables of numbers or analysed images."""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik._config import SystemConfigError, read_toml
from rasnik.geometry.network import Network
from rasnik.instrument import scales_contradict

__all__ = ["Readings", "contradictions", "parse_readings", "read_readings", "write_readings"]

Array = NDArray[np.float64]

_VALUES = ("x_um", "y_um", "scale", "theta_rad")
_SIGMAS = ("sigma_x_um", "sigma_y_um", "sigma_scale", "sigma_theta_rad")
# As much as distances may be wrong: a tenth of a motion along x then shows along y.
_TURNED_RAD = 0.1


@dataclass(frozen=True, eq=False)
class Readings:
    """One reading of each Rasnik of an installation, as far as there are any.

    Attributes
    ----------
    values : ndarray, shape (rasniks, 4)
        x, y (um), scale, theta_z (rad); NaN where nothing was read. theta_z is told with respect
        to the orientation code of the network.
    sigmas : ndarray, shape (rasniks, 4)
        What came with the readings; NaN where nothing did.
    problems : tuple of str
        A sentence for each reading that cannot be used.
    """

    values: Array
    sigmas: Array
    problems: tuple[str, ...] = field(default=())


def read_readings(network: Network, path: str | PathLike[str]) -> Readings:
    """Readings from a file.

    Parameters
    ----------
    network : Network
    path : path-like
        ``.csv``: a header line, one row for each Rasnik. ``.json``: a list of objects, or an
        object with one for each name. ``.jsonl``: an object on each line. ``.toml``: a table for
        each name. Keys: ``name``, ``x_um``, ``y_um``, ``scale``, ``theta_rad``, ``sigma_*`` of
        each. Results of ``rasnik analyse`` are taken as they are: the name is that of the image
        file, or of the folder that it lies in.

    Returns
    -------
    Readings

    Raises
    ------
    ValueError
        If the file is not such a table.
    OSError
        If it cannot be read.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".toml":
        try:
            return parse_readings(network, _rows(read_toml(path), path))
        except SystemConfigError as error:
            raise ValueError(str(error)) from None
    if suffix not in (".csv", ".json", ".jsonl"):
        raise ValueError(f"{path}: readings are .csv, .json, .jsonl or .toml")
    try:
        text = path.read_text(encoding="utf-8-sig")
        if suffix == ".csv":
            rows: list[Any] = _table(text, path)
        elif suffix == ".jsonl":
            rows = [_json(line, path) for line in text.splitlines() if line.strip()]
        else:
            rows = _rows(_json(text, path), path)
    except (json.JSONDecodeError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: this cannot be read as {suffix[1:]}: {error}") from None
    return parse_readings(network, rows)


def _once(names: Sequence[str], path: Path) -> None:
    """Refuse what readers of files would let the last of its name decide."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise ValueError(f"{path}: {', '.join(twice)} must not stand more than once")


def _json(text: str, path: Path) -> Any:
    def table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        _once([name for name, _ in pairs], path)
        return dict(pairs)

    return json.loads(text, object_pairs_hook=table)


def _table(text: str, path: Path) -> list[Any]:
    """Rows of a CSV table."""
    lines = csv.DictReader(text.splitlines(), skipinitialspace=True)
    columns = lines.fieldnames = [one.strip() for one in lines.fieldnames or ()]
    _once([one for one in columns if one], path)
    if columns and not {"name", "file"} & set(columns):
        other = next((mark for mark in ";\t" if mark in columns[0]), None)
        hint = "" if other is None else f"; columns are separated by commas, not by {other!r}"
        raise ValueError(f"{path}: the header line needs a column 'name'{hint}")
    return list(lines)


def _rows(content: Any, path: Path) -> list[Any]:
    if isinstance(content, dict) and isinstance(content.get("readings"), list | dict):
        content = content["readings"]
    if isinstance(content, list):
        return content
    if isinstance(content, dict) and "x_um" not in content:
        return [
            {"name": name, **row} if isinstance(row, dict) else row for name, row in content.items()
        ]
    raise ValueError(
        f"{path}: this holds no readings; give a list of objects with name, x_um, y_um, scale, "
        "theta_rad, or an object with one for each name"
    )


def parse_readings(network: Network, rows: Iterable[Any]) -> Readings:
    """Readings from rows of a table; a row that cannot be used is named, and left out.

    Parameters
    ----------
    network : Network
    rows : iterable of mappings
        With the keys of `read_readings`; texts are read as numbers, empty ones are not known.

    Returns
    -------
    Readings
    """
    shape = (len(network.rasniks), 4)
    values, sigmas = np.full(shape, np.nan), np.full(shape, np.nan)
    problems: list[str] = []
    seen: dict[str, int] = {}
    for number, row in enumerate(rows, 1):
        if not isinstance(row, Mapping):
            problems.append(f"reading {number} is {row!r}: it should be a table of values")
            continue
        name = _name(network, row)
        if name is None:
            given = row.get("name") or row.get("file")
            problems.append(
                f"reading {number} is of {given!r}, but there is no such Rasnik in "
                f"{network.installation.name}"
                if given
                else f"reading {number} has no name"
            )
            continue
        seen[name] = seen.get(name, 0) + 1
        index = network.rasniks.index(name)
        try:
            values[index], sigmas[index] = _numbers(network, index, row)
        except ValueError as error:
            problems.append(f"the reading of {name} is left out: {error}")
    for name, count in seen.items():
        if count > 1:
            problems.append(
                f"there are {count} readings of {name} and none is used; give one, such as the mean"
            )
            values[network.rasniks.index(name)] = np.nan
    missing = [name for name in network.rasniks if name not in seen]
    if missing:
        problems.append(f"there is no reading of {', '.join(missing)}")
    return Readings(values, sigmas, tuple(problems))


def _name(network: Network, row: Mapping[str, Any]) -> str | None:
    """The Rasnik a row is of: by its name, its image file or the folder of that."""
    names = [row.get("name"), row.get("instrument")]
    if row.get("file"):
        file = Path(str(row["file"]))
        names += [file.name, file.stem, file.parent.name]
    return next((str(name) for name in names if name and str(name) in network.rasniks), None)


def _numbers(network: Network, index: int, row: Mapping[str, Any]) -> tuple[Array, Array]:
    """Values and sigmas of a row; raises ValueError with what is wrong with it."""
    if None in row:  # so csv calls what stands beyond the last column
        raise ValueError(
            "it has more values than the header line has columns; numbers have a decimal point, "
            "not a comma"
        )
    if row.get("ok") in (False, "false", "False", 0):
        flags = row.get("flags") or row.get("error") or "no position"
        shown = ", ".join(flags) if isinstance(flags, list) else str(flags)
        raise ValueError(f"its analysis failed ({shown})")
    values = np.array([_number(row, key) for key in _VALUES])
    sigmas = np.array([_number(row, key) for key in _SIGMAS])
    if np.isnan(values).all():
        raise ValueError("it holds none of x_um, y_um, scale, theta_rad")
    if values[2] <= 0:
        raise ValueError(f"scale = {values[2]:g} is not positive")
    for key, sigma in zip(_SIGMAS, sigmas, strict=True):
        if sigma <= 0:
            raise ValueError(f"{key} = {sigma:g} is not positive")
    code = row.get("orientation")
    if code not in (None, "", 0, "0"):
        here, there = int(network.orientation[index]), _number(row, "orientation")
        if there == 5 - here:  # half a turn apart: the same image
            values[3] += np.pi
        elif there != here:
            raise ValueError(
                f"it has orientation {there:g}, but as described it is {here} or {5 - here}; check "
                "how mask and sensor are turned"
            )
    return values, sigmas


def _number(row: Mapping[str, Any], key: str) -> float:
    given = row.get(key)
    if given is None or given == "":
        return math.nan
    try:
        if isinstance(given, bool):
            raise TypeError
        value = float(given)
    except (TypeError, ValueError):
        raise ValueError(f"{key} = {given!r} is not a number") from None
    if not math.isfinite(value):
        raise ValueError(f"{key} = {given!r} is not a finite number")
    return value


def contradictions(
    network: Network, readings: Readings, compared: NDArray[np.bool_]
) -> Iterator[str]:
    """What readings say against the description, where no fit compares them with it.

    Parameters
    ----------
    network : Network
    readings : Readings
    compared : ndarray of bool, shape (rasniks, 4)
        Values that a fit compares with those described.

    Yields
    ------
    str
        One sentence for each scale and each theta_z: what x and y mean is then another thing.
    """
    seen = np.where(compared, np.nan, readings.values)[:, 2:]
    for name, (scale, theta), (_, _, here, there) in zip(
        network.rasniks, seen.tolist(), network.nominal.tolist(), strict=True
    ):
        if math.isfinite(scale) and scales_contradict(scale, here):
            yield (
                f"{name} has scale = {scale:.4g}, but as described it is {here:.4g}; check the "
                "positions of mask, lens and sensor"
            )
        if math.isfinite(theta) and abs(math.sin(theta - there)) > _TURNED_RAD:
            yield (
                f"{name} has theta_rad = {theta:.4g}, but as described it is "
                f"{round(there, 6) + 0.0:.4g}; say by rotation_rad how its mask or sensor is turned"
            )


def write_readings(network: Network, values: Array, path: str | PathLike[str]) -> None:
    """Write readings as a CSV table.

    Parameters
    ----------
    network : Network
    values : ndarray, shape (rasniks, 4)
        As in `Readings`; rows of NaN are left out.
    path : path-like

    Raises
    ------
    OSError
        If it cannot be written.
    """
    with open(path, "w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["name", *_VALUES])
        for name, row in zip(network.rasniks, values.tolist(), strict=True):
            if not all(math.isnan(value) for value in row):
                table.writerow([name, *("" if math.isnan(v) else repr(v) for v in row)])
