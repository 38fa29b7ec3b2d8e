"""Phases and wave vectors of spatial frequencies, to the noise limit, and the lattice they make.

A discrete Fourier transform knows integer frequencies only. Here the windowed transform is
evaluated at exact wave vectors, with its first moments: for a pure tone the moment divided by
the transform tells how far the wave vector is off, and the phase at the window's centroid does
not depend on that error. The sums are separable under any rotation, so they are two small
matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rasnik.analysis.picture import Picture

__all__ = ["ToneLattice", "Tones", "chess_lattice", "combine", "measure", "primary_pair", "refine"]

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Tones (n, m) of the chess pattern used for the lattice: wave vector pi (n grad p + m grad q).
# Both odd; the negative of a tone is the same tone.
_TONES = np.array(
    [(1, -1), (1, 1), (3, -1), (3, 1), (1, -3), (1, 3), (3, -3), (3, 3),
     (5, -1), (5, 1), (1, -5), (1, 5), (7, -1), (7, 1), (1, -7), (1, 7)]
)  # fmt: skip
# A harmonic counts if its amplitude is this many times its noise ...
_HARMONIC_SIGNIFICANCE = 8.0
# ... and its phase is where the primary tones expect it (rad).
_HARMONIC_TOLERANCE = 0.35


@dataclass(frozen=True, eq=False)
class Tones:
    """The windowed transform of a picture at given wave vectors.

    Attributes
    ----------
    wave : ndarray, shape (n, 2)
        Wave vectors (radians per pixel).
    transform : ndarray of complex, shape (n,)
        Sum of windowed picture x exp(-i wave . position), positions from the centroid.
    offset : ndarray, shape (n, 2)
        Estimate of (true wave vector) - `wave`.
    """

    wave: Array
    transform: Complexes
    offset: Array


def measure(picture: Picture, wave: Array) -> Tones:
    """Evaluate the windowed transform of `picture` at each wave vector, shape (n, 2)."""
    u, v = picture.u_px, picture.v_px
    n = len(wave)
    along_u = _waves(u, wave[:, 0])
    basis = np.concatenate([along_u.real, along_u.imag])
    basis = np.concatenate([basis, basis * (u / u[-1])]).astype(np.float32)
    parts = np.empty((len(v), 4 * n), np.float32)
    _project(picture.windowed, basis, parts)
    plain, first = (half[:, :n] + 1j * half[:, n:] for half in np.hsplit(parts.astype(float), 2))
    along_v = _waves(v, wave[:, 1]).T
    transform = (along_v * plain).sum(axis=0)
    by_u = (along_v * first).sum(axis=0) * u[-1]
    by_v = (along_v * plain * v[:, None]).sum(axis=0)
    safe = np.where(transform == 0, 1.0, transform)
    moment = np.stack([(by_u / safe).imag, (by_v / safe).imag], axis=1)
    return Tones(wave, transform, moment @ np.linalg.inv(picture.variance))


@njit(cache=True, fastmath=True)
def _project(picture, basis, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """out = picture @ basis.T on one core; the rows of basis come in fours.

    A threaded matrix library loses more than it wins when the cores are busy.
    """
    height, width = picture.shape
    for row in range(0, height, 2):
        other = min(row + 1, height - 1)
        for n in range(0, basis.shape[0], 4):
            s0 = s1 = s2 = s3 = t0 = t1 = t2 = t3 = np.float32(0)
            for column in range(width):
                x, y = picture[row, column], picture[other, column]
                b0, b1 = basis[n, column], basis[n + 1, column]
                b2, b3 = basis[n + 2, column], basis[n + 3, column]
                s0 += x * b0
                s1 += x * b1
                s2 += x * b2
                s3 += x * b3
                t0 += y * b0
                t1 += y * b1
                t2 += y * b2
                t3 += y * b3
            out[other, n], out[other, n + 1], out[other, n + 2], out[other, n + 3] = t0, t1, t2, t3
            out[row, n], out[row, n + 1], out[row, n + 2], out[row, n + 3] = s0, s1, s2, s3


def _waves(position: Array, wave: Array) -> Complexes:
    """exp(-i wave position), shape (n, m)."""
    phase = np.outer(wave, position)
    result = np.empty(phase.shape, np.complex128)
    result.real, result.imag = np.cos(phase), -np.sin(phase)
    return result


def refine(picture: Picture, wave: Array, steps: int = 2) -> Tones:
    """Follow each wave vector to the nearest maximum of the spectrum.

    The steps are limited to one bin of the transform, so a start within a bin is needed.
    """
    height, width = picture.windowed.shape
    limit = np.array([2 * np.pi / width, 2 * np.pi / height])
    start = wave
    for _ in range(steps):
        tones = measure(picture, wave)
        wave = np.clip(wave + tones.offset, start - 1.5 * limit, start + 1.5 * limit)
    return measure(picture, wave)


def primary_pair(tones: Tones) -> Array:
    """Field coordinates in which the first two tones are the primaries of a chess pattern.

    Returns
    -------
    ndarray, shape (2, 3)
        (p, q) = result @ (u_px, v_px, 1) from the centroid of the window, with p growing
        rightward and q upward within 45 degrees.
    """
    # The pattern with bright fields at even i + j is  cos pi(p - q) - cos pi(p + q)  to first
    # order: one tone has positive, the other negative amplitude, whichever way they are labelled.
    best, best_value = np.zeros((2, 3)), -np.inf
    for first, second in ((0, 1), (1, 0)):
        difference = np.append(tones.wave[first], np.angle(tones.transform[first]))
        total = np.append(tones.wave[second], np.angle(tones.transform[second]) + np.pi)
        for sign in (1, -1):
            for other in (1, -1):
                p = (sign * difference + other * total) / (2 * np.pi)
                q = (other * total - sign * difference) / (2 * np.pi)
                norm = np.hypot(*p[:2]) + np.hypot(*q[:2])
                value = (p[0] - q[1]) / norm
                if p[0] * q[1] - p[1] * q[0] < 0 and value > best_value:
                    best, best_value = np.stack([p, q]), value
    return best


@dataclass(frozen=True, eq=False)
class ToneLattice:
    """A chess lattice from the phases of its tones, in pixels from the centroid of the window.

    Attributes
    ----------
    matrix : ndarray, shape (2, 3)
        (p, q) = matrix @ (u_px, v_px, 1).
    covariance : ndarray, shape (6, 6)
        Of ``matrix.ravel()``, from white pixel noise.
    orders : ndarray of int, shape (n, 2)
        The tones used.
    weight : ndarray, shape (n,)
        Inverse variance of their phases (rad^-2).
    blur_px : float
        Gaussian sigma of everything that blurs, the pixel included; NaN if unknown.
    amplitude : float
        Amplitude of the primary tones (grey levels).
    """

    matrix: Array
    covariance: Array
    orders: NDArray[np.int64]
    weight: Array
    blur_px: float
    amplitude: float


def chess_lattice(picture: Picture, matrix: Array, noise_variance: float) -> ToneLattice:
    """Refine a lattice with the primary tones and all harmonics that stand out of the noise.

    Parameters
    ----------
    matrix : ndarray, shape (2, 3)
        Start (see `primary_pair`).
    noise_variance : float
        Variance of a pixel, grey levels squared.
    """
    waves = np.pi * _TONES @ matrix[:, :2]
    below_nyquist = np.abs(waves).max(axis=1) < np.pi
    below_nyquist[:2] = True
    orders = _TONES[below_nyquist]
    tones = measure(picture, waves[below_nyquist])

    power = np.abs(tones.transform) ** 2
    noise_power = max(noise_variance, 1e-12) * picture.noise_moments[2, 2]
    error = phase_errors(tones, orders, matrix)
    used = (power > _HARMONIC_SIGNIFICANCE**2 * noise_power) & (np.abs(error) < _HARMONIC_TOLERANCE)
    used[:2] = True
    orders, weight = orders[used], 2 * power[used] / noise_power
    step, inverse = combine(orders, weight, error[used], tones.offset[used])

    # (wave vector, phase) from the moments, whose noise is correlated if the window is lopsided
    solve = np.eye(3)
    solve[:2, :2] = np.linalg.inv(picture.variance)
    spread = solve @ (picture.noise_moments / picture.noise_moments[2, 2]) @ solve.T
    amplitude = 2 * np.abs(tones.transform[used]) / picture.total
    return ToneLattice(
        matrix=matrix + step,
        covariance=np.kron(inverse, spread),
        orders=orders,
        weight=weight,
        blur_px=_blur(orders, tones.wave[used], amplitude),
        amplitude=float(np.sqrt(amplitude[0] * amplitude[1])),
    )


def phase_errors(tones: Tones, orders: NDArray[np.int64], matrix: Array) -> Array:
    """Phase of each tone minus what the lattice says, radians, within +-pi/2."""
    # sign of the amplitude: positive for (n, -m), negative for (n, m), n and m > 0
    expected = np.pi * orders @ matrix[:, 2] + np.where(orders[:, 1] > 0, np.pi, 0.0)
    error = np.angle(tones.transform * np.exp(-1j * expected))
    within: Array = np.mod(error + np.pi / 2, np.pi) - np.pi / 2  # defocus may invert a harmonic
    return within


def combine(
    orders: NDArray[np.int64], weight: Array, phase: Array, wave: Array
) -> tuple[Array, Array]:
    """Weighted least squares over tones for a change of the lattice's matrix.

    Tone (n, m) measures the combination n p0 + m q0 of the phases and n grad p + m grad q of
    the wave vectors. White noise makes the errors of different tones independent.

    Parameters
    ----------
    orders : ndarray of int, shape (n, 2)
    weight : ndarray, shape (n,)
    phase : ndarray, shape (n,)
        Change of the phases, radians.
    wave : ndarray, shape (n, 2)
        Change of the wave vectors.

    Returns
    -------
    step : ndarray, shape (2, 3)
    covariance : ndarray, shape (2, 2)
        Of the last column of `step`, if `weight` is the inverse variance of the phases.
    """
    inverse = np.asarray(np.linalg.inv((weight[:, None] * orders).T @ orders), np.float64)
    values = np.column_stack([wave, phase])
    step: Array = inverse @ (orders.T @ (weight[:, None] * values)) / np.pi
    return step, inverse / np.pi**2


def _blur(orders: NDArray[np.int64], waves: Array, amplitude: Array) -> float:
    """Gaussian sigma (pixels) from the fading of the harmonics, NaN with the primaries alone."""
    if len(orders) < 3:
        return float("nan")
    square = (waves**2).sum(axis=1)
    level = np.log(amplitude * np.abs(orders.prod(axis=1)))
    weight = amplitude**2
    mean_square, mean_level = np.average(square, weights=weight), np.average(level, weights=weight)
    slope = np.sum(weight * (square - mean_square) * (level - mean_level)) / np.sum(
        weight * (square - mean_square) ** 2
    )
    return float(np.sqrt(max(-2 * slope, 0.0)))
