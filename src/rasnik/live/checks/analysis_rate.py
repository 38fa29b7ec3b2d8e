"""How many frames this machine analyses in a second, against those that the cameras send."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.live.checks.finding import Finding, Machine
from rasnik.live.checks.machine import cores_to_use
from rasnik.live.checks.rates import frame_rate_hz, system_of
from rasnik.live.linear_algebra import in_one_thread
from rasnik.live.station import ChannelConfig, StationConfig

__all__ = ["Measured", "Stream", "analysis_rate", "judged", "measure"]

_POSES = 8
_STEP_UM = 0.01  # between frames: slow motion, as at a station
_WARM = 48  # frames before the clock starts
_TOTAL_S = 2.0
_MARGIN = 1.25  # of the rate: what reading, recording and the page take besides
_LATE_MS = 20.0


@dataclass(frozen=True, eq=False)
class Measured:
    """How a channel was analysed.

    Attributes
    ----------
    rate_hz : float
        Frames analysed in a second.
    needed_hz : float
        Frames that its camera sends.
    share : float
        Of one core, in computing, at the camera's rate.
    median_ms, p99_ms : float
        Of the times that frames took.
    lost : int
        Frames of the simulation that gave no position.
    """

    name: str
    size: tuple[int, int]
    rate_hz: float
    needed_hz: float
    share: float
    median_ms: float
    p99_ms: float
    lost: int


class Stream:
    """Frames of a channel, simulated, and the tracker that follows them."""

    def __init__(self, channel: ChannelConfig) -> None:
        from rasnik.imaging.simulate import simulate
        from rasnik.tracking.tracker import Tracker

        system = system_of(channel)
        self.channel, self.needed_hz = channel, frame_rate_hz(channel)
        start = simulate(system, seed=0).truth[0]
        poses = [(start.x_um + k * _STEP_UM, start.y_um, 0.002) for k in range(_POSES)]
        self.frames = simulate(system, poses, seed=1).frames
        self.tracker = Tracker(system, model=channel.model, orientation=channel.orientation)
        self._k = 0
        self.lost = 0

    def step(self) -> None:
        """The next frame: forth and back, without a jump."""
        turn = len(self.frames) - 1
        k = self._k % (2 * turn)
        pose = self.tracker.update(
            self.frames[k if k <= turn else 2 * turn - k], self._k / self.needed_hz, self._k
        )
        self.lost += not pose.ok
        self._k += 1

    def run(self, seconds: float) -> tuple[NDArray[np.float64], float]:
        """Seconds that each frame took, and those of computing in this thread in all."""
        taken: list[float] = []
        computed = time.thread_time()
        now = time.perf_counter()
        end = now + seconds
        while now < end or not taken:
            before = now
            self.step()
            now = time.perf_counter()
            taken.append(now - before)
        return np.array(taken), time.thread_time() - computed


def measure(channels: Sequence[ChannelConfig], seconds: float = _TOTAL_S) -> list[Measured]:
    """All channels at a time, each as fast as it goes, in a thread of its own as at a station."""
    in_one_thread()
    streams = [Stream(channel) for channel in channels]
    for stream in streams:
        for _ in range(_WARM):
            stream.step()
        stream.lost = 0
    results: dict[int, Any] = {}

    def work(index: int) -> None:
        results[index] = streams[index].run(seconds)

    threads = [threading.Thread(target=work, args=(k,), daemon=True) for k in range(len(streams))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if len(results) < len(streams):
        raise RuntimeError("a frame could not be analysed")
    return [_measured(stream, *results[k]) for k, stream in enumerate(streams)]


def _measured(stream: Stream, taken: NDArray[np.float64], computed_s: float) -> Measured:
    height, width = stream.frames[0].shape
    median_ms, p99_ms = 1e3 * np.percentile(taken, [50, 99])
    return Measured(
        stream.channel.name,
        (width, height),
        len(taken) / float(taken.sum()),
        stream.needed_hz,
        computed_s / len(taken) * stream.needed_hz,
        float(median_ms),
        float(p99_ms),
        stream.lost,
    )


def analysis_rate(
    machine: Machine, config: StationConfig, seconds: float = _TOTAL_S
) -> Iterator[Finding]:
    """Whether all cameras of the station together are kept up with."""
    yield from judged(measure(config.channel, seconds), cores_to_use(machine))


def judged(measured: Sequence[Measured], cores: float) -> Iterator[Finding]:
    """Findings about channels that were analysed at the same time."""
    together = f", {len(measured)} channels at a time" if len(measured) > 1 else ""
    for each in measured:
        yield _judged(each, together)
    share = sum(each.share for each in measured)
    if len(measured) > 1:
        found = f"{share:.2f} of {cores:g} cores for all channels together"
        if share * _MARGIN > cores:
            yield Finding(
                "analysis", "fault", found, "Run some of the channels on another machine."
            )
        else:
            yield Finding("analysis", "ok", found)


def _judged(each: Measured, together: str) -> Finding:
    about = f"analysis {each.name}"
    width, height = each.size
    found = (
        f"{each.rate_hz:.0f} frames/s of {width} x {height}{together}; the camera sends "
        f"{each.needed_hz:g}, which take {100 * each.share:.0f} % of a core; "
        f"{each.median_ms:.2f} ms a frame, 99 % within {each.p99_ms:.2f} ms"
    )
    if each.lost:
        return Finding(
            about,
            "fault",
            f"{found}; {each.lost} simulated frames gave no position",
            "See whether the system's file describes the instrument: rasnik simulate, then "
            "rasnik track.",
        )
    if each.rate_hz < each.needed_hz:
        return Finding(
            about,
            "fault",
            f"{found}: not kept up with",
            "Lower frame_rate_hz or the region of the camera, or use a faster machine.",
        )
    if each.rate_hz < _MARGIN * each.needed_hz:
        return Finding(
            about,
            "warning",
            f"{found}: next to nothing is left for reading and recording",
            "Lower frame_rate_hz, or leave this machine to the station alone.",
        )
    if each.p99_ms > _LATE_MS:
        return Finding(
            about,
            "warning",
            f"{found}: some come late",
            "Stop other programs that compute on this machine, and measure again.",
        )
    return Finding(about, "ok", found)
