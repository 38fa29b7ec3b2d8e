"""What was found, how bad it is and what helps; the machine it was found on."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

__all__ = ["NOT_KNOWN", "Finding", "Level", "Machine", "guarded", "nearest_folder"]

Level = Literal["ok", "note", "warning", "fault"]

NOT_KNOWN = "not known here"


@dataclass(frozen=True)
class Finding:
    """One line of the table.

    Attributes
    ----------
    about : str
        What was looked at, in a few words.
    level : str
        "ok", "note" (good to know), "warning" (data may suffer), "fault" (the station will not
        do what it was told).
    found : str
    remedy : str
        What helps; there is one unless all is well.
    """

    about: str
    level: Level
    found: str
    remedy: str = ""

    def __post_init__(self) -> None:
        if (self.level == "ok") == bool(self.remedy):
            raise ValueError(f"{self.about}: a remedy is for what is not ok, and needed there")


@dataclass(frozen=True)
class Machine:
    """Where files of the operating system are read; tests put a folder of their own there."""

    root: Path = Path("/")

    def path(self, name: str) -> Path:
        return self.root / name.lstrip("/")

    def read(self, name: str) -> str | None:
        """Text of a file, without white space around it; None where it cannot be read."""
        try:
            return self.path(name).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    def number(self, name: str) -> int | None:
        """The whole number in a file; None where there is none."""
        try:
            return int(self.read(name) or "")
        except ValueError:
            return None

    def names(self, folder: str) -> list[str]:
        """What lies in a folder, sorted; nothing where it cannot be read."""
        try:
            return sorted(entry.name for entry in self.path(folder).iterdir())
        except OSError:
            return []


def guarded(about: str, check: Callable[[], Iterable[Finding]]) -> Iterator[Finding]:
    """The findings of a check; one that fails is itself a finding."""
    try:
        yield from check()
    except Exception as error:
        what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        yield Finding(
            about,
            "warning",
            f"could not be looked at ({' '.join(what.split())})",
            "Look at this by hand; what rasnik doctor did not manage is worth an issue.",
        )


def nearest_folder(path: Path) -> Path:
    """The folder itself, or the nearest above it that exists."""
    path = Path(os.path.abspath(path))
    while not path.is_dir() and path != path.parent:
        path = path.parent
    return path
