"""Effects chosen by name, and all of them together in the right order."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.imaging.deviations import Deviations
from rasnik.imaging.effects._matrix import shifted
from rasnik.imaging.effects.base import EFFECTS, STAGES, Context, Effect, Image
from rasnik.imaging.effects.readout import Rounding, Saturation
from rasnik.imaging.noise import frame_dtype, quantise_levels
from rasnik.imaging.projection import Projection
from rasnik.instrument import System

__all__ = ["Chain", "make_effect", "make_effects"]


def make_effects(effects: Any) -> tuple[Effect, ...]:
    """Effects from names and values.

    Parameters
    ----------
    effects : None, str, Effect, mapping, or iterable of str or Effect
        A mapping gives the main parameter of each name, a mapping of several parameters,
        True for the default or False for none of it. A string is ``name``, ``name=value`` or
        ``name=value,parameter=value``.

    Returns
    -------
    tuple of Effect

    Raises
    ------
    ValueError
        If a name or parameter is unknown (near names are offered), a value impossible, or an
        effect named twice.
    TypeError
        If a value is of a wrong type.
    """
    if effects is None:
        return ()
    if isinstance(effects, str | Effect):
        effects = [effects]
    if isinstance(effects, Mapping):
        made = [make_effect(*item) for item in effects.items() if not _left_out(*item)]
    elif isinstance(effects, Iterable):
        made = [e if isinstance(e, Effect) else _from_text(e) for e in effects]
    else:
        raise TypeError(f"effects must be names and values, not {effects!r}")
    names = [e.info.name for e in made]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"effect {name} is given twice")
    order = list(EFFECTS)
    return tuple(sorted(made, key=lambda e: order.index(e.info.name)))


def _left_out(name: str, value: Any) -> bool:
    """Whether an effect is not wanted; those that are always on are switched off by a 0."""
    return value is False and name in EFFECTS and not EFFECTS[name].always_on


def make_effect(name: str, value: Any = True) -> Effect:
    """One effect; see `make_effects`."""
    info = EFFECTS.get(name)
    if info is None:
        near = difflib.get_close_matches(str(name), EFFECTS, n=2, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}?" if near else f"they are {', '.join(EFFECTS)}"
        raise ValueError(f"there is no effect {name!r}; {hint}")
    if value is False:
        value = 0.0
    if value is True or value is None:
        return info.make()
    settings = dict(value) if isinstance(value, Mapping) else {info.parameter: value}
    known = [f.name for f in fields(info.make)]  # type: ignore[arg-type]
    for key, number in settings.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ValueError(
                f"effect {name} has no parameter {key!r}, but {', '.join(known)}{hint}"
            )
        if not isinstance(number, Real) or isinstance(number, bool):
            raise TypeError(f"effect {name}: {key} must be a number, not {number!r}")
        if not np.isfinite(float(number)):
            raise ValueError(f"effect {name}: {key} must be finite, not {number!r}")
    return info.make(**settings)


def _from_text(text: Any) -> Effect:
    if not isinstance(text, str):
        raise TypeError(f"an effect is given by its name, not {text!r}")
    name, _, rest = text.partition("=")
    if not rest:
        return make_effect(name.strip())
    settings: dict[str, float] = {}
    for place, part in enumerate(rest.split(",")):
        key, equals, number = part.rpartition("=")
        key = key.strip()
        if not equals:
            if place or name.strip() not in EFFECTS:
                key = "" if place else name.strip()
            else:
                key = EFFECTS[name.strip()].parameter
        try:
            settings[key] = float(number)
        except ValueError:
            raise ValueError(f"effect {text!r}: {number.strip()!r} is not a number") from None
    return make_effect(name.strip(), settings)


@dataclass(frozen=True, eq=False)
class Chain:
    """The effects of one simulation, applied in the order in which light and charge meet them."""

    effects: tuple[Effect, ...]
    context: Context
    quantise: bool

    @cached_property
    def system(self) -> System:
        """The system with the noise that the effects give it."""
        system = self.context.system
        for effect in self.effects:
            system = effect.system(system)
        return system

    @cached_property
    def shifts_um(self) -> Image | None:
        """Displacement (x, y) on the mask that each frame shows, shape (frames, 2)."""
        factor = np.prod([effect.shift_factor() for effect in self.effects])
        total: Image | None = None
        for effect in self.effects:
            shift = effect.shifts_um(self.context)
            if shift is not None:
                own = 1.0 if effect.shift_factor() != 1.0 else factor
                total = own * shift + (0.0 if total is None else total)
        return total

    @cached_property
    def deviations(self) -> Deviations:
        # From the pixel back to the mask: a pixel that is out of place sees another point of
        # the distorted image.
        change = Deviations()
        for effect in sorted(self.effects, key=lambda e: -STAGES.index(e.info.stage)):
            change = effect.deviations(change, self.context)
        return change

    def projection(self, projection: Projection, k: int) -> Projection:
        """What frame k shows of a pose."""
        for effect in self.effects:
            projection = effect.projection(projection, self.context)
        if self.shifts_um is not None:
            x, y = self.shifts_um[k]
            projection = shifted(projection, float(x), float(y))
        return projection

    def respond(self, levels: Image) -> Image:
        """The constant part of the sensor's response."""
        for effect in self.effects:
            levels = effect.respond(levels, self.context)
        return levels

    def gain(self, k: int) -> NDArray[np.floating[Any]] | None:
        """Response of frame k over the constant one; None if it does not vary."""
        total: NDArray[np.floating[Any]] | None = None
        for effect in self.effects:
            own = effect.gain(k, self.context)
            if own is not None:
                total = own if total is None else total * own
        return total

    @cached_property
    def _reads_out(self) -> bool:
        return any(type(e).read_out is not Effect.read_out for e in self.effects)

    @cached_property
    def _step_top(self) -> tuple[float, float]:
        step, top = 1.0, float(self.context.system.full_scale)
        for effect in self.effects:
            if isinstance(effect, Rounding):
                step = effect.step_grey
            if isinstance(effect, Saturation) and effect.top_grey is not None:
                top = effect.top_grey
        return step, top

    @cached_property
    def ordinary(self) -> bool:
        """Whether frames are rounded and limited as the sensor does it, and nothing more."""
        whole = (1.0, float(self.context.system.full_scale))
        return self.quantise and not self._reads_out and self._step_top == whole

    @property
    def dtype(self) -> np.dtype[Any]:
        """Data type of the frames."""
        step, top = self._step_top
        whole = step >= 1 and step == int(step) and 0 < top <= self.context.system.full_scale
        if self.quantise and whole:
            return frame_dtype(self.context.system)
        return np.dtype(np.float64)

    def read_out(self, levels: Image) -> NDArray[Any]:
        """A frame from levels with noise, which may be changed in place."""
        for effect in self.effects:
            levels = effect.read_out(levels, self.context)
        if not self.quantise:
            return levels
        step, top = self._step_top
        if (step, top) == (1.0, self.context.system.full_scale):
            return quantise_levels(levels, self.context.system)
        if step > 0:
            levels = np.rint(levels / step) * step
        if top > 0:
            levels = np.clip(levels, 0, top)
        return levels.astype(self.dtype)
