"""The noise of a sensor from frames of a still scene: the photon-transfer curve.

The variance of a pixel grows with its grey level Q as A + B Q: electronic noise A, and shot
noise with B the grey level of one electron. As everywhere in the package A is the noise before
rounding; rounding to whole grey levels adds 1/12, which is measured with it and taken off.

Sources: van der Graaf et al., section 3 "Quantum fluctuations: shot noise"; J. R. Janesick,
"Photon Transfer" (2007), chapters 5 to 7; EMVA Standard 1288 for the names of the quantities.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.noise_law import (
    BINS,
    LEAST_IN_BIN,
    NoiseLaw,
    bend_level,
    binned,
    curvature,
    fit_law,
    robust_law,
    rough_law,
)
from rasnik.characterisation.pixel_map import (
    Defect,
    FixedPattern,
    fixed_pattern,
    has_scene,
    slope_of,
    value_defects,
)
from rasnik.characterisation.temporal_noise import StillSceneError, TemporalNoise, temporal_noise

__all__ = ["NoiseLaw", "PhotonTransfer", "StillSceneError", "fit_law", "photon_transfer"]

Image = NDArray[np.float64]

_CLIP_SIGMAS = 4.0  # a pixel whose fluctuations reach the end of the range is not used
# Below this variance, in units of the squared step, rounding adds no longer 1/12: the noise is
# too small to smear the steps. At 0.2 it differs by up to 3 % of the variance, at 0.3 by 0.5 %.
_SMEARED = 0.25
_STILL_PX, _MOVING_PX = 0.3, 1.0  # range of the motion: warned above the first, refused above
_EDGE_WARNED, _EDGE_REFUSED = 0.03, 1.0  # relative excess of the variance where it is steep
_CHI2_WARNED, _CHI2_REFUSED = 1.5, 20.0
_SURE = 4.0  # standard deviations


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """How a sensor fluctuates; see `photon_transfer`.

    Attributes
    ----------
    law : NoiseLaw
        Of the image handed out (after binning).
    curvature, sigma_curvature : float
        C of variance = A + B Q + C Q^2, 1: zero for a linear sensor.
    full_scale : float or None
        Highest grey level of the format; None if not known.
    saturation_level : float or None
        Level at which the grey levels end; None if no pixel reached it.
    bend_level : float or None
        Level from which on the variance falls behind the law, as a full well makes it.
    bins : ndarray, shape (n, 4)
        Mean level, mean variance with rounding, its standard deviation by chance, pixels.
    noise : TemporalNoise
        Maps of mean and variance, and motion and light of the frames.
    used : ndarray of bool, shape (H, W)
        Pixels in the fit.
    fixed : FixedPattern
    defects : tuple of Defect
    edge_excess, sigma_edge_excess : float
        Relative excess of the variance on the steepest pixels: what motion has left. NaN where
        no part of the scene is steep.
    warnings : tuple of str
    """

    law: NoiseLaw
    curvature: float
    sigma_curvature: float
    full_scale: float | None
    saturation_level: float | None
    bend_level: float | None
    bins: Image
    noise: TemporalNoise
    used: NDArray[np.bool_]
    fixed: FixedPattern
    defects: tuple[Defect, ...]
    edge_excess: float
    sigma_edge_excess: float
    warnings: tuple[str, ...]

    @property
    def electrons_per_grey(self) -> tuple[float, float]:
        """Electrons per grey level, 1 / B, and its standard deviation; NaN without shot noise."""
        B = self.law.B
        return (1 / B, self.law.sigma_B / B**2) if B > 0 else (math.nan, math.nan)

    @property
    def full_well_e(self) -> tuple[float, float]:
        """Electrons at the saturation level, or at full scale if nothing saturates; its sigma."""
        ends = (self.bend_level, self.saturation_level, self.full_scale)
        level = next((end for end in ends if end is not None), math.nan)
        value, sigma = self.electrons_per_grey
        return value * level, sigma * level

    @property
    def drift_px(self) -> tuple[float, float]:
        """Range of the scene's motion in x and y, pixels."""
        return float(np.ptp(self.noise.x_px)), float(np.ptp(self.noise.y_px))

    @property
    def flicker(self) -> float:
        """Standard deviation of the light from frame to frame, relative."""
        return float(self.noise.light.std(ddof=1))

    def as_dict(self) -> dict[str, Any]:
        """Everything but the maps, for JSON; NaN becomes None."""
        law, noise = self.law, self.noise
        left, right = (float(f(noise.mean[self.used])) for f in (np.min, np.max))
        content: dict[str, Any] = {
            "A": law.A,
            "sigma_A": law.sigma_A,
            "B": law.B,
            "sigma_B": law.sigma_B,
            "covariance_AB": float(law.covariance[0, 1]),
            "chi2_ndf": law.chi2_ndf,
            "rounding_variance": law.rounding,
            "A_with_rounding": law.A + law.rounding,
            "electrons_per_grey": self.electrons_per_grey[0],
            "sigma_electrons_per_grey": self.electrons_per_grey[1],
            "read_noise_e": math.sqrt(max(law.A, 0.0)) * self.electrons_per_grey[0],
            "full_well_e": self.full_well_e[0],
            "sigma_full_well_e": self.full_well_e[1],
            "full_scale": self.full_scale,
            "saturation_level": self.saturation_level,
            "bend_level": self.bend_level,
            "curvature": self.curvature,
            "sigma_curvature": self.sigma_curvature,
            "level_min": left,
            "level_max": right,
            "frames": noise.frames,
            "frames_left_out": noise.left_out,
            "frames_repeated": noise.repeated,
            "height_px": noise.mean.shape[0],
            "width_px": noise.mean.shape[1],
            "pixels_used": int(self.used.sum()),
            "flicker": self.flicker,
            "drift_x_px": self.drift_px[0],
            "drift_y_px": self.drift_px[1],
            "edge_excess": self.edge_excess,
            "sigma_edge_excess": self.sigma_edge_excess,
            "row_variance": noise.row_variance[0],
            "sigma_row_variance": noise.row_variance[1],
            "column_variance": noise.column_variance[0],
            "sigma_column_variance": noise.column_variance[1],
            **self.fixed.as_dict(),
            "defects": [defect.as_dict() for defect in self.defects],
            "warnings": list(self.warnings),
        }
        return {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in content.items()
        }


