"""A suspension from a TOML file, from single values, or from both.

    [suspension]            # fields of `Suspension`
    frequency_hz = 0.5
    q = 100.0
    mass_kg = 1.0

A Watt's linkage may be given by its geometry instead (fields of `WattLinkage`); frequency, mass and
coupling follow from it, and Q too where its flexures alone damp:

    [linkage]
    flexure_loss = 1e-3
    [linkage.pendulum]
    length_mm = 100.0
    load_kg = 0.6
    [linkage.inverted]
    length_mm = 100.0
    load_kg = 0.4
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from rasnik._config import SystemConfigError, read_toml, sentences
from rasnik.seismic.linkage import WattLinkage
from rasnik.seismic.suspension import Suspension

__all__ = ["load_suspension"]

_FROM_LINKAGE = ("frequency_hz", "mass_kg", "kind", "coupling")


class _Table(BaseModel):
    """Fields that are checked once those of the linkage and of options have joined them."""

    model_config = ConfigDict(frozen=True, extra="allow")


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    suspension: _Table = _Table()
    linkage: WattLinkage | None = None


def load_suspension(
    path: str | PathLike[str] | None = None, values: Mapping[str, Any] | None = None
) -> Suspension:
    """Read a suspension and check it.

    Parameters
    ----------
    path : path-like, optional
        TOML file with a table ``suspension``, or ``linkage``, or both.
    values : mapping, optional
        Fields of `Suspension` that replace those of the file; None leaves them.

    Raises
    ------
    SystemConfigError
        If the file cannot be read, or a value is missing, unknown or impossible.
    """
    label = "suspension" if path is None else str(path)
    given = {name: value for name, value in (values or {}).items() if value is not None}
    try:
        file = _File.model_validate({} if path is None else read_toml(Path(path)))
    except ValidationError as error:
        raise SystemConfigError(label, sentences(_File, error)) from None
    if path is not None and not file.model_fields_set:
        raise SystemConfigError(label, ["there is neither a table [suspension] nor [linkage]"])
    fields = dict(file.suspension)
    if file.linkage is not None:
        twice = [name for name in _FROM_LINKAGE if name in fields]
        if twice:
            raise SystemConfigError(
                label,
                [f"suspension.{name} follows from [linkage]; leave it out" for name in twice],
            )
        fields = _of_linkage(label, file.linkage, fields.get("q", given.get("q"))) | fields
    try:
        return Suspension.model_validate(fields | given)
    except ValidationError as error:
        problems = sentences(Suspension, error)
        raise SystemConfigError(label, [_with_option(one) for one in problems]) from None


def _of_linkage(label: str, linkage: WattLinkage, q: Any) -> dict[str, Any]:
    """Fields of the suspension that a linkage is."""
    try:
        return linkage.suspension(q).model_dump()
    except ValidationError as error:
        raise SystemConfigError(label, sentences(Suspension, error)) from None
    except ValueError as error:
        raise SystemConfigError(label, [str(error)]) from None


def _with_option(sentence: str) -> str:
    """Says where a value that is missing may come from."""
    return f"{sentence}: give it, or a file" if sentence.endswith("is missing") else sentence
