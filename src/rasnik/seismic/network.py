"""Several stations: motion of one against another, what they have in common, strain between them.

A network of displacement u(r) is described near its middle by u(r) = u0 + G (r - r0). The
symmetric part of G is the strain, the antisymmetric one the rotation about the vertical. That is
exact for motion that is linear across the network; a wave of wavelength L is measured low by
sin(pi d / L) / (pi d / L) by two stations a distance d apart along its way.

Source: P. Spudich et al., Annals of Geophysics 37 (1994), doi 10.4401/ag-4146, for strain in time
from the displacements of an array by least squares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.characterisation.gaps import TOLERANCE, Series, aligned
from rasnik.characterisation.spectrum import Coherence, coherence, window_length

__all__ = [
    "GRADIENTS",
    "SingularNetworkError",
    "StrainTensor",
    "Transfer",
    "differential",
    "strain",
    "strain_tensor",
    "transfer",
    "without_common_mode",
]

#: Order of what `strain_tensor` finds: mean motion, strain, rotation anticlockwise from above.
GRADIENTS = ("u_east", "u_north", "e_east", "e_north", "e_east_north", "rotation")

_NM_PER_M = 1e9
# Stations nearer to one line than this fraction of their extent say nothing across it.
_FLATTEST = 1e-6

Array = NDArray[np.float64]


class SingularNetworkError(ValueError):
    """Raised where the places of the stations leave something unmeasured, and says what."""


# ------------------------------------------------------------------------ two stations


def differential(one: Series, other: Series) -> Series:
    """Motion of the other station less that of one, over the time that they share.

    Raises
    ------
    ValueError
        If their units differ, or as `aligned`.
    """
    if one.unit != other.unit:
        raise ValueError(f"{one.name} is in {one.unit}, {other.name} in {other.unit}")
    first, second = aligned(one, other)
    return Series(
        second.values - first.values, first.rate_hz, f"{other.name} - {one.name}", one.unit,
        first.start_s,
    )  # fmt: skip


def strain(
    one: Series, other: Series, baseline_m: float, sigma_nm: tuple[float, float] = (math.nan,) * 2
) -> tuple[Series, float]:
    """Strain along the line from one station to the other.

    Parameters
    ----------
    one, other : Series
        Displacements in nm along the line, positive from one to the other.
    baseline_m : float
        Distance of the stations.
    sigma_nm : (float, float)
        Standard deviation of a value of each.

    Returns
    -------
    strain : Series
        Without unit; positive where the ground is stretched.
    sigma : float
        Standard deviation of each of its values; NaN if those of the stations are not known.

    Raises
    ------
    ValueError
        As `differential`; or if the series are not in nm or the baseline is not above 0.
    """
    if not (math.isfinite(baseline_m) and baseline_m > 0):
        raise ValueError(f"the baseline must be above 0 m, not {baseline_m}")
    _check_nm([one, other])
    between = differential(one, other)
    size = _NM_PER_M * baseline_m
    name = f"strain from {one.name} to {other.name}"
    return replace(between, values=between.values / size, name=name, unit=""), math.hypot(
        *sigma_nm
    ) / size


@dataclass(frozen=True, eq=False)
class Transfer:
    """What of one station arrives at another.

    Attributes
    ----------
    frequency_hz : ndarray, shape (m,)
    value : ndarray of complex, shape (m,)
        Motion of the other per motion of one, for times exp(+i w t); noise of the first
        station makes it too small.
    sigma : ndarray, shape (m,)
        Standard deviation of the real part and of the imaginary part.
    coherence : Coherence
    """

    frequency_hz: Array
    value: NDArray[np.complex128]
    sigma: Array
    coherence: Coherence


def transfer(
    one: Series, other: Series, *, windows: int | None = None, length_s: float | None = None
) -> Transfer:
    """Transfer function from one station to another, by Welch's method.

    Parameters
    ----------
    one, other : Series
    windows, length_s : optional
        As in `rasnik.characterisation.spectrum.window_length`.

    Raises
    ------
    ValueError
        As `rasnik.characterisation.spectrum.coherence`.

    Notes
    -----
    The error follows from the coherence g: |H| sqrt((1 - g) / (2 n g)) with n effective averages.
    Source: J. S. Bendat and A. G. Piersol, Random Data, 4th ed. (2010), section 9.2.
    """
    from scipy import signal

    both = coherence(one, other, windows=windows, length_s=length_s)
    first, second = aligned(one, other)
    length = window_length(first, windows=windows, length_s=length_s)
    cross, power = 0.0, 0.0
    for a, b in zip(first.runs(), second.runs(), strict=True):
        if len(a) >= length:
            options = (first.rate_hz, "hann", length)
            # scipy conjugates the first argument; a stretch counts by its number of windows
            count = 1 + (len(a) - length) // (length - length // 2)
            cross = cross + count * signal.csd(a, b, *options)[1]
            power = power + count * signal.welch(a, *options)[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        value = np.asarray(cross / power)
        spread = (1 - both.coherence) / (2 * both.averages * both.coherence)
        sigma = np.abs(value) * np.sqrt(np.clip(spread, 0, None))
    return Transfer(both.frequency_hz, value, sigma, both)


# ------------------------------------------------------------------------ many stations


def without_common_mode(
    stations: Sequence[Series], weights: ArrayLike | None = None
) -> tuple[Series, list[Series]]:
    """What all stations have in common, and what is left of each.

    Parameters
    ----------
    stations : sequence of Series
        On one clock (`on_one_clock`) and of one unit.
    weights : array_like, optional
        Of the stations in the mean, 1 / sigma^2 for instance; equal by default.

    Returns
    -------
    common : Series
        Weighted mean.
    left : list of Series
        Stations less the mean. Noise of n equal stations that are independent falls by
        sqrt(1 - 1 / n) here and the rests are no longer independent: they sum to 0.

    Raises
    ------
    ValueError
        If the stations are not on one clock or of one unit, or weights are wrong.
    """
    values = _stacked(stations)
    share = np.ones(len(values)) if weights is None else np.asarray(weights, dtype=float)
    if share.shape != (len(values),) or not (np.isfinite(share) & (share >= 0)).all():
        raise ValueError(f"there must be {len(values)} weights of 0 or more")
    if not share.sum() > 0:
        raise ValueError("one weight at least must be above 0")
    mean = share @ values / share.sum()
    first = stations[0]
    common = replace(first, values=mean, name="common motion")
    rest = [replace(one, values=own - mean) for one, own in zip(stations, values, strict=True)]
    return common, rest


@dataclass(frozen=True, eq=False)
class StrainTensor:
    """Gradients of the motion of a network in time.

    Attributes
    ----------
    series : dict of Series
        By the names of `GRADIENTS`: mean motion at `origin_m` in nm, the others without unit,
        rotation in rad.
    covariance : ndarray, shape (6, 6)
        Of one moment, in the order and units of `GRADIENTS`.
    chi2 : ndarray, shape (n,)
        Per moment; NaN with three stations, which leave nothing over.
    degrees_of_freedom : int
    condition : float
        Of the places: extent of the network over its width.
    origin_m : ndarray, shape (2,)
        Middle of the network.
    """

    series: dict[str, Series]
    covariance: Array
    chi2: Array
    degrees_of_freedom: int
    condition: float
    origin_m: Array

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviations by the names of `GRADIENTS`."""
        return dict(zip(GRADIENTS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def strain_tensor(
    east: Sequence[Series],
    north: Sequence[Series],
    places_m: ArrayLike,
    sigma_nm: ArrayLike = 1.0,
) -> StrainTensor:
    """Horizontal strain and rotation from three stations or more, by least squares.

    Parameters
    ----------
    east, north : sequence of Series
        Displacements of each station in nm, all on one clock.
    places_m : array_like, shape (stations, 2)
        East and north of each.
    sigma_nm : array_like, shape (), (stations,) or (stations, 2)
        Standard deviation of a value, independent between stations and components.

    Returns
    -------
    StrainTensor

    Raises
    ------
    SingularNetworkError
        If there are less than three stations, or they lie on a line: what is not measured is
        named.
    ValueError
        If numbers, clocks or units do not fit.
    """
    places = np.asarray(places_m, dtype=float)
    count = len(east)
    if places.shape != (count, 2) or len(north) != count or not np.isfinite(places).all():
        raise ValueError(
            f"there are {count} series to the east and {len(north)} to the north, but places of "
            f"shape {places.shape}; each station needs both and a place of two numbers"
        )
    condition = _check_places(places)
    series = [*east, *north]
    _check_nm(series)
    values = _stacked(series)
    sigma = np.broadcast_to(_sigmas(sigma_nm, count), (count, 2)).T.ravel()
    origin = places.mean(axis=0)
    offset = _NM_PER_M * (places - origin)
    matrix = np.zeros((2 * count, 6))
    x, y = offset.T
    # u_east = u0 + e_east x + (e_en - w) y,  u_north = v0 + (e_en + w) x + e_north y
    matrix[:count, 0] = matrix[count:, 1] = 1
    matrix[:count, 2], matrix[:count, 4], matrix[:count, 5] = x, y, -y
    matrix[count:, 3], matrix[count:, 4], matrix[count:, 5] = y, x, x
    # Columns of one size: metres and strains differ by many orders.
    size = np.linalg.norm(matrix, axis=0)
    inverse = np.linalg.pinv(matrix / size / sigma[:, None])
    found = (inverse @ (values / sigma[:, None])) / size[:, None]
    covariance = inverse @ inverse.T / np.outer(size, size)
    freedom = 2 * count - 6
    rest = (values - matrix @ found) / sigma[:, None]
    chi2 = (rest**2).sum(axis=0) if freedom else np.full(values.shape[1], np.nan)
    like, units = series[0], ("nm", "nm", "", "", "", "rad")
    made = {
        name: replace(like, values=own, name=name, unit=unit)
        for name, own, unit in zip(GRADIENTS, found, units, strict=True)
    }
    return StrainTensor(made, covariance, chi2, freedom, condition, origin)


def _check_places(places_m: Array) -> float:
    """Extent of the network over its width; an error that says what is not measured."""
    if len(places_m) < 3:
        raise SingularNetworkError(
            f"strain in all directions needs three stations, not {len(places_m)}; two give the "
            "strain along the line between them"
        )
    offset = places_m - places_m.mean(axis=0)
    _, size, axes = np.linalg.svd(offset, full_matrices=False)
    if size[0] == 0:
        raise SingularNetworkError("all stations are at one place: no gradient is measured")
    if size[1] < _FLATTEST * size[0]:
        azimuth = math.degrees(math.atan2(axes[0, 0], axes[0, 1])) % 180
        raise SingularNetworkError(
            f"all stations lie on one line, {azimuth:.4g} degrees clockwise from north: how the "
            "motion changes across it is not measured (strain across the line, and shear and "
            "rotation apart)"
        )
    return float(size[0] / size[1])


def _check_nm(series: Sequence[Series]) -> None:
    for one in series:
        if one.unit != "nm":
            raise ValueError(f"{one.name} is in {one.unit or 'no unit'}; strain needs nm")


def _sigmas(sigma_nm: ArrayLike, count: int) -> Array:
    sigma = np.asarray(sigma_nm, dtype=float)
    if (
        sigma.shape not in ((), (count,), (count, 2))
        or not (np.isfinite(sigma) & (sigma > 0)).all()
    ):
        raise ValueError(f"sigma should be one number above 0, or {count}, or {count} x 2")
    return sigma[:, None] if sigma.ndim == 1 else sigma


def _stacked(stations: Sequence[Series]) -> Array:
    """Values of series on one clock, shape (stations, n)."""
    if len(stations) < 2:
        raise ValueError(f"a network has two stations at least, not {len(stations)}")
    first = stations[0]
    for one in stations[1:]:
        late = abs(one.start_s - first.start_s) * first.rate_hz
        if len(one) != len(first) or one.rate_hz != first.rate_hz or late > TOLERANCE:
            raise ValueError(f"{first.name} and {one.name} are not on one clock; use on_one_clock")
        if one.unit != first.unit:
            raise ValueError(f"{first.name} is in {first.unit}, {one.name} in {one.unit}")
    return np.array([one.values for one in stations])
