"""A track as a plot: position, scale and rotation against time, and what befell the frames."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rasnik.analysis.flags import Flag
from rasnik.tracking.track import Track

__all__ = ["envelope", "plot_track", "track_figure"]

_DPI = 110
_COLOUR = "#2f6fb3"
#: Columns into which a long track is gathered; more than the plot has pixels across.
_COLUMNS = 2000
#: Up to here every frame, or what befell it, has a point of its own.
_FEW = 120

_FAILED = "no position"
#: What is marked, from the top, and in what colour and shape. The colours are those of Okabe and
#: Ito, which the colour-blind tell apart; where there are no colours, the rows do it.
_EVENTS: tuple[tuple[str, Flag, str, str], ...] = (
    ("cold start", Flag.COLD_START, "#009e73", "^"),
    ("refitted", Flag.REFITTED, "#e69f00", "o"),
    ("moved", Flag.MOVED, "#cc79a7", "D"),
    ("light changed", Flag.LIGHT_CHANGED, "#56b4e9", "s"),
    ("obstructed", Flag.OBSTRUCTED, "#d55e00", "v"),
    ("model misfit", Flag.MODEL_MISFIT, "#8a6d3b", "P"),
    ("frames lost", Flag.FRAMES_LOST, "#000000", "x"),
    ("time irregular", Flag.TIME_IRREGULAR, "#7a7a7a", "+"),
)


@dataclass(frozen=True)
class _Unit:
    name: str
    factor: float
    """Units in one of those that the track is stored in."""


_LENGTHS = (_Unit("pm", 1e6), _Unit("nm", 1e3), _Unit("µm", 1.0), _Unit("mm", 1e-3))
_ANGLES = (_Unit("nrad", 1e9), _Unit("µrad", 1e6), _Unit("mrad", 1e3), _Unit("rad", 1.0))
_RATIOS = (_Unit("1e-9", 1e9), _Unit("1e-6", 1e6), _Unit("1e-3", 1e3), _Unit("", 1.0))
#: (column, its name in the plot, decimals its offset is rounded to, unit of the offset, units)
_CURVES = (
    ("x_um", "x", 3, " µm", _LENGTHS),
    ("y_um", "y", 3, " µm", _LENGTHS),
    ("scale", "S", 6, "", _RATIOS),
    ("theta_rad", "theta_z", 6, " rad", _ANGLES),
)


def plot_track(track: Track, path: str | os.PathLike[str], *, title: str = "") -> None:
    """Write the plot of a track to a file; its suffix chooses the format.

    Parameters
    ----------
    track : Track
        Of any length: where frames lie closer than pixels, the least and the greatest value in
        each column of pixels are drawn, so no spike is lost.
    path : path-like
    title : str
        What was tracked; begins the title.

    Raises
    ------
    ValueError
        If the track is empty, or the suffix is not known.
    OSError
        If the file cannot be written.
    """
    track_figure(track, title=title).savefig(path)


def track_figure(track: Track, *, title: str = "") -> Figure:
    """Curves of x, y, scale and rotation above a strip that marks what befell the frames."""
    if not len(track):
        raise ValueError("there is nothing to plot: the track is empty")
    along, label = _abscissa(track)
    ok = track.ok
    events = _events(track, ok)
    heights = [1.3, 1.3, 1, 1, *([0.22 * len(events) + 0.1] if events else [])]
    figure = Figure(figsize=(10, 1.5 + 1.6 * sum(heights)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))
    breaks = np.flatnonzero(np.diff(track.frame) != 1) + 1
    for one, (column, name, decimals, offset_unit, units) in zip(axes, _CURVES, strict=False):
        values = np.where(ok, getattr(track, column), np.nan)
        offset = round(float(np.nanmedian(values)), decimals) + 0.0 if ok.any() else 0.0
        unit = _unit(values - offset, units)
        _draw_curve(one, along, (values - offset) * unit.factor, breaks)
        shown = f"{name} − {offset:.{decimals}f}{offset_unit}" if offset else name
        one.set_ylabel(f"{shown}\n{unit.name or 'ratio'}")
        one.grid(color="#e4e4e4")
        one.set_axisbelow(True)
        one.ticklabel_format(axis="y", useOffset=False)
    if events:
        _draw_events(axes[-1], along, events)
    axes[-1].set_xlabel(label)
    if len(track) > 1 and along[-1] > along[0]:
        margin = 0.01 * (along[-1] - along[0])
        axes[-1].set_xlim(along[0] - margin, along[-1] + margin)
    axes[0].set_title(_title(track, ok, title))
    figure.align_ylabels(axes[: len(_CURVES)].tolist())
    return figure


def _abscissa(track: Track) -> tuple[NDArray[np.float64], str]:
    """Time where every frame has one and it only grows; else the number of the frame."""
    time_s = track.time_s
    if np.isfinite(time_s).all() and (np.diff(time_s) > 0).all():
        return time_s, "time, s"
    return track.frame.astype(np.float64), "number of the frame"


def _title(track: Track, ok: NDArray[np.bool_], title: str) -> str:
    n, failed = len(track), int((~ok).sum())
    lines = [f"{title + ': ' if title else ''}position of the mask in {n:,} frame{'s' * (n != 1)}"]
    if failed:
        lines[0] += f", {failed:,} without a position (gaps)"
    if ok.any():
        x_nm, y_nm = (1e3 * float(s[ok].mean()) for s in (track.sigma_x_um, track.sigma_y_um))
        lines.append(f"mean stated error of a frame: x {x_nm:.3g} nm, y {y_nm:.3g} nm")
    return "\n".join(lines)


def _unit(values: NDArray[np.float64], units: tuple[_Unit, ...]) -> _Unit:
    """The unit in which the curve spans 1 to 1000."""
    finite = values[np.isfinite(values)]
    span = float(np.ptp(finite)) if len(finite) else 0.0
    return next(
        (unit for unit in units if 1 <= span * unit.factor < 1000), units[-1 if span else 1]
    )


# ------------------------------------------------------------------------ curves


def envelope(
    along: NDArray[np.float64], values: NDArray[np.float64], columns: int = _COLUMNS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points that draw the same picture as a long curve: least and greatest of each column.

    Parameters
    ----------
    along : ndarray, shape (n,)
        Increasing.
    values : ndarray, shape (n,)
        NaN where there is none.
    columns : int
        Number of equal parts of the range of `along`.

    Returns
    -------
    along, values : ndarray, shape (m,)
        At most two points in each column, in the order in which they occur, and a NaN in a
        column without values.
    """
    edges = np.linspace(along[0], along[-1], columns + 1)[1:-1]
    starts = np.concatenate([[0], np.searchsorted(along, edges), [len(along)]])
    starts, occupied = starts[:-1], np.diff(starts) > 0
    firsts = starts[occupied]
    bare = np.isnan(values)
    least = _place_of(np.where(bare, np.inf, values), firsts, np.minimum)
    most = _place_of(np.where(bare, -np.inf, values), firsts, np.maximum)
    places = np.sort(np.column_stack([least, most]), axis=1).ravel()
    places = places[np.concatenate([[True], np.diff(places) > 0])]
    return along[places], values[places]


