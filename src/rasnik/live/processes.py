"""How the station begins a process of its own with another of its modules."""

from __future__ import annotations

import os
import sys

__all__ = ["environment_of_modules", "module_command"]


def module_command(module: str, *arguments: str) -> list[str]:
    """Run a module as a program; files of the folder where the station runs are not modules."""
    return [sys.executable, "-P", "-m", module, *arguments]


def environment_of_modules() -> dict[str, str]:
    """The environment in which it finds the same modules as this process."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
