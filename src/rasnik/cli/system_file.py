"""Measured values into the TOML file of a system, the rest of the file left as it is."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rasnik.instrument import System, load_system

__all__ = ["system_text", "with_values"]


def system_text(source: str) -> str:
    """The TOML of a shipped system or of a file, comments included."""
    from importlib import resources

    if source.endswith(".toml") or {"/", "\\"} & set(source):
        return Path(source).read_text(encoding="utf-8")
    folder = resources.files("rasnik") / "systems"
    name = source.strip().lower().replace("_", "-")
    return (folder / f"{name}.toml").read_text(encoding="utf-8")


def with_values(text: str, system: System, values: Mapping[str, Any], remark: str) -> str:
    """The TOML text of a system with some values of one table replaced.

    Parameters
    ----------
    text : str
        Describes `system`.
    system : System
    values : mapping
        ``{"sensor.noise_a": 0.26}``.
    remark : str
        Comment behind each new value; the old comment told of the old value.

    Returns
    -------
    str
        The same text with those lines changed or added. A file laid out so that this fails (as
        inline tables are) is written anew, with the units as comments.

    Raises
    ------
    rasnik.SystemConfigError
        If the values do not go with the system.
    """
    import tomllib

    wanted = load_system(system, values)
    lines = text.splitlines()
    for dotted, value in values.items():
        table, key = dotted.split(".")
        _set_line(lines, table, key, f"{key} = {value!r}  # {remark}")
    changed = "\n".join(lines) + "\n"
    try:
        if System.model_validate(tomllib.loads(changed)) == wanted:
            return changed
    except ValueError:  # not TOML any longer, or another system
        pass
    return wanted.to_toml()


def _set_line(lines: list[str], table: str, key: str, line: str) -> None:
    """Replace the line of a key in a table, or add it at the table's end."""
    heads = [k for k, text in enumerate(lines) if re.match(r"\s*\[", text)]
    start = next((k for k in heads if re.match(rf"\s*\[\s*{table}\s*\]", lines[k])), None)
    if start is None:
        return
    end = next((k for k in heads if k > start), len(lines))
    for k in range(start + 1, end):
        if re.match(rf"\s*#?\s*{key}\s*=", lines[k]) or lines[k].startswith(f"# {key} is not set"):
            lines[k] = line
            return
    while end > start + 1 and not lines[end - 1].strip():
        end -= 1
    # Comments at the end of a table belong to the next one.
    while end > start + 1 and lines[end - 1].lstrip().startswith("#"):
        end -= 1
    lines.insert(end, line)
