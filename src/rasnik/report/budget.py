"""The error budget as a plot: every source's share of x and y, the largest on top."""

from __future__ import annotations

import os

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rasnik.performance.budget import Budget, Contribution

__all__ = ["budget_figure", "draw_budget"]

#: Colour and meaning of what is new in every image, of what drifts and of what stays.
TIMES = {
    "white": ("#2f6fb3", "white: new in every image, averages away"),
    "slow": ("#d1762b", "slow: drifts, correlated in time"),
    "fixed": ("#7a7a7a", "fixed: felt as far as the mask moves"),
}
_DPI = 110
_RANGE = 1e5  # between the longest bar and the shortest that is shown


def budget_figure(budget: Budget) -> Figure:
    """Bars of all contributions within a factor 1e5 of the largest, on a logarithmic axis."""

    def size(one: Contribution) -> float:
        return max(one.x_nm or 0.0, one.y_nm or 0.0)

    largest = max(size(one) for one in budget.contributions)
    rows = sorted((c for c in budget.contributions if size(c) > largest / _RANGE), key=size)
    figure = Figure(figsize=(9.5, 1.9 + 0.33 * len(rows)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for k, row in enumerate(rows):
        colour = TIMES[row.time][0]
        axes.barh(k + 0.19, row.x_nm or 0, 0.36, color=colour)
        axes.barh(k - 0.19, row.y_nm or 0, 0.36, color=colour, alpha=0.55)
    axes.set_xscale("log")
    axes.set_xlim(largest / _RANGE, 3 * largest)
    axes.set_yticks(range(len(rows)), [row.source for row in rows])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    bound = budget.bound.sigma_nm
    axes.axvline(bound, color="black", linewidth=1, linestyle="--")
    axes.annotate(
        f"bound {bound:.3g} nm per image",
        (bound, 0.012),
        xycoords=("data", "axes fraction"),
        xytext=(5, 0),
        textcoords="offset points",
        fontsize=9,
    )
    axes.set_xlabel("contribution, nm on the mask (upper bar x, lower and paler bar y)")
    axes.set_title(f"{budget.system.name}: error sources of a position")
    axes.grid(axis="x", which="major", color="#dddddd")
    axes.set_axisbelow(True)
    handles = [Patch(color=colour, label=label) for colour, label in TIMES.values()]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def draw_budget(budget: Budget, path: str | os.PathLike[str]) -> None:
    """Write the plot to a file; its suffix chooses the format."""
    budget_figure(budget).savefig(path)
