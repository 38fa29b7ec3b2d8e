"""How long it takes to begin: imports, first calls, `rasnik track`; compiled before or not.

Every figure is of a new Python process. What is compiled, and Python's own byte code, goes to
folders that are empty at first ("nothing compiled", "no byte code either": the first start on a
fresh install by an installer that leaves byte code to be made) and are used again ("compiled
before"). The files of the package itself have been read before and come from memory.

    python benchmarks/startup.py
    python benchmarks/startup.py --functions 10 --json startup.json
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import _study
from rasnik import load_system
from rasnik.imaging.projection import Projection
from rasnik.io import read_track

COMMAND = str(Path(sysconfig.get_path("scripts")) / "rasnik")
IMPORTS = "from rasnik import Tracker, analyse, load_system"
LONGEST_S = 300.0
_POLL_S = 0.02

# Runs in a process of its own and prints seconds of its steps as JSON.
CHILD = """
import json, sys, time
steps, clock = {}, time.perf_counter

def step(name, call):
    start = clock()
    result = call()
    steps[name] = clock() - start
    return result

def libraries():
    import numpy, numba, pydantic, scipy.fft, scipy.linalg, scipy.ndimage, scipy.special

def package():
    global Tracker, analyse, load_system
    from rasnik import Tracker, analyse, load_system

step("import numpy, scipy, numba, pydantic", libraries)
step("import rasnik, Tracker and analyse, beyond these", package)

from numba.core import event
import numpy as np
frames = np.load(sys.argv[1])
system = load_system("solidras")
compiled, running = {}, []  # running: beginning, and time spent on the functions it calls

class Listener(event.Listener):
    def on_start(self, event):
        running.append([clock(), 0.0])

    def on_end(self, event):
        function = event.data["dispatcher"].py_func
        name = f"{function.__module__}.{function.__name__}"
        begun, inner = running.pop()
        taken = clock() - begun
        compiled[name] = compiled.get(name, 0.0) + taken - inner
        if running:
            running[-1][1] += taken

event.register("numba:compile", Listener())
pose = step("first image", lambda: analyse(frames[0], system))
step("next image, from nothing", lambda: analyse(frames[1], system))
step("next image, with prior", lambda: analyse(frames[2], system, prior=pose))
tracker = Tracker(system)
step("tracker: first frame", lambda: tracker.update(frames[0]))
step("tracker: second frame", lambda: tracker.update(frames[1]))
slowest = 0.0
for frame in frames[2:]:
    start = clock()
    pose = tracker.update(frame)
    slowest = max(slowest, clock() - start)
steps["tracker: slowest of the next frames"] = slowest
step("tracker: first batch", lambda: tracker.run(frames))
assert pose.ok, pose.error
print(json.dumps({"steps": steps, "compiled": compiled}))
"""


def environ(**folders: Path) -> dict[str, str]:
    return {**os.environ, **{name: str(folder) for name, folder in folders.items()}}


def wall_s(arguments: list[str], repeats: int, **folders: Path) -> float:
    """Shortest time of a process from start to end."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        subprocess.run(arguments, env=environ(**folders), check=True, capture_output=True)
        times.append(time.perf_counter() - start)
    return min(times)


def imports_by_package(statement: str) -> dict[str, float]:
    """Seconds spent in the modules of each package, the largest first, as Python tells."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", statement],
        check=True,
        capture_output=True,
        text=True,
    )
    seconds: dict[str, float] = {}
    for line in done.stderr.splitlines():
        microseconds, _, name = line.removeprefix("import time:").split("|")
        if microseconds.strip().isdigit():
            package = name.strip().partition(".")[0]
            group = "standard library" if package in sys.stdlib_module_names else package
            seconds[group] = seconds.get(group, 0.0) + int(microseconds) * 1e-6
    return dict(sorted(seconds.items(), key=lambda item: -item[1]))


def first_calls(frames: Path, **folders: Path) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(frames)],
        env=environ(**folders),
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def track_command(frames: Path, output: Path, **folders: Path) -> tuple[float, float, float]:
    """Seconds from the start of the command to the first row that a reader sees, and to its end.

    The third figure is the processor time of the whole run, which other work on the machine
    does not lengthen as it does the others.
    """
    output.unlink(missing_ok=True)
    first_row = float("nan")
    used = processor_s()
    start = time.perf_counter()
    with subprocess.Popen(
        [COMMAND, "track", str(frames), "--system", "solidras", "-o", str(output)],
        env=environ(**folders),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            while process.poll() is None and rows_in(output) == 0:
                if time.perf_counter() - start > LONGEST_S:
                    process.kill()
                time.sleep(_POLL_S)
            first_row = time.perf_counter() - start
            said, _ = process.communicate(timeout=LONGEST_S)
        except BaseException:
            process.kill()
            raise
    end = time.perf_counter() - start
    if process.returncode or rows_in(output) == 0:
        raise SystemExit(f"rasnik track ended with {process.returncode} and said:\n{said}")
    return first_row, end, processor_s() - used


def processor_s() -> float:
    """Processor time of all child processes that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def rows_in(path: Path) -> int:
    """Rows that another program finds in the file; 0 while there is no file to read."""
    try:
        return len(read_track(path)) if path.exists() else 0
    except (OSError, ValueError):
        return 0


