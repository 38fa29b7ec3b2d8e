"""Tracking through jumps, blank frames, flashes, hands in the beam, torn and missing frames.

SolidRas, 720 x 540 pixels of 8 bits, a disturbance of 1 to 10 frames about every 100 frames
(`_fault_stream`). The pose of every frame is known, and every result is judged:

right       within 6 of its own sigmas of the truth, or within 5 nm anywhere in the image.
            If parts of a frame show different poses, one of them, or one in between if they
            are less than 0.1 um apart (as when the mask moves during an exposure), whole fields
            not counted.
none        no position was given.
wrong       anything else, by the strongest flag that came with it:
  unflagged   none at all
  informed    only flags that tell of the stream or of what the tracker did for no fault
              of the result: frames lost, cold start, moved, ...
  treated     flags of a fit of its own: refitted, another profile or map
  warned      flags that call the image itself into question: obstructed, misfit, ...

Relocking: the number of undisturbed frames after a disturbance, the first right one (ok, within
5 sigma) included. Only the first two kinds of wrong results, relocking later than the second
frame, and undisturbed frames without the right position count as failures.

    python benchmarks/tracking_faults.py -n 100000 --json faults.json
"""

from __future__ import annotations

import argparse

import _study

_study.one_thread()

import json  # noqa: E402
import sys  # noqa: E402
from collections import Counter, defaultdict  # noqa: E402
from collections.abc import Iterable, Sequence  # noqa: E402
from dataclasses import dataclass, field  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
from rich.progress import Progress  # noqa: E402

from _fault_stream import KINDS, FaultStream, Truth, View  # noqa: E402
from rasnik import Flag, Track, Tracker  # noqa: E402

OUTCOMES = ("right", "none", "unflagged", "informed", "treated", "warned")
RELOCK = 2  # frames

_INFORMED = Flag(0)
for _flag in (
    Flag.FRAMES_LOST, Flag.TIME_IRREGULAR, Flag.NOISE_ESTIMATED, Flag.COLD_START,
    Flag.PRIOR_REJECTED, Flag.MOVED,
):  # fmt: skip
    _INFORMED |= _flag
_TREATED = Flag.REFITTED | Flag.PROFILE_REFINED | Flag.AFFINE | Flag.PROJECTIVE
_POSE = ("x_um", "y_um", "scale", "theta_rad")
# 5 nm, and the turn and scale that move the edge of the image by as much.
_ALLOWED = np.array([0.005, 0.005, 2e-6, 2e-6])
_SMEAR_UM = 0.1


def strength(flags: int) -> str:
    """How much warning flags give of a wrong result."""
    if not flags:
        return "unflagged"
    if not flags & ~int(_INFORMED):
        return "informed"
    return "treated" if not flags & ~int(_INFORMED | _TREATED) else "warned"


def _length(error: np.ndarray) -> float:
    return float(np.hypot(*error[:2]))


