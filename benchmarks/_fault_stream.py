"""A stream of frames in which everything goes wrong that can, with the truth of every frame.

The whole course is laid down first (`FaultStream`): where the mask is, how bright the light, what
is in the way, which frames are missing. Any frame can then be made on its own, the same
every time. The mask drifts slowly and vibrates by 30 nm all the while.

Expected images come from the image model, some from the exact generator. They are made at
poses at most 0.1 um away; the rest is the first order in the displacement, which leaves less than
0.01 grey levels. Noise comes from a pool of normal numbers, cut out anew for every frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _fault_images import BLANKS, PARTS, Levels, dust_map
from rasnik.imaging.appearance import Appearance, Camera
from rasnik.imaging.kernels import LEVEL
from rasnik.imaging.model import expected_signals
from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.noise import quantise_levels
from rasnik.imaging.projection import Projection
from rasnik.instrument import System, load_system

ORIENTATION = 4
# As the paper's SolidRas, but darker, so that the light can rise by 5 % within the range.
SYSTEM = load_system("solidras", {"sensor.dark_level": 21.0, "sensor.light_level": 210.0})

_DRIFT_UM, _DRIFT_S = (3.0, 2.0), (61.0, 83.0)
_VIBRATION_UM, _VIBRATION_HZ = 0.03, (17.3, 23.9)
_LIGHT_DRIFT, _LIGHT_S = 0.08, 47.0
_BASE_FRAMES = 32  # frames made from one expected image
_WANDER_UM = (2e4, 1.7e5)  # where the mask stays, whatever the jumps
_FIELD_STEPS = (1, 2, 9, 18, 81)  # one, two, the period of the code and multiples of it
_POOL = (1009, 1201)
_BASE, _CONTENT, _EVENT, _FIXED = 1, 2, 3, 4  # keys of the random streams drawn from one seed


class View(Enum):
    """What a frame shows of the mask."""

    FULL = "full"  # an undisturbed view, at whatever pose and light
    PART = "part"  # one pose, but something is in the way or too bright
    PIECES = "pieces"  # parts of the image that show different poses
    NOTHING = "nothing"


@dataclass(frozen=True)
class Truth:
    """What is known of one frame.

    Attributes
    ----------
    kind : str
        What disturbs it, one of `KINDS`, "dust" or "quiet".
    view : View
    poses : ndarray, shape (pieces, 4)
        x (um), y (um), scale, theta_z (rad) of each piece.
    change : str
        Kind of the disturbance that this frame comes just after; empty if none.
    """

    kind: str
    view: View
    poses: NDArray[np.float64]
    change: str = ""


@dataclass(frozen=True)
class Event:
    """A disturbance from frame `start` on, `length` frames long."""

    kind: str
    start: int
    length: int


_MOVES = ("jump", "jump of whole fields", "turn", "scale", "sweep")
_LIGHTS = {"half the light": 0.5, "light x 0.9": 0.9, "light x 1.05": 1.05}
_MISSING = ("no image", "wrong size")
_TORN = ("torn by vibration", "torn by a jump", "torn by whole fields")
#: Every kind of disturbance but dust, which comes and goes besides.
KINDS = (*_MOVES, *_LIGHTS, "dropped", *PARTS, *BLANKS, *_MISSING, *_TORN, "rolled")
# Moves are what is most easily followed wrongly.
_WEIGHTS = {"jump": 4.0, "jump of whole fields": 4.0, "turn": 2.0, "hand": 2.0}


def _one_per_gap(n: int, every: float, kinds: Sequence[str], rng: np.random.Generator) -> Any:
    """Disturbances of 1 to 10 frames with `every` frames from one to the next on average."""
    weights = np.array([_WEIGHTS.get(kind, 1.0) for kind in kinds])
    weights /= weights.sum()
    at, order = 5, list(kinds)  # each kind once before chance decides
    while True:
        length = int(rng.integers(1, 11))
        kind = order.pop(0) if order else str(rng.choice(kinds, p=weights))
        at += 1 + int(rng.exponential(max(every - 6.5, 1.0)))
        if at + length >= n:
            return
        yield Event(kind, at, length)
        at += length


class FaultStream:
    """Frames of a mask that drifts and vibrates, disturbed at random moments.

    Parameters
    ----------
    n : int
        Number of frames.
    seed : int
    every : float
        Mean number of frames from one disturbance to the next; infinite for none.
    kinds : sequence of str
        Which disturbances, of `KINDS` and "dust".
    exact : float
        Share of the expected images that come from the exact generator (0.3 s each).
    system : System

    Attributes
    ----------
    numbers : ndarray of int64, shape (n,)
        Of the frames in their source; dropped frames are left out.
    times_s : ndarray, shape (n,)
    poses : ndarray, shape (n, 4)
        x (um), y (um), scale, theta_z (rad) of the mask at each frame.
    """

    def __init__(
        self,
        n: int,
        seed: int = 0,
        *,
        every: float = 100.0,
        kinds: Sequence[str] = (*KINDS, "dust"),
        exact: float = 0.05,
        system: System = SYSTEM,
    ) -> None:
        self.system, self.seed, self._exact = system, seed, exact
        rng = np.random.default_rng([seed, _FIXED])
        self._pool = rng.standard_normal(_POOL, dtype=np.float32)
        events = [kind for kind in kinds if kind != "dust"]
        self.events: list[Event] = []
        if events and np.isfinite(every):
            self.events = list(_one_per_gap(n, every, events, rng))
        self._event = np.full(n, -1)
        self.numbers = np.arange(n)
        self._light = np.ones(n, np.float32)
        # The pose without drift and vibration: constant between the moves.
        self._rest = np.tile([61_234.5, 83_456.7, 1.0, 0.003], (n, 1))
        for k, event in enumerate(self.events):
            self._event[event.start : event.start + event.length] = k
            self._lay_down(event, np.random.default_rng([seed, _EVENT, k]))
        self._dust = np.full(n, -1)
        if "dust" in kinds:
            self._lay_dust(rng)
        rate_hz = system.sensor.frame_rate_hz or 275.0
        self.times_s = self.numbers / rate_hz
        t = self.times_s
        self._light *= 1 + np.float32(_LIGHT_DRIFT) * np.sin(2 * np.pi * t / _LIGHT_S)
        self._base_at = (np.arange(n) // _BASE_FRAMES) * _BASE_FRAMES
        self.poses = self._rest.copy()
        self.poses[:, :2] += self._drift(t)
        for axis, hz in enumerate(_VIBRATION_HZ):
            self.poses[:, axis] += _VIBRATION_UM * np.sin(2 * np.pi * hz * t + axis)
        self._base = lru_cache(maxsize=4)(self._render)

    def __len__(self) -> int:
        return len(self.numbers)

    def frames(self) -> Iterator[NDArray[Any] | None]:
        """All frames in order."""
        for k in range(len(self)):
            yield self.frame(k)

    # ------------------------------------------------------------ the course of events

    def _drift(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        phase = 2 * np.pi * t_s[:, None] / np.array(_DRIFT_S)
        return np.array(_DRIFT_UM) * np.sin(phase)

    def _lay_down(self, event: Event, rng: np.random.Generator) -> None:
        """Enter what a disturbance does to pose, light and numbers."""
        span = slice(event.start, event.start + event.length)
        if event.kind in _LIGHTS:
            # every third time the light stays as it is for a while
            longer = 150 if rng.random() < 1 / 3 else 0
            self._light[event.start : span.stop + longer] *= _LIGHTS[event.kind]
        elif event.kind == "dropped":
            self.numbers[event.start :] += int(rng.integers(1, 50))
        elif event.kind in _MOVES:
            move = self._move(event, rng)
            self._rest[span] += move
            if rng.random() < 0.5 or event.kind == "sweep":
                self._rest[span.stop :] += move[-1]
        elif event.kind in _TORN[1:] and rng.random() < 0.5:
            # the mask stays where the second half of the first torn frame shows it
            self._rest[event.start :] += self._tear(event)

    def _move(self, event: Event, rng: np.random.Generator) -> NDArray[np.float64]:
        """Displacement at each frame of the event, shape (length, 4)."""
        rest = self._rest[event.start - 1]
        move = np.zeros((event.length, 4))
        if event.kind == "turn":
            turned = rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(1e-6), np.log(0.05)))
            move[:, 3] = -turned if abs(rest[3] + turned) > 0.06 else turned
        elif event.kind == "scale":
            change = rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(1e-4), np.log(1e-2)))
            move[:, 2] = -change if abs(rest[2] + change - 1) > 0.03 else change
        elif event.kind == "sweep":
            step = self._jump(rest, np.exp(rng.uniform(np.log(0.1), np.log(300))), rng)
            move[:, :2] = step * np.arange(1, event.length + 1)[:, None]
        elif event.kind == "jump":
            size = np.exp(rng.uniform(np.log(0.01), np.log(1e4)))
            move[:, :2] = self._jump(rest, size, rng)
        else:
            move[:, :2] = self._fields(rest, rng)
        return move

    def _jump(
        self, rest: NDArray[np.float64], size_um: float, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        angle = rng.uniform(0, 2 * np.pi)
        return _inward(rest, size_um * np.array([np.cos(angle), np.sin(angle)]))

    def _fields(self, rest: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        steps = rng.choice(_FIELD_STEPS, 2) * rng.choice([-1, 1], 2)
        steps *= np.array([(1, 0), (0, 1), (1, 1)])[rng.integers(3)]
        return _inward(rest, steps * self.system.mask.field_um)

    def _tear(self, event: Event) -> NDArray[np.float64]:
        """Displacement between the two halves of a torn frame, shape (4,)."""
        rng = np.random.default_rng([self.seed, _EVENT, event.start, _BASE])
        rest, move = self._rest[event.start - 1], np.zeros(4)
        if event.kind == "torn by a jump":
            move[:2] = self._jump(rest, np.exp(rng.uniform(np.log(0.01), np.log(1e4))), rng)
        elif event.kind == "torn by whole fields":
            move[:2] = self._fields(rest, rng)
        return move

    def _lay_dust(self, rng: np.random.Generator) -> None:
        """Specks that settle, stay for 20 to 500 frames, and go; 10 % of the time."""
        at, k, n = int(rng.integers(30, 300)), 0, len(self)
        while at < n:
            stay = int(np.exp(rng.uniform(np.log(20), np.log(500))))
            self._dust[at : at + stay] = k
            at += stay + int(rng.exponential(9 * 150))
            k += 1

    # ------------------------------------------------------------ truth and frame

    def truth(self, k: int) -> Truth:
        """What frame k shows."""
        event = self._event_at(k)
        dusty = self._dust[k] >= 0
        kind = event.kind if event else "dust" if dusty else "quiet"
        view = View.PART if dusty else View.FULL
        poses = self.poses[k : k + 1]
        if kind in PARTS:
            view = View.PART
        elif kind in BLANKS or kind in _MISSING:
            view, poses = View.NOTHING, np.empty((0, 4))
        elif event and kind in _TORN:
            view, poses = View.PIECES, np.stack([self._other_pose(k, event), self.poses[k]])
        elif event and kind == "rolled":
            view, poses = View.PIECES, self._rolled_poses(k, self._roll(event))
        return Truth(kind, view, poses, self._change(k, event))

    def _event_at(self, k: int) -> Event | None:
        return self.events[self._event[k]] if self._event[k] >= 0 else None

    def _change(self, k: int, event: Event | None) -> str:
        if k == 0:
            return "start"
        if event and event.start == k:
            return event.kind
        if (self._rest[k] != self._rest[k - 1]).any():
            cause = event or self._event_at(k - 1)
            return cause.kind if cause else "jump"
        step = abs(self._light[k] / self._light[k - 1] - 1) > 0.01
        return "light comes back" if step else ""

    def _other_pose(self, k: int, event: Event) -> NDArray[np.float64]:
        """Pose that the upper part of a torn frame shows."""
        if event.kind == "torn by vibration":
            return self.poses[k - 1]
        stays = (self._rest[event.start] != self._rest[event.start - 1]).any()
        if stays and k == event.start:
            return self.poses[k - 1]
        sign = -1 if stays else 1
        return self.poses[k] + sign * self._tear(event)

    def _roll(self, event: Event) -> tuple[int, int]:
        """Rows and columns by which an image begins too late."""
        rng = np.random.default_rng([self.seed, _EVENT, event.start])
        height, width = self.system.shape
        size = [int(np.exp(rng.uniform(0, np.log(side / 2)))) for side in (height, width)]
        way = np.array([(1, 0), (0, 1), (1, 1)])[rng.integers(3)] * rng.choice([-1, 1], 2)
        return int(size[0] * way[0]), int(size[1] * way[1])

    def _rolled_poses(self, k: int, roll: tuple[int, int]) -> NDArray[np.float64]:
        """Poses of the pieces of a rolled image, which continues at the opposite side."""
        shape, pitch = self.system.shape, self.system.pitch_um
        rows, columns = (
            {step, step - int(np.sign(step)) * side} for step, side in zip(roll, shape, strict=True)
        )
        projection = Projection.from_pose(*self.poses[k], ORIENTATION)
        shifts = np.array([(c, r) for r in rows for c in columns]) * -pitch
        x, y = projection.to_mask(shifts[:, 0], shifts[:, 1])
        rest = np.broadcast_to(self.poses[k, 2:], (len(x), 2))
        return np.column_stack([x, y, rest])

    def frame(self, k: int) -> NDArray[Any] | None:
        """Frame k as it comes off the sensor; None if there is none."""
        event = self._event_at(k)
        rng = np.random.default_rng([self.seed, _CONTENT, k])
        kind = event.kind if event else ""
        if kind == "no image":
            return None
        levels = self._levels(k, self.poses[k])
        if event is not None:
            # one event, one hand: what stays the same from frame to frame is drawn alike
            own = np.random.default_rng([self.seed, _EVENT, event.start])
            phase = (k - event.start + 0.5) / event.length
            if kind in PARTS:
                levels = PARTS[kind](levels, own, phase)
            elif kind in BLANKS:
                levels = BLANKS[kind](levels, own if kind != "noise" else rng, phase)
            elif kind in _TORN:
                row = int(rng.integers(1, levels.shape[0]))
                levels[:row] = self._levels(k, self._other_pose(k, event))[:row]
            elif kind == "rolled":
                levels = np.roll(levels, self._roll(event), (0, 1))
        frame = self._read_out(levels, rng)
        if kind == "wrong size":
            assert event is not None
            return (frame[:, :-1], frame[::2, ::2], frame.T, frame[:0])[event.start % 4]
        return frame

    def _levels(self, k: int, pose: NDArray[np.float64]) -> Levels:
        """Expected grey levels at a pose near a base, in the light of frame k."""
        base = pose - self.poses[k] + self._rest[k]
        base[:2] += self._drift(self.times_s[self._base_at[k], None])[0]
        base = base.round(9)  # so that rounding errors do not make it another one
        level, by_x, by_y = self._base(*base)
        dx, dy = (pose - base)[:2].astype(np.float32)
        levels = dx * by_x
        levels += dy * by_y
        levels += level
        levels *= self._light[k]
        if self._dust[k] >= 0:
            levels *= _cached_dust(self.system.shape, self.seed, int(self._dust[k]))
        return levels

    def _render(self, x: float, y: float, scale: float, theta: float) -> Levels:
        """Level and its derivatives by x and y (grey per um), shape (3, H, W)."""
        system = self.system
        projection = Projection.from_pose(x, y, scale, theta, ORIENTATION)
        sensor = system.sensor
        appearance = Appearance.uniform(
            sensor.dark_level, sensor.light_level, system.optics.blur_um
        )
        camera = Camera(system.shape, system.pitch_um)
        planes = expected_signals(system.mask, projection, appearance, camera, (LEVEL, 0, 1))
        planes[1:] /= system.mask.field_um
        chance = np.random.default_rng([self.seed, _BASE, int(abs(x * 1e3)) % 2**31])
        if chance.random() < self._exact:
            planes[0] = exact_image(system, projection)
        return planes

    def _read_out(self, levels: Levels, rng: np.random.Generator) -> NDArray[Any]:
        """Noise of the sensor's law, range and rounding."""
        assert self.system.noise_law is not None
        electronic, shot = (np.float32(value) for value in self.system.noise_law)
        (height, width), (rows, columns) = levels.shape, self._pool.shape
        r, c = int(rng.integers(rows - height)), int(rng.integers(columns - width))
        noise = self._pool[r : r + height, c : c + width]
        noise = noise[:: int(rng.choice([-1, 1])), :: int(rng.choice([-1, 1]))]
        sigma = np.maximum(levels, 0)
        sigma *= shot
        sigma += electronic
        np.sqrt(sigma, out=sigma)
        sigma *= noise
        levels = levels + sigma if rng.random() < 0.5 else levels - sigma
        return quantise_levels(levels, self.system)


@lru_cache(maxsize=2)
def _cached_dust(shape: tuple[int, int], seed: int, k: int) -> Levels:
    return dust_map(shape, np.random.default_rng([seed, _FIXED, k]))


def _inward(rest: NDArray[np.float64], move: NDArray[np.float64]) -> NDArray[np.float64]:
    """A displacement turned round where it would leave the middle of the mask."""
    low, high = _WANDER_UM
    beyond = (rest[:2] + move < low) | (rest[:2] + move > high)
    return np.where(beyond, -move, move)
