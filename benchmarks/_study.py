"""What the studies share: where they ran, frames of known truth, clocks, seeded trials."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from rich.progress import track

if TYPE_CHECKING:  # numpy is imported where it is used: `one_thread` has to come first
    import numpy as np

    from rasnik.imaging.projection import Projection
    from rasnik.instrument import System
    from rasnik.mask import ChessField


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


def save_json(path: str | None, **content: Any) -> None:
    """Write results beside the environment they were measured in; nothing without a path."""
    if path:
        with open(path, "w", encoding="utf-8") as file:
            json.dump({"environment": environment(), **content}, file, indent=1)


# ------------------------------------------------------------------------- frames


def frame_pool(
    system: System,
    projections: list[Projection],
    *,
    n: int | None = None,
    seed: int = 0,
    dtype: str | None = None,
    mask: ChessField | None = None,
) -> np.ndarray:
    """Noisy frames, frame k of projection k modulo their number, by the image model.

    Parameters
    ----------
    n : int, optional
        Number of frames; that of the projections by default.
    seed : int
        Frame k has the noise of (seed, k).
    dtype : str, optional
        ``"float32"`` gives levels that are not rounded; by default what the sensor hands out.
    mask : ChessField, optional
        Shown instead of the mask of the system.

    Returns
    -------
    ndarray, shape (n, H, W)
    """
    import numpy as np

    from rasnik.imaging.appearance import Appearance, Camera
    from rasnik.imaging.model import expected_image
    from rasnik.imaging.noise import ReadOut, frame_dtype

    n = len(projections) if n is None else n
    sensor = system.sensor
    look = Appearance.uniform(sensor.dark_level, sensor.light_level, system.optics.blur_um)
    camera = Camera(system.shape, system.pitch_um)
    quantise = dtype != "float32"
    frames = np.empty((n, *system.shape), frame_dtype(system) if quantise else np.float32)

    def fill(first: int) -> None:
        expected = expected_image(mask or system.mask, projections[first], look, camera)
        readout = ReadOut(expected, system)
        for k in range(first, n, len(projections)):
            frames[k] = readout.frame(np.random.default_rng([seed, k]), quantise=quantise)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(fill, range(min(n, len(projections)))))
    return frames


# ------------------------------------------------------------------------- clocks


@dataclass(frozen=True)
class Task:
    """Something to be timed that works on `frames` frames at a call.

    `check` is given what every call returns, while the clock stands still.
    """

    name: str
    call: Callable[[], Any]
    frames: int = 1
    check: Callable[[Any], None] = lambda result: None


def measure(tasks: dict[Any, Task], repeats: int) -> dict[Any, np.ndarray]:
    """Milliseconds per frame of every repetition, all tasks in turn within each.

    On a machine with other work to do, tasks that are measured in turn suffer alike. There is
    no progress bar: it would be a second thread.
    """
    import numpy as np

    for task in tasks.values():
        task.call()  # compiled and cached
    times: dict[Any, list[float]] = {key: [] for key in tasks}
    for _ in range(repeats):
        for key, task in tasks.items():
            start = time.perf_counter()
            result = task.call()
            times[key].append((time.perf_counter() - start) * 1e3 / task.frames)
            task.check(result)
    return {key: np.array(values) for key, values in times.items()}
