"""All that a spectrum tells of one column of a track: floor, lines, Allan deviation, bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rasnik.characterisation.allan import Allan, allan
from rasnik.characterisation.floor import NoiseFloor, noise_floor
from rasnik.characterisation.gaps import IrregularTimesError, Series, even_series
from rasnik.characterisation.irregular import lomb_scargle
from rasnik.characterisation.lines import MAINS_HZ, Line, find_lines
from rasnik.characterisation.spectrum import Spectrum, welch
from rasnik.instrument import System
from rasnik.performance.bound import Bound, bound
from rasnik.tracking.track import Track

__all__ = ["TrackSpectrum", "bound_of", "bound_per_frame", "track_spectrum"]


@dataclass(frozen=True, eq=False)
class TrackSpectrum:
    """Spectrum of one column of a track.

    Attributes
    ----------
    label : str
        Which track it is.
    spectrum : Spectrum
    lines : tuple of Line
    floor : NoiseFloor or None
    no_floor : str
        Why there is none.
    series : Series or None
        None where times are irregular.
    allan : Allan or None
        None where times are irregular or frames too few.
    bound : float
        Cramer-Rao bound of a single frame, rounding counted, in the unit of the spectrum; NaN if
        it is not known.
    """

    label: str
    spectrum: Spectrum
    lines: tuple[Line, ...]
    floor: NoiseFloor | None
    no_floor: str
    series: Series | None
    allan: Allan | None
    bound: float

    @property
    def bound_asd(self) -> float:
        """The bound as a one-sided amplitude spectral density: sigma sqrt(2 / f)."""
        return self.bound * math.sqrt(2 / self.spectrum.rate_hz)

    def as_dict(self, *, curves: bool = False) -> dict[str, Any]:
        """For JSON; with the curves if wished."""
        spectrum, unit = self.spectrum, self.spectrum.unit
        end = f"_{unit}" if unit else ""
        known = math.isfinite(self.bound)
        ratio = self.floor.asd / self.bound_asd if known and self.floor else None
        document = {
            "track": self.label,
            "column": spectrum.name,
            "unit": unit,
            **spectrum.as_dict(),
            f"rms{end}": spectrum.rms(),
            "floor": self.floor.as_dict() if self.floor else None,
            "no_floor": self.no_floor or None,
            f"bound_asd{end}_rthz": self.bound_asd if known else None,
            f"bound_sigma_over_sqrt_f{end}_rthz": (
                self.bound / math.sqrt(spectrum.rate_hz) if known else None
            ),
            f"bound_per_frame{end}": self.bound if known else None,
            "floor_over_bound": ratio,
            "lines": [line.as_dict(unit) for line in self.lines],
            "allan": self.allan.as_dict() if self.allan else None,
        }
        if curves:
            document["frequency_hz"] = spectrum.frequency_hz.tolist()
            document[f"asd{end}_rthz"] = spectrum.asd.tolist()
            document[f"cumulative_rms{end}"] = spectrum.cumulative_rms.tolist()
        return document


def track_spectrum(
    track: Track,
    column: str = "x_um",
    *,
    label: str = "",
    rate_hz: float | None = None,
    windows: int | None = None,
    length_s: float | None = None,
    irregular: bool = False,
    floor_range_hz: tuple[float, float] | None = None,
    mains_hz: Sequence[float] = MAINS_HZ,
    limit: Bound | None = None,
) -> TrackSpectrum:
    """Spectrum of one column, with all that is read off it.

    Parameters
    ----------
    track : Track
    column : str
    label : str
    rate_hz : float, optional
        For tracks without times.
    windows, length_s : optional
        Number of windows or their length; see `window_length`.
    irregular : bool
        Take the periodogram of Lomb and Scargle at the times that the frames have.
    floor_range_hz : tuple of float, optional
        Where the noise floor is; found by default.
    mains_hz : sequence of float
        Frequencies of which harmonics are named.
    limit : Bound, optional
        As `bound_of` gives it.

    Raises
    ------
    ValueError
        If the times are irregular and `irregular` is not set, or frames too few.
    """
    series, deviation = None, None
    if irregular:
        if rate_hz is not None:
            raise ValueError("irregular times are used as they are; a rate cannot be given as well")
        spectrum = lomb_scargle(track, column, windows=windows, length_s=length_s)
    else:
        try:
            series = even_series(track, column, rate_hz=rate_hz)
        except IrregularTimesError as error:
            raise ValueError(f"{error}, or ask for the Lomb-Scargle periodogram") from None
        spectrum = welch(series, windows=windows, length_s=length_s)
        deviation = allan(series)
    lines = find_lines(spectrum, mains_hz=mains_hz)
    floor, reason = None, ""
    try:
        floor = noise_floor(spectrum, lines, range_hz=floor_range_hz)
    except ValueError as error:
        reason = str(error)
    per_frame = bound_per_frame(limit, column)
    return TrackSpectrum(
        label, spectrum, lines, floor, reason, series, deviation, per_frame
    )  # fmt: skip


def bound_of(track: Track, system: System | None) -> Bound | None:
    """The bound at the median pose, rounding counted; None if the system states no noise."""
    if system is None or system.noise_law is None or not track.ok.any():
        return None
    here = track[track.ok]
    x_um, y_um, theta_rad = (
        float(np.median(values)) for values in (here.x_um, here.y_um, here.theta_rad)
    )
    return bound(system, (x_um, y_um, theta_rad), rounding=True)


def bound_per_frame(limit: Bound | None, column: str) -> float:
    """The bound of a column, in nm, rad or as a ratio; NaN where there is none."""
    if limit is None:
        return math.nan
    return {
        "x_um": limit.sigma_x_nm,
        "y_um": limit.sigma_y_nm,
        "scale": limit.sigma_scale,
        "theta_rad": limit.sigma_theta_rad,
    }.get(column, math.nan)
