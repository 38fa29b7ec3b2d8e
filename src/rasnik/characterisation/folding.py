"""Linearity of real data, without a truth: the density of positions folded modulo a period.

Where a mask moves freely over many fields, no place within a field is special: the true
position modulo a field is evenly distributed. An error e(x) that repeats with the field
crowds measured positions together where its slope is negative and thins them out where it is
positive. With F the cumulative distribution of the folded measured position, evenly
distributed truth means ``x_true = period * F(x)``, so ``e(x) = x - period * F(x)`` but for a
constant. F is taken as a Fourier series of a few harmonics, whose coefficients are the means
of exp(-2 pi i k x / period) over the track.

Two things make this work on real motion, where a plain histogram would show the motion:

* The track is cut into blocks of time. In each, positions are weighted by a smooth window over
  the range covered and over the time, so that neither turning points nor the ends of the block
  look like a periodic error.
* The scatter between blocks is the uncertainty, however much or little successive positions
  have to do with each other. The same sum at frequencies halfway between the harmonics, where
  no instrument has an error, says whether the motion is even enough.

Source: van der Graaf et al., section 3.3: "The error can be quantified by making density plots
of real data with random x and y, and an empirical correction can be applied".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solve
from scipy.signal.windows import general_cosine
from scipy.stats import f as f_distribution

from rasnik.instrument import System
from rasnik.tracking.track import Track

__all__ = ["BLOCKS", "Fold", "Folding", "fold", "fold_track"]

#: Blocks of time into which a track is cut.
BLOCKS = 24
#: Probability of a clean track below which an error, or an uneven motion, is taken as real.
LEVEL = 0.01

# Half the width of the line that the window makes of a frequency, in units of 1 / span.
_HALF_WIDTH = 4.0
_LEAST_SPAN = 2.0  # periods in a block, below which there is nothing to see
_LEAST_IN_BLOCK = 50  # positions
_HARMONICS = {"two fields": 10, "one field": 5, "pixel": 3}
_GRID = 256  # points of the error curve
_BINS = 20  # of the density that is shown
# The four-term window of Blackman and Harris: what is more than 4 / span away from a frequency
# is suppressed by 92 dB. Harris, Proc. IEEE 66 (1978) 51.
_WINDOW = (0.35875, -0.48829, 0.14128, -0.01168)


@dataclass(frozen=True, eq=False)
class Fold:
    """Error of one coordinate that repeats with one period.

    Attributes
    ----------
    axis : str
        x or y.
    name : str
        What the period is: two fields, one field, pixel, or a length.
    period_um : float
        On the mask.
    coefficients : ndarray of complex, shape (K,)
        c_k, mean of exp(-2 pi i k x / period), k = 1 .. K, of the weighted positions.
    position_um : ndarray, shape (256,)
        Folded position, from 0 to a period.
    error_nm, sigma_nm : ndarray, shape (256,)
        Measured minus true position there, mean zero, and its standard deviation.
    p_value : float
        Probability that a track without an error looks as uneven.
    control_p_value : float
        The same at frequencies where there is no error: if small, it is the motion that is
        uneven.
    span_periods : float
        Periods that a block of the track covers (median).
    needed_periods : float
        Periods that it has to cover for its window to tell the harmonics from the control.
    density : ndarray, shape (20,)
        Weighted density over the period; 1 is even.
    points : int
    """

    axis: str
    name: str
    period_um: float
    coefficients: NDArray[np.complex128] = field(repr=False)
    position_um: NDArray[np.float64] = field(repr=False)
    error_nm: NDArray[np.float64] = field(repr=False)
    sigma_nm: NDArray[np.float64] = field(repr=False)
    p_value: float
    control_p_value: float
    span_periods: float
    needed_periods: float
    density: NDArray[np.float64] = field(repr=False)
    points: int

    @property
    def peak_to_peak_nm(self) -> float:
        return float(np.ptp(self.error_nm))

    @property
    def rms_nm(self) -> float:
        """Of the error, what its uncertainty adds taken off in the mean."""
        squares = float(np.mean(self.error_nm**2) - np.mean(self.sigma_nm**2))
        return math.sqrt(max(0.0, squares))

    @property
    def sigma_rms_nm(self) -> float:
        """Root mean square uncertainty of the error."""
        return float(np.sqrt(np.mean(self.sigma_nm**2)))

    @property
    def wide(self) -> bool:
        """Whether the motion covers enough periods."""
        return self.span_periods >= self.needed_periods

    @property
    def smooth(self) -> bool:
        """Whether the motion favours no places of its own."""
        return self.control_p_value >= LEVEL

    @property
    def detected(self) -> bool:
        """Whether there is an error: more than chance, and not by the motion itself."""
        return self.p_value < LEVEL and self.wide and self.smooth

    @property
    def remark(self) -> str:
        """What speaks against the figures; empty if nothing does."""
        said = []
        if not self.wide:
            said.append(
                f"the motion is not wide enough: a block of the track covers "
                f"{self.span_periods:.3g} periods, {self.needed_periods:.3g} are needed"
            )
        if not self.smooth:
            said.append(
                "the motion is not smooth enough: it favours some places by itself (p = "
                f"{self.control_p_value:.2g} at frequencies where no instrument has an error)"
            )
        return "; ".join(said)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "axis": self.axis,
            "name": self.name,
            "period_um": self.period_um,
            "p_value": self.p_value,
            "control_p_value": self.control_p_value,
            "detected": self.detected,
            "peak_to_peak_nm": self.peak_to_peak_nm,
            "rms_nm": self.rms_nm,
            "sigma_rms_nm": self.sigma_rms_nm,
            "span_periods": self.span_periods,
            "needed_periods": self.needed_periods,
            "points": self.points,
            "harmonics": [[c.real, c.imag] for c in self.coefficients.tolist()],
            "position_um": self.position_um.tolist(),
            "error_nm": self.error_nm.tolist(),
            "sigma_nm": self.sigma_nm.tolist(),
            "remark": self.remark,
        }


@dataclass(frozen=True)
class Folding:
    """All folds of a track; those that could not be made, with the reason."""

    folds: tuple[Fold, ...]
    refused: dict[str, str]

    def __getitem__(self, key: tuple[str, str]) -> Fold:
        """The fold of an axis and a name."""
        return next(one for one in self.folds if (one.axis, one.name) == key)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"folds": [one.as_dict() for one in self.folds], "refused": self.refused}


def fold_track(
    track: Track, system: System, periods_um: tuple[float, ...] | None = None
) -> Folding:
    """Fold x and y of a track modulo two fields, one field and one pixel.

    Parameters
    ----------
    track : Track
        Of a mask that moves over many fields, in the order in which it was measured.
    system : System
        Gives field and pixel; the scale is that of the track.
    periods_um : tuple of float, optional
        Other periods instead, on the mask.

    Returns
    -------
    Folding

    Raises
    ------
    ValueError
        If there are too few positions.
    """
    good = track[track.ok]
    if len(good) < BLOCKS * _LEAST_IN_BLOCK:
        raise ValueError(
            f"the track has {len(good)} positions; {BLOCKS * _LEAST_IN_BLOCK} are the least for a "
            "density"
        )
    a = system.mask.field_um
    named = {
        "two fields": 2 * a,
        "one field": a,
        "pixel": system.pitch_um / float(np.median(good.scale)),
    }
    if periods_um is not None:
        named = {f"{period:g} µm": period for period in periods_um}
    folds, refused = [], {}
    for axis in "xy":
        for name, period in named.items():
            try:
                folds.append(
                    fold(
                        getattr(good, f"{axis}_um"),
                        period,
                        harmonics=_HARMONICS.get(name, 5),
                        control_shift=_control_shift(2 * a / period),
                        axis=axis,
                        name=name,
                    )
                )
            except ValueError as error:
                refused[f"{axis}, {name}"] = str(error)
    return Folding(tuple(folds), refused)


def _control_shift(ratio: float) -> float:
    """Where no error is expected, given how often the period goes into two fields.

    A whole number of times n: its harmonics are every n-th of two fields. The control lies halfway
    between two of those.
    """
    n = round(ratio)
    return 0.5 / n if n >= 1 and abs(ratio - n) < 1e-6 * n else 0.5


def fold(
    position_um: NDArray[np.float64],
    period_um: float,
    *,
    harmonics: int = 5,
    control_shift: float = 0.5,
    axis: str = "x",
    name: str = "",
) -> Fold:
    """Error that repeats with a period, from the density of positions.

    Parameters
    ----------
    position_um : ndarray, shape (n,)
        In the order in which they were measured, finite.
    period_um : float
    harmonics : int
        Number of harmonics of the error.
    control_shift : float
        By how much the control frequencies lie below the harmonics, in units of the first. Half
        way, unless errors of a longer period have harmonics there.
    axis, name : str
        For the record.

    Raises
    ------
    ValueError
        If there are too few positions, or the motion covers too little.
    """
    if not (math.isfinite(period_um) and period_um > 0):
        raise ValueError(f"the period must be positive, not {period_um!r} um")
    blocks = np.array_split(np.asarray(position_um, dtype=np.float64), BLOCKS)
    if len(blocks[-1]) < _LEAST_IN_BLOCK:
        raise ValueError(f"{len(position_um)} positions are too few for a density")
    span = float(np.median([np.ptp(block) for block in blocks])) / period_um
    if span < _LEAST_SPAN:
        raise ValueError(
            f"the motion covers {span:.2g} periods of {period_um:g} um in a block of the track; "
            f"{_HALF_WIDTH / control_shift:.3g} are needed"
        )
    signal, control = np.empty((2, BLOCKS, harmonics), dtype=np.complex128)
    weights = np.empty(BLOCKS)
    counts = np.zeros(_BINS)
    for k, block in enumerate(blocks):
        weight = _weights(block)
        phase = block / period_um
        turn = np.exp(-2j * np.pi * phase)
        signal[k] = _sums(turn, weight + 0j, harmonics)
        control[k] = _sums(turn, weight * np.exp(2j * np.pi * control_shift * phase), harmonics)
        weights[k] = weight.sum()
        bins = np.minimum((phase % 1.0 * _BINS).astype(np.intp), _BINS - 1)
        counts += np.bincount(bins, weight, _BINS)
    coefficients = signal.sum(axis=0) / weights.sum()
    grid = np.arange(_GRID) / _GRID
    curves = _error_nm(signal - weights[:, None] * coefficients, period_um, grid)
    curves *= BLOCKS / weights.sum()
    return Fold(
        axis=axis,
        name=name or f"{period_um:g} µm",
        period_um=period_um,
        coefficients=coefficients,
        position_um=grid * period_um,
        error_nm=_error_nm(coefficients, period_um, grid),
        sigma_nm=np.sqrt(np.sum(curves**2, axis=0) / (BLOCKS * (BLOCKS - 1))),
        p_value=_probability(signal),
        control_p_value=_probability(control),
        span_periods=span,
        needed_periods=_HALF_WIDTH / control_shift,
        density=counts / counts.mean(),
        points=len(position_um),
    )


def _weights(block: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth windows over the range that a block covers, and over its time."""
    low, high = block.min(), block.max()
    turn = 2 * np.pi * (block - low) / (high - low)
    over_range = sum(c * np.cos(k * turn) for k, c in enumerate(_WINDOW))
    return np.asarray(over_range * general_cosine(len(block), (0.5, 0.5), sym=False))


