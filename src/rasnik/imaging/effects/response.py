"""How the pixels answer to light: cross-talk, gain, pedestal, flicker, dead and hot ones.

All of them act on the pixels of the image that is handed out; where the sensor bins, on its
superpixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from rasnik.imaging.effects.base import Context, Effect, Image, check_range, effect

__all__ = ["CrossTalk", "DeadPixels", "Flicker", "GainSpread", "HotPixels", "PedestalSpread"]

_PAPER = "section 3, Pixel response: slope and pedestal, pixel cross talk"

#: Time scales of flicker, each twice the one before; the longest is a million frames.
FLICKER_OCTAVES = 20


@effect(
    "cross_talk",
    "a pixel gives this part of its signal to each of its four neighbours",
    unit="",
    stage="response",
    reference=_PAPER,
)
@dataclass(frozen=True)
class CrossTalk(Effect):
    """Beyond the edge of the image the sensor continues as it is at the edge."""

    share: float = 0.005

    def __post_init__(self) -> None:
        check_range("cross_talk", self.share, 0, 0.25)

    def respond(self, levels: Image, context: Context) -> Image:
        spread = [self.share, -2 * self.share, self.share]
        along, across = (correlate1d(levels, spread, axis=axis, mode="nearest") for axis in (0, 1))
        return np.asarray(levels + along + across)


@effect(
    "gain_spread",
    "the slope of the response differs from pixel to pixel, Gaussian",
    unit="rms, relative",
    stage="response",
    reference=_PAPER,
)
@dataclass(frozen=True)
class GainSpread(Effect):
    rms: float = 0.01

    def __post_init__(self) -> None:
        check_range("gain_spread", self.rms, 0, 1)

    def respond(self, levels: Image, context: Context) -> Image:
        return levels * (1 + self.rms * context.rng("gain_spread").standard_normal(levels.shape))


@effect(
    "pedestal_spread",
    "the level without light differs from pixel to pixel, Gaussian",
    unit="grey rms",
    stage="response",
    reference=_PAPER,
)
@dataclass(frozen=True)
class PedestalSpread(Effect):
    rms_grey: float = 0.5

    def __post_init__(self) -> None:
        check_range("pedestal_spread", self.rms_grey, 0)

    def respond(self, levels: Image, context: Context) -> Image:
        spread = context.rng("pedestal_spread").standard_normal(levels.shape)
        return levels + self.rms_grey * spread


@effect(
    "flicker",
    "the slope of each pixel's response wanders with a spectrum 1/f; rms in a decade of it",
    unit="rms per decade, relative",
    stage="response",
    reference="section 3, Pixel Flicker noise",
)
@dataclass(frozen=True)
class Flicker(Effect):
    """Sum of random steps on time scales of 1, 2, 4, ... frames, each of the same variance.

    The one-sided power spectrum is ``rms^2 / (ln 10 f)`` from the inverse of a million frames
    to about half the frame rate.
    """

    rms: float = 1e-3

    def __post_init__(self) -> None:
        check_range("flicker", self.rms, 0, 1)

    def gain(self, k: int, context: Context) -> NDArray[np.floating[Any]]:
        total = np.ones(context.shape, np.float32)
        octave_rms = np.float32(self.rms * np.sqrt(np.log10(2)))
        for octave in range(FLICKER_OCTAVES):
            total += octave_rms * self._level(octave, k, context)
        return total

    @staticmethod
    def _level(octave: int, k: int, context: Context) -> NDArray[np.float32]:
        """The value of one time scale, held for 2**octave frames from a random beginning."""
        begin = context.cache.get(("flicker", octave))
        if begin is None:
            begin = int(context.rng("flicker begin", octave).integers(2**octave))
            context.cache["flicker", octave] = begin
        block = (k + begin) >> octave
        kept = context.cache.get(("flicker map", octave))
        if kept is None or kept[0] != block:
            rng = context.rng("flicker", octave, block)
            kept = block, rng.standard_normal(context.shape, dtype=np.float32)
            context.cache["flicker map", octave] = kept
        return np.asarray(kept[1])


def _chosen(context: Context, name: str, share: float) -> NDArray[np.bool_]:
    return np.asarray(context.rng(name).random(context.shape) < share)


@effect(
    "dead_pixels",
    "this part of the pixels sees no light",
    unit="",
    stage="response",
    reference="not in the paper; data sheets of sensors",
)
@dataclass(frozen=True)
class DeadPixels(Effect):
    share: float = 1e-4

    def __post_init__(self) -> None:
        check_range("dead_pixels", self.share, 0, 1)

    def respond(self, levels: Image, context: Context) -> Image:
        return np.where(_chosen(context, "dead_pixels", self.share), 0.0, levels)


@effect(
    "hot_pixels",
    "this part of the pixels stands at full scale",
    unit="",
    stage="response",
    reference="not in the paper; data sheets of sensors",
)
@dataclass(frozen=True)
class HotPixels(Effect):
    share: float = 1e-4

    def __post_init__(self) -> None:
        check_range("hot_pixels", self.share, 0, 1)

    def respond(self, levels: Image, context: Context) -> Image:
        full = float(context.system.full_scale)
        return np.where(_chosen(context, "hot_pixels", self.share), full, levels)
