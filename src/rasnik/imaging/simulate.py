"""Simulated frames together with the truth they were made from.

A frame is made in three steps: the pose of each frame is laid down (`Truth`), the expected
image of that pose is computed (a *path*, see `PATHS`, with the *effects* asked for), and the
sensor adds its noise. Frames of the same pose share the expected image. Every frame has a
random generator of its own, so frame k of a simulation is the same whether it is made alone, in
order, or by several threads.
"""

from __future__ import annotations

import math
import operator
import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.imaging.effects import Chain, Context, make_effects
from rasnik.imaging.levels import LevelMap
from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.motion import displacements, make_motions
from rasnik.imaging.noise import ReadOut, Statistics
from rasnik.imaging.paper import paper_image
from rasnik.imaging.poses import Truth, check_on_mask, parse_pose, parse_poses
from rasnik.instrument import System, load_system

__all__ = ["PATHS", "Simulation", "Truth", "simulate"]

#: Ways to compute the expected image, by name:
#: (system, projection, light_map=..., dark_map=..., deviations=...) -> float64 (H, W).
PATHS: dict[str, Callable[..., NDArray[np.float64]]] = {
    "exact": exact_image,
    "paper": paper_image,
}

# Keys of the random streams drawn from one seed; 2 is that of the effects.
_POSITIONS, _FRAMES, _MOTION = 0, 1, 3


@dataclass(frozen=True)
class _Settings:
    noise: bool
    statistics: Statistics
    path: str
    light_map: LevelMap | float | None
    dark_map: LevelMap | float | None


@dataclass(frozen=True, eq=False)
class Simulation:
    """Frames and truth of one simulation.

    Frames are made when asked for. ``for frame, truth in simulation`` and ``simulation[k]``
    keep none of them, however many there are; `frames` makes them all and keeps them.

    Attributes
    ----------
    system : System
        As given. What effects change of it is not in it.
    truth : tuple of Truth
        One per frame: where the mask stands, which is not what the image shows if an effect
        bends the light or stretches the mask.
    seed : int
        Makes the same simulation again.
    """

    system: System
    truth: tuple[Truth, ...]
    seed: int
    settings: _Settings = field(repr=False)
    chain: Chain = field(repr=False)

    @cached_property
    def frames(self) -> NDArray[Any]:
        """All frames, shape (n, H, W), made by one thread per processor core."""
        out = np.empty((len(self), *self.system.shape), self.dtype)
        for k, frame in enumerate(self._frames()):
            out[k] = frame
        return out

    @property
    def described(self) -> dict[str, Any]:
        """How the frames were made, for the record: path, and effects with their parameters."""
        effects = {e.info.name: e.parameters for e in self.chain.effects}
        return {"path": self.settings.path, "noise": self.settings.noise, "effects": effects}

    @property
    def dtype(self) -> np.dtype[Any]:
        """Data type of the frames."""
        return self.chain.dtype

    def expected(self, k: int) -> NDArray[np.float64]:
        """Expected image of frame k: without noise, range and rounding; shape (H, W)."""
        k = range(len(self))[k]
        expected = self._expected(k)
        gain = self.chain.gain(k)
        return expected if gain is None else expected * gain

    def __len__(self) -> int:
        return len(self.truth)

    def __getitem__(self, k: int) -> tuple[NDArray[Any], Truth]:
        truth = self.truth[operator.index(k)]
        k %= len(self)
        return self._renderer(k)(k), truth

    def __iter__(self) -> Iterator[tuple[NDArray[Any], Truth]]:
        yield from zip(self._frames(), self.truth, strict=True)

    def _frames(self) -> Iterator[NDArray[Any]]:
        """All frames in order, a few made ahead by one thread per processor core."""
        workers = os.cpu_count() or 1
        waiting: deque[Future[NDArray[Any]]] = deque()
        with ThreadPoolExecutor(workers) as pool:
            try:
                for run in self._runs():
                    render = pool.submit(self._renderer, run[0])
                    for k in run:
                        waiting.append(pool.submit(_render_when_ready, render, k))
                        if len(waiting) > 2 * workers:
                            yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                for future in waiting:
                    future.cancel()

    def _runs(self) -> Iterator[range]:
        """Ranges of consecutive frames that show the same."""

        def shown(k: int) -> tuple[int, ...]:
            shifts = self.chain.shifts_um
            return (id(self.truth[k]), 0 if shifts is None else hash(shifts[k].tobytes()))

        for _, group in groupby(range(len(self)), key=shown):
            first, *rest = group
            yield range(first, first + 1 + len(rest))

    def _expected(self, k: int) -> NDArray[np.float64]:
        s = self.settings
        levels = PATHS[s.path](
            self.system,
            self.chain.projection(self.truth[k].projection, k),
            light_map=s.light_map,
            dark_map=s.dark_map,
            deviations=self.chain.deviations,
        )
        return self.chain.respond(levels)

    def _renderer(self, k: int) -> Callable[[int], NDArray[Any]]:
        """Function that makes frame k, and all that show the same."""
        expected, s, chain = self._expected(k), self.settings, self.chain
        shared: list[ReadOut] = []
        if s.noise and chain.gain(k) is None:
            shared.append(ReadOut(expected, chain.system, s.statistics))

        def render(k: int) -> NDArray[Any]:
            gain = chain.gain(k)
            levels = expected.copy() if gain is None else expected * gain
            if s.noise:
                readout = shared[0] if shared else ReadOut(levels, chain.system, s.statistics)
                rng = _stream(self.seed, _FRAMES, k)
                if chain.ordinary:
                    return readout.frame(rng)
                levels = readout.frame(rng, quantise=False)
            return chain.read_out(levels)

        return render


