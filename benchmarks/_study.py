"""What the studies share: where they ran, and many seeded trials over the cores."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import version
from typing import Any

from rich.progress import track


def environment() -> str:
    """Machine and versions, one line."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="ascii") as info:
            model = next(line.split(":")[1].strip() for line in info if "model name" in line)
    except (OSError, StopIteration):
        pass
    packages = ", ".join(
        f"{name} {version(name)}" for name in ("rasnik", "numpy", "scipy", "numba")
    )
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, {packages}"


def one_thread() -> None:
    """Keep linear algebra to one thread; call before numpy is imported."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def trials(function: Callable[[Any], Any], arguments: Iterable[Any], jobs: int) -> list[Any]:
    """`function` of every argument, in order, over `jobs` processes."""
    arguments = list(arguments)
    if jobs == 1:
        return [function(argument) for argument in track(arguments, description="trials")]
    with ProcessPoolExecutor(jobs) as pool:
        results = pool.map(function, arguments, chunksize=4)
        return list(track(results, description="trials", total=len(arguments)))
