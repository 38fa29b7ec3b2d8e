"""What the commands share: consoles, the way they refuse, options that are parsed alike."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, NoReturn

import typer
from rich.console import Console
from rich.markup import escape

if TYPE_CHECKING:
    from rasnik.instrument import System

__all__ = ["WRONG_USAGE", "fail", "load", "messages", "numbers", "output"]

#: Exit status of a command that was not understood; 1 stands for results that are not all good.
WRONG_USAGE = 2
#: Width of tables that do not go to a terminal, where lines need not fit.
_FILE_WIDTH = 200


def output() -> Console:
    """Console for results, on the standard output."""
    return Console(width=None if sys.stdout.isatty() else _FILE_WIDTH, highlight=False)


def messages() -> Console:
    """Console for messages and progress, on the standard error output."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


def fail(message: str) -> NoReturn:
    """Say in one sentence what is wrong with the command, and end it."""
    messages().print(f"[bold red]rasnik:[/] {escape(message)}")
    raise typer.Exit(WRONG_USAGE)


def numbers(text: str, option: str, names: str, least: int) -> list[float]:
    """Comma-separated numbers of an option; `names` says what they are."""
    most = len(names.split(","))
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        fail(f"{option} {text!r} is not a list of numbers {names}.")
    if not least <= len(values) <= most:
        count = str(most) if least == most else f"{least} to {most}"
        fail(f"{option} {text!r} has {len(values)} numbers; {count} are needed: {names}.")
    return values


def load(source: str, overrides: Iterable[str]) -> System:
    """The system of a command, or the end of it."""
    from rasnik.instrument import SystemConfigError, load_system

    try:
        return load_system(source, list(overrides))
    except SystemConfigError as error:
        fail(str(error))