def _sums(turn: NDArray[Any], weight: NDArray[Any], count: int) -> NDArray[np.complex128]:
    """Sums of weight * turn^k, k = 1 .. count."""
    found = np.empty(count, dtype=np.complex128)
    for k in range(count):
        weight = weight * turn
        found[k] = weight.sum()
    return found


def _error_nm(
    coefficients: NDArray[np.complex128], period_um: float, phase: NDArray[np.float64]
) -> NDArray[np.float64]:
    """x - period * F(x) for coefficients of shape (..., K); shape (..., len(phase))."""
    k = np.arange(1, coefficients.shape[-1] + 1)
    waves = np.exp(2j * np.pi * np.outer(k, phase)) / k[:, None]
    return np.asarray(-1e3 * period_um / np.pi * np.imag(coefficients @ waves))


def _probability(sums: NDArray[np.complex128]) -> float:
    """Probability that block sums of mean zero scatter as these, all harmonics taken together.

    Hotelling's test of each harmonic, real and imaginary part together; the least
    probability, corrected for the number of harmonics (Sidak).
    """
    n = len(sums)
    least = 1.0
    for column in sums.T:
        parts = np.column_stack([column.real, column.imag])
        mean = parts.mean(axis=0)
        try:
            t2 = n * mean @ solve(np.cov(parts.T), mean, assume_a="pos")
        except LinAlgError:  # no scatter at all: made-up data
            return 0.0
        least = min(least, float(f_distribution.sf(t2 * (n - 2) / (2 * (n - 1)), 2, n - 2)))
    return float(-math.expm1(sums.shape[1] * math.log1p(-least))) if least < 1 else 1.0
