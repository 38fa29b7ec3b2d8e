"""The instrument: mask, optics, sensor and geometry as one immutable description.

A system file is TOML with the tables ``mask``, ``optics``, ``sensor`` and ``geometry``; the
files shipped in ``rasnik/systems`` are examples. Grey levels, blur, scale and rotation serve
prediction and simulation; the analysis estimates them from the image.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rasnik._config import (
    ContradictionError,
    SystemConfigError,
    apply_overrides,
    parse_overrides,
    read_toml,
    sentences,
    toml_lines,
)
from rasnik.mask import ChessField

__all__ = [
    "Geometry",
    "Optics",
    "Sensor",
    "System",
    "SystemConfigError",
    "load_system",
    "scales_contradict",
    "system_names",
]

_SCALE_TOLERANCE = 0.1

# Up to 100 km: a light path on the Moon has some ten.
Millimetres = Annotated[float, Field(gt=0, le=1e8)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Optics(_Part):
    """What lies between mask and sensor. The description of each field states its unit."""

    scale: float = Field(ge=1e-3, le=1e3, description="image size / mask size")
    blur_um: float = Field(
        ge=0, le=1e4, description="um on the sensor, Gaussian sigma of the blur without the pixel"
    )
    orientation: Literal[1, 2, 3, 4] | None = Field(
        default=None, description="1..4 as on the conventions page; unset: found from the image"
    )
    theta_rad: float = Field(
        default=0.0,
        ge=-2 * math.pi,
        le=2 * math.pi,
        description="rad, rotation of the pattern, anticlockwise as seen on the image",
    )
    wavelength_nm: float | None = Field(default=None, ge=10, le=1e5, description="nm, of the light")
    numerical_aperture: float | None = Field(
        default=None, gt=0, le=2, description="sine of the half angle of the cone at the mask"
    )
    focal_length_mm: Millimetres | None = Field(default=None, description="mm, of the lens")
    diaphragm_mm: Millimetres | None = Field(default=None, description="mm, diameter")


class Sensor(_Part):
    """The image sensor.

    `width_px`, `height_px` and `pixel_um` are those of the physical pixels. With ``binning``
    b > 1 the camera hands out the mean of each square of b x b pixels, rounded once to
    `bit_depth` bits: grey levels and full scale stay, `shape` and `pitch_um` are those of the
    image handed out, and `noise_law` that of its superpixels.
    """

    model: str = Field(default="", description="maker and type")
    width_px: int = Field(ge=8, le=65536, description="physical pixels in a row")
    height_px: int = Field(ge=8, le=65536, description="physical pixels in a column")
    pixel_um: float = Field(ge=0.1, le=1000, description="um, pitch of the physical pixels")
    bit_depth: int = Field(default=8, ge=1, le=16, description="bits of a grey level")
    noise_a: float | None = Field(
        default=None,
        ge=0,
        le=1e9,
        description="grey^2, noise of one physical pixel in the dark: "
        "variance = noise_a + noise_b * grey level, rounding not counted",
    )
    noise_b: float | None = Field(
        default=None, ge=0, le=1e5, description="grey, shot noise: slope of that variance"
    )
    full_well_e: float | None = Field(
        default=None, gt=0, le=1e12, description="electrons in one physical pixel at full scale"
    )
    quantum_efficiency: float | None = Field(
        default=None, gt=0, le=1, description="electrons per photon at this wavelength"
    )
    dark_level: float = Field(ge=0, description="grey level of black fields")
    light_level: float = Field(ge=0, description="grey level of white fields")
    frame_rate_hz: float | None = Field(default=None, gt=0, le=1e7, description="Hz")
    exposure_s: float | None = Field(default=None, gt=0, le=1e5, description="s, per image")
    binning: int = Field(
        default=1, ge=1, le=64, description="pixels averaged into one, in each direction"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        problems = []
        if self.dark_level >= self.light_level:
            problems.append(
                f"dark_level = {self.dark_level:g} must be below light_level = {self.light_level:g}"
            )
        if self.light_level > self.full_scale:
            problems.append(
                f"light_level = {self.light_level:g} is above {self.full_scale}, the full scale "
                f"of {self.bit_depth} bits"
            )
        if (self.noise_a is None) != (self.noise_b is None):
            problems.append("noise_a and noise_b go together: give both or neither")
        if self.width_px % self.binning or self.height_px % self.binning:
            problems.append(
                f"{self.width_px} x {self.height_px} pixels cannot be divided into squares of "
                f"binning = {self.binning}"
            )
        if self.exposure_s and self.frame_rate_hz and self.exposure_s * self.frame_rate_hz > 1:
            problems.append(
                f"exposure_s = {self.exposure_s:g} is longer than a frame at frame_rate_hz = "
                f"{self.frame_rate_hz:g} takes"
            )
        if problems:
            raise ContradictionError(problems)
        return self

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the image handed out."""
        return self.height_px // self.binning, self.width_px // self.binning

    @property
    def pitch_um(self) -> float:
        """Pitch of the pixels of the image handed out."""
        return self.pixel_um * self.binning

    @property
    def full_scale(self) -> int:
        """Highest grey level."""
        return int(2**self.bit_depth - 1)

    @property
    def noise_law(self) -> tuple[float, float] | None:
        """(A, B) of the image handed out: variance = A + B * grey level before rounding.

        The mean of b x b pixels has 1 / b^2 of the variance of one; rounding that mean to a
        whole grey level adds 1/12, which is not counted here. None if the noise is not known.
        """
        if self.noise_a is None or self.noise_b is None:
            return None
        return self.noise_a / self.binning**2, self.noise_b / self.binning**2

    @property
    def electrons_per_grey(self) -> float | None:
        """Electrons in one physical pixel per grey level; None if not known.

        The full well over the full scale or, without a full well, 1 / noise_b (for shot noise
        the variance in electrons equals their number).
        """
        if self.full_well_e is not None:
            return self.full_well_e / self.full_scale
        return 1.0 / self.noise_b if self.noise_b else None


