"""What redoing a figure yields: a picture, rows of the table, and the numbers behind both."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rasnik.report.numbers import with_sigma

__all__ = [
    "BLACK",
    "BLUE",
    "GREEN",
    "ORANGE",
    "PURPLE",
    "SKY",
    "VERMILION",
    "Effort",
    "Outcome",
    "Row",
    "Value",
    "json_ready",
    "new_figure",
]

# The colours of Okabe and Ito, which the colour-blind tell apart. Curves differ in line or
# marker as well, for prints without colour.
BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
BLUE, VERMILION, PURPLE = "#0072b2", "#d55e00", "#cc79a7"

_DPI = 150


@dataclass(frozen=True)
class Effort:
    """How much is simulated: enough to see it, or enough to quote it."""

    quick: bool = False
    seed: int = 1

    def pick(self, quick: int, full: int) -> int:
        """A number of images, steps or frames."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Value:
    """A number and its standard deviation, NaN where it has none."""

    value: float
    sigma: float = math.nan

    @property
    def text(self) -> str:
        """As printed: as many digits as the standard deviation allows, else three."""
        if math.isfinite(self.sigma) and self.sigma > 0:
            return with_sigma(self.value, self.sigma)
        return f"{self.value:.3g}" if math.isfinite(self.value) else "-"


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    quantity, unit : str
    paper : str
        What the paper states, in its words or digits.
    fourier, likelihood, bound : Value or None
        By this package's two methods, and the least possible (Cramer and Rao).
    why : str
        One sentence on where and why these differ from the paper's.
    """

    quantity: str
    unit: str
    paper: str
    fourier: Value | None = None
    likelihood: Value | None = None
    bound: Value | None = None
    why: str = ""


@dataclass(frozen=True, eq=False)
class Outcome:
    """A figure done again.

    Attributes
    ----------
    source : str
        Which figures or numbers of the paper these are.
    title, caption : str
    figure : Figure
    rows : tuple of Row
        Lines for the table; none where the figure is a picture only.
    data : dict
        The numbers behind the picture, for JSON.
    """

    source: str
    title: str
    caption: str
    figure: Figure
    rows: tuple[Row, ...] = ()
    data: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """All but the picture, ready for JSON."""
        document = {
            "source": self.source,
            "title": self.title,
            "caption": self.caption,
            "rows": [asdict(row) for row in self.rows],
            "data": self.data,
        }
        return dict(json_ready(document))


def json_ready(value: Any) -> Any:
    """The same in types that JSON has; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): json_ready(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(one) for one in value]
    if isinstance(value, np.ndarray):
        return json_ready(value.tolist())
    if isinstance(value, np.bool_ | np.integer):
        return value.item()
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of this size in inches, that needs no screen."""
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure
