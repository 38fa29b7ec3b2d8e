"""What was found, drawn over the image: fitted lattice, code lines, residuals.

Uses matplotlib's figures directly, not its pyplot state, so it is safe in threads and servers.
"""

from __future__ import annotations

import os
import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rasnik.analysis.flags import FLAGS
from rasnik.analysis.pose import Pose
from rasnik.imaging.projection import Projection
from rasnik.instrument import System
from rasnik.mask import ChessField
from rasnik.report.numbers import with_sigma
from rasnik.report.residuals import residual_image

__all__ = ["draw_overlay", "overlay_figure"]

Image = NDArray[Any]

#: With more fields in view than this, only code lines are drawn.
MOST_FIELDS = 80
#: No more code numbers along one side than this.
MOST_LABELS = 30
#: No more candidates of an ambiguous image in the caption than this.
MOST_CANDIDATES = 4
COLUMN_COLOUR, ROW_COLOUR, LATTICE_COLOUR = "#ff9d2e", "#39b6ff", "#5fd35f"
_DPI = 110
_CAPTION_LETTERS = 105  # in a line over one panel
_POINTS = 400  # along a line, to find where it enters the image


@dataclass(frozen=True)
class _View:
    """The part of the mask that an image shows."""

    projection: Projection
    mask: ChessField
    shape: tuple[int, int]
    pitch_um: float

    def to_pixel(self, i: Any, j: Any) -> tuple[Any, Any]:
        """(column, row) of mask points given in fields."""
        field = self.mask.field_um
        u, v = self.projection.to_sensor(np.asarray(i) * field, np.asarray(j) * field)
        height, width = self.shape
        return u / self.pitch_um + (width - 1) / 2, v / self.pitch_um + (height - 1) / 2

    def fields(self) -> tuple[int, int, int, int]:
        """(i0, i1, j0, j1): the fields around the view, within the mask."""
        height, width = self.shape
        u = (np.array([0, width, width, 0]) - width / 2) * self.pitch_um
        v = (np.array([0, 0, height, height]) - height / 2) * self.pitch_um
        x, y = (c / self.mask.field_um for c in self.projection.to_mask(u, v))
        i0, i1, j0, j1 = self.mask.bounds_fields
        return (
            max(i0, int(np.floor(x.min()))),
            min(i1, int(np.ceil(x.max()))),
            max(j0, int(np.floor(y.min()))),
            min(j1, int(np.ceil(y.max()))),
        )

    def inside(self, column: Image, row: Image, margin: float = 0.0) -> NDArray[np.bool_]:
        height, width = self.shape
        return (
            (column > margin - 0.5)
            & (column < width - 0.5 - margin)
            & (row > margin - 0.5)
            & (row < height - 0.5 - margin)
        )


def _draw_band(axes: Axes, view: _View, ends: tuple[Any, Any], colour: str) -> None:
    column, row = view.to_pixel(*ends)
    axes.fill(column, row, facecolor=colour, edgecolor=colour, alpha=0.3, linewidth=0.6)


class _Labels:
    """Numbers where code lines enter the image, left out where they would cover each other."""

    def __init__(self, axes: Axes, view: _View) -> None:
        self._axes, self._view = axes, view
        self._placed: list[tuple[float, float]] = []
        self._margin = 0.02 * max(view.shape)

    def place(self, line: tuple[Any, Any], text: str, *, column: bool) -> None:
        """Number of a code column, as high as it is seen, or row, as far left."""
        at_column, at_row = self._view.to_pixel(*line)
        seen = np.flatnonzero(self._view.inside(at_column, at_row, self._margin))
        if not seen.size:
            return
        best = seen[np.argmin((at_row if column else at_column)[seen])]
        x, y = float(at_column[best]), float(at_row[best])
        room = 1.6 * self._margin
        if any(abs(x - other) < room and abs(y - o) < room for other, o in self._placed):
            return
        self._placed.append((x, y))
        self._axes.text(
            x,
            y,
            text,
            color=COLUMN_COLOUR if column else ROW_COLOUR,
            fontsize=8,
            fontweight="bold",
            ha="center",
            va="center",
            path_effects=[patheffects.withStroke(linewidth=2.2, foreground="black")],
        )


