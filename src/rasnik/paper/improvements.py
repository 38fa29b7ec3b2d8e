"""Numbers of sections 2, 5 and 6 that follow from the bound alone: steps, mask errors, wells."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.ticker import FuncFormatter, NullFormatter

from rasnik.paper.contour import crossings
from rasnik.paper.images import POSITION_UM, solidras
from rasnik.paper.outcome import BLUE, SKY, VERMILION, Effort, Outcome, Row, Value, new_figure
from rasnik.performance.bound import bound
from rasnik.performance.improvements import Improvement, improvements
from rasnik.performance.light import light_of

__all__ = ["steps"]

_MASK_EDGE_NM = 6.0


def steps(effort: Effort) -> Outcome:
    """Section 6, Improvements, and single figures of sections 2 and 5."""
    # The measured steps have rows of their own, with simulated images.
    found = [
        one for one in improvements() if one.step.startswith("MicroRas") or one.bound_factor_best
    ]
    figure = new_figure(9.5, 0.9 + 0.42 * len(found))
    axes = figure.subplots()
    y = np.arange(len(found))
    for values, marker, colour, label in (
        ([one.paper_factor for one in found], "D", VERMILION, "paper"),
        ([one.bound_factor for one in found], "o", BLUE, "bound, fields as they are"),
        ([one.bound_factor_best for one in found], "s", SKY, "bound, best fields before and after"),
    ):
        axes.plot(
            [math.nan if value is None else value for value in values], y, marker,
            color=colour, label=label, markersize=7, fillstyle="full" if marker != "s" else "none",
            markeredgewidth=1.6,
        )  # fmt: skip
    axes.set_yticks(y, [one.step.replace("->", "→") for one in found])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xticks([1, 2, 3, 5, 10, 20, 50])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e4e4e4")
    axes.set_axisbelow(True)
    axes.set_xlabel("noise floor before / after")
    axes.legend(loc="upper center", bbox_to_anchor=(0.3, 1.12), ncols=3, frameon=False)
    caption = (
        "By how much the noise floor falls with each step that the paper proposes: its "
        "expectation, and the Cramer-Rao bound with rounding counted."
    )
    rows = (*_single(), *map(_row, found))
    data = {one.step: {"floor_pm_rthz": one.floor_pm_rthz, "paper": one.paper,
                       "bound_factor": one.bound_factor, "best_fields": one.bound_factor_best}
            for one in found}  # fmt: skip
    return Outcome(
        "Sections 3, 5, 6", "Single numbers and improvements", caption, figure, rows, data
    )


def _row(one: Improvement) -> Row:
    return Row(
        f"improvement: {one.step}".replace("->", "→"),
        "factor",
        one.paper.replace("->", "→").replace("rtHz", "√Hz"),
        bound=Value(one.bound_factor),
        why="The bound, with the field sizes as they are and the blur following wavelength and "
        "aperture; the picture also has the best field size before and after each step. A "
        "larger magnification gains only as far as the aperture grows with it, a shorter "
        "wavelength only as far as fields shrink with it.",
    )  # fmt: skip


def _single() -> tuple[Row, ...]:
    system = solidras()
    light = light_of(system)
    mask_pm = 1e3 * _MASK_EDGE_NM / math.sqrt(crossings(system))
    a, b = system.noise_law or (math.nan, math.nan)
    level = (1 - a) / b / system.full_scale
    coarse = bound(system, POSITION_UM, rounding=True).sigma_x_nm
    fine = bound(system, POSITION_UM).sigma_x_nm
    return (
        Row(
            "electrons in a white pixel of SolidRas", "1000 e-", "22 (well depth)",
            bound=Value((light.electrons_white or math.nan) / 1e3),
            why="Counted by the shot noise, 252 / B; at the highest grey level it would be "
            "255 / B = 23.2, 5 % above the well depth stated.",
        ),
        Row(
            "position error by mask edges of 6 nm", "pm", "50", bound=Value(mask_pm),
            why="The paper takes 6 nm over the square root of 1.5e4 independent values. The "
            f"contours of SolidRas are crossed by rows of pixels {crossings(system) / 1e3:.0f}k "
            "times, each counted as independent here; an error that is the same along a whole "
            "field side would make 119 pm.",
        ),
        Row(
            "light above which noise exceeds an 8-bit step", "% of full scale", "20",
            bound=Value(100 * level),
            why="From the paper's own law: 0.26 + 0.011 Q = 1 at Q = 67; at 20 % it is 0.91.",
        ),
        Row(
            "resolution with 8 bits / with 12 bits", "factor", "1 (no gain)",
            bound=Value(coarse / fine),
            why="Rounding adds the variance 1/12 in steps of grey level; with 12 bits that "
            "vanishes. The gain is small, as the paper says.",
        ),
    )  # fmt: skip
