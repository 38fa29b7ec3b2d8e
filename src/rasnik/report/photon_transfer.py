"""The photon-transfer curve with its fit, and the map of the pixels' variance."""

from __future__ import annotations

import math
import os

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import ndimage

from rasnik.characterisation.photon_transfer import PhotonTransfer
from rasnik.report.numbers import concise

__all__ = ["noise_figure", "plot_noise"]

_DPI = 110
_POINT, _LAW, _POOR = "#2f6fb3", "#d1762b", "#7a7a7a"
_MOST_POINTS = 4000
_MOST_DEFECTS = 300
_MAP_SIDE = 400  # pixels of a map that are drawn along its longer side
#: Told apart by their shapes, in print as on the screen.
_MARKS = {"noisy": "o", "quiet": "s", "stuck": "x", "hot": "^", "dead": "v"}


def plot_noise(found: PhotonTransfer, path: str | os.PathLike[str], *, title: str = "") -> None:
    """Write the plot to a file; its suffix chooses the format."""
    noise_figure(found, title=title).savefig(path)


def noise_figure(found: PhotonTransfer, *, title: str = "") -> Figure:
    """Curve with fit over its residuals on the left; maps of variance and of its excess right."""
    figure = Figure(figsize=(12.5, 7.4), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subfigures(1, 2, width_ratios=(1.25, 1), squeeze=False)[0]
    curve, rest = left.subplots(2, 1, sharex=True, height_ratios=(2.3, 1))
    _draw_curve(curve, found)
    _draw_rest(rest, found)
    upper, lower = right.subplots(2, 1)
    _draw_maps(upper, lower, found)
    height, width = found.noise.mean.shape
    text = f"{title + ': ' if title else ''}noise of {width} x {height} pixels"
    figure.suptitle(f"{text} in {found.noise.frames} frames")
    return figure


def _draw_curve(axes: Axes, found: PhotonTransfer) -> None:
    law, noise = found.law, found.noise
    known = np.isfinite(noise.variance)
    for mask, colour, label in (
        (known & ~found.used, _POOR, "pixels not used (end of the range, defects)"),
        (known & found.used, _POINT, "pixels"),
    ):
        level, variance = noise.mean[mask], noise.variance[mask]
        few = np.random.default_rng(0).permutation(len(level))[:_MOST_POINTS]
        if len(few):
            axes.plot(
                level[few], variance[few], ".", color=colour, markersize=2, alpha=0.35,
                label=label, rasterized=True,
            )  # fmt: skip
    bins = found.bins
    axes.errorbar(
        bins[:, 0], bins[:, 1], bins[:, 2], fmt="o", color="black", markersize=3.5,
        label="mean of the pixels of a level", zorder=4,
    )  # fmt: skip
    ends = np.array([min(0.0, bins[0, 0]), bins[-1, 0]])
    law_text = f"A = {concise(law.A, law.sigma_A)}, B = {concise(law.B, law.sigma_B)}"
    rounding = f" + {law.rounding:.3g} of rounding" if law.rounding else ""
    axes.plot(
        ends, law.measured(ends), color=_LAW, linewidth=2, zorder=5,
        label=f"A + B Q{rounding}\n{law_text}",
    )  # fmt: skip
    top = max(float(bins[:, 1].max()), float(law.measured(ends[1])))
    axes.set_ylim(0, 1.6 * top)
    if found.saturation_level is not None:
        axes.axvline(found.saturation_level, color=_POOR, linestyle=":")
        axes.annotate(
            "saturation", (found.saturation_level, 0.03), xycoords=("data", "axes fraction"),
            rotation=90, ha="right", va="bottom", color=_POOR, fontsize=9,
        )  # fmt: skip
    axes.set_ylabel("variance in time, grey²")
    axes.set_title("variance against grey level", fontsize=11)
    legend = axes.legend(fontsize=9, loc="upper left", framealpha=0.9)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1)
    _grid(axes)


def _draw_rest(axes: Axes, found: PhotonTransfer) -> None:
    bins, law = found.bins, found.law
    expected = law.measured(bins[:, 0])
    axes.axhline(0, color=_LAW, linewidth=2)
    axes.errorbar(
        bins[:, 0], 100 * (bins[:, 1] / expected - 1), 100 * bins[:, 2] / expected,
        fmt="o", color="black", markersize=3.5,
    )  # fmt: skip
    axes.set_ylabel("variance − law, %")
    axes.set_xlabel("grey level Q")
    _grid(axes)


def _grid(axes: Axes) -> None:
    axes.grid(color="#e4e4e4")
    axes.set_axisbelow(True)


def _reduced(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means of squares of pixels, as many as can be told apart on the plot."""
    side = max(1, math.ceil(max(image.shape) / _MAP_SIDE))
    rows, columns = (length // side * side for length in image.shape)
    squares = image[:rows, :columns].reshape(rows // side, side, columns // side, side)
    return np.asarray(squares.mean(axis=(1, 3)))


def _draw_maps(upper: Axes, lower: Axes, found: PhotonTransfer) -> None:
    noise = found.noise
    height, width = noise.mean.shape
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    variance = _reduced(noise.variance)
    low, high = np.nanquantile(variance, [0.01, 0.99])
    image = upper.imshow(variance, cmap="cividis", vmin=low, vmax=high, extent=extent)
    upper.figure.colorbar(image, ax=upper, label="grey²", extend="both", shrink=0.9)
    upper.set_title("variance of the pixels", fontsize=11)

    # A single variance is uncertain by sqrt(2 / dof): neighbours together show what is left.
    ratio = np.where(found.used, noise.variance / found.law.measured(noise.mean), 1.0) - 1
    smooth = 100 * _reduced(ndimage.gaussian_filter(np.nan_to_num(ratio), 2.0))
    # Paler than it could be, so that marks stand out.
    limit = max(1.5 * float(np.quantile(np.abs(smooth), 0.99)), 1e-9)
    image = lower.imshow(smooth, cmap="PuOr", vmin=-limit, vmax=limit, extent=extent)
    lower.figure.colorbar(image, ax=lower, label="%", extend="both", shrink=0.9)
    lower.set_title("variance − law, smoothed over 5 pixels; defects marked", fontsize=11)
    for kind, marker in _MARKS.items():
        places = [(d.column, d.row) for d in found.defects if d.kind == kind]
        if places:
            x, y = np.array(places[:_MOST_DEFECTS]).T
            lower.plot(
                x, y, marker, markersize=7, color="black", fillstyle="none",
                markeredgewidth=1.5, label=f"{kind} ({len(places)})",
            )  # fmt: skip
    if found.defects:
        lower.legend(
            fontsize=8, loc="upper left", bbox_to_anchor=(0, -0.16), ncols=5, frameon=False
        )
    for axes in (upper, lower):
        axes.set_xlabel("column")
        axes.set_ylabel("row")
