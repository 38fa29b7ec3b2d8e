"""An installation: rigid bodies, and the Rasniks whose elements are mounted on them.

A TOML file with the lists ``bodies``, ``rasniks`` and ``sagittas``; those shipped in
``rasnik/installations`` are examples. Positions of elements are given in the frame of the body
that carries them, positions of bodies in that of the installation. Axes and signs of what is read
stand in ``docs/conventions.md``.
"""

from __future__ import annotations

import difflib
import tomllib
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rasnik._config import ContradictionError, SystemConfigError, read_toml, sentences
from rasnik.geometry.mounting import COINCIDENT_MM, mounting_problems, world
from rasnik.geometry.rigid import DOFS

__all__ = [
    "VALUES",
    "Accuracy",
    "Body",
    "Installation",
    "Lens",
    "Mask",
    "Prior",
    "Rasnik",
    "Sagitta",
    "SensorPlace",
    "installation_names",
    "load_installation",
]

#: The four values that a Rasnik reads.
VALUES = ("x", "y", "scale", "theta")

_Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
_Angle = Annotated[float, Field(ge=-10, le=10)]
_Point = Annotated[list[_Coordinate], Field(min_length=3, max_length=3)]
_Turn = Annotated[list[_Angle], Field(min_length=3, max_length=3)]
_Name = Annotated[str, Field(min_length=1, max_length=80)]
_Sigma = Annotated[float, Field(gt=0, le=1e9)]
_Dof = Literal["x", "y", "z", "rx", "ry", "rz"]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Prior(_Part):
    """How well the place of a body is known without any reading: standard deviations."""

    x_um: _Sigma | None = Field(default=None, description="um, along its own x")
    y_um: _Sigma | None = Field(default=None, description="um")
    z_um: _Sigma | None = Field(default=None, description="um")
    rx_rad: _Sigma | None = Field(default=None, description="rad, about its own x")
    ry_rad: _Sigma | None = Field(default=None, description="rad")
    rz_rad: _Sigma | None = Field(default=None, description="rad")


class Body(_Part):
    """Something rigid that carries elements."""

    name: _Name = Field(description="short name")
    position_mm: _Point = Field(description="mm, of its origin in the installation")
    rotation_rad: _Turn = Field(
        default=[0.0, 0.0, 0.0],
        description="rad, rotation vector: axis and angle that turn the axes of the installation "
        "into those of the body",
    )
    fixed: bool = Field(default=False, description="whether all else is measured against it")
    held: list[_Dof] = Field(
        default=[], description="degrees of freedom that stay as they are: x y z rx ry rz"
    )
    prior: Prior = Prior()

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which of `rasnik.geometry.rigid.DOFS` can change, shape (6,)."""
        held = {f"{name}_rad" if name.startswith("r") else f"{name}_um" for name in self.held}
        return np.array([not self.fixed and name not in held for name in DOFS])

    @property
    def prior_sigma(self) -> NDArray[np.float64]:
        """Standard deviations beforehand, shape (6,); infinite where there is none."""
        return np.array([getattr(self.prior, name) or np.inf for name in DOFS])


class _Element(_Part):
    body: _Name = Field(description="name of the body that carries it")
    position_mm: _Point = Field(description="mm, in the frame of the body")


class Mask(_Element):
    """Where a mask is mounted. Without a rotation it faces the sensor, X along the body's x."""

    rotation_rad: _Turn | None = Field(
        default=None, description="rad, rotation vector from the body's axes to X, Y, Z of the mask"
    )
    point_um: Annotated[list[_Coordinate], Field(min_length=2, max_length=2)] | None = Field(
        default=None, description="um, mask coordinates (X, Y) of the point that position_mm gives"
    )


class Lens(_Part):
    """Where a lens is mounted. Without a position: on the line, where the scale wants it."""

    body: _Name = Field(description="name of the body that carries it")
    position_mm: _Point | None = Field(default=None, description="mm, in the frame of the body")


class SensorPlace(_Element):
    """Where a sensor is mounted. Without a rotation it is parallel to the mask and faces it."""

    rotation_rad: _Turn | None = Field(
        default=None, description="rad, rotation vector from the body's axes to u, v, w"
    )


class Accuracy(_Part):
    """How well a Rasnik reads; without a value that of ``[defaults]`` holds."""

    system: str | None = Field(
        default=None, description="shipped system or TOML file: its bound is part of the errors"
    )
    sigma_x_um: _Sigma | None = Field(
        default=None, description="um, of x beyond what comes with a reading: air, mounting"
    )
    sigma_y_um: _Sigma | None = Field(default=None, description="um, likewise of y")
    sigma_scale: _Sigma | None = Field(default=None, description="likewise of the scale")
    sigma_theta_rad: _Sigma | None = Field(default=None, description="rad, likewise of theta_z")
    measures: Annotated[list[Literal["x", "y", "scale", "theta"]], Field(min_length=1)] | None = (
        Field(default=None, description="which values are used: x y scale theta; all by default")
    )


