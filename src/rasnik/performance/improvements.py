"""The steps that the paper proposes or measured: its factors beside those of the bound.

Source: van der Graaf et al., section 5 (measured steps) and section 6, "Improvements".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rasnik.instrument import System, load_system
from rasnik.performance.bound import bound
from rasnik.performance.coupling import coupled
from rasnik.performance.design import PLACES, best_field

__all__ = ["Improvement", "improvements"]


@dataclass(frozen=True)
class Improvement:
    """One claim of the paper.

    Attributes
    ----------
    step : str
        What changes.
    paper : str
        What the paper says, with its figures.
    paper_factor : float or None
        By how much the noise floor changes according to the paper: above 1 for the better.
    bound_factor : float
        The same of the bound, with the field sizes of the two systems as they are.
    bound_factor_best : float or None
        The same if both have the field size that is best for them; None if not asked.
    floor_pm_rthz : float
        sigma_x / sqrt(f) of the bound after the step, pm/sqrt(Hz) on the mask.
    floor_best_pm_rthz : float or None
        The same with the best field size.
    """

    step: str
    paper: str
    paper_factor: float | None
    bound_factor: float
    bound_factor_best: float | None
    floor_pm_rthz: float
    floor_best_pm_rthz: float | None


@dataclass(frozen=True)
class _Step:
    step: str
    paper: str
    factor: float | None
    before: System
    after: System
    best: bool = True


def improvements(advance: Callable[[], Any] = lambda: None) -> list[Improvement]:
    """Work out the factor of the bound for every claim.

    Rounding to whole grey levels counts. The improvements of section 6 are steps from MicroRas,
    the measured ones of section 5 steps from SolidRas.

    Parameters
    ----------
    advance : callable, optional
        Called after each row, to show progress.
    """
    known: dict[System, float] = {}
    rows = []
    for step in _steps():
        before, after = _floor(step.before, known), _floor(step.after, known)
        ideal: list[float] = []
        if step.best:
            ideal = [_best_floor(system, known) for system in (step.before, step.after)]
        rows.append(
            Improvement(
                step.step,
                step.paper,
                step.factor,
                before / after,
                ideal[0] / ideal[1] if ideal else None,
                after,
                ideal[1] if ideal else None,
            )
        )
        advance()
    return rows


def _floor(system: System, known: dict[System, float]) -> float:
    if system not in known:
        rate = system.sensor.frame_rate_hz or 1.0
        known[system] = 1e3 * bound(system, count=PLACES, rounding=True).sigma_nm / math.sqrt(rate)
    return known[system]


def _best_floor(system: System, known: dict[System, float]) -> float:
    """The least floor over field sizes: the system's own if the search finds nothing better."""
    return min(_floor(best_field(system), known), _floor(system, known))


def _steps() -> list[_Step]:
    return [*_measured(), *_wavelength(), *_objective(), *_sensor(), *_together()]


def _measured() -> list[_Step]:
    """Section 5: what was measured or simulated with SolidRas."""
    solidras = load_system("solidras")
    binned = load_system(solidras, {"sensor.binning": 2})

    def step(name: str, paper: str, factor: float, before: System, **changes: Any) -> _Step:
        dotted = {key.replace("__", "."): value for key, value in changes.items()}
        return _Step(name, paper, factor, before, coupled(before, dotted), best=False)

    return [
        step("SolidRas: half the light", "3.0 -> 4.8 nm per image (simulated)", 3.0 / 4.8,
             solidras, sensor__light_factor=0.5),
        step("SolidRas: half the light, superpixels", "3.3 -> 5.0 nm per image (simulated)",
             3.3 / 5.0, binned, sensor__light_factor=0.5),
        step("SolidRas: superpixels of 2 x 2", "3.0 -> 3.3 nm per image (simulated)", 3.0 / 3.3,
             solidras, sensor__binning=2),
        step("SolidRas: 275 -> 100 Hz", "1.6 (measured)", 1 / 1.6, solidras,
             sensor__frame_rate_hz=100.0),
        _Step("SolidRas: diaphragm 4 -> 8 mm", "2 (expected)", 2.0, solidras,
              coupled(solidras, {"optics.diaphragm_mm": 8.0})),
        _Step("SolidRas: 8 mm and 365 nm, superpixels", "200 -> 110 pm/rtHz (measured)",
              200 / 110, binned,
              coupled(binned, {"optics.diaphragm_mm": 8.0, "optics.wavelength_nm": 365.0})),
    ]  # fmt: skip


def _wavelength() -> list[_Step]:
    found = []
    for name in ("solidras", "microras"):
        system = load_system(name)
        label = "SolidRas" if name == "solidras" else "MicroRas"
        found.append(
            _Step(
                f"{label}: 448 -> 200 nm",
                "3; by its law lambda^(1/1.5) 1.7",
                3.0,
                system,
                coupled(system, {"optics.wavelength_nm": 200.0}),
            )
        )
    return found


def _objective() -> list[_Step]:
    microras = load_system("microras")
    return [
        _Step(
            f"MicroRas: 20x -> 40x, {what}",
            "2",
            2.0,
            microras,
            coupled(microras, {"optics.scale": 40.0, "optics.numerical_aperture": aperture}),
        )
        for what, aperture in (
            ("same NA 0.40", 0.40),
            ("NA 0.65", 0.65),
            ("NA 0.80: same blur on sensor", 0.80),
        )
    ]


def _sensor() -> list[_Step]:
    microras = load_system("microras")
    faster = coupled(microras, {"sensor.frame_rate_hz": 860.0})
    return [
        _Step("MicroRas: 275 -> 860 Hz, same sensor", "1.7", 1.7, microras, faster, best=False),
        _Step("MicroRas: MER-031-860 (smaller sensor)", "1.7", 1.7, microras,
              load_system("microras-860hz")),
    ]  # fmt: skip


def _together() -> list[_Step]:
    microras = load_system("microras")
    offshelf = load_system("microras-offshelf")
    return [
        _Step("MicroRas: 365 nm, reflective 40x, MER-031-860", "7, to 1 pm/rtHz", 7.0, microras,
              offshelf),
        _Step("MicroRas: 200 nm, reflective 40x, MER-031-860", "7, to 1 pm/rtHz", 7.0, microras,
              coupled(offshelf, {"optics.wavelength_nm": 200.0})),
        _Step("MicroRas: 200 nm, 40x, 860 Hz, 1e6 electrons", "35, to 0.2 pm/rtHz", 35.0,
              microras, load_system("microras-ultimate")),
    ]  # fmt: skip
