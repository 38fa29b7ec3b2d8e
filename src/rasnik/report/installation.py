"""An installation as a drawing: bodies and light paths, motions exaggerated, with their errors."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rasnik.geometry.solution import Adjustment
from rasnik.report.numbers import rounded, with_sigma

__all__ = ["installation_figure", "plot_installation"]

_DPI = 110
_BEFORE, _AFTER, _LIGHT = "#9a9a9a", "#2f6fb3", "#d1762b"
_UNMEASURED = "#c9a227"
# Size of the largest drawn motion, of the drawing.
_SHARE = 0.06
# Least half size of a body in the drawing, of the drawing.
_LEAST = 0.03

Array = NDArray[np.float64]


def plot_installation(found: Adjustment, path: str | os.PathLike[str]) -> None:
    """Write the drawing to a file; its suffix chooses the format.

    Raises
    ------
    ValueError
        If the suffix is not known.
    OSError
        If the file cannot be written.
    """
    installation_figure(found).savefig(path)


def installation_figure(found: Adjustment) -> Figure:
    """Two views of the installation, and motions or errors of all bodies."""
    figure = Figure(figsize=(12.5, 9.0), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    views = figure.subplots(2, 2, width_ratios=[1.15, 1])
    shown = _drawn_motions(found)
    elements = found.network.elements_mm(np.zeros_like(shown))
    extent = max(float(np.ptp(elements.reshape(-1, 3), axis=0).max()), 1e-9)
    factor = _exaggeration(shown, extent)
    long = int(np.argmax(np.ptp(elements.reshape(-1, 3), axis=0)))
    for axes, up in zip(views[:, 0], [k for k in range(3) if k != long], strict=True):
        _draw_view(axes, found, shown, (long, up), factor, extent)
    has_data = bool(np.isfinite(found.motions).any() and np.isfinite(found.chi2))
    _draw_motions(views[0, 1], found, slice(0, 3), "µm", 1.0, has_data)
    _draw_motions(views[1, 1], found, slice(3, 6), "µrad", 1e6, has_data)
    figure.suptitle(_title(found, has_data))
    handles, labels = views[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    return figure


def _title(found: Adjustment, has_data: bool) -> str:
    name = found.network.installation.name
    if not has_data:
        return f"{name}: what one reading of each Rasnik tells"
    text = f"{name}: motions from {sum(one.used for one in found.checks)} values"
    if np.isfinite(found.probability):
        text += f"; chi2 {found.chi2:.1f} for {found.ndf:.3g} degrees of freedom"
    wrong = [f"{one.value} of {one.rasnik}" for one in found.outliers]
    return text + (f"; wrong: {', '.join(wrong)}" if wrong else "")


def _drawn_motions(found: Adjustment) -> Array:
    """Measured motions; those that are unmeasured are drawn as none."""
    return np.nan_to_num(found.motions)


def _exaggeration(shown: Array, extent: float) -> float:
    """A round factor that makes the largest motion visible."""
    size = max(np.abs(shown[:, :3]).max() / 1e3, np.abs(shown[:, 3:]).max() * extent / 4)
    if size == 0:
        return 1.0
    factor = _SHARE * extent / size
    decade = 10.0 ** np.floor(np.log10(factor))
    return float(max(k * decade for k in (1, 2, 5) if k * decade <= factor))


# -------------------------------------------------------------------------- views


def _draw_view(
    axes: Any,
    found: Adjustment,
    shown: Array,
    plane: tuple[int, int],
    factor: float,
    extent: float,
) -> None:
    network = found.network
    still = np.zeros_like(shown)
    for moved, colour, label in (
        (still, _BEFORE, "nominal"),
        (shown * factor, _AFTER, f"moved, {factor:,.0f} times exaggerated"),
    ):
        if colour == _AFTER and not shown.any():
            continue
        for b in range(len(network.bodies)):
            outline = _outline(found, moved, b, extent)
            # the frame of a flat body seen from its edge is a line
            axes.plot(
                outline[:, plane[0]], outline[:, plane[1]], "-", color=colour, linewidth=1.6,
                zorder=3 if colour == _AFTER else 2, label=label if b == 0 else None,
            )  # fmt: skip
    wrong = {one.rasnik for one in found.outliers}
    lines = network.elements_mm(shown * factor)
    for name, line in zip(network.rasniks, lines, strict=True):
        axes.plot(
            line[:, plane[0]], line[:, plane[1]], "-", zorder=1,
            color="#c0392b" if name in wrong else _LIGHT,
            linewidth=1.6 if name in wrong else 0.7,
        )  # fmt: skip
    for k, (marker, label) in enumerate((("s", "mask"), ("o", "lens"), ("^", "sensor"))):
        axes.plot(
            lines[:, k, plane[0]], lines[:, k, plane[1]], marker, color=_LIGHT, markersize=4,
            zorder=4, label=label,
        )  # fmt: skip
    _name_bodies(axes, found, plane, lines)
    axes.set_xlabel(f"{'xyz'[plane[0]]} (mm)")
    axes.set_ylabel(f"{'xyz'[plane[1]]} (mm)")
    axes.set_title(f"seen along {'xyz'[3 - plane[0] - plane[1]]}", fontsize=10)
    axes.margins(x=0.16)  # room for the names
    axes.grid(color="#eeeeee")
    axes.set_axisbelow(True)


def _outline(found: Adjustment, motions: Array, body: int, extent: float) -> Array:
    """Edges of the box around the elements on a body, as one path with gaps, shape (n, 3)."""
    network = found.network
    points = network.points_on(body)
    low, high = (
        (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    )
    middle, half = (low + high) / 2, (high - low) / 2
    half = np.where(half < 1e-6 * extent, 0.0, half + 0.02 * extent)
    if not half.any():
        half = np.full(3, _LEAST * extent)
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    places = np.array([network.place(motions, body, middle + c * half) for c in corners])
    gap = np.full(3, np.nan)
    path = []
    for a in range(8):
        for b in range(a + 1, 8):
            if np.abs(corners[a] - corners[b]).sum() == 2:  # they differ in one coordinate
                path += [places[a], places[b], gap]
    return np.array(path)


def _name_bodies(axes: Any, found: Adjustment, plane: tuple[int, int], lines: Array) -> None:
    """Names above the bodies, with what of them is not drawn."""
    network = found.network
    top = lines[..., plane[1]].max()
    for b, name in enumerate(network.bodies):
        lost = [d for d in range(6) if found.free[b, d] and not found.measured[b, d]]
        text = name + (" (fixed)" if not found.free[b].any() else "")
        if lost:
            text += "\nunmeasured: " + ", ".join(_short(d) for d in lost)
        axes.annotate(
            text, (network.positions_mm[b, plane[0]], top), xytext=(0, 22),
            textcoords="offset points", ha="center", va="bottom", fontsize=8,
            color=_UNMEASURED if lost else "black", annotation_clip=False,
        )  # fmt: skip
    low, high = lines[..., plane[1]].min(), top
    axes.set_ylim(low - 0.12 * (high - low), high + 0.3 * (high - low))


def _short(dof: int) -> str:
    return "xyz"[dof] if dof < 3 else f"about {'xyz'[dof - 3]}"


# ------------------------------------------------------------------------ motions


def _draw_motions(
    axes: Any, found: Adjustment, dofs: slice, unit: str, factor: float, has_data: bool
) -> None:
    """Motions with error bars, or errors alone, of every body and of the sagittas."""
    rows: list[tuple[str, float, float, str]] = []
    for b, name in enumerate(found.network.bodies):
        for d in range(*dofs.indices(6)):
            if found.free[b, d]:
                sigma = found.sigmas[b, d] * factor
                rows.append((f"{name} {_short(d)}", found.motions[b, d] * factor, sigma, "o"))
    if dofs.start == 0:
        for one in found.sagittas:
            for axis, value, sigma in zip(one.axes, one.value_um, one.sigma_um, strict=True):
                rows.append((f"sagitta {one.name} {axis}", value, sigma, "D"))
    for row, (_, value, sigma, marker) in enumerate(rows):
        _draw_row(axes, row, value, sigma, marker, has_data)
    axes.set_yticks(range(len(rows)), [label for label, *_ in rows], fontsize=8)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    if has_data:
        axes.axvline(0, color="black", linewidth=0.8)
        low, high = axes.get_xlim()
        axes.set_xlim(low, high + 0.4 * (high - low))  # room for the numbers
    elif np.isfinite([sigma for _, _, sigma, _ in rows]).any():
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        axes.set_xlim(low / 2, high * (high / low) ** 0.3 * 2)
    what = "translation" if dofs.start == 0 else "rotation"
    meaning = f"{what} ± 1 standard deviation" if has_data else f"standard deviation of {what}"
    axes.set_xlabel(f"{meaning} ({unit})")
    axes.grid(axis="x", color="#eeeeee")
    axes.set_axisbelow(True)


def _draw_row(axes: Any, row: int, value: float, sigma: float, marker: str, has_data: bool) -> None:
    if not np.isfinite(sigma):
        axes.axhspan(row - 0.4, row + 0.4, color=_UNMEASURED, alpha=0.25, linewidth=0)
        axes.annotate(
            "unmeasured", (0.5, row), xycoords=("axes fraction", "data"), ha="center",
            va="center", fontsize=8, color="#7a6210",
        )  # fmt: skip
        return
    colour = _AFTER if marker == "o" else _LIGHT
    if has_data:
        axes.errorbar(value, row, xerr=sigma, fmt=marker, capsize=4, color=colour, markersize=5)
    else:
        axes.plot(sigma, row, marker, color=colour)
    told = with_sigma(value, sigma) if has_data else f"± {rounded(sigma, sigma)}"
    axes.annotate(
        told, (0.985, row), xycoords=("axes fraction", "data"), ha="right", va="center",
        fontsize=7.5, color="#444444",
    )  # fmt: skip