def _place_of(
    values: NDArray[np.float64], firsts: NDArray[np.int64], extreme: np.ufunc
) -> NDArray[np.int64]:
    """Index of the extreme of each column, whose first values are at `firsts`."""
    best = extreme.reduceat(values, firsts)
    counts = np.diff(np.concatenate([firsts, [len(values)]]))
    hits = np.flatnonzero(values == np.repeat(best, counts))
    column = np.searchsorted(firsts, hits, side="right")
    return hits[np.concatenate([[True], np.diff(column) > 0])]


def _draw_curve(
    axes: Axes,
    along: NDArray[np.float64],
    values: NDArray[np.float64],
    breaks: NDArray[np.int64],
) -> None:
    """A line with gaps; a frame between two gaps is a point."""
    if len(along) > 2 * _COLUMNS:
        drawn, curve = envelope(along, values)
    else:
        drawn = np.insert(along, breaks, along[breaks])
        curve = np.insert(values, breaks, np.nan)
    axes.plot(drawn, curve, color=_COLOUR, linewidth=0.8)
    there = np.isfinite(curve)
    padded = np.concatenate([[False], there, [False]])
    alone = there & ~padded[:-2] & ~padded[2:]
    points = there if there.sum() <= _FEW else alone
    axes.plot(drawn[points], curve[points], ".", color=_COLOUR, markersize=4)


# ------------------------------------------------------------------------ events


def _events(track: Track, ok: NDArray[np.bool_]) -> list[tuple[str, NDArray[np.bool_], str, str]]:
    """(name, frames, colour, marker) of what happened at all, failures first."""
    rows = [(_FAILED, ~ok, "#b00020", "|")]
    rows += [
        (name, (track.flags & np.uint32(flag)) != 0, colour, marker)
        for name, flag, colour, marker in _EVENTS
    ]
    return [row for row in rows if row[1].any()]


def _draw_events(
    axes: Axes,
    along: NDArray[np.float64],
    events: list[tuple[str, NDArray[np.bool_], str, str]],
) -> None:
    """A row for each kind, a mark for each frame, or for each column of pixels."""
    span = max(float(along[-1] - along[0]), 1e-30)
    for row, (_, frames, colour, marker) in enumerate(events):
        places = along[frames]
        column = np.floor((places - along[0]) / span * _COLUMNS)
        places = places[np.concatenate([[True], np.diff(column) > 0])]
        axes.plot(
            places, np.full(len(places), -row), marker if len(places) <= _FEW else "|",
            color=colour, markersize=5, linestyle="none", fillstyle="full",
        )  # fmt: skip
    names = [f"{name} ({int(frames.sum()):,})" for name, frames, *_ in events]
    axes.set_yticks([-row for row in range(len(events))], names, fontsize=8)
    axes.set_ylim(-len(events) + 0.4, 0.6)
    axes.grid(axis="x", color="#e4e4e4")
    axes.set_axisbelow(True)
