"""A row of pixels across one contour, and how well that row knows where the contour is."""

from __future__ import annotations

import math

import numpy as np

from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.noise import add_noise
from rasnik.imaging.projection import Projection
from rasnik.instrument import System, load_system
from rasnik.paper.images import (
    POSITION_UM,
    by_fourier,
    by_likelihood,
    noisy,
    show_image,
    solidras,
    stream,
)
from rasnik.paper.outcome import BLUE, VERMILION, Effort, Outcome, Row, Value, new_figure
from rasnik.performance.bound import bound

__all__ = ["contour", "crossings"]

# Principles: "standard Rasnik systems (pixel pitch of 10 um, and sensor dimension of 4 mm x
# 3 mm)"; a contour length of 100 mm in each direction makes fields of 4 mm x 3 mm / 100 mm.
_STANDARD = {
    "mask.field_um": 120.0,
    "sensor.pixel_um": 10.0,
    "sensor.width_px": 400,
    "sensor.height_px": 300,
}
_PAPER_CROSSINGS = 15_000


def crossings(system: System) -> float:
    """How many rows of pixels cross a vertical contour, over the whole image."""
    height, width = system.shape
    contour_um = height * width * system.pitch_um**2 / (system.mask.field_um * system.optics.scale)
    return contour_um / system.pitch_um


def contour(effort: Effort) -> Outcome:
    """Fig. 2, and the precision of one crossing and of the mean of all."""
    system = solidras(width_px=120, height_px=90)
    place = Projection.from_pose(*POSITION_UM, 1.0, 0.0, 4)
    image = add_noise(exact_image(system, place), system, effort.seed)
    row, column = _a_contour(image)
    part = image[row - 5 : row + 5, column : column + 10]
    levels = part[5].astype(float)
    steps = levels[2:] - levels[:-2]
    figure = new_figure(9, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
    show_image(left, part, "a contour in 10 x 10 pixels")
    left.axhline(5, color=VERMILION, linewidth=1.2)
    n = np.arange(10)
    right.plot(n, levels, "o-", color=VERMILION, label="$Q_n$")
    right.plot(n[1:-1], np.abs(steps), "s--", color=BLUE, label="$|Q_{n+1} - Q_{n-1}|$")
    right.set_xlabel("pixel n of the marked row")
    right.set_ylabel("grey level")
    right.set_ylim(0, 265)
    right.grid(color="#e4e4e4")
    right.legend(frameon=False)
    rows, data = _precision(effort)
    caption = (
        "Left: a vertical contour of a simulated SolidRas image. Right: the marked row of pixels "
        "(red circles) and its differences (blue squares), whose peak marks the contour."
    )
    data |= {"levels": levels, "steps": steps}
    return Outcome("Fig. 2", "A contour and its derivative", caption, figure, rows, data)


def _a_contour(image: np.ndarray) -> tuple[int, int]:
    """(row, column) from which ten pixels of a row hold a vertical contour in their middle."""
    grey = image.astype(float)
    for row in range(20, grey.shape[0] - 20):
        window = grey[row - 6 : row + 6]
        steps = np.abs(np.diff(window, axis=1)).min(axis=0)
        column = int(np.argmax(steps[20:-20])) + 20
        if steps[column] > 60:
            return row, column - 4
    raise RuntimeError("the image shows no vertical contour")


def _precision(effort: Effort) -> tuple[tuple[Row, ...], dict[str, float]]:
    """The standard Rasnik of the paper's section 2, in a simulation."""
    system = load_system("solidras", _STANDARD)
    least = bound(system, POSITION_UM, rounding=True)
    frames = list(
        noisy(
            exact_image(system, least.poses[0]),
            system,
            effort.pick(64, 400),
            stream(effort.seed, 1),
        )
    )
    count = crossings(system)
    found = {
        name: 1e3 * float(np.std(track.x_um, ddof=1))
        for name, track in (
            ("fourier", by_fourier(frames, system)),
            ("likelihood", by_likelihood(frames, system)),
        )
    }
    chance = 1 / math.sqrt(2 * (len(frames) - 1))
    each = math.sqrt(count) * 1e-3

    def row(quantity: str, unit: str, paper: str, factor: float, why: str) -> Row:
        values = {n: Value(factor * v, factor * v * chance) for n, v in found.items()}
        return Row(quantity, unit, paper, **values, bound=Value(factor * least.sigma_x_nm), why=why)

    why = (
        "The paper does not state light or blur of the standard system: ours has those of SolidRas "
        "(25..252, 4.5 µm). The fit uses every pixel of the edge by its noise rather than the top "
        "of a derivative. One crossing is the whole image times the square root of the number of "
        f"crossings: {count:.0f} by 100 mm of contour and pixels of 10 µm, where the paper counts "
        f"{_PAPER_CROSSINGS}."
    )
    rows = (
        row("standard Rasnik, one crossing of a contour", "µm", "~0.2", each, why),
        row("standard Rasnik, per image", "nm", "~1.5", 1.0, why),
    )
    return rows, {"crossings": count, "paper_crossings": _PAPER_CROSSINGS, "images": len(frames)}
