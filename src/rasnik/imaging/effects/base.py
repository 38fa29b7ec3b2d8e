"""What an effect is: a few hooks along the way from the mask to the grey levels.

An effect is a frozen dataclass whose first field is its main parameter. It overrides the hooks
of the stages it acts in; the order of the hooks is the order in which light and charge meet
them, whatever the order in which effects are named.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rasnik.imaging.deviations import Deviations
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.instrument import System

__all__ = [
    "EFFECTS",
    "STAGES",
    "Context",
    "Effect",
    "Image",
    "Info",
    "check_range",
    "effect",
    "effects_markdown",
]

Image = NDArray[np.float64]

#: Stages in the order in which an image passes them.
STAGES = ("mask", "air", "optics", "light", "geometry", "response", "noise", "read-out")

#: Rate at which frames follow each other where the system does not state its own.
DEFAULT_RATE_HZ = 1.0

# Key of the random streams of effects; those of positions and noise are 0 and 1.
_EFFECTS = 2


@dataclass(frozen=True, eq=False)
class Context:
    """What an effect may know of the simulation it is in.

    Attributes
    ----------
    system : System
        As given, before any effect.
    seed : int
    frames : int
        Length of the sequence.
    cache : dict
        For an effect to keep what is costly to make again.
    """

    system: System
    seed: int
    frames: int = 1
    cache: dict[Any, Any] = field(default_factory=dict, repr=False)

    @property
    def rate_hz(self) -> float:
        return self.system.sensor.frame_rate_hz or DEFAULT_RATE_HZ

    @property
    def shape(self) -> tuple[int, int]:
        return self.system.shape

    def rng(self, name: str, *index: int) -> np.random.Generator:
        """The random stream of one purpose: the same at every call."""
        key = (_EFFECTS, zlib.crc32(name.encode()), *index)
        return np.random.Generator(
            np.random.SFC64(np.random.SeedSequence(self.seed, spawn_key=key))
        )

    def points(self, change: Deviations) -> tuple[Image, Image]:
        """The sensor points that pixels see so far, each of shape (H, W)."""
        if change.points_um is not None:
            return change.points_um
        u, v = np.meshgrid(*sensor_grid_um(self.shape, self.system.pitch_um))
        return u, v


class Effect:
    """Base of all effects; every hook does nothing by default."""

    info: ClassVar[Info]

    @property
    def parameters(self) -> dict[str, Any]:
        """Its parameters by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]

    def system(self, system: System) -> System:
        """The instrument with another sensor or other light."""
        return system

    def projection(self, projection: Projection, context: Context) -> Projection:
        """The pose that the image really shows."""
        return projection

    def shifts_um(self, context: Context) -> Image | None:
        """Displacement (x, y) on the mask of what each frame shows, shape (frames, 2)."""
        return None

    def shift_factor(self) -> float:
        """Factor on the steady displacement made by other effects."""
        return 1.0

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        """The optical deviations, with those of this effect."""
        return change

    def respond(self, levels: Image, context: Context) -> Image:
        """The expected levels after what is constant in the sensor's response."""
        return levels

    def gain(self, k: int, context: Context) -> NDArray[np.floating[Any]] | None:
        """Factor on the expected levels of frame k, shape (H, W)."""
        return None

    def read_out(self, levels: Image, context: Context) -> Image:
        """Levels with noise, before they are rounded and limited; may be changed in place."""
        return levels


@dataclass(frozen=True)
class Info:
    """One line of the table of effects.

    Attributes
    ----------
    name : str
    summary : str
        What it does.
    parameter, unit : str
        The main parameter.
    default : float or None
        Its value where none is given; None: the system's.
    stage : str
    reference : str
    make : type
        The dataclass of the effect.
    always_on : bool
        Whether it is on unless switched off.
    options : tuple of (name, default)
        Further parameters.
    """

    name: str
    summary: str
    parameter: str
    unit: str
    default: float | None
    stage: str
    reference: str
    make: Callable[..., Effect]
    always_on: bool = False
    options: tuple[tuple[str, Any], ...] = ()


#: Every effect by name, in the order in which an image meets them.
EFFECTS: dict[str, Info] = {}


def effect(
    name: str,
    summary: str,
    *,
    unit: str,
    stage: str,
    reference: str,
    always_on: bool = False,
) -> Callable[[type[Any]], type[Any]]:
    """Enter a dataclass into the table of effects."""

    def enter(cls: type[Any]) -> type[Any]:
        main, *rest = fields(cls)
        if stage not in STAGES:
            raise ValueError(f"effect {name}: no stage {stage!r}")
        cls.info = EFFECTS[name] = Info(
            name,
            summary,
            main.name,
            unit,
            None if main.default is MISSING else main.default,
            stage,
            reference,
            cls,
            always_on,
            tuple((f.name, f.default) for f in rest),
        )
        return cls

    return enter


def check_range(name: str, value: float, low: float, high: float = np.inf) -> None:
    """Refuse a parameter outside [low, high] with a sentence."""
    if not (np.isfinite(value) and low <= value <= high):
        limits = f"at least {low:g}" if high == np.inf else f"between {low:g} and {high:g}"
        raise ValueError(f"effect {name} must be {limits}, not {value:g}")


def effects_markdown() -> str:
    """The table of effects for the documentation."""
    lines = [
        "| stage | effect | what it does | parameter | default | unit | more | reference |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for info in EFFECTS.values():
        name = f"`{info.name}`" + (" (on)" if info.always_on else "")
        default = "system's" if info.default is None else f"{info.default:g}"
        more = ", ".join(
            f"`{key}` = {'system' if value is None else value}" for key, value in info.options
        )
        lines.append(
            f"| {info.stage} | {name} | {info.summary} | `{info.parameter}` | {default} | "
            f"{info.unit or '1'} | {more} | {info.reference} |"
        )
    return "\n".join(lines) + "\n"
