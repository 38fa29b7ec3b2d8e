"""A linearisation in use: what it says of frames, and whether that is to be believed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import exp, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rasnik.analysis.flags import Flag
from rasnik.analysis.frame import Frame
from rasnik.analysis.gauss_newton import iterate
from rasnik.analysis.moments import all_tiles
from rasnik.analysis.outliers import estimate_noise, find_outliers
from rasnik.analysis.parameters import POSE_SIZE, Model, State
from rasnik.analysis.pose import Pose
from rasnik.imaging.projection import wrap_angle
from rasnik.tracking import kernels
from rasnik.tracking.linearisation import Linearisation, Settings, linearise

__all__ = [
    "LIGHT_USABLE",
    "NEAR",
    "USABLE",
    "Reading",
    "Reference",
    "approach",
    "model_of",
]

#: Motions in units of the edge width: where a new reference is wanted, and how far the present
#: one can be used. For 85 um fields that is 0.2 um, with errors of 2 pm, and 0.35 um with 15 pm.
NEAR = 0.04
USABLE = 0.07

#: Relative changes of the contrast, likewise.
_LIGHT_NEAR, LIGHT_USABLE = 0.05, 0.25
_BLUR_NEAR = 0.03
_CHI2_SIGMAS = 7.0
_MISFIT = 1.15
_MISFIT_DRIFT = 0.1
_CURVATURE = 0.1
_SURPRISE = 45.0
_SCALE_CHANGE = 0.05
_COARSE_STRIDE = 13  # tiles; shares no factor with their usual number in a row
_AVERAGED = 64  # frames over which the chi-square that is expected follows the one seen

#: What a pose keeps of the flags of the fit that the reference began with.
_LASTING = (
    Flag.SATURATED
    | Flag.QUARTER_TURN
    | Flag.MODEL_MISFIT
    | Flag.NOISE_ESTIMATED
    | Flag.HEAVILY_MASKED
    | Flag.AFFINE
    | Flag.PROJECTIVE
    | Flag.PROFILE_REFINED
    | Flag.NOT_FINITE
    | Flag.LOW_CONTRAST
    | Flag.SCALE_UNEXPECTED
)


class Statistics(NamedTuple):
    """How well a step explains a frame, in the order of `kernels.estimate`."""

    chi2: float
    expected: float
    worst_tile: float
    motion: float
    contrast: float
    pose_energy: float
    surprise: float


class Reading(NamedTuple):
    """What a reference says of a frame: plain numbers, as each is looked at many times.

    Attributes
    ----------
    step : ndarray, shape (k,)
    statistics : Statistics
    """

    step: NDArray[np.float64]
    statistics: Statistics

    @property
    def chi2_ratio(self) -> float:
        """Chi-square per expected chi-square."""
        return self.statistics.chi2 / max(self.statistics.expected, 1.0)


@dataclass(eq=False)
class Reference:
    """A linearisation and what frames near it should look like.

    Attributes
    ----------
    linear : Linearisation
    origin : Pose
        The full fit that this and all references before it descend from: orientation, code,
        flags.
    growth : ndarray, shape (4,)
        Factors on the uncertainty of x, y, S, theta_z for what the noise does not explain.
    chi2_ratio : float
        Chi-square per expected chi-square.
    surprise : ndarray, optional
        What a richer map explains, if the image fits badly from the beginning.
    """

    linear: Linearisation
    origin: Pose
    growth: NDArray[np.float64] = field(default_factory=lambda: np.ones(4))
    chi2_ratio: float = 1.0
    surprise: NDArray[np.float64] | None = None
    begun: tuple[float, NDArray[np.float64]] | None = None
    """When the mask was first seen near this reference, in frames, and the step to it."""

    @classmethod
    def from_fit(cls, frame: Frame, pose: Pose, free: bool) -> Reference:
        """Linearise about a pose that was fitted to a prepared frame.

        Parameters
        ----------
        frame : Frame
        pose : Pose
            Its full fit.
        free : bool
            Whether richer maps than the pose's may be called for.
        """
        assert pose.projection is not None and pose.appearance is not None
        state = State(pose.projection, pose.appearance)
        if frame.mask.polarity != pose.polarity:
            frame = replace(frame, mask=frame.mask.model_copy(update={"polarity": pose.polarity}))
        valid, arguments = frame.valid, (state, frame.mask, frame.camera)
        if np.count_nonzero(valid) > (1 - pose.masked_fraction) * valid.size + 0.5:
            valid = find_outliers(frame.image, valid, *arguments, frame.noise)
        noise = frame.noise or estimate_noise(frame.image, valid, *arguments)
        settings = Settings(frame.mask, frame.camera, noise, model_of(pose), free, valid)
        reference = cls(linearise(settings, state), pose)
        sigmas = np.sqrt(np.diag(pose.covariance) / np.diag(reference._covariance))
        enlarged = pose.flags & (Flag.MODEL_MISFIT | Flag.NOISE_ESTIMATED)
        reference.growth = np.maximum(sigmas, 1.0) if enlarged else np.ones(4)
        return reference

    def expect(self, reading: Reading) -> None:
        """Take the first frame's misfit as what is to be expected of the next."""
        if not np.isfinite(reading.statistics).all():
            return
        self.chi2_ratio = reading.chi2_ratio
        if self.chi2_ratio > _MISFIT:
            self.linear.limits[:] *= max(1.0, reading.statistics.worst_tile)
            self.surprise = reading.step[self.linear.n_parameters :].copy()

    def moved_to(self, linear: Linearisation) -> Reference:
        """The same expectations about another linearisation."""
        linear.limits[:] = self.linear.limits
        return replace(self, linear=linear, begun=None)

    # ----------------------------------------------------------------- reading frames

    def read(
        self,
        frames: Sequence[NDArray[Any]],
        mapping: Callable[..., Iterable[Reading]] = map,
    ) -> list[Reading]:
        """Estimate frames; `mapping` may work on several at a time."""
        return list(mapping(self._read, frames))

    def _read(self, frame: NDArray[Any]) -> Reading:
        step, statistics = np.empty(self.linear.n_steps), np.empty(kernels.N_STATISTICS)
        self.linear.estimate(frame, step, statistics)
        return Reading(step, Statistics(*statistics.tolist()))

    def fits(self, reading: Reading) -> bool:
        """Whether a frame is explained: nothing moved far, nothing in the way, the same light."""
        return self.usable(reading) and self.explains(reading)

    def explains(self, reading: Reading) -> bool:
        """Whether the model describes a frame, wherever the mask is."""
        ndf, statistics = self.linear.ndf, reading.statistics
        bent = statistics.pose_energy / ndf * self.motion(reading) ** 2
        allowed = (
            _CHI2_SIGMAS * sqrt(2 / ndf) * self.chi2_ratio
            + _MISFIT_DRIFT * abs(self.chi2_ratio - 1)
            + _CURVATURE * bent
        )
        return (
            abs(reading.chi2_ratio - self.chi2_ratio) < allowed
            and statistics.worst_tile < 1 + bent
            and self._surprise(reading) < _SURPRISE * max(1.0, self.chi2_ratio)
        )

    def _surprise(self, reading: Reading) -> float:
        """What a richer map would explain that it did not explain before."""
        if self.surprise is None:
            return reading.statistics.surprise
        extra = reading.step[self.linear.n_parameters :] - self.surprise
        return float(extra @ extra)

    def motion(self, reading: Reading) -> float:
        """Largest motion of the mask over the image, in widths of an edge."""
        return reading.statistics.motion / self.linear.edge_width_fields

    def usable(self, reading: Reading) -> bool:
        """Whether a frame is near enough for what the reference says of it."""
        return self.motion(reading) < USABLE and not self.light_changed(reading)

    def near(self, reading: Reading) -> bool:
        """Whether a frame is so near that no new reference is wanted."""
        shape = POSE_SIZE[self.linear.settings.model] + 12
        variance = self.linear.state.appearance.blur_um**2
        return (
            self.motion(reading) < NEAR
            and abs(reading.statistics.contrast - 1) < _LIGHT_NEAR
            and abs(reading.step.item(shape)) < 2 * _BLUR_NEAR * variance
        )

    def light_changed(self, reading: Reading) -> bool:
        return not abs(reading.statistics.contrast - 1) < LIGHT_USABLE

    def learn(self, reading: Reading) -> None:
        """Follow slow changes of the misfit with a frame that was believed."""
        self.chi2_ratio += (reading.chi2_ratio - self.chi2_ratio) / _AVERAGED

    def velocity(self, reading: Reading, clock: float) -> NDArray[np.float64]:
        """Mean change of the pose per frame since this reference came into use, shape (4,)."""
        if self.begun is None or self.begun[0] == clock:
            return np.zeros(4)
        begun, step = self.begun
        return (reading.step[:4] - step) / (clock - begun)

    def ahead(self, reading: Reading, clock: float, frames: float) -> State:
        """Where the mask will be a number of frames after a reading."""
        step = reading.step.copy()
        step[:4] += frames * self.velocity(reading, clock)
        return self.linear.stepped(step)

    @property
    def near_um(self) -> float:
        """The motion on the mask at which a new reference is wanted."""
        return NEAR * self.linear.edge_width_fields * self.linear.settings.mask.field_um

    # ----------------------------------------------------------------- results

    @cached_property
    def flags(self) -> Flag:
        return self.origin.flags & _LASTING

    @cached_property
    def vector(self) -> NDArray[np.float64]:
        """(x, y, ln S, theta) of the reference, shape (4,)."""
        return _vector_of(self.linear.state, self.origin.orientation)

    @cached_property
    def _covariance(self) -> NDArray[np.float64]:
        """Of x, y, S, theta_z from the noise, at the reference."""
        unit = np.array([1.0, 1.0, np.exp(self.vector[2]), 1.0])
        return self.linear.covariance[:4, :4] * np.outer(unit, unit)

    @cached_property
    def _grown(self) -> NDArray[np.float64]:
        """The same with what the noise does not explain."""
        return self._covariance * np.outer(self.growth, self.growth)

    def _noise_factor(self, reading: Reading) -> float:
        """Growth of the uncertainty with the light: noise over contrast."""
        variance = reading.statistics.expected / max(self.linear.n_pixels, 1)
        return sqrt(max(variance, 0.0)) / max(reading.statistics.contrast, 1e-9)

    def _chi2_ndf(self, reading: Reading) -> float:
        chi2, expected = reading.statistics.chi2, reading.statistics.expected
        return chi2 / max(expected * self.linear.ndf / max(self.linear.n_pixels, 1), 1.0)

    def columns(self, readings: Sequence[Reading]) -> dict[str, NDArray[Any]]:
        """The columns of a track for frames that fit."""
        x, y, log_scale, theta = self.vector
        steps = np.array([reading.step for reading in readings]).T
        light = POSE_SIZE[self.linear.settings.model]
        appearance = self.linear.state.appearance
        factor = np.array([self._noise_factor(reading) for reading in readings])
        sigma = np.sqrt(np.diag(self._grown))
        return {
            "x_um": x + steps[0],
            "y_um": y + steps[1],
            "scale": np.exp(log_scale + steps[2]),
            "theta_rad": np.pi - (np.pi - theta - steps[3]) % (2 * np.pi),
            "sigma_x_um": sigma[0] * factor,
            "sigma_y_um": sigma[1] * factor,
            "sigma_scale": sigma[2] * factor,
            "sigma_theta_rad": sigma[3] * factor,
            "chi2_ndf": np.array([self._chi2_ndf(reading) for reading in readings]),
            "blur_um": np.sqrt(np.maximum(appearance.blur_um**2 + steps[light + 12], 0.0)),
            "dark_level": appearance.dark[0] + steps[light],
            "light_level": appearance.light[0] + steps[light + 6],
        }

    def pose(self, reading: Reading, flags: Flag = Flag.NONE) -> Pose:
        """The pose in a frame that fits."""
        state = self.linear.stepped(reading.step)
        x, y, log_scale, theta = (self.vector + reading.step[:4]).tolist()
        appearance = state.appearance
        return Pose(
            ok=True,
            x_um=x,
            y_um=y,
            scale=exp(log_scale),
            theta_rad=wrap_angle(theta),
            orientation=self.origin.orientation,
            covariance=self._grown * self._noise_factor(reading) ** 2,
            chi2_ndf=self._chi2_ndf(reading),
            blur_um=appearance.blur_um,
            dark_level=appearance.dark.item(0),
            light_level=appearance.light.item(0),
            edge_shift_um=appearance.edge_shift_um,
            polarity=self.origin.polarity,
            code_lines_read=self.origin.code_lines_read,
            code_lines_in_view=self.origin.code_lines_in_view,
            masked_fraction=1 - self.linear.n_pixels / self.linear.level.size,
            flags=self.flags | flags if flags else self.flags,
            projection=state.projection,
            appearance=appearance,
            method=self.origin.method,
            model=self.origin.model,
        )


