"""From a reading back to displacements of the elements that are said to move.

At most four motions can be found from the four numbers of one reading, and only if their columns
in the matrix of `rasnik.geometry.three_points` do not depend on each other. The exact readings are
inverted by Newton's method with exact derivatives, so large displacements are as good as small
ones. With fewer motions than readings it is a least-squares fit weighted by the covariance, and
chi-square says whether these motions explain the reading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.geometry.dependence import indistinguishable
from rasnik.geometry.reading import READINGS
from rasnik.geometry.three_points import ALL_MOTIONS, ThreePoints, motion_index, motion_unit

__all__ = ["Displacement", "displacement", "displacements"]

Array = NDArray[np.float64]

# Half a step is tried when a whole one makes it worse; Newton's steps double the digits.
_MOST_STEPS, _MOST_HALVINGS = 60, 12
# Relative to the distance of the lens: a step after which only rounding is left, and the last
# step and the misfit of a solution that was found.
_SETTLED, _FOUND = 1e-12, 1e-9


class HasReading(Protocol):
    """A `rasnik.Pose` or a `rasnik.geometry.reading.Reading`."""

    @property
    def x_um(self) -> float: ...
    @property
    def y_um(self) -> float: ...
    @property
    def scale(self) -> float: ...
    @property
    def theta_rad(self) -> float: ...
    @property
    def orientation(self) -> int: ...


@dataclass(frozen=True, eq=False)
class Displacement:
    """How far elements are from where they were built, if nothing else has moved.

    Attributes
    ----------
    names : tuple of str
        The motions that were asked for.
    values : ndarray, shape (n,)
        In um and rad.
    covariance : ndarray, shape (n, n)
        From that of the reading; NaN without one. It does not cover errors of the distances, nor
        motions that were taken to be zero.
    chi2 : float
        Of the reading against these motions; NaN where all readings are used up.
    ndf : int
        Readings used less motions found.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    chi2: float
    ndf: int

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.names.index(name)])

    def sigma(self, name: str) -> float:
        """Standard deviation of one motion."""
        index = self.names.index(name)
        return float(np.sqrt(self.covariance[index, index]))

    @property
    def probability(self) -> float:
        """Of a larger chi2, if only these motions have happened; NaN where nothing is left over."""
        from scipy.stats import chi2

        return float(chi2.sf(self.chi2, self.ndf)) if self.ndf else math.nan

    def as_dict(self) -> dict[str, Any]:
        """For JSON: unit in the names, None where there is no number."""
        found: dict[str, Any] = {}
        for name in self.names:
            unit, sigma = motion_unit(name), self.sigma(name)
            found[f"{name}_{unit}"] = self[name]
            found[f"sigma_{name}_{unit}"] = sigma if math.isfinite(sigma) else None
        chi2, probability = (self.chi2, self.probability) if self.ndf else (None, None)
        return {**found, "chi2": chi2, "ndf": self.ndf, "probability": probability}


def displacement(
    instrument: ThreePoints,
    reading: HasReading,
    names: Sequence[str],
    covariance: ArrayLike | None = None,
    use: Sequence[str] = READINGS,
) -> Displacement:
    """Displacements of elements from one reading.

    Parameters
    ----------
    instrument : ThreePoints
        As built.
    reading : Pose or Reading
    names : sequence of str
        The motions that may have happened, of `ALL_MOTIONS`; everything else stood still.
    covariance : array_like, shape (4, 4), optional
        Of x, y, S, theta_z. Of a `rasnik.Pose` by default its own.
    use : sequence of str
        The readings that are used, of `READINGS`.

    Returns
    -------
    Displacement

    Raises
    ------
    ValueError
        If the reading has no position or another orientation, if the motions cannot be told
        apart or are more than the readings, or if no displacement explains the reading.
    """
    if reading.orientation != instrument.orientation:
        raise ValueError(
            f"the reading has orientation {reading.orientation}, the Rasnik was built with "
            f"{instrument.orientation}; analyse the image with its orientation fixed"
        )
    values = np.array([getattr(reading, name) for name in READINGS], dtype=np.float64)
    if not np.isfinite(values[_rows(use)]).all():
        raise ValueError("the reading has no position: there is nothing to be inverted")
    given = getattr(reading, "covariance", None) if covariance is None else covariance
    noise = None if given is None else np.asarray(given, dtype=np.float64)
    found = displacements(instrument, values, names, noise, use)
    if not np.isfinite(found).all():
        raise ValueError(
            f"no displacement of {', '.join(names)} explains the reading x = {values[0]:.6g} um, "
            f"y = {values[1]:.6g} um, S = {values[2]:.6g}, theta_z = {values[3]:.6g} rad"
        )
    return _with_errors(instrument, values, tuple(names), found, noise, use)


def _with_errors(
    instrument: ThreePoints,
    values: Array,
    names: tuple[str, ...],
    found: Array,
    noise: Array | None,
    use: Sequence[str],
) -> Displacement:
    """The result with what the covariance of the reading makes of it."""
    rows, n = _rows(use), len(names)
    part = np.full((len(rows), len(rows)), np.nan) if noise is None else noise[np.ix_(rows, rows)]
    vector = _full(names, found)
    slopes = instrument.slopes(vector)[np.ix_(rows, [motion_index(name) for name in names])]
    if len(rows) == n:
        back = np.linalg.inv(slopes)
        return Displacement(names, found, np.asarray(back @ part @ back.T), math.nan, 0)
    inverse = np.linalg.inv(part)  # was found positive definite
    covariance = np.asarray(np.linalg.inv(slopes.T @ inverse @ slopes))
    left = _difference(values, instrument.values(vector))[rows]
    chi2 = float(left @ inverse @ left)
    return Displacement(names, found, covariance, chi2, len(rows) - n)


