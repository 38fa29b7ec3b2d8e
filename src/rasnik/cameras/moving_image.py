"""Noisy frames of a moving mask, made faster than a camera takes them.

The mask goes round a closed loop of poses. The expected pattern is rendered, once, at points of
that loop which lie so close that a cubic through four of them gives the pattern in between; a
frame is that cubic, its grey levels, and noise. Noise comes from a pool of normal numbers: each
row of each frame begins at a random place in it, with a random sign, so that two frames have
nothing in common on the average.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.model import expected_image
from rasnik.imaging.noise import frame_dtype
from rasnik.imaging.poses import Truth, parse_pose
from rasnik.instrument import System

__all__ = ["MovingImage"]

# Largest distance of the rendered points, in units of the width of an edge (blur and pixel): the
# cubic is then right to 2e-5 of the step from black to white.
_STEP_SIGMAS = 0.2
# By how much, in the same unit, a cubic through points of a circle may shift the image: 0.02 nm
# of SolidRas.
_SHIFT_SIGMAS = 4e-6
_FEWEST_POINTS = 16
_MOST_BYTES = 512 << 20
# The pattern is kept in whole steps of this, half a grey level of 14 bits.
_UNIT = np.float32(1 / 20_000)
_POOL = 1 << 20
# The turn moves the corners of the image by this share of what the motion moves the image.
_TURN = 0.1


class MovingImage:
    """Frames of a system's mask anywhere on a closed loop of poses.

    The loop is ``x = x0 + motion sin(phase)``, ``y = y0 + motion cos(phase)``, and a small turn
    ``sin(phase + 1)``, about a point near the middle of the mask.

    Parameters
    ----------
    system : System
    motion_um : float
        Amplitude on the mask.
    seed : int
        Of the noise.

    Raises
    ------
    ValueError
        If the system does not state its noise, or the motion leaves the mask or is so large that
        its images do not fit the memory.
    """

    def __init__(self, system: System, motion_um: float, seed: int) -> None:
        if system.noise_law is None:
            raise ValueError(
                f"the noise of system {system.name} is not known: give sensor.noise_a and "
                "sensor.noise_b"
            )
        if not (math.isfinite(motion_um) and motion_um >= 0):
            raise ValueError(f"motion_um must be 0 or more, not {motion_um:g}")
        self._system = system
        self._motion_um = motion_um
        self._seed = seed
        self._camera = Camera(system.shape, system.pitch_um)
        height, width = system.shape
        self._half_diagonal_um = math.hypot(height, width) * system.pitch_um / 2
        moved_um = motion_um * system.optics.scale
        self._turn_rad = _TURN * moved_um / self._half_diagonal_um
        sigma_um = math.hypot(system.optics.blur_um, system.pitch_um / math.sqrt(12))
        wanted = 1.0
        if motion_um:
            step_um = _step_um(moved_um, sigma_um)
            wanted = max(_FEWEST_POINTS, 2 * math.pi * moved_um * (1 + _TURN) / step_um)
        self._points = math.ceil(wanted)
        most = _MOST_BYTES // (2 * height * width)
        if self._points > most:
            raise ValueError(
                f"a motion of {motion_um:g} um takes too much memory to simulate; give "
                f"motion_um of {motion_um * most / wanted:.2g} at most"
            )
        self._check_on_mask()
        self._rendered = np.empty((self._points, height, width), np.int16)
        self._ready = np.zeros(self._points, bool)
        rng = np.random.default_rng(seed)
        pool = rng.standard_normal(_POOL, dtype=np.float32)
        self._pool = (pool - pool.mean()) / pool.std()
        self.frame(0.0, 1.0, 1.0, 0)  # compiled here, not while frames wait

    def prepare(self, phase: float, longest_s: float) -> None:
        """Render the points after a phase, until all are or the time is over.

        The others are rendered when they are first needed, which delays that frame.
        """
        end_s = time.perf_counter() + longest_s
        (first, *_), _ = self._nearest(phase)
        for k in range(self._points):
            if time.perf_counter() > end_s:
                return
            self._render((first + k) % self._points)

    def truth(self, phase: float) -> Truth:
        """The pose at a phase, in radians."""
        x0, x1, y0, y1 = self._system.mask.bounds_um
        field = self._system.mask.field_um
        # Off the middle by part of a field, as an instrument would be.
        return parse_pose(
            self._system,
            {
                "x_um": (x0 + x1) / 2 + 0.3 * field + self._motion_um * math.sin(phase),
                "y_um": (y0 + y1) / 2 + 0.2 * field + self._motion_um * math.cos(phase),
                "theta_rad": self._system.optics.theta_rad + self._turn_rad * math.sin(phase + 1),
            },
            "the simulated motion",
        )

    def frame(self, phase: float, brightness: float, gain: float, index: int) -> NDArray[Any]:
        """One frame.

        Parameters
        ----------
        phase : float
            Where on the loop, in radians.
        brightness : float
            Factor on all grey levels, gain included; 1 for those of the system.
        gain : float
            Factor by which the sensor amplifies, and its noise with it.
        index : int
            Of the frame: the same index gives the same noise.

        Returns
        -------
        ndarray, shape (H, W)
            uint8 or uint16, limited to full scale.
        """
        sensor = self._system.sensor
        law = self._system.noise_law
        assert law is not None
        (a, b, c, d), weights = self._nearest(phase)
        for point in (a, b, c, d):
            self._render(point)
        dark = brightness * sensor.dark_level
        step = brightness * (sensor.light_level - sensor.dark_level) * float(_UNIT)
        out = np.empty(self._system.shape, frame_dtype(self._system))
        _expose(
            self._rendered[a],
            self._rendered[b],
            self._rendered[c],
            self._rendered[d],
            weights.astype(np.float32),
            np.array([dark, step, law[0] * gain**2, law[1] * gain], np.float32),
            np.float32(self._system.full_scale),
            self._pool,
            np.uint64(np.random.SeedSequence((self._seed, index)).generate_state(1, np.uint64)[0]),
            out,
        )
        return out

    def _nearest(self, phase: float) -> tuple[list[int], NDArray[np.float64]]:
        """The four rendered points about a phase, and their weights (Lagrange's cubic)."""
        at = phase / (2 * math.pi) % 1.0 * self._points
        first = math.floor(at)
        t = at - first
        weights = [
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        ]
        return [(first + k) % self._points for k in (-1, 0, 1, 2)], np.array(weights)

    def _check_on_mask(self) -> None:
        for quarter in range(4):
            self.truth(quarter * math.pi / 2)

    def _render(self, point: int) -> None:
        if self._ready[point]:
            return
        system, phase = self._system, 2 * math.pi * point / self._points
        pattern = Appearance.uniform(0.0, 1.0, system.optics.blur_um)
        image = expected_image(system.mask, self.truth(phase).projection, pattern, self._camera)
        self._rendered[point] = np.rint(image / _UNIT)
        self._ready[point] = True


def _step_um(radius_um: float, sigma_um: float) -> float:
    """Distance of the points to render on a circle on the sensor.

    Of a function of the path s, the cubic lacks (3/128) h^4 times the fourth derivative. That of
    the circle itself is 1 / radius^3. The third order of the image, s^2 along the circle times
    s^2 / (2 radius) across it, adds a shift of 0.05 h^4 / (radius sigma^2).
    """
    path = (_SHIFT_SIGMAS * sigma_um * radius_um**3 / 0.0234) ** 0.25
    image = (_SHIFT_SIGMAS * sigma_um**3 * radius_um / 0.05) ** 0.25
    return min(_STEP_SIGMAS * sigma_um, path, image)


@njit(cache=True, nogil=True, fastmath=True)
def _expose(
    a: NDArray[np.int16],
    b: NDArray[np.int16],
    c: NDArray[np.int16],
    d: NDArray[np.int16],
    weights: NDArray[np.float32],
    levels: NDArray[np.float32],
    full_scale: np.float32,
    pool: NDArray[np.float32],
    state: np.uint64,
    out: NDArray[Any],
) -> None:
    """Write the frame: the cubic through four patterns, its grey levels, their noise."""
    height, width = out.shape
    wa, wb, wc, wd = weights
    dark, step, electronic, shot = levels
    zero, half = np.float32(0), np.float32(0.5)
    for row in range(height):
        # xorshift64*, by Marsaglia and Vigna: one number for the start and sign of each row.
        state ^= state >> np.uint64(12)
        state ^= state << np.uint64(25)
        state ^= state >> np.uint64(27)
        drawn = state * np.uint64(2685821657736338717)
        start = np.int64((drawn >> np.uint64(32)) % np.uint64(pool.size - width))
        sign = np.float32(1) if drawn & np.uint64(1 << 31) else np.float32(-1)
        noise = pool[start : start + width]
        for column in range(width):
            pattern = (
                wa * np.float32(a[row, column])
                + wb * np.float32(b[row, column])
                + wc * np.float32(c[row, column])
                + wd * np.float32(d[row, column])
            )
            grey = dark + step * pattern
            variance = electronic + shot * max(grey, zero)
            grey += sign * noise[column] * np.sqrt(variance)
            out[row, column] = np.int32(min(max(grey, zero), full_scale) + half)
