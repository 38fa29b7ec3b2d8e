"""Linearity as plots: error along simulated scans, and periodic errors of a real track."""

from __future__ import annotations

import math
import os

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rasnik.characterisation.folding import Fold, Folding
from rasnik.characterisation.linearity import Linearity, MethodError, Scan

__all__ = ["folding_figure", "linearity_figure", "plot_folding", "plot_linearity"]

_DPI = 110
_COLOUR, _GREY = "#2f6fb3", "#b5b5b5"
#: Colour, line and point of each method; without colours, line and point tell them apart.
_METHODS = {
    "likelihood": ("#2f6fb3", "-", "o"),
    "fourier": ("#d1762b", "--", "s"),
    "tracker": ("#4f8a4f", ":", "^"),
}
_PATHS = {"exact": "exact frames", "paper": "frames of the paper's generator"}


def plot_linearity(found: Linearity, path: str | os.PathLike[str]) -> None:
    """Write the plot of simulated scans to a file; its suffix chooses the format.

    Raises
    ------
    ValueError
        If the suffix is not known.
    OSError
        If the file cannot be written.
    """
    linearity_figure(found).savefig(path)


def linearity_figure(found: Linearity) -> Figure:
    """One panel for each scan: error against position, for each method."""
    scans: dict[Scan, list[MethodError]] = {}
    for one in found.errors:
        scans.setdefault(one.scan, []).append(one)
    columns = min(len(scans), 2)
    rows = math.ceil(len(scans) / columns)
    figure = Figure(figsize=(5.2 * columns, 1.1 + 3.3 * rows), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (scan, errors) in zip(panels, scans.items(), strict=False):
        _draw_scan(axes, scan, errors)
    for axes in panels[len(scans) :]:
        axes.set_axis_off()
    levels = ", grey levels rounded" if found.rounded else ""
    effects = f", {', '.join(found.effects)}" if found.effects else ""
    figure.suptitle(
        f"{found.system.name}: linearity error of the analysis\n"
        f"{_PATHS.get(found.path, found.path)}, no noise{levels}{effects}"
    )
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _draw_scan(axes: Axes, scan: Scan, errors: list[MethodError]) -> None:
    wide = scan.range_um >= 1
    at = scan.offsets_um * (1 if wide else 1e3)
    largest = max((one.figures["largest_nm"] for one in errors), default=math.nan)
    unit, factor = ("pm", 1e3) if largest < 0.5 else ("nm", 1.0)
    for one in errors:
        colour, line, point = _METHODS[one.method]
        axes.plot(
            at, one.along_nm * factor, line, color=colour, marker=point, markersize=3.5,
            linewidth=1.2, label=one.method,
        )  # fmt: skip
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xlabel(f"true {scan.axis} from the start, {'µm' if wide else 'nm'}")
    axes.set_ylabel(f"found − true {scan.axis}, {unit}")
    axes.set_title(f"theta_z = {1e3 * scan.theta_rad:g} mrad", fontsize=10)
    axes.grid(color="#e4e4e4")
    axes.set_axisbelow(True)


def plot_folding(found: Folding, path: str | os.PathLike[str], *, title: str = "") -> None:
    """Write the plot of the periodic errors of a track to a file, as `plot_linearity`."""
    folding_figure(found, title=title).savefig(path)


def folding_figure(found: Folding, *, title: str = "") -> Figure:
    """For each period and axis: density of positions, and the error that follows from it."""
    if not found.folds:
        raise ValueError("there is nothing to plot: no period could be folded")
    names = list(dict.fromkeys(one.name for one in found.folds))
    figure = Figure(figsize=(10.4, 1.3 + 3.3 * len(names)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(names), 2, squeeze=False)
    for row, name in zip(panels, names, strict=True):
        for axes, axis in zip(row, "xy", strict=True):
            one = next((f for f in found.folds if (f.axis, f.name) == (axis, name)), None)
            if one is None:
                axes.set_axis_off()
            else:
                _draw_fold(axes, one)
    head = f"{title}: " if title else ""
    figure.suptitle(
        f"{head}periodic errors, from the density of {found.folds[0].points:,} positions"
    )
    handles, labels = [], []
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            if label not in labels:
                handles.append(handle)
                labels.append(label)
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _draw_fold(axes: Axes, one: Fold) -> None:
    position = np.append(one.position_um, one.period_um)
    error, sigma = (np.append(v, v[0]) for v in (one.error_nm, one.sigma_nm))
    behind = axes.twinx()
    edges = np.linspace(0, one.period_um, len(one.density) + 1)
    behind.stairs(
        100 * (one.density - 1), edges, color=_GREY, linewidth=1.2, label="density (right axis)"
    )
    orders = np.arange(1, len(one.coefficients) + 1)
    waves = np.exp(2j * np.pi / one.period_um * np.outer(orders, position))
    behind.plot(
        position, 200 * (one.coefficients @ waves).real, "--", color=_GREY, linewidth=1.2,
        label="density of the harmonics taken",
    )  # fmt: skip
    most = max(float(np.abs(one.density - 1).max()) * 250, 1e-6)
    behind.set_ylim(-most, most)
    behind.set_ylabel("density from even, %", color="#6a6a6a")
    axes.set_zorder(behind.get_zorder() + 1)  # the error is in front
    axes.set_frame_on(False)
    axes.fill_between(
        position, error - sigma, error + sigma, color=_COLOUR, alpha=0.25, linewidth=0,
        label="± 1 sigma",
    )  # fmt: skip
    axes.plot(position, error, color=_COLOUR, linewidth=1.6, label="error, measured − true")
    axes.axhline(0, color="black", linewidth=0.8)
    reach = 1.15 * float((np.abs(error) + sigma).max())
    axes.set_ylim(-reach, reach)
    axes.set_xlim(0, one.period_um)
    axes.set_xlabel(f"{one.axis} modulo {one.name}, µm")
    axes.set_ylabel(f"error of {one.axis}, nm")
    verdict = "detected" if one.detected else "not detected"
    if one.remark:
        verdict = "motion not wide enough" if not one.wide else "motion not even enough"
    axes.set_title(f"{one.axis} modulo {one.name}: p = {one.p_value:.2g}, {verdict}", fontsize=10)
