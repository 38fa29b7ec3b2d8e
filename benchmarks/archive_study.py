"""An archive analysed while its processes are killed: is each image there once, and how fast.

    python benchmarks/archive_study.py --images 10000 --instruments 10

Makes images of known positions as folders of PNG and TIFF, stacks in TIFF, HDF5 and Zarr, some
damaged, blank or jumping. Then `rasnik archive analyse` is run by two workers; one of them, and
later the whole run, is killed (SIGKILL), and the same command given again. The dataset must hold
every image once, with its position within the stated error. The same again with a scheduler and
workers of their own, on this machine. The speed is that of the same function in a plain loop.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import _study

_study.one_thread()

import numpy as np  # noqa: E402
import psutil  # noqa: E402

import rasnik  # noqa: E402

SHAPE = (152, 200)
KINDS = ("png", "tif", "tiff stack", "hdf5", "zarr")
BEGIN_S = 1.77e9
EVERY_S = 150.0  # between images of a folder: 2000 of them make four days
STACK = 500  # frames of a TIFF stack
JUMPING, BLANK_EVERY, DAMAGED_EVERY = 17, 131, 97
LONGEST_S = 900.0


def small_system() -> rasnik.System:
    """A sensor so small that 100,000 images fit on the disk."""
    height, width = SHAPE
    changes = {
        "sensor.width_px": width,
        "sensor.height_px": height,
        "mask.field_um": 60.0,
        "optics.blur_um": 8.0,
        "optics.orientation": 4,
    }
    return rasnik.load_system("atlas-ccd", changes)


# ------------------------------------------------------------------------ images


@dataclass(frozen=True)
class Truth:
    """What the dataset must hold of one instrument."""

    instrument: str
    file: list[str]
    frame: np.ndarray
    pose: np.ndarray
    """x_um, y_um; NaN where there is nothing to be seen."""


def make_instrument(job: tuple[Path, int, int, int]) -> Truth:
    """Images of one instrument, and what they show."""
    folder, number, n, seed = job
    name = f"{number:04d}"  # a number: readers must not take it for one
    rng = np.random.default_rng([seed, number])
    path = folder / name
    path.mkdir(parents=True)
    poses = poses_of(rng, n, jumping=number % JUMPING == JUMPING - 1)
    frames = render(poses, rng)
    blank = np.arange(n) % BLANK_EVERY == BLANK_EVERY - 1
    frames[blank] = 30
    poses[blank] = np.nan
    file, frame = write(path, KINDS[number % len(KINDS)], frames, poses)
    return Truth(name, file, frame, poses)


def poses_of(rng: np.random.Generator, n: int, jumping: bool) -> np.ndarray:
    """x_um, y_um, theta_rad, shape (n, 3): a mask that drifts and shakes, or one that jumps."""
    start = rng.uniform(3000, 9000, 2)
    if jumping:
        xy = rng.uniform(3000, 9000, (n, 2))
    else:
        xy = start + np.cumsum(rng.normal(0, 0.05, (n, 2)), axis=0) + rng.normal(0, 0.1, (n, 2))
    return np.column_stack([xy, rng.uniform(-0.005, 0.005) + rng.normal(0, 1e-5, n)])


def render(poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    from rasnik.imaging.appearance import Appearance, Camera
    from rasnik.imaging.model import expected_image
    from rasnik.imaging.noise import ReadOut
    from rasnik.imaging.projection import Projection

    system = small_system()
    sensor = system.sensor
    look = Appearance.uniform(sensor.dark_level, sensor.light_level, system.optics.blur_um)
    camera = Camera(system.shape, system.pitch_um)
    frames = np.empty((len(poses), *SHAPE), dtype=np.uint8)
    for k, (x, y, theta) in enumerate(poses.tolist()):
        seen = Projection.from_pose(x, y, system.optics.scale, theta, 4)
        frames[k] = ReadOut(expected_image(system.mask, seen, look, camera), system).frame(rng)
    return frames


def write(
    path: Path, kind: str, frames: np.ndarray, poses: np.ndarray
) -> tuple[list[str], np.ndarray]:
    """Store frames; returns file and frame of each."""
    import tifffile

    n = len(frames)
    if kind in ("png", "tif"):
        files = [path / f"image{k}.{kind}" for k in range(n)]
        for k, file in enumerate(files):
            write_image(file, frames[k], damaged=k % DAMAGED_EVERY == DAMAGED_EVERY - 1)
            os.utime(file, (BEGIN_S + k * EVERY_S,) * 2)
        poses[DAMAGED_EVERY - 1 :: DAMAGED_EVERY] = np.nan
        return list(map(str, files)), np.zeros(n, dtype=int)
    index = np.arange(n)
    if kind == "tiff stack":
        for first in range(0, n, STACK):
            tifffile.imwrite(path / f"stack{first // STACK}.tif", frames[first : first + STACK])
        return [str(path / f"stack{k // STACK}.tif") for k in index], index % STACK
    if kind == "hdf5":
        import h5py

        with h5py.File(path / "frames.h5", "w") as file:
            file.create_dataset("frames", data=frames, chunks=(16, *SHAPE))
        return [str(path / "frames.h5")] * n, index
    import zarr

    store = zarr.open_group(str(path / "frames.zarr"), mode="w")
    store.create_array("frames", data=frames, chunks=(64, *SHAPE))
    return [str(path / "frames.zarr")] * n, index


def write_image(file: Path, frame: np.ndarray, damaged: bool) -> None:
    from PIL import Image

    if file.suffix == ".png":
        Image.fromarray(frame).save(file, compress_level=1)
    else:
        Image.fromarray(frame).save(file)
    if damaged:
        file.write_bytes(file.read_bytes()[:3000])


def make_archive(folder: Path, options: argparse.Namespace) -> list[Truth]:
    each = options.images // options.instruments
    jobs = [(folder, k, each, options.seed) for k in range(options.instruments)]
    truths = []
    with ProcessPoolExecutor(options.workers) as pool:
        for truth in pool.map(make_instrument, jobs):
            truths.append(truth)
            tell(f"  images: {len(truths)} of {len(jobs)} instruments", end="\r")
    (folder / "not-in-the-table").mkdir()
    write_image(folder / "not-in-the-table" / "a.png", np.zeros(SHAPE, np.uint8), damaged=False)
    return truths


def write_table(folder: Path, truths: list[Truth]) -> Path:
    (folder / "small.toml").write_text(small_system().to_toml())
    rows = [f"{truth.instrument},small.toml" for truth in truths]
    (folder / "systems.csv").write_text("\n".join(["instrument,system", *rows]) + "\n")
    return folder / "systems.csv"


# ------------------------------------------------------------------------ processes


@dataclass
class Memory:
    """Resident memory of a run over time, by what the processes are."""

    rows: list[tuple[float, float, float]] = field(default_factory=list)
    """Time (s), client and scheduler (MB), the largest worker (MB)."""


def workers_of(process: psutil.Process) -> list[psutil.Process]:
    """The processes below one that work: those of Dask are spawned."""
    found = []
    for child in process.children(recursive=True):
        try:
            if "spawn_main" in " ".join(child.cmdline()):
                found.append(child)
        except psutil.Error:
            pass
    return found


@contextmanager
def watched(roots: list[psutil.Process], memory: Memory) -> Iterator[None]:
    """Note the memory of some processes and of the workers below them."""
    stop, start_s = threading.Event(), time.monotonic()

    def watch() -> None:
        while not stop.wait(0.5):
            try:
                heads = max(root.memory_info().rss for root in roots)
                below = [w.memory_info().rss for root in roots for w in workers_of(root)]
            except psutil.Error:
                continue
            largest = max(below, default=0) / 1e6
            memory.rows.append((time.monotonic() - start_s, heads / 1e6, largest))

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def rows_done(dataset: Path) -> int:
    """Rows that are in a dataset that is being written."""
    import json

    journal = dataset / "_journal.jsonl"
    if not journal.exists():
        return 0
    done = 0
    for line in journal.read_bytes().splitlines():
        try:
            values = json.loads(line)
        except ValueError:
            continue
        done += values.get("good", 0) + values.get("failed", 0)
    return done


def wait_for_rows(dataset: Path, rows: float, process: subprocess.Popen[bytes]) -> bool:
    """Wait until a dataset has so many rows; False if the process ended before it."""
    end_s = time.monotonic() + LONGEST_S
    while rows_done(dataset) < rows:
        if process.poll() is not None:
            return False
        assert time.monotonic() < end_s, "it takes too long"
        time.sleep(0.5)
    return True


def archive_command(source: Path, dataset: Path, table: Path, more: list[str]) -> list[str]:
    return [
        *(sys.executable, "-c", "from rasnik.cli import app; app()"),
        *("archive", "analyse", str(source)),
        *("-o", str(dataset), "--systems", str(table), "--json", *more),
    ]


def start(command: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def finish(process: subprocess.Popen[bytes], total: int, dataset: Path) -> None:
    """Wait for the end of a run, and say how far it is."""
    output: list[bytes] = []
    assert process.stdout is not None
    reader = threading.Thread(target=lambda: output.append(process.stdout.read()))
    reader.start()
    while process.poll() is None:
        tell(f"  {rows_done(dataset)} of {total} images", end="\r")
        time.sleep(2.0)
    reader.join()
    text = b"".join(output).decode()
    assert process.returncode == 1, f"status {process.returncode}: {text}"  # some have no position
    assert "not-in-the-table, 1 files left out" in text, text


def kill_worker(root: psutil.Process) -> None:
    victims = workers_of(root)
    assert victims, "the run ended before a worker could be killed; take more images"
    victims[0].kill()


# ------------------------------------------------------------------------ what must hold


def check(dataset: Path, truths: list[Truth]) -> dict[str, float]:
    """Every image once, and where it must be; returns what was found."""
    from rasnik.archive.dataset import open_dataset

    names = ["instrument", "file", "frame", "ok", "x_um", "y_um", "sigma_x_um", "sigma_y_um"]
    table = open_dataset(dataset).to_table(columns=names).to_pydict()
    keys = list(zip(table["instrument"], table["file"], table["frame"], strict=True))
    expected = {
        (truth.instrument, file, int(frame)): pose
        for truth in truths
        for file, frame, pose in zip(truth.file, truth.frame, truth.pose, strict=True)
    }
    assert len(keys) == len(set(keys)), "some images are there twice"
    assert set(keys) == set(expected), "images are missing, or are there that should not be"
    truth = np.array([expected[key] for key in keys])
    found = np.array([table["x_um"], table["y_um"]], dtype=float).T
    sigma = np.array([table["sigma_x_um"], table["sigma_y_um"]], dtype=float).T
    ok = np.array(table["ok"])
    visible = np.isfinite(truth[:, 0])
    assert not (ok & ~visible).any(), "a position where there is none"
    pulls = ((found - truth[:, :2]) / sigma)[ok]
    return {
        "images": len(keys),
        "good": int(ok.sum()),
        "missed": int((visible & ~ok).sum()),
        "pull_rms": float(np.sqrt(np.mean(pulls**2))),
        "pull_most": float(np.abs(pulls).max()),
    }


def judge(found: dict[str, float], memory: Memory) -> None:
    print(
        f"  {found['images']} images, each once; {found['good']} with a position, "
        f"{found['missed']} of those that show a mask without; deviation over sigma: rms "
        f"{found['pull_rms']:.3f}, most {found['pull_most']:.2f}"
    )
    assert 0.95 < found["pull_rms"] < 1.05, "the errors are not as stated"
    assert found["pull_most"] < 6.5, "a position is wrong"
    print("  resident memory, MB, over the last run:")
    print(f"  {'time (s)':>10}{'client, scheduler':>20}{'largest worker':>16}")
    for row in memory.rows[:: max(1, len(memory.rows) // 10)]:
        print(f"  {row[0]:10.1f}{row[1]:20.0f}{row[2]:16.0f}")


# ------------------------------------------------------------------------ the runs


def killed_run(
    archive: Path, table: Path, truths: list[Truth], options: argparse.Namespace
) -> float:
    """A worker killed, the run killed at several places, and gone on with; seconds it took."""
    total, dataset = total_of(truths), archive.parent / "killed"
    command = archive_command(archive, dataset, table, ["--workers", str(options.workers)])
    begin_s, memory = time.monotonic(), Memory()
    for kill in range(options.kills):
        process = start(command)
        root, share = psutil.Process(process.pid), (kill + 0.5) / (options.kills + 1)
        assert wait_for_rows(dataset, max(share * total, rows_done(dataset) + 1), process)
        kill_worker(root)
        time.sleep(1.0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert process.stdout is not None
        process.stdout.close()
        tell(f"  a worker and the run killed after {rows_done(dataset)} of {total} images")
    process = start(command)
    with watched([psutil.Process(process.pid)], memory):
        if wait_for_rows(dataset, rows_done(dataset) + 1, process):
            kill_worker(psutil.Process(process.pid))
        finish(process, total, dataset)
    tell(f"  gone on with {time.monotonic() - begin_s:.0f} s after the beginning")
    judge(check(dataset, truths), memory)
    return time.monotonic() - begin_s


def scheduled_run(
    archive: Path, table: Path, truths: list[Truth], options: argparse.Namespace
) -> None:
    """The same with a scheduler and workers that were there before, one of them killed."""
    total, dataset = total_of(truths), archive.parent / "scheduled"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = subprocess.Popen(
        [*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"], **quiet
    )
    workers = subprocess.Popen(
        [*dask, "worker", address, "--nthreads", "1", "--nworkers", str(options.workers),
         "--no-dashboard", "--local-directory", str(archive.parent)],
        **quiet,
    )  # fmt: skip
    try:
        time.sleep(3.0)
        memory = Memory()
        process = start(archive_command(archive, dataset, table, ["--scheduler", address]))
        roots = [psutil.Process(p.pid) for p in (process, scheduler, workers)]
        with watched(roots, memory):
            if wait_for_rows(dataset, 0.3 * total, process):
                kill_worker(psutil.Process(workers.pid))
            finish(process, total, dataset)
        judge(check(dataset, truths), memory)
    finally:
        for daemon in (workers, scheduler):
            daemon.terminate()
            daemon.wait()


@dataclass(frozen=True)
class Speed:
    """Images per second and process."""

    alone: float
    """A plain loop with the machine to itself."""
    together: float
    """As many plain loops at once as there are workers, each while it works."""
    worker: float
    """A worker, from the first chunk to the end of the last."""
    worker_busy: float
    """A worker while it works."""

    def __str__(self) -> str:
        return (
            f"  plain loop {self.alone:.1f} images/s; several at once {self.together:.1f} each\n"
            f"  a worker {self.worker:.1f} in the whole run, {self.worker_busy:.1f} while it "
            f"works: {100 * self.worker / self.together:.1f} % and "
            f"{100 * self.worker_busy / self.together:.1f} % of several loops at once"
        )


def throughput(archive: Path, truths: list[Truth], options: argparse.Namespace) -> Speed:
    """How fast it is, on some of the instruments."""
    chosen = [truth.instrument for truth in truths[: options.timed]]
    sources = [str(archive / name) for name in chosen]
    n = sum(len(truth.file) for truth in truths[: options.timed])
    plain_loop(sources[:1])  # compiled code is loaded
    found, alone_s = plain_loop(sources)
    with ProcessPoolExecutor(options.workers) as pool:
        shares = [sources[k :: options.workers] for k in range(options.workers)]
        list(pool.map(plain_loop, [sources[:1]] * options.workers))
        together = list(pool.map(plain_loop, shares))
    assert found == n == sum(images for images, _ in together)
    return Speed(
        n / alone_s,
        n / sum(seconds for _, seconds in together),
        *archived(sources, archive.parent / "timed", n, options.workers),
    )


def plain_loop(sources: list[str]) -> tuple[int, float]:
    """The function that the workers call, called in a loop; images, and seconds that it took."""
    from rasnik.archive.done import DoneFrames
    from rasnik.archive.plan import Planner
    from rasnik.archive.sources import find_items
    from rasnik.archive.systems_table import InstrumentSettings
    from rasnik.archive.work import Work, analyse_chunk

    settings = InstrumentSettings(small_system())
    planner = Planner(lambda name: settings, DoneFrames())
    works = (Work(chunk, settings) for chunk in planner.chunks(find_items(sources)))
    start_s = time.perf_counter()
    n = sum(sum(analyse_chunk(work).found) for work in works)
    return n, time.perf_counter() - start_s


def archived(sources: list[str], dataset: Path, n: int, workers: int) -> tuple[float, float]:
    """Images per second of each worker: of the whole run, in which one has the last chunk while
    the others wait; and while it works.
    """
    from rasnik.archive.cluster import dask_pool
    from rasnik.archive.dataset import Dataset
    from rasnik.archive.run import ArchiveRun, absolute_sources
    from rasnik.archive.systems_table import SystemsTable

    table = SystemsTable.for_all(small_system())
    with dask_pool(workers, None, small_system()) as pool:
        with Dataset(dataset.with_name("warm")) as warm:  # compiled code is loaded
            ArchiveRun(absolute_sources(sources[:workers]), table, warm).run(pool)
        with Dataset(dataset) as written:
            run = ArchiveRun(absolute_sources(sources), table, written)
            run.run(pool)
    assert sum(total.images for total in run.totals.values()) == n
    worked_s = sum(total.seconds for total in run.totals.values())
    return n / run.elapsed_s / workers, n / worked_s


def total_of(truths: list[Truth]) -> int:
    return sum(len(truth.file) for truth in truths)


def tell(text: str, end: str = "\n") -> None:
    if end == "\n" or sys.stdout.isatty():
        print(text, end=end, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=10_000)
    parser.add_argument("--instruments", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kills", type=int, default=2, help="times the whole run is killed")
    parser.add_argument("--timed", type=int, help="instruments that the speed is measured with")
    parser.add_argument("--folder", type=Path, help="on a disk with room; 40 kB for each image")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if options.timed is None:
        options.timed = max(options.workers * 5, 2 * options.instruments // 5)
    options.timed = min(options.timed, options.instruments)
    print(f"{_study.environment()}, seed {options.seed}")
    folder = Path(tempfile.mkdtemp(dir=options.folder, prefix="archive-study-"))
    try:
        study(folder, options)
    finally:
        shutil.rmtree(folder)


def study(folder: Path, options: argparse.Namespace) -> None:
    begin_s = time.monotonic()
    archive = folder / "archive"
    truths = make_archive(archive, options)
    table = write_table(folder, truths)
    size = sum(file.stat().st_size for file in archive.rglob("*") if file.is_file())
    tell(
        f"{total_of(truths)} images of {len(truths)} instruments, {size / 1e9:.2f} GB, made in "
        f"{time.monotonic() - begin_s:.0f} s"
    )
    tell("a plain loop, and the workers, on the same images:")
    print(throughput(archive, truths, options))
    tell("workers and runs killed:")
    killed_run(archive, table, truths, options)
    tell("a scheduler and workers of their own, one killed:")
    scheduled_run(archive, table, truths, options)
    tell(f"done in {time.monotonic() - begin_s:.0f} s")


if __name__ == "__main__":
    main()
