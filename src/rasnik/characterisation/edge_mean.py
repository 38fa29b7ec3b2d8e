"""The mean of the edges of several images of one scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rasnik.characterisation.edge_contours import N_KINDS
from rasnik.characterisation.edge_misfit import Cause
from rasnik.characterisation.edge_transfer import Transfer
from rasnik.characterisation.edges import CURVES, NUMBERS, EdgeProfile, Edges, Estimate
from rasnik.characterisation.focus import BlurMap

__all__ = ["mean_edges"]

Array = NDArray[np.float64]


def mean_edges(several: Sequence[Edges]) -> Edges:
    """Mean over images of one scene, each with the same weight.

    The map of the blur and the causes of misfit are means as well; errors are those of the
    mean, the images taken as independent. Errors of the mask's contours are not: they are the
    same in images of one place.

    Raises
    ------
    ValueError
        If there is no image, or their pixels differ.
    """
    if not several:
        raise ValueError("there are no images to average")
    first = several[0]
    if len(several) == 1:
        return first
    if any(one.pixel_um != first.pixel_um for one in several):
        raise ValueError("the images have different pixels and cannot be averaged")
    numbers = {name: _mean_estimate([one.numbers[name] for one in several]) for name in NUMBERS}
    return Edges(
        images=len(several),
        pixel_um=first.pixel_um,
        scale=float(np.mean([one.scale for one in several])),
        profiles=tuple(
            _mean_profile([one.profiles[kind] for one in several]) for kind in range(N_KINDS)
        ),
        **numbers,
        transfer=(
            _mean_transfer([one.transfer[0] for one in several]),
            _mean_transfer([one.transfer[1] for one in several]),
        ),
        blur_map=_mean_map([one.blur_map for one in several]),
        causes=tuple(
            Cause(
                one.name,
                one.parameters,
                float(np.mean([each.causes[k].chi2_ndf for each in several])),
                float(np.mean([each.causes[k].rms for each in several])),
            )
            for k, one in enumerate(first.causes)
        ),
        chi2_ndf=float(np.mean([one.chi2_ndf for one in several])),
        levelled=float(np.mean([one.levelled for one in several])),
        noise_known=all(one.noise_known for one in several),
    )


def _mean_estimate(several: Sequence[Estimate]) -> Estimate:
    values, sigmas = np.array(several).T
    return Estimate(float(values.mean()), float(np.sqrt(np.sum(sigmas**2))) / len(values))


def _mean_arrays(several: Sequence[Any], values: str, sigmas: str) -> tuple[Array, Array]:
    value = np.mean([getattr(one, values) for one in several], axis=0)
    sigma = np.sqrt(np.sum([getattr(one, sigmas) ** 2 for one in several], axis=0)) / len(several)
    return value, sigma


def _mean_profile(several: Sequence[EdgeProfile]) -> EdgeProfile:
    length = min(len(one.distance_um) for one in several)

    def cut(one: EdgeProfile) -> EdgeProfile:
        inner = slice((len(one.distance_um) - length) // 2, (len(one.distance_um) + length) // 2)
        return replace(one, **{name: getattr(one, name)[inner] for name in CURVES})

    several = [cut(one) for one in several]
    value, sigma = _mean_arrays(several, "value", "sigma")
    binned, binned_sigma = _mean_arrays(several, "binned", "binned_sigma")
    line, line_sigma = _mean_arrays(several, "line", "line_sigma")
    return EdgeProfile(
        name=several[0].name,
        distance_um=several[0].distance_um,
        value=value,
        sigma=sigma,
        binned=binned,
        binned_sigma=binned_sigma,
        model=np.mean([one.model for one in several], axis=0),
        line=line,
        line_sigma=line_sigma,
        shift_um=_mean_estimate([one.shift_um for one in several]),
        blur_um=_mean_estimate([one.blur_um for one in several]),
        kurtosis=_mean_estimate([one.kurtosis for one in several]),
    )


def _mean_transfer(several: Sequence[Transfer]) -> Transfer:
    total, sigma = _mean_arrays(several, "total", "total_sigma")
    return Transfer(
        several[0].frequency_per_um,
        total,
        sigma,
        np.mean([one.pixel for one in several], axis=0),
        np.mean([one.model for one in several], axis=0),
        several[0].diffraction,
    )


def _mean_map(several: Sequence[BlurMap]) -> BlurMap:
    blur, sigma = _mean_arrays(several, "blur_um", "sigma_um")
    return BlurMap(
        several[0].u_um,
        several[0].v_um,
        blur,
        sigma,
        np.mean([one.plane for one in several], axis=0),
        float(np.mean([one.chi2_ndf for one in several])),
        float(np.mean([one.chi2_even for one in several])),
    )
