"""Resolution as a plot: the estimates of every order beside stated error and bound."""

from __future__ import annotations

import os

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rasnik.characterisation.resolution import Resolution, Scatter
from rasnik.report.numbers import with_sigma

__all__ = ["plot_resolution", "resolution_figure"]

_DPI = 110
_COLOUR, _CHOSEN = "#2f6fb3", "#d1762b"
_NAMES = {"x": "x", "y": "y", "scale": "scale S", "theta": "theta_z"}
_SHOWN = {"nm": ("nm", 1.0), "rad": ("µrad", 1e6), "": ("1e-6", 1e6)}


def plot_resolution(found: Resolution, path: str | os.PathLike[str], *, title: str = "") -> None:
    """Write the plot to a file; its suffix chooses the format.

    Raises
    ------
    ValueError
        If the suffix is not known.
    OSError
        If the file cannot be written.
    """
    resolution_figure(found, title=title).savefig(path)


def resolution_figure(found: Resolution, *, title: str = "") -> Figure:
    """One panel for each coordinate: what the differences of every order see."""
    figure = Figure(figsize=(9.5, 7.2), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, one in zip(figure.subplots(2, 2).flat, found.scatters.values(), strict=True):
        _draw(axes, one)
    head = f"{title}: " if title else ""
    figure.suptitle(f"{head}scatter of a single frame, from {found.frames:,} frames")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _draw(axes, one: Scatter) -> None:  # type: ignore[no-untyped-def]
    unit, factor = _SHOWN[one.unit]
    orders = np.arange(len(one.by_order))
    values, errors = np.array(one.by_order) * factor, np.array(one.by_order_error) * factor
    axes.errorbar(
        orders, values, errors, fmt="o", color=_COLOUR, capsize=4, label="estimate ± 1 sigma"
    )
    axes.plot(
        one.order, values[one.order], "s", markersize=13, fillstyle="none", color=_CHOSEN,
        markeredgewidth=1.8, label="taken as the resolution",
    )  # fmt: skip
    for level, style, label in (
        (one.stated, "--", "stated with the poses"),
        (one.bound, ":", "Cramer-Rao bound"),
    ):
        if level > 0:
            axes.axhline(level * factor, color="black", linestyle=style, linewidth=1.2, label=label)
    if values.max() > 5 * values.min() > 0:
        axes.set_yscale("log")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("order of the differences (0: about the mean)")
    axes.set_ylabel(f"standard deviation, {unit}")
    sigma, error = one.sigma * factor, one.sigma_error * factor
    moved = ", the scene moved" if one.moved else ""
    figure = f"({with_sigma(sigma, error)}) {unit}"
    axes.set_title(f"{_NAMES[one.name]}: {figure}{moved}", fontsize=10)
    axes.grid(color="#e4e4e4")
    axes.set_axisbelow(True)
