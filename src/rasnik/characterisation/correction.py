"""A linearity correction: periodic errors found by folding, taken off a track on request."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.folding import Folding
from rasnik.tracking.track import Track

__all__ = ["Correction", "Term", "apply_correction", "correction_of"]

_KIND = "rasnik linearity correction"
_APPLIED = "linearity_correction"
_GRID = 64  # positions of the table that is written for other programs


@dataclass(frozen=True)
class Term:
    """One periodic error of one coordinate.

    ``error(x) = sum over k of cosine_nm[k-1] cos(2 pi k x / period) + sine_nm[k-1] sin(...)``,
    measured minus true, as a function of the measured position.
    """

    axis: str
    name: str
    period_um: float
    cosine_nm: tuple[float, ...]
    sine_nm: tuple[float, ...]
    sigma_rms_nm: float

    def error_nm(self, position_um: NDArray[np.float64]) -> NDArray[np.float64]:
        """Error at positions of any shape."""
        turn = np.exp(2j * np.pi * (np.asarray(position_um) / self.period_um % 1.0))
        total, power = np.zeros(np.shape(position_um)), np.ones_like(turn)
        for cosine, sine in zip(self.cosine_nm, self.sine_nm, strict=True):
            power = power * turn
            total += cosine * power.real + sine * power.imag
        return total

    def as_dict(self) -> dict[str, Any]:
        """For JSON, with a table for programs that do not know of harmonics."""
        grid = np.arange(_GRID, dtype=np.float64) * (self.period_um / _GRID)
        return {
            "axis": self.axis,
            "name": self.name,
            "period_um": self.period_um,
            "cosine_nm": list(self.cosine_nm),
            "sine_nm": list(self.sine_nm),
            "sigma_rms_nm": self.sigma_rms_nm,
            "position_um": grid.tolist(),
            "error_nm": self.error_nm(grid).tolist(),
        }


@dataclass(frozen=True)
class Correction:
    """The periodic errors to be taken off the coordinates of a track."""

    terms: tuple[Term, ...]

    def error_nm(self, axis: str, position_um: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of the errors of an axis at measured positions."""
        total = np.zeros(np.shape(position_um))
        for term in self.terms:
            if term.axis == axis:
                total += term.error_nm(position_um)
        return total

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"kind": _KIND, "terms": [term.as_dict() for term in self.terms]}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Correction:
        """What `as_dict` gave.

        Raises
        ------
        ValueError
            If it is something else.
        """
        if document.get("kind") != _KIND:
            raise ValueError("this is not a linearity correction; rasnik linearity TRACK makes one")
        try:
            return cls(tuple(_term(one) for one in document["terms"]))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"the linearity correction is damaged: {error}") from None


def _term(one: Mapping[str, Any]) -> Term:
    cosine, sine = ([float(v) for v in one[key]] for key in ("cosine_nm", "sine_nm"))
    period, sigma = float(one["period_um"]), float(one["sigma_rms_nm"])
    if len(cosine) != len(sine) or one["axis"] not in ("x", "y"):
        raise ValueError("a term needs as many cosines as sines and an axis x or y")
    if not (period > 0 and all(math.isfinite(v) for v in (*cosine, *sine, period))):
        raise ValueError("its numbers must be finite and its period positive")
    return Term(one["axis"], str(one["name"]), period, tuple(cosine), tuple(sine), sigma)


def correction_of(folding: Folding) -> Correction:
    """The errors that were detected, each counted once.

    Two fields hold the harmonics of one field, so one field is taken only where two fields
    show nothing; a pixel is taken unless its period is among the harmonics of the fields.

    Parameters
    ----------
    folding : Folding

    Returns
    -------
    Correction
        Without terms if no error was detected.
    """
    terms: list[Term] = []
    for found in sorted(folding.folds, key=lambda one: -one.period_um):
        if not found.detected:
            continue
        frequency = 1 / found.period_um
        if any(
            term.axis == found.axis and frequency < (len(term.cosine_nm) + 0.5) / term.period_um
            for term in terms
        ):
            continue
        k = np.arange(1, len(found.coefficients) + 1)
        waves = -1e3 * found.period_um / np.pi * found.coefficients / k
        terms.append(
            Term(
                found.axis,
                found.name,
                found.period_um,
                tuple(waves.imag.tolist()),
                tuple(waves.real.tolist()),
                found.sigma_rms_nm,
            )
        )
    return Correction(tuple(terms))


def apply_correction(track: Track, table: Correction) -> Track:
    """The track with the errors of x and y taken off.

    The stated errors stay those of the pixel noise; how well the correction is known stands
    with its terms.

    Parameters
    ----------
    track : Track
    table : Correction

    Returns
    -------
    Track
        Its metadata say what was done.

    Raises
    ------
    ValueError
        If the track is corrected already.
    """
    if _APPLIED in track.metadata:
        raise ValueError("the linearity of this track is corrected already")
    note = [
        {
            key: value
            for key, value in term.as_dict().items()
            if key not in ("position_um", "error_nm")
        }
        for term in table.terms
    ]
    return replace(
        track,
        x_um=track.x_um - 1e-3 * table.error_nm("x", track.x_um),
        y_um=track.y_um - 1e-3 * table.error_nm("y", track.y_um),
        metadata={**track.metadata, _APPLIED: json.dumps(note)},
    )