class Geometry(_Part):
    """Distances along the optical axis."""

    mask_lens_mm: Millimetres | None = Field(default=None, description="mm")
    lens_sensor_mm: Millimetres | None = Field(default=None, description="mm")


class System(_Part):
    """A Rasnik: mask, optics, sensor and geometry."""

    name: str = Field(min_length=1, description="short name")
    description: str = Field(default="", description="one sentence")
    mask: ChessField
    optics: Optics
    sensor: Sensor
    geometry: Geometry = Geometry()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if _scale_contradicts(self.optics.scale, self.geometry):
            g = self.geometry
            raise ValueError(
                f"optics.scale = {self.optics.scale:g}, but geometry.lens_sensor_mm = "
                f"{g.lens_sensor_mm:g} and geometry.mask_lens_mm = {g.mask_lens_mm:g} "
                f"make a scale of {g.lens_sensor_mm / g.mask_lens_mm:g}"  # type: ignore[operator]
            )
        return self

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the image in pixels, after binning."""
        return self.sensor.shape

    @property
    def pitch_um(self) -> float:
        """Pitch of the pixels of the image, after binning."""
        return self.sensor.pitch_um

    @property
    def full_scale(self) -> int:
        """Highest grey level."""
        return self.sensor.full_scale

    @property
    def noise_law(self) -> tuple[float, float] | None:
        """(A, B) of the image: variance = A + B * grey level before rounding, after binning."""
        return self.sensor.noise_law

    @property
    def pixels_per_field(self) -> float:
        """Pixels of the image along the side of one chess field."""
        return self.mask.field_um * self.optics.scale / self.pitch_um

    def to_toml(self) -> str:
        """The whole system as a TOML file with units in comments; it loads back equal."""
        lines = toml_lines(self)
        for table in ("mask", "optics", "sensor", "geometry"):
            lines += ["", f"[{table}]", *toml_lines(getattr(self, table))]
        return "\n".join(lines) + "\n"


def system_names() -> list[str]:
    """Names of the systems shipped with the package, sorted."""
    folder = resources.files("rasnik") / "systems"
    return sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".toml"))


def load_system(
    source: str | PathLike[str] | System,
    overrides: Mapping[str, Any] | Iterable[str] | str = (),
) -> System:
    """Read a system and check it.

    Parameters
    ----------
    source : str, path or System
        Name of a shipped system (see `system_names`), path of a TOML file, or a system to
        change. A string is taken as a path if it ends in ``.toml`` or holds a slash.
    overrides : mapping, str or iterable of str, optional
        Values that replace those of the source: ``{"sensor.pixel_um": 7.4}``,
        ``{"sensor": {"pixel_um": 7.4}}`` or ``["sensor.pixel_um=7.4"]``. In strings the value
        is read as TOML, and as plain text if it is not TOML; ``none`` (in a mapping: None)
        means not known. Where a new scale contradicts the distances of the source, these are
        dropped.

    Returns
    -------
    System

    Raises
    ------
    SystemConfigError
        If the name is unknown, the file cannot be read, or a value is missing, unknown,
        impossible or contradicts another.
    """
    if isinstance(source, System):
        label, data = source.name, source.model_dump(exclude_none=True)
    else:
        label, data = _read(source)
    changes = parse_overrides(label, overrides)
    if changes:
        label += " with overrides"
        data = apply_overrides(System, label, data, changes)
        _drop_stale_distances(data, changes)
    try:
        return System.model_validate(data)
    except ValidationError as error:
        raise SystemConfigError(label, sentences(System, error)) from None


def _read(source: str | PathLike[str]) -> tuple[str, dict[str, Any]]:
    """(label for messages, raw content) of a shipped system or of a file."""
    text, names = str(source), system_names()
    if not isinstance(source, str) or text.endswith(".toml") or {"/", "\\"} & set(text):
        return text, read_toml(Path(source))
    wanted = text.strip().lower().replace("_", "-")
    if wanted in names:
        shipped = resources.files("rasnik") / "systems" / f"{wanted}.toml"
        return wanted, tomllib.loads(shipped.read_text(encoding="utf-8"))
    near = difflib.get_close_matches(wanted, names, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    raise SystemConfigError(
        repr(text),
        [
            f"there is no system of this name; {hint}Shipped are {', '.join(names)}; "
            "a file is given by a path that ends in .toml"
        ],
    )


def _drop_stale_distances(data: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Forget the distances if a new scale, given without new distances, contradicts them."""
    if "optics.scale" not in changes or any(key.startswith("geometry.") for key in changes):
        return
    try:
        stale = _scale_contradicts(data["optics"]["scale"], Geometry(**data.get("geometry", {})))
    except (
        ArithmeticError,
        LookupError,
        TypeError,
        ValueError,
    ):  # faults that are reported in full later
        return
    if stale:
        del data["geometry"]


def _scale_contradicts(scale: float, geometry: Geometry) -> bool:
    if geometry.lens_sensor_mm is None or geometry.mask_lens_mm is None:
        return False
    return scales_contradict(geometry.lens_sensor_mm / geometry.mask_lens_mm, scale)


def scales_contradict(one: float, other: float) -> bool:
    """Whether two scales, or distances, differ by more than how they are measured explains.

    Distances are measured to the middle of a lens, not to its principal planes, so the scale they
    give is a rough one: 10 % are allowed.
    """
    return abs(math.log(one / other)) > math.log1p(_SCALE_TOLERANCE)
