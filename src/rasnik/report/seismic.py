"""Seismometers as plots: the self-noise budget, ground motion, a ring-down."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rasnik.characterisation.spectrum import Spectrum, welch
from rasnik.report.numbers import with_sigma
from rasnik.seismic.budget import SelfNoise
from rasnik.seismic.ground import GroundMotion, readout_asd
from rasnik.seismic.noise_models import noise_model
from rasnik.seismic.ring_down import RingDown
from rasnik.seismic.suspension import Suspension

__all__ = [
    "budget_figure",
    "draw_budget",
    "draw_ground",
    "draw_ring_down",
    "ground_figure",
    "ring_down_figure",
]

_DPI = 110
#: Colours of Okabe and Ito, which the colour-blind tell apart; in print the dashes do it.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_DASHES = ((0, (5, 1.2)), (0, (1.5, 1)), (0, (6, 1, 1.5, 1)), (0, (3, 1, 1, 1, 1, 1)))
_MODELS = (("low", "NLNM"), ("high", "NHNM"))
_MOST_POINTS = 4000
_UNITS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}
_METRES = {"nm": 1e-9, "um": 1e-6, "µm": 1e-6, "mm": 1e-3, "m": 1.0}


def draw_budget(found: SelfNoise, path: str | os.PathLike[str]) -> None:
    """Write the plot of a budget to a file; its suffix chooses the format."""
    budget_figure(found).savefig(path)


def draw_ground(
    motions: Mapping[str, GroundMotion],
    suspension: Suspension,
    path: str | os.PathLike[str],
    *,
    sigmas: Mapping[str, float] | None = None,
    title: str = "",
) -> None:
    """Write the plot of ground motions to a file; its suffix chooses the format."""
    ground_figure(motions, suspension, sigmas=sigmas, title=title).savefig(path)


def draw_ring_down(found: RingDown, path: str | os.PathLike[str], *, title: str = "") -> None:
    """Write the plot of a ring-down to a file; its suffix chooses the format."""
    ring_down_figure(found, title=title).savefig(path)


# ------------------------------------------------------------------------ budget


def budget_figure(found: SelfNoise) -> Figure:
    """The terms and their sum as acceleration of the ground, beside the noise models."""
    figure = Figure(figsize=(9.5, 7.2), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _draw_models(axes, found.frequency_hz, "acceleration")
    for k, term in enumerate(found.terms):
        axes.plot(
            found.frequency_hz, term.asd, color=_COLOURS[k % len(_COLOURS)], linewidth=1.3,
            linestyle=_DASHES[k % len(_DASHES)], label=f"{term.name}: {term.source}",
        )  # fmt: skip
    axes.plot(found.frequency_hz, found.total, color="black", linewidth=2, label="self-noise")
    for low, high in found.quiet_hz:
        axes.axvspan(low, high, color="#009e73", alpha=0.08, linewidth=0)
    _finish(axes, "acceleration")
    suspension = found.suspension
    mass = f", {suspension.mass_kg:g} kg" if suspension.mass_kg else ""
    quiet = ", ".join(f"{low:.3g} to {high:.3g} Hz" for low, high in found.quiet_hz) or "nowhere"
    left_out = "".join(f"\nnot counted: {one.partition(':')[0]}" for one in found.not_counted)
    axes.set_title(
        f"{found.system.name} reading a mass of f0 = {suspension.frequency_hz:g} Hz, "
        f"Q = {suspension.q:g}{mass}, along {found.axis}\n"
        f"self-noise below the low-noise model (shaded): {quiet}{left_out}",
        fontsize=10,
    )
    # The dips at the resonance go as deep as Q is high, and tell nothing.
    axes.set_ylim(bottom=0.03 * float(found.total.min()))
    figure.legend(fontsize=8.5, loc="outside lower center", ncols=2, frameon=False)
    return figure


# ------------------------------------------------------------------------ ground motion


def ground_figure(
    motions: Mapping[str, GroundMotion],
    suspension: Suspension,
    *,
    sigmas: Mapping[str, float] | None = None,
    title: str = "",
) -> Figure:
    """Every motion in time, then their spectra beside the noise of the readings and the models.

    Parameters
    ----------
    motions : mapping of str to GroundMotion
        By their names, as "x"; of one quantity.
    suspension : Suspension
    sigmas : mapping of str to float, optional
        Noise of one reading, in the unit of the readings.
    title : str
    """
    if not motions:
        raise ValueError("there is nothing to plot")
    rows = len(motions)
    figure = Figure(figsize=(9.5, 2.2 * rows + 5), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(rows + 1, 1, height_ratios=[2.2] * rows + [5])
    bottom = figure.add_subplot(grid[rows])
    quantity = next(iter(motions.values())).quantity
    spectra = []
    for k, (name, motion) in enumerate(motions.items()):
        _draw_motion(figure.add_subplot(grid[k]), name, motion, _COLOURS[k % len(_COLOURS)])
        longest_s = max(len(run) for run in motion.runs()) / motion.rate_hz
        try:  # windows that hold a few periods of the lowest frequency, where there are any
            window_s = min(4 / motion.band_hz[0], longest_s)
            spectra.append((k, name, motion, welch(motion, length_s=window_s)))
        except ValueError:  # too short for a spectrum; the motion itself is drawn
            continue
    low, high = next(iter(motions.values())).corners_hz[::3]
    _draw_models(bottom, np.geomspace(low, high, 400), quantity)
    for k, name, motion, spectrum in spectra:
        sigma = (sigmas or {}).get(name, math.nan)
        _draw_spectrum(bottom, name, motion, spectrum, suspension, sigma, _COLOURS[k])
    if not spectra:
        bottom.text(0.5, 0.9, "too short for a spectrum", transform=bottom.transAxes, ha="center")
    band = next(iter(motions.values())).band_hz
    bottom.axvspan(*band, color="#888888", alpha=0.1, linewidth=0, label="band")
    bottom.set_xlim(low, high)
    _finish(bottom, quantity)
    bottom.legend(fontsize=8.5, loc="best")
    figure.suptitle(
        f"{title + ': ' if title else ''}ground {quantity}, {band[0]:g} to {band[1]:g} Hz, mass "
        f"of f0 = {suspension.frequency_hz:g} Hz, Q = {suspension.q:g}",
        fontsize=10.5,
    )
    return figure


def _draw_motion(axes: Axes, name: str, motion: GroundMotion, colour: str) -> None:
    time_s = motion.start_s + np.arange(len(motion)) / motion.rate_hz
    label = f"± {motion.sigma:.2g} {motion.unit}" if math.isfinite(motion.sigma) else ""
    axes.plot(*_thinned(time_s, motion.values), color=colour, linewidth=0.8, label=label)
    axes.set_ylabel(f"{name}, {motion.unit}")
    axes.set_xlabel("time, s")
    if label:
        axes.legend(fontsize=8.5, loc="upper right", title="noise of the reading", title_fontsize=8)
    axes.grid(color="#e4e4e4")
    axes.set_axisbelow(True)


def _draw_spectrum(
    axes: Axes,
    name: str,
    motion: GroundMotion,
    spectrum: Spectrum,
    suspension: Suspension,
    sigma: float,
    colour: str,
) -> None:
    """The spectrum of a motion and the noise of its readings, where the taper lets them."""
    metres = _METRES[motion.unit.partition("/")[0]]
    inside = (spectrum.frequency_hz > motion.corners_hz[0]) & (
        spectrum.frequency_hz < motion.corners_hz[3]
    )
    f_hz = spectrum.frequency_hz[inside]
    axes.plot(f_hz, spectrum.asd[inside] * metres, color=colour, linewidth=1, label=name)
    if math.isfinite(sigma):
        f_hz = np.geomspace(*motion.corners_hz[::3], 400)
        noise = readout_asd(
            f_hz, sigma * metres, motion.rate_hz, suspension, motion.quantity,
            exposure_s=motion.exposure_s,
        )  # fmt: skip
        axes.plot(
            f_hz, noise, color=colour, linestyle=_DASHES[0], linewidth=1.2,
            label=f"{name}: noise of the readings",
        )  # fmt: skip


# ------------------------------------------------------------------------ ring-down


def ring_down_figure(found: RingDown, *, title: str = "") -> Figure:
    """The readings with the fitted decay, and what remains."""
    figure = Figure(figsize=(9.5, 6), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
    series = found.series
    time_s = np.arange(len(series)) / series.rate_hz
    fitted = found.values(time_s)
    steady = found.offset + found.drift * time_s
    decay = found.amplitude * np.exp(-np.pi * found.frequency_hz * found.loss * time_s)
    shown = series.start_s + time_s
    thin = _thinned(shown, series.values - found.offset)
    above.plot(*thin, color=_COLOURS[0], linewidth=0.7, label="readings")
    for sign in (1, -1):
        above.plot(
            shown, steady - found.offset + sign * decay, color=_COLOURS[1], linewidth=1.2,
            label="fitted decay" if sign > 0 else None,
        )  # fmt: skip
    below.plot(*_thinned(shown, series.values - fitted), color=_COLOURS[0], linewidth=0.6)
    above.set_ylabel(f"reading less {found.offset:.10g} {series.unit}, {series.unit}")
    below.set_ylabel(f"remainder, {series.unit}")
    below.set_xlabel("time, s")
    sigmas = found.sigmas
    q = (
        f"Q = {with_sigma(found.q, found.sigma_q)}"
        if found.decays
        else f"Q above {found.least_q:.3g} (95 %)"
    )
    text = f"f0 = {with_sigma(found.frequency_hz, float(sigmas[0]))} Hz, {q}"
    head = f"{title}: " if title else ""
    remarks = "".join(f"\n{one.partition(':')[0]}" for one in found.remarks)
    above.set_title(f"{head}free decay, {text}{remarks}", fontsize=10)
    above.legend(fontsize=8.5, loc="upper right")
    for axes in (above, below):
        axes.grid(color="#e4e4e4")
        axes.set_axisbelow(True)
    return figure


# ------------------------------------------------------------------------ common


def _draw_models(axes: Axes, frequency_hz: NDArray[np.float64], quantity: str) -> None:
    for model, name in _MODELS:
        asd = np.sqrt(noise_model(frequency_hz, model, quantity))  # type: ignore[arg-type]
        if np.isfinite(asd).any():
            axes.plot(
                frequency_hz, asd, color="#777777", linewidth=1.6,
                linestyle="-" if model == "low" else ":", label=f"{name} (Peterson 1993)",
            )  # fmt: skip


def _thinned(
    time_s: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and greatest value in each of many steps; a step without any is a gap."""
    step = -(-len(values) // (_MOST_POINTS // 2))
    if step <= 1:
        return time_s, values
    whole = len(values) // step * step
    parts = values[:whole].reshape(-1, step)
    known = np.isfinite(parts)
    least = np.where(known, parts, np.inf).min(axis=1)
    most = np.where(known, parts, -np.inf).max(axis=1)
    both = np.stack([least, most], axis=1).ravel()
    return np.repeat(time_s[:whole:step], 2), np.where(np.isfinite(both), both, np.nan)


def _finish(axes: Axes, quantity: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel(
        f"ground {quantity}\namplitude spectral density, {_UNITS[quantity]}/√Hz, one-sided"
    )
    axes.grid(which="major", color="#dcdcdc")
    axes.set_axisbelow(True)
