"""The error budget: what every source contributes to x and y.

Random sources of the pixels go through the linear estimator of the fit; what is the same in
every image is applied to the expected image; the rest are formulas. All are referred to the mask.

Source: van der Graaf et al., section 3, "Error sources".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from rasnik.imaging.projection import Projection
from rasnik.instrument import System, load_system
from rasnik.performance.assumptions import Assumptions
from rasnik.performance.bound import ROUNDING_VARIANCE, Bound, bound, positions
from rasnik.performance.estimator import Estimator, estimator

__all__ = ["Budget", "Contribution", "budget"]

Kind = Literal["random", "systematic"]

#: Positions within two fields over which fixed patterns and distortion are averaged.
_PLACES = 4
# Refractivity of air at 1013.25 hPa and 288.15 K, visible light.
_REFRACTIVITY = 2.77e-4

Pair = tuple[float, float]


@dataclass(frozen=True)
class Contribution:
    """One error source.

    Attributes
    ----------
    source : str
    x_nm, y_nm : float or None
        Standard deviation (random) or size (systematic) on the mask; None if it needs
        something that the system does not state.
    kind : {"random", "systematic"}
    time : {"white", "slow", "fixed"}
        New in every image; drifting, correlated in time; or the same in every image, so that it
        is felt only as far as the mask moves.
    formula : str
        Where the figure comes from, with its parameters.
    reference : str
        Section of the paper.
    """

    source: str
    x_nm: float | None
    y_nm: float | None
    kind: Kind
    time: Literal["white", "slow", "fixed"]
    formula: str
    reference: str


@dataclass(frozen=True, eq=False)
class Budget:
    """Contributions of all sources, and the bound that contains the white ones.

    Attributes
    ----------
    system : System
    assumptions : Assumptions
    bound : Bound
        With rounding.
    contributions : tuple of Contribution
    """

    system: System
    assumptions: Assumptions
    bound: Bound
    contributions: tuple[Contribution, ...]

    def total_nm(self, time: str) -> Pair:
        """Root of the sum of squares of the contributions of a kind in time, for x and y."""
        chosen = [c for c in self.contributions if c.time == time]
        return (
            math.sqrt(sum((c.x_nm or 0.0) ** 2 for c in chosen)),
            math.sqrt(sum((c.y_nm or 0.0) ** 2 for c in chosen)),
        )


@dataclass(frozen=True, eq=False)
class _Bench:
    """What the sources are worked out with."""

    system: System
    assumed: Assumptions
    bound: Bound
    estimators: tuple[Estimator, ...]

    def random(self, sigma: Callable[[Estimator], NDArray[Any] | float]) -> Pair:
        """Rms over the places of what independent errors of the pixels do."""
        found = [one.random_nm(sigma(one)) for one in self.estimators]
        return _rms(found)

    def shifts(self, change: Callable[[Estimator], Pair]) -> NDArray[np.float64]:
        """Shift of x and y at every place, shape (n, 2)."""
        return np.array([change(one) for one in self.estimators])


def _rms(pairs: Iterable[Pair] | NDArray[np.float64]) -> Pair:
    x, y = np.sqrt(np.mean(np.square(list(pairs)), axis=0))
    return float(x), float(y)


def budget(system: System, assumed: Assumptions | None = None, poses: Any = None) -> Budget:
    """Work out the contribution of every error source.

    Parameters
    ----------
    system : System
        With a noise law.
    assumed : Assumptions, optional
        Sizes of the sources that the system does not state.
    poses : optional
        One pose as `rasnik.simulate` takes it; by default the reference.

    Raises
    ------
    ValueError
        If the noise of the system is not known, or its fields cannot be seen.
    """
    assumed = assumed or Assumptions()
    least = bound(system, poses, rounding=True)
    first = positions(system, poses)[0]
    step = 2 * system.mask.field_um / _PLACES
    places = [_moved(first, k * step, (k * 0.618 % 1) * 2 * step) for k in range(_PLACES)]
    bench = _Bench(system, assumed, least, tuple(estimator(system, place) for place in places))
    found = [*_noise(bench), *_pixels(bench), *_picture(bench), *_mask(bench), *_air(bench)]
    return Budget(system, assumed, least, tuple([*found, *_temperature(bench)]))


def _moved(projection: Projection, dx_um: float, dy_um: float) -> Projection:
    matrix = projection.matrix.copy()
    shift = np.eye(3)
    shift[:2, 2] = dx_um, dy_um
    return Projection(shift @ matrix)


# ------------------------------------------------------------------ sources, by section


def _noise(bench: _Bench) -> list[Contribution]:
    """Fluctuations of the pixels; their squares add up to that of the bound."""
    a, b = bench.system.noise_law or (0.0, 0.0)
    reference = "3.5 quantum fluctuations"
    shot = bench.random(lambda e: np.sqrt(b * e.expected))
    dark = bench.random(lambda e: math.sqrt(a))
    rounding = bench.random(lambda e: math.sqrt(ROUNDING_VARIANCE))
    clipped = _rms(bench.shifts(lambda e: e.shift_nm(_clipped(e, bench.system.full_scale))))
    lost = math.sqrt(1 / (1 - bench.assumed.dust_fraction) - 1)
    dust = lost * bench.bound.sigma_x_nm, lost * bench.bound.sigma_y_nm
    return [
        Contribution("shot noise", *shot, "random", "white", f"√ sum (K s)^2, s^2 = {b:.3g} Q",
                     reference),
        Contribution("electronic noise", *dark, "random", "white", f"√ sum (K s)^2, s^2 = {a:.3g}",
                     reference),
        Contribution("rounding to grey levels", *rounding, "random", "white",
                     "√ sum (K s)^2, s^2 = 1/12", reference),
        Contribution("saturation", *clipped, "systematic", "fixed",
                     "sum K e, e: mean of what is cut off at full scale", reference),
        Contribution("dust and stains", *dust, "random", "white",
                     f"bound x sqrt(1/(1-f) - 1), f = {bench.assumed.dust_fraction:g}",
                     "4, fig. of a real image"),
    ]  # fmt: skip


def _clipped(e: Estimator, full_scale: int) -> NDArray[np.float64]:
    """Mean change of every pixel by cutting off at full scale (minus the Gaussian's excess)."""
    sigma = np.sqrt(e.noise[0] + e.noise[1] * e.expected.astype(np.float64))
    z = (e.expected - full_scale) / sigma
    density = np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
    return np.asarray(-sigma * (density + z * ndtr(z)))


def _pixels(bench: _Bench) -> list[Contribution]:
    assumed, system = bench.assumed, bench.system
    # a superpixel is the mean of binning^2 pixels with errors of their own
    share = 1 / system.sensor.binning
    gain = bench.random(lambda e: share * assumed.gain_spread * e.expected)
    pedestal = bench.random(lambda e: share * assumed.pedestal_grey)
    flicker = bench.random(lambda e: share * assumed.flicker * e.expected)
    place = _rms(bench.shifts(lambda e: _place(e, share * assumed.pixel_place_nm * 1e-3)))
    column_um = assumed.column_place_nm * 1e-3 * math.sqrt(share)
    column = _rms(bench.shifts(lambda e: _columns(e, column_um)))
    variance = assumed.crosstalk * system.sensor.pixel_um**2 / 2
    blur = math.sqrt(system.optics.blur_um**2 + variance)
    blurred = bound(
        load_system(system, {"optics.blur_um": blur}), list(bench.bound.poses), rounding=True
    )
    crosstalk = tuple(
        math.sqrt(max(float(blurred.covariance[k, k] - bench.bound.covariance[k, k]), 0.0)) * 1e3
        for k in (0, 1)
    )
    return [
        Contribution("pixel gain spread", *gain, "systematic", "fixed",
                     f"√ sum (K g Q)^2, g = {assumed.gain_spread:g}", "3.5 pixel response"),
        Contribution("pixel pedestal spread", *pedestal, "systematic", "fixed",
                     f"√ sum (K p)^2, p = {assumed.pedestal_grey:g} grey", "3.5 pixel response"),
        Contribution("pixel flicker (1/f)", *flicker, "random", "slow",
                     f"√ sum (K g Q)^2, g = {assumed.flicker:g}", "3.5 pixel flicker noise"),
        Contribution("pixel cross-talk", crosstalk[0], crosstalk[1], "random", "white",
                     f"bound with blur^2 + c p^2/2, c = {assumed.crosstalk:g}",
                     "3.5 pixel cross talk"),
        Contribution("pixel geometry", *place, "systematic", "fixed",
                     f"√ sum (K dQ/du d)^2, d = {assumed.pixel_place_nm:g} nm on the sensor",
                     "3.5 pixel geometry"),
        Contribution("row and column geometry", *column, "systematic", "fixed",
                     f"√ sum over columns (sum K dQ/du d)^2, d = {assumed.column_place_nm:g} nm",
                     "3.5 row and column geometry"),
    ]  # fmt: skip


def _place(e: Estimator, sigma_um: float) -> Pair:
    return e.random_nm(np.hypot(e.slope_u, e.slope_v) * sigma_um)


def _columns(e: Estimator, sigma_um: float) -> Pair:
    """Columns displaced along u and rows along v, each by an amount of its own."""
    found = []
    for k in e.gain.astype(np.float64):
        columns, rows = (k * e.slope_u).sum(axis=0), (k * e.slope_v).sum(axis=1)
        found.append(1e3 * sigma_um * float(np.sqrt((columns**2).sum() + (rows**2).sum())))
    return found[0], found[1]


def _picture(bench: _Bench) -> list[Contribution]:
    """Distortion and uneven light: the mean shift is constant, the rest a linearity error."""
    assumed = bench.assumed
    distorted = bench.shifts(lambda e: e.displaced_nm(*_radial(e, assumed.distortion)))
    uneven = bench.shifts(lambda e: e.shift_nm(_third_order(e, assumed.light_third_order)))
    offset, linearity = np.abs(distorted.mean(axis=0)), distorted.std(axis=0)
    light = _rms(uneven)
    how = f"sum K dQ/dr d, d/r = {assumed.distortion:g} (r/corner)^2"
    return [
        Contribution("distortion, offset", float(offset[0]), float(offset[1]), "systematic",
                     "fixed", f"{how}; mean over two fields", "3.3 image distortion"),
        Contribution("distortion, periodic", float(linearity[0]), float(linearity[1]),
                     "systematic", "fixed", f"{how}; rms about that mean",
                     "3.3 image distortion"),
        Contribution("uneven light", *light, "systematic", "fixed",
                     f"sum K e, e = {assumed.light_third_order:g} Q (u^3 + v^3); to second order "
                     "it is fitted", "not in section 3"),
        Contribution("black fields too large", 0.0, 0.0, "systematic", "fixed",
                     "the edge shift is fitted", "3.4 blurring, asymmetric edge"),
        Contribution("defocus, lens temperature", 0.0, 0.0, "systematic", "slow",
                     "the blur is fitted; the optical centre stays", "3.4, 3.6"),
    ]  # fmt: skip


def _radial(e: Estimator, share: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    u, v = e.u_um[None, :], e.v_um[:, None]
    growth = share * (u**2 + v**2) / (u[0, -1] ** 2 + v[-1, 0] ** 2)
    return u * growth, v * growth


def _third_order(e: Estimator, share: float) -> NDArray[np.float64]:
    u, v = e.u_um / e.u_um[-1], e.v_um / e.v_um[-1]
    return np.asarray(share * e.expected * (u**3 + (v**3)[:, None]))


def _mask(bench: _Bench) -> list[Contribution]:
    assumed, system = bench.assumed, bench.system
    samples = assumed.mask_edge_samples or _edge_samples(system)
    edge = assumed.mask_edge_nm / math.sqrt(samples)
    printed = assumed.mask_scale_error * assumed.mask_distance_mm * 1e6
    return [
        Contribution("mask edges", edge, edge, "systematic", "fixed",
                     f"e / sqrt(N), e = {assumed.mask_edge_nm:g} nm, N = {samples:.3g}",
                     "3.2 coded mask"),
        Contribution("mask scale as printed", printed, printed, "systematic", "fixed",
                     f"s d, s = {assumed.mask_scale_error:g}, d = {assumed.mask_distance_mm:g} mm",
                     "3.2 coded mask"),
    ]  # fmt: skip


def _edge_samples(system: System) -> float:
    """Crossings of contours of one direction with rows of pixels, in view."""
    image_field = system.mask.field_um * system.optics.scale
    width = system.sensor.width_px * system.sensor.pixel_um
    return width / image_field * system.sensor.height_px


def _air(bench: _Bench) -> list[Contribution]:
    assumed, geometry = bench.assumed, bench.system.geometry
    density = assumed.air_pressure_hpa / 1013.25 * 288.15 / assumed.air_temperature_k
    # n - 1 is proportional to the density, which falls as 1 / T
    per_kelvin = _REFRACTIVITY * density / assumed.air_temperature_k
    a, b = geometry.mask_lens_mm, geometry.lens_sensor_mm
    sizes: list[float | None] = [None, None]
    length = "needs geometry.mask_lens_mm and geometry.lens_sensor_mm"
    if a is not None and b is not None:
        # a ray of curvature k through sensor centre and lens meets the mask off its straight
        # continuation by k a (a + b) / 2
        lever = 1e-6 * a * (a + b) / 2 * 1e9
        gradients = assumed.air_gradient_k_per_m, assumed.air_turbulence_k_per_m
        sizes = [per_kelvin * gradient * lever for gradient in gradients]
        length = f"a = {a:g} mm, b = {b:g} mm"
    how = "a (a+b)/2 dn/dT dT/dx"
    return [
        Contribution("air: steady gradient", sizes[0], sizes[0], "systematic", "slow",
                     f"{how}, {length}, {assumed.air_gradient_k_per_m:g} K/m",
                     "3.1 light through air"),
        Contribution("air: turbulence", sizes[1], sizes[1], "random", "slow",
                     f"{how}, {assumed.air_turbulence_k_per_m:g} K/m rms",
                     "3.1 light through air"),
    ]  # fmt: skip


def _temperature(bench: _Bench) -> list[Contribution]:
    assumed = bench.assumed
    mask = (
        assumed.mask_expansion_per_k * assumed.mask_temperature_k * assumed.mask_distance_mm * 1e6
    )
    arm = assumed.arm_expansion_per_k * assumed.arm_temperature_k * assumed.arm_mm * 1e6
    growth = assumed.sensor_expansion_per_k * assumed.sensor_temperature_k
    return [
        Contribution("mask temperature", mask, mask, "systematic", "slow",
                     f"a dT d, a = {assumed.mask_expansion_per_k:g}/K, "
                     f"dT = {assumed.mask_temperature_k:g} K, d = {assumed.mask_distance_mm:g} mm",
                     "3.6 temperature, mask"),
        Contribution("sensor expansion", 0.0, 0.0, "systematic", "slow",
                     f"scale changes by {growth:.2g}; x and y of the centre do not",
                     "3.6 temperature, sensor"),
        Contribution("suspension, arms", arm, arm, "systematic", "slow",
                     f"a dT L, a = {assumed.arm_expansion_per_k:g}/K, "
                     f"dT = {assumed.arm_temperature_k:g} K, L = {assumed.arm_mm:g} mm",
                     "3.6 suspension"),
    ]  # fmt: skip