@dataclass
class Report:
    """Counts of a fault run.

    Attributes
    ----------
    height_um, field_um : float
        Of the image and of a field.
    outcomes : dict of Counter
        By kind of frame, by outcome (`OUTCOMES`).
    flags : dict of Counter
        By kind of frame, by name of the flag.
    relock : dict of Counter
        By kind of disturbance, by number of frames.
    never : dict of Counter
        Likewise, of those that the next disturbance put an end to.
    late_at : list of int
        Frames by which it should have been relocked.
    lost : list of int
        Undisturbed frames without the right position.
    false_alarms : int
        Undisturbed frames with the right position and a flag.
    short_sigma : int
        Right within 5 nm, but not within 6 sigma.
    between : float
        Largest distance (um) to the nearest piece of a result between two, unflagged.
    wrong : list of dict
        Every wrong result.
    """

    height_um: float
    field_um: float
    outcomes: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    flags: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    relock: dict[str, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))
    never: dict[str, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))
    late_at: list[int] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)
    false_alarms: int = 0
    short_sigma: int = 0
    between: float = 0.0
    wrong: list[dict[str, Any]] = field(default_factory=list)
    _waiting: str = ""
    _waited: int = 0

    def total(self, outcome: str) -> int:
        return sum(counts[outcome] for counts in self.outcomes.values())

    @property
    def passed(self) -> bool:
        silent = self.total("unflagged") + self.total("informed")
        return not (silent or self.late_at or self.lost)

    def add(self, first: int, track: Track, truths: Sequence[Truth]) -> None:
        """Judge the frames of a piece of the track; `first` is the index of its first one."""
        found = np.stack([getattr(track, name) for name in _POSE], axis=1)
        sigma = np.stack([getattr(track, f"sigma_{name}") for name in _POSE], axis=1)
        for j, (truth, ok) in enumerate(zip(truths, track.ok, strict=True)):
            flags = int(track.flags[j])
            outcome = "none"
            pull = np.inf
            if ok:
                outcome, pull = self._judged(found[j], sigma[j], flags, truth)
            self.outcomes[truth.kind][outcome] += 1
            self.flags[truth.kind].update(Flag(flags).names)
            if outcome not in ("right", "none"):
                near = min(found[j] - truth.poses, key=_length, default=np.full(4, np.nan))
                self.wrong.append({
                    "index": first + j, "kind": truth.kind, "outcome": outcome,
                    "error": near.tolist(), "sigma": sigma[j].tolist(),
                    "flags": Flag(flags).names,
                })  # fmt: skip
            self._follow(first + j, truth, outcome, pull, flags)

    def _judged(
        self,
        found: np.ndarray,
        sigma: np.ndarray,
        flags: int,
        truth: Truth,
    ) -> tuple[str, float]:
        """Outcome and largest pull (against the nearest piece) of a result that is there."""
        if not len(truth.poses):
            return strength(flags), np.inf
        error = np.abs(found - truth.poses)
        pulls = (error / sigma).max(axis=1)
        pull = float(np.nan_to_num(pulls, nan=np.inf).min())
        allowed = np.maximum(6 * np.nan_to_num(sigma), _ALLOWED)
        if (error <= allowed).all(axis=1).any():
            self.short_sigma += pull > 6
            return "right", pull
        if truth.view is View.PIECES:
            distance = self._smeared(found, allowed, truth.poses)
            if distance is not None:
                self.between = max(self.between, 0.0 if flags else distance)
                return "right", pull
        return strength(flags), pull

    def _smeared(self, found: np.ndarray, allowed: np.ndarray, poses: np.ndarray) -> float | None:
        """Distance (um) to the nearest piece of a result between two that nearly agree.

        Pieces whole fields apart share the chessboard: which of them it is, the code says.
        None if the result is none of this.
        """
        distances = []
        for one in poses:
            for other in poses:
                apart = other - one
                apart[:2] -= self.field_um * np.rint(apart[:2] / self.field_um)
                smear = float(np.hypot(*apart[:2]))
                # A straight line through a step has at most 1.5 steps over its length as slope.
                margin = allowed + np.array([0, 0, 1, 1]) * 1.5 * smear / self.height_um
                error = found - one
                inside = error >= np.minimum(apart, 0) - margin
                inside &= error <= np.maximum(apart, 0) + margin
                if smear < _SMEAR_UM and inside.all():
                    distances.append(float(np.hypot(*error[:2])))
        return min(distances, default=None)

    def _follow(self, k: int, truth: Truth, outcome: str, pull: float, flags: int) -> None:
        """Count frames until the position is right again, and losses where nothing happens."""
        if truth.view is not View.FULL or truth.change:
            self._give_up()
            self._waiting = truth.change or truth.kind
        if truth.view is not View.FULL:
            return
        if not self._waiting:
            if outcome != "right":
                self.lost.append(k)
            self.false_alarms += outcome == "right" and flags != 0
        elif pull < 5:
            self.relock[self._waiting][self._waited + 1] += 1
            self._waiting, self._waited = "", 0
        else:
            self._waited += 1
            if self._waited == RELOCK:
                self.late_at.append(k)

    def _give_up(self) -> None:
        if self._waiting and self._waited:
            self.never[self._waiting][self._waited] += 1
        self._waiting, self._waited = "", 0

    def as_dict(self) -> dict[str, Any]:
        return {
            "frames": sum(map(sum, (c.values() for c in self.outcomes.values()))),
            "passed": self.passed,
            **{name: self.total(name) for name in OUTCOMES},
            "relocked_late": len(self.late_at),
            "lost_for_no_reason": len(self.lost),
            "flagged_for_no_reason": self.false_alarms,
            "right_but_sigma_short": self.short_sigma,
            "largest_distance_between_pieces_um": self.between,
            "outcomes": self.outcomes,
            "relock": self.relock,
            "disturbed_again_before_relock": self.never,
            "flags": self.flags,
            "late_at": self.late_at[:1000],
            "lost": self.lost[:1000],
            "wrong": self.wrong[:1000],
        }


