"""All Rasniks of an installation as one function of the motions of its bodies, with derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rasnik.geometry.installation import Installation
from rasnik.geometry.mounting import mounting
from rasnik.geometry.reading import Placement, derivatives, projection, readings
from rasnik.geometry.rigid import UM_PER_MM, left_jacobian, rotation_matrix, skew
from rasnik.imaging.projection import Projection

__all__ = ["Network"]

Array = NDArray[np.float64]

_ELEMENTS = ("mask", "lens", "sensor")


class Network:
    """The exact model of an installation.

    Motions are arrays of shape (bodies, 6) in the order of `rasnik.geometry.rigid.DOFS`:
    translations (um) along and rotation vectors (rad) about the nominal axes of each body.

    Parameters
    ----------
    installation : Installation

    Attributes
    ----------
    bodies, rasniks : list of str
        Names, in the order of all arrays.
    orientation : ndarray of int, shape (rasniks,)
        Code of each Rasnik as described; theta_z is told with respect to it, on the full circle.
    nominal : ndarray, shape (rasniks, 4)
        What they read when nothing has moved: x, y (um), scale, theta_z (rad).
    """

    def __init__(self, installation: Installation) -> None:
        self.installation = installation
        self.bodies = [body.name for body in installation.bodies]
        self.rasniks = [rasnik.name for rasnik in installation.rasniks]
        self.positions_mm = np.array([body.position_mm for body in installation.bodies], float)
        self.rotations = rotation_matrix([body.rotation_rad for body in installation.bodies])
        number = {name: k for k, name in enumerate(self.bodies)}
        #: Body that carries each element: shape (rasniks, 3), of mask, lens, sensor.
        self.carriers = np.array(
            [
                [number[getattr(rasnik, kind).body] for kind in _ELEMENTS]
                for rasnik in installation.rasniks
            ]
        )
        placed = [mounting(installation, rasnik) for rasnik in installation.rasniks]
        self._points = np.array([one.points_mm for one in placed])
        self._mask_axes = np.array([one.mask_axes for one in placed])
        self._sensor_axes = np.array([one.sensor_axes for one in placed])
        self._origin = np.array(
            [rasnik.mask.point_um or [0.0, 0.0] for rasnik in installation.rasniks]
        )
        still = np.zeros((len(self.bodies), 6))
        _, self.orientation = readings(*self._placements(still))
        self.nominal = self.values(still)

    def values(self, motions: Array) -> Array:
        """What all Rasniks read.

        Parameters
        ----------
        motions : ndarray, shape (bodies, 6)

        Returns
        -------
        ndarray, shape (rasniks, 4)
            x, y (um), scale, theta_z (rad).

        Raises
        ------
        ValueError
            If a lens is no longer between mask and sensor, or an element is seen edge on.
        """
        found, _ = readings(*self._placements(motions), self.orientation)
        found[:, :2] += self._origin
        return found

    def projection(self, motions: Array, rasnik: int) -> Projection:
        """The map from sensor to mask of one Rasnik, to simulate its image with."""
        mask, lens, sensor = self._placements(motions)
        seen = projection(
            Placement(mask.position_mm[rasnik], mask.rotation[rasnik]),
            lens[rasnik],
            Placement(sensor.position_mm[rasnik], sensor.rotation[rasnik]),
        )
        shift = np.eye(3)
        shift[:2, 2] = self._origin[rasnik]
        return Projection(shift @ seen.matrix)

    def jacobian(self, motions: Array) -> Array:
        """Derivatives of `values`, in closed form.

        Returns
        -------
        ndarray, shape (rasniks, 4, bodies, 6)
        """
        by_element = derivatives(*self._placements(motions), self.orientation)
        turned = self.rotations @ rotation_matrix(motions[:, 3:])
        turns = self.rotations @ left_jacobian(motions[:, 3:])
        total = np.zeros((len(self.rasniks), 4, len(self.bodies), 6))
        rows = np.arange(len(self.rasniks))[:, None]
        for k, (first, last) in enumerate(((0, 6), (6, 9), (9, 15))):
            carrier = self.carriers[:, k]
            arm = (turned[carrier] @ self._points[:, k, :, None])[..., 0]
            motion = np.zeros((len(self.rasniks), 6, 6))
            motion[:, :3, :3] = self.rotations[carrier]
            motion[:, :3, 3:] = -UM_PER_MM * skew(arm) @ turns[carrier]
            motion[:, 3:, 3:] = turns[carrier]
            part = by_element[:, :, first:last] @ motion[:, : last - first]
            np.add.at(total, (rows, np.arange(4), carrier[:, None]), part)
        return total

    def place(self, motions: Array, body: int, point_mm: Array) -> Array:
        """Where a point of a body stands in the installation, mm, shape (3,)."""
        turned = rotation_matrix(motions[body, 3:]) @ point_mm
        moved = motions[body, :3] / UM_PER_MM + turned
        return np.asarray(self.positions_mm[body] + self.rotations[body] @ moved)

    def points_on(self, body: int) -> Array:
        """Where elements are mounted on a body, in its frame, mm, shape (elements, 3)."""
        return np.asarray(self._points[self.carriers == body])

    def elements_mm(self, motions: Array) -> Array:
        """Where mask, lens and sensor of each Rasnik stand, mm, shape (rasniks, 3, 3)."""
        mask, lens, sensor = self._placements(motions)
        return np.stack([mask.position_mm, lens, sensor.position_mm], axis=1)

    def _placements(self, motions: Array) -> tuple[Placement, Array, Placement]:
        turned = self.rotations @ rotation_matrix(motions[:, 3:])
        shift = (self.rotations @ motions[:, :3, None])[..., 0] / UM_PER_MM
        origins = self.positions_mm + shift
        arms = (turned[self.carriers] @ self._points[..., None])[..., 0]
        points = origins[self.carriers] + arms
        mask, _, sensor = self.carriers.T
        return (
            Placement(points[:, 0], turned[mask] @ self._mask_axes),
            points[:, 1],
            Placement(points[:, 2], turned[sensor] @ self._sensor_axes),
        )
