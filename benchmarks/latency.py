"""From frame to pose in a paced stream: how late poses come, and how late the machine itself is.

A frame is handed over at every tick of the clock, as the thread that reads a camera would do
it; its latency is the time from the tick until `Tracker.update` returns. Frames that come
while one is worked on wait in a ring of buffers; when all are full the oldest is lost.
The mask drifts and shakes, so that the tracker has to renew its reference again and again. The
frames are read from memory in order, forth and back.

Between the parts of the stream two other loops run at the same pace: one that does nothing and
one that only adds up the frame. What they lose is lost to the machine.

    python benchmarks/latency.py
    python benchmarks/latency.py --rate 275 --seconds 60 --json latency.json
"""

from __future__ import annotations

import argparse

import _study

_study.one_thread()

import ctypes  # noqa: E402
import gc  # noqa: E402
import os  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402

from rasnik import Flag, Pose, Tracker, load_system  # noqa: E402
from rasnik.imaging.projection import Projection  # noqa: E402

START_UM = (41000.0, 30200.0)
DIRECTION = (0.8, 0.6)
THETA_RAD, ORIENTATION = 0.002, 4
WRONG_SIGMAS = 8.0

# Sleeping, even for no time, ends late by a tenth of a millisecond or so; the rest is waited for
# awake. Whoever waits for a camera leaves the interpreter to other threads meanwhile: a foreign
# function does so, too.
_AWAKE_S = 3e-4
_give_way = ctypes.CDLL(None).sched_yield if os.name == "posix" else lambda: time.sleep(0)


def wait_until(moment_s: float) -> None:
    """Return at a time of `time.perf_counter`, as exactly as the machine allows."""
    spare = moment_s - time.perf_counter() - _AWAKE_S
    if spare > 0:
        time.sleep(spare)
    while time.perf_counter() < moment_s:
        _give_way()


def paced(
    work: Callable[[int], Pose | None],
    keep: Callable[[int, Pose | None], None],
    ticks: range,
    rate_hz: float,
    buffers: int,
) -> np.ndarray:
    """Seconds from each tick to the end of its work; NaN for ticks whose frame was lost."""
    count = len(ticks)
    latency = np.full(count, np.nan)
    start = time.perf_counter() + 0.01
    k = 0
    while k < count:
        tick = start + k / rate_hz
        behind = int((time.perf_counter() - tick) * rate_hz)
        if behind >= buffers:
            k += behind - buffers + 1
            continue
        wait_until(tick)
        result = work(ticks[k])
        latency[k] = time.perf_counter() - tick
        keep(ticks[k], result)
        k += 1
    return latency


