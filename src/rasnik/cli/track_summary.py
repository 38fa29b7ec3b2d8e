"""What ``rasnik track`` says at the end: counts, motion, and the first failures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table

from rasnik.analysis.flags import FLAGS, Flag, FlagInfo
from rasnik.cli.common import messages, output
from rasnik.tracking.track import Track

__all__ = ["Failure", "Summary"]

_MOST_FAILURES = 5


@dataclass(frozen=True)
class Failure:
    """A frame without a position."""

    frame: int
    reason: str


@dataclass
class _Moments:
    """Mean, scatter and extremes of values that come in pieces."""

    count: int = 0
    mean: float = math.nan
    squares: float = 0.0
    """Sum of the squared distances from the mean."""
    least: float = math.inf
    most: float = -math.inf

    def add(self, values: NDArray[np.float64]) -> None:
        """Chan, Golub and LeVeque, Am. Stat. 37 (1983) 242, eq. 2.1: no digits are lost."""
        if not len(values):
            return
        mean, n = float(values.mean()), len(values)
        step = mean - (self.mean if self.count else mean)
        self.squares += float(((values - mean) ** 2).sum())
        self.squares += step**2 * self.count * n / (self.count + n)
        self.mean = mean - step * self.count / (self.count + n)
        self.count += n
        self.least = min(self.least, float(values.min()))
        self.most = max(self.most, float(values.max()))

    @property
    def rms(self) -> float:
        return math.sqrt(self.squares / self.count) if self.count else math.nan

    @property
    def peak_to_peak(self) -> float:
        return self.most - self.least if self.count else math.nan


def _fatal(flags: int) -> FlagInfo | None:
    return next((info for info in FLAGS if info.fatal and flags & info.flag), None)


@dataclass
class Summary:
    """Counts and moments of a track that comes block by block; memory does not grow."""

    tracked: int = 0
    refitted: int = 0
    cold_starts: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    """Number of frames without a position, by the flag that says why."""
    frames_lost: int = 0
    failures: list[Failure] = field(default_factory=list)
    """The first ones."""
    _axes: dict[str, tuple[_Moments, _Moments]] = field(
        default_factory=lambda: {axis: (_Moments(), _Moments()) for axis in "xy"}
    )
    """Position and its stated error, in um."""

    @property
    def frames(self) -> int:
        return self.tracked + self.refitted + self.cold_starts + self.failed.total()

    def add(self, block: Track, reasons: Mapping[int, str] | None = None) -> None:
        """Count the frames of a block; `reasons` says of some, by number, why they failed."""
        ok = block.ok
        cold = ok & _carries(block, Flag.COLD_START)
        refitted = ok & _carries(block, Flag.REFITTED) & ~cold
        self.cold_starts += int(cold.sum())
        self.refitted += int(refitted.sum())
        self.tracked += int((ok & ~cold & ~refitted).sum())
        self.frames_lost += block.count(Flag.FRAMES_LOST)
        for axis, (position, sigma) in self._axes.items():
            position.add(getattr(block, f"{axis}_um")[ok])
            sigma.add(getattr(block, f"sigma_{axis}_um")[ok])
        for row in np.flatnonzero(~ok):
            info = _fatal(int(block.flags[row]))
            self.failed[info.name if info else "no position"] += 1
            if len(self.failures) < _MOST_FAILURES:
                number = int(block.frame[row])
                sentence = info.sentence if info else "There is no position."
                reason = (reasons or {}).get(number, sentence)
                self.failures.append(Failure(number, reason))

    def as_dict(self) -> dict[str, Any]:
        """For JSON: None where there is no number."""
        axes = {
            axis: {
                "mean_um": position.mean,
                "rms_nm": 1e3 * position.rms,
                "peak_to_peak_nm": 1e3 * position.peak_to_peak,
                "mean_sigma_nm": 1e3 * sigma.mean,
            }
            for axis, (position, sigma) in self._axes.items()
        }
        return {
            "frames": self.frames,
            "tracked": self.tracked,
            "refitted": self.refitted,
            "cold_starts": self.cold_starts,
            "failed": self.failed.total(),
            "failed_by_flag": dict(self.failed),
            "frames_lost": self.frames_lost,
            **{
                axis: {name: v if math.isfinite(v) else None for name, v in values.items()}
                for axis, values in axes.items()
            },
            "failures": [{"frame": f.frame, "reason": f.reason} for f in self.failures],
        }

    def print_table(self, frames_per_s: float) -> None:
        """Print the counts and the motion on the standard output."""
        counts = Table(box=None, pad_edge=False, show_header=False)
        counts.add_column(style="bold")
        counts.add_column(justify="right")
        counts.add_column()
        by_flag = ", ".join(f"{name} {count}" for name, count in self.failed.most_common())
        for name, count, remark in (
            ("frames", self.frames, ""),
            ("tracked", self.tracked, ""),
            ("refitted", self.refitted, "fitted on their own; see the flags"),
            ("cold starts", self.cold_starts, ""),
            ("failed", self.failed.total(), by_flag),
            ("frames lost", self.frames_lost, "places where frames are missing"),
        ):
            counts.add_row(name, str(count), escape(remark) if count else "")
        if math.isfinite(frames_per_s):
            counts.add_row("frames/s", f"{frames_per_s:.4g}", "")
        motion = Table(box=None, pad_edge=False, header_style="bold")
        for heading in ("", "mean (µm)", "rms (nm)", "peak to peak (nm)", "mean sigma (nm)"):
            motion.add_column(heading, justify="right", no_wrap=True)
        for axis, (position, sigma) in self._axes.items():
            if position.count:
                cells = (1e3 * position.rms, 1e3 * position.peak_to_peak, 1e3 * sigma.mean)
                motion.add_row(axis, f"{position.mean:.4f}", *(f"{value:.4g}" for value in cells))
        console = output()
        console.print(counts)
        if motion.row_count:
            console.print(motion)
            console.print("(rms: about the mean)")

    def print_failures(self) -> None:
        """Print why the first frames failed, on the standard error output."""
        console = messages()
        for failure in self.failures:
            console.print(f"[red]frame {failure.frame}: {escape(failure.reason)}[/]")
        more = self.failed.total() - len(self.failures)
        if more > 0:
            console.print(f"[red]and {more} more without a position; their flags say why[/]")


def _carries(block: Track, flag: Flag) -> NDArray[np.bool_]:
    return (block.flags & np.uint32(flag)) != 0
