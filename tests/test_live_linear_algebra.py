"""Linear algebra of a station in one thread."""

import os
import subprocess
import sys

import pytest

THREADS = """
import ctypes, os
import numpy
from rasnik.live.linear_algebra import _FUNCTIONS, _VARIABLES, _loaded, in_one_thread

def threads():
    found = []
    for library in map(ctypes.CDLL, _loaded()):
        for name in (name.replace("_set_", "_get_") for name in _FUNCTIONS):
            found += [getattr(library, name)()] if hasattr(library, name) else []
    return found

before = threads()
in_one_thread()
print(before, threads(), [os.environ.get(name) for name in _VARIABLES])
"""


def told(**variables: str) -> str:
    """Threads of OpenBLAS before and after, and what processes that are started then will read."""
    kept = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    run = subprocess.run(
        [sys.executable, "-c", THREADS],
        env=kept | variables, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return run.stdout.strip()


def test_one_thread_and_no_more() -> None:
    found = told()
    if found.startswith("[]"):
        pytest.skip("numpy has no OpenBLAS here, or this system does not tell")
    assert found.endswith(" [1] ['1', '1', '1']")


def test_what_the_environment_says_holds() -> None:
    found = told(OPENBLAS_NUM_THREADS="2")
    assert found.endswith("[None, '2', None]")
    before, after = found.split(" [None")[0].split("] ")
    assert before + "]" == after
