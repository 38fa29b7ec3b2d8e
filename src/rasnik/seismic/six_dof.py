"""Six degrees of freedom of a proof mass from three Rasniks: the paper's 6-D inertial sensor.

The mass and its frame are the two bodies of an installation (`rasnik.geometry.installation`), the
frame fixed. What can be measured, and how well, is what `rasnik.geometry.adjustment` says of it;
here the same problem is solved for every frame of a track: once for all with the derivatives at
the nominal place, or exactly, by repeating that until the exact model of the light paths agrees.

Source: van der Graaf et al., appendix "Applications": "With three Rasnik systems, a 6D inertial
sensor can be realised."
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rasnik.characterisation.gaps import Series, even_series
from rasnik.geometry.adjustment import adjust
from rasnik.geometry.installation import VALUES, Installation
from rasnik.geometry.network import Network
from rasnik.geometry.observability import unmeasured_space
from rasnik.geometry.observations import Readings
from rasnik.geometry.rigid import DOFS, UM_PER_MM
from rasnik.seismic.clocks import on_one_clock
from rasnik.seismic.ground import GroundMotion, ground_motion
from rasnik.seismic.suspension import Quantity, Suspension
from rasnik.tracking.track import Track

__all__ = ["SixDof", "SixDofMotion", "ground_in_six"]

Array = NDArray[np.float64]

_COLUMNS = ("x_um", "y_um", "scale", "theta_rad")
_NM_PER_UM = 1e3
# Largest step in standard deviations at which the exact solution is said to have been found.
_CONVERGED = 1e-3
_MOST_STEPS = 30


@dataclass(frozen=True, eq=False)
class SixDofMotion:
    """Motion of the mass relative to the frame.

    Attributes
    ----------
    series : dict of Series
        By the names of `rasnik.geometry.rigid.DOFS`: translations in nm along the mass's own
        axes, turns in rad about them. NaN where a reading is missing, or where the degree of
        freedom is not measured.
    chi2 : ndarray, shape (n,)
        Weighted squares of what is left of the readings; NaN where nothing is left over.
    degrees_of_freedom : int
        Readings less motions that they measure.
    exact : bool
        Whether the exact model was solved.
    sigma : dict of float
        Standard deviation of a value of each series by the noise of the readings, in its unit; NaN
        where it is not measured or was resampled.
    """

    series: dict[str, Series]
    chi2: Array
    degrees_of_freedom: int
    exact: bool
    sigma: dict[str, float]


class SixDof:
    """A proof mass that Rasniks read, as a linear map from readings to motions and back.

    Parameters
    ----------
    installation : Installation
        With one body that can move, and whatever stands still.
    sigmas : mapping, optional
        Of names of Rasniks to four standard deviations of a reading: x, y (um), scale, theta_z
        (rad); what is not finite is not used. By default, and for other names, those that the
        installation states.

    Attributes
    ----------
    network : Network
    mass : str
        Name of the body that moves.
    covariance : ndarray, shape (6, 6)
        Of one frame, in um and rad, in the order of `rasnik.geometry.rigid.DOFS`; 0 where the
        body is held, NaN where a motion is not measured.
    measured : ndarray of bool, shape (6,)
    unmeasured : tuple of str
        Motions that no reading shows, in words.
    condition : float
        Largest over smallest effect of a motion of the mass, turns counted at the distance of
        its elements, in standard deviations of the readings; infinite if one is unmeasured.

    Raises
    ------
    ValueError
        If not exactly one body can move, it has a prior, or the error of no reading is known.
    """

    def __init__(
        self, installation: Installation, sigmas: Mapping[str, ArrayLike] | None = None
    ) -> None:
        free = [body for body in installation.bodies if body.free.any()]
        if len(free) != 1:
            names = ", ".join(body.name for body in free) or "none"
            raise ValueError(
                f"an inertial sensor has one body that moves; here it is {len(free)} ({names}): "
                "make the others fixed, or use an adjustment"
            )
        if np.isfinite(free[0].prior_sigma).any():
            raise ValueError(
                f"the motion of {free[0].name} is wanted without a prior; leave it out"
            )
        self.network, self.mass = Network(installation), free[0].name
        self._body = self.network.bodies.index(self.mass)
        self._free = free[0].free
        own = np.full(self.network.nominal.shape, np.nan)
        for name, values in (sigmas or {}).items():
            if name not in self.network.rasniks:
                raise ValueError(
                    f"there is no Rasnik {name!r}; there are {', '.join(self.network.rasniks)}"
                )
            own[self.network.rasniks.index(name)] = values
        # The adjustment of readings that are all nominal says what can be measured.
        found = adjust(self.network, Readings(self.network.nominal, own))
        rows = slice(6 * self._body, 6 * self._body + 6)
        self.covariance = found.covariance[rows, rows]
        self.measured = found.measured[self._body] | ~self._free
        self.unmeasured = tuple(one.words for one in found.unmeasured)
        pairs = zip(installation.rasniks, own, strict=True)
        self._sigmas = np.array([installation.value_sigmas(r, one) for r, one in pairs])
        self._used = np.isfinite(self._sigmas)
        self._linearise()

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviations of one frame by degree of freedom, um and rad."""
        return dict(zip(DOFS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def _linearise(self) -> None:
        installation, network = self.network.installation, self.network
        ranges = np.array([UM_PER_MM * installation.range_mm] * 3 + [installation.range_rad] * 3)
        still = np.zeros((len(network.bodies), 6))
        slopes = network.jacobian(still)[:, :, self._body, :]
        whitened = (slopes / self._sigmas[..., None])[self._used]
        used = whitened[:, self._free] * ranges[self._free]
        space = unmeasured_space(used)
        inverse = np.linalg.pinv(np.vstack([used, space.T]))[:, : len(used)]
        self._inverse = np.zeros((6, len(used)))
        self._inverse[self._free] = inverse * ranges[self._free, None]
        self._whitened = whitened
        self._freedom = len(used) - (int(self._free.sum()) - space.shape[1])
        arm_um = UM_PER_MM * float(
            np.sqrt(np.mean(np.sum(network.points_on(self._body) ** 2, axis=-1)))
        )
        even = np.array([1.0] * 3 + [1 / arm_um if arm_um else 1.0] * 3)
        sizes = np.linalg.svd((whitened * even)[:, self._free], compute_uv=False)
        full = space.shape[1] == 0 and len(sizes) == self._free.sum()
        self.condition = float(sizes[0] / sizes[-1]) if full else np.inf

    # -------------------------------------------------------------------- readings

    def readings(self, motions: ArrayLike) -> Array:
        """What the Rasniks read if the mass moves, by the exact model.

        Parameters
        ----------
        motions : array_like, shape (n, 6)
            In um and rad, from the nominal place.

        Returns
        -------
        ndarray, shape (n, rasniks, 4)
        """
        motions = np.asarray(motions, dtype=float)
        found = np.empty((len(motions), *self.network.nominal.shape))
        place = np.zeros((len(self.network.bodies), 6))
        for k, motion in enumerate(motions):
            place[self._body] = motion
            found[k] = self.network.values(place)
        return found

    def solve(self, values: ArrayLike, *, exact: bool = False) -> tuple[Array, Array]:
        """Motions of the mass from readings.

        Parameters
        ----------
        values : array_like, shape (n, rasniks, 4)
            x, y (um), scale, theta_z (rad), as `readings` gives them. A frame of which any value
            in use is NaN has no motion.
        exact : bool
            Solve the exact model, some 0.1 ms a frame and step; else the linear one, which is
            wrong by the square of the motion over the distances.

        Returns
        -------
        motions : ndarray, shape (n, 6)
            In um and rad; NaN where unmeasured or missing, or where the exact solution was not
            found.
        chi2 : ndarray, shape (n,)

        Raises
        ------
        ValueError
            If the shape does not fit.
        """
        values = np.asarray(values, dtype=float)
        if values.shape[1:] != self.network.nominal.shape:
            raise ValueError(
                f"readings of {len(self.network.rasniks)} Rasniks have the shape (n, "
                f"{len(self.network.rasniks)}, 4), not {values.shape}"
            )
        wanted = self._over_sigma(values)
        at = self._over_sigma(self.network.nominal[None])
        motions = (wanted - at) @ self._inverse.T
        rest = wanted - at - motions @ self._whitened.T
        if exact:
            motions, rest = self._refined(wanted, motions)
        chi2 = np.sum(rest**2, axis=1) if self._freedom else np.full(len(values), np.nan)
        return np.where(self.measured, motions, np.nan), chi2

    def _over_sigma(self, values: Array) -> Array:
        """Readings in use over their errors, shape (n, m)."""
        return np.asarray((values / self._sigmas)[:, self._used])

    def _refined(self, wanted: Array, motions: Array) -> tuple[Array, Array]:
        rest = np.full_like(wanted, np.nan)
        left = np.flatnonzero(np.isfinite(motions).all(axis=1))
        motions = motions.copy()
        motions[np.setdiff1d(np.arange(len(motions)), left)] = np.nan
        for _ in range(_MOST_STEPS):
            if not len(left):
                return motions, rest
            rest[left] = wanted[left] - self._over_sigma(self.readings(motions[left]))
            step = rest[left] @ self._inverse.T
            motions[left] += step
            size = np.linalg.norm(step @ self._whitened.T, axis=1)
            left = left[size > _CONVERGED]
        motions[left] = np.nan  # a chord that does not lead there
        return motions, rest

    # -------------------------------------------------------------------- tracks

    def motion(
        self,
        tracks: Mapping[str, Track],
        *,
        exact: bool = False,
        absolute: bool = False,
        resample_hz: float | None = None,
    ) -> SixDofMotion:
        """Motion of the mass from tracks of its Rasniks.

        Parameters
        ----------
        tracks : mapping
            By the names of the Rasniks.
        exact : bool
            As in `solve`.
        absolute : bool
            Take readings as they are, so that motion counts from the nominal place. By default
            the mean of each track stands for it: origins of masks need not be known.
        resample_hz : float, optional
            As in `rasnik.seismic.clocks.on_one_clock`, for Rasniks with clocks of their own.

        Raises
        ------
        ValueError
            If a track is missing or not regular, or the clocks differ and no rate is given.
        """
        names = self.network.rasniks
        missing = [name for name in names if name not in tracks]
        if missing:
            raise ValueError(f"there is no track of {', '.join(missing)}")
        wanted = [(k, v) for k in range(len(names)) for v in range(4) if self._used[k, v]]
        series = [
            replace(even_series(tracks[names[k]], _COLUMNS[v]), name=f"{VALUES[v]} of {names[k]}")
            for k, v in wanted
        ]
        series = on_one_clock(series, resample_hz=resample_hz)
        values = np.full((len(series[0]), len(names), 4), np.nan)
        for (k, v), one in zip(wanted, series, strict=True):
            own = one.values / _NM_PER_UM if one.unit == "nm" else one.values
            shift = 0.0 if absolute else self.network.nominal[k, v] - np.nanmean(own)
            values[:, k, v] = own + shift
        motions, chi2 = self.solve(values, exact=exact)
        like, made, sigma = series[0], {}, {}
        for name, column in zip(DOFS, motions.T, strict=True):
            length = name.endswith("_um")
            size = _NM_PER_UM if length else 1.0
            made[name] = replace(
                like,
                values=column * size,
                name=f"{name.rpartition('_')[0]} of {self.mass}",
                unit="nm" if length else "rad",
            )
            sigma[name] = self.sigma[name] * size if resample_hz is None else np.nan
        return SixDofMotion(made, chi2, self._freedom, exact, sigma)


def ground_in_six(
    motion: SixDofMotion,
    suspensions: Mapping[str, Suspension],
    quantity: Quantity = "velocity",
    *,
    band_hz: tuple[float, float],
    exposure_s: float = 0.0,
) -> dict[str, GroundMotion]:
    """Motion of the ground in all degrees of freedom that have a suspension.

    Parameters
    ----------
    motion : SixDofMotion
    suspensions : mapping
        By the names of `rasnik.geometry.rigid.DOFS`: a mass has a natural frequency and a Q of
        its own in each. What the mass carries (``on_mass``) does not matter here.
    quantity, band_hz, exposure_s
        As in `rasnik.seismic.ground.ground_motion`.

    Returns
    -------
    dict of GroundMotion
        Translations in nm (per s, per s^2), turns in rad; with the errors that the noise of the
        readings leaves.

    Raises
    ------
    ValueError
        If there is no such degree of freedom, it was not measured, or as `ground_motion`.

    Notes
    -----
    Each degree of freedom is taken by itself. A ground that tilts also accelerates a mass
    sideways, by g times the tilt; that is in the horizontal motions and is not taken out.
    """
    found = {}
    for name, suspension in suspensions.items():
        if name not in motion.series:
            raise ValueError(f"{name!r} is not one of {', '.join(DOFS)}")
        series = motion.series[name]
        if not series.valid:
            raise ValueError(f"{series.name} is not measured: no reading shows it")
        # Where the mass is, less where the frame is: what a camera on the mass would read. The
        # equation of a turn is that of a length.
        unit = series.unit
        mass = suspension.model_copy(update={"on_mass": "camera"})
        sigma = motion.sigma[name]
        ground = ground_motion(
            replace(series, unit="nm"),
            mass,
            quantity,
            band_hz=band_hz,
            sigma=sigma if np.isfinite(sigma) else None,
            exposure_s=exposure_s,
        )
        found[name] = replace(ground, unit=ground.unit.replace("nm", unit))
    return found