def _render_when_ready(render: Future[Callable[[int], NDArray[Any]]], k: int) -> NDArray[Any]:
    # Pool threads take tasks in order, so the renderer is at work before any of its frames is
    # waited for: the wait ends.
    return render.result()(k)


def simulate(
    system: System | str | os.PathLike[str],
    poses: Any = None,
    *,
    n: int = 1,
    seed: int | None = None,
    noise: bool = True,
    quantise: bool | None = None,
    statistics: Statistics = "gaussian",
    light_map: LevelMap | float | None = None,
    dark_map: LevelMap | float | None = None,
    path: str = "exact",
    effects: Any = None,
    motion: Any = None,
) -> Simulation:
    """Simulate frames of a mask at given or random poses.

    Parameters
    ----------
    system : System, str or path
        The instrument, or its name or file.
    poses : optional
        One pose or a sequence of poses. A pose is ``(x_um, y_um[, theta_rad[, scale[,
        orientation]]])``, a mapping with these keys, anything with these attributes (a
        `Truth`, an analysed pose) or a `Projection`. What is left out, or None, is the
        system's; the orientation is 4 where the system leaves it open. By default every frame
        has a random position, at which the view is filled by the mask if it can be.
    n : int
        Frames of each pose given; without poses, number of random positions.
    seed : int, optional
        Seed of positions and noise; random by default, to be read from the result.
    noise : bool
        Whether the sensor adds noise.
    quantise : bool, optional
        Whether levels are limited to the sensor's range and rounded; by default if there is
        noise. Frames are then uint8 or uint16, otherwise float64.
    statistics : {"gaussian", "poisson"}
        Distribution of the shot noise.
    light_map, dark_map : callable or float, optional
        Grey levels of white and black over the sensor, see `exact_image`; by default the
        system's levels.
    path : str
        How the expected image is computed: ``"exact"``, or ``"paper"`` as the paper does it.
    effects : optional
        Sources of error by name, e.g. ``{"mask_edges": 6.0, "blooming": True}``, or a list of
        names, ``"name=value"`` or `Effect`; see `rasnik.imaging.effects`.
    motion : optional
        A motion or several (`rasnik.imaging.motion`), which add to every pose over its `n`
        frames at the frame rate of the system.

    Returns
    -------
    Simulation

    Raises
    ------
    ValueError
        If a pose is incomplete or impossible or its (x_um, y_um) is not on the mask (the view
        may reach beyond the mask, which is opaque there), if `n` is below 1, an option is
        unknown, noise is wanted and the system does not state it, an effect or motion is
        impossible or needs what the system does not state, or a motion leaves the mask.
    SystemConfigError
        If the system cannot be read.
    TypeError
        If a pose, `n` or `seed` is of a wrong type.
    """
    system = load_system(system)
    n, seed = _count(n), _seed(seed)
    if path not in PATHS:
        raise ValueError(f"path must be one of {', '.join(PATHS)}, not {path!r}")
    if statistics not in ("gaussian", "poisson"):
        raise ValueError(f"statistics must be 'gaussian' or 'poisson', not {statistics!r}")
    settings = _Settings(noise, statistics, path, light_map, dark_map)
    if poses is None:
        positions = _random_positions(system, 1 if motion is not None else n, seed)
        starts = [parse_pose(system, position, "pose") for position in positions]
    else:
        starts = parse_poses(system, poses)
    if motion is not None:
        truth = _moving(system, starts, n, motion, seed)
    else:
        truth = starts if poses is None else [t for t in starts for _ in range(n)]
    chain = Chain(
        make_effects(effects),
        Context(system, seed, len(truth)),
        noise if quantise is None else quantise,
    )
    if noise and chain.system.noise_law is None:
        raise ValueError(
            f"the noise of system {system.name} is not known: give sensor.noise_a and "
            "sensor.noise_b, or simulate without noise"
        )
    simulation = Simulation(system, tuple(truth), seed, settings, chain)
    _ = chain.shifts_um, chain.deviations  # faults show here rather than at the first frame
    return simulation


