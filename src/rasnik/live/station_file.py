"""A station as a TOML file with a comment for every value."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from rasnik._config import toml_lines
from rasnik.live.station import StationConfig

__all__ = ["station_toml"]

_HEAD = """\
# A station of rasnik: its cameras, what is recorded, who may look.
# Begin it with: rasnik live THIS_FILE
# Relative paths count from the folder of this file. A [[channel]] more is a camera more.
"""


def station_toml(config: StationConfig) -> str:
    """The text of a station file, complete; what is not set stands there as a comment."""
    lines = [_HEAD, *toml_lines(config), *_tables(config, "")]
    return "\n".join(lines) + "\n"


def _tables(part: BaseModel, prefix: str) -> Iterator[str]:
    for name in type(part).model_fields:
        value: Any = getattr(part, name)
        if isinstance(value, BaseModel):
            yield from _table(value, f"[{prefix}{name}]", f"{prefix}{name}.")
        elif isinstance(value, list) and value and isinstance(value[0], BaseModel):
            for entry in value:
                yield from _table(entry, f"[[{prefix}{name}]]", f"{prefix}{name}.")


def _table(part: BaseModel, heading: str, prefix: str) -> Iterator[str]:
    lines = toml_lines(part)
    if lines:
        told = inspect.getdoc(type(part))
        yield ""
        if told and told != inspect.getdoc(BaseModel):
            yield from (f"# {line}".rstrip() for line in told.splitlines())
        yield heading
        yield from lines
    yield from _tables(part, prefix)
