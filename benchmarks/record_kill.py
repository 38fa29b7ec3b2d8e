"""What a record holds after its program was killed, and after its disk was full.

    python benchmarks/record_kill.py -n 10

**Kills.** A program records simulated poses at 275 frames/s, with raw frames of an event now and
then and files that are rotated every few seconds, and is killed (SIGKILL) at a random moment; it
is started again each time on the same folder. After each kill every file must open and hold every
row handed over more than a second before, with its own values; frames of events must open once
the next program runs. The history of all of it must count every row that is there.

**Full disk.** The record goes to a small disk of its own (tmpfs of 8 MiB; mounting it needs root)
that somebody else fills in the meantime, down to the last byte. It must be said, the program must
go on, rows must be there as soon as there is space again, and not one may be lost. The same with
space that is kept free.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from _kill import killed
from rasnik import load_system
from rasnik.analysis.pose import Pose
from rasnik.cameras.camera import CameraFrame
from rasnik.io.images import iter_frames
from rasnik.io.track_table import read_rows
from rasnik.recording import disk, record_file
from rasnik.recording.options import RawFrames, Recording
from rasnik.recording.record_file import record_files
from rasnik.recording.recorder import Recorder
from rasnik.recording.sample import Sample

RATE_HZ = 275.0
CHANNEL = "study"
SHAPE = (540, 720)
EVENT_EVERY = 150  # frames
RUN = 1_000_000  # numbers of run k begin at k * RUN


def sample_of(number: int) -> Sample:
    """A sample whose values follow from its number."""
    image = np.full(SHAPE, number % 251, dtype=np.uint8)
    frame = CameraFrame(
        image, number % 65536, time.time(), time.perf_counter(), number / RATE_HZ, 100.0, 0.0
    )
    pose = Pose(
        ok=True,
        x_um=np.sin(number),
        y_um=np.cos(number),
        scale=1 + 1e-6 * np.sin(number / 7),
        theta_rad=1e-3 * np.sin(number / 11),
        covariance=np.diag([1e-6, 1e-6, 1e-12, 1e-12]),
        chi2_ndf=1.0,
    )
    return Sample(frame, number, pose)


def check(rows: np.ndarray) -> None:
    """Rows have the values of their numbers."""
    number = rows["frame"]
    for name, values in (
        ("x_um", np.sin(number)),
        ("y_um", np.cos(number)),
        ("scale", 1 + 1e-6 * np.sin(number / 7)),
        ("theta_rad", 1e-3 * np.sin(number / 11)),
        ("device_time_s", number / RATE_HZ),
        ("camera_number", number % 65536),
    ):
        assert np.allclose(rows[name], values, rtol=0, atol=1e-12), f"{name} differs"


def recorder_of(folder: Path, keep_free_mib: float, **options: float) -> Recorder:
    raw = RawFrames(before_s=0.02, after_s=0.02, most_per_hour=100_000)
    recording = Recording(keep_free_mib=keep_free_mib, raw=raw, **options)
    return Recorder(folder, CHANNEL, load_system("solidras"), recording, {"study": "record_kill"})


# ------------------------------------------------------------------------- kills


def record_until_killed(folder: Path, first: int) -> None:
    """The program to be killed; tells on standard output what it has handed over, and when."""
    recorder = recorder_of(folder, 1.0, rotate_hours=2.0 / 3600)
    recorder.start()
    due_s = time.monotonic()
    number = first
    while True:
        recorder.add(sample_of(number))
        if number % EVENT_EVERY == EVENT_EVERY // 2:
            recorder.event("asked for")
        number += 1
        kept = recorder.status().kept_frames
        os.write(1, f"{number} {time.monotonic()} {kept}\n".encode())
        due_s += 1 / RATE_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))


@dataclass(frozen=True)
class Kill:
    """One kill: rows handed over and found, age of the oldest lost one, files and raw frames."""

    handed: int
    found: int
    lost_age_s: float
    files: int
    kept_frames: int


def kill_once(folder: Path, run: int, after_s: float) -> Kill:
    """Start the program, kill it some seconds after it began, and look at its files.

    Raises
    ------
    AssertionError
        If they do not hold what they must.
    """
    before = set(record_files(folder / CHANNEL))
    command = [sys.executable, __file__, "--record", str(folder), str(run * RUN)]
    lines, kill_s = killed(command, after_s)
    next_number, at_s = lines[:, 0].astype(int), lines[:, 1]

    files = [path for path in record_files(folder / CHANNEL) if path not in before]
    parts = [read_rows(path)[0] for path in files]
    rows = np.concatenate(parts) if parts else np.empty(0, dtype=[("frame", "i8")])
    assert np.array_equal(rows["frame"], run * RUN + np.arange(len(rows))), "rows are missing"
    if len(rows):
        check(rows)
    lost = next_number > run * RUN + len(rows)
    age_s = float(kill_s - at_s[lost][0]) if lost.any() else 0.0
    assert age_s <= 1.0, f"rows handed over {age_s:.2f} s before the kill are lost"
    return Kill(len(lines), len(rows), age_s, len(files), int(lines[-1, 2]))


def check_frames(folder: Path, told: int) -> int:
    """Complete what killed programs left of frames; number of those that are readable."""
    with recorder_of(folder, 1.0):
        pass  # the thread that writes frames begins with it, and closing waits for it
    place = folder / CHANNEL / "frames"
    assert not list(place.glob("*.part")), "files of frames were not completed"
    count = 0
    for frame in iter_frames(sorted(place.glob("*.h5"))):
        assert frame.image is not None, frame.error
        assert frame.image.shape == SHAPE
        assert (frame.image == frame.image[0, 0]).all()
        count += 1
    assert count >= told, f"{told} frames were stored, {count} are readable"
    return count


def study_kills(kills: int, seed: int, longest_s: float) -> None:
    rng = np.random.default_rng(seed)
    print(f"kills: {RATE_HZ:g} rows/s, files rotated every 2 s")
    print(f"{'handed over':>14}{'found':>10}{'oldest lost':>14}{'files':>8}{'raw frames':>12}")
    results = []
    with tempfile.TemporaryDirectory() as name:
        folder, begin_s = Path(name), time.time()
        for run in range(kills):
            kill = kill_once(folder, run, rng.uniform(0.1, longest_s))
            results.append(kill)
            print(
                f"{kill.handed:14}{kill.found:10}{kill.lost_age_s:12.2f} s{kill.files:8}"
                f"{kill.kept_frames:12}"
            )
        frames = check_frames(folder, sum(kill.kept_frames for kill in results))
        found = sum(kill.found for kill in results)
        with recorder_of(folder, 1.0) as recorder:
            history = recorder.history(begin_s - 1, time.time() + 1, 20)
        assert history["count"].sum() == found, "the history does not hold every row"
    oldest_s = max(kill.lost_age_s for kill in results)
    print(
        f"{kills} kills: every file opens; {found} rows found, the oldest lost one {oldest_s:.2f} s"
        f" old; {frames} raw frames readable; the history counts every row"
    )


# ------------------------------------------------------------------------- full disk


@contextmanager
def small_disk(size_mib: int) -> Iterator[Path]:
    """A disk of its own; the folder is empty."""
    folder = Path(tempfile.mkdtemp())
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size_mib}m", "tmpfs", str(folder)]
    try:
        subprocess.run(mount, check=True)
        try:
            yield folder
        finally:
            subprocess.run(["umount", str(folder)], check=True)
    finally:
        folder.rmdir()


def fill(path: Path, leave_bytes: int) -> None:
    """Take all space of a disk but a little."""
    with path.open("wb", buffering=0) as file:
        left = shutil.disk_usage(path.parent).free - leave_bytes
        try:
            while left > 0:
                left -= file.write(b"x" * min(left, 1 << 16))
        except OSError:
            pass  # full


def study_full_disk(
    keep_free_mib: float, leave_bytes: int, rate_hz: float, surprise: bool = False
) -> None:
    """Record on a disk that is filled for four seconds.

    With `surprise` the recorder believes that there is space, as if it had gone between the look
    at it and the writing.
    """
    record_file.free_mib = (lambda folder: 1000.0) if surprise else disk.free_mib
    began_s = time.monotonic()
    number, messages = 0, []
    longest_s = 0.0

    def record_for(seconds: float) -> None:
        nonlocal number, longest_s
        end_s = due_s = time.monotonic()
        end_s += seconds
        while time.monotonic() < end_s:
            sample = sample_of(number)
            begin_s = time.perf_counter()
            recorder.add(sample)
            longest_s = max(longest_s, time.perf_counter() - begin_s)
            number += 1
            message = recorder.status().message
            if message and not (messages and messages[-1].split(":")[0] == message.split(":")[0]):
                messages.append(message)
            due_s += 1 / rate_hz
            time.sleep(max(0.0, due_s - time.monotonic()))

    with small_disk(8) as place:
        with recorder_of(place, keep_free_mib) as recorder:
            recorder.start()
            record_for(1.5)
            before = recorder.status().rows
            filler = place / "of somebody else"
            fill(filler, leave_bytes)
            record_for(4.0)
            full = recorder.status()
            filler.unlink()
            record_for(3.0)
            after = recorder.status()
        end = recorder.status()
        files = record_files(place / CHANNEL)
        parts = [read_rows(path)[0] for path in files]
        rows = np.concatenate(parts)
        check(rows)
        found = np.unique(rows["frame"])
        assert before > 0
        assert messages, "the full disk was not said"
        assert full.message, "the full disk was not said at its end"
        assert not after.message, after.message
        assert end.not_recorded == 0
        assert np.array_equal(found, np.arange(number)), "rows are missing"
    print(
        f"full disk ({keep_free_mib:g} MiB kept free, {leave_bytes} bytes left"
        f"{', gone unseen' if surprise else ''}, {rate_hz:g} rows/s): "
        f"{number} rows handed over, {len(found)} found in {len(files)} files"
        f" ({len(rows) - len(found)} twice), longest call of add {longest_s * 1e3:.1f} ms, "
        f"{time.monotonic() - began_s:.0f} s"
    )
    for message in messages:
        print(f"  said: {message}")


def main() -> None:
    if sys.argv[1:2] == ["--record"]:
        record_until_killed(Path(sys.argv[2]), int(sys.argv[3]))
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=10, help="kills")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--longest-s", type=float, default=4.0, help="before a kill")
    options = parser.parse_args()
    import _study

    print(f"{_study.environment()}, seed {options.seed}")
    if options.n:
        study_kills(options.n, options.seed, options.longest_s)
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        print("full disk: left out, as mounting a small disk needs root")
        return
    study_full_disk(1.5, 0, RATE_HZ)
    study_full_disk(0.0, 500_000, RATE_HZ)
    for leave_bytes in (0, 30_000, 700_000):
        study_full_disk(0.0, leave_bytes, 3000.0, surprise=True)


if __name__ == "__main__":
    main()
