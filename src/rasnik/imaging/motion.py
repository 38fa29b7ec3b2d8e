"""How a pose moves in time: drift, sine, seismic noise, steps, or a table; any of them added up.

A motion is a displacement (x, y) on the mask and a turn, as a function of the time since the
first frame. Each is a frozen dataclass; `make_motions` also makes them from text.
"""

from __future__ import annotations

import csv
import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "MOTIONS",
    "Drift",
    "Motion",
    "Seismic",
    "Sine",
    "Steps",
    "Table",
    "displacements",
    "make_motions",
]

Array = NDArray[np.float64]


@runtime_checkable
class Motion(Protocol):
    """A displacement as a function of time."""

    summary: ClassVar[str]

    def at(self, t_s: Array, rng: np.random.Generator) -> Array:
        """(x_um, y_um, theta_rad) at the times of the frames, shape (n, 3)."""
        ...


@dataclass(frozen=True)
class Drift:
    """Constant velocity."""

    summary: ClassVar[str] = "constant velocity"
    x_um_per_s: float = 0.0
    y_um_per_s: float = 0.0
    theta_rad_per_s: float = 0.0

    def at(self, t_s: Array, rng: np.random.Generator) -> Array:
        return np.outer(t_s, [self.x_um_per_s, self.y_um_per_s, self.theta_rad_per_s])


@dataclass(frozen=True)
class Sine:
    """``amplitude sin(2 pi hz t + phase)``."""

    summary: ClassVar[str] = "a sine of the given amplitudes"
    hz: float = 1.0
    x_um: float = 0.0
    y_um: float = 0.0
    theta_rad: float = 0.0
    phase_rad: float = 0.0

    def at(self, t_s: Array, rng: np.random.Generator) -> Array:
        wave = np.sin(2 * np.pi * self.hz * t_s + self.phase_rad)
        return np.outer(wave, [self.x_um, self.y_um, self.theta_rad])


@dataclass(frozen=True)
class Seismic:
    """Gaussian noise like the motion of the ground, the same and independent in x and y.

    One-sided amplitude spectral density ``asd / (1 + (f / corner)^2)``: flat below the corner,
    falling as 1/f^2 above it. Frequencies below one over twice the length of the sequence are
    left out.
    """

    summary: ClassVar[str] = "noise, flat up to a corner, then falling as 1/f^2"
    asd_um_rthz: float = 0.01
    corner_hz: float = 1.0

    def __post_init__(self) -> None:
        if self.asd_um_rthz < 0 or self.corner_hz <= 0:
            raise ValueError("seismic: asd_um_rthz must not be negative, corner_hz positive")

    def at(self, t_s: Array, rng: np.random.Generator) -> Array:
        out = np.zeros((t_s.size, 3))
        if t_s.size < 2:
            return out
        rate_hz, length = 1 / (t_s[1] - t_s[0]), 2 * t_s.size
        f = np.fft.rfftfreq(length, 1 / rate_hz)
        asd = self.asd_um_rthz / (1 + (f / self.corner_hz) ** 2)
        asd[0] = 0
        # Each of the two quadratures of a line holds half of the power asd^2 rate / length.
        sigma = asd * np.sqrt(rate_hz * length) / 2
        for axis in (0, 1):
            real, imaginary = rng.standard_normal((2, f.size))
            out[:, axis] = np.fft.irfft(sigma * (real + 1j * imaginary), length)[: t_s.size]
        return out


@dataclass(frozen=True)
class Steps:
    """A step of this size every `every_s` seconds."""

    summary: ClassVar[str] = "a step of this size at regular times"
    every_s: float = 1.0
    x_um: float = 0.0
    y_um: float = 0.0
    theta_rad: float = 0.0

    def __post_init__(self) -> None:
        if not self.every_s > 0:
            raise ValueError(f"steps: every_s must be positive, not {self.every_s:g}")

    def at(self, t_s: Array, rng: np.random.Generator) -> Array:
        # The times of frames are rounded: a frame at the step belongs after it.
        count = np.floor(t_s / self.every_s + 1e-9)
        return np.outer(count, [self.x_um, self.y_um, self.theta_rad])