def make_frames(path: Path, count: int, seed: int) -> None:
    """SolidRas frames of a mask that moves by 10 nm a frame, up and down."""
    projections = [
        Projection.from_pose(41000.0 + 0.01 * abs(k - 8), 30200.0, 1.0, 0.002, 4) for k in range(16)
    ]
    pool = _study.frame_pool(load_system("solidras"), projections, n=count, seed=seed)
    np.save(path, pool)


# ------------------------------------------------------------------------- tables


def show_processes(repeats: int) -> dict[str, float]:
    cases = {
        "python -c pass": [sys.executable, "-c", "pass"],
        'python -c "import rasnik"': [sys.executable, "-c", "import rasnik"],
        'python -c "import numpy, scipy.fft, scipy.ndimage"': [
            sys.executable,
            "-c",
            "import numpy, scipy.fft, scipy.ndimage",
        ],
        f'python -c "{IMPORTS}"': [sys.executable, "-c", IMPORTS],
        "rasnik --version": [COMMAND, "--version"],
    }
    print(f"\nWhole processes, best of {repeats}, s")
    found = {}
    for name, arguments in cases.items():
        found[name] = wall_s(arguments, repeats)
        print(f"  {name:62}{found[name]:>8.3f}", flush=True)
    return found


def show_packages(most: int = 8) -> dict[str, float]:
    found = imports_by_package(IMPORTS)
    print(f'\nOf "{IMPORTS}", s, as python -X importtime tells, which slows it down')
    for name, seconds in list(found.items())[:most]:
        print(f"  {name:62}{seconds:>8.3f}")
    return found


def show_first_calls(frames: Path, cache: Path, functions: int, repeats: int) -> dict[str, Any]:
    empty = first_calls(frames, NUMBA_CACHE_DIR=cache)
    again = [first_calls(frames, NUMBA_CACHE_DIR=cache) for _ in range(repeats)]
    warm = {name: min(run["steps"][name] for run in again) for name in empty["steps"]}
    print(f"\n{'First calls, s':64}{'nothing compiled':>18}{'compiled before':>17}")
    for name, seconds in empty["steps"].items():
        print(f"  {name:62}{seconds:>18.3f}{warm[name]:>17.3f}")
    total, total_warm = (sum(run["compiled"].values()) for run in (empty, again[0]))
    print(f"  {'of all this, compiling':62}{total:>18.3f}{total_warm:>17.3f}")
    slowest = sorted(empty["compiled"].items(), key=lambda item: -item[1])[:functions]
    for name, seconds in slowest:
        print(f"    {name:60}{seconds:>18.3f}")
    return {"nothing compiled": empty, "compiled before": warm}


def show_command(frames: Path, folder: Path, repeats: int) -> dict[str, tuple[float, float, float]]:
    cache = folder / "command-cache"
    fresh, fresh_code = folder / "fresh-cache", folder / "fresh-code"
    output = folder / "track.h5"
    found = {
        "nothing compiled": track_command(frames, output, NUMBA_CACHE_DIR=cache),
        "compiled before": min(
            track_command(frames, output, NUMBA_CACHE_DIR=cache) for _ in range(repeats)
        ),
        "nothing compiled, no byte code either": track_command(
            frames, output, NUMBA_CACHE_DIR=fresh, PYTHONPYCACHEPREFIX=fresh_code
        ),
    }
    print(
        f"\n{'rasnik track: s from its start':46}{'to the first row':>18}{'to its end':>14}"
        f"{'processor time':>17}"
    )
    for name, (first_row, end, processor) in found.items():
        print(f"  {name:44}{first_row:>18.2f}{end:>14.2f}{processor:>17.2f}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-n", type=int, default=2, help="repetitions, except of empty caches")
    parser.add_argument("--frames", type=int, default=256, help="for rasnik track")
    parser.add_argument("--functions", type=int, default=5, help="the slowest to compile, shown")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", metavar="FILE", help="write the results")
    options = parser.parse_args()
    print(_study.environment())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames = folder / "frames.npy"
        make_frames(frames, options.frames, options.seed)
        results = {
            "processes": show_processes(options.n),
            "packages": show_packages(),
            "first_calls": show_first_calls(frames, folder / "cache", options.functions, options.n),
            "command": show_command(frames, folder, options.n),
        }
    _study.save_json(options.json, options=vars(options), **results)


if __name__ == "__main__":
    main()
