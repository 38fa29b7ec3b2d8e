"""Following a mask from frame to frame, at camera rate and at the bound.

Most frames lie near a reference and take one pass over their pixels (`Reference.read`). A
frame that the reference does not explain is looked at again, with more and more effort: with a
new reference where the mask seems to have gone, with a full fit from the last pose, from
nothing. Every frame's flags say what was done and why; no position is reported that did
not explain its frame, code included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import count, islice
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.analyse import analyse
from rasnik.analysis.flags import Flag
from rasnik.analysis.frame import Bounds, Frame, prepare_frame, resolve_instrument
from rasnik.analysis.parameters import POSE_SIZE, Model, State
from rasnik.analysis.pose import Pose
from rasnik.instrument import System
from rasnik.tracking.arrival import Arrivals
from rasnik.tracking.linearisation import linearise
from rasnik.tracking.motion import Motion
from rasnik.tracking.reference import (
    LIGHT_USABLE,
    NEAR,
    USABLE,
    Reading,
    Reference,
    approach,
    model_of,
)
from rasnik.tracking.renewal import Renewal
from rasnik.tracking.track import POSE_COLUMNS, TRACK_COLUMNS, Track

__all__ = ["Tracker"]

Image = NDArray[Any]

_NO_OTHER = 20  # times the range of a reference: guesses so close lead to the same place
_PATIENCE = 3  # frames with something in the way before that is taken as lasting
_MORE_MASKED = 5e-4
_ASKED_AFTER = 32  # frames until such things are reconsidered for the first time
_PASSING = (  # what a frame may have called for that later ones do not
    Flag.AFFINE
    | Flag.PROJECTIVE
    | Flag.PROFILE_REFINED
    | Flag.MODEL_MISFIT
    | Flag.HEAVILY_MASKED
    | Flag.SATURATED
)
_MOST_AT_ONCE = 64  # frames
_AS_STORED = tuple(np.dtype(name) for name in ("uint8", "uint16", "float32"))


class Tracker:
    """Follow a mask from frame to frame.

    Parameters
    ----------
    system, field_um, pixel_um, model, orientation, bounds
        As for `rasnik.analyse`.
    prior : Pose, optional
        Where to begin, from an earlier track of the same mask.
    threads : int, optional
        Number of frames worked on at a time by `run` and `blocks`.

    Examples
    --------
    >>> import rasnik
    >>> poses = [(4000.0 + 0.01 * k, 5000.0, 0.002) for k in range(5)]
    >>> frames = rasnik.simulate("solidras", poses, seed=1).frames
    >>> track = rasnik.Tracker("solidras").run(frames)
    >>> track.ok.all(), float((track.x_um[-1] - track.x_um[0]).round(2))
    (np.True_, 0.04)
    """

    def __init__(
        self,
        system: System | str | None = None,
        *,
        field_um: float | None = None,
        pixel_um: float | None = None,
        model: Model | Literal["auto"] = "auto",
        orientation: int | None = None,
        bounds: Bounds | None = None,
        prior: Pose | None = None,
        threads: int = 1,
    ) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, not {threads!r}")
        self._mask, self._pitch_um, self.system = resolve_instrument(system, field_um, pixel_um)
        self._options: dict[str, Any] = {
            "system": self.system, "field_um": field_um, "pixel_um": pixel_um,
            "model": model, "orientation": orientation, "bounds": bounds,
        }  # fmt: skip
        self._threads = threads
        self._shape = None if self.system is None else self.system.shape
        self._prior = prior
        self._reference: Reference | None = None
        self._last: tuple[Reference, Reading] | None = None  # that fitted
        self._renewal = Renewal()
        self._motion = Motion()
        self._ask_after, self._ask_at = _ASKED_AFTER, 0.0  # frames, whether less would do
        self._odd = 0  # frames in a row that a fit explained less well
        self._at_once = _MOST_AT_ONCE
        self._arrivals = Arrivals()
        #: Number of references made so far.
        self.references = 0

    # ----------------------------------------------------------------- what callers use

    def update(
        self, frame: Image | None, t: float | None = None, number: int | None = None
    ) -> Pose:
        """The pose in the next frame of a stream.

        New references are made a little with every frame, so that none of them waits.

        Parameters
        ----------
        frame : ndarray, shape (H, W), or None
            Grey levels; None for a frame that could not be read.
        t : float, optional
            Its time, in seconds.
        number : int, optional
            Its number; frames that were lost leave numbers out.

        Returns
        -------
        Pose
            With the flags of tracking: what was done and why.
        """
        arrival = self._arrivals.add(t, number)
        grey = self._usable_frame(frame)
        if grey is None:
            return Pose(flags=Flag.NO_IMAGE | arrival)
        reference = self._reference
        if reference is None:
            return self._recover(grey, None, arrival)
        (reading,) = reference.read([grey])
        if not reference.fits(reading):
            return self._recover(grey, reading, arrival)
        self._accept(reference, reading, self._arrivals.clock)
        self._change_to(self._renewal.in_parts(reference, reading, self._arrivals))
        self._reconsider(grey)
        return reference.pose(reading, arrival)

    def blocks(
        self,
        frames: Iterable[Image | None],
        times: Iterable[float] | None = None,
        numbers: Iterable[int] | None = None,
        size: int = 256,
    ) -> Iterator[Track]:
        """Track a sequence of any length, piece by piece, in bounded memory.

        Parameters
        ----------
        frames : iterable of ndarray, shape (H, W), or None
            Grey levels; None for frames that could not be read.
        times : iterable of float, optional
            Their times, in seconds. By default they follow from their numbers and the
            system's frame rate, if it has one.
        numbers : iterable of int, optional
            Their numbers, 0, 1, 2, ... by default; frames that were lost leave numbers out.
        size : int, optional
            Frames in a piece.

        Yields
        ------
        Track
            The next `size` frames; the last piece may be shorter.
        """
        source = iter(frames)
        ordinals: Iterator[int] = count() if numbers is None else iter(numbers)
        clock: Iterator[float] | None = None if times is None else iter(times)
        with ThreadPoolExecutor(self._threads) as pool:
            mapping = map if self._threads == 1 else pool.map
            while chunk := list(islice(source, size)):
                number = np.fromiter(islice(ordinals, len(chunk)), dtype=np.int64)
                if clock is not None:
                    time = np.fromiter(islice(clock, len(chunk)), dtype=np.float64)
                else:
                    time = self._nominal_times(number)
                if len(number) < len(chunk) or len(time) < len(chunk):
                    raise ValueError("there are fewer times or numbers than frames")
                yield self._track(chunk, time, number, mapping)

    def run(
        self,
        frames: Iterable[Image | None],
        times: Iterable[float] | None = None,
        numbers: Iterable[int] | None = None,
        progress: Callable[[int], object] | None = None,
    ) -> Track:
        """Track all frames of a sequence.

        Parameters
        ----------
        frames, times, numbers
            As for `blocks`.
        progress : callable, optional
            Called with the number of frames done since the last call.
        """
        pieces = []
        for piece in self.blocks(frames, times, numbers):
            pieces.append(piece)
            if progress is not None:
                progress(len(piece))
        return Track.concatenate(pieces)

    # ----------------------------------------------------------------- frames that fit

    def _track(
        self,
        frames: list[Image | None],
        time_s: NDArray[np.float64],
        number: NDArray[np.int64],
        mapping: Any,
    ) -> Track:
        """Track a list of frames, many at once as long as they fit."""
        columns: dict[str, Any] = {c.name: np.full(len(frames), np.nan) for c in TRACK_COLUMNS}
        columns.update(frame=number, time_s=time_s, flags=np.zeros(len(frames), dtype=np.uint32))
        done = 0
        while done < len(frames):
            batch = self._batch(frames[done : done + self._at_once])
            n = self._track_batch(batch, slice(done, done + len(batch)), columns, mapping)
            if n == 0:  # the next frame needs more than one look
                pose = self.update(frames[done], time_s[done], number[done])
                for name in POSE_COLUMNS:
                    columns[name][done] = getattr(pose, name)
                columns["flags"][done] = pose.flags
                n = 1
            whole = n == len(batch)
            self._at_once = min(2 * self._at_once, _MOST_AT_ONCE) if whole else n
            done += n
        return Track(**columns)

    def _batch(self, frames: list[Image | None]) -> list[Image]:
        """The next frames, as far as they can be tracked at all."""
        batch: list[Image] = []
        for frame in frames:
            grey = self._usable_frame(frame)
            if grey is None or self._reference is None:
                break
            batch.append(grey)
        return batch

    def _track_batch(
        self, batch: list[Image], rows: slice, columns: dict[str, Any], mapping: Any
    ) -> int:
        """Fill in the rows of the frames up to the first that does not fit; how many there are."""
        reference = self._reference
        if reference is None or not batch:
            return 0
        readings: list[Reading] = []
        for reading in reference.read(batch, mapping):
            if not reference.fits(reading):
                break
            k = rows.start + len(readings)
            arrival = self._arrivals.add(columns["time_s"][k], columns["frame"][k])
            columns["flags"][k] = int(reference.flags | arrival)
            self._accept(reference, reading, self._arrivals.clock)
            readings.append(reading)
            if not reference.near(reading):  # the next ones get a new reference
                break
        n = len(readings)
        if n == 0:
            return 0
        for name, values in reference.columns(readings).items():
            columns[name][rows.start : rows.start + n] = values
        if not reference.near(readings[-1]):
            self._change_to(self._renewal.at_once(reference, readings[-1], self._arrivals.clock))
        self._reconsider(batch[n - 1])
        return n

    def _accept(self, reference: Reference, reading: Reading, clock: float) -> None:
        """Learn from a frame that fits."""
        reference.learn(reading)
        if reference.begun is None:
            reference.begun = clock, reading.step[:4]
        self._motion.add(clock, reference.vector + reading.step[:4])
        self._last = reference, reading
        self._odd = 0

    def _change_to(self, reference: Reference | None) -> None:
        if reference is not None:
            self._reference = reference
            self.references += 1

    def _reconsider(self, grey: Image) -> None:
        """Whether a full fit would find less amiss now, asked more and more seldom.

        A frame that was not a clean view of one mask may have called for more freedom, or for
        more pixels to be left out, than is needed later.
        """
        reference = self._reference
        if (
            reference is None
            or not reference.flags & _PASSING
            or self._ask_at > self._arrivals.clock
        ):
            return
        self._ask_after *= 2
        self._ask_at = self._arrivals.clock + self._ask_after
        pose = analyse(grey, prior=self._expected(), **self._options)
        given_up = (reference.flags & _PASSING) & ~pose.flags
        if pose.ok and given_up and not pose.flags & Flag.PRIOR_REJECTED:
            self._begin(grey, pose)

    # ----------------------------------------------------------------- frames that do not fit

    def _recover(self, grey: Image, reading: Reading | None, arrival: Flag) -> Pose:
        """First a new reference where the mask seems to be, then a full fit."""
        self._renewal.stop()
        reference = self._reference
        if reference is None or reading is None:
            return self._fit(grey, arrival, self._prior)
        if not reference.usable(reading):
            frame = self._prepared(grey)
            for state in self._guesses():
                found = self._relocate(reference, grey, frame, state)
                if found is not None:
                    self._reference, close = found
                    self._accept(self._reference, close, self._arrivals.clock)
                    flags = Flag.REFITTED | arrival | _changes(reference, reading)
                    return self._reference.pose(close, flags)
        return self._fit(grey, arrival, self._expected())

    def _guesses(self) -> Iterator[State]:
        """Where the mask may be: as extrapolated, and where it was."""
        if self._last is None:
            return
        reference, reading = self._last
        step = reading.step.copy()
        predicted = self._motion.predict(self._arrivals.clock)
        if predicted is not None:
            ahead = step.copy()
            ahead[:4] = predicted - reference.vector
            yield reference.linear.stepped(ahead)
            if _distance(ahead - step) < _NO_OTHER * reference.near_um:
                return
        yield reference.linear.stepped(step)

    def _relocate(
        self, reference: Reference, grey: Image, frame: Frame, state: State
    ) -> tuple[Reference, Reading] | None:
        """A reference that explains the frame, begun from a guess; None if there is none."""
        settings = reference.linear.settings
        near = approach(frame, settings, state)
        if near is None:
            return None
        try:
            moved = reference.moved_to(linearise(settings, near))
        except ValueError:
            return None
        self.references += 1
        (reading,) = moved.read([grey])
        return (moved, reading) if moved.fits(reading) else None

    def _expected(self) -> Pose | None:
        """The last pose that was tracked, moved to where the mask should be now."""
        if self._last is None:
            return None
        pose = self._last[0].pose(self._last[1])
        state = next(self._guesses())
        return replace(pose, projection=state.projection)

    def _fit(self, grey: Image, arrival: Flag, prior: Pose | None) -> Pose:
        """A full fit, from a pose nearby or from nothing."""
        pose = analyse(grey, prior=prior, **self._options)
        if pose.flags & Flag.SETTLED_BY_PRIOR:  # the mask may have moved by many fields
            return Pose(flags=(pose.flags & ~Flag.SETTLED_BY_PRIOR) | Flag.AMBIGUOUS | arrival)
        cold = prior is None or bool(pose.flags & Flag.PRIOR_REJECTED)
        flags = (pose.flags & ~Flag.PRIOR_REJECTED) | arrival
        if not pose.ok:
            return replace(pose, flags=flags)
        flags |= Flag.COLD_START if cold else Flag.REFITTED
        reference = self._reference
        if reference is not None:
            changes = _changes_of(reference, pose)
            flags |= changes
            if not changes or _is_odd(reference, pose):  # a frame near the reference would fit it
                flags |= Flag.OBSTRUCTED
            if flags & Flag.OBSTRUCTED:
                self._odd += 1
                if self._odd <= _PATIENCE:
                    return replace(pose, flags=flags)
        self._begin(grey, pose)
        return replace(pose, flags=flags)

    def _begin(self, grey: Image, pose: Pose) -> None:
        """Track from a full fit on, if a linearisation about it finds the same."""
        free = self._options["model"] == "auto"
        try:
            reference = Reference.from_fit(self._prepared(grey), pose, free)
        except ValueError:  # a pose at the edge of what can be modelled
            return
        (reading,) = reference.read([grey])
        reference.expect(reading)
        self.references += 1
        if not reference.usable(reading):
            return
        self._reference, self._last = reference, (reference, reading)
        self._odd = 0
        self._ask_after, self._ask_at = _ASKED_AFTER, self._arrivals.clock + _ASKED_AFTER
        self._motion.add(self._arrivals.clock, reference.vector)

    def _prepared(self, grey: Image) -> Frame:
        bounds = self._options["bounds"]
        return prepare_frame(grey, self._mask, self._pitch_um, self.system, bounds)[0]

    def _usable_frame(self, frame: Image | None) -> Image | None:
        """The frame as the kernels take it; None if it is not an image of the right size."""
        if frame is None:
            return None
        array = np.asarray(frame)
        if self._shape is None and array.ndim == 2:
            self._shape = array.shape
        if array.shape != self._shape or array.dtype.kind not in "uif":
            return None
        if array.dtype not in _AS_STORED:
            fits = array.dtype.kind in "iu" and array.min() >= 0 and array.max() < 2**16
            array = array.astype(np.uint16 if fits else np.float32)
        if array.dtype.kind == "f" and not np.isfinite(array.sum()):
            array = np.nan_to_num(array, nan=0.0, posinf=0.0, neginf=0.0)
        return np.ascontiguousarray(array)

    def _nominal_times(self, number: NDArray[np.int64]) -> NDArray[np.float64]:
        rate = None if self.system is None else self.system.sensor.frame_rate_hz
        return number / rate if rate else np.full(len(number), np.nan)


def _distance(step: NDArray[np.float64]) -> float:
    """Motion on the mask that a change of the pose makes, at the centre."""
    return float(np.hypot(step[0], step[1]))


def _changes(reference: Reference, reading: Reading) -> Flag:
    """Why a frame was out of a reference's range."""
    flags = Flag.LIGHT_CHANGED if reference.light_changed(reading) else Flag.NONE
    return flags | (Flag.MOVED if not reference.motion(reading) < USABLE else Flag.NONE)


def _changes_of(reference: Reference, pose: Pose) -> Flag:
    """The same from a full fit."""
    flags = Flag.NONE
    x, y = reference.vector[:2]
    if np.hypot(pose.x_um - x, pose.y_um - y) > USABLE / NEAR * reference.near_um:
        flags |= Flag.MOVED
    light = reference.linear.state.appearance
    ratio = (pose.light_level - pose.dark_level) / (light.light[0] - light.dark[0])
    if not abs(ratio - 1) < LIGHT_USABLE:
        flags |= Flag.LIGHT_CHANGED
    return flags


def _is_odd(reference: Reference, pose: Pose) -> bool:
    """Whether a fit needed more freedom, or left out or unexplained more, than those before."""
    settings = reference.linear.settings
    masked = 1 - reference.linear.n_pixels / settings.valid.size
    return bool(
        pose.masked_fraction > masked + _MORE_MASKED
        or POSE_SIZE[model_of(pose)] > POSE_SIZE[settings.model]
        or pose.chi2_ndf > 1.05 * max(1.0, reference.chi2_ratio)
    )