@dataclass(frozen=True, eq=False)
class Table:
    """Displacements at given times, linear in between.

    Attributes
    ----------
    t_s : array_like, shape (m,)
        Rising.
    x_um, y_um, theta_rad : array_like, shape (m,), optional
    """

    summary: ClassVar[str] = "displacements from a CSV file: t_s, x_um, y_um, theta_rad"
    t_s: Sequence[float] | Array
    x_um: Sequence[float] | Array | float = 0.0
    y_um: Sequence[float] | Array | float = 0.0
    theta_rad: Sequence[float] | Array | float = 0.0

    def __post_init__(self) -> None:
        t = np.asarray(self.t_s, dtype=np.float64)
        if t.ndim != 1 or t.size < 1 or not (np.diff(t) > 0).all():
            raise ValueError("table: the times t_s must be one rising column")
        for name in ("x_um", "y_um", "theta_rad"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.ndim and value.shape != t.shape:
                raise ValueError(
                    f"table: {name} has {value.size} values, but there are {t.size} times"
                )
            if not np.isfinite(value).all():
                raise ValueError(f"table: {name} holds values that are not finite")

    @classmethod
    def read(cls, path: Path | str) -> Table:
        """A CSV file whose first line names the columns.

        Raises
        ------
        ValueError
            If the file cannot be read, or a column is missing, unknown or not of numbers.
        """
        try:
            with open(path, newline="", encoding="utf-8-sig") as file:
                rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"the table {path} cannot be read: {error}") from None
        names = [name.strip() for name in rows[0]] if rows else []
        known = [f.name for f in fields(cls)]
        if "t_s" not in names or not set(names) <= set(known):
            raise ValueError(
                f"the table {path} must name its columns in the first line: t_s and some of "
                f"{', '.join(known[1:])}; it has {', '.join(names) or 'none'}"
            )
        try:
            values = np.array([[float(cell) for cell in row] for row in rows[1:]])
            columns = dict(zip(names, values.T, strict=True))
        except ValueError:
            raise ValueError(f"the table {path} holds something that is not a number") from None
        return cls(**columns)

    def at(self, t_s: Array, rng: np.random.Generator) -> Array:
        t = np.asarray(self.t_s, dtype=np.float64)
        if t_s[0] < t[0] - 1e-9 or t_s[-1] > t[-1] + 1e-9:
            raise ValueError(
                f"the table covers {t[0]:g}..{t[-1]:g} s, but the frames {t_s[0]:g}..{t_s[-1]:g} s"
            )
        columns = (np.asarray(getattr(self, n), float) for n in ("x_um", "y_um", "theta_rad"))
        return np.stack([np.interp(t_s, t, np.broadcast_to(c, t.shape)) for c in columns], axis=1)


#: Motions by the name they have in text.
MOTIONS: dict[str, type[Any]] = {
    "drift": Drift,
    "sine": Sine,
    "seismic": Seismic,
    "steps": Steps,
    "table": Table,
}


def make_motions(motion: Any) -> tuple[Motion, ...]:
    """Motions from objects or from text.

    Parameters
    ----------
    motion : Motion, str, or iterable of them
        As text ``name:parameter=value,...``, e.g. ``drift:x_um_per_s=0.1``, or ``table:FILE``.

    Raises
    ------
    ValueError
        If a name or parameter is unknown (near names are offered) or a value impossible.
    TypeError
        If it is no motion.
    """
    if isinstance(motion, str | Motion):
        motion = [motion]
    if not isinstance(motion, Iterable):
        raise TypeError(f"{motion!r} is not a motion: they are {', '.join(MOTIONS)}")
    made = tuple(_from_text(m) if isinstance(m, str) else m for m in motion)
    for one in made:
        if not isinstance(one, Motion):
            raise TypeError(f"{one!r} is not a motion: they are {', '.join(MOTIONS)}")
    return made


def _from_text(text: str) -> Motion:
    name, _, rest = text.partition(":")
    kind = MOTIONS.get(name.strip())
    if kind is None:
        near = difflib.get_close_matches(name, MOTIONS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"they are {', '.join(MOTIONS)}"
        raise ValueError(f"there is no motion {name!r}; {hint}")
    if kind is Table:
        return Table.read(rest)
    known = [f.name for f in fields(kind)]
    settings: dict[str, float] = {}
    for part in filter(None, rest.split(",")):
        key, _, number = (piece.strip() for piece in part.partition("="))
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ValueError(f"{name} has no parameter {key!r}, but {', '.join(known)}{hint}")
        try:
            settings[key] = float(number)
        except ValueError:
            raise ValueError(f"{name}: {key} must be a number, not {number!r}") from None
        if not np.isfinite(settings[key]):
            raise ValueError(f"{name}: {key} must be finite, not {number}")
    made: Motion = kind(**settings)
    return made


def displacements(
    motions: Iterable[Motion], n: int, rate_hz: float, rng: np.random.Generator
) -> Array:
    """Sum of all motions at n frames, shape (n, 3): x_um, y_um, theta_rad."""
    t_s = np.arange(n) / rate_hz
    return np.sum([np.zeros((n, 3)), *(motion.at(t_s, rng) for motion in motions)], axis=0)
