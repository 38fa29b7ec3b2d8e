"""A program that is killed in the middle of its work, and what it said until then."""

from __future__ import annotations

import os
import select
import subprocess
import time

import numpy as np

__all__ = ["killed"]

_LONGEST_S = 60.0  # without a word


def killed(command: list[str], after_s: float) -> tuple[np.ndarray, float]:
    """Run a program that prints lines of numbers, and kill it.

    Parameters
    ----------
    command : list of str
    after_s : float
        Time from its first word to its end.

    Returns
    -------
    lines : ndarray of float, shape (n, columns)
    kill_s : float
        When it was killed, by `time.monotonic`.

    Raises
    ------
    AssertionError
        If it ended by itself.
    """
    child = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert child.stdout is not None
    told, kill_s = b"", float("inf")
    while time.monotonic() < kill_s:
        wait_s = min(kill_s - time.monotonic(), _LONGEST_S)
        if select.select([child.stdout], [], [], max(0.0, wait_s))[0]:
            news = os.read(child.stdout.fileno(), 65536)
            assert news, "the program ended by itself"
            if not told:
                kill_s = time.monotonic() + after_s
            told += news
    child.kill()
    kill_s = time.monotonic()
    told += child.stdout.read()
    child.wait()
    child.stdout.close()
    return np.array([line.split() for line in told.decode().splitlines()], dtype=float), kill_s