def follow(
    stream: FaultStream, tracker: Tracker, size: int = 256, progress: Any = None
) -> tuple[Report, Track]:
    """Track a stream and judge every frame; also the last piece of the track."""
    system = stream.system
    report = Report(system.shape[0] * system.pitch_um, system.mask.field_um)
    done, block = 0, Track()
    blocks: Iterable[Track] = tracker.blocks(
        stream.frames(), stream.times_s.tolist(), stream.numbers.tolist(), size
    )
    for block in blocks:
        stop = done + len(block)
        if (block.frame != stream.numbers[done:stop]).any():
            raise RuntimeError(f"the numbers of frames {done} to {stop} are not those handed over")
        report.add(done, block, [stream.truth(k) for k in range(done, stop)])
        done = stop
        if progress is not None:
            progress(len(block))
    if done != len(stream):
        raise RuntimeError(f"{len(stream)} frames were handed over, {done} came back")
    return report, block


def _print_wrong(wrong: list[dict[str, Any]], most: int = 40) -> None:
    """The first of every run of wrong frames that are alike."""
    before, lines = None, 0
    for row in wrong:
        here = (row["kind"], row["outcome"], row["index"])
        is_next = before == (*here[:2], row["index"] - 1)
        before = here
        if is_next or lines == most:
            continue
        lines += 1
        x, y = (1e3 * value for value in row["error"][:2])
        print(
            f"  {row['outcome']:>9}, frame {row['index']}, {row['kind']}: off by {x:.4g}, "
            f"{y:.4g} nm, sigma {1e3 * row['sigma'][0]:.2g} nm, "
            f"{', '.join(row['flags']) or 'no flag'}"
        )


def _print(report: Report) -> None:
    order = [k for k in ("quiet", "dust", *KINDS) if k in report.outcomes]
    width = 22
    print(f"\n{'frames':{width}}" + "".join(f"{name:>11}" for name in ("all", *OUTCOMES)))
    for kind in order:
        counts = report.outcomes[kind]
        row = [sum(counts.values()), *(counts[name] for name in OUTCOMES)]
        print(f"{kind:{width}}" + "".join(f"{value:>11d}" for value in row))
    row = [sum(map(report.total, OUTCOMES)), *map(report.total, OUTCOMES)]
    print(f"{'all':{width}}" + "".join(f"{value:>11d}" for value in row))

    print(f"\n{'relocked at frame':{width}}{'1':>9}{'2':>9}{'later':>9}   cut short after")
    kinds = ("start", "dust", *KINDS, "light comes back")
    for kind in (k for k in kinds if k in report.relock or k in report.never):
        count, never = report.relock.get(kind, Counter()), report.never.get(kind, Counter())
        later = sum(count[k] for k in count if k > RELOCK)
        cut = ", ".join(f"{k}: {never[k]}" for k in sorted(never))
        print(f"{kind:{width}}{count[1]:>9}{count[2]:>9}{later:>9}   {cut}")

    print("\nflags, share of the frames of a kind")
    for kind in order:
        n = sum(report.outcomes[kind].values())
        common = report.flags[kind].most_common(6)
        print(f"{kind:{width}}" + ", ".join(f"{name} {c / n:.2f}" for name, c in common))

    _print_wrong(report.wrong)
    print(
        f"\nwrong and unflagged {report.total('unflagged')}, with information only "
        f"{report.total('informed')}; relocked later than frame {RELOCK}: "
        f"{len(report.late_at)} {report.late_at[:10]}; "
        f"undisturbed, but without the right position: {len(report.lost)} {report.lost[:10]}\n"
        f"undisturbed, but flagged: {report.false_alarms}; right within 5 nm, not within "
        f"6 sigma: {report.short_sigma}; torn frames between their pieces, unflagged: off by up "
        f"to {1e3 * report.between:.1f} nm\n{'passed' if report.passed else 'FAILED'}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-n", type=int, default=100_000, help="frames")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--every", type=float, default=100.0, help="frames between disturbances")
    parser.add_argument("--only", nargs="+", choices=[*KINDS, "dust"], metavar="KIND")
    parser.add_argument(
        "--without", nargs="+", choices=[*KINDS, "dust"], metavar="KIND", default=[]
    )
    parser.add_argument("--exact", type=float, default=0.05, help="share of exact images")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write all counts to this file")
    options = parser.parse_args()
    print(_study.environment())
    kinds = [k for k in options.only or (*KINDS, "dust") if k not in options.without]
    stream = FaultStream(
        options.n, options.seed, every=options.every, kinds=kinds, exact=options.exact
    )
    print(f"{options.n} frames, {len(stream.events)} disturbances, seed {options.seed}")
    tracker = Tracker(stream.system, threads=options.threads)
    with Progress() as bar:
        task = bar.add_task("frames", total=options.n)
        report, _ = follow(stream, tracker, progress=lambda n: bar.advance(task, n))
    _print(report)
    if options.json:
        record = {"environment": _study.environment(), "seed": options.seed, **report.as_dict()}
        options.json.write_text(json.dumps(record, indent=1), encoding="utf-8")
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
