"""A linearisation in use: what it says of frames, and whether that is to be believed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

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
from rasnik.tracking.linearisation import Builder, Linearisation, Settings

__all__ = [
    "LIGHT_USABLE",
    "NEAR",
    "USABLE",
    "Reading",
    "Reference",
    "approach",
    "build",
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


@dataclass(frozen=True, eq=False)
class Reading:
    """What a reference says of n frames.

    Attributes
    ----------
    steps : ndarray, shape (n, k)
    statistics : ndarray, shape (n, kernels.N_STATISTICS)
    """

    steps: NDArray[np.float64]
    statistics: NDArray[np.float64]

    def __getitem__(self, index: slice) -> Reading:
        return Reading(self.steps[index], self.statistics[index])

    def __len__(self) -> int:
        return len(self.steps)

    @property
    def chi2_ratio(self) -> NDArray[np.float64]:
        """Chi-square per expected chi-square, shape (n,)."""
        chi2, expected = self.statistics[:, [kernels.CHI2, kernels.EXPECTED]].T
        ratio: NDArray[np.float64] = chi2 / np.maximum(expected, 1.0)
        return ratio


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
    surprise : ndarray
        What a richer map explains, if the image fits badly from the beginning.
    """

    linear: Linearisation
    origin: Pose
    growth: NDArray[np.float64] = field(default_factory=lambda: np.ones(4))
    chi2_ratio: float = 1.0
    surprise: NDArray[np.float64] | float = 0.0
    begun: float | None = None
    """When the mask was first seen near this reference, in frames."""

    @classmethod
    def from_fit(cls, frame: Frame, pose: Pose, free: bool) -> tuple[Reference, Reading]:
        """Linearise about a pose that was fitted to a prepared frame.

        Parameters
        ----------
        frame : Frame
        pose : Pose
            Its full fit.
        free : bool
            Whether richer maps than the pose's may be called for.

        Returns
        -------
        reference : Reference
        reading : Reading
            Of this frame.
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
        reference = cls(build(settings, state), pose)
        sigmas = np.sqrt(np.diag(pose.covariance) / np.diag(reference._covariance))
        enlarged = pose.flags & (Flag.MODEL_MISFIT | Flag.NOISE_ESTIMATED)
        reference.growth = np.maximum(sigmas, 1.0) if enlarged else np.ones(4)
        reading = reference.read([frame.image])
        reference._settle(reading)
        return reference, reading

    def _settle(self, reading: Reading) -> None:
        """Take the first frame's misfit as what is to be expected of the next."""
        row = reading.statistics[0]
        if not np.isfinite(row).all():
            return
        self.chi2_ratio = float(reading.chi2_ratio[0])
        if self.chi2_ratio > _MISFIT:
            self.linear.limits[:] *= max(1.0, row[kernels.WORST_TILE])
            self.surprise = reading.steps[0, self.linear.n_parameters :].copy()

    def moved_to(self, linear: Linearisation) -> Reference:
        """The same expectations about another linearisation."""
        linear.limits[:] = self.linear.limits
        return replace(self, linear=linear, begun=None)

    # ----------------------------------------------------------------- reading frames

    def read(
        self,
        frames: Sequence[NDArray[Any]],
        mapping: Callable[[Callable[[int], None], Iterable[int]], Iterable[None]] = map,
    ) -> Reading:
        """Estimate frames; `mapping` may work on several at a time."""
        steps = np.zeros((len(frames), self.linear.n_steps))
        statistics = np.zeros((len(frames), kernels.N_STATISTICS))

        def one(k: int) -> None:
            self.linear.estimate(frames[k], steps[k], statistics[k])

        for _ in mapping(one, range(len(frames))):
            pass
        return Reading(steps, statistics)

    def fits(self, reading: Reading) -> NDArray[np.bool_]:
        """Which frames are explained: nothing moved far, nothing in the way, the same light."""
        return self.usable(reading) & self.explains(reading)

    def explains(self, reading: Reading) -> NDArray[np.bool_]:
        """Which frames the model describes, wherever the mask is."""
        linear, statistics = self.linear, reading.statistics.T
        ratio = reading.chi2_ratio
        bent = statistics[kernels.POSE_ENERGY] / linear.ndf * self.motion(reading) ** 2
        allowed = (
            _CHI2_SIGMAS * np.sqrt(2 / linear.ndf) * self.chi2_ratio
            + _MISFIT_DRIFT * abs(self.chi2_ratio - 1)
            + _CURVATURE * bent
        )
        extra = reading.steps[:, linear.n_parameters :] - self.surprise
        surprise = (extra**2).sum(axis=1)
        good: NDArray[np.bool_] = (
            (np.abs(ratio - self.chi2_ratio) < allowed)
            & (statistics[kernels.WORST_TILE] < 1 + bent)
            & (surprise < _SURPRISE * max(1.0, self.chi2_ratio))
        )
        return good

    def motion(self, reading: Reading) -> NDArray[np.float64]:
        """Largest motion of the mask over the image, in widths of an edge."""
        motion: NDArray[np.float64] = (
            reading.statistics[:, kernels.MOTION] / self.linear.edge_width_fields
        )
        return motion

    def usable(self, reading: Reading) -> NDArray[np.bool_]:
        """Which frames are near enough for what the reference says of them."""
        return (self.motion(reading) < USABLE) & ~self.light_changed(reading)

    def near(self, reading: Reading) -> NDArray[np.bool_]:
        """Which frames are so near that no new reference is wanted."""
        shape = POSE_SIZE[self.linear.settings.model] + 12
        variance = self.linear.state.appearance.blur_um**2
        light = np.abs(reading.statistics[:, kernels.CONTRAST] - 1)
        near: NDArray[np.bool_] = (
            (self.motion(reading) < NEAR)
            & (light < _LIGHT_NEAR)
            & (np.abs(reading.steps[:, shape]) < 2 * _BLUR_NEAR * variance)
        )
        return near

    def light_changed(self, reading: Reading) -> NDArray[np.bool_]:
        changed: NDArray[np.bool_] = ~(
            np.abs(reading.statistics[:, kernels.CONTRAST] - 1) < LIGHT_USABLE
        )
        return changed

    def learn(self, reading: Reading) -> None:
        """Follow slow changes of the misfit with frames that were believed."""
        ratio = reading.chi2_ratio
        share = 1 - (1 - 1 / _AVERAGED) ** len(ratio)
        self.chi2_ratio += share * (float(ratio.mean()) - self.chi2_ratio)

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

    def _noise_factor(self, reading: Reading) -> NDArray[np.float64]:
        """Growth of the uncertainty with the light: noise over contrast."""
        statistics = reading.statistics.T
        variance = statistics[kernels.EXPECTED] / max(self.linear.n_pixels, 1)
        factor: NDArray[np.float64] = np.sqrt(np.maximum(variance, 0.0)) / np.maximum(
            statistics[kernels.CONTRAST], 1e-9
        )
        return factor

    def columns(self, reading: Reading) -> dict[str, NDArray[Any] | float]:
        """The columns of a track for frames that fit."""
        x, y, log_scale, theta = self.vector
        steps = reading.steps.T
        light = POSE_SIZE[self.linear.settings.model]
        appearance = self.linear.state.appearance
        factor = self._noise_factor(reading)
        sigma = np.sqrt(np.diag(self._covariance)) * self.growth
        return {
            "x_um": x + steps[0],
            "y_um": y + steps[1],
            "scale": np.exp(log_scale + steps[2]),
            "theta_rad": np.pi - (np.pi - theta - steps[3]) % (2 * np.pi),
            "sigma_x_um": sigma[0] * factor,
            "sigma_y_um": sigma[1] * factor,
            "sigma_scale": sigma[2] * factor,
            "sigma_theta_rad": sigma[3] * factor,
            "chi2_ndf": self._chi2_ndf(reading),
            "blur_um": np.sqrt(np.maximum(appearance.blur_um**2 + steps[light + 12], 0.0)),
            "dark_level": appearance.dark[0] + steps[light],
            "light_level": appearance.light[0] + steps[light + 6],
        }

    def _chi2_ndf(self, reading: Reading) -> NDArray[np.float64]:
        statistics = reading.statistics.T
        degrees = statistics[kernels.EXPECTED] * self.linear.ndf / max(self.linear.n_pixels, 1)
        ratio: NDArray[np.float64] = statistics[kernels.CHI2] / np.maximum(degrees, 1.0)
        return ratio

    def pose(self, reading: Reading, flags: Flag = Flag.NONE) -> Pose:
        """The pose in one frame that fits."""
        step = reading.steps[0]
        state = self.linear.stepped(step)
        x, y, log_scale, theta = self.vector + step[:4]
        growth = self.growth * self._noise_factor(reading)[0]
        appearance = state.appearance
        return Pose(
            ok=True,
            x_um=float(x),
            y_um=float(y),
            scale=float(np.exp(log_scale)),
            theta_rad=wrap_angle(theta),
            orientation=self.origin.orientation,
            covariance=self._covariance * growth * growth[:, None],
            chi2_ndf=float(self._chi2_ndf(reading)[0]),
            blur_um=appearance.blur_um,
            dark_level=float(appearance.dark[0]),
            light_level=float(appearance.light[0]),
            edge_shift_um=appearance.edge_shift_um,
            polarity=self.origin.polarity,
            code_lines_read=self.origin.code_lines_read,
            code_lines_in_view=self.origin.code_lines_in_view,
            masked_fraction=1 - self.linear.n_pixels / self.linear.level.size,
            flags=self.flags | flags,
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


def build(settings: Settings, state: State) -> Linearisation:
    """A linearisation made in one go."""
    builder = Builder(settings, state)
    builder.advance()
    return builder.finish()


def model_of(pose: Pose) -> Model:
    assert pose.model in POSE_SIZE
    return pose.model


def _vector_of(state: State, orientation: int) -> NDArray[np.float64]:
    """(x, y, ln S, theta) of a state, shape (4,)."""
    scale, theta, _ = state.projection.similarity(orientation)
    return np.array([state.projection.x_um, state.projection.y_um, np.log(scale), theta])
