"""Which system each instrument of an archive is: a table of thousands of rows.

A table is CSV, TOML or Parquet with the columns ``instrument``, ``system`` and, where they are
needed, ``overrides``, ``model``, ``orientation`` and ``frame_rate_hz``. The instrument is a name
or a pattern (``EML*``). In TOML each row is a table ``[[instruments]]``.

A row with a fault does not spoil the others: it is named in `SystemsTable.faults`, and again
when its instrument is asked for.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rasnik._config import SystemConfigError, parse_overrides, read_toml, sentences
from rasnik.instrument import System, load_system

__all__ = ["TABLE_SUFFIXES", "InstrumentSettings", "MissingSystemError", "SystemsTable"]

#: What a table may be.
TABLE_SUFFIXES = (".csv", ".toml", ".parquet")

Model = Literal["auto", "similarity", "affine", "projective"]

_ROWS = "instruments"
_BEYOND = "beyond the last column"
_MAGIC = re.compile(r"[*?\[]")


class MissingSystemError(ValueError):
    """The table does not say, or not clearly, what system an instrument is."""


@dataclass(frozen=True)
class InstrumentSettings:
    """How the images of one instrument are analysed.

    Attributes
    ----------
    system : System
    model : str
        Map that is fitted, as for `rasnik.analyse`.
    orientation : int or None
        1 to 4; None: found from the image, or that of the system.
    frame_rate_hz : float or None
        Of frames that follow each other in one file; None: not known.
    """

    system: System
    model: Model = "auto"
    orientation: int | None = None
    frame_rate_hz: float | None = None


class _Row(BaseModel):
    """One row, with numbers as numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    instrument: str = Field(min_length=1)
    system: str = Field(min_length=1)
    overrides: str | dict[str, Any] | list[str] | None = None
    model: Model | None = None
    orientation: Literal[1, 2, 3, 4] | None = None
    frame_rate_hz: Annotated[float, Field(gt=0, le=1e7)] | None = None


@dataclass(frozen=True)
class SystemsTable:
    """Settings by the name of an instrument.

    Attributes
    ----------
    source : str
        Where the table came from.
    rows : mapping of str to InstrumentSettings or str
        By name or pattern; a sentence in place of settings says what is wrong with the row.
    """

    source: str
    rows: Mapping[str, InstrumentSettings | str]
    _found: dict[str, InstrumentSettings] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def read(
        cls, path: str | PathLike[str], default: System | InstrumentSettings | None = None
    ) -> SystemsTable:
        """Read a table.

        Parameters
        ----------
        path : path-like
            Ends in one of `TABLE_SUFFIXES`. Paths of systems in it are relative to its folder.
        default : System or InstrumentSettings, optional
            For instruments that no row names.

        Raises
        ------
        SystemConfigError
            If the table cannot be read, has unknown columns, or no row.
        ImportError
            If it is Parquet and pyarrow is not installed.
        """
        path = Path(path)
        rows: dict[str, InstrumentSettings | str] = {}
        systems = _Systems(path.parent)
        for label, cells in _cells(path):
            name = str(cells.get("instrument") or "")
            if name in rows:
                rows[name] = f"{path}, {label}: {name} is in the table more than once"
                continue
            try:
                rows[name] = _settings(cells, systems)
            except SystemConfigError as error:
                where = f"{path}, {label}" + (f": {error.source}" if error.source else "")
                rows[name or label] = "; ".join(f"{where}: {p}" for p in error.problems)
        if not rows:
            raise SystemConfigError(str(path), ["the table has no rows"])
        return cls(str(path), _with_default(rows, default))

    @classmethod
    def for_all(cls, default: System | InstrumentSettings) -> SystemsTable:
        """The same settings for every instrument."""
        return cls("one system for all", _with_default({}, default))

    @property
    def faults(self) -> tuple[str, ...]:
        """One sentence for each row that cannot be used, with file and row."""
        return tuple(row for row in self.rows.values() if isinstance(row, str))

    def of(self, instrument: str) -> InstrumentSettings:
        """Settings of an instrument.

        The row of its very name counts first, then the matching pattern with the most plain
        characters.

        Raises
        ------
        MissingSystemError
            If no row names it, two patterns fit equally well, or its row has a fault.
        """
        if instrument not in self._found:
            self._found[instrument] = self._look_up(instrument)
        return self._found[instrument]

    def _look_up(self, instrument: str) -> InstrumentSettings:
        name = instrument if instrument in self.rows else self._pattern(instrument)
        row = self.rows[name]
        if isinstance(row, str):
            raise MissingSystemError(f"the system of {instrument} cannot be used: {row}")
        return row

    def _pattern(self, instrument: str) -> str:
        fitting = [name for name in self._patterns if fnmatchcase(instrument, name)]
        if not fitting:
            raise MissingSystemError(
                f"{self.source} names no system for the instrument {instrument}; add a row for it, "
                "or one with the instrument * for all others"
            )
        most = max(map(_plain_characters, fitting))
        best = [name for name in fitting if _plain_characters(name) == most]
        if len(best) > 1:
            raise MissingSystemError(
                f"the instrument {instrument} fits {' and '.join(best)} in {self.source} equally "
                "well; add a row with its name"
            )
        return best[0]

    @cached_property
    def _patterns(self) -> list[str]:
        return [name for name in self.rows if _MAGIC.search(name)]


def _plain_characters(pattern: str) -> int:
    """How many characters a pattern prescribes."""
    return len(re.sub(r"\*|\?|\[[^]]*\]", "", pattern))


