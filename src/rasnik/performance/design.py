"""Design: the bound over one or two parameters of an instrument, and where it is best.

Source: van der Graaf et al., section 2 (there is an optimal field size) and section 6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from rasnik.analysis.fourier import LEAST_PIXELS_PER_FIELD
from rasnik.instrument import System, load_system
from rasnik.performance.bound import Bound, bound
from rasnik.performance.coupling import EXTRA_KEYS, Coupling, coupled

__all__ = ["FIGURES", "Curve", "Design", "Variation", "best_field", "explore", "parse_variation"]

#: Figures of merit, with how they are written.
FIGURES = {
    "sigma_x_nm": "sigma of x per image, nm on the mask",
    "sigma_y_nm": "sigma of y per image, nm on the mask",
    "sigma_theta_rad": "sigma of theta_z per image, rad",
    "sigma_scale": "sigma of the scale per image",
    "image_sigma_x_nm": "sigma of x per image, nm on the sensor",
    "floor_x_pm_rthz": "sigma_x / sqrt(f), pm/sqrt(Hz) on the mask",
    "asd_x_pm_rthz": "one-sided ASD of x, pm/sqrt(Hz) on the mask",
    "asd_theta_rad_rthz": "one-sided ASD of theta_z, rad/sqrt(Hz)",
}

#: Random positions over which every point is averaged, so that curves are smooth.
PLACES = 3
_DEFAULT_POINTS = 21
_WHOLE = {"sensor.width_px", "sensor.height_px", "sensor.binning", "sensor.bit_depth",
          "mask.code_bits", "mask.columns", "mask.rows"}  # fmt: skip
_MOST_POINTS = 2500


@dataclass(frozen=True)
class Variation:
    """A parameter and the values it takes.

    Attributes
    ----------
    key : str
        Dotted name of a field of the system, or of `EXTRA_KEYS`.
    values : tuple of float or int
        Increasing.
    """

    key: str
    values: tuple[float, ...]

    @property
    def whole(self) -> bool:
        """Whether only whole numbers make sense."""
        return self.key in _WHOLE

    @property
    def logarithmic(self) -> bool:
        """Whether the values span a factor that calls for a logarithmic axis."""
        small = self.whole and self.values[-1] < 20
        return not small and self.values[0] > 0 and self.values[-1] / self.values[0] >= 3


def parse_variation(text: str, points: int = _DEFAULT_POINTS) -> Variation:
    """Read ``mask.field_um=20:200``, ``mask.field_um=20:200:41`` or ``sensor.binning=1,2,4``.

    The points are spaced evenly, or in equal ratios if the range spans a factor of three.

    Raises
    ------
    ValueError
        If it cannot be understood: one sentence.
    """
    key, equals, text_values = (part.strip() for part in text.partition("="))
    how = "write KEY=LOW:HIGH, KEY=LOW:HIGH:POINTS or KEY=A,B,C, as mask.field_um=20:200"
    if not key or not equals or not text_values:
        raise ValueError(f"--vary {text!r} is not understood: {how}")
    try:
        if ":" in text_values:
            low, high, *rest = (float(part) for part in text_values.split(":"))
            if len(rest) > 1 or any(n != int(n) for n in rest):
                raise ValueError
            values = _range(text, low, high, int(rest[0]) if rest else points)
        else:
            values = np.array([float(part) for part in text_values.split(",")])
    except OverflowError:
        raise ValueError(f"--vary {text!r} is not understood: {how}") from None
    except ValueError as error:
        raise (
            error
            if str(error).startswith("--vary")
            else ValueError(f"--vary {text!r} is not understood: {how}")
        ) from None
    if not np.isfinite(values).all():
        raise ValueError(f"--vary {text!r} has values that are not finite")
    if key in _WHOLE:
        values = np.rint(values)
        return Variation(key, tuple(int(v) for v in np.unique(values)))
    return Variation(key, tuple(float(v) for v in np.unique(values)))


def _range(text: str, low: float, high: float, points: int) -> NDArray[np.float64]:
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"--vary {text!r} must go from a lower to a higher value")
    if not 2 <= points <= _MOST_POINTS:
        raise ValueError(f"--vary {text!r} must have 2 to {_MOST_POINTS} points")
    if low > 0 and high / low >= 3:
        return np.geomspace(low, high, points)
    return np.linspace(low, high, points)


@dataclass(frozen=True, eq=False)
class Curve:
    """The figure of merit along one parameter.

    Attributes
    ----------
    variation : Variation
    figure : ndarray, shape (n,)
        NaN where the instrument would not work.
    field_um : ndarray, shape (n,)
        The field size, of the system or the best one at every point.
    contour_mm : ndarray, shape (n,)
        Length of the contours of one direction in view, on the sensor.
    contrast : ndarray, shape (n,)
        Of the fundamental tone of the chess pattern: exp(-pi^2 s^2 / a^2), s being blur and
        pixel together and a the field on the sensor.
    optimum : float
        Where it is best.
    best : float
        The figure there.
    wide : tuple of float
        Over what range it is within 5 % of the best, within the values.
    exponent : float
        n of figure ~ parameter^n, fitted; NaN if it makes no sense.
    """

    variation: Variation
    figure: NDArray[np.float64]
    field_um: NDArray[np.float64]
    contour_mm: NDArray[np.float64]
    contrast: NDArray[np.float64]
    optimum: float
    best: float
    wide: tuple[float, float]
    exponent: float


@dataclass(frozen=True, eq=False)
class Design:
    """A system whose parameters are varied.

    Attributes
    ----------
    system : System
    figure : str
        Key of `FIGURES`.
    rules : Coupling
    best_fields : bool
        Whether every point has the field size that is best for it.
    rounding : bool
        Whether rounding to whole grey levels counts.
    failures : dict
        Sentence by point that cannot work.
    """

    system: System
    figure: str = "sigma_x_nm"
    rules: Coupling = field(default_factory=Coupling)
    best_fields: bool = False
    rounding: bool = True
    failures: dict[tuple[float, ...], str] = field(default_factory=dict)

    def at(self, changes: Mapping[str, Any]) -> tuple[float, System | None]:
        """The figure at one point, and the system there; NaN, None where it cannot work."""
        try:
            system = coupled(self.system, changes, self.rules)
            if self.best_fields:
                system = best_field(system, rounding=self.rounding)
            value = _bound(system, self.rounding).figures()[self.figure]
        except ValueError as error:
            self.failures[tuple(changes.values())] = str(error)
            return math.nan, None
        if value is None:
            raise ValueError(
                f"{self.figure} needs the frame rate, which system {self.system.name} does not "
                "state: give sensor.frame_rate_hz with --set"
            )
        return float(value), system

    def curve(self, variation: Variation) -> Curve:
        """The figure along one parameter.

        Raises
        ------
        ValueError
            If the instrument would work nowhere: the first reason.
        """
        points = [self.at({variation.key: value}) for value in variation.values]
        figure = np.array([value for value, _ in points])
        self._check(figure)
        systems = [system for _, system in points]
        optimum, best = self._refined(variation, figure)
        near = _near(variation, figure, 1.05 * best)
        return Curve(
            variation,
            figure,
            _of(systems, lambda s: s.mask.field_um),
            _of(systems, _contour_mm),
            _of(systems, _contrast),
            optimum,
            best,
            (float(min([*near, optimum])), float(max([*near, optimum]))),
            _exponent(variation, figure),
        )

    def map(self, first: Variation, second: Variation) -> NDArray[np.float64]:
        """The figure over two parameters, shape (second, first)."""
        figure = np.array(
            [
                [self.at({first.key: a, second.key: b})[0] for a in first.values]
                for b in second.values
            ]
        )
        self._check(figure)
        return figure

    def _check(self, figure: NDArray[np.float64]) -> None:
        if not np.isfinite(figure).any():
            raise ValueError(next(iter(self.failures.values())))

    def _refined(self, variation: Variation, figure: NDArray[np.float64]) -> tuple[float, float]:
        """The best point, refined between its neighbours."""
        k, values = int(np.nanargmin(figure)), variation.values
        if variation.whole or k in (0, len(values) - 1):
            return values[k], float(figure[k])
        if not np.isfinite([figure[k - 1], figure[k + 1]]).all():
            return values[k], float(figure[k])
        found = minimize_scalar(
            lambda x: self.at({variation.key: float(x)})[0],
            bounds=(values[k - 1], values[k + 1]),
            method="bounded",
            options={"maxiter": 12, "xatol": 1e-3 * values[k]},
        )
        if found.fun < figure[k]:
            return float(found.x), float(found.fun)
        return values[k], float(figure[k])


def explore(
    system: System,
    variations: list[Variation],
    figure: str | None = None,
    rules: Coupling | None = None,
    *,
    best_fields: bool = False,
    rounding: bool = True,
) -> Design:
    """A `Design`, after checking that it can be asked for.

    Parameters
    ----------
    figure : str, optional
        By default sigma_x_nm; asd_x_pm_rthz if the frame rate is varied.

    Raises
    ------
    ValueError
        If the figure or a parameter is unknown, or the fields are both varied and optimised.
    """
    keys = [variation.key for variation in variations]
    if figure is None:
        figure = "asd_x_pm_rthz" if "sensor.frame_rate_hz" in keys else "sigma_x_nm"
    if figure not in FIGURES:
        raise ValueError(f"the figure must be one of {', '.join(FIGURES)}, not {figure!r}")
    if len(set(keys)) < len(keys):
        raise ValueError(f"{keys[0]} is varied twice")
    if best_fields and "mask.field_um" in keys:
        raise ValueError("mask.field_um is varied: it cannot be the best one at every point too")
    for variation in variations:
        if variation.key in EXTRA_KEYS:
            coupled(system, {variation.key: variation.values[0]})
        else:
            load_system(system, {variation.key: variation.values[0]})  # refuses unknown
    return Design(_endless(system), figure, rules or Coupling(), best_fields, rounding)


def _endless(system: System) -> System:
    """The system with as much mask as the code allows: a design should not end at its edge."""
    free = {f"mask.{name}": None for name in ("columns", "rows")}
    return load_system(system, {**free, "mask.first_column": 0, "mask.first_row": 0})


def best_field(system: System, *, rounding: bool = True) -> System:
    """The system with the field size at which the sigma of a position is least.

    Smaller fields have more contour, larger ones more contrast.

    Raises
    ------
    ValueError
        If no field size works.
    """
    system = _endless(system)
    low = 1.02 * LEAST_PIXELS_PER_FIELD * system.pitch_um / system.optics.scale
    smear = math.hypot(system.optics.blur_um, system.pitch_um / math.sqrt(12))
    high = max(3 * low, 12 * smear / system.optics.scale)

    def sigma(log_field: float) -> float:
        try:
            changed = load_system(system, {"mask.field_um": math.exp(log_field)})
            return bound(changed, count=1, rounding=rounding).sigma_nm  # the optimum is flat
        except ValueError:
            return math.inf

    grid = np.linspace(math.log(low), math.log(high), 9)
    values = [sigma(x) for x in grid]
    k = int(np.argmin(values))
    if not math.isfinite(values[k]):
        raise ValueError(f"no field size can be seen with a blur of {system.optics.blur_um:g} um")
    ends = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
    found = minimize_scalar(sigma, bounds=ends, method="bounded", options={"maxiter": 10})
    best = float(found.x) if found.fun < values[k] else float(grid[k])
    return load_system(system, {"mask.field_um": math.exp(best)})


def _bound(system: System, rounding: bool) -> Bound:
    return bound(system, count=PLACES, rounding=rounding)


def _of(systems: list[System | None], quantity: Callable[[System], float]) -> NDArray[np.float64]:
    return np.array([math.nan if s is None else quantity(s) for s in systems])


def _contour_mm(system: System) -> float:
    sensor = system.sensor
    area = sensor.width_px * sensor.height_px * sensor.pixel_um**2
    return 1e-3 * area / (system.mask.field_um * system.optics.scale)


def _contrast(system: System) -> float:
    smear = system.optics.blur_um**2 + system.pitch_um**2 / 12
    return math.exp(-(math.pi**2) * smear / (system.mask.field_um * system.optics.scale) ** 2)


def _near(variation: Variation, figure: NDArray[np.float64], limit: float) -> list[float]:
    """Values at which the figure is below a limit; between the points by interpolation."""
    good = np.isfinite(figure)
    values = np.array(variation.values, dtype=float)[good]
    fine = values if variation.whole else np.linspace(values[0], values[-1], 2001)
    return list(fine[np.interp(fine, values, figure[good]) <= limit])


def _exponent(variation: Variation, figure: NDArray[np.float64]) -> float:
    good = np.isfinite(figure)
    values = np.array(variation.values)
    if good.sum() < 3 or values.min() <= 0:
        return math.nan
    return float(np.polyfit(np.log(values[good]), np.log(figure[good]), 1)[0])
