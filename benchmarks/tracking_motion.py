"""Tracking a mask in motion: is the error at the bound, whatever the motion?

SolidRas at 275 frames a second, moved by a sine at 30 degrees to x, from 1 nm to 1 mm and from
0.1 to 100 Hz. Frequencies are odd, lest the phases repeat. Every frame shows one moment; the
table states the longest exposure for which that holds. Images are those of the image model
with the noise of the sensor, for two cases those of the exact generator.

Per case: share of frames tracked, refitted, begun cold and lost; error over the Cramer-Rao bound
(rounding counted), rms and largest; amplitude spectral density (Welch) of the error over that of
the bound, at the motion's frequency and its next two multiples (folded back into the band), the
median and the largest; the probability by chance of what a least-squares fit finds at those
three frequencies, which also sees what Welch's segments are too short for; and the relative
error of the amplitude.

Then images smeared by an exposure as long as the frame interval.

    python benchmarks/tracking_motion.py
    python benchmarks/tracking_motion.py --full -o build/motion
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _study

_study.one_thread()

import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from scipy import signal, stats  # noqa: E402

from rasnik import Flag, Projection, System, Track, Tracker, bound, load_system  # noqa: E402
from rasnik.imaging.model import expected_image  # noqa: E402
from rasnik.imaging.motion import Sine  # noqa: E402
from rasnik.imaging.noise import add_noise  # noqa: E402
from rasnik.imaging.poses import parse_pose  # noqa: E402
from rasnik.imaging.simulate import PATHS, simulate  # noqa: E402
from rasnik.performance.bound import camera_of, state_at  # noqa: E402
from tracking_accuracy import RATIO_LIMIT, Metered, shown, values, verdict, warm_up  # noqa: E402

SYSTEM = load_system("solidras")
RATE_HZ = 275.0
START = (60_031.7, 70_012.3, 0.002)
DIRECTION_RAD = math.radians(30)
AMPLITUDES_UM = (1e-3, 0.03, 1.0, 30.0, 1e3)
FREQUENCIES_HZ = (0.1, 1.03, 10.3, 99.7)
FULL_AMPLITUDES_UM = (1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3)
FULL_FREQUENCIES_HZ = (0.1, 0.31, 1.03, 3.1, 10.3, 31.0, 99.7)
EXACT_CASES = ((0.3, 10.3), (30.0, 1.03))
SMEARS_UM = (0.3, 1.0, 3.0, 10.0, 30.0)
#: Smear taken as none when exposures are stated; the last table shows what it does.
NO_SMEAR_UM = 1.0
#: Probability that chance alone marks any case of a table.
CHANCE = 0.01


def model_image(system: System, projection: Projection, **_: Any) -> np.ndarray:
    """The image of the model of the fit, as a path of `simulate`."""
    look = state_at(system, projection).appearance
    return expected_image(system.mask, projection, look, camera_of(system)).astype(float)


PATHS["model"] = model_image


@dataclass(frozen=True)
class Case:
    """One motion."""

    amplitude_um: float
    hz: float
    n: int
    path: str = "model"

    @property
    def motion(self) -> Sine:
        """From one end of the sine, so that half a period shows all of it."""
        x, y = math.cos(DIRECTION_RAD), math.sin(DIRECTION_RAD)
        return Sine(self.hz, self.amplitude_um * x, self.amplitude_um * y, phase_rad=-math.pi / 2)

    @property
    def peak_um_per_s(self) -> float:
        return 2 * math.pi * self.hz * self.amplitude_um


@dataclass(frozen=True, eq=False)
class Result:
    """A tracked case; errors and displacements of x and y in um, shape (n, 2)."""

    case: Case
    track: Track
    errors: np.ndarray
    moved: np.ndarray
    least: np.ndarray  # (2,): the bound, um
    rate: float  # frames/s of the tracker

    @property
    def scaled(self) -> np.ndarray:
        """Errors over the bound, shape (n, 2); 0 where there is no position."""
        return np.nan_to_num(self.errors / self.least)

    @property
    def segment(self) -> int:
        """Frames in one of the segments of Welch's method."""
        return min(self.case.n // 4, 1024)

    def spectrum(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Frequencies, power density over that of the bound (mean of x and y), its degrees
        of freedom."""
        f, power = signal.welch(self.scaled.T, RATE_HZ, nperseg=self.segment)
        # Hann windows that overlap by half; both coordinates count.
        segments = (self.case.n - self.segment) // (self.segment // 2) + 1
        freedom = 2 * 2 * segments / (1 + 2 * (segments - 1) / segments / 36)
        return f, power.mean(axis=0) * RATE_HZ / 2, freedom

    def harmonics(self) -> np.ndarray:
        """The motion's frequency, twice and three times it, folded back into the band."""
        f = self.case.hz * np.arange(1, 4)
        return np.abs((f + RATE_HZ / 2) % RATE_HZ - RATE_HZ / 2)

    def at_harmonics(self) -> np.ndarray:
        """Amplitude density over the bound at `harmonics`; (3,).

        What is too slow for the segments is taken at the lowest frequency they show.
        """
        f, power, _ = self.spectrum()
        bins = np.clip(np.rint(self.harmonics() / f[1]).astype(int), 1, len(f) - 2)
        return np.sqrt(power[bins])

    def median(self) -> float:
        """Median of the amplitude density over the bound, 1 for white noise at the bound."""
        _, power, freedom = self.spectrum()
        return float(np.sqrt(np.median(power[1:-1]) * freedom / stats.chi2.median(freedom)))

    def lines(self) -> float:
        """Probability that white noise at the bound has as much at the three frequencies."""
        phase = 2 * np.pi * self.case.hz * np.arange(self.case.n)[:, None] / RATE_HZ
        phase = phase * np.arange(1, 4)
        basis, _ = np.linalg.qr(
            np.hstack([np.ones((self.case.n, 1)), np.cos(phase), np.sin(phase)])
        )
        parts = basis[:, 1:].T @ self.scaled
        return float(stats.chi2.sf((parts**2).sum(), parts.size))

    def marks(self, chance: float) -> list[str]:
        """What is beyond the bound by more than happens by chance with this probability."""
        _, power, freedom = self.spectrum()
        each = chance / 4
        found = {
            "lost": not self.track.ok.all(),
            "rms": stats.chi2.sf((self.scaled**2).sum(), self.scaled.size) < each,
            "largest": 2 * stats.norm.sf(np.abs(self.scaled).max()) * self.scaled.size < each,
            "density": stats.chi2.sf(power[1:-1].max() * freedom, freedom) * len(power) < each,
            "lines": self.lines() < each,
        }
        return [name for name, beyond in found.items() if beyond]

    def gain(self) -> tuple[float, float]:
        """Relative error of the amplitude, and what the bound allows for it."""
        moved = (self.moved - self.moved.mean(axis=0)) / self.least
        power = (moved**2).sum()
        return float((moved * self.scaled).sum() / power), float(1 / np.sqrt(power))


def observe(case: Case, seed: int) -> Result:
    """Track one case."""
    simulation = simulate(SYSTEM, START, n=case.n, seed=seed, path=case.path, motion=case.motion)
    truth = np.array([(t.x_um, t.y_um) for t in simulation.truth])
    frames = Metered(frame for frame, _ in simulation)
    label = f"{case.amplitude_um:g} um, {case.hz:g} Hz"
    times = (np.arange(case.n) / RATE_HZ).tolist()
    begin = time.perf_counter()
    track = Tracker(SYSTEM).run(shown(frames, label, case.n), times)
    rate = case.n / (time.perf_counter() - begin - frames.waited_s)
    errors = values(track)[:, :2] - truth
    # The bound varies by some per cent with the codes in view.
    along = simulation.truth[:: max(1, case.n // 16)]
    least = np.sqrt(np.diag(bound(SYSTEM, along, rounding=True).covariance)[:2])
    return Result(case, track, errors, truth - truth[0], least, rate)


def shares(track: Track) -> tuple[float, ...]:
    """Per cent of the frames tracked, refitted, begun cold, and without a position."""
    cold = track.flags & np.uint32(Flag.COLD_START) != 0
    fitted = (track.flags & np.uint32(Flag.REFITTED) != 0) & ~cold
    parts = (track.ok & ~cold & ~fitted, track.ok & fitted, track.ok & cold, ~track.ok)
    return tuple(100 * float(part.mean()) for part in parts)


def grid(cases: list[Case], seed: int) -> list[Result]:
    """Track all cases, one line for each."""
    print(
        f"\n{'':30}{'exposure':>9}|{'frames, %':^28}|{'':7}|{'error / bound':^15}|"
        f"{'density / bound at':^37}|{'lines':>8}|{'amplitude, rel.':^18}\n"
        f"{'amplitude':>10}{'Hz':>6}{'um/frame':>9}{'n':>5}{'max, us':>9}|"
        f"{'tracked':>8}{'refit':>7}{'cold':>6}{'lost':>7}|{'1/s':>7}|{'rms':>7}{'largest':>8}|"
        f"{'f':>7}{'2 f':>7}{'3 f':>7}{'median':>8}{'most':>8}|{'chance':>8}|"
        f"{'error':>9}{'bound':>9}"
    )
    results = []
    for k, case in enumerate(cases):
        result = observe(case, seed + k)
        marks = result.marks(CHANCE / len(cases))
        print(_row(result), f"  NOT AT THE BOUND: {', '.join(marks)}" if marks else "", flush=True)
        results.append(result)
    marked = sum(bool(r.marks(CHANCE / len(cases))) for r in results)
    verdict("cases not at the bound", marked, 0)
    return results


def _row(result: Result) -> str:
    case = result.case
    tracked, refitted, cold, lost = shares(result.track)
    at, power = result.at_harmonics(), result.spectrum()[1]
    gain, allowed = result.gain()
    exposure_us = 1e6 * min(1 / RATE_HZ, NO_SMEAR_UM / case.peak_um_per_s)
    return (
        f"{_length(case.amplitude_um):>10}{case.hz:>6g}{case.peak_um_per_s / RATE_HZ:>9.2g}"
        f"{case.n:>5}{exposure_us:>9.4g}|"
        f"{tracked:>8.1f}{refitted:>7.1f}{cold:>6.1f}{lost:>7.1f}|{result.rate:>7.0f}|"
        f"{np.sqrt((result.scaled**2).mean()):>7.3f}{np.abs(result.scaled).max():>8.2f}|"
        f"{at[0]:>7.2f}{at[1]:>7.2f}{at[2]:>7.2f}{result.median():>8.3f}"
        f"{np.sqrt(power[1:-1].max()):>8.2f}|{result.lines():>8.2g}|{gain:>9.1e}{allowed:>9.1e}"
    )


def _length(um: float) -> str:
    for unit, size in (("mm", 1e3), ("um", 1.0), ("nm", 1e-3)):
        if um >= size:
            return f"{um / size:g} {unit}"
    return f"{um * 1e6:g} pm"


def conclude(results: list[Result]) -> None:
    """All cases together."""
    scaled = np.concatenate([r.scaled for r in results])
    lost = sum(int((~r.track.ok).sum()) for r in results)
    ratio = np.sqrt((scaled**2).mean())
    at = np.concatenate([r.at_harmonics() for r in results])
    lines = stats.kstest([r.lines() for r in results], "uniform").pvalue
    print(f"\nall {len(scaled)} frames of {len(results)} cases")
    print(f"  error / bound {ratio:.4f} +- {ratio / np.sqrt(2 * scaled.size):.4f}")
    print(f"  density / bound at f, 2 f, 3 f: rms {np.sqrt((at**2).mean()):.3f}")
    print(f"  probability that the chances of the lines are even, as for none: {lines:.2g}")
    verdict("frames without a position", lost, 0)
    verdict("error / bound", ratio, RATIO_LIMIT)


def plot(results: list[Result], path: Path) -> None:
    """Amplitude densities of the errors, one panel for each amplitude."""
    amplitudes = sorted({r.case.amplitude_um for r in results})
    columns = 3 if len(amplitudes) > 4 else 2
    rows = math.ceil(len(amplitudes) / columns)
    figure = Figure(figsize=(4.4 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    frequencies = sorted({r.case.hz for r in results})
    colours = dict(zip(frequencies, _colours(len(frequencies)), strict=True))
    for panel, amplitude in zip(panels.flat, amplitudes, strict=False):
        for r in (r for r in results if r.case.amplitude_um == amplitude):
            f, power, _ = r.spectrum()
            pm = 1e6 * np.sqrt((r.least**2).mean() * 2 / RATE_HZ)
            colour = colours[r.case.hz]
            panel.loglog(f[1:-1], pm * np.sqrt(power[1:-1]), lw=0.8, color=colour)
            panel.axvline(r.case.hz, color=colour, lw=0.8, ls=":")
        panel.axhline(pm, color="black", lw=1.2)
        panel.set_title(f"sine of {_length(amplitude)}", fontsize=10)
        panel.grid(alpha=0.3, which="both")
    panels[0, 0].set_ylim(bottom=5, top=max(200, panels[0, 0].get_ylim()[1]))
    for panel in panels.flat[len(amplitudes) :]:
        panel.set_visible(False)
    for panel in panels[:, 0]:
        panel.set_ylabel("error of x and y,\nrms, pm / sqrt(Hz)")
    for panel in (*panels[-1], *panels.flat[len(amplitudes) - columns : len(amplitudes)]):
        panel.set_xlabel("frequency, Hz")
        panel.xaxis.set_tick_params(labelbottom=True)
    axes = panels[0, 0]
    axes.plot([], [], color="black", lw=1.2, label="bound")
    for hz, colour in colours.items():
        axes.plot([], [], color=colour, lw=0.8, label=f"motion at {hz:g} Hz (dotted line)")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.savefig(path, dpi=120)


def _colours(n: int) -> np.ndarray:
    from matplotlib import colormaps

    return np.asarray(colormaps["viridis"](np.linspace(0, 0.85, n)))


# ------------------------------------------------------------------------- smear


def smeared(case: Case, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Frames exposed for the whole of the interval, and the mean position (2,) during it."""
    start = parse_pose(SYSTEM, START, "start")
    rng = np.random.default_rng(seed)
    node, weight = np.polynomial.legendre.leggauss(9)
    for k in range(case.n):
        moved = case.motion.at((k + node / 2) / RATE_HZ, rng)
        images = (model_image(SYSTEM, start.moved(*step).projection) for step in moved)
        expected = sum(w / 2 * image for w, image in zip(weight, images, strict=True))
        place = weight / 2 @ moved[:, :2]
        yield add_noise(expected, SYSTEM, rng), np.array(START[:2]) + place


def smear(options: argparse.Namespace) -> None:
    """What tracking says of images that are smeared."""
    print(
        f"\nexposed for all of 1/{RATE_HZ:g} s, 10.3 Hz; position: mean over the exposure\n"
        f"{'smear,':>10}{'error/bound':>12}{'error / stated sigma':^29}{'chi2/ndf':^19}"
        f"{'blur, um':>12}  flags, % of the frames\n"
        f"{'um':>10}{'rms':>12}{'rms':>9}{'largest':>9}{'unflagged':>11}{'mean':>10}{'largest':>9}"
    )
    for k, length_um in enumerate(SMEARS_UM):
        hz = 10.3
        amplitude_um = length_um * RATE_HZ / (2 * math.pi * hz)
        case = Case(amplitude_um, hz, options.smear_n)
        made = shown(smeared(case, options.seed + k), f"smear {length_um:g} um", case.n)
        frames, truth = zip(*made, strict=True)
        track = Tracker(SYSTEM).run(frames, (np.arange(case.n) / RATE_HZ).tolist())
        errors = (values(track)[:, :2] - truth)[track.ok]
        least = np.sqrt(np.diag(bound(SYSTEM, START, rounding=True).covariance)[:2])
        pulls = errors / np.stack([track.sigma_x_um, track.sigma_y_um], axis=1)[track.ok]
        # what says of a frame that it is unlike the others; being tracked anew does not
        usual = np.uint32(Flag.COLD_START | Flag.REFITTED | Flag.MOVED)
        unflagged = (track.flags & ~usual == 0)[track.ok]
        flagged = {
            flag.name.lower(): 100 * track.count(flag) / len(track)
            for flag in Flag
            if flag.name and track.count(flag)
        }
        blur = track.blur_um[track.ok]
        print(
            f"{length_um:>10g}{np.sqrt(((errors / least) ** 2).mean()):>12.2f}"
            f"{np.sqrt((pulls**2).mean()):>9.2f}{np.abs(pulls).max():>9.1f}"
            f"{np.abs(pulls[unflagged]).max(initial=0):>11.1f}"
            f"{np.nanmean(track.chi2_ndf):>10.3f}{np.nanmax(track.chi2_ndf):>9.3f}"
            f"{blur.min():>7.2f}..{blur.max():<5.2f}  "
            + ", ".join(f"{name} {share:.0f}" for name, share in flagged.items()),
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-n", type=int, help="frames of a case at least; default 384, full 2048")
    parser.add_argument("--exact-n", type=int, default=200, help="frames of an exact case; 0: none")
    parser.add_argument("--smear-n", type=int, default=60, help="smeared frames; 0: none")
    parser.add_argument("--full", action="store_true", help="finer grid, longer sequences")
    parser.add_argument("--amplitude", type=float, nargs="+", metavar="UM", help="instead")
    parser.add_argument("--hz", type=float, nargs="+", help="instead")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, default=Path("build/tracking"), metavar="DIR")
    options = parser.parse_args()
    if min(options.n or 32, options.exact_n or 32) < 32:
        parser.error("a spectrum needs 32 frames")
    options.output.mkdir(parents=True, exist_ok=True)
    amplitudes = options.amplitude or (FULL_AMPLITUDES_UM if options.full else AMPLITUDES_UM)
    frequencies = options.hz or (FULL_FREQUENCIES_HZ if options.full else FREQUENCIES_HZ)
    least = options.n or (2048 if options.full else 384)
    print(_study.environment(), f"seed {options.seed}", sep="\n")
    warm_up()
    # Half a period at least, which is the way from end to end.
    cases = [
        Case(amplitude, hz, max(least, math.ceil(RATE_HZ / hz / (1 if options.full else 2))))
        for amplitude in amplitudes
        for hz in frequencies
    ]
    results = grid(cases, options.seed)
    conclude(results)
    path = options.output / "tracking-motion.png"
    plot(results, path)
    print(f"  plot: {path}")
    if options.exact_n:
        print("\nimages of the exact generator")
        grid([Case(a, hz, options.exact_n, "exact") for a, hz in EXACT_CASES], options.seed)
    if options.smear_n:
        smear(options)


if __name__ == "__main__":
    main()
