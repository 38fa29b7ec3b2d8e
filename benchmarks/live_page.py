"""The page open on a fast camera: latency of poses, updates of the page, share of a processor.

A simulated camera and its station run in this process, the page in another one as with
`rasnik live`, headless Chromium in more. Latency is that from the reception of a frame to its
pose being there for everybody, by the rows of the channel. Chromium draws without a graphics card
here: its own share is large, and on a machine with two cores it is taken from the others'.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from _study import environment, save_json

SIZES = {"desktop": (1400, 1000), "phone": (390, 844)}
#: Threads of the station; the first makes the simulated images, too.
PARTS = ("acquisition", "tracking", "record", "watch", "page answers")
SETTLED_S = 5.0  # of a page that was just opened
TICKS_HZ = os.sysconf("SC_CLK_TCK")


def cpu_s(pid: int, children: bool = False) -> float:
    """Processor time of a process, and of all that come from it."""
    ticks = 0
    family = {pid}
    for number in sorted(int(name) for name in os.listdir("/proc") if name.isdigit()):
        try:
            fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if number in family or (children and int(fields[1]) in family):
            family.add(number)
            ticks += int(fields[11]) + int(fields[12])
    return ticks / TICKS_HZ


def threads_s() -> dict[str, float]:
    """Processor time of the threads of this process that have most to do, by their names."""
    found: dict[str, float] = {}
    for thread in threading.enumerate():
        text = Path(f"/proc/self/task/{thread.native_id}/stat").read_text()
        ticks = sum(map(int, text.rpartition(")")[2].split()[11:13]))
        name = next((word for word in PARTS if word in thread.name), "other")
        found[name] = found.get(name, 0.0) + ticks / TICKS_HZ
    return {f"  {name}": found.get(name, 0.0) for name in PARTS}


def look_on(line: Any, url: str, chromium: str) -> None:
    """In a process of its own: open the page in sizes that are asked for, count its updates."""
    from playwright.sync_api import sync_playwright

    # As any program, whatever the station that started it has.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.setpriority(os.PRIO_PROCESS, 0, 0)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page: Any = None
        while (asked := line.recv()) is not None:
            if asked != "updates":
                if page is not None:
                    page.close()
                page = browser.new_page(viewport={"width": asked[0], "height": asked[1]})
                page.goto(url)
                page.wait_for_timeout(1e3 * SETTLED_S)
            line.send(page.evaluate("({...rasnik.updates})"))
        browser.close()


def measured(channel: Any, pids: dict[str, int], line: Any, seconds: float) -> dict[str, float]:
    """What happens in so many seconds."""
    import numpy as np

    def updates() -> dict[str, int]:
        if line is None:
            return {}
        line.send("updates")
        return line.recv()

    def used() -> dict[str, float]:
        processes = {name: cpu_s(pid, name == "browser") for name, pid in pids.items()}
        return {"station": processes.pop("station"), **threads_s(), **processes}

    before, updates_before = channel.status(), updates()
    count, start_s, used_before = channel.recent.count, time.monotonic(), used()
    time.sleep(seconds)
    span_s, used_s = time.monotonic() - start_s, used()
    rows, _ = channel.recent.since(count)
    after = updates()
    latency_ms = 1e3 * rows["latency_s"]
    dropped = channel.status().dropped - before.dropped
    return {
        "frames / s": len(rows) / span_s,
        "dropped": dropped,
        "latency, median / ms": float(np.median(latency_ms)),
        "latency, 99 % / ms": float(np.quantile(latency_ms, 0.99)),
        "latency, longest / ms": float(latency_ms.max()),
        **{f"{name} updates / s": (after[name] - updates_before[name]) / span_s for name in after},
        **{f"{name} / %": 100 * (used_s[name] - used_before[name]) / span_s for name in used_s},
    }


def run(arguments: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Without a viewer, then with each size of the page."""
    from rasnik.live.service import Station
    from rasnik.live.station import CameraConfig, ChannelConfig, Server, StationConfig
    from rasnik.web.process import PageProcess
    from rasnik.web.server import PageServer

    camera = CameraConfig(frame_rate_hz=arguments.frame_rate, seed=arguments.seed)
    kind = PageServer if arguments.thread else PageProcess
    results: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        config = StationConfig(
            folder=Path(folder), channel=[ChannelConfig(name="camera", camera=camera)]
        )
        with Station(config) as station, kind(station, Server(port=0)) as server:
            channel = station.channels["camera"]
            while channel.recent.count < 5 * arguments.frame_rate:
                time.sleep(0.1)
            pids = {"station": os.getpid()}
            if isinstance(server, PageProcess) and server.pid is not None:
                pids["page"] = server.pid
            results["no viewer"] = measured(channel, pids, None, arguments.seconds)
            context = multiprocessing.get_context("spawn")
            line, there = context.Pipe()
            viewer = context.Process(target=look_on, args=(there, server.url, arguments.chromium))
            viewer.start()
            pids["browser"] = viewer.pid or 0
            for name in arguments.size:
                line.send(SIZES[name])
                line.recv()
                results[name] = measured(channel, pids, line, arguments.seconds)
            line.send(None)
            viewer.join(10)
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frame-rate", type=float, default=275.0, help="Hz")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement")
    parser.add_argument("--size", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--thread", action="store_true", help="the page in the station's process")
    parser.add_argument(
        "--not-raised", action="store_true", help="do not put the station before other programs"
    )
    parser.add_argument("--json", help="write the results to this file")
    arguments = parser.parse_args()

    from rasnik.live.linear_algebra import in_one_thread
    from rasnik.live.priority import before_others

    in_one_thread()
    raised = nullcontext("") if arguments.not_raised else before_others(1)
    with raised as priority:
        results = run(arguments)

    print(f"{environment()}; seed {arguments.seed}; load {os.getloadavg()[0]:.1f}")
    print(
        f"simulated camera, {arguments.frame_rate:g} Hz; {arguments.seconds:g} s each; page in "
        f"{'a thread' if arguments.thread else 'its own process'}; station's priority: "
        f"{priority or 'that of any program'}\n"
    )
    print(" " * 24 + "".join(f"{name:>12}" for name in results))
    for row in dict.fromkeys(row for result in results.values() for row in result):
        cells = (f"{r[row]:12.2f}" if row in r else f"{'':>12}" for r in results.values())
        print(f"{row:24}" + "".join(cells))
    save_json(arguments.json, options=vars(arguments), priority=priority, results=results)


if __name__ == "__main__":
    main()