class Rasnik(Accuracy):
    """Mask, lens and sensor, each on a body."""

    name: _Name = Field(description="short name, as in the readings")
    mask: Mask
    lens: Lens
    sensor: SensorPlace


class Sagitta(_Part):
    """How far the middle of three bodies stands from the line between the outer two."""

    name: _Name = Field(default="sagitta", description="short name")
    bodies: Annotated[list[_Name], Field(min_length=3, max_length=3)] = Field(
        description="names of the three bodies, the middle one second"
    )
    points_mm: Annotated[list[_Point], Field(min_length=3, max_length=3)] = Field(
        default=[[0.0, 0.0, 0.0]] * 3, description="mm, the point of each body, in its own frame"
    )


class Installation(_Part):
    """Bodies joined by Rasniks."""

    name: _Name = Field(description="short name")
    description: str = Field(default="", description="one sentence")
    range_mm: float = Field(
        default=10.0,
        gt=0,
        le=1e6,
        description="mm, how far a body may have moved; a motion that the readings know no better "
        "than this is unmeasured",
    )
    range_rad: float = Field(default=0.01, gt=0, le=1, description="rad, likewise turned")
    defaults: Accuracy = Accuracy()
    bodies: list[Body] = Field(min_length=1)
    rasniks: list[Rasnik] = Field(min_length=1)
    sagittas: list[Sagitta] = []

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        problems = [*self._name_problems(), *self._prior_problems(), *self._body_problems()]
        bodies = {body.name for body in self.bodies}
        for rasnik in self.rasniks:
            if {rasnik.mask.body, rasnik.lens.body, rasnik.sensor.body} <= bodies:
                problems += [f"rasnik {rasnik.name}: {text}" for text in self._faults(rasnik)]
        if problems:
            raise ContradictionError(problems)
        return self

    def _name_problems(self) -> Iterator[str]:
        for kind in ("bodies", "rasniks", "sagittas"):
            counts = Counter(one.name for one in getattr(self, kind))
            for name, count in counts.items():
                if count > 1:
                    yield f"{count} {kind} have the name {name!r}: give each its own"

    def _prior_problems(self) -> Iterator[str]:
        for body in self.bodies:
            for dof, free in zip(DOFS, body.free, strict=True):
                if not free and getattr(body.prior, dof) is not None:
                    how = "fixed" if body.fixed else f"held in {dof.split('_')[0]}"
                    yield f"body {body.name} is {how}, and prior.{dof} says how far it may " \
                        "move: give one of them"  # fmt: skip

    def _body_problems(self) -> Iterator[str]:
        names = [body.name for body in self.bodies]
        used = [
            (f"{kind} of rasnik {rasnik.name}", getattr(rasnik, kind).body)
            for rasnik in self.rasniks
            for kind in ("mask", "lens", "sensor")
        ]
        for sagitta in self.sagittas:
            used += [(f"sagitta {sagitta.name}", name) for name in sagitta.bodies]
            if len(set(sagitta.bodies)) < 3:
                yield f"sagitta {sagitta.name} needs three different bodies"
            elif set(sagitta.bodies) <= set(names) and self._has_no_line(sagitta):
                yield f"sagitta {sagitta.name}: the points of {sagitta.bodies[0]} and " \
                    f"{sagitta.bodies[2]} are at the same place and make no line"  # fmt: skip
        for what, name in used:
            if name not in names:
                near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
                hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(names)}"
                yield f"{what}: there is no body {name!r}; {hint}"

    def _has_no_line(self, sagitta: Sagitta) -> bool:
        first, _, last = (
            world(self.body(name), point)
            for name, point in zip(sagitta.bodies, sagitta.points_mm, strict=True)
        )
        return bool(np.linalg.norm(last - first) < COINCIDENT_MM)

    def _faults(self, rasnik: Rasnik) -> Iterator[str]:
        accuracy = self.accuracy(rasnik)
        if accuracy.system is not None:
            try:
                _system_sigmas(accuracy.system)
            except (SystemConfigError, ValueError) as error:
                yield str(error)
                return
        measures = accuracy.measures or ()
        for value, sigma in zip(VALUES, self.value_sigmas(rasnik), strict=True):
            if value in measures and not np.isfinite(sigma):
                unit = {"x": "_um", "y": "_um", "theta": "_rad", "scale": ""}[value]
                yield f"it measures {value} with an unknown error; give sigma_{value}{unit} or a " \
                    "system"  # fmt: skip
        yield from mounting_problems(self, rasnik)

    def body(self, name: str) -> Body:
        """The body of a name."""
        return next(body for body in self.bodies if body.name == name)

    def accuracy(self, rasnik: Rasnik) -> Accuracy:
        """What holds for a Rasnik: its own values, else the defaults."""
        own = {name: getattr(rasnik, name) for name in Accuracy.model_fields}
        stated = {name: value for name, value in own.items() if value is not None}
        return self.defaults.model_copy(update=stated)

    def value_sigmas(self, rasnik: Rasnik, own: NDArray[np.float64] | None = None) -> Any:
        """Standard deviations of the four values of a Rasnik.

        Parameters
        ----------
        rasnik : Rasnik
        own : ndarray, shape (4,), optional
            What comes with a reading; NaN where unknown. By default, and where unknown, that of
            the system.

        Returns
        -------
        ndarray, shape (4,)
            x, y (um), scale, theta_z (rad): the reading's own error and that of the installation,
            added in quadrature; infinite where neither is known or the value is not used.
        """
        accuracy = self.accuracy(rasnik)
        bound = np.full(4, np.nan)
        if accuracy.system is not None:
            bound = np.array(_system_sigmas(accuracy.system))
        noise = bound if own is None else np.where(np.isfinite(own), own, bound)
        names = ("sigma_x_um", "sigma_y_um", "sigma_scale", "sigma_theta_rad")
        beyond = np.array([getattr(accuracy, name) or 0.0 for name in names])
        total = np.hypot(np.nan_to_num(noise), beyond)
        used = np.array([value in (accuracy.measures or VALUES) for value in VALUES])
        return np.where(used & (total > 0), total, np.inf)


