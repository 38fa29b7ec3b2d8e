"""Noise floors: spectra of simulated recordings of SolidRas and MicroRas."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from rasnik.imaging.motion import Motion
from rasnik.instrument import System, load_system
from rasnik.paper.asd import Asd, asd_of
from rasnik.paper.images import solidras
from rasnik.paper.instruments import IN_AIR, MICRORAS, SUSPENDED, UV, Recording, record
from rasnik.paper.outcome import (
    BLACK,
    BLUE,
    GREEN,
    SKY,
    VERMILION,
    Effort,
    Outcome,
    Row,
    Value,
    new_figure,
)
from rasnik.performance.bound import bound

__all__ = ["frame_rates", "light_levels", "microras", "solidras_uv"]

_CONVENTION = (
    "The paper computes sigma/√f and compares it with a Welch plot, which for white noise is "
    "one-sided and √2 higher; which of the two its measured floors are is not stated."
)
_WHY_FLOOR = (
    "The fit takes from the images what the bound allows, the paper's analysis 4 to 7 times less "
    f"(its 3.3 nm per image against a bound of 0.48). {_CONVENTION}"
)
_WHY_UV = (
    "With the field size kept, half the blur improves the bound little, since pixels of 13.8 µm "
    "smear the contours as much; the paper saw 180 fall to 110, and a sharper image may have "
    f"served its analysis more. {_CONVENTION}"
)
_WHY_MICRORAS = (
    "The paper does not state MicroRas' field size, blur or grey levels; those here are derived "
    f"from SolidRas, so the bound is of the right order only. {_CONVENTION}"
)
_WHY_THETA = (
    "The paper's figure makes 17 µrad per image if it is sigma/√f, some 60 times the bound and 27 "
    "times a plain Fourier analysis. It says that its simulations agree, but neither shows them "
    "nor says how theta_z is found from the spectrum."
)


@dataclass(frozen=True, eq=False)
class _Series:
    """One recording with its spectra and its bound."""

    label: str
    recording: Recording
    x: Asd
    y: Asd
    theta: Asd
    colour: str
    line: str

    @property
    def system(self) -> System:
        return self.recording.system

    @property
    def rate_hz(self) -> float:
        return self.system.sensor.frame_rate_hz or math.nan

    @property
    def floor(self) -> Value:
        """One-sided ASD of x and y together, pm/sqrt(Hz)."""
        x, y = self.x.floor, self.y.floor
        power = (x.value**2 + y.value**2) / 2
        sigma = math.hypot(x.value * x.sigma, y.value * y.sigma) / (2 * math.sqrt(power))
        return Value(math.sqrt(power), sigma)

    @property
    def fourier(self) -> Value:
        """The same of the Fourier method, from its errors."""
        errors = 1e6 * self.recording.fourier_errors[:, :2]
        sigma = math.sqrt(float(errors.var(axis=0, ddof=1).mean()))
        level = sigma * math.sqrt(2 / self.rate_hz)
        return Value(level, level / math.sqrt(4 * (len(errors) - 1)))

    @property
    def fourier_theta(self) -> Value:
        errors = self.recording.fourier_errors[:, 3]
        level = float(errors.std(ddof=1)) * math.sqrt(2 / self.rate_hz)
        return Value(level, level / math.sqrt(2 * (len(errors) - 1)))

    @property
    def least(self) -> Value:
        """The bound as one-sided ASD, pm/sqrt(Hz)."""
        sigma_pm = 1e3 * bound(self.system, rounding=True).sigma_nm
        return Value(sigma_pm * math.sqrt(2 / self.rate_hz))

    def as_dict(self) -> dict[str, Any]:
        """For JSON: floors and curves."""
        return {
            "label": self.label,
            "frames": len(self.recording.track),
            "frame_rate_hz": self.rate_hz,
            "asd_floor_pm_rthz": self.floor.value,
            "asd_floor_sigma_pm_rthz": self.floor.sigma,
            "asd_floor_bound_pm_rthz": self.least.value,
            "asd_floor_fourier_pm_rthz": self.fourier.value,
            "theta_asd_floor_rad_rthz": self.theta.floor.value,
            "frequency_hz": self.x.frequency_hz,
            "asd_x_pm_rthz": self.x.density,
            "asd_y_pm_rthz": self.y.density,
            "lines_x_hz": [line.frequency_hz for line in self.x.lines],
            "lines_y_hz": [line.frequency_hz for line in self.y.lines],
            "floor_range_hz": self.x.floor_range_hz,
        }


def _series(
    label: str,
    system: System,
    motions: tuple[Motion, ...],
    effort: Effort,
    number: int,
    look: tuple[str, str],
) -> _Series:
    recording = record(
        system, motions, effort.pick(1500, 12_000), (effort.seed, 6, number), effort.pick(100, 800)
    )
    track = recording.track
    x, y = (asd_of(track, column, 1e3) for column in ("x_um", "y_um"))
    return _Series(label, recording, x, y, asd_of(track, "theta_rad"), *look)


# ------------------------------------------------------------------------ the figures


def light_levels(effort: Effort) -> Outcome:
    """Fig. 11: full light, a half, a quarter and an eighth, on a lab table."""
    looks = ((GREEN, "-"), (VERMILION, "-"), (SKY, "-"), (BLUE, "-"))
    names = ("full light", "1/2", "1/4", "1/8")
    series = [
        _series(name, solidras(light=0.5**k, binning=2), IN_AIR, effort, k, look)
        for k, (name, look) in enumerate(zip(names, looks, strict=True))
    ]
    rows = [
        *_floor_rows(
            "SolidRas, full light, superpixels",
            series[0],
            ("180 (plot)", "200 (from 3.3 nm)"),
            _WHY_FLOOR,
        )
    ]
    pure = [_shot_noise_only(one.system) for one in series]
    for k in range(3):
        rows.append(
            _ratio_row(
                f"noise floor, light {names[k + 1]} / light {'1' if k == 0 else names[k]}",
                "1.41 (√2)", series[k + 1], series[k],
                "√2 holds for shot noise alone: without electronic noise and rounding the bound "
                f"rises by {pure[k + 1] / pure[k]:.3f}. A = 0.26 and the rounding to 8 bits "
                "stay as the light falls, so it rises by more; so do the paper's own simulations "
                "(3.0 to 4.8 nm, a factor 1.6), where its measurement saw √2.",
            )
        )  # fmt: skip
    caption = (
        "One-sided amplitude spectral density of x and y of SolidRas with superpixels at 275 Hz, "
        "by the tracker, at four levels of light. Motion by the air, which rises to low "
        "frequencies, is simulated. Dashes on the right: Cramer-Rao bound."
    )
    return _outcome("Fig. 11", "Noise floors at four levels of light", caption, series, rows)


def frame_rates(effort: Effort) -> Outcome:
    """Fig. 12: 275 Hz, 100 Hz, and half the light, suspended in vacuum."""
    full = solidras(binning=2)
    cases = (
        ("275 Hz", full, (VERMILION, "-")),
        ("100 Hz", solidras(binning=2, frame_rate_hz=100.0), (SKY, "-")),
        ("half light", solidras(light=0.5, binning=2), (BLUE, "-")),
    )
    series = [
        _series(name, system, SUSPENDED, effort, 10 + k, look)
        for k, (name, system, look) in enumerate(cases)
    ]
    best, slow, half = series
    theta = bound(full, rounding=True).sigma_theta_rad
    micro, rate = 1e6, best.rate_hz
    rows = [
        _ratio_row(
            "noise floor, 100 Hz / 275 Hz", "1.6 (√2.75 = 1.66)", slow, best,
            "White noise: the resolution per image stays, and the lower frame rate spreads it "
            "over a narrower band.",
        ),
        _ratio_row(
            "noise floor, half light / full light, suspended", "1.41", half, best,
            "As for the levels of light on the lab table: A and the rounding stay as it falls.",
        ),
        Row(
            "theta_z noise floor, one-sided ASD", "µrad/√Hz", "1.0",
            _times(best.fourier_theta, micro), _times(best.theta.floor, micro),
            Value(micro * theta * math.sqrt(2 / rate)),
            _WHY_THETA,
        ),
        Row(
            "theta_z noise floor, sigma/√f", "µrad/√Hz", "",
            _times(best.fourier_theta, micro / math.sqrt(2)),
            _times(best.theta.floor, micro / math.sqrt(2)),
            Value(micro * theta / math.sqrt(rate)), _WHY_THETA,
        ),
    ]  # fmt: skip
    caption = (
        "SolidRas with superpixels as a pendulum in vacuum: one-sided amplitude spectral density "
        "of x and y by the tracker. The peak near 1.9 Hz is the pendulum. Windows of 1.44 s as in "
        "the paper (one hour in 5000 windows). Dashes on the right: Cramer-Rao bound."
    )
    return _outcome("Fig. 12", "Frame rate and light, suspended", caption, series, rows)


def solidras_uv(effort: Effort) -> Outcome:
    """Fig. 15: 365 nm and a diaphragm of 8 mm."""
    system = load_system("solidras-uv", {"sensor.binning": 2})
    series = [_series("SolidRas UV", system, UV, effort, 20, (BLUE, "-"))]
    rows = _floor_rows("SolidRas UV, 8 mm diaphragm", series[0], ("110 (plot)", ""), _WHY_UV)
    caption = (
        "SolidRas with the ultraviolet LED, suspended. The peaks in y near 20 Hz are the "
        "strings stretching, absent in x; their sizes are chosen. Dashes: Cramer-Rao bound."
    )
    return _outcome("Fig. 15", "SolidRas with ultraviolet light", caption, series, rows)


def microras(effort: Effort) -> Outcome:
    """Fig. 18: the microscope objective."""
    system = load_system("microras", {"sensor.binning": 2})
    series = [_series("MicroRas", system, MICRORAS, effort, 30, (BLUE, "-"))]
    rows = _floor_rows("MicroRas", series[0], ("7 (plot)", ""), _WHY_MICRORAS)
    caption = (
        "MicroRas on wires of 30 mm, 275 Hz, superpixels: pendulum near 3 Hz, a broad resonance "
        "of the unit at 25 Hz, lines at 25, 50, 75 and 100 Hz. Their sizes are chosen; the floor "
        "follows from the light. Dashes: Cramer-Rao bound."
    )
    return _outcome("Fig. 18", "MicroRas", caption, series, rows)


# ------------------------------------------------------------------------ rows


def _times(value: Value, factor: float) -> Value:
    return Value(factor * value.value, factor * value.sigma)


def _floor_rows(name: str, one: _Series, paper: tuple[str, str], why: str) -> list[Row]:
    """Both conventions; `paper` in the same order."""
    plain = 1 / math.sqrt(2)
    return [
        Row(f"{name}: noise floor, one-sided ASD", "pm/√Hz", paper[0], one.fourier,
            one.floor, one.least, why),
        Row(f"{name}: noise floor, sigma/√f", "pm/√Hz", paper[1], _times(one.fourier, plain),
            _times(one.floor, plain), _times(one.least, plain), why),
    ]  # fmt: skip


def _ratio_row(name: str, paper: str, above: _Series, below: _Series, why: str) -> Row:
    def ratio(a: Value, b: Value) -> Value:
        value = a.value / b.value
        return Value(value, value * math.hypot(a.sigma / a.value, b.sigma / b.value))

    return Row(
        name, "factor", paper, ratio(above.fourier, below.fourier), ratio(above.floor, below.floor),
        Value(above.least.value / below.least.value), why,
    )  # fmt: skip


def _shot_noise_only(system: System) -> float:
    return bound(load_system(system, {"sensor.noise_a": 0.0})).sigma_nm


# ------------------------------------------------------------------------ the picture


def _outcome(
    source: str, title: str, caption: str, series: Sequence[_Series], rows: Sequence[Row]
) -> Outcome:
    data = {"series": [one.as_dict() for one in series], "density": "one-sided"}
    return Outcome(source, title, caption, _draw(series), tuple(rows), data)


def _draw(series: Sequence[_Series]) -> Figure:
    figure = new_figure(9.5, 7.2)
    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    for axes, name in zip(panels, "xy", strict=True):
        for one in series:
            curve: Asd = getattr(one, name)
            axes.loglog(
                curve.frequency_hz, curve.density, one.line, color=one.colour, linewidth=1.0,
                label=f"{one.label}: {curve.floor.text} pm/√Hz",
            )  # fmt: skip
            axes.hlines(
                one.least.value, *curve.floor_range_hz, color=BLACK, linestyle=(0, (6, 3)),
                linewidth=1.1, zorder=5,
            )  # fmt: skip
            if len(series) > 1:  # so that curves can be told apart without colours
                axes.annotate(
                    one.label, (curve.frequency_hz[-1], curve.floor.value), xytext=(6, 0),
                    textcoords="offset points", va="center", fontsize=8, color=one.colour, zorder=6,
                    bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85},
                )  # fmt: skip
        axes.set_ylabel(f"ASD of {name}, pm/√Hz (one-sided)")
        axes.grid(which="both", color="#e9e9e9", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.legend(frameon=False, fontsize=9, loc="upper right", title="noise floor")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylim(bottom=0.4 * min(one.least.value for one in series))
    right = max(float(one.x.frequency_hz[-1]) for one in series)
    axes.set_xlim(0.6, right * (1.75 if len(series) > 1 else 1.1))
    axes.set_xlabel("frequency, Hz")
    return figure
