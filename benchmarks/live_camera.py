"""A GigE Vision stream through the whole live pipeline: is every frame accounted for, is it right?

Aravis' own camera runs in another process on the loopback interface and shows a mask in known
motion (`_fake_gige`). It notes every frame that it sends, with its time stamp; the record of
the channel is compared with these notes, frame by frame.

* stream: nothing lost but what is counted; error of the positions over the Cramer-Rao bound.
* losses: the same with packets lost on their way; frames counted lost = frames sent that
  are not in the record, gap by gap.
* restart: two cameras; one is killed and started again. The other must not notice, the first
  must be back within 5 s, and its record must show the gap.

Frames that the camera does not send because its own process gets no time are counted by time
("not sent"); they are no losses of the pipeline.

    python benchmarks/live_camera.py --minutes 10
    python benchmarks/live_camera.py --parts stream --minutes 1 --rate 275
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _study

_study.one_thread()

import numpy as np  # noqa: E402

import _fake_gige  # noqa: E402
from rasnik import Flag, System, bound, load_system  # noqa: E402
from rasnik.io.track_table import read_rows  # noqa: E402
from rasnik.live.channel import Channel  # noqa: E402
from rasnik.live.service import Station  # noqa: E402
from rasnik.live.station import CameraConfig, ChannelConfig, StationConfig  # noqa: E402
from rasnik.live.status import ChannelStatus  # noqa: E402

WRONG_SIGMAS = 8.0
BACK_WITHIN_S = 5.0
RATIO_LIMIT = 1.1
PARTS = ("stream", "losses", "restart")
ADDRESSES = ("127.0.0.1", "127.0.0.2")


@dataclass(frozen=True, eq=False)
class Account:
    """What became of the frames that were sent, from the first recorded one to the last."""

    status: ChannelStatus
    not_recorded: int
    rows: np.ndarray
    index: np.ndarray  # of each row in what was sent; -1 for rows that were never sent
    sent: np.ndarray

    @property
    def strangers(self) -> int:
        return int(np.count_nonzero(self.index < 0))

    @property
    def missing(self) -> int:
        """Sent between the first and the last row, and not recorded."""
        known = self.index[self.index >= 0]
        return int(known[-1] - known[0] + 1 - len(known))

    @property
    def in_order(self) -> bool:
        return bool((np.diff(self.index[self.index >= 0]) > 0).all())

    @property
    def counted(self) -> int:
        """What the pipeline says that it has lost after it was sent."""
        return self.status.lost_in_transfer + self.status.dropped + self.not_recorded

    @property
    def closed(self) -> bool:
        received = self.status.frames - self.status.dropped - self.not_recorded
        return (
            self.missing == self.counted
            and received == len(self.rows)
            and not self.strangers
            and self.in_order
        )


def account(channel: Channel, fake_logs: list[np.ndarray]) -> Account:
    """Compare a channel that has ended with what was sent to it."""
    folder = Path(channel.status().recording_file).parent
    files = sorted(folder.glob("*.h5"), key=lambda path: path.stat().st_mtime_ns)
    rows = np.concatenate([read_rows(path)[0] for path in files])
    sent = np.concatenate(fake_logs)
    time_us = np.rint(1e6 * rows["device_time_s"]).astype(np.int64)
    place = np.minimum(np.searchsorted(sent["time_us"], time_us), len(sent) - 1)
    index = np.where(sent["time_us"][place] == time_us, place, -1)
    recorder = channel.recorder.status()
    return Account(channel.status(), recorder.not_recorded, rows, index, sent)


# --------------------------------------------------------------------------- positions


def judged(found: Account, system: System, options: argparse.Namespace) -> dict[str, Any]:
    """Errors against the truth of each frame, and the bound."""
    known = (found.index >= 0) & np.isfinite(found.rows["x_um"])
    rows, phase = found.rows[known], found.sent["phase"][found.index[known]]
    truth = _fake_gige.truth_um(phase, options.pool, options.radius_um)
    error = np.stack([rows["x_um"], rows["y_um"]], axis=-1) - truth
    sigma = np.stack([rows["sigma_x_um"], rows["sigma_y_um"]], axis=-1)
    places = _fake_gige.truth_um(np.arange(0, options.pool, options.pool // 5), options.pool, 0)
    pose = (*places[0], _fake_gige.THETA_RAD)
    least = np.sqrt(np.diag(bound(system, [pose], rounding=True).covariance.reshape(4, 4)))[:2]
    # A picture is shown again in every turn: of independent errors there are as many as pictures.
    pictures = min(len(np.unique(phase)), options.pool)
    flags: dict[str, int] = {}
    for value, count in zip(*np.unique(found.rows["flags"], return_counts=True), strict=True):
        for name in Flag(int(value)).names:
            flags[name] = flags.get(name, 0) + int(count)
    return {
        "frames": len(found.rows),
        "without_position": int(np.count_nonzero(~known)),
        "wrong": int((np.abs(error) > WRONG_SIGMAS * sigma).any(axis=1).sum()),
        "rms_nm": (1e3 * np.sqrt(np.mean(error**2, axis=0))).tolist(),
        "mean_nm": (1e3 * error.mean(axis=0)).tolist(),
        "bound_nm": (1e3 * least).tolist(),
        "ratio": (np.sqrt(np.mean(error**2, axis=0)) / least).tolist(),
        "ratio_error": 1 / np.sqrt(2 * pictures),
        "pictures": pictures,
        "flags": flags,
    }


def show_positions(result: dict[str, Any]) -> None:
    print(f"{'':8}{'rms error':>12}{'bound':>10}{'ratio':>9}{'+-':>7}{'mean error':>13}   nm")
    for k, axis in enumerate("xy"):
        print(
            f"{axis:8}{result['rms_nm'][k]:>12.3f}{result['bound_nm'][k]:>10.3f}"
            f"{result['ratio'][k]:>9.3f}{result['ratio_error']:>7.3f}{result['mean_nm'][k]:>13.3f}"
        )
    flags = ", ".join(f"{name} {count}" for name, count in result["flags"].items()) or "none"
    print(
        f"{result['frames']} rows ({result['pictures']} pictures), without position "
        f"{result['without_position']}, wrong {result['wrong']}; flags: {flags}"
    )


def show_account(found: Account) -> None:
    status, latency_ms = found.status, 1e3 * found.rows["latency_s"]
    first, last = found.index[0], found.index[-1]
    span_s = 1e-6 * float(found.sent["time_us"][last] - found.sent["time_us"][first])
    print(
        f"{'sent':>9}{'recorded':>10}{'missing':>9} | {'in transfer':>11}{'dropped':>9}"
        f"{'not recorded':>14} | {'not sent':>9}{'rate, Hz':>10}\n"
        f"{last - first + 1:>9}{len(found.rows):>10}{found.missing:>9} | "
        f"{status.lost_in_transfer:>11}{status.dropped:>9}{found.not_recorded:>14} | "
        f"{status.lost_by_time:>9}{len(found.rows) / span_s:>10.2f}"
    )
    print(
        f"driver: {status.driver_counters}; frames of another origin {found.strangers}; latency "
        f"to the record: median {np.median(latency_ms):.2f} ms, 99 % "
        f"{np.quantile(latency_ms, 0.99):.2f} ms, largest {latency_ms.max():.1f} ms"
    )


def verdict(what: str, holds: bool) -> bool:
    print(f"{'holds' if holds else 'FAILS'}: {what}")
    return holds


# --------------------------------------------------------------------------- the parts


def channel_config(name: str, address: str, rate_hz: float, packet_bytes: int) -> ChannelConfig:
    camera = CameraConfig(
        kind="aravis", device=address, frame_rate_hz=rate_hz, packet_bytes=packet_bytes
    )
    return ChannelConfig(
        name=name, system="solidras", orientation=_fake_gige.ORIENTATION, camera=camera
    )


def wait(seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
    """Wait, at most until something is so; whether it is."""
    end_s = time.perf_counter() + seconds
    while time.perf_counter() < end_s:
        if until():
            return True
        time.sleep(0.02)
    return until()


def one_stream(
    options: argparse.Namespace, folder: Path, pictures: Path, minutes: float, lost_ratio: float
) -> tuple[dict[str, Any], bool]:
    """Part 1: a stream, without or with losses."""
    system = load_system("solidras", {"optics.orientation": _fake_gige.ORIENTATION})
    config = channel_config("bench", ADDRESSES[0], options.rate, options.packet_bytes)
    station = Station(StationConfig(folder=folder, channel=[config]))
    log = folder / "sent.bin"
    with _fake_gige.FakeCamera(log, pictures, lost_ratio=lost_ratio) as fake:
        began_s, cpu_s = time.perf_counter(), time.process_time()
        with station:
            wait(60 * minutes)
        cpu = (time.process_time() - cpu_s) / (time.perf_counter() - began_s)
        sent = fake.sent()
    found = account(station.channels["bench"], [sent])
    show_account(found)
    result = judged(found, system, options)
    show_positions(result)
    print(f"{100 * cpu:.0f} % of a core for the whole pipeline")
    good = verdict(
        f"every frame sent is recorded or counted: {found.missing} missing, "
        f"{found.counted} counted",
        found.closed,
    )
    good &= verdict(
        f"pose equal to truth: {result['wrong']} wrong, {result['without_position']} without",
        not result["wrong"] and not result["without_position"],
    )
    worst = max(result["ratio"])
    limit = RATIO_LIMIT + 3 * result["ratio_error"]
    good &= verdict(f"noise at the bound: {worst:.3f}, at most {limit:.3f}", worst < limit)
    figures = {"sent": len(sent), "missing": found.missing, "counted": found.counted, "cpu": cpu}
    return {**figures, "positions": result}, good


def restart(
    options: argparse.Namespace, folder: Path, pictures: Path
) -> tuple[dict[str, Any], bool]:
    """Part 2: two cameras, one of which is gone for a while."""
    reason = _fake_gige.add_address(ADDRESSES[1])
    if reason:
        print(f"skipped: a second address is not possible here ({reason})")
        return {"skipped": reason}, True
    names = ("steady", "killed")
    configs = [
        channel_config(name, address, options.rate_two, options.packet_bytes)
        for name, address in zip(names, ADDRESSES, strict=True)
    ]
    station = Station(StationConfig(folder=folder, channel=configs))
    logs = [folder / f"sent{k}.bin" for k in range(3)]
    steady = _fake_gige.FakeCamera(logs[0], pictures, address=ADDRESSES[0], serial="R1")
    first = _fake_gige.FakeCamera(logs[1], pictures, address=ADDRESSES[1], serial="R2")
    second = None
    try:
        with station:
            status = {name: channel.status for name, channel in station.channels.items()}
            wait(30, lambda: all(status[name]().locked for name in names))
            wait(options.seconds_two)
            killed_s = time.time()
            first.kill()
            wait(options.away)
            second = _fake_gige.FakeCamera(logs[2], pictures, address=ADDRESSES[1], serial="R2")
            back_s = time.time()
            wait(20, lambda: status["killed"]().reconnects > 0 and status["killed"]().locked)
            wait(options.seconds_two)
    finally:
        for camera in (steady, first, second):
            if camera is not None:
                camera.close()
    one = account(station.channels["steady"], [_fake_gige.read_sent(logs[0])])
    two = account(station.channels["killed"], [_fake_gige.read_sent(log) for log in logs[1:]])
    for name, found in zip(names, (one, two), strict=True):
        print(f"\n{name}")
        show_account(found)
    return _judge_restart(one, two, killed_s, back_s)


def _judge_restart(
    one: Account, two: Account, killed_s: float, back_s: float
) -> tuple[dict[str, Any], bool]:
    host_s = two.rows["host_time_s"]
    after = host_s > back_s
    returned_s = float(host_s[after][0] - back_s) if after.any() else float("inf")
    gap_s = float(np.diff(host_s).max())
    at = int(np.argmax(np.diff(host_s)))
    numbers = int(two.rows["frame"][at + 1] - two.rows["frame"][at] - 1)
    period_s = float(np.median(np.diff(one.rows["device_time_s"])))
    window = (one.rows["host_time_s"] > killed_s - 1) & (one.rows["host_time_s"] < back_s + 5)
    one_ok = np.isfinite(one.rows["x_um"][window]).all()
    print()
    good = verdict(
        f"the other camera unaffected: {one.missing} missing, {one.counted} counted, largest "
        f"time between its frames {1e3 * np.diff(one.rows['host_time_s'][window]).max():.1f} ms",
        one.closed and one.counted == 0 and bool(one_ok),
    )
    good &= verdict(
        f"back {returned_s:.2f} s after it was started again (at most {BACK_WITHIN_S:g})",
        returned_s <= BACK_WITHIN_S,
    )
    good &= verdict(
        f"gap visible in the record: {gap_s:.2f} s without rows, {numbers} numbers left out",
        abs(numbers * period_s - gap_s) < 0.1 * gap_s and two.strangers == 0,
    )
    return {"returned_s": returned_s, "gap_s": gap_s, "numbers_left_out": numbers}, good


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--minutes", type=float, default=1.0, help="of the stream")
    parser.add_argument("--minutes-losses", type=float, help="by default a tenth, at least 1/4")
    parser.add_argument("--rate", type=float, default=275.0, help="frames per second")
    parser.add_argument("--rate-two", type=float, default=100.0, help="of each of two cameras")
    parser.add_argument("--seconds-two", type=float, default=8.0, help="before and after")
    parser.add_argument("--away", type=float, default=4.0, help="seconds without the camera")
    parser.add_argument("--lost-ratio", type=float, default=0.001, help="of the packets")
    parser.add_argument("--packet-bytes", type=int, default=9000)
    parser.add_argument("--pool", type=int, default=275, help="pictures of one turn")
    parser.add_argument("--radius-um", type=float, default=0.5, help="of the motion")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", metavar="FILE", help="write the results")
    options = parser.parse_args()
    print(_study.environment())
    print(f"{options.rate:g} Hz, 720 x 540 pixels of 8 bits, seed {options.seed}")
    results: dict[str, Any] = {}
    good = True
    with tempfile.TemporaryDirectory(prefix="rasnik-live-") as name:
        top = Path(name)
        pictures = top / "pictures.npy"
        system = load_system("solidras")
        _fake_gige.make_pictures(pictures, options.pool, options.radius_um, system, options.seed)
        short = options.minutes_losses or max(options.minutes / 10, 0.25)
        for part in options.parts:
            print(f"\n== {part}")
            folder = top / part
            folder.mkdir()
            if part == "restart":
                results[part], holds = restart(options, folder, pictures)
            else:
                minutes, ratio = (
                    (options.minutes, 0.0) if part == "stream" else (short, options.lost_ratio)
                )
                results[part], holds = one_stream(options, folder, pictures, minutes, ratio)
            good &= holds
    _study.save_json(options.json, options=vars(options), results=results)
    raise SystemExit(0 if good else 1)


if __name__ == "__main__":
    main()