def approach(frame: Frame, settings: Settings, state: State) -> State | None:
    """A state near the frame's, from a twelfth of its pixels; None if it is not found.

    Parameters
    ----------
    frame : Frame
    settings : Settings
    state : State
        Within a quarter of a field, and any light.
    """
    tiles = all_tiles(settings.camera.shape)[::_COARSE_STRIDE]
    frame = replace(frame, mask=settings.mask, valid=settings.valid)
    kurtosis = state.appearance.kurtosis != 0.0
    try:
        found = iterate(
            frame, settings.noise, state, settings.model, kurtosis, tiles, 8,
            trim=True, fixed_shape=True,
        )  # fmt: skip
    except ValueError:  # a state that cannot be modelled
        return None
    return found.state if found.converged and _sane(state, found.state) else None


def _sane(start: State, found: State) -> bool:
    """Whether a state is still the same instrument: a few per cent of scale, some contrast."""
    before, after = (state.projection.similarity()[0] for state in (start, found))
    light, dark = found.appearance.light[0], found.appearance.dark[0]
    return bool(abs(np.log(after / before)) < _SCALE_CHANGE and np.isfinite(light) and light > dark)


def model_of(pose: Pose) -> Model:
    assert pose.model in POSE_SIZE
    return pose.model


def _vector_of(state: State, orientation: int) -> NDArray[np.float64]:
    """(x, y, ln S, theta) of a state, shape (4,)."""
    scale, theta, _ = state.projection.similarity(orientation)
    return np.array([state.projection.x_um, state.projection.y_um, np.log(scale), theta])
