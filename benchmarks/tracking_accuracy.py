"""Tracking against the bound, against the full fit, and along a walk without noise.

Three studies of SolidRas, 720 x 540 pixels of 8 bits. Images come from the exact generator,
which shares no formula with the fit or the tracker.

* noise: the error of tracked frames of a mask at rest over the Cramer-Rao bound (rounding
  counted), per coordinate; pulls; chi-square.
* difference: tracked pose minus that of the full likelihood fit of the same frame, begun cold.
* walk: frames without noise and rounding along a random walk through 10 um; the error must
  not step where the tracker takes a new reference.

    python benchmarks/tracking_accuracy.py
    python benchmarks/tracking_accuracy.py --only walk --walk 2000 -o build/walk
    python benchmarks/tracking_accuracy.py --only walk --walk 400 --paced-hz 275
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import _study

_study.one_thread()

import numpy as np  # noqa: E402
import rich.progress  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from rasnik import Flag, Track, Tracker, analyse, bound, load_system, simulate  # noqa: E402
from rasnik.analysis.pose import PARAMETERS  # noqa: E402

SYSTEM = load_system("solidras")
# (x um, y um, theta_z rad, scale): the paper's first position, others anywhere on the mask.
POSES = (
    (4000.0, 5000.0, 0.0, 1.0),
    (60_031.7, 70_012.3, 0.002, 1.0),
    (123_456.7, 34_567.8, -0.02, 1.003),
    (25_011.1, 160_044.4, 0.15, 0.99),
    (150_000.2, 98_765.4, -0.4, 1.01),
)
#: Names and factors from um, 1 and rad to what is printed.
UNITS = (("x, nm", 1e3), ("y, nm", 1e3), ("S, 1e-6", 1e6), ("theta_z, urad", 1e6))
RATIO_LIMIT = 1.05
DIFFERENCE_LIMIT_PM = 10.0
STEP_LIMIT_PM = 20.0


class Metered:
    """Frames handed on, with the time spent on waiting for them; some are kept."""

    def __init__(self, frames: Iterable[np.ndarray], keep_every: int = 0) -> None:
        self._frames, self._every = frames, keep_every
        self.waited_s = 0.0
        self.kept: dict[int, np.ndarray] = {}

    def __iter__(self) -> Iterator[np.ndarray]:
        iterator, k = iter(self._frames), 0
        while True:
            start = time.perf_counter()
            frame = next(iterator, None)
            self.waited_s += time.perf_counter() - start
            if frame is None:
                return
            if self._every and k % self._every == 0:
                self.kept[k] = frame
            yield frame
            k += 1


def shown(frames: Iterable[np.ndarray], label: str, total: int) -> Iterable[np.ndarray]:
    """The frames, with a progress bar where somebody may be looking."""
    quiet = not sys.stdout.isatty()
    return rich.progress.track(frames, label, total, transient=True, disable=quiet)


def warm_up() -> None:
    """Have everything compiled, lest it count as time of the first frames."""
    frames = [frame for frame, _ in simulate(SYSTEM, [POSES[0], (4000.5, 5000.0)], n=2, seed=1)]
    Tracker(SYSTEM).run(frames)


def values(track: Track) -> np.ndarray:
    """x, y (um), S, theta_z (rad) of every frame, shape (n, 4)."""
    return np.stack([getattr(track, name) for name in PARAMETERS], axis=1)


def sigmas(track: Track) -> np.ndarray:
    """The errors stated for `values`, shape (n, 4)."""
    names = ("sigma_x_um", "sigma_y_um", "sigma_scale", "sigma_theta_rad")
    return np.stack([getattr(track, name) for name in names], axis=1)


def work(track: Track) -> str:
    """What became of the frames, in per cent."""
    cold, fitted = (
        track.ok & (track.flags & np.uint32(flag) != 0) for flag in (Flag.COLD_START, Flag.REFITTED)
    )
    shares = {
        "tracked": track.ok & ~cold & ~fitted,
        "refitted": fitted & ~cold,
        "cold": cold,
        "lost": ~track.ok,
    }
    return ", ".join(f"{name} {100 * share.mean():.1f} %" for name, share in shares.items())


def verdict(what: str, value: float, limit: float, unit: str = "") -> None:
    held = "held" if value <= limit else "NOT HELD"
    print(f"  must hold: {what} <= {limit:g}{unit}: {value:.4g}{unit}, {held}")


# ------------------------------------------------------------------- a mask at rest


@dataclass(frozen=True, eq=False)
class Still:
    """Tracked frames of one pose; arrays of shape (n, 4) but for the differences."""

    errors: np.ndarray
    sigmas: np.ndarray
    least: np.ndarray  # (4,): the bound
    differences: np.ndarray  # (m, 4): tracked - full fit
    track: Track


def still(pose: tuple[float, ...], n: int, seed: int, fit_every: int) -> Still:
    """Track n noisy frames of one pose."""
    simulation = simulate(SYSTEM, pose, n=n, seed=seed)
    truth = simulation.truth[0]
    least = np.sqrt(np.diag(bound(SYSTEM, truth, rounding=True).covariance))
    frames = Metered((frame for frame, _ in simulation), fit_every)
    begin = time.perf_counter()
    track = Tracker(SYSTEM).run(shown(frames, f"{pose}", n))
    rate = n / (time.perf_counter() - begin - frames.waited_s)
    found = values(track)
    errors = found - [getattr(truth, name) for name in PARAMETERS]
    fits = [
        found[k] - [getattr(fit, name) for name in PARAMETERS]
        for k, fit in ((k, analyse(frame, SYSTEM)) for k, frame in frames.kept.items())
    ]
    x_um, y_um, theta_rad, scale = pose
    print(
        f"\nx {x_um:g} um, y {y_um:g} um, theta_z {1e3 * theta_rad:g} mrad, S {scale:g}: "
        f"{n} frames, {rate:.0f} frames/s\n  {work(track)}"
    )
    result = Still(errors, sigmas(track), least, np.array(fits).reshape(-1, 4), track)
    _still_table(result)
    return result


def _still_table(result: Still) -> None:
    n = len(result.errors)
    good = result.errors[result.track.ok]
    pulls = good / result.sigmas[result.track.ok]
    chi2 = result.track.chi2_ndf[result.track.ok]
    print(
        f"{'':>14}{'bound':>9}{'rms error':>11}{'ratio':>8}{'+-':>7}{'mean error':>12}{'+-':>9}"
        f"{'pull mean':>11}{'width':>8}{'largest':>9}"
    )
    for k, (name, unit) in enumerate(UNITS):
        rms = np.sqrt((good[:, k] ** 2).mean())
        ratio = rms / result.least[k]
        spread = good[:, k].std() / np.sqrt(len(good))
        print(
            f"{name:>14}{result.least[k] * unit:>9.4f}{rms * unit:>11.4f}{ratio:>8.4f}"
            f"{ratio / np.sqrt(2 * n):>7.4f}{good[:, k].mean() * unit:>12.5f}"
            f"{spread * unit:>9.5f}{pulls[:, k].mean():>11.4f}{pulls[:, k].std():>8.4f}"
            f"{np.abs(pulls[:, k]).max():>9.2f}"
        )
    # chi-square of one frame scatters by sqrt(2 / pixels), its mean by that over sqrt(n)
    pixels = np.prod(SYSTEM.shape)
    print(
        f"  chi2/ndf {chi2.mean():.4f}, scatter {chi2.std():.5f} "
        f"(of as many Gaussian pixels {np.sqrt(2 / pixels):.5f}); "
        "below 1 as full scale cuts off noise of white"
    )


def noise(options: argparse.Namespace) -> None:
    """Error over bound at several poses, and the difference to the full fit."""
    per_pose = max(1, options.n // options.poses)
    fit_every = max(1, options.n // options.fits) if options.fits else 0
    poses = [POSES[k % len(POSES)] for k in range(options.poses)]
    results = [still(pose, per_pose, options.seed + k, fit_every) for k, pose in enumerate(poses)]
    scaled = np.concatenate([r.errors[r.track.ok] / r.least for r in results])
    pulls = np.concatenate([(r.errors / r.sigmas)[r.track.ok] for r in results])
    total = sum(len(r.errors) for r in results)
    chance = 1 / np.sqrt(2 * len(scaled))
    print(f"\nall {total} frames, {total - len(scaled)} without a position")
    print(f"{'':>14}{'error / bound':>15}{'+-':>8}{'pull mean':>11}{'+-':>8}{'pull width':>12}")
    for k, (name, _) in enumerate(UNITS):
        ratio = np.sqrt((scaled[:, k] ** 2).mean())
        print(
            f"{name.split(',')[0]:>14}{ratio:>15.4f}{ratio * chance:>8.4f}"
            f"{pulls[:, k].mean():>11.4f}"
            f"{1 / np.sqrt(len(scaled)):>8.4f}{pulls[:, k].std():>12.4f}"
        )
    worst = np.sqrt((scaled**2).mean(axis=0)).max()
    verdict("largest error / bound", worst, RATIO_LIMIT)
    if fit_every:
        _difference_table(np.concatenate([r.differences for r in results]))


def _difference_table(differences: np.ndarray) -> None:
    print(f"\ntracked - full fit of the same frame, begun cold, {len(differences)} frames")
    print(f"{'':>16}{'rms':>9}{'mean':>9}{'largest':>9}")
    for k, (name, unit) in enumerate(
        (("x, pm", 1e6), ("y, pm", 1e6), ("S, 1e-9", 1e9), ("theta_z, nrad", 1e9))
    ):
        d = differences[:, k] * unit
        print(f"{name:>16}{np.sqrt((d**2).mean()):>9.3f}{d.mean():>9.3f}{np.abs(d).max():>9.3f}")
    rms = 1e6 * np.sqrt((differences[:, :2] ** 2).mean(axis=0)).max()
    verdict("difference, rms of x and y", rms, DIFFERENCE_LIMIT_PM, " pm")


# ------------------------------------------------------------------------- the walk


def walk_poses(n: int, length_um: float, step_um: float, seed: int) -> np.ndarray:
    """x, y, theta_z along a random walk that also drifts by `length_um`, shape (n, 3).

    Every step is Gaussian in x and y, about an even drift at 37 degrees to x; theta_z turns
    by 0.2 urad rms a step.
    """
    rng = np.random.default_rng(seed)
    drift = length_um / max(1, n - 1) * np.array([np.cos(0.65), np.sin(0.65), 0.0])
    steps = drift + rng.standard_normal((n, 3)) * [step_um, step_um, 2e-7]
    steps[0] = 0
    return np.array([60_031.7, 70_012.3, 0.002]) + np.cumsum(steps, axis=0)


def paced(frames: list[np.ndarray], rate_hz: float) -> Track:
    """Track frame by frame as a camera hands them out, so that the tracker cannot wait."""
    tracker = Tracker(SYSTEM)
    poses = [tracker.update(frames[0], 0.0)]  # the cold start is given its time
    begin = time.perf_counter()
    for k, frame in enumerate(frames[1:], 1):
        time.sleep(max(0.0, begin + k / rate_hz - time.perf_counter()))
        poses.append(tracker.update(frame, k / rate_hz))
    return Track.from_poses(poses)


def walk(options: argparse.Namespace) -> None:
    """Error along a random walk, without noise."""
    poses = walk_poses(options.walk, options.length_um, options.step_um, options.seed)
    simulation = simulate(SYSTEM, poses, seed=options.seed, noise=False)
    frames = Metered(
        (frame.astype(np.float32) for frame, _ in simulation),
        max(1, options.walk // options.walk_fits),
    )
    begin = time.perf_counter()
    if options.paced_hz:
        track = paced(list(shown(frames, "walk", len(poses))), options.paced_hz)
    else:
        track = Tracker(SYSTEM).run(shown(frames, "walk", len(poses)))
    rate = len(poses) / (time.perf_counter() - begin - frames.waited_s)
    errors = 1e6 * (values(track)[:, :2] - poses[:, :2])
    kept = np.array(list(frames.kept))
    fits = [analyse(frame, SYSTEM) for frame in frames.kept.values()]
    fit_errors = 1e6 * (np.array([[fit.x_um, fit.y_um] for fit in fits]) - poses[kept, :2])
    moved = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    print(
        f"\nwalk without noise, {len(poses)} frames, {rate:.0f} frames/s, {work(track)}\n"
        f"  from end to end {np.linalg.norm(poses[-1, :2] - poses[0, :2]):.2f} um, "
        f"along the way {moved.sum():.2f} um; one step {1e3 * np.median(moved):.0f} nm, "
        f"at most {1e3 * moved.max():.0f} nm"
    )
    steps = np.abs(np.diff(errors, axis=0))
    print(f"{'pm':>10}{'mean error':>12}{'rms error':>11}{'largest':>9}{'rms step':>10}", end="")
    print(f"{'largest':>9}{'at frame':>10}{'full fit, rms':>15}{'tracked - fit':>15}")
    for k, name in enumerate("xy"):
        e, s = errors[:, k], steps[:, k]
        apart = errors[kept, k] - fit_errors[:, k]
        print(
            f"{name:>10}{np.nanmean(e):>12.3f}{np.sqrt(np.nanmean(e**2)):>11.3f}"
            f"{np.nanmax(np.abs(e)):>9.3f}{np.sqrt(np.nanmean(s**2)):>10.3f}{np.nanmax(s):>9.3f}"
            f"{np.nanargmax(s) + 1:>10d}{np.sqrt((fit_errors[:, k] ** 2).mean()):>15.3f}"
            f"{np.sqrt(np.nanmean(apart**2)):>15.3f}"
        )
    # a frame without a position is no small step
    largest = steps.max() if track.ok.all() else np.inf
    verdict("largest step of the error", largest, STEP_LIMIT_PM, " pm")
    path = options.output / "tracking-walk.png"
    _plot_walk(poses, errors, kept, fit_errors, path)
    print(f"  plot: {path}")


def _plot_walk(
    poses: np.ndarray, errors: np.ndarray, kept: np.ndarray, fit_errors: np.ndarray, path: Path
) -> None:
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    by_frame, by_place, by_step = figure.subplots(3, 1)
    for k, (name, colour) in enumerate((("x", "#1f6fb4"), ("y", "#c2591a"))):
        place = poses[:, k] - poses[0, k]
        by_frame.plot(errors[:, k], color=colour, lw=0.8, label=f"{name}, tracked")
        by_frame.plot(kept, fit_errors[:, k], "o", ms=3, mfc="none", color=colour,
                      label=f"{name}, full fit")  # fmt: skip
        by_place.plot(place, errors[:, k], ".", ms=2.5, color=colour, label=name)
        by_step.plot(np.arange(1, len(errors)), np.diff(errors[:, k]), color=colour, lw=0.7,
                     label=name)  # fmt: skip
    by_frame.set(xlabel="frame", ylabel="error, pm", title="Random walk without noise")
    by_place.set(xlabel="position since the first frame, um (x for x, y for y)", ylabel="error, pm")
    by_step.set(xlabel="frame", ylabel="change of the error\nfrom frame to frame, pm")
    for side in (-STEP_LIMIT_PM, STEP_LIMIT_PM):
        by_step.axhline(side, color="black", lw=0.8, ls=":")
    for axes in (by_frame, by_place, by_step):
        axes.grid(alpha=0.3)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-n", type=int, default=20_000, help="noisy frames in all")
    parser.add_argument("--poses", type=int, default=5, help="poses they are divided among")
    parser.add_argument("--fits", type=int, default=400, help="full fits to compare with; 0: none")
    parser.add_argument("--walk", type=int, default=800, help="frames of the walk")
    parser.add_argument("--walk-fits", type=int, default=50, help="full fits along it")
    parser.add_argument("--length-um", type=float, default=10.0, help="drift of the walk")
    parser.add_argument("--step-um", type=float, default=0.04, help="rms step of x and of y")
    parser.add_argument(
        "--paced-hz", type=float, help="walk: frame by frame at this rate (held in memory)"
    )
    parser.add_argument("--only", choices=["noise", "walk"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, default=Path("build/tracking"), metavar="DIR")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    print(_study.environment(), f"seed {options.seed}", sep="\n")
    warm_up()
    if options.only != "walk":
        noise(options)
    if options.only != "noise":
        walk(options)


if __name__ == "__main__":
    main()
