"""The page open on a fast camera: latency of poses, updates of the page, share of a processor.

A simulated camera, a station and its page run in this process, and headless Chromium in others.
Latency is that from the reception of a frame to its pose being there for everybody, by the rows
of the channel. Chromium draws without a graphics card here: its own share is large, and on a
machine with two cores it is taken from the station's.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any

from _study import environment, one_thread, save_json

one_thread()


def cpu_s() -> float:
    """Processor time of this process, all threads."""
    times = os.times()
    return times.user + times.system


def measured(channel: Any, page: Any, seconds: float) -> dict[str, float]:
    """What happened in so many seconds."""
    import numpy as np

    count, before = channel.recent.count, channel.status()
    updates = page.evaluate("({...rasnik.updates})") if page is not None else {}
    start_s, start_cpu_s = time.monotonic(), cpu_s()
    if page is None:
        time.sleep(seconds)
    else:
        page.wait_for_timeout(1e3 * seconds)
    span_s, used_s = time.monotonic() - start_s, cpu_s() - start_cpu_s
    after = page.evaluate("({...rasnik.updates})") if page is not None else {}
    rows, _ = channel.recent.since(count)
    latency_ms = 1e3 * rows["latency_s"]
    status = channel.status()
    return {
        "frames / s": len(rows) / span_s,
        "dropped": status.dropped - before.dropped,
        "latency, median / ms": float(np.median(latency_ms)),
        "latency, 99 % / ms": float(np.quantile(latency_ms, 0.99)),
        **{f"{name} updates / s": (after[name] - updates[name]) / span_s for name in updates},
        "processor / %": 100 * used_s / span_s,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frame-rate", type=float, default=275.0, help="Hz")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--json", help="write the results to this file")
    arguments = parser.parse_args()

    from playwright.sync_api import sync_playwright

    from rasnik.live.service import Station
    from rasnik.live.station import CameraConfig, ChannelConfig, Server, StationConfig
    from rasnik.web.server import PageServer

    camera = CameraConfig(frame_rate_hz=arguments.frame_rate, seed=arguments.seed)
    results: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        config = StationConfig(
            folder=Path(folder), channel=[ChannelConfig(name="camera", camera=camera)]
        )
        with Station(config) as station, PageServer(station, Server(port=0)) as server:
            channel = station.channels["camera"]
            while channel.recent.count < 5 * arguments.frame_rate:
                time.sleep(0.1)
            results["no page"] = measured(channel, None, arguments.seconds)
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(
                    executable_path=arguments.chromium, args=["--no-sandbox"]
                )
                for name, size in {"desktop": (1400, 1000), "phone": (390, 844)}.items():
                    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
                    page.goto(server.url)
                    page.wait_for_timeout(5000)
                    results[name] = measured(channel, page, arguments.seconds)
                    page.close()
                browser.close()

    print(f"{environment()}; seed {arguments.seed}; load {os.getloadavg()[0]:.1f}")
    print(f"simulated camera, {arguments.frame_rate:g} Hz; {arguments.seconds:g} s each\n")
    print(" " * 24 + "".join(f"{name:>12}" for name in results))
    for row in results["desktop"]:
        cells = (f"{r[row]:12.2f}" if row in r else f"{'':>12}" for r in results.values())
        print(f"{row:24}" + "".join(cells))
    save_json(arguments.json, seed=arguments.seed, results=results)


if __name__ == "__main__":
    main()
