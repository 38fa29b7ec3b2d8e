"""Resolution per image: repeated images of a still scene, whole and binned, full and half light."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray

from rasnik.imaging.montecarlo import exact_image
from rasnik.paper.images import POSITION_UM, by_fourier, by_likelihood, noisy, solidras, stream
from rasnik.paper.outcome import (
    BLACK,
    BLUE,
    ORANGE,
    VERMILION,
    Effort,
    Outcome,
    Row,
    Value,
    new_figure,
)
from rasnik.performance.bound import bound

__all__ = ["resolution", "scatter_of"]

# (name, binning, part of the light, paper's resolution per image in nm)
_CASES = (
    ("whole images", 1, 1.0, 3.0),
    ("whole images, half light", 1, 0.5, 4.8),
    ("superpixels", 2, 1.0, 3.3),
    ("superpixels, half light", 2, 0.5, 5.0),
)

_WHY = (
    "Same generator settings, light and noise, and the images allow the bound: an analysis decides "
    "what is taken of it. The likelihood fit uses every pixel and reaches it; a Fourier analysis "
    "sees the image through a window and a finite set of peaks; that of the paper (SOAP) loses "
    "more, in a step that is not described."
)


def scatter_of(values_nm: NDArray[np.float64]) -> Value:
    """Standard deviation of x and y together, of images of one position; (n, 2)."""
    count = len(values_nm)
    sigma = math.sqrt(float(np.var(values_nm, axis=0, ddof=1).mean()))
    return Value(sigma, sigma / math.sqrt(4 * (count - 1)))


def resolution(effort: Effort) -> Outcome:
    """Section 5: 3.0, 4.8, 3.3 and 5.0 nm per image."""
    count = effort.pick(64, 256)
    rows: list[Row] = []
    found: list[dict[str, Any]] = []
    for number, (name, binning, light, paper) in enumerate(_CASES):
        system = solidras(light=light, binning=binning)
        least = bound(system, POSITION_UM, rounding=True)
        expected = exact_image(system, least.poses[0])
        frames = list(noisy(expected, system, count, stream(effort.seed, 2, number)))
        values = {}
        for method, analysis in (("fourier", by_fourier), ("likelihood", by_likelihood)):
            track = analysis(frames, system)
            values[method] = scatter_of(1e3 * np.stack([track.x_um, track.y_um], axis=1))
        rows.append(
            Row(
                f"resolution per image, x and y, {name}", "nm", f"{paper:.1f}", **values,
                bound=Value(least.sigma_nm), why=_WHY,
            )
        )  # fmt: skip
        found.append(
            {"case": name, "paper_nm": paper, "bound_nm": least.sigma_nm, "images": count}
            | {f"{method}_nm": value.value for method, value in values.items()}
            | {f"{method}_sigma_nm": value.sigma for method, value in values.items()}
        )
    figure = _draw(found)
    caption = (
        f"Scatter of the position in {count} simulated images of one scene (exact generator, "
        "noise, 8 bits), rms of x and y; with one standard deviation."
    )
    return Outcome(
        "Section 5", "Resolution per image", caption, figure, tuple(rows), {"cases": found}
    )


def _draw(found: list[dict[str, Any]]) -> Any:
    figure = new_figure(8.5, 4.2)
    axes = figure.subplots()
    x = np.arange(len(found))
    series = (
        ("paper (SOAP)", "paper_nm", VERMILION, "D", -0.18),
        ("fourier", "fourier_nm", ORANGE, "^", -0.06),
        ("likelihood", "likelihood_nm", BLUE, "o", 0.06),
    )
    for label, key, colour, marker, shift in series:
        errors = [one.get(key.replace("_nm", "_sigma_nm"), 0.0) for one in found]
        values = [one[key] for one in found]
        axes.errorbar(
            x + shift, values, errors, fmt=marker, color=colour, markersize=8, label=label,
            capsize=3,
        )  # fmt: skip
        for place, value in zip(x + shift, values, strict=True):
            above = marker != "o"
            axes.annotate(
                f"{value:.2g}", (place, value), textcoords="offset points",
                xytext=(0, 8 if above else -16), ha="center", fontsize=8,
            )  # fmt: skip
    for place, one in zip(x, found, strict=True):
        axes.hlines(
            one["bound_nm"], place - 0.3, place + 0.3, color=BLACK, linestyle="--",
            label="Cramer-Rao bound" if place == 0 else "_",
        )  # fmt: skip
    axes.set_xticks(x, [one["case"].replace(", ", ",\n") for one in found])
    axes.set_yscale("log")
    axes.set_ylim(0.2, 9)
    axes.set_yticks([0.2, 0.5, 1, 2, 5], ["0.2", "0.5", "1", "2", "5"])
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("resolution per image, nm")
    axes.grid(axis="y", color="#e4e4e4")
    axes.set_axisbelow(True)
    axes.legend(frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.12))
    return figure