def _code_lines(first: int, last: int, begin: int, period: int) -> list[int]:
    """Field indices of the code lines among fields first..last - 1 of a mask from `begin` on."""
    if last <= first:
        return []
    return [i for i in range(first // period * period, last, period) if i >= begin]


def _draw_code_lines(axes: Axes, view: _View) -> None:
    i0, i1, j0, j1 = view.fields()
    period, (begin_i, _, begin_j, _) = view.mask.period, view.mask.bounds_fields
    columns = _code_lines(i0, i1, begin_i, period)
    rows = _code_lines(j0, j1, begin_j, period)
    for i in columns:
        _draw_band(axes, view, ([i, i + 1, i + 1, i], [j0, j0, j1, j1]), COLUMN_COLOUR)
    for j in rows:
        _draw_band(axes, view, ([i0, i0, i1, i1], [j, j + 1, j + 1, j]), ROW_COLOUR)
    pivots = np.array([(i + 0.5, j + 0.5) for i in columns for j in rows])
    if len(pivots):
        column, row = view.to_pixel(*pivots.T)
        seen = view.inside(column, row)
        axes.plot(column[seen], row[seen], "s", ms=5, mfc="none", mec="#ff3b3b", mew=1.2)
    labels = _Labels(axes, view)
    along_i, along_j = np.linspace(i0, i1, _POINTS), np.linspace(j0, j1, _POINTS)
    for i in columns[:: 1 + len(columns) // MOST_LABELS]:
        labels.place((np.full(_POINTS, i + 0.5), along_j), str(i // period), column=True)
    for j in rows[:: 1 + len(rows) // MOST_LABELS]:
        labels.place((along_i, np.full(_POINTS, j + 0.5)), str(j // period), column=False)


def _draw_contours(axes: Axes, view: _View) -> None:
    """The lines between fields, if there are few enough to see anything."""
    i0, i1, j0, j1 = view.fields()
    if max(i1 - i0, j1 - j0) > MOST_FIELDS:
        return
    style: dict[str, Any] = {"color": LATTICE_COLOUR, "linewidth": 0.5, "alpha": 0.8}
    for i in range(i0, i1 + 1):
        axes.plot(*view.to_pixel([i, i], [j0, j1]), **style)
    for j in range(j0, j1 + 1):
        axes.plot(*view.to_pixel([i0, i1], [j, j]), **style)


class _Sheet:
    """A figure with panels side by side, each above its colour bar, and a caption on top.

    Everything is placed in inches: matplotlib's automatic layouts draw the figure twice.
    """

    _PANEL, _LEFT, _RIGHT, _BOTTOM, _TOP, _LINE = 8.0, 0.75, 0.85, 1.35, 0.75, 0.19

    def __init__(self, panels: int, shape: tuple[int, ...], caption: str) -> None:
        lines = [
            part
            for line in caption.splitlines()
            for part in textwrap.wrap(line, panels * _CAPTION_LETTERS) or [""]
        ]
        self._width = self._PANEL - self._LEFT - self._RIGHT
        self._height = self._width * min(max(shape[0] / shape[1], 0.3), 2.0)
        total = self._BOTTOM + self._height + self._TOP + 0.2 + self._LINE * len(lines)
        self._size = panels * self._PANEL, total
        self.figure = Figure(figsize=self._size, dpi=_DPI)
        FigureCanvasAgg(self.figure)
        self.figure.suptitle(
            "\n".join(lines), x=0.12 / self._size[0], y=1 - 0.1 / total, ha="left", fontsize=10
        )

    def _axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        across, up = self._size
        return self.figure.add_axes((left / across, bottom / up, width / across, height / up))

    def panel(self, number: int) -> Axes:
        """Axes of an image, from the left."""
        left = number * self._PANEL + self._LEFT
        return self._axes(left, self._BOTTOM, self._width, self._height)

    def colour_bar(self, number: int, shown: Any, label: str, **options: Any) -> None:
        """The scale under a panel."""
        left = number * self._PANEL + self._LEFT + 0.15 * self._width
        axes = self._axes(left, 0.55, 0.7 * self._width, 0.16)
        bar = self.figure.colorbar(shown, cax=axes, orientation="horizontal", **options)
        bar.set_label(label)


def _show(axes: Axes, pixels: Image, pitch_um: float, **options: Any) -> Any:
    """An image with pixels on the lower and left axes, micrometres on the others."""
    height, width = pixels.shape
    shown = axes.imshow(pixels, extent=(-0.5, width - 0.5, height - 0.5, -0.5), **options)
    axes.set(xlabel="column (pixel)", ylabel="row (pixel)")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    for across, centre in ((True, (width - 1) / 2), (False, (height - 1) / 2)):

        def to_um(pixel: Any, centre: float = centre) -> Any:
            return (pixel - centre) * pitch_um

        def to_pixel(um: Any, centre: float = centre) -> Any:
            return um / pitch_um + centre

        if across:
            axes.secondary_xaxis("top", functions=(to_um, to_pixel)).set_xlabel("u (µm)")
        else:
            axes.secondary_yaxis("right", functions=(to_um, to_pixel)).set_ylabel("v (µm)")
    return shown


def _grey_range(image: Image) -> tuple[float, float]:
    finite = image[np.isfinite(image)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = (float(level) for level in np.percentile(finite, [0.5, 99.5]))
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _draw_image(sheet: _Sheet, image: Image, pose: Pose, system: System) -> None:
    """The image with the lattice that was found, and the reference point."""
    axes, pitch_um = sheet.panel(0), system.pitch_um
    low, high = _grey_range(image)
    shown = _show(axes, image, pitch_um, cmap="gray", vmin=low, vmax=high)
    sheet.colour_bar(0, shown, "grey level")
    if pose.ok and pose.projection is not None:
        view = _View(pose.projection, system.mask, image.shape, pitch_um)
        _draw_contours(axes, view)
        _draw_code_lines(axes, view)
    centre = (image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2
    stroke = [patheffects.withStroke(linewidth=3.5, foreground="black")]
    axes.plot(*centre, "+", ms=16, mew=1.8, color="#ff4dff", path_effects=stroke)
    lattice = "Fitted lattice, code columns (orange) and rows (blue), pivots, " if pose.ok else ""
    axes.set_title(f"{lattice}reference point (+)", fontsize=10)


def _draw_residuals(sheet: _Sheet, residuals: Image, pitch_um: float) -> None:
    """Image minus model; NaN (pixels left out) in yellow."""
    axes = sheet.panel(1)
    seen = residuals[np.isfinite(residuals)]
    spread = 1.4826 * float(np.median(np.abs(seen - np.median(seen)))) if seen.size else 0.0
    limit = 5 * spread if spread > 0 else 1.0
    colours = colormaps["RdBu_r"].with_extremes(bad="#ffe14d")
    masked = np.ma.masked_invalid(residuals)
    shown = _show(axes, masked, pitch_um, cmap=colours, vmin=-limit, vmax=limit)
    sheet.colour_bar(1, shown, "image - model (grey levels)", extend="both")
    left_out = 1 - seen.size / residuals.size
    title = "Residuals" + (f"; yellow: left out ({100 * left_out:.1f} %)" if left_out else "")
    axes.set_title(title, fontsize=10)


def _caption(pose: Pose) -> str:
    if not pose.ok:
        lines = [f"No position. {pose.error}"]
        for c in pose.candidates[:MOST_CANDIDATES]:
            lines.append(
                f"candidate: x = {c.x_um:.3f}, y = {c.y_um:.3f} µm, theta = "
                f"{1e3 * c.theta_rad:.3f} mrad, orientation {c.orientation}, "
                f"log-odds {c.log_odds:.1f}"
            )
        if len(pose.candidates) > MOST_CANDIDATES:
            lines.append(f"and {len(pose.candidates) - MOST_CANDIDATES} more candidates")
        return "\n".join(lines)
    theta = with_sigma(1e3 * pose.theta_rad, 1e3 * pose.sigma_theta_rad)
    lines = [
        f"x = {with_sigma(pose.x_um, pose.sigma_x_um)} µm     "
        f"y = {with_sigma(pose.y_um, pose.sigma_y_um)} µm",
        f"S = {with_sigma(pose.scale, pose.sigma_scale)}     "
        f"theta = {theta} mrad     orientation {pose.orientation}",
        f"chi2/ndf = {pose.chi2_ndf:.3f}     {pose.method}, {pose.model}     "
        f"code lines read: {pose.code_lines_read} of {pose.code_lines_in_view}",
    ]
    flags = [info.name for info in FLAGS if pose.flags & info.flag]
    if flags:
        lines.append("flags: " + ", ".join(flags))
    return "\n".join(lines)


def overlay_figure(
    image: Image, pose: Pose, system: System, residuals: Image | None = None, title: str = ""
) -> Figure:
    """The figure that `draw_overlay` saves.

    Parameters
    ----------
    image : ndarray, shape (H, W)
    pose : Pose
    system : System
        Its mask and the pitch of its pixels are used.
    residuals : ndarray, shape (H, W), optional
        Image minus model, NaN where pixels were left out; a panel of its own.
    title : str
    """
    caption = f"{title}\n{_caption(pose)}" if title else _caption(pose)
    sheet = _Sheet(1 if residuals is None else 2, image.shape, caption)
    _draw_image(sheet, image, pose, system)
    if residuals is not None:
        _draw_residuals(sheet, residuals, system.pitch_um)
    return sheet.figure


def draw_overlay(
    image: Image,
    pose: Pose,
    system: System,
    path: str | os.PathLike[str],
    *,
    bounds_px: tuple[int, int, int, int] | None = None,
    title: str = "",
) -> None:
    """Save a PNG of an image with what was found in it.

    Left the image with the fitted lattice (all field contours if there are few, code columns
    and rows with their numbers, pivots) and the reference point; right the residuals, image
    minus model. The caption gives the pose with its standard deviations. Without a position
    the image and the reason are shown.

    Parameters
    ----------
    image : ndarray, shape (H, W)
    pose : Pose
        As found by `rasnik.analyse` in this image.
    system : System
        Its mask, noise and the pitch of its pixels are used.
    path : path-like
    bounds_px : tuple of int, optional
        (left, top, right, bottom) of the part analysed, the last ones included.
    title : str
        First line of the caption.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    residuals = None
    if pose.ok and pose.projection is not None:
        residuals = residual_image(image, pose, system, bounds_px)
    figure = overlay_figure(image, pose, system, residuals, title)
    figure.savefig(path, pil_kwargs={"compress_level": 3})
