"""Simulated instruments in motion: what the paper's systems stood in while they measured."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.analyse import analyse
from rasnik.imaging.model import expected_image
from rasnik.imaging.motion import Motion, Seismic, Sine, displacements
from rasnik.imaging.noise import ReadOut
from rasnik.imaging.poses import parse_pose
from rasnik.instrument import System
from rasnik.paper.images import stream
from rasnik.performance.bound import camera_of, reference_pose, state_at
from rasnik.tracking.track import Track
from rasnik.tracking.tracker import Tracker

__all__ = ["IN_AIR", "MICRORAS", "SUSPENDED", "UV", "Recording", "Resonance", "record"]

_GRAVITY = 9.81  # m/s^2
_AT_ONCE = 256


@dataclass(frozen=True)
class Resonance:
    """Gaussian motion of a damped oscillator that white noise shakes.

    One-sided amplitude spectral density proportional to ``1 / |1 - r^2 + i r / Q|``, r = f / hz,
    independent in x and y.
    """

    summary: ClassVar[str] = "a resonance driven by noise"
    hz: float
    quality: float
    x_rms_um: float = 0.0
    y_rms_um: float = 0.0

    def at(self, t_s: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """(x_um, y_um, theta_rad) at the times of the frames, shape (n, 3)."""
        out = np.zeros((t_s.size, 3))
        if t_s.size < 2:
            return out
        step_s, length = t_s[1] - t_s[0], 2 * t_s.size
        f = np.fft.rfftfreq(length, step_s)
        r = f / self.hz
        response = 1 / (1 - r**2 + 1j * r / self.quality)
        # White noise of unit density gives the variance pi / 2 hz Q.
        response /= math.sqrt(math.pi / 2 * self.hz * self.quality)
        response[0] = 0
        for axis, rms in ((0, self.x_rms_um), (1, self.y_rms_um)):
            real, imaginary = rng.standard_normal((2, f.size))
            noise = response * (real + 1j * imaginary) * math.sqrt(length / step_s) / 2
            out[:, axis] = rms * np.fft.irfft(noise, length)[: t_s.size]
        return out


def _pendulum_hz(length_m: float) -> float:
    return math.sqrt(_GRAVITY / length_m) / (2 * math.pi)


# The paper shows the spectra and names the causes; lengths of the suspensions are stated, sizes
# of the motions are not and are chosen here, in micrometres on the mask.

#: SolidRas on a lab table: air of varying refractive index, felt at low frequency.
IN_AIR: tuple[Motion, ...] = (Seismic(asd_um_rthz=4e-3, corner_hz=0.5),)
#: SolidRas in vacuum as a pendulum on wires; their length is taken to be that of the UV run.
SUSPENDED: tuple[Motion, ...] = (
    Seismic(asd_um_rthz=1e-3, corner_hz=0.3),
    Resonance(_pendulum_hz(0.07), 30, 8e-3, 5e-3),
)
#: The same on strings of 70 mm; their stretching is seen in y near 20 Hz, not in x.
UV: tuple[Motion, ...] = (
    *SUSPENDED,
    Resonance(18.0, 60, 0.0, 0.5e-3),
    Resonance(21.5, 60, 0.0, 0.8e-3),
)
#: MicroRas on wires of 30 mm: a pendulum near 3 Hz, the unit itself near 25 Hz, and lines at 25,
#: 50, 75 and 100 Hz that the paper ascribes to the mains.
MICRORAS: tuple[Motion, ...] = (
    Seismic(asd_um_rthz=1e-4, corner_hz=0.3),
    Resonance(_pendulum_hz(0.03), 30, 0.6e-3, 0.4e-3),
    Resonance(25.0, 5, 0.04e-3, 0.03e-3),
    Sine(25.0, 0.03e-3, 0.02e-3),
    Sine(50.0, 0.08e-3, 0.06e-3, phase_rad=1.0),
    Sine(75.0, 0.02e-3, 0.015e-3, phase_rad=2.0),
    Sine(100.0, 0.04e-3, 0.03e-3, phase_rad=3.0),
)


@dataclass(frozen=True, eq=False)
class Recording:
    """A simulated series of frames after both analyses.

    Attributes
    ----------
    system : System
    track : Track
        Of all frames, by the tracker (likelihood).
    fourier_errors : ndarray, shape (m, 4)
        By the Fourier method minus truth, of some of the frames: x, y (um), scale, theta_z.
    """

    system: System
    track: Track
    fourier_errors: NDArray[np.float64]


def record(
    system: System,
    motions: tuple[Motion, ...],
    count: int,
    seed: tuple[int, ...],
    fourier: int,
) -> Recording:
    """Simulate frames of a moving instrument and track them.

    The expected image is made anew for every frame, by the quick image model, which agrees with
    the exact one to 1e-4 of the step from black to white.

    Parameters
    ----------
    system : System
        With a frame rate.
    motions : tuple of Motion
    count : int
        Frames.
    seed : tuple of int
    fourier : int
        How many of them the Fourier method analyses, evenly spread.
    """
    rate_hz = system.sensor.frame_rate_hz
    if rate_hz is None:
        raise ValueError(f"system {system.name} states no frame rate")
    rng = stream(*seed)
    moves = displacements(motions, count, rate_hz, rng)
    start = parse_pose(system, reference_pose(system), "start")
    stride = max(1, count // fourier)
    errors: list[list[float]] = []

    def frames() -> Iterator[NDArray[Any]]:
        for k, move in enumerate(moves):
            truth = start.moved(*map(float, move))
            state = state_at(system, truth.projection)
            expected = expected_image(
                system.mask, truth.projection, state.appearance, camera_of(system)
            )
            frame = ReadOut(expected, system).frame(rng)
            if k % stride == 0:
                pose = analyse(frame, system, orientation=truth.orientation, method="fourier")
                errors.append(
                    [
                        pose.x_um - truth.x_um,
                        pose.y_um - truth.y_um,
                        pose.scale - truth.scale,
                        pose.theta_rad - truth.theta_rad,
                    ]
                )
            yield frame

    tracker = Tracker(system, orientation=start.orientation, model="similarity")
    pieces = list(tracker.blocks(frames(), size=_AT_ONCE))
    track = Track.concatenate(pieces)
    found = np.array(errors)
    if not track.ok.all() or not np.isfinite(found).all():
        raise RuntimeError(f"frames of {system.name} without a position")
    return Recording(system, track, found)