class Stream:
    """Frames of a moving mask, in memory, and the tracker that follows them."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.system = load_system("solidras", {"sensor.frame_rate_hz": options.rate})
        self.rate_hz = options.rate
        time_s = np.arange(options.pool) / options.rate
        sine = np.sin(2 * np.pi * options.sine_hz * time_s)
        moved = options.drift_um_s * time_s + options.sine_um * sine
        self.truth_um = np.array(START_UM) + moved[:, None] * np.array(DIRECTION)
        scale = self.system.optics.scale
        projections = [
            Projection.from_pose(x, y, scale, THETA_RAD, ORIENTATION) for x, y in self.truth_um
        ]
        self.frames = _study.frame_pool(self.system, projections, seed=options.seed)
        self.tracker = Tracker(self.system, orientation=ORIENTATION)
        self.references_before = 0
        # Numbers, not poses: ten thousands of objects would occupy Python's memory management.
        self.found: dict[int, tuple[float, ...]] = {}

    def index(self, k: int) -> int:
        """Which frame is shown at tick k: forth and back, without a jump."""
        turn = len(self.frames) - 1
        k %= 2 * turn
        return k if k <= turn else 2 * turn - k

    def nothing(self, k: int) -> None:
        pass

    def add_up(self, k: int) -> None:
        self.frames[self.index(k)].sum()

    def follow(self, k: int) -> Pose:
        return self.tracker.update(self.frames[self.index(k)], k / self.rate_hz, k)

    def keep(self, k: int, pose: Pose | None) -> None:
        if pose is not None:
            sigmas = (pose.sigma_x_um, pose.sigma_y_um)
            self.found[k] = (pose.x_um, pose.y_um, *sigmas, float(pose.ok), float(pose.flags))

    def judged(self) -> dict[str, Any]:
        """What became of the frames: errors against the truth, and flags."""
        table = np.array(list(self.found.values()))
        ok = table[:, 4] > 0
        truth = self.truth_um[[self.index(k) for k in self.found]]
        error, sigma = (table[:, :2] - truth)[ok], table[ok, 2:4]
        flags: dict[str, int] = {}
        for value, count in zip(*np.unique(table[:, 5], return_counts=True), strict=True):
            for name in Flag(int(value)).names:
                flags[name] = flags.get(name, 0) + int(count)
        return {
            "frames": len(table),
            "without_position": int(np.count_nonzero(~ok)),
            "wrong": int((np.abs(error) > WRONG_SIGMAS * sigma).any(axis=1).sum()),
            "error_rms_nm": 1e3 * float(np.sqrt(np.mean(error**2))),
            "sigma_rms_nm": 1e3 * float(np.sqrt(np.mean(sigma**2))),
            "flags": flags,
            "references": self.tracker.references - self.references_before,
        }


def run(stream: Stream, options: argparse.Namespace) -> dict[str, list[np.ndarray]]:
    """Latencies of the three loops, which take turns, part by part."""
    loops = {
        "empty loop": (stream.nothing, 0.2),
        "frame.sum()": (stream.add_up, 0.2),
        "Tracker.update": (stream.follow, 1.0),
    }
    found: dict[str, list[np.ndarray]] = {name: [] for name in loops}
    total = round(options.seconds * stream.rate_hz)
    part = min(total, round(options.part * stream.rate_hz))
    # The first frames are not paced: the mask has to be found and the code to be compiled.
    done = round(options.warm_up * stream.rate_hz)
    for k in range(done):
        stream.follow(k)
    stream.references_before = stream.tracker.references
    # What has been imported need not be looked through for garbage: that takes 50 ms at times.
    gc.collect()
    gc.freeze()
    for first in range(done, done + total, part):
        for name, (work, share) in loops.items():
            count = max(1, round(min(part, done + total - first) * share))
            ticks = range(first, first + count)
            latency = paced(work, stream.keep, ticks, stream.rate_hz, options.buffers)
            found[name].append(latency)
            time.sleep(0.1)  # whatever still runs in the background ends
    return found


def summary(parts: list[np.ndarray], rate_hz: float) -> dict[str, float]:
    """Milliseconds, and numbers of ticks."""
    latency_s = np.concatenate(parts)
    ms = 1e3 * latency_s[np.isfinite(latency_s)]
    return {
        "p99_quietest_ms": min(1e3 * float(np.nanquantile(part, 0.99)) for part in parts),
        "median_ms": float(np.median(ms)),
        "p99_ms": float(np.quantile(ms, 0.99)),
        "p999_ms": float(np.quantile(ms, 0.999)),
        "max_ms": float(ms.max()),
        "late": int(np.count_nonzero(ms > 1e3 / rate_hz)),
        "missed": len(latency_s) - len(ms),
        "ticks": len(latency_s),
    }


def show(results: dict[str, dict[str, float]], judged: dict[str, Any]) -> None:
    print(
        f"\n{'latency, ms':16}{'median':>9}{'99 %':>9}{'99.9 %':>9}{'largest':>9}"
        f"{'ticks':>8}{'late':>7}{'missed':>8}{'99 % of the quietest part':>27}"
    )
    for name, r in results.items():
        print(
            f"{name:16}{r['median_ms']:>9.3f}{r['p99_ms']:>9.3f}{r['p999_ms']:>9.3f}"
            f"{r['max_ms']:>9.3f}{r['ticks']:>8}{r['late']:>7}{r['missed']:>8}"
            f"{r['p99_quietest_ms']:>27.3f}"
        )
    print("late: longer than one tick; missed: lost because all buffers were full")
    flags = ", ".join(f"{name} {count}" for name, count in judged["flags"].items()) or "none"
    print(
        f"\nposes: {judged['frames']}, without position {judged['without_position']}, "
        f"wrong {judged['wrong']}; rms error {judged['error_rms_nm']:.3f} nm, "
        f"stated {judged['sigma_rms_nm']:.3f} nm\n"
        f"new references {judged['references']}; flags: {flags}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rate", type=float, default=860.0, help="frames per second")
    parser.add_argument("--seconds", type=float, default=30.0, help="of tracking")
    parser.add_argument("--part", type=float, default=5.0, help="seconds between the other loops")
    parser.add_argument("--warm-up", type=float, default=0.5, help="seconds of frames, not paced")
    parser.add_argument("--buffers", type=int, default=16, help="frames that can wait")
    parser.add_argument("--pool", type=int, default=860, help="frames in memory")
    parser.add_argument("--drift-um-s", type=float, default=1.0)
    parser.add_argument("--sine-um", type=float, default=0.05, help="amplitude")
    parser.add_argument("--sine-hz", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", metavar="FILE", help="write the results")
    options = parser.parse_args()
    print(_study.environment())
    stream = Stream(options)
    print(
        f"{options.rate:g} Hz, 720 x 540 pixels of 8 bits, seed {options.seed}; "
        f"{options.drift_um_s:g} um/s and {1e3 * options.sine_um:g} nm at {options.sine_hz:g} Hz"
    )
    latencies = run(stream, options)
    results = {name: summary(values, options.rate) for name, values in latencies.items()}
    judged = stream.judged()
    show(results, judged)
    _study.save_json(options.json, options=vars(options), latency=results, poses=judged)


if __name__ == "__main__":
    main()
