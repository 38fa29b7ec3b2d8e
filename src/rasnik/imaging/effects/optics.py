"""Effects of the optics: distortion, uneven blur, defocus, diffraction, coherence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rasnik.imaging.deviations import CoherentLight, Deviations
from rasnik.imaging.effects.base import Context, Effect, Image, check_range, effect
from rasnik.imaging.transfer import AiryTransfer, DiscTransfer, GaussianTransfer, ProductTransfer
from rasnik.instrument import System

__all__ = [
    "BlurVariation",
    "Coherence",
    "Defocus",
    "Diffraction",
    "Distortion",
    "image_aperture",
    "undistorted",
]


def image_aperture(system: System) -> float:
    """Numerical aperture on the side of the sensor: half the aperture over its distance.

    Raises
    ------
    ValueError
        If the system states neither ``optics.numerical_aperture`` nor diaphragm and distance.
    """
    optics = system.optics
    if optics.numerical_aperture is not None:
        return optics.numerical_aperture / optics.scale
    if optics.diaphragm_mm is not None and system.geometry.lens_sensor_mm is not None:
        half = optics.diaphragm_mm / 2
        return float(half / np.hypot(half, system.geometry.lens_sensor_mm))
    raise ValueError(
        f"the aperture of system {system.name} is not known: give optics.numerical_aperture, or "
        "optics.diaphragm_mm and geometry.lens_sensor_mm"
    )


def _wavelength_um(system: System, wavelength_nm: float | None) -> float:
    value = system.optics.wavelength_nm if wavelength_nm is None else wavelength_nm
    if value is None:
        raise ValueError(
            f"the wavelength of system {system.name} is not known: give optics.wavelength_nm"
        )
    check_range("wavelength_nm", value, 1.0)
    return value * 1e-3


def undistorted(u: Image, v: Image, k1_per_mm2: float) -> tuple[Image, Image]:
    """The points that a lens of distortion k1 images on (u, v): ``r' = r (1 + k1 r^2)`` solved.

    Raises
    ------
    ValueError
        If the distortion folds the image over within the sensor.
    """
    k1 = k1_per_mm2 * 1e-6
    seen = np.hypot(u, v)
    if k1 < 0 and seen.max() >= 2 / (3 * np.sqrt(-3 * k1)):
        raise ValueError(
            f"a distortion of {k1_per_mm2:g} per mm^2 folds the image over within the sensor"
        )
    r = seen.copy()
    for _ in range(60):
        step = (r * (1 + k1 * r**2) - seen) / (1 + 3 * k1 * r**2)
        r -= step
        if np.abs(step).max() < 1e-9:
            break
    ratio = np.divide(r, seen, out=np.ones_like(r), where=seen > 0)
    return u * ratio, v * ratio


@effect(
    "distortion",
    "radial distortion: a point at r from the middle appears at r (1 + k1 r^2)",
    unit="1/mm^2",
    stage="optics",
    reference="section 3, Image distortion",
)
@dataclass(frozen=True)
class Distortion(Effect):
    k1_per_mm2: float = 1e-4

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        return replace(change, points_um=undistorted(*context.points(change), self.k1_per_mm2))


@effect(
    "diffraction",
    "the blur is that of an ideal lens with the system's aperture, in place of the Gaussian",
    unit="nm, wavelength",
    stage="optics",
    reference="section 3, Image blurring; section 6: 1.22 wavelength / NA",
)
@dataclass(frozen=True)
class Diffraction(Effect):
    """Incoherent light. The wavelength is the system's by default."""

    wavelength_nm: float | None = None

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        wavelength_um = _wavelength_um(context.system, self.wavelength_nm)
        return replace(change, transfer=AiryTransfer(wavelength_um, image_aperture(context.system)))


@effect(
    "defocus",
    "the sensor stands out of the focus by this much",
    unit="um",
    stage="optics",
    reference="section 3, Image blurring: out-of-focus of sensor",
)
@dataclass(frozen=True)
class Defocus(Effect):
    """With `diffraction` by wave optics, else a disc of light on top of the Gaussian blur."""

    defocus_um: float = 100.0

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        if isinstance(change.transfer, AiryTransfer):
            return replace(change, transfer=replace(change.transfer, defocus_um=self.defocus_um))
        radius = abs(self.defocus_um) * image_aperture(context.system)
        blur = change.transfer or GaussianTransfer(context.system.optics.blur_um)
        return replace(change, transfer=ProductTransfer(blur, DiscTransfer(radius)))


@effect(
    "blur_variation",
    "the blur grows from the middle to the corner by this part, as the square of the radius",
    unit="",
    stage="optics",
    reference="section 3, Image blurring",
)
@dataclass(frozen=True)
class BlurVariation(Effect):
    growth: float = 0.1

    def __post_init__(self) -> None:
        check_range("blur_variation", self.growth, -0.5, 2.0)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        u, v = context.points(replace(change, points_um=None))
        square = u**2 + v**2
        return replace(change, blur_ratio=1 + self.growth * square / square.max())


@effect(
    "coherence",
    "this part of the light is coherent over the aperture: Fresnel edges, approximate and slow",
    unit="",
    stage="optics",
    reference="section 3, Image blurring: Fresnel edge diffraction",
)
@dataclass(frozen=True)
class Coherence(Effect):
    """A sum of a coherent and an incoherent image, which real partial coherence is only nearly.

    The coherent part is imaged by the system's aperture; `defocus_um` away from the focus its
    edges show the Fresnel fringes.
    """

    share: float = 0.2
    defocus_um: float = 0.0

    def __post_init__(self) -> None:
        check_range("coherence", self.share, 0, 1)

    def deviations(self, change: Deviations, context: Context) -> Deviations:
        light = CoherentLight(
            self.share,
            _wavelength_um(context.system, None),
            image_aperture(context.system),
            self.defocus_um,
        )
        return replace(change, coherent=light)
