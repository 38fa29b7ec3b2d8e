"""Three points as a drawing: the line of sight when an element moves, or air bends the light."""

from __future__ import annotations

import os

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rasnik.geometry.rigid import UM_PER_MM
from rasnik.geometry.three_points import ThreePoints

__all__ = ["draw_geometry", "geometry_figure"]

_DPI = 110
_MASK, _LENS, _SENSOR, _LIGHT, _FAINT = "#4f8a4f", "#2f6fb3", "#7a4fa3", "#d1762b", "#9a9a9a"
_HALF = 1.0  # half height of an element in the drawing
_NEAR = 0.15  # share of the length within which labels would touch


def geometry_figure(instrument: ThreePoints) -> Figure:
    """Four small drawings: the lens moved, the camera turned, the mask moved along, light bent.

    Distances along the line are true; displacements across it are not.
    """
    figure = Figure(figsize=(10.5, 7.0), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 2)
    for draw, axes in zip((_lens, _camera, _along, _bent), panels.flat, strict=True):
        _finish(axes, instrument)
        draw(axes, instrument)
    figure.suptitle(
        f"Mask, lens and sensor: a = {instrument.mask_lens_mm:g} mm, b = "
        f"{instrument.lens_sensor_mm:g} mm, S = b / a = {instrument.scale:.4g} "
        "(across the line not to scale)"
    )
    return figure


def draw_geometry(instrument: ThreePoints, path: str | os.PathLike[str]) -> None:
    """Write the drawing as .png, .pdf or .svg."""
    geometry_figure(instrument).savefig(path)


def _lens(axes: Axes, instrument: ThreePoints) -> None:
    a, b = instrument.mask_lens_mm, instrument.lens_sensor_mm
    move = 0.7 / (1 + a / b)
    _elements(axes, instrument, lens=move)
    axes.plot([0, a + b], [0, 0], color=_FAINT, linestyle="--")
    axes.plot([0, a, a + b], [move * (1 + a / b), move, 0], color=_LIGHT)
    _arrow(axes, a, 0, move, "sagitta", side=1 if b >= a else -1)
    _arrow(axes, 0, 0, move * (1 + a / b), "x", side=1)
    axes.set_title(f"lens moved by d: x = d (1 + a/b) = {1 + a / b:.4g} d")


def _camera(axes: Axes, instrument: ThreePoints) -> None:
    a, b = instrument.mask_lens_mm, instrument.lens_sensor_mm
    pivot = a if instrument.pivot_mm is None else instrument.pivot_mm
    angle = 0.75 / max(a + b - pivot, pivot, 1e-9)
    at = {z: angle * (z - pivot) for z in (0.0, a, a + b)}
    _elements(axes, instrument, lens=at[a], sensor=at[a + b])
    axes.plot([0, a + b], [0, 0], color=_FAINT, linestyle="--")
    axes.plot([0, a + b], [at[0.0], at[a + b]], color=_LIGHT)
    axes.plot([a, a + b], [at[a], at[a + b]], color=_LENS, linewidth=5, alpha=0.25,
              solid_capstyle="round")  # fmt: skip
    axes.plot(pivot, 0, "k.", markersize=8)
    low, high = axes.get_xlim()
    margin = 0.06 * (max(high, pivot) - min(low, pivot))
    axes.set_xlim(min(low, pivot - margin), max(high, pivot + margin))
    if at[0.0]:
        _arrow(axes, 0, 0, at[0.0], "x", side=1)
    slope = instrument.matrix(["camera_turn_y"])[0, 0] / UM_PER_MM
    axes.set_title(f"camera turned by φ about •: x = {round(slope, 9) + 0.0:g} mm · φ")


def _along(axes: Axes, instrument: ThreePoints) -> None:
    a, b = instrument.mask_lens_mm, instrument.lens_sensor_mm
    nearer = 0.25 * a
    size = 0.4 * min(1, a / b)  # so that both images fit on the sensor
    _elements(axes, instrument)
    axes.vlines(nearer, -_HALF, _HALF, color=_MASK, linestyle=":", linewidth=2.5)
    for sign in (-1, 1):
        axes.plot([0, a, a + b], [sign * size, 0, -sign * size * b / a], color=_FAINT)
        ends = [sign * size, 0, -sign * size * b / (a - nearer)]
        axes.plot([nearer, a, a + b], ends, color=_LIGHT)
    axes.annotate("", (nearer, -1.15), (0, -1.15), arrowprops={"arrowstyle": "->"})
    axes.text(nearer / 2, -1.3, "z", ha="center", va="top")
    axes.set_title("mask moved by z along the light: S = b / (a - z)")


def _bent(axes: Axes, instrument: ThreePoints) -> None:
    a, b = instrument.mask_lens_mm, instrument.lens_sensor_mm
    z = np.linspace(0, a + b, 200)
    bend = 0.8 / max(a * (a + b), b * b / 4)  # at the mask, and between lens and sensor
    _elements(axes, instrument)
    axes.plot([0, a + b], [0, 0], color=_FAINT, linestyle="--")
    axes.plot(z, bend * (z - a) * (z - a - b), color=_LIGHT)
    _arrow(axes, 0, 0, bend * a * (a + b), "x", side=1)
    axes.annotate("", (0.72 * (a + b), 1.05), (0.72 * (a + b), 0.45),
                  arrowprops={"arrowstyle": "->", "color": "black"})  # fmt: skip
    axes.text(0.74 * (a + b), 0.75, "denser air", va="center", fontsize=9)
    axes.set_title("light bent in air: x = dn/dx a (a + b) / 2")


def _elements(axes: Axes, instrument: ThreePoints, lens: float = 0.0, sensor: float = 0.0) -> None:
    a, b = instrument.mask_lens_mm, instrument.lens_sensor_mm
    axes.vlines(0, -_HALF, _HALF, color=_MASK, linewidth=3)
    axes.annotate("", (a, lens + 0.8), (a, lens - 0.8),
                  arrowprops={"arrowstyle": "<->", "color": _LENS, "linewidth": 2})  # fmt: skip
    axes.plot(a, lens, "o", color=_LENS, markersize=4)
    axes.vlines(a + b, sensor - 0.55, sensor + 0.55, color=_SENSOR, linewidth=3)
    axes.plot(a + b, sensor, "o", color=_SENSOR, markersize=4)


def _arrow(axes: Axes, z: float, low: float, high: float, text: str, side: int) -> None:
    axes.annotate("", (z, high), (z, low),
                  arrowprops={"arrowstyle": "->", "color": "black", "shrinkA": 0, "shrinkB": 0},
                  )  # fmt: skip
    axes.annotate(text, (z, (low + high) / 2), xytext=(7 * side, 0), textcoords="offset points",
                  va="center", ha="left" if side > 0 else "right")  # fmt: skip


def _finish(axes: Axes, instrument: ThreePoints) -> None:
    a, b = instrument.mask_lens_mm, instrument.lens_sensor_mm
    axes.set_xlim(-0.06 * (a + b), 1.06 * (a + b))
    axes.set_ylim(-1.6, 1.35)
    axes.set_yticks([])
    labels = ["mask\n0", f"lens\n{a:g}", f"sensor\n{a + b:g}"]
    # beside a near neighbour the lens is named two lines below
    labels[1] = "\n\n" * (min(a, b) < _NEAR * (a + b)) + labels[1]
    axes.set_xticks([0, a, a + b], labels)
    axes.set_xlabel("along the light, mm")
    for side in ("left", "right", "top"):
        axes.spines[side].set_visible(False)