def _moving(system: System, starts: list[Truth], n: int, motion: Any, seed: int) -> list[Truth]:
    """n poses from each start on."""
    motions, rate_hz = make_motions(motion), system.sensor.frame_rate_hz
    if rate_hz is None:
        raise ValueError(
            f"the frame rate of system {system.name} is not known: give sensor.frame_rate_hz "
            "for a motion"
        )
    truth = []
    for index, start in enumerate(starts):
        steps = displacements(motions, n, rate_hz, _stream(seed, _MOTION, index))
        truth += [start.moved(*map(float, step)) for step in steps]
    for k, pose in enumerate(truth):
        check_on_mask(system, pose, f"frame {k} of the motion")
    return truth


# ------------------------------------------------------------------------- randomness


def _stream(seed: int, purpose: int, index: int = 0) -> np.random.Generator:
    """The random stream of one purpose and frame: independent of all others of this seed."""
    return np.random.Generator(
        np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(purpose, index)))
    )


def _random_positions(system: System, n: int, seed: int) -> NDArray[np.float64]:
    """n points (x, y), uniform over the mask; off its edge by half a view where it is large."""
    height, width = system.shape
    view = math.hypot(height, width) * system.pitch_um / system.optics.scale
    x0, x1, y0, y1 = system.mask.bounds_um
    low, high = np.array([x0, y0]), np.array([x1, y1])
    inset = np.where(high - low > view, view / 2, 0.0)
    return _stream(seed, _POSITIONS).uniform(low + inset, high - inset, (n, 2))


def _count(n: int) -> int:
    try:
        count = operator.index(n)
    except TypeError:
        raise TypeError(f"n, the number of frames, must be a whole number, not {n!r}") from None
    if count < 1:
        raise ValueError(f"n, the number of frames, must be at least 1, not {count}")
    return count


def _seed(seed: int | None) -> int:
    if seed is None:
        return int(np.random.SeedSequence().generate_state(1, np.uint64)[0])
    try:
        value = operator.index(seed)
    except TypeError:
        raise TypeError(f"seed must be a whole number, not {seed!r}") from None
    if value < 0:
        raise ValueError(f"seed must not be negative, it is {value}")
    return value
