"""Frames per second of the generator, best of several runs.

Full SolidRas frames, 720 x 540 pixels: with noise only (one pose), with motion (a new pose in
every frame), with some effects, and the expected image alone by both paths.

    python benchmarks/simulate_speed.py -n 300 --runs 5
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import _study
from rasnik import load_system, simulate

SYSTEM = load_system("solidras")
POSE = (41000.0, 30200.0, 0.002)


def rate(make: Callable[[int], object], n: int, runs: int) -> float:
    """Frames per second of the best run."""
    best = float("inf")
    for _ in range(runs):
        start = time.perf_counter()
        make(n)
        best = min(best, time.perf_counter() - start)
    return n / best


def streamed(n: int, **options: object) -> None:
    for _ in simulate(SYSTEM, POSE, n=n, seed=1, **options):  # type: ignore[arg-type]
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=200, help="frames of a run with noise only")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    print(_study.environment())
    n, few = options.n, max(4, options.n // 20)
    cases: list[tuple[str, Callable[[int], object], int]] = [
        ("noise only, kept", lambda n: simulate(SYSTEM, POSE, n=n, seed=1).frames, n),
        ("noise only, streamed", streamed, n),
        ("noise, whole electrons", lambda n: streamed(n, statistics="poisson"), few),
        ("gain, blooming", lambda n: streamed(n, effects=["gain_spread", "blooming"]), few),
        ("flicker", lambda n: streamed(n, effects="flicker"), few),
        ("motion", lambda n: streamed(n, motion="sine:hz=3,x_um=0.2"), few),
        ("expected image, exact", lambda n: [_expected("exact") for _ in range(n)], few),
        ("expected image, paper", lambda n: [_expected("paper") for _ in range(n)], few),
    ]
    print(f"{'':>24} {'frames/s':>10}   720 x 540, best of {options.runs}")
    for name, make, count in cases:
        make(2)
        print(f"{name:>24} {rate(make, count, options.runs):>10.1f}", flush=True)


def _expected(path: str) -> None:
    simulate(SYSTEM, POSE, seed=1, path=path).expected(0)


if __name__ == "__main__":
    main()
