"""Spectra as a plot: any number of tracks and columns, their floors, lines and bounds."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rasnik.characterisation.lines import Line
from rasnik.characterisation.spectrum import Coherence
from rasnik.characterisation.track_spectrum import TrackSpectrum
from rasnik.report.numbers import rounded, with_sigma

__all__ = ["plot_spectra", "shown_unit", "spectra_figure"]

_DPI = 110
#: Colours of Okabe and Ito, which the colour-blind tell apart, dark ones first; in print the
#: dashes do it.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9")
_DASHES = ("-", (0, (5, 1.2)), (0, (1.5, 1)), (0, (6, 1, 1.5, 1)))
_MOST_POINTS = 3000
_MOST_NAMED = 8
_CONVENTION = (
    "One-sided spectra: white noise of sigma per frame at f frames/s lies at sigma √(2/f). "
    "The paper quotes sigma/√f, smaller by √2."
)
_SYMBOLS = {
    "x_um": "x",
    "y_um": "y",
    "scale": "scale S",
    "theta_rad": "theta_z",
    "blur_um": "blur",
    "dark_level": "dark level",
    "light_level": "light level",
}
_STEPS = {
    "nm": ((1e3, "µm"), (1.0, "nm"), (1e-3, "pm"), (1e-6, "fm")),
    "rad": ((1.0, "rad"), (1e-3, "mrad"), (1e-6, "µrad"), (1e-9, "nrad"), (1e-12, "prad")),
    "": ((1.0, ""), (1e-3, "1e-3"), (1e-6, "1e-6"), (1e-9, "1e-9")),
}


def shown_unit(unit: str, size: float) -> tuple[str, float]:
    """(unit, factor to it) in which a value reads well: pm rather than 0.033 nm."""
    for step, name in _STEPS.get(unit, ((1.0, unit),)):
        if abs(size) >= step:
            return name, 1 / step
    step, name = _STEPS.get(unit, ((1.0, unit),))[-1]
    return name, 1 / step


def plot_spectra(
    found: Sequence[TrackSpectrum],
    path: str | os.PathLike[str],
    *,
    coherences: Sequence[tuple[str, Coherence]] = (),
    logarithmic: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]] = (),
    title: str = "",
) -> None:
    """Write the plot to a file; its suffix chooses the format. See `spectra_figure`.

    Raises
    ------
    ValueError
        If there is nothing to plot, or the suffix is not known.
    OSError
        If the file cannot be written.
    """
    spectra_figure(found, coherences=coherences, logarithmic=logarithmic, title=title).savefig(path)


def spectra_figure(
    found: Sequence[TrackSpectrum],
    *,
    coherences: Sequence[tuple[str, Coherence]] = (),
    logarithmic: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]] = (),
    title: str = "",
) -> Figure:
    """One panel of spectra for each unit, then integrated rms, Allan deviation and coherence.

    Parameters
    ----------
    found : sequence of TrackSpectrum
    coherences : sequence of (str, Coherence)
        With what is coherent.
    logarithmic : sequence of (frequency_hz, psd)
        Spectra at logarithmic frequencies to draw instead, one for each of `found`.
    title : str
    """
    if not found:
        raise ValueError("there is nothing to plot")
    units = list(dict.fromkeys(one.spectrum.unit for one in found))
    rows = [("spectrum", u) for u in units] + [("below", u) for u in units]
    if coherences:
        rows.append(("coherence", ""))
    heights = [{"spectrum": 5.0, "below": 2.9, "coherence": 2.4}[kind] for kind, _ in rows]
    figure = Figure(figsize=(10, 0.9 + sum(heights)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(len(rows), 2, height_ratios=heights)
    for row, (kind, unit) in enumerate(rows):
        own = [(k, one) for k, one in enumerate(found) if one.spectrum.unit == unit]
        if kind == "spectrum":
            _draw_spectra(figure.add_subplot(grid[row, :]), own, logarithmic)
        elif kind == "below":
            _draw_rms(figure.add_subplot(grid[row, 0]), own)
            _draw_allan(figure.add_subplot(grid[row, 1]), own)
        else:
            _draw_coherences(figure.add_subplot(grid[row, :]), coherences)
    head = f"{title}\n" if title else ""
    figure.suptitle(f"{head}{_CONVENTION}", fontsize=10)
    return figure


def _style(k: int) -> dict[str, Any]:
    return {
        "color": _COLOURS[k % len(_COLOURS)],
        "linestyle": _DASHES[k % len(_DASHES)],
    }


def _name(one: TrackSpectrum) -> str:
    symbol = _SYMBOLS.get(one.spectrum.name, one.spectrum.name)
    return f"{one.label} {symbol}".strip()


def _rthz(unit: str) -> str:
    return f"{unit}/√Hz" if unit else "1/√Hz"


def _draw_spectra(
    axes: Axes,
    own: list[tuple[int, TrackSpectrum]],
    logarithmic: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> None:
    typical = [one.floor.asd if one.floor else float(np.median(one.spectrum.asd)) for _, one in own]
    unit, factor = shown_unit(own[0][1].spectrum.unit, min(typical))
    bounds: dict[float, float] = {}
    lowest = math.inf
    for k, one in own:
        frequency_hz, asd = one.spectrum.frequency_hz, one.spectrum.asd
        if logarithmic:
            frequency_hz, asd = logarithmic[k][0], np.sqrt(logarithmic[k][1])
        inside = frequency_hz > 0
        low, high = _thinned(frequency_hz[inside], asd[inside] * factor)
        label = _name(one)
        if one.floor is not None:
            value, sigma = one.floor.asd * factor, one.floor.sigma * factor
            label += (
                f": floor {with_sigma(value, sigma)} {_rthz(unit)}, "
                f"{one.floor.low_hz:.3g} to {one.floor.high_hz:.4g} Hz "
                f"(sigma/√f: {one.floor.as_paper * factor:.4g})"
            )
            axes.plot(
                [one.floor.low_hz, one.floor.high_hz], [value, value],
                color="black", linewidth=1.6, zorder=4,
            )  # fmt: skip
        axes.plot(low, high, linewidth=0.9, label=label, **_style(k))
        lowest = min(lowest, float(np.quantile(asd[inside], 0.01)) * factor)
        if math.isfinite(one.bound):
            bounds.setdefault(float(f"{one.bound_asd * factor:.3g}"), one.spectrum.rate_hz)
    for value, rate_hz in bounds.items():
        axes.axhline(
            value, color="black", linestyle=":", linewidth=1.3,
            label=f"Cramer-Rao bound at {rate_hz:g} frames/s: {value:g} {_rthz(unit)}",
        )  # fmt: skip
        lowest = min(lowest, value)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.6 * lowest)
    _name_lines(axes, own, factor)
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel(f"amplitude spectral density\n{_rthz(unit)}, one-sided")
    axes.legend(fontsize=8.5, loc="upper right")
    _finish(axes)


def _thinned(
    frequency_hz: NDArray[np.float64], asd: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and greatest value in each of many steps of the logarithm: no line is lost."""
    if len(asd) <= _MOST_POINTS:
        return frequency_hz, asd
    edges = np.geomspace(frequency_hz[0], frequency_hz[-1], _MOST_POINTS // 2)
    starts = np.unique(np.searchsorted(frequency_hz, edges[:-1]))
    shown = frequency_hz[starts]
    both = np.stack([np.minimum.reduceat(asd, starts), np.maximum.reduceat(asd, starts)], axis=1)
    return np.repeat(shown, 2), both.ravel()


def _name_lines(axes: Axes, own: list[tuple[int, TrackSpectrum]], factor: float) -> None:
    """Frequencies beside the strongest lines; mains in words."""
    every = [(line, one) for _, one in own for line in one.lines]
    every.sort(key=lambda pair: -pair[0].significance)
    named: list[float] = []
    for line, one in every:
        if len(named) == _MOST_NAMED:
            break
        if any(abs(math.log(line.frequency_hz / other)) < 0.03 for other in named):
            continue
        named.append(line.frequency_hz)
        tops = [_highest(other, line) for _, other in own]
        text = f"{float(rounded(line.frequency_hz, one.spectrum.resolution_hz / 5, 1)):g} Hz"
        if line.name:
            text += " mains" + ("\n(alias)" if line.name.startswith("alias") else "")
        axes.annotate(
            text, (line.frequency_hz, max(tops) * factor), xytext=(0, 4),
            textcoords="offset points", fontsize=7.5, rotation=90, ha="center", va="bottom",
        )  # fmt: skip
    bottom, top = axes.get_ylim()  # room for the names, or for the legend
    axes.set_ylim(bottom, top * (top / bottom) ** 0.45 if named else 5 * top)


def _highest(one: TrackSpectrum, line: Line) -> float:
    """Of a spectrum near a line; 0 where it does not reach."""
    frequency_hz = one.spectrum.frequency_hz
    reach_hz = 3 * one.spectrum.resolution_hz
    near = (frequency_hz >= line.low_hz - reach_hz) & (frequency_hz <= line.high_hz + reach_hz)
    return float(one.spectrum.asd[near].max(initial=0.0))


def _draw_rms(axes: Axes, own: list[tuple[int, TrackSpectrum]]) -> None:
    unit, factor = shown_unit(own[0][1].spectrum.unit, max(one.spectrum.rms() for _, one in own))
    for k, one in own:
        spectrum = one.spectrum
        inside = spectrum.frequency_hz > 0
        axes.plot(
            spectrum.frequency_hz[inside], spectrum.cumulative_rms[inside] * factor,
            linewidth=1.2, label=_name(one), **_style(k),
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel(f"rms above it, {unit or 'ratio'}")
    axes.set_title("integrated from the highest frequency", fontsize=9.5)
    _finish(axes)


def _draw_allan(axes: Axes, own: list[tuple[int, TrackSpectrum]]) -> None:
    shown = [(k, one.allan, one) for k, one in own if one.allan is not None]
    axes.set_title("overlapping Allan deviation", fontsize=9.5)
    if not shown:
        axes.text(0.5, 0.5, "not defined for irregular times", ha="center", va="center")
        axes.set_axis_off()
        return
    unit, factor = shown_unit(
        own[0][1].spectrum.unit, max(float(found.deviation.max()) for _, found, _ in shown)
    )
    for k, found, one in shown:
        axes.errorbar(
            found.tau_s, found.deviation * factor, found.error * factor,
            linewidth=1.0, elinewidth=0.8, marker="o", markersize=2.5,
                label=_name(one), **_style(k),
        )  # fmt: skip
        if math.isfinite(one.bound):
            white = one.bound * factor / np.sqrt(found.tau_s * one.spectrum.rate_hz)
            axes.plot(found.tau_s, white, ":", color="black", linewidth=1.2)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("averaging time, s" + (" (dotted: bound)" if shown else ""))
    axes.set_ylabel(f"deviation, {unit or 'ratio'}")
    _finish(axes)


def _draw_coherences(axes: Axes, coherences: Sequence[tuple[str, Coherence]]) -> None:
    for k, (name, one) in enumerate(coherences):
        inside = one.frequency_hz > 0
        label = f"{name}; noise exceeds {one.threshold():.2g} in 1 % of bins"
        axes.plot(
            one.frequency_hz[inside], one.coherence[inside], linewidth=0.8, label=label, **_style(k)
        )
        axes.axhline(one.threshold(), color="black", linestyle=":", linewidth=1)
    axes.set_xscale("log")
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel("coherence\n(magnitude squared)")
    axes.legend(fontsize=8.5)
    _finish(axes)


def _finish(axes: Axes) -> None:
    axes.grid(which="major", color="#dcdcdc")
    axes.set_axisbelow(True)
