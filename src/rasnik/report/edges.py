"""Edge profiles as a plot: spread, residual, transfer, and the blur over the image."""

from __future__ import annotations

import os

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rasnik.characterisation.edges import Edges
from rasnik.report.numbers import rounded, with_sigma

__all__ = ["blur_track_figure", "edges_figure", "plot_blur_track", "plot_edges"]

_DPI = 110
#: Colour and marker of each profile: across x blue, across y orange; black to white first.
_LOOKS = (("#2f6fb3", "o"), ("#8fb8de", "s"), ("#d1762b", "^"), ("#edb888", "v"))
_MOST_POINTS = 60


def plot_edges(found: Edges, path: str | os.PathLike[str], *, title: str = "") -> None:
    """Write the plot to a file; its suffix chooses the format.

    Raises
    ------
    ValueError
        If the suffix is not known.
    OSError
        If the file cannot be written.
    """
    edges_figure(found, title=title).savefig(path)


def edges_figure(found: Edges, *, title: str = "") -> Figure:
    """Edge spread, what it is beyond the model, modulation transfer, and blur over the image."""
    figure = Figure(figsize=(11, 8.2), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    (spread, transfer), (rest, blur) = figure.subplots(2, 2)
    _draw_spread(spread, found)
    _draw_rest(rest, found)
    _draw_transfer(transfer, found)
    _draw_map(figure, blur, found)
    head = f"{title}: " if title else ""
    count = "" if found.images == 1 else f", mean of {found.images} images"
    figure.suptitle(
        f"{head}blur {with_sigma(*found.blur_um)} µm, excess kurtosis "
        f"{with_sigma(*found.kurtosis)}, edge shift {with_sigma(*found.edge_shift_um)} µm{count}",
        fontsize=11,
    )
    return figure


def _draw_spread(axes, found: Edges) -> None:  # type: ignore[no-untyped-def]
    for one, (colour, marker) in zip(found.profiles, _LOOKS, strict=True):
        distance = one.distance_um / found.pixel_um
        every = max(1, len(distance) // _MOST_POINTS)
        axes.plot(
            distance[::every], one.binned[::every], marker, color=colour, markersize=4,
            label=f"{one.name}", linestyle="none",
        )  # fmt: skip
    first = found.profiles[0]
    axes.plot(first.distance_um / found.pixel_um, first.model, "k-", linewidth=1, label="model, x")
    axes.set_xlabel("distance from the contour on the sensor, pixels (white to the right)")
    axes.set_ylabel("edge spread, 0 black to 1 white")
    axes.set_title("Edge spread, pixel included", fontsize=10)
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    _grid(axes)


def _draw_rest(axes, found: Edges) -> None:  # type: ignore[no-untyped-def]
    for one, (colour, marker) in zip(found.profiles, _LOOKS, strict=True):
        distance = one.distance_um / found.pixel_um
        every = max(1, len(distance) // _MOST_POINTS)
        axes.errorbar(
            distance[::every], 100 * (one.binned - one.model)[::every],
            100 * one.binned_sigma[::every], fmt=marker, color=colour, markersize=3, linewidth=0.8,
        )  # fmt: skip
        axes.plot(distance, 100 * (one.value - one.model), color=colour, linewidth=1.2)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xlabel("distance from the contour on the sensor, pixels")
    axes.set_ylabel("measured - model, % of the step")
    axes.set_title("What the image model leaves (points: bins; lines: free curve)", fontsize=10)
    _grid(axes)


def _draw_transfer(axes, found: Edges) -> None:  # type: ignore[no-untyped-def]
    pixel = found.pixel_um
    for one, name, (colour, _) in zip(found.transfer, "xy", _LOOKS[::2], strict=True):
        frequency = one.frequency_per_um * pixel
        low, high = one.total - one.total_sigma, one.total + one.total_sigma
        axes.fill_between(frequency, low, high, color=colour, alpha=0.3, linewidth=0)
        axes.plot(frequency, one.total, color=colour, label=f"measured, across {name}")
        clear = (one.optical_sigma < 0.05) & (one.total > 3 * one.total_sigma)
        optical = np.where(clear, one.optical, np.nan)
        axes.plot(frequency, optical, "--", color=colour, label=f"pixel removed, {name}")
    one = found.transfer[0]
    frequency = one.frequency_per_um * pixel
    axes.plot(frequency, one.pixel, ":", color="black", linewidth=1.2, label="pixel")
    if one.diffraction is not None:
        axes.plot(
            frequency, one.diffraction, "-.", color="#7a7a7a", label="ideal lens, without pixel"
        )
    axes.axvline(0.5, color="#999999", linewidth=0.8)
    axes.annotate(
        "Nyquist", (0.5, 1.04), xytext=(-3, 0), textcoords="offset points", ha="right", fontsize=8
    )
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.1)
    axes.set_xlabel("frequency on the sensor, cycles per pixel")
    axes.set_ylabel("modulation transfer")
    axes.set_title("Modulation transfer", fontsize=10)
    axes.legend(frameon=False, fontsize=8, loc="upper right")
    _grid(axes)


def _draw_map(figure: Figure, axes, found: Edges) -> None:  # type: ignore[no-untyped-def]
    blur = found.blur_map
    rows, columns = blur.blur_um.shape
    u, v = blur.u_um * 1e-3, blur.v_um * 1e-3
    half_u = (u.max() - u.min()) / max(columns - 1, 1) / 2
    half_v = (v.max() - v.min()) / max(rows - 1, 1) / 2
    extent = (u.min() - half_u, u.max() + half_u, v.max() + half_v, v.min() - half_v)
    shown = axes.imshow(blur.blur_um, extent=extent, cmap="cividis")
    figure.colorbar(shown, ax=axes, label="blur sigma, µm on the sensor")
    middle = np.nanmean(blur.blur_um) if np.isfinite(blur.blur_um).any() else 0.0
    for k in np.ndindex(rows, columns):
        if np.isfinite(blur.blur_um[k]):
            colour = "black" if blur.blur_um[k] > middle else "white"
            value, sigma = float(blur.blur_um[k]), float(blur.sigma_um[k])
            text = f"{rounded(value, sigma, 1)}\n± {rounded(sigma, sigma, 1)}"
            axes.text(u[k], v[k], text, ha="center", va="center", fontsize=7, color=colour)
    axes.set_xlabel("u, mm (right)")
    axes.set_ylabel("v, mm (down)")
    axes.set_title("Blur over the image", fontsize=10)


def _grid(axes) -> None:  # type: ignore[no-untyped-def]
    axes.grid(color="#e4e4e4")
    axes.set_axisbelow(True)


# ------------------------------------------------------------------------ along a track


def plot_blur_track(
    position: NDArray[np.float64],
    blur_um: NDArray[np.float64],
    defocus_um: NDArray[np.float64] | None,
    path: str | os.PathLike[str],
    *,
    unit: str = "s",
    title: str = "",
) -> None:
    """Write the plot of blur along a track to a file; its suffix chooses the format."""
    figure = blur_track_figure(position, blur_um, defocus_um, unit=unit, title=title)
    figure.savefig(path)


def blur_track_figure(
    position: NDArray[np.float64],
    blur_um: NDArray[np.float64],
    defocus_um: NDArray[np.float64] | None,
    *,
    unit: str = "s",
    title: str = "",
) -> Figure:
    """Blur and, where the optics are known, the distance from the focus against time or frame.

    Parameters
    ----------
    position : ndarray, shape (n,)
        Time in s, or number of the frame.
    blur_um, defocus_um : ndarray, shape (n,)
    unit : str
        "s" for times, "" for numbers.
    """
    panels = 1 if defocus_um is None else 2
    figure = Figure(figsize=(9.5, 2.6 + 2.2 * panels), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0]
    rows[0].plot(position, blur_um, ".", markersize=2, color=_LOOKS[0][0], rasterized=True)
    rows[0].set_ylabel("blur sigma, µm on the sensor")
    if defocus_um is not None:
        rows[1].plot(position, defocus_um, ".", markersize=2, color=_LOOKS[2][0], rasterized=True)
        rows[1].set_ylabel("distance from focus, µm\n(sign not known)")
    rows[-1].set_xlabel("time, s" if unit == "s" else "frame")
    head = f"{title}: " if title else ""
    figure.suptitle(f"{head}blur along the track, {len(blur_um):,} frames", fontsize=11)
    for axes in rows:
        _grid(axes)
    return figure
