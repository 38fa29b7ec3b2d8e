"""Design curves and maps as plots."""

from __future__ import annotations

import os

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from rasnik.performance.coupling import EXTRA_KEYS
from rasnik.performance.design import FIGURES, Curve, Design, Variation

__all__ = ["curve_figure", "map_figure", "save_figure"]

_DPI = 110
_COLOUR, _SECOND, _THIRD = "#2f6fb3", "#d1762b", "#4f8a4f"

#: Names of what is varied most often.
_LABELS = {
    "mask.field_um": "side of a chess field, µm",
    "optics.wavelength_nm": "wavelength, nm",
    "optics.numerical_aperture": "numerical aperture",
    "optics.diaphragm_mm": "diaphragm, mm",
    "optics.scale": "scale (image / mask)",
    "optics.blur_um": "blur on the sensor, µm",
    "sensor.pixel_um": "pixel pitch, µm",
    "sensor.frame_rate_hz": "frame rate, Hz",
    "sensor.full_well_e": "full well, electrons",
    "sensor.area_mm2": "area of the sensor, mm²",
    "sensor.binning": "binning",
}


def curve_figure(design: Design, curve: Curve) -> Figure:
    """The figure of merit along one parameter, over contour length and contrast."""
    figure = _new((8.0, 6.6))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
    values = np.array(curve.variation.values, dtype=float)
    if curve.variation.whole:
        upper.plot(values, curve.figure, "o", color=_COLOUR)
    else:
        upper.plot(values, curve.figure, "-", marker=".", color=_COLOUR)
    upper.axvspan(*curve.wide, color=_COLOUR, alpha=0.1, label="within 5 % of the best")
    upper.plot(curve.optimum, curve.best, "o", color=_SECOND, markersize=8,
               label=f"best: {curve.best:.3g} at {curve.optimum:.3g}")  # fmt: skip
    upper.set_ylabel(FIGURES[design.figure])
    upper.set_title(_title(design))
    upper.legend(frameon=False)
    _scale(upper, "y", curve.figure)
    lower.plot(values, curve.contrast, color=_SECOND)
    lower.set_ylim(0, 1.05)
    lower.set_ylabel("contrast of the fields", color=_SECOND)
    other = lower.twinx()
    other.plot(values, curve.contour_mm, color=_THIRD, linestyle="--")
    other.set_ylim(0, 1.1 * float(np.nanmax(curve.contour_mm)))
    other.set_ylabel("contours in view\non the sensor, mm", color=_THIRD)
    lower.set_xlabel(_label(curve.variation))
    if curve.variation.logarithmic:
        upper.set_xscale("log")
        _plain_ticks(lower, "x")
    elif curve.variation.whole:
        lower.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in (upper, lower):
        axes.grid(color="#e4e4e4")
        axes.set_axisbelow(True)
    return figure


def map_figure(
    design: Design, first: Variation, second: Variation, figure: NDArray[np.float64]
) -> Figure:
    """The figure of merit over two parameters, with its contours and the best point."""
    drawing = _new((8.2, 6.2))
    axes = drawing.subplots()
    x, y = np.array(first.values, dtype=float), np.array(second.values, dtype=float)
    shown = np.ma.masked_invalid(figure)
    low, high = float(shown.min()), float(shown.max())
    norm = LogNorm(low, high) if low > 0 and high / low > 1.001 else None
    mesh = axes.pcolormesh(x, y, shown, shading="nearest", norm=norm, cmap="viridis_r")
    if min(figure.shape) > 1 and high > 1.001 * low:
        lines = axes.contour(
            x, y, shown, np.geomspace(low, high, 9)[1:-1], colors="white", linewidths=0.8
        )
        axes.clabel(lines, fmt="%.3g", fontsize=8)
    row, column = np.unravel_index(np.nanargmin(figure), figure.shape)
    axes.plot(x[column], y[row], "o", color=_SECOND, markeredgecolor="white", markersize=9,
              clip_on=False, label=f"best: {low:.3g}")  # fmt: skip
    axes.legend(loc="upper right")
    axes.set_xlabel(_label(first))
    axes.set_ylabel(_label(second))
    for variation, axis in ((first, "x"), (second, "y")):
        if variation.logarithmic:
            getattr(axes, f"set_{axis}scale")("log")
            _plain_ticks(axes, axis)
    axes.set_title(_title(design))
    bar = drawing.colorbar(mesh, label=FIGURES[design.figure])
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    bar.ax.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:.2g}"))
    return drawing


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a plot to a file; its suffix chooses the format."""
    figure.savefig(path)


def _new(size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _title(design: Design) -> str:
    fields = ", best field size at every point" if design.best_fields else ""
    return f"{design.system.name}: Cramer-Rao bound{fields}"


def _label(variation: Variation) -> str:
    known = _LABELS.get(variation.key) or EXTRA_KEYS.get(variation.key)
    return f"{known}  ({variation.key})" if known else variation.key


def _scale(axes: Axes, axis: str, values: NDArray[np.float64]) -> None:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low > 0 and high / low > 4:
        getattr(axes, f"set_{axis}scale")("log")
        _plain_ticks(axes, axis)
    else:
        getattr(axes, f"set_{axis}lim")(0, 1.1 * high)


def _plain_ticks(axes: Axes, axis: str) -> None:
    """Ticks at 1, 2, 5 times powers of ten, written as plain numbers."""
    one = axes.xaxis if axis == "x" else axes.yaxis
    one.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    one.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    one.set_minor_formatter(NullFormatter())
