"""Time per frame of cold start, refinement and tracking, and of what it can be compared with.

    python benchmarks/speed.py
    python benchmarks/speed.py -n 50 --only sizes peers --json speed.json

All tasks of a table take turns within each repetition, so that other work on the machine hits
them alike; the ratios are those of medians. `frame.sum()` is the floor: whatever looks at every
pixel takes longer. It sums the same frames as the tracker follows, one after the other.
The tracked mask runs round a circle of 30 nm radius. Every position found is compared with
the truth; a track with a wrong or missing position has no speed, and the program ends there.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import _study

_study.one_thread()

import numpy as np  # noqa: E402
import scipy.fft  # noqa: E402

import _peers  # noqa: E402
from _study import Task  # noqa: E402
from rasnik import Flag, Pose, System, Track, Tracker, analyse, load_system  # noqa: E402
from rasnik.imaging.projection import Projection  # noqa: E402

RADIUS_UM = 0.03
PHASES = 16
MOST_BYTES = 64e6  # of the frames of one case
THETA_RAD, ORIENTATION = 0.002, 4
WRONG_SIGMAS = 8.0

FLOOR, TRANSFORM = "frame.sum()", "scipy.fft.rfft2, float32"
COLD, REFINED = "cold start to the bound", "refinement, prior 0.03 um away"
STREAM, BATCH = "Tracker.update", "Tracker.run"


class Row(NamedTuple):
    """One line of a table, as it goes to the screen and to JSON."""

    case: str
    task: str
    pixels: int
    ms_median: float
    ms_best: float
    frames_per_s: float
    ns_per_pixel: float
    per_sum: float
    per_rfft2: float
    error_px: float | None = None


class Case:
    """Frames of one kind in memory, and what there is to time on them."""

    def __init__(self, name: str, system: System, frames: int, seed: int, dtype: str = "") -> None:
        self.name, self.system = name, system
        size = system.shape[0] * system.shape[1] * (4 if dtype else 1 + (system.full_scale > 255))
        n = int(max(min(frames, MOST_BYTES / size), PHASES))
        phase = 2 * np.pi * np.arange(PHASES) / PHASES
        x0, x1, y0, y1 = system.mask.bounds_um
        centre = (0.4 * x0 + 0.6 * x1, 0.7 * y0 + 0.3 * y1)
        circle = np.stack([np.cos(phase), np.sin(phase)], axis=1) * RADIUS_UM + centre
        self.truth_um = circle[np.arange(n) % PHASES]
        self.rest = (system.optics.scale, THETA_RAD, ORIENTATION)
        projections = [_projection(x, y, *self.rest) for x, y in circle]
        # One more, a micrometre away, as a worse prior.
        away = _projection(centre[0] + 1.0, centre[1], *self.rest)
        self.frames = _study.frame_pool(system, projections, n=n, seed=seed, dtype=dtype or None)
        self.away = _study.frame_pool(system, [away], seed=seed, dtype=dtype or None)[0]
        self.tracked = self.refitted = 0

    # Everything below returns tasks; frames are read from memory as a camera would leave them.

    def floor(self) -> list[Task]:
        grey = self.frames[:4].astype(np.float32)
        return [
            Task(FLOOR, lambda: [frame.sum() for frame in self.frames], len(self.frames)),
            Task(TRANSFORM, lambda: [scipy.fft.rfft2(frame) for frame in grey], len(grey)),
        ]

    def single(self) -> list[Task]:
        frame, near = self.frames[0], self._pose(self.frames[3])
        return [
            Task(COLD, lambda: self._pose(frame)),
            Task(REFINED, lambda: self._pose(frame, prior=near)),
        ]

    def single_more(self) -> list[Task]:
        frame, far = self.frames[0], self._pose(self.away)
        return [
            Task("Fourier method", lambda: self._pose(frame, method="fourier")),
            Task("refinement, prior 1 um away", lambda: self._pose(frame, prior=far)),
        ]

    def stream(self) -> Task:
        tracker = self._tracker(1)
        return Task(
            STREAM,
            lambda: [tracker.update(frame) for frame in self.frames],
            len(self.frames),
            lambda poses: self.check(Track.from_poses(poses)),
        )

    def batch(self, threads: int = 1) -> Task:
        tracker = self._tracker(threads)
        name = BATCH if threads == 1 else f"{BATCH}, {threads} threads"
        return Task(name, lambda: tracker.run(self.frames), len(self.frames), self.check)

    def check(self, track: Track) -> None:
        """End the program if a position is missing or wrong; count what was not tracked."""
        error = np.stack([track.x_um, track.y_um], axis=1) - self.truth_um
        sigma = np.stack([track.sigma_x_um, track.sigma_y_um], axis=1)
        if not track.ok.all() or (np.abs(error) > WRONG_SIGMAS * sigma).any():
            raise SystemExit(
                f"{self.name}: {np.count_nonzero(~track.ok)} of {len(track)} frames without "
                f"position, largest error {1e3 * np.nanmax(np.abs(error)):.3f} nm"
            )
        self.tracked += len(track)
        self.refitted += track.count(Flag.REFITTED | Flag.COLD_START)

    def _tracker(self, threads: int) -> Tracker:
        """A tracker that has found the mask and stands just before the first frame."""
        tracker = Tracker(self.system, orientation=ORIENTATION, threads=threads)
        tracker.update(self.frames[PHASES - 1])
        return tracker

    def _pose(self, frame: np.ndarray, **options: object) -> Pose:
        pose = analyse(frame, self.system, orientation=ORIENTATION, **options)  # type: ignore[arg-type]
        if not pose.ok:
            raise SystemExit(f"{self.name}: {pose.error}")
        return pose


# ------------------------------------------------------------------------- tables


def sizes(options: argparse.Namespace) -> list[Row]:
    solidras = load_system("solidras")
    cases = [
        Case("720 x 540", solidras, options.frames, options.seed),
        Case(
            "2 x 2 binned: 360 x 270",
            load_system(solidras, {"sensor.binning": 2}),
            options.frames,
            options.seed,
        ),
        Case("2048 x 2048", _sized(2048), options.frames, options.seed),
    ]
    tasks = {c.name: [*c.floor(), *c.single(), c.stream(), c.batch()] for c in cases}
    tasks["720 x 540"] += cases[0].single_more()
    return table("Frames of 8 bits", cases, tasks, options.n)


def types(options: argparse.Namespace) -> list[Row]:
    twelve = {
        "sensor.bit_depth": 12,
        "sensor.dark_level": 25.0 * 16,
        "sensor.light_level": 252.0 * 16,
        "sensor.noise_a": 0.26 * 16**2,
        "sensor.noise_b": 0.011 * 16,
    }
    solidras = load_system("solidras")
    cases = [
        Case("uint8", solidras, options.frames, options.seed),
        Case("uint16, 12 bits", load_system(solidras, twelve), options.frames, options.seed),
        Case("float32", solidras, options.frames, options.seed, "float32"),
    ]
    tasks = {c.name: [*c.floor(), c.stream(), c.batch()] for c in cases}
    return table("Types of frames, 720 x 540", cases, tasks, options.n)


def pixels(options: argparse.Namespace) -> list[Row]:
    cases = [Case(f"{n} x {n}", _sized(n), options.frames, options.seed) for n in (256, 512, 1024)]
    tasks = {c.name: [*c.floor(), *c.single(), c.batch()] for c in cases}
    return table("Number of pixels, fields of 12.3 pixels", cases, tasks, options.n)


def fields(options: argparse.Namespace) -> list[Row]:
    cases = []
    for field_um in (30.0, 60.0, 120.0, 240.0):
        system = load_system("solidras", {"mask.field_um": field_um})
        count = system.shape[0] * system.shape[1] / system.pixels_per_field**2
        cases.append(Case(f"{count:.0f} fields", system, options.frames, options.seed))
    tasks = {c.name: [*c.floor(), *c.single(), c.batch()] for c in cases}
    return table("Number of fields in view, 720 x 540", cases, tasks, options.n)


def threads(options: argparse.Namespace) -> list[Row]:
    case = Case("720 x 540", load_system("solidras"), 2 * options.frames, options.seed)
    tasks = {case.name: [*case.floor(), case.batch(), case.batch(2)]}
    return table("Threads, 720 x 540", [case], tasks, options.n)


def _sized(side: int) -> System:
    return load_system("solidras", {"sensor.width_px": side, "sensor.height_px": side})


def table(title: str, cases: list[Case], tasks: dict[str, list[Task]], repeats: int) -> list[Row]:
    """Measure and print; one row for each task of each case."""
    by_key = {(name, task.name): task for name, some in tasks.items() for task in some}
    times = _study.measure(by_key, repeats)
    shapes = {case.name: case.system.shape for case in cases}
    rows = [row(case, name, shapes[case], times) for case, name in by_key]
    show(title, repeats, rows)
    for case in cases:
        if case.refitted:
            print(f"{case.name}: {case.refitted} of {case.tracked} frames were fitted, not tracked")
    return rows


def row(
    case: str, name: str, shape: tuple[int, int], times: dict[tuple[str, str], np.ndarray]
) -> Row:
    values = times[case, name]
    median, count = float(np.median(values)), shape[0] * shape[1]
    return Row(
        case,
        name,
        count,
        median,
        float(values.min()),
        1e3 / median,
        1e6 * median / count,
        median / float(np.median(times[case, FLOOR])),
        median / float(np.median(times[case, TRANSFORM])),
    )


def show(title: str, repeats: int, rows: list[Row]) -> None:
    print(f"\n{title}; one core if no threads are named, {repeats} repetitions")
    print(
        f"{'':44}{'median ms':>10}{'best ms':>9}{'frames/s':>10}{'ns/pixel':>10}"
        f"{'/ sum':>8}{'/ rfft2':>9}" + f"{'error px':>10}" * any(r.error_px for r in rows)
    )
    case = ""
    for r in rows:
        if r.case != case:
            case = r.case
            print(case)
        error = "" if r.error_px is None else f"{r.error_px:>10.6f}"
        print(
            f"  {r.task:42}{r.ms_median:>10.3f}{r.ms_best:>9.3f}{r.frames_per_s:>10.1f}"
            f"{r.ns_per_pixel:>10.2f}{r.per_sum:>8.1f}{r.per_rfft2:>9.2f}{error}",
            flush=True,
        )


def markdown(rows: list[Row]) -> str:
    """The rows as a table for the documentation."""
    lines = ["| | | ms | frames/s | ns/pixel | / sum | / rfft2 | error, px |", "|---" * 8 + "|"]
    for r in rows:
        error = "" if r.error_px is None else f"{r.error_px:.2g}"
        lines.append(
            f"| {r.case} | {r.task} | {_short(r.ms_median)} | {_short(r.frames_per_s)} "
            f"| {_short(r.ns_per_pixel)} | {_short(r.per_sum)} | {_short(r.per_rfft2)} | {error} |"
        )
    return "\n".join(lines) + "\n"


def _short(value: float) -> str:
    """Three figures, without an exponent."""
    return f"{value:.3g}" if value < 999.5 else f"{float(f'{value:.3g}'):.0f}"


# ------------------------------------------------------------------------- peers


def peers(options: argparse.Namespace) -> list[Row]:
    """Displacement since the first frame: time, and rms error of each component.

    One row is different: the tracker follows the small steps of its stream.
    """
    system = load_system("solidras")
    case = Case("720 x 540", system, options.frames, options.seed)
    rng = np.random.default_rng([options.seed, 1])
    poses = np.empty((options.displacements + 1, 5))
    poses[:, :2] = case.truth_um[0]
    poses[1:, :2] += rng.uniform(-system.pitch_um, system.pitch_um, (len(poses) - 1, 2))
    poses[:, 2:] = system.optics.scale, THETA_RAD, ORIENTATION
    coded = [_projection(*pose) for pose in poses]
    frames = _study.frame_pool(system, coded, seed=options.seed + 1)
    board, plain, corners = _peers.board_frames(system, poses, options.seed + 2)
    on_mask = [*_ours(case, frames[0]), _peers.correlation(frames[0])]
    on_board = [_peers.chessboard(board[0], corners, accurate) for accurate in (False, True)]
    board_name = f"plain board of {corners[0]} x {corners[1]} corners"

    tasks: dict[tuple[str, str], Task] = {}
    errors: dict[tuple[str, str], float] = {}
    for what, images, projections, known in (
        ("coded mask", frames, coded, on_mask),
        (board_name, board, plain, on_board),
    ):
        tasks |= {(what, task.name): task for task in case.floor()}
        for peer in filter(None, known):
            name, find = peer
            found = np.array([find(image) for image in images[1:]])
            errors[what, name] = _error_px(found, projections, system)
            tasks[what, name] = Task(name, lambda find=find, image=images[1]: find(image))
        if what == "coded mask":
            stream = case.stream()
            errors[what, STREAM] = _stream_error_px(case, stream)
            tasks[what, STREAM] = stream
        if None in known:
            print(f"{what}: a peer is not installed and left out; pip install '.[bench]'")
    times = _study.measure(tasks, options.n)
    rows = [row(*key, system.shape, times)._replace(error_px=errors.get(key)) for key in tasks]
    show("Displacement since the first frame, up to one pixel", options.n, rows)
    return rows


def _projection(x: float, y: float, scale: float, theta: float, orientation: float) -> Projection:
    return Projection.from_pose(x, y, scale, theta, int(orientation))


def _of(pose: Pose) -> Projection:
    return _projection(pose.x_um, pose.y_um, pose.scale, pose.theta_rad, pose.orientation)


def _error_px(found: np.ndarray, projections: list[Projection], system: System) -> float:
    """Rms of both components; `found` has one row for each but the first projection."""
    truth = _peers.shifts_px(projections, system.pitch_um)[1:]
    return float(np.sqrt(np.mean((found - truth) ** 2)))


def _ours(case: Case, start: np.ndarray) -> list[tuple[str, _peers.Displacement]]:
    first = analyse(start, case.system, orientation=ORIENTATION)

    def shift(frame: np.ndarray, prior: Pose | None) -> np.ndarray:
        pose = analyse(frame, case.system, orientation=ORIENTATION, prior=prior)
        return _peers.shifts_px([_of(first), _of(pose)], case.system.pitch_um)[1]

    return [
        (COLD, lambda frame: shift(frame, None)),
        ("refinement, prior up to 1 pixel away", lambda frame: shift(frame, first)),
    ]


def _stream_error_px(case: Case, stream: Task) -> float:
    found = [_of(pose) for pose in stream.call()]
    truth = [_projection(x, y, *case.rest) for x, y in case.truth_um]
    return _error_px(_peers.shifts_px(found, case.system.pitch_um)[1:], truth, case.system)


TABLES = {
    "sizes": sizes,
    "types": types,
    "pixels": pixels,
    "fields": fields,
    "threads": threads,
    "peers": peers,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-n", type=int, default=11, help="repetitions")
    parser.add_argument("--frames", type=int, default=128, help="frames in memory for each case")
    parser.add_argument("--displacements", type=int, default=16, help="for the errors of the peers")
    parser.add_argument("--only", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", metavar="FILE", help="write all rows")
    parser.add_argument("--markdown", metavar="FILE", help="write the tables, medians only")
    options = parser.parse_args()
    print(_study.environment())
    print(f"seed {options.seed}")
    tables = {name: TABLES[name](options) for name in options.only}
    rows = [row._asdict() | {"table": name} for name in tables for row in tables[name]]
    _study.save_json(options.json, options=vars(options), rows=rows)
    if options.markdown:
        with open(options.markdown, "w", encoding="utf-8") as file:
            file.write("\n".join(f"{name}\n\n{markdown(some)}" for name, some in tables.items()))


if __name__ == "__main__":
    main()