@lru_cache(maxsize=64)
def _system_sigmas(source: str) -> tuple[float, ...]:
    """Bound on x, y (um), scale and theta_z (rad) of one image of a system, rounding counted."""
    from rasnik.instrument import load_system
    from rasnik.performance.bound import bound

    found = bound(load_system(source), rounding=True)
    return tuple(float(value) for value in np.sqrt(np.diag(found.covariance)))


# ------------------------------------------------------------------------ files


def installation_names() -> list[str]:
    """Names of the installations shipped with the package, sorted."""
    folder = resources.files("rasnik") / "installations"
    return sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".toml"))


def load_installation(
    source: str | PathLike[str], *, left_out: list[str] | None = None
) -> Installation:
    """Read an installation and check it.

    Parameters
    ----------
    source : str or path
        Name of a shipped installation (see `installation_names`), or path of a TOML file.
    left_out : list of str, optional
        Rasniks that cannot be used as described are left out, and why is appended here, a
        sentence for each fault. By default they raise.

    Returns
    -------
    Installation

    Raises
    ------
    SystemConfigError
        If the file cannot be read, or a value is missing, unknown, impossible or contradicts
        another; with `left_out`, if bodies are at fault or no Rasnik remains.
    """
    label, data = _read(source)
    try:
        return Installation.model_validate(data)
    except ValidationError as error:
        if left_out is None:
            raise SystemConfigError(label, sentences(Installation, error)) from None
        first = error
    data = _without_faulty(data, left_out)
    try:
        return Installation.model_validate(data)
    except ValidationError:
        raise SystemConfigError(label, sentences(Installation, first)) from None


def _read(source: str | PathLike[str]) -> tuple[str, dict[str, Any]]:
    """(label for messages, raw content) of a shipped installation or of a file."""
    text, names = str(source), installation_names()
    if not isinstance(source, str) or text.endswith(".toml") or {"/", "\\"} & set(text):
        return text, _beside(Path(source), read_toml(Path(source)))
    wanted = text.strip().lower().replace("_", "-")
    if wanted in names:
        shipped = resources.files("rasnik") / "installations" / f"{wanted}.toml"
        return wanted, tomllib.loads(shipped.read_text(encoding="utf-8"))
    near = difflib.get_close_matches(wanted, names, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    problem = (
        f"there is no installation of this name; {hint}Shipped are {', '.join(names)}; "
        "a file is given by a path that ends in .toml"
    )
    raise SystemConfigError(repr(text), [problem])


def _beside(path: Path, data: dict[str, Any]) -> dict[str, Any]:
    """The description with files of systems looked for beside the file that names them."""
    listed = data.get("rasniks")
    for entry in [data.get("defaults"), *(listed if isinstance(listed, list) else ())]:
        system = entry.get("system") if isinstance(entry, dict) else None
        if isinstance(system, str) and system.endswith(".toml"):
            entry["system"] = str(path.parent / system)
    return data


def _without_faulty(data: dict[str, Any], left_out: list[str]) -> dict[str, Any]:
    """The description without Rasniks that are at fault by themselves or repeat a name."""
    listed = data.get("rasniks")
    if not isinstance(listed, list):
        return data
    kept: list[Any] = []
    names: set[str] = set()
    for number, entry in enumerate(listed, 1):
        name = entry.get("name") if isinstance(entry, dict) else None
        label = f"rasnik {name}" if name else f"rasnik number {number}"
        if isinstance(name, str) and name in names:
            left_out.append(f"{label} is described twice; the second description is left out")
            continue
        try:
            Installation.model_validate({**data, "rasniks": [entry], "sagittas": []})
        except ValidationError as error:
            texts = [text.replace("rasniks.0.", "") for text in sentences(Installation, error)]
            left_out += [text if label in text else f"{label}: {text}" for text in texts]
            continue
        kept.append(entry)
        names.add(str(name))
    return {**data, "rasniks": kept}
