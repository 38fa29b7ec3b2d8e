"""What a track file holds after its writer was killed, many times in a row.

    python benchmarks/track_kill.py -n 10

A program writes rows at 860 frames/s and is killed (SIGKILL) at a random moment; then it goes on
where the file ends, as `rasnik track` does. After each kill the file must open and hold every row
written more than a second before; at the end it must hold every frame once, with its own values.
A second run writes as fast as it can and waits for the file every time, so that the kill most
often falls into the middle of writing; not a row may be lost.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from _kill import killed
from rasnik import Track, load_system
from rasnik.io import TrackWriter, read_track
from rasnik.tracking.track import TRACK_COLUMNS

RATE_HZ = 860.0
BLOCK_ROWS = 8
SOURCE = {"source": "kill study"}


def rows_of(first: int, stop: int) -> Track:
    """Rows whose every value follows from the number of the frame."""
    frame = np.arange(first, stop)
    values = {
        column.name: np.sin(frame + place)
        for place, column in enumerate(TRACK_COLUMNS)
        if column.dtype == "f8"
    }
    return Track(**{**values, "frame": frame, "flags": frame % 7})


def write_until_killed(path: Path, flush_s: float) -> None:
    """The program to be killed; tells on standard output what it has written, and when."""
    with TrackWriter(
        path, system=load_system("solidras"), metadata=SOURCE, resume=True, flush_s=flush_s
    ) as file:
        os.write(1, f"{file.next_frame} {time.monotonic()}\n".encode())
        due_s = time.monotonic()
        while True:
            file.write(rows_of(file.next_frame, file.next_frame + BLOCK_ROWS))
            os.write(1, f"{file.next_frame} {time.monotonic()}\n".encode())
            if flush_s > 0:
                due_s += BLOCK_ROWS / RATE_HZ
                time.sleep(max(0.0, due_s - time.monotonic()))


@dataclass(frozen=True)
class Kill:
    """One kill: rows written, rows found in the file, and how old the oldest lost one was."""

    began_at: int
    written: int
    found: int
    lost_age_s: float


def kill_once(path: Path, after_s: float, flush_s: float) -> Kill:
    """Start the writer, kill it some seconds after it began, and look at the file.

    Raises
    ------
    AssertionError
        If the file does not hold what it must.
    """
    command = [sys.executable, __file__, "--write", str(path), str(flush_s)]
    lines, kill_s = killed(command, after_s)
    stop, at_s = lines[:, 0].astype(int), lines[:, 1]

    track = read_track(path)
    lost = stop > len(track)
    age_s = float(kill_s - at_s[lost][0]) if lost.any() else 0.0
    check(track)
    assert age_s <= min(flush_s, 1.0), f"rows written {age_s:.2f} s before the kill are lost"
    return Kill(int(stop[0]), int(stop[-1]), len(track), age_s)


def check(track: Track) -> None:
    """Every frame from 0 once, with its own values."""
    expected = rows_of(0, len(track)).as_dict()
    for name, values in track.as_dict().items():
        assert np.array_equal(values, expected[name]), f"{name} differs"


def study(folder: Path, kills: int, seed: int, flush_s: float, longest_s: float) -> list[Kill]:
    """Kill and go on, then complete the file and check all of it."""
    rng = np.random.default_rng(seed)
    path = folder / f"track-{flush_s}.h5"
    results = []
    for _ in range(kills):
        results.append(kill_once(path, rng.uniform(0, longest_s), flush_s))
        began = results[-1].began_at
        assert began == (results[-2].found if len(results) > 1 else 0), "resumed elsewhere"
    with TrackWriter(path, system=load_system("solidras"), metadata=SOURCE, resume=True) as file:
        assert file.next_frame == results[-1].found
        file.write(rows_of(file.next_frame, file.next_frame + 1000))
    track = read_track(path)
    assert len(track) == results[-1].found + 1000
    check(track)
    return results


def main() -> None:
    if sys.argv[1:2] == ["--write"]:
        write_until_killed(Path(sys.argv[2]), float(sys.argv[3]))
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=10, help="kills of each kind")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    import _study

    print(f"{_study.environment()}, seed {options.seed}")
    for flush_s, kind in (
        (1.0, f"{RATE_HZ:g} rows/s, flush_s = 1"),
        (0.0, "flat out, flush_s = 0"),
    ):
        print(f"{kind}\n{'from':>10}{'written':>10}{'found':>10}{'oldest lost':>14}")
        with tempfile.TemporaryDirectory() as folder:
            for kill in study(Path(folder), options.n, options.seed, flush_s, 3.0):
                print(
                    f"{kill.began_at:10}{kill.written:10}{kill.found:10}{kill.lost_age_s:12.2f} s"
                )
    print("every file opened, continued, and holds every frame once")


if __name__ == "__main__":
    main()
