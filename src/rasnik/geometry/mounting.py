"""Where the elements of one Rasnik stand on their bodies, and whether that makes sense."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rasnik.geometry.reading import FACING, Placement, readings
from rasnik.geometry.rigid import axes_along, rotation_matrix
from rasnik.instrument import scales_contradict

if TYPE_CHECKING:
    from rasnik.geometry.installation import Body, Installation, Rasnik
    from rasnik.instrument import System

__all__ = ["COINCIDENT_MM", "Mounting", "mounting", "mounting_problems", "world"]

Array = NDArray[np.float64]

#: Points nearer to each other than this are taken for the same.
COINCIDENT_MM = 1e-3
# Body axes nearer to the line than this (cosine) cannot say where X points.
_ALONG = 0.9


@dataclass(frozen=True, eq=False)
class Mounting:
    """Elements of one Rasnik in the frames of the bodies that carry them.

    Attributes
    ----------
    points_mm : ndarray, shape (3, 3)
        Of mask, lens and sensor.
    mask_axes, sensor_axes : ndarray, shape (3, 3)
        X, Y, Z and u, v, w as columns.
    world_mm : ndarray, shape (3, 3)
        Of mask, lens and sensor in the installation, nominal.
    """

    points_mm: Array
    mask_axes: Array
    sensor_axes: Array
    world_mm: Array


def mounting(installation: Installation, rasnik: Rasnik) -> Mounting:
    """The nominal places of the elements, with what the description leaves open filled in.

    Raises
    ------
    ValueError
        If they make no line of sight.
    """
    bodies = [installation.body(e.body) for e in (rasnik.mask, rasnik.lens, rasnik.sensor)]
    mask_body, lens_body, sensor_body = bodies
    mask, sensor = world(mask_body, rasnik.mask.position_mm), world(
        sensor_body, rasnik.sensor.position_mm
    )  # fmt: skip
    line = sensor - mask
    if np.linalg.norm(line) < COINCIDENT_MM:
        raise ValueError("mask and sensor are at the same place")
    if rasnik.lens.position_mm is None:
        lens = mask + line / (1 + _wanted_scale(installation, rasnik))
        lens_local = rotation_matrix(lens_body.rotation_rad).T @ (lens - lens_body.position_mm)
    else:
        lens_local = np.array(rasnik.lens.position_mm, dtype=np.float64)
        lens = world(lens_body, lens_local)
    along = (lens - mask) @ line / (line @ line)
    for name, place in (("mask", mask), ("sensor", sensor)):
        if np.linalg.norm(lens - place) < COINCIDENT_MM:
            raise ValueError(f"lens and {name} are at the same place")
    if not 0 < along < 1:
        raise ValueError(
            f"the lens is not between mask and sensor but {along:.3g} of the way from one to the "
            "other; check the positions and the order mask, lens, sensor"
        )
    mask_base = rotation_matrix(mask_body.rotation_rad)
    if rasnik.mask.rotation_rad is None:
        mask_axes = mask_base.T @ _facing(line, mask_base)
    else:
        mask_axes = rotation_matrix(rasnik.mask.rotation_rad)
    if rasnik.sensor.rotation_rad is None:
        sensor_axes = rotation_matrix(sensor_body.rotation_rad).T @ mask_base @ mask_axes @ FACING
    else:
        sensor_axes = rotation_matrix(rasnik.sensor.rotation_rad)
    points = np.array([rasnik.mask.position_mm, lens_local, rasnik.sensor.position_mm])
    return Mounting(points, mask_axes, sensor_axes, np.array([mask, lens, sensor]))


def world(body: Body, point_mm: NDArray[np.float64] | list[float]) -> Array:
    """Where a point of a body stands in the installation, nominal, mm."""
    return np.asarray(body.position_mm + rotation_matrix(body.rotation_rad) @ np.array(point_mm))


def _facing(line: Array, base: Array) -> Array:
    """Axes of a mask that faces along the line, X near the body's x (or y) axis."""
    cosine = abs(base[:, 0] @ line) / np.linalg.norm(line)
    return axes_along(line, base[:, 0] if cosine < _ALONG else base[:, 1])


def _wanted_scale(installation: Installation, rasnik: Rasnik) -> float:
    system = _system(installation, rasnik)
    return 1.0 if system is None else system.optics.scale


def _system(installation: Installation, rasnik: Rasnik) -> System | None:
    from rasnik.instrument import load_system

    name = installation.accuracy(rasnik).system
    return None if name is None else load_system(name)


def mounting_problems(installation: Installation, rasnik: Rasnik) -> Iterator[str]:
    """One sentence for each contradiction between the places of the elements and the system."""
    try:
        placed = mounting(installation, rasnik)
        base = [
            rotation_matrix(installation.body(e.body).rotation_rad)
            for e in (rasnik.mask, rasnik.sensor)
        ]
        values, _ = readings(
            Placement(placed.world_mm[0], base[0] @ placed.mask_axes),
            placed.world_mm[1],
            Placement(placed.world_mm[2], base[1] @ placed.sensor_axes),
        )
    except ValueError as error:
        yield str(error)
        return
    system = _system(installation, rasnik)
    if system is None:
        return
    distances = np.linalg.norm(np.diff(placed.world_mm, axis=0), axis=1)
    scale = distances[1] / distances[0]
    if scales_contradict(scale, system.optics.scale):
        yield (
            f"the distances make a scale of {scale:.4g} (mask to lens {distances[0]:.6g} mm, lens "
            f"to sensor {distances[1]:.6g} mm), but system {system.name} has optics.scale = "
            f"{system.optics.scale:g}"
        )
    for name, here, there in (
        ("mask_lens_mm", distances[0], system.geometry.mask_lens_mm),
        ("lens_sensor_mm", distances[1], system.geometry.lens_sensor_mm),
    ):
        if there is not None and scales_contradict(here, there):
            yield (
                f"system {system.name} has geometry.{name} = {there:g}, but the positions make it "
                f"{here:.6g} mm"
            )
    if rasnik.mask.point_um is not None:
        x, y = values[:2] + rasnik.mask.point_um
        x0, x1, y0, y1 = system.mask.bounds_um
        if not (x0 <= x <= x1 and y0 <= y <= y1):
            yield (
                f"the line crosses the mask plane at ({x:.6g}, {y:.6g}) um, beside the mask, which "
                f"ends at ({x1:.6g}, {y1:.6g}) um; check mask.point_um and the positions"
            )
