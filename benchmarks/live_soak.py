"""Hours of `rasnik live`: memory over time, every frame accounted for, a clean end on SIGTERM.

The station runs as a child process, as a service would, with simulated cameras or replays of
frames that were written before. Its memory, threads and open files are read from outside, the
last frames from its record. At the end it gets SIGTERM, and the numbers it says are compared
with the record: every frame is recorded, or counted as lost or dropped.

    python benchmarks/live_soak.py --hours 2
    python benchmarks/live_soak.py --hours 0.05 --cameras 1 --replays 1 --rate 60 --page
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

import _study

_study.one_thread()

import numpy as np  # noqa: E402
from scipy.stats import linregress  # noqa: E402

from rasnik import Flag, load_system, simulate  # noqa: E402
from rasnik.io import read_track  # noqa: E402
from rasnik.live.station import StationConfig  # noqa: E402
from rasnik.live.station_file import station_toml  # noqa: E402

REPLAYED = 64  # frames, again and again
LONGEST_END_S = 30.0
GROWTH_MIB_PER_HOUR = 16.0  # of the trend after the first quarter
NOISE_MIB = 12.0  # what the trend of a short run may come to by chance
SAID = re.compile(
    r"^(\w+): (\d+) frames, (\d+) with a position, (\d+) lost, (\d+) dropped, (\d+) recorded"
)


def write_station(folder: Path, options: argparse.Namespace) -> Path:
    """The station file, with the frames of its replays."""
    camera = {"frame_rate_hz": options.rate, "seed": options.seed}
    system = load_system(options.system)
    channels: list[dict[str, Any]] = [
        {"name": f"simulated{k}", "system": options.system, "camera": camera}
        for k in range(options.cameras)
    ]
    if options.replays:
        turn = 2 * np.pi * np.arange(REPLAYED) / REPLAYED
        poses = [(4000 + 0.1 * np.cos(a), 5000 + 0.1 * np.sin(a), 0.002) for a in turn]
        np.save(folder / "frames.npy", simulate(system, poses, seed=options.seed).frames)
    for k in range(options.replays):
        replay = {"kind": "replay", "source": [str(folder / "frames.npy")], "repeat": True}
        channels.append({"name": f"replay{k}", "system": options.system, "camera": camera | replay})
    for channel in channels:
        channel["recording"] = {"rotate_hours": options.rotate_hours}
    config = StationConfig.model_validate(
        {"folder": folder / "data", "server": {"port": 0}, "channel": channels}
    )
    path = folder / "station.toml"
    path.write_text(station_toml(config), encoding="utf-8")
    return path


class Child:
    """The station in its own process, and what it says."""

    def __init__(self, station: Path, page: bool) -> None:
        command = [sys.executable, "-c", "from rasnik.cli import app; app()", "live", str(station)]
        self.process = subprocess.Popen(
            [*command, "--page" if page else "--no-page"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line.rstrip())

    @property
    def url(self) -> str:
        return next((line.split()[1] for line in self.lines if line.startswith("page: ")), "")

    def usage(self) -> dict[str, float]:
        """Memory in MiB, threads, open files, and seconds of processor time so far."""
        proc = Path(f"/proc/{self.process.pid}")
        status = dict(
            line.split(":", 1) for line in (proc / "status").read_text().splitlines() if ":" in line
        )
        ticks = (proc / "stat").read_text().rpartition(")")[2].split()[11:13]
        return {
            "rss_mib": int(status["VmRSS"].split()[0]) / 1024,
            "threads": int(status["Threads"]),
            "files": len(list((proc / "fd").iterdir())),
            "cpu_s": sum(map(int, ticks)) / 100,
        }

    def end(self) -> tuple[int, float]:
        """SIGTERM; the exit status, and how long it took."""
        start_s = time.perf_counter()
        self.process.send_signal(signal.SIGTERM)
        status = self.process.wait(LONGEST_END_S)
        self._reader.join(5)
        return status, time.perf_counter() - start_s


def channel_states(url: str) -> list[dict[str, Any]]:
    """What the page tells of the channels, asked like a viewer would."""
    with urllib.request.urlopen(f"{url}api/channels", timeout=10) as answer:
        return json.loads(answer.read())


def soak(child: Child, options: argparse.Namespace) -> list[dict[str, float]]:
    """Memory and so on at regular times, until the time is over."""
    samples: list[dict[str, float]] = []
    start_s = time.monotonic()
    end_s = start_s + 3600 * options.hours
    while time.monotonic() < end_s:
        time.sleep(min(options.every, max(0.0, end_s - time.monotonic())))
        if child.process.poll() is not None:
            raise SystemExit("the station ended early:\n" + "\n".join(child.lines))
        sample = {"s": time.monotonic() - start_s, **child.usage()}
        if child.url:
            states = channel_states(child.url)
            sample["latency_p99_ms"] = max(s["latency_p99_ms"] or 0.0 for s in states)
        samples.append(sample)
        print("  ".join(f"{name} {value:.5g}" for name, value in sample.items()), flush=True)
    return samples


def accounts(lines: list[str], folder: Path) -> list[dict[str, Any]]:
    """For each channel what it said at its end, beside its record."""
    found = []
    for line in lines:
        if (said := SAID.match(line)) is None:
            continue
        name, *numbers = said.groups()
        frames, tracked, lost, dropped, rows = map(int, numbers)
        tracks = [read_track(file) for file in sorted((folder / name).glob("*.h5"))]
        number = np.concatenate([track.frame for track in tracks])
        flags = np.concatenate([track.flags for track in tracks])
        ok = np.concatenate([track.ok for track in tracks])
        gaps = int(np.diff(number).sum()) - (len(number) - 1)
        found.append(
            {
                "channel": name,
                "frames": frames,
                "rows": len(number),
                "files": len(tracks),
                "lost": lost,
                "dropped": dropped,
                "gaps": gaps,
                "without_position": int((~ok).sum()),
                "flagged_gaps": int(np.count_nonzero(flags & int(Flag.FRAMES_LOST))),
                "accounted": (
                    frames == len(number) + dropped
                    and rows == len(number)
                    and tracked == int(ok.sum())
                    and bool((np.diff(number) > 0).all())
                    and lost + dropped - int(number[0]) <= gaps <= lost + dropped
                ),
            }
        )
    return found


def trend(samples: list[dict[str, float]]) -> tuple[float, float, float]:
    """Memory after the first quarter: (slope, its standard error) in MiB an hour, growth in MiB.

    Memory goes up and down by some 20 MiB from reading to reading; in an hour the slope is known to
    about as much.
    """
    later = samples[len(samples) // 4 :]
    if len(later) < 4:
        return float("nan"), float("nan"), float("nan")
    hours = [sample["s"] / 3600 for sample in later]
    line = linregress(hours, [sample["rss_mib"] for sample in later])
    return float(line.slope), float(line.stderr), float(line.slope) * (hours[-1] - hours[0])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--cameras", type=int, default=2, help="simulated ones")
    parser.add_argument("--replays", type=int, default=0)
    parser.add_argument("--rate", type=float, default=100.0, help="frames per second of each")
    parser.add_argument("--system", default="solidras")
    parser.add_argument("--rotate-hours", type=float, default=0.25)
    parser.add_argument("--every", type=float, default=10.0, help="seconds between readings")
    parser.add_argument("--page", action="store_true", help="serve the page, and ask it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", metavar="FILE", help="write the results")
    options = parser.parse_args()
    print(_study.environment())
    with tempfile.TemporaryDirectory(prefix="rasnik-soak-") as name:
        folder = Path(name)
        child = Child(write_station(folder, options), options.page)
        try:
            samples = soak(child, options)
            status, end_s = child.end()
        finally:
            child.process.kill()
        table = accounts(child.lines, folder / "data")
    slope, error, growth = trend(samples)
    cpu = samples[-1]["cpu_s"] / samples[-1]["s"]
    print(f"\n{'channel':12}" + "".join(f"{key:>17}" for key in list(table[0])[1:]))
    for row in table:
        print(f"{row['channel']:12}" + "".join(f"{row[key]!s:>17}" for key in list(row)[1:]))
    flat = not (slope > GROWTH_MIB_PER_HOUR and growth > NOISE_MIB)
    complete = len(table) == options.cameras + options.replays
    clean = status == 0 and not any("Traceback" in line for line in child.lines)
    print(
        f"\nmemory {samples[0]['rss_mib']:.0f} MiB first, {samples[-1]['rss_mib']:.0f} MiB last, "
        f"{slope:+.1f} +- {error:.1f} MiB/h after the first quarter ({growth:+.1f} MiB): "
        f"{'flat' if flat else 'GROWS'}\n"
        f"threads {samples[0]['threads']:g} first, {samples[-1]['threads']:g} last; open files "
        f"{samples[0]['files']:g} first, {samples[-1]['files']:g} last; {cpu:.2f} cores\n"
        f"frames unaccounted for: {'none' if all(r['accounted'] for r in table) else 'SOME'}\n"
        f"SIGTERM: status {status} after {end_s:.1f} s"
    )
    _study.save_json(options.json, options=vars(options), samples=samples, channels=table)
    if not (flat and complete and clean and all(row["accounted"] for row in table)):
        raise SystemExit("\n".join(["the soak failed; the station said:", *child.lines]))


if __name__ == "__main__":
    main()