def photon_transfer(
    frames: Iterable[NDArray[Any]], *, full_scale: float | None = None
) -> PhotonTransfer:
    """Noise law, full well, fixed pattern and defects from frames of a still scene.

    Parameters
    ----------
    frames : iterable of ndarray, shape (H, W)
        At least 10 successive frames, better 100 or more, read once and not kept. Any scene
        with dark and bright parts will do, a mask for one. It may drift by some tenths of a
        pixel, and its light may flicker.
    full_scale : float, optional
        Highest grey level the format can hold. By default that of the least of 8, 10, 12, 14
        or 16 bits that holds all grey levels seen.

    Returns
    -------
    PhotonTransfer

    Raises
    ------
    StillSceneError
        If the scene moves, there are too few frames, or no pixel can be used.
    """
    noise = temporal_noise(frames)
    step, full_scale, saturation = _levels(noise, full_scale)
    _refuse_motion(noise)
    rounding = step**2 / 12
    valid = np.isfinite(noise.variance)
    if not valid.any() or not (noise.variance[valid] > 0).any():
        raise StillSceneError("no pixel fluctuates; are these copies of one image?")
    usable = valid & _within_range(noise, full_scale, saturation, rounding)
    if np.count_nonzero(usable) < 2 * LEAST_IN_BIN:
        raise StillSceneError(
            "nearly all pixels are at the ends of the range of grey levels; choose an exposure "
            "at which the bright parts stay below saturation"
        )
    usable, quiet_share = _without_quiet(noise, usable, step)
    law, used, odd = robust_law(noise, usable, rounding)
    bins = binned(noise, used, law)
    bend = bend_level(bins)
    if bend is not None:
        law, used, odd = robust_law(noise, usable & (noise.mean < bend), rounding)
    bending = curvature(noise, used, law)
    excess, sigma_excess = _edge_excess(noise, used, law)
    defects = (*odd, *value_defects(noise))
    found = PhotonTransfer(
        law,
        *bending,
        full_scale,
        saturation,
        bend,
        binned(noise, used | (usable & (noise.mean >= (bend or math.inf))), law),
        noise,
        used,
        fixed_pattern(noise, _whole(noise, saturation, odd), law.measured),
        defects,
        excess,
        sigma_excess,
        (),
    )
    return _with_warnings(found, quiet_share, step)


