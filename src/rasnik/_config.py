"""Plain descriptions from files and overrides: reading, changing, complaining, writing.

Nothing here knows what a Rasnik is; `rasnik.instrument` does.
"""

from __future__ import annotations

import copy
import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

__all__ = [
    "ContradictionError",
    "SystemConfigError",
    "apply_overrides",
    "parse_overrides",
    "read_toml",
    "sentences",
    "toml_lines",
]


class SystemConfigError(ValueError):
    """A system that cannot be used as described; `problems` holds one sentence for each fault."""

    def __init__(self, source: str, problems: Iterable[str]) -> None:
        self.source = source
        self.problems = tuple(problems)
        if len(self.problems) == 1:
            text = f"{source}: {self.problems[0]}"
        else:
            text = "\n  - ".join([f"{source} has {len(self.problems)} faults:", *self.problems])
        super().__init__(text)

    def __reduce__(self) -> tuple[Any, ...]:  # so that it survives a trip between processes
        return type(self), (self.source, self.problems)


class ContradictionError(ValueError):
    """Raised by a model whose values do not go together; one sentence for each case."""

    def __init__(self, problems: Iterable[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(self.problems))


def read_toml(path: Path) -> dict[str, Any]:
    """Content of a TOML file.

    Raises
    ------
    SystemConfigError
        If it cannot be read.
    """
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8"))
    except FileNotFoundError:
        problem = "there is no such file"
    except IsADirectoryError:
        problem = "this is a folder, not a TOML file"
    except OSError as error:
        problem = f"the file cannot be read: {error.strerror or error}"
    except UnicodeDecodeError:
        problem = "this is not a text file in UTF-8"
    except tomllib.TOMLDecodeError as error:
        problem = f"this is not valid TOML: {error}"
    raise SystemConfigError(str(path), [problem])


def parse_overrides(
    label: str, overrides: Mapping[str, Any] | Iterable[str] | str
) -> dict[str, Any]:
    """Overrides in any form as one flat mapping from dotted field to value."""
    if isinstance(overrides, Mapping):
        return _flatten(overrides)
    flat: dict[str, Any] = {}
    for item in [overrides] if isinstance(overrides, str) else overrides:
        key, equals, text = (part.strip() for part in item.partition("="))
        if not key or not equals or not text:
            raise SystemConfigError(
                label, [f"the override {item!r} is not of the form sensor.pixel_um=7.4"]
            )
        flat |= _flatten({key: _parse_value(text)})
    return flat


def _parse_value(text: str) -> Any:
    if text.lower() == "none":
        return None
    try:
        parsed = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    return parsed["value"] if len(parsed) == 1 else text


def _flatten(nested: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in nested.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            # Scalars of numpy become Python's, which the strict fields ask for.
            flat[prefix + key] = value.item() if hasattr(value, "item") else value
    return flat


def apply_overrides(
    model: type[BaseModel], label: str, data: dict[str, Any], changes: Mapping[str, Any]
) -> dict[str, Any]:
    """A copy of `data` with the dotted fields of `changes` set, or removed where None."""
    data, names = copy.deepcopy(data), _field_names(model)
    for dotted, value in changes.items():
        *tables, leaf = dotted.split(".")
        target: Any = data
        for table in tables:
            target = target.setdefault(table, {})
            if not isinstance(target, dict):
                raise SystemConfigError(label, [_unknown(model, dotted)])
        if value is None and dotted in names:
            target.pop(leaf, None)
        else:
            target[leaf] = value
    return data


def _field_names(model: type[BaseModel], prefix: str = "") -> list[str]:
    """Dotted names of all fields and tables."""
    names = []
    for name, info in model.model_fields.items():
        names.append(prefix + name)
        for kind in (info.annotation, *get_args(info.annotation)):  # a table, or a list of them
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                names += _field_names(kind, f"{prefix}{name}.")
    return names


def _unknown(model: type[BaseModel], dotted: str) -> str:
    """The sentence for a field that does not exist, with those that may be meant."""
    names, wrong = _field_names(model), dotted
    dotted = ".".join(part for part in dotted.split(".") if not part.isdigit())
    near = [name for name in names if name.rpartition(".")[2] == dotted.rpartition(".")[2]]
    near = near or difflib.get_close_matches(dotted, names, n=2, cutoff=0.7)
    hint = f"; did you mean {' or '.join(near)}?" if near else ""
    return f"there is no field {wrong}{hint}"


def sentences(model: type[BaseModel], error: ValidationError) -> list[str]:
    """One sentence for each fault found by pydantic."""
    found = []
    for fault in error.errors():
        dotted = ".".join(str(part) for part in fault["loc"])
        match fault["type"]:
            case "missing":
                found.append(f"{dotted} is missing")
            case "extra_forbidden":
                found.append(_unknown(model, dotted))
            case "model_type":
                found.append(f"{dotted} = {fault['input']!r}: it should be a table of fields")
            case "value_error":
                cause = fault["ctx"]["error"]
                problems = cause.problems if isinstance(cause, ContradictionError) else [str(cause)]
                found += [f"in {dotted}, {text}" if dotted else text for text in problems]
            case "list_type" | "tuple_type" if isinstance(fault["input"], dict):
                found.append(f"{dotted} is a list of tables; write [[{dotted}]] with two brackets")
            case "list_type" | "tuple_type":
                found.append(f"{dotted} = {fault['input']!r}: it should be a list, in brackets")
            case "path_type":
                found.append(f"{dotted} = {fault['input']!r}: it should be a path, in quotes")
            case _:
                wish = re.sub(r"^(Input|String|List) should", "it should", fault["msg"])
                found.append(f"{dotted} = {fault['input']!r}: {wish}")
    return found


def toml_lines(part: BaseModel) -> list[str]:
    """One line for each plain field, its description as the comment."""
    lines = []
    for name, info in type(part).model_fields.items():
        value = getattr(part, name)
        if isinstance(value, BaseModel) or _are_tables(value):
            continue
        comment = f"  # {info.description}" if info.description else ""
        if value is None:
            lines.append(f"# {name} is not set{comment}")
        else:
            lines.append(f"{name} = {_toml_value(value)}{comment}")
    return lines


def _are_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], BaseModel)


def _toml_value(value: str | int | float | Path | list[Any] | tuple[Any, ...]) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Path):
        value = str(value)
    if not isinstance(value, str):
        return repr(value)
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    plain = "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped)
    return f'"{plain}"'