def _with_default(
    rows: dict[str, InstrumentSettings | str], default: System | InstrumentSettings | None
) -> dict[str, InstrumentSettings | str]:
    if default is None:
        return rows
    settings = InstrumentSettings(default) if isinstance(default, System) else default
    return {"*": settings} | rows


# ------------------------------------------------------------------------ one row


class _Systems:
    """Systems that were loaded already; thousands of instruments share a few."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._loaded: dict[tuple[str, str], System | SystemConfigError] = {}

    def load(self, name: str, overrides: Mapping[str, Any]) -> System:
        """A system with overrides; raises SystemConfigError."""
        if not overrides:
            return self._once((name, ""), lambda: load_system(self._where(name)))
        key = (name, repr(sorted(overrides.items())))
        return self._once(key, lambda: load_system(self.load(name, {}), overrides))

    def _once(self, key: tuple[str, str], make: Any) -> System:
        if key not in self._loaded:
            try:
                self._loaded[key] = make()
            except SystemConfigError as error:
                self._loaded[key] = error
        found = self._loaded[key]
        if isinstance(found, SystemConfigError):
            raise found
        return found

    def _where(self, name: str) -> str:
        is_file = name.endswith(".toml") or {"/", "\\"} & set(name)
        return str(self._folder / name) if is_file else name


def _settings(cells: dict[str, Any], systems: _Systems) -> InstrumentSettings:
    """Settings from the cells of a row; raises SystemConfigError."""
    if _BEYOND in cells:
        raise SystemConfigError(
            "",
            [f"{cells[_BEYOND]!r} stands {_BEYOND}; put quotes around a cell with commas in it"],
        )
    try:
        row = _Row.model_validate(cells)
    except ValidationError as error:
        raise SystemConfigError("", sentences(_Row, error)) from None
    given: Any = row.overrides or {}
    if isinstance(given, str):
        given = [part.strip() for part in given.split(";") if part.strip()]
    system = systems.load(row.system, parse_overrides("overrides", given))
    return InstrumentSettings(system, row.model or "auto", row.orientation, row.frame_rate_hz)


# ------------------------------------------------------------------------ files


def _cells(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """(where it stands, cells that are not empty) of every row."""
    match path.suffix.lower():
        case ".csv":
            yield from _csv_rows(path)
        case ".toml":
            yield from _toml_rows(path)
        case ".parquet":
            yield from _parquet_rows(path)
        case other:
            raise SystemConfigError(
                str(path),
                [
                    f"{other or 'no suffix'} is not a kind of table; "
                    f"end the name in one of {', '.join(TABLE_SUFFIXES)}"
                ],
            )


def _check_columns(path: Path, names: Iterable[str]) -> None:
    names, known = list(names), list(_Row.model_fields)
    twice = sorted({name for name in names if names.count(name) > 1})
    faults = [f"the column {name} is missing" for name in ("instrument", "system")
              if name not in names]  # fmt: skip
    unknown = [name for name in names if name not in known]
    if unknown:
        faults.append(f"unknown columns: {', '.join(unknown)}; known are {', '.join(known)}")
    elif twice:
        faults.append(f"columns that are there twice: {', '.join(twice)}; leave one of each")
    if faults:
        raise SystemConfigError(str(path), faults)


def _csv_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.reader(file)
            names = [name.strip() for name in next(lines, [])]
            _check_columns(path, names)
            for line in lines:
                texts = [text.strip() for text in line]
                if any(texts):
                    cells = _typed(dict(zip(names, texts, strict=False)))
                    beyond = ",".join(texts[len(names) :])
                    yield f"line {lines.line_num}", cells | ({_BEYOND: beyond} if beyond else {})
    except FileNotFoundError:
        raise SystemConfigError(str(path), ["there is no such file"]) from None
    except OSError as error:
        reason = error.strerror or error
        raise SystemConfigError(str(path), [f"the file cannot be read: {reason}"]) from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise SystemConfigError(str(path), [f"this is not CSV in UTF-8: {error}"]) from None


def _typed(texts: dict[str, str]) -> dict[str, Any]:
    """Cells of a CSV row: numbers where numbers belong; an empty cell is none."""
    cells: dict[str, Any] = {name: text for name, text in texts.items() if text}
    for name, kind in (("orientation", int), ("frame_rate_hz", float)):
        try:
            cells[name] = kind(cells[name])
        except (KeyError, ValueError):
            pass  # what is no number is complained about with the rest of the row
    return cells


def _toml_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    data = read_toml(path)
    rows = data.get(_ROWS)
    if set(data) != {_ROWS} or not isinstance(rows, list):
        raise SystemConfigError(str(path), [f"a table of systems consists of [[{_ROWS}]] alone"])
    for number, row in enumerate(rows, 1):
        yield f"[[{_ROWS}]] number {number}", dict(row)


def _parquet_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise ImportError(
            f'{path}: Parquet files need pyarrow; install it with: pip install "rasnik[archive]"'
        ) from None
    try:
        table = parquet.read_table(path)
    except FileNotFoundError:
        raise SystemConfigError(str(path), ["there is no such file"]) from None
    except (pyarrow.ArrowException, OSError) as error:
        raise SystemConfigError(str(path), [f"this is not a Parquet file: {error}"]) from None
    _check_columns(path, table.column_names)
    for number, row in enumerate(table.to_pylist(), 1):
        yield f"row {number}", {key: value for key, value in row.items() if value not in (None, "")}