def _with_warnings(found: PhotonTransfer, quiet_share: float, step: float) -> PhotonTransfer:
    """The result with its warnings; refused if the scene moved after all."""
    law, words = found.law, []
    edge, sigma = found.edge_excess, found.sigma_edge_excess
    moving = edge > _EDGE_REFUSED and edge > _SURE * sigma
    if moving or law.chi2_ndf > _CHI2_REFUSED:
        raise StillSceneError(
            "the pixels change by far more than their noise, most of all where the scene is "
            "steep: it moves; record a scene that stands still to a fraction of a pixel"
        )
    if max(found.drift_px) > _STILL_PX:
        x, y = found.drift_px
        words.append(
            f"the scene moved by {x:.2g} pixels in x and {y:.2g} in y; motion up to "
            f"{_STILL_PX:g} pixels is taken out well, more only in part"
        )
    if edge > _EDGE_WARNED and edge > _SURE * sigma:
        words.append(
            f"where the scene is steep the variance is {100 * edge:.0f} % too large: some motion "
            "is left in it, and A and B are too large by a part of that"
        )
    if law.chi2_ndf > _CHI2_WARNED:
        words.append(
            f"the pixels scatter about the law {math.sqrt(law.chi2_ndf):.1f} times as much as "
            "chance makes them; the errors of A and B are enlarged by that"
        )
    if law.B <= 2 * law.sigma_B:
        words.append(
            "no shot noise is seen: the scene has too few grey levels, or the frames too few; "
            "B and what follows from it mean nothing"
        )
    if law.A < -2 * law.sigma_A:
        words.append(
            "A is negative: the grey levels have an offset, or were changed after the "
            "read-out (compressed, smoothed, gamma)"
        )
    if quiet_share > 0:
        words.append(
            f"{100 * quiet_share:.2g} % of the pixels fluctuate less than the steps of the grey "
            "levels and are not used; record with more bits"
        )
    if step == 0:
        words.append(
            "the grey levels are no whole numbers: no rounding is taken off, and what was "
            "averaged or converted does not show the noise of the sensor"
        )
    if found.bend_level is not None:
        words.append(
            f"from grey level {found.bend_level:.0f} on the variance falls behind the law: the "
            "wells are full there"
        )
    if found.noise.left_out:
        words.append(f"{found.noise.left_out} frames of other light or another scene are left out")
    if found.noise.repeated:
        words.append(f"{found.noise.repeated} frames equal the one before and are left out")
    return PhotonTransfer(**{**found.__dict__, "warnings": tuple(words)})


# ---------------------------------------------------------------- range and rounding


def _levels(
    noise: TemporalNoise, full_scale: float | None
) -> tuple[float, float | None, float | None]:
    """(step of the grey levels, full scale, level of saturation); step 0 if not rounded."""
    if noise.counts is None:
        return 0.0, full_scale, None
    seen = np.flatnonzero(noise.counts)
    step = float(np.gcd.reduce(np.diff(seen))) if len(seen) > 1 else 1.0
    top = int(seen[-1])
    if full_scale is None:
        # Fewer bits may be stored at the upper end of more: 4095 * 16 in 16 bits.
        fits = (2**bits - 1 for bits in (8, 10, 12, 14, 16))
        full_scale = float(next(end for end in fits if top <= end))
        full_scale -= full_scale % step
    counts = noise.counts[seen]
    if top >= full_scale:
        return step, full_scale, float(full_scale)
    # Levels that end at a step instead of a tail are cut off before the end of the format.
    heaped = len(counts) > 3 and counts[-1] > 2 * counts[-4:-1].max()
    heaped = heaped and counts[-1] > 1e-4 * counts.sum()
    return step, full_scale, float(top) if heaped else None


