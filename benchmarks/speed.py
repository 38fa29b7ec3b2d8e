"""Time per frame on one core, as ratios to one Fourier transform of the same frame.

    python benchmarks/speed.py

Best and median of N interleaved repetitions: machines are noisy, ratios less so.
"""

from __future__ import annotations

import argparse

import _study

_study.one_thread()

import time  # noqa: E402
from collections.abc import Callable  # noqa: E402

import numpy as np  # noqa: E402
import scipy.fft  # noqa: E402

from rasnik import analyse, load_system, simulate  # noqa: E402


def measure(tasks: dict[str, Callable[[], object]], repeats: int) -> dict[str, np.ndarray]:
    """Milliseconds of every repetition, all tasks in turn within each."""
    for task in tasks.values():
        task()  # compiled and cached
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(repeats):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            times[name].append((time.perf_counter() - start) * 1e3)
    return {name: np.array(values) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=60, help="repetitions")
    options = parser.parse_args()
    print(_study.environment())
    system = load_system("solidras")
    poses = [(4000.3, 5000.2, 0.002), (4000.32, 5000.18, 0.002), (4001.3, 5000.2, 0.002)]
    frame, close, near = simulate(system, poses, seed=1).frames
    prior_close, prior_near = analyse(close, system), analyse(near, system)
    grey = frame.astype(np.float32)
    tasks: dict[str, Callable[[], object]] = {
        "frame.sum()": lambda: frame.sum(),
        "scipy.fft.rfft2, float32": lambda: scipy.fft.rfft2(grey),
        "cold start to the bound": lambda: analyse(frame, system),
        "Fourier method": lambda: analyse(frame, system, method="fourier"),
        "refinement, prior 0.03 um away": lambda: analyse(frame, system, prior=prior_close),
        "refinement, prior 1 um away": lambda: analyse(frame, system, prior=prior_near),
    }
    times = measure(tasks, options.n)
    reference = times["scipy.fft.rfft2, float32"]
    print(f"\n720 x 540 pixels, one core\n{'':34}{'median ms':>10}{'best ms':>9}{'/ rfft2':>9}")
    for name, values in times.items():
        ratio = np.median(values) / np.median(reference)
        print(f"{name:34}{np.median(values):>10.2f}{values.min():>9.2f}{ratio:>9.1f}")


if __name__ == "__main__":
    main()