def displacements(
    instrument: ThreePoints,
    values: ArrayLike,
    names: Sequence[str],
    covariance: ArrayLike | None = None,
    use: Sequence[str] = READINGS,
) -> Array:
    """Displacements of elements from many readings, as from the columns of a track.

    Parameters
    ----------
    instrument : ThreePoints
    values : array_like, shape (..., 4)
        x (um), y (um), S, theta_z (rad); NaN where there is none.
    names : sequence of str
    covariance : array_like, shape (4, 4), optional
        Weighs the readings against each other; needed if they are more than the motions.
    use : sequence of str

    Returns
    -------
    ndarray, shape (..., n)
        um and rad; NaN where there is no reading, or no displacement that explains it.

    Raises
    ------
    ValueError
        If the motions cannot be told apart or are more than the readings, or a covariance is
        needed and missing.
    """
    values = np.asarray(values, dtype=np.float64)
    whiten = _whitening(instrument, names, covariance, use)
    flat = np.atleast_2d(values.reshape(-1, 4))
    found = np.full((len(flat), len(names)), np.nan)
    known = np.isfinite(flat[:, _rows(use)]).all(axis=1)
    if known.any():
        found[known] = _solve(instrument, flat[known], names, whiten, _rows(use))
    return found.reshape(*values.shape[:-1], len(names))


def _whitening(
    instrument: ThreePoints,
    names: Sequence[str],
    covariance: ArrayLike | None,
    use: Sequence[str],
) -> Array:
    """Matrix that makes the used readings alike; checks that the motions can be found."""
    if len(set(names)) < len(names) or not names:
        raise ValueError("name the motions to be found, each once")
    rows = _rows(use)
    same = indistinguishable(instrument, names, use)
    if same:
        raise ValueError(
            f"{', '.join(use)} of one Rasnik cannot tell these motions apart: {'; '.join(same)}"
        )
    if covariance is None or len(rows) == len(names):
        if len(rows) > len(names):
            raise ValueError(
                f"{len(rows)} readings for {len(names)} motions: give a covariance that weighs "
                "them, or name as many readings to use"
            )
        return np.diag(1 / instrument.natural_readings[rows])
    part = np.asarray(covariance, dtype=np.float64)[np.ix_(rows, rows)]
    try:
        if np.isfinite(part).all():
            return np.linalg.inv(np.linalg.cholesky(part))
    except np.linalg.LinAlgError:
        pass
    raise ValueError(f"the covariance of {', '.join(use)} is not known or not positive definite")


def _solve(
    instrument: ThreePoints, values: Array, names: Sequence[str], whiten: Array, rows: list[int]
) -> Array:
    """Newton's method (Gauss-Newton if overdetermined) for all readings at once."""
    columns = [motion_index(name) for name in names]
    natural = instrument.natural_motions(names)

    def misfit(guess: Array, which: NDArray[np.int64]) -> Array:
        left = _difference(values[which], instrument.values(_full(names, guess)))
        return np.asarray((whiten @ left[:, rows, None])[..., 0])

    found = np.zeros((len(values), len(names)))
    active = np.arange(len(values), dtype=np.int64)
    left = misfit(found, active)
    last = np.full(len(values), np.inf)
    for _ in range(_MOST_STEPS):
        if not len(active):
            break
        slopes = instrument.slopes(_full(names, found[active]))[:, rows][:, :, columns]
        inverse = np.linalg.pinv(whiten @ slopes * natural)
        step = (inverse @ left[active, :, None])[..., 0]
        size = last[active] = np.abs(step).max(axis=1)
        trial, new = found[active] + step * natural, left[active]
        going = size > _SETTLED
        worse = np.ones(len(active), dtype=bool)
        for halving in range(_MOST_HALVINGS):
            trial[worse] = found[active[worse]] + step[worse] * natural / 2**halving
            new[worse] = misfit(trial[worse], active[worse])
            # near the least of a sum of squares only rounding changes it; NaN is worse
            before = np.linalg.norm(left[active], axis=1)
            worse = ~(np.linalg.norm(new, axis=1) <= before * (1 + 1e-12)) & going
            if not worse.any():
                break
        accepted = active[~worse]
        found[accepted], left[accepted] = trial[~worse], new[~worse]
        active = active[~worse & going]
    ok = last < _FOUND
    if len(rows) == len(names):  # then a solution leaves nothing; whitening is by natural sizes
        ok &= np.linalg.norm(left, axis=1) < _FOUND
    return np.where(ok[:, None], found, np.nan)


def _full(names: Sequence[str], values: Array) -> Array:
    """All motions, those not named zero."""
    full = np.zeros((*values.shape[:-1], len(ALL_MOTIONS)))
    full[..., [motion_index(name) for name in names]] = values
    return full


def _difference(values: Array, others: Array) -> Array:
    """Differences of readings, that of theta_z in [-pi, pi)."""
    left = values - others
    left[..., 3] = np.mod(left[..., 3] + np.pi, 2 * np.pi) - np.pi
    return left


def _rows(use: Sequence[str]) -> list[int]:
    try:
        return [READINGS.index(name) for name in use]
    except ValueError:
        raise ValueError(f"readings are {', '.join(READINGS)}, not {', '.join(use)}") from None