def _within_range(
    noise: TemporalNoise, full_scale: float | None, saturation: float | None, rounding: float
) -> NDArray[np.bool_]:
    """Pixels whose fluctuations stay within the grey levels, by their expected levels alone.

    To choose by the values seen would favour pixels that happened to fluctuate little.
    """
    end = saturation if saturation is not None else full_scale
    bottom = 0.0 if noise.counts is not None else -math.inf
    if end is None and math.isinf(bottom):
        return np.ones(noise.mean.shape, bool)
    top = math.inf if end is None else end
    # What fluctuation to expect is read from the pixels that are well inside.
    room = 0.03 * (top - bottom) if math.isfinite(top - bottom) else 0.0
    inside = np.isfinite(noise.variance) & (noise.lowest > bottom) & (noise.highest < top - room)
    if np.count_nonzero(inside) < 2 * LEAST_IN_BIN:
        return np.zeros(noise.mean.shape, bool)
    law = rough_law(noise, inside, rounding)
    low, high = (
        _CLIP_SIGMAS * np.sqrt(np.maximum(law.measured(level), rounding))
        for level in (noise.lowest, noise.highest)
    )
    return np.asarray((noise.lowest - low >= bottom) & (noise.highest + high <= top))


def _whole(
    noise: TemporalNoise, saturation: float | None, odd: tuple[Defect, ...]
) -> NDArray[np.bool_]:
    """Pixels whose mean is right: those whose fluctuations alone are cut off still count."""
    whole = np.isfinite(noise.variance) & (noise.variance > 0)
    if saturation is not None:
        whole &= noise.highest < saturation
    for defect in odd:
        whole[defect.row, defect.column] = False
    return whole


def _without_quiet(
    noise: TemporalNoise, usable: NDArray[np.bool_], step: float
) -> tuple[NDArray[np.bool_], float]:
    """Without the levels at which the noise does not smear the steps, and their share."""
    if step == 0:
        return usable, 0.0
    bins = binned(noise, usable, None)
    loud = bins[bins[:, 1] > (_SMEARED + 1 / 12) * step**2]
    if len(loud) == len(bins):
        return usable, 0.0
    if len(loud) < 2:
        raise StillSceneError(
            "the noise is smaller than the steps of the grey levels; record with more bits"
        )
    kept = usable & (noise.mean >= loud[:, 0].min() - 0.5 * np.ptp(bins[:, 0]) / BINS)
    return kept, 1 - float(kept.sum() / usable.sum())


def _refuse_motion(noise: TemporalNoise) -> None:
    x, y = float(np.ptp(noise.x_px)), float(np.ptp(noise.y_px))
    if has_scene(noise.mean) and max(x, y) > _MOVING_PX:
        raise StillSceneError(
            f"the scene moves: by about {x:.2g} pixels in x and {y:.2g} in y over the frames; "
            f"noise is measured on a scene that stays within {_MOVING_PX:g} pixel"
        )


def _edge_excess(
    noise: TemporalNoise, used: NDArray[np.bool_], law: NoiseLaw
) -> tuple[float, float]:
    """Relative excess of the variance on steep pixels over that on the others."""
    steep = used & slope_of(noise.mean, noise.variance, noise.frames)
    calm = used & ~steep
    if min(steep.sum(), calm.sum()) < LEAST_IN_BIN:
        return math.nan, math.nan
    ratio = noise.variance / law.measured(noise.mean)
    excess = float(ratio[steep].mean() / ratio[calm].mean() - 1)
    sigma = math.hypot(*(ratio[part].std() / math.sqrt(part.sum()) for part in (steep, calm)))
    return excess, sigma
