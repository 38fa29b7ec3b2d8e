"""The first start on a machine: compile the kernels in two processes at a time.

The kernels are compiled when they are first called, which takes a while, and are then kept on
disk for later processes. Compilation does not run in parallel within a process; but a frame is
analysed long before it is tracked, so that another process can meanwhile prepare for tracking.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numba import typeof
from numpy.typing import NDArray

from rasnik.analysis.analyse import analyse
from rasnik.analysis.parameters import State
from rasnik.imaging import kernels as model
from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.projection import Projection
from rasnik.instrument import System, load_system
from rasnik.tracking import kernels
from rasnik.tracking.linearisation import Settings, Sums, estimator, scene_of

__all__ = ["compile_kernels", "is_compiled", "prepare"]

_KERNELS = (kernels.store, kernels.sum_frame, kernels.estimate)
_LONGEST_S = 60.0
_POLL_S = 0.05


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
    return all(map(_is_stored, _KERNELS))


def _is_stored(kernel: Any) -> bool:
    stats = getattr(kernel, "stats", None)  # without compilation they are plain functions
    if stats is None:
        return True
    function = kernel.py_func
    name = f"{Path(function.__code__.co_filename).stem}.{function.__name__}-*.nbi"
    return any(Path(stats.cache_path).glob(name))


def compile_kernels(grey: np.dtype[Any], wait_s: float = 0.0) -> None:
    """Compile every kernel, for frames of a type of grey levels.

    First comes what another process, which compiles the image model, needs last of it.

    Parameters
    ----------
    grey : dtype
    wait_s : float, optional
        So long another process is given to compile the image model, which `store` is built on.
    """
    shape, system = (32, 160), load_system("solidras")
    camera, valid = Camera(shape, system.sensor.pixel_um), np.ones(shape, dtype=np.uint8)
    settings = Settings(system.mask, camera, (0.3, 0.01), "similarity", True, valid)
    pose = Projection.from_pose(1000.0, 1000.0, 1.0, 0.0, 4)
    state = State(pose, Appearance.uniform(20.0, 200.0, 10.0))
    scene = scene_of(settings, state)
    _compile_parts_of_model(scene)
    sums = Sums.over(settings, state, scene)
    *_, linear = estimator(sums)
    assert linear is not None
    step, statistics = np.empty(linear.n_steps), np.empty(kernels.N_STATISTICS)
    linear.estimate(np.full(shape, 100, dtype=grey), step, statistics)
    end = time.monotonic() + wait_s
    while time.monotonic() < end and not _is_stored(model.signals):
        time.sleep(_POLL_S)
    sums.store(0, sums.tiling.count)


def _compile_parts_of_model(scene: model.Scene) -> None:
    work = np.zeros((model.WORK_ROWS, model.STRIDE), dtype=np.float32)
    index = np.zeros((3, model.LANES), dtype=np.int32)
    fields, start = scene.fields.ravel(), np.int32(0)
    _compile(model.many_corners, work, index, fields, start, start, scene.reach, scene.orders)
    _compile(model.add_part, work, scene.shape, np.float32(1.0), scene.orders)


def _compile(kernel: Any, *arguments: Any) -> None:
    """For arguments of these types, without a call."""
    if hasattr(kernel, "compile"):
        kernel.compile(tuple(map(typeof, arguments)))


if __name__ == "__main__":
    compile_kernels(np.dtype(sys.argv[1]), wait_s=_LONGEST_S / 2)
