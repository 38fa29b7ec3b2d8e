"""The fluctuation of pixels against their content, measured back from simulated images."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from rasnik.characterisation.photon_transfer import PhotonTransfer, photon_transfer
from rasnik.imaging.montecarlo import exact_image
from rasnik.imaging.projection import Projection
from rasnik.paper.images import POSITION_UM, noisy, solidras, stream
from rasnik.paper.outcome import BLACK, BLUE, VERMILION, Effort, Outcome, Row, Value, new_figure

__all__ = ["pixel_noise"]

_A, _B = 0.26, 0.011
_SELECTED = 240  # pixels drawn singly, as the paper does


def pixel_noise(effort: Effort) -> Outcome:
    """Fig. 4: variance = A + B Q, from 256 images of a still scene."""
    count = effort.pick(64, 256)
    system = solidras()
    expected = exact_image(system, Projection.from_pose(*POSITION_UM, 1.0, 0.002, 4))
    frames = noisy(expected, system, count, stream(effort.seed, 4))
    found = photon_transfer(frames, full_scale=float(system.full_scale))
    law = found.law
    why = (
        f"Fitted to {count} simulated 8-bit images made with the paper's A and B, by the "
        "photon-transfer analysis of `rasnik noise` (neither of the two methods of position); the "
        "variance 1/12 of rounding is taken off. The paper does not say whether its A, measured "
        "on 8-bit images, contains it."
    )
    rows = (
        Row("pixel fluctuations, A", "grey²", "0.26", None, Value(law.A, law.sigma_A), None, why),
        Row("pixel fluctuations, B", "grey", "0.011", None, Value(law.B, law.sigma_B), None, why),
    )
    caption = (
        f"Fluctuation of pixels in {count} simulated images of a still scene against their mean "
        f"content: {_SELECTED} single pixels, means over many, and the fitted law "
        f"σ² = {law.A:.3f} + {law.B:.5f} Q (+ 1/12 by rounding) beside the paper's."
    )
    data = found.as_dict() | {"simulated": {"A": _A, "B": _B}, "bins": found.bins}
    return Outcome("Fig. 4", "Pixel fluctuations", caption, _draw(found, effort.seed), rows, data)


def _draw(found: PhotonTransfer, seed: int) -> Figure:
    figure = new_figure(8.5, 4.6)
    axes = figure.subplots()
    rng = stream(seed, 5)
    # Pixels evenly over the grey levels, else nearly all would be black or white.
    level, variance = found.noise.mean[found.used], found.noise.variance[found.used]
    target = rng.uniform(level.min(), level.max(), _SELECTED)
    order = np.argsort(level)
    chosen = order[np.clip(np.searchsorted(level[order], target), 0, len(order) - 1)]
    axes.plot(level[chosen], np.sqrt(variance[chosen]), ".", color="#9aa5b1", label="single pixels")
    mean, var, sigma, _ = found.bins.T
    axes.errorbar(
        mean, np.sqrt(var), sigma / (2 * np.sqrt(var)), fmt="o", color=BLUE, markersize=5,
        label="means over pixels",
    )  # fmt: skip
    q = np.linspace(0, 255, 200)
    axes.plot(q, np.sqrt(found.law.measured(q)), color=BLACK, label="fit, rounding included")
    axes.plot(
        q, np.sqrt(_A + _B * q), color=VERMILION, linestyle="--",
        label="paper: √(0.26 + 0.011 Q)",
    )  # fmt: skip
    axes.set_xlabel("mean pixel content Q, grey levels")
    axes.set_ylabel("fluctuation σ, grey levels")
    axes.set_xlim(0, 260)
    axes.set_ylim(0, None)
    axes.grid(color="#e4e4e4")
    axes.set_axisbelow(True)
    axes.legend(frameon=False)
    return figure
