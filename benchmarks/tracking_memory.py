"""Memory of tracking over a million frames: it must not grow.

SolidRas, 720 x 540 pixels of 8 bits. Frames are made while they are tracked: stretches of 64
frames (`_fault_stream`: drift, vibration, jumps and other disturbances) are shown to and fro,
a new stretch every 5000 frames (of long runs). The track goes into an HDF5 file, as with a camera.

    python benchmarks/tracking_memory.py -n 1000000 --json memory.json
"""

from __future__ import annotations

import argparse

import _study

_study.one_thread()

import json  # noqa: E402
import os  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Iterator  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
from rich.progress import Progress  # noqa: E402

from _fault_stream import SYSTEM, FaultStream  # noqa: E402
from rasnik import System, Tracker  # noqa: E402
from rasnik.io.track_file import TrackWriter  # noqa: E402

STRETCH = 64
# 11 bytes a frame of the long run; a row of the track that is kept takes 116.
ALLOWED_MB = 10.0


def resident_mb() -> float:
    """Memory of this process that is in use (Linux)."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def shown(n: int) -> int:
    """For how many of n frames a stretch lasts: a tenth of the run sees several."""
    return int(np.clip(n // 40, 2 * STRETCH, 5000))


def endless(stream: FaultStream, n: int) -> Iterator[Any]:
    """n frames, each stretch of the stream to and fro until the next one is due."""
    turn = 2 * STRETCH - 2
    frames: list[Any] = []
    for k in range(n):
        stretch, step = divmod(k, shown(n))
        if step == 0:
            first = stretch * STRETCH
            frames.clear()
            frames.extend(stream.frame(first + j) for j in range(STRETCH))
        at = step % turn
        yield frames[min(at, turn - at)]


def _take_what_is_needed_once(system: System, seed: int) -> None:
    """Have another tracker start from nothing: buffers and tables of that stay in memory."""
    stream = FaultStream(40, seed, every=8.0, kinds=("jump", "hand"), exact=0.0, system=system)
    Tracker(system).run(stream.frames(), stream.times_s.tolist(), stream.numbers.tolist())


def measure(
    n: int,
    samples: int,
    path: Path,
    *,
    seed: int = 1,
    every: float = 1000.0,
    system: System = SYSTEM,
    progress: Any = None,
) -> tuple[np.ndarray, int]:
    """Track n frames into a file.

    Returns
    -------
    table : ndarray, shape (about samples, 3)
        Frames so far, resident memory (MB), seconds since the start.
    ok : int
        Frames with a position.
    """
    stretches = -(-n // shown(n))
    stream = FaultStream(stretches * STRETCH, seed, every=every, exact=0.0, system=system)
    rate_hz = stream.system.sensor.frame_rate_hz or 275.0
    _take_what_is_needed_once(system, seed)
    tracker = Tracker(system)
    rows, done, ok, start = [], 0, 0, time.perf_counter()
    with TrackWriter(path, system=stream.system, metadata={"source": "made up"}) as file:
        times = (k / rate_hz for k in range(n))
        for block in tracker.blocks(endless(stream, n), times):
            file.write(block)
            done += len(block)
            ok += int(block.ok.sum())
            if done * samples >= (len(rows) + 1) * n:
                rows.append((done, resident_mb(), time.perf_counter() - start))
            if progress is not None:
                progress(len(block))
    if done != n:
        raise RuntimeError(f"{n} frames were handed over, {done} came back")
    return np.array(rows), ok


def growth_mb(table: np.ndarray, warm_up: float = 0.1) -> tuple[float, float]:
    """(last less first, slope x frames) of the resident memory after the warm-up."""
    frames, memory = table[table[:, 0] >= warm_up * table[-1, 0], :2].T
    slope = np.polyfit(frames, memory, 1)[0]
    return float(memory[-1] - memory[0]), float(slope * (frames[-1] - frames[0]))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-n", type=int, default=1_000_000, help="frames")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", type=float, default=1000.0, help="frames between disturbances")
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--json", type=Path, help="write the samples to this file")
    options = parser.parse_args()
    print(_study.environment())
    with tempfile.TemporaryDirectory() as folder, Progress() as bar:
        task = bar.add_task("frames", total=options.n)
        path = Path(folder) / "track.h5"
        table, ok = measure(
            options.n, options.samples, path, seed=options.seed, every=options.every,
            progress=lambda n: bar.advance(task, n),
        )  # fmt: skip
        size_mb = path.stat().st_size / 1e6
    print(f"\n{'frames':>10}{'resident MB':>14}{'frames/s':>10}")
    for k in np.linspace(0, len(table) - 1, min(11, len(table))).astype(int):
        frames, memory, seconds = table[k]
        print(f"{frames:>10.0f}{memory:>14.1f}{frames / seconds:>10.0f}")
    change, trend = growth_mb(table)
    flat = max(change, trend) < ALLOWED_MB
    print(
        f"\n{ok} of {options.n} frames with a position; file of {size_mb:.1f} MB\n"
        f"growth after the first tenth: {change:.2f} MB, straight line {trend:.2f} MB: "
        f"{'flat' if flat else 'GROWS'} (allowed: {ALLOWED_MB:g} MB)"
    )
    if options.json:
        record = {
            "environment": _study.environment(), "frames": options.n, "seed": options.seed,
            "growth_mb": change, "trend_mb": trend, "file_mb": size_mb, "ok": ok,
            "table": table.tolist(),
        }  # fmt: skip
        options.json.write_text(json.dumps(record, indent=1), encoding="utf-8")
    return 0 if flat else 1


if __name__ == "__main__":
    sys.exit(main())
