"""The first start on a machine: compile the kernels in two processes at a time.

The kernels are compiled when they are first called, which takes a while, and are then kept on
disk for later processes. Compilation does not run in parallel within a process; but a frame is
analysed long before it is tracked, so that another process can meanwhile prepare for tracking.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.analyse import analyse
from rasnik.analysis.parameters import State
from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.projection import Projection
from rasnik.instrument import System, load_system
from rasnik.tracking import kernels
from rasnik.tracking.linearisation import Settings, linearise

__all__ = ["compile_kernels", "is_compiled", "prepare"]

_KERNELS = (kernels.store, kernels.sum_frame, kernels.estimate)
_LONGEST_S = 60.0


def prepare(image: NDArray[Any], system: System) -> bool:
    """Compile whatever tracking needs, unless that has been done on this machine.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        The first frame.
    system : System

    Returns
    -------
    bool
        Whether there was something to do.
    """
    if is_compiled() or not sys.executable:
        return False
    command = [sys.executable, "-m", __name__, image.dtype.name]
    silent = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent) as other:
        try:
            analyse(image, system)
            other.wait(_LONGEST_S)
        except subprocess.TimeoutExpired:
            pass  # then they are compiled here, when they are called
        finally:
            other.kill()
    return True


def is_compiled() -> bool:
    """Whether the kernels of tracking have been compiled and stored by any process."""
    for kernel in _KERNELS:
        stats = getattr(kernel, "stats", None)  # without compilation they are plain functions
        if stats is None:
            return True
        name = f"{Path(kernel.py_func.__code__.co_filename).stem}.{kernel.py_func.__name__}-*.nbi"
        if not any(Path(stats.cache_path).glob(name)):
            return False
    return True


def compile_kernels(grey: np.dtype[Any]) -> None:
    """Call every kernel once, with a small frame of a type of grey levels."""
    shape, system = (32, 160), load_system("solidras")
    camera, valid = Camera(shape, system.sensor.pixel_um), np.ones(shape, dtype=np.uint8)
    settings = Settings(system.mask, camera, (0.3, 0.01), "similarity", True, valid)
    state = State(
        Projection.from_pose(1000.0, 1000.0, 1.0, 0.0, 4), Appearance.uniform(20.0, 200.0, 10.0)
    )
    linear = linearise(settings, state)
    step, statistics = np.empty(linear.n_steps), np.empty(kernels.N_STATISTICS)
    linear.estimate(np.full(shape, 100, dtype=grey), step, statistics)


if __name__ == "__main__":
    compile_kernels(np.dtype(sys.argv[1]))
