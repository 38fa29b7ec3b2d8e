"""Figures of the paper that are images: pattern, blur, noise, and SolidRas with its dust."""

from __future__ import annotations

import numpy as np
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from rasnik.imaging.noise import add_noise
from rasnik.imaging.paper import paper_image
from rasnik.imaging.projection import Projection
from rasnik.imaging.simulate import simulate
from rasnik.instrument import System, load_system
from rasnik.paper.images import POSITION_UM, show_image, solidras
from rasnik.paper.outcome import VERMILION, Effort, Outcome, new_figure

__all__ = ["blur", "chessfield", "exaggerated_noise", "solidras_image"]

_SMALL = {"width_px": 120, "height_px": 90}
_THETA_RAD = 0.002


def _expected(system: System, theta_rad: float = _THETA_RAD) -> NDArray[np.float64]:
    """The image by the paper's generator, without noise."""
    place = Projection.from_pose(*POSITION_UM, system.optics.scale, theta_rad, 4)
    return paper_image(system, place)


def chessfield(effort: Effort) -> Outcome:
    """Fig. 3: the coded chessboard, and grey pixels where contours cross them."""
    system = solidras()
    mask = system.mask
    i, j = (int(value // mask.field_um) for value in POSITION_UM)
    size = 28
    fields = mask.fields(i - size, i + size, j - size, j + size)
    sharp = load_system(solidras(**_SMALL), {"optics.blur_um": 0})
    pixels = _expected(sharp, 0.05)[30:60, 40:70]
    figure = new_figure(9, 4.6)
    left, right = figure.subplots(1, 2)
    extent = (i - size, i + size, j - size, j + size)
    left.imshow(fields, cmap="gray", origin="lower", extent=extent, interpolation="nearest")
    left.set_xlabel("field along X")
    left.set_ylabel("field along Y")
    left.set_title("pattern: every ninth row and column is code")
    for along in range(extent[0], extent[1]):
        if along % mask.period == 0:
            left.axvspan(along, along + 1, color=VERMILION, alpha=0.25, linewidth=0)
    for along in range(extent[2], extent[3]):
        if along % mask.period == 0:
            left.axhspan(along, along + 1, color=VERMILION, alpha=0.25, linewidth=0)
    show_image(right, pixels, "contours cross pixels: grey values, no blur")
    grey = float(np.mean((pixels > 30) & (pixels < 247)))
    caption = (
        "Left: the ChessField pattern around the place of the paper's simulations; the tinted "
        "rows and columns hold the code. Right: the same pattern turned by 50 mrad as pixels of "
        "6.9 µm see it without any blur, each filled by 10 x 10 points."
    )
    data = {"code_of_view": mask.code_at(*POSITION_UM), "grey_pixels_share": grey}
    return Outcome("Fig. 3", "ChessField pattern and grey pixels", caption, figure, (), data)


def blur(effort: Effort) -> Outcome:
    """Fig. 5: two widths of the blur."""
    widths = (6.0, 12.0)
    figure = new_figure(9, 3.9)
    contrast = {}
    for axes, width in zip(figure.subplots(1, 2), widths, strict=True):
        system = load_system(solidras(**_SMALL), {"optics.blur_um": width})
        image = add_noise(_expected(system), system, effort.seed)
        show_image(axes, image, f"blur σ = {width:.1f} µm")
        dark, light = np.percentile(image, (5, 95))
        contrast[f"{width:g}"] = float((light - dark) / (light + dark))
    caption = (
        "The paper's generator with its two widths of the Gaussian blur; 120 x 90 pixels of the "
        "SolidRas image with its noise."
    )
    data = {"contrast_5_to_95_percent": contrast}
    return Outcome("Fig. 5", "Image blurring", caption, figure, (), data)


def exaggerated_noise(effort: Effort) -> Outcome:
    """Fig. 6: the shot noise made visible."""
    factor = 12.0
    system = solidras(**_SMALL)
    louder = load_system(
        system,
        {
            "sensor.noise_a": (system.sensor.noise_a or 0) * factor**2,
            "sensor.noise_b": (system.sensor.noise_b or 0) * factor**2,
        },
    )
    expected = _expected(system)
    figure = new_figure(9, 3.9)
    left, right = figure.subplots(1, 2)
    show_image(left, add_noise(expected, system, effort.seed), "σ² = 0.26 + 0.011 Q")
    show_image(right, add_noise(expected, louder, effort.seed), f"σ times {factor:g}")
    caption = (
        f"Pixel noise as measured by the paper, and {factor:g} times as large; the paper does not "
        "state by how much it exaggerates."
    )
    return Outcome("Fig. 6", "Exaggerated noise", caption, figure, (), {"factor": factor})


def solidras_image(effort: Effort) -> Outcome:
    """Figs. 13 and 14: a SolidRas image with stains and dust, and one by the generator."""
    system = solidras()
    pose = (*POSITION_UM, _THETA_RAD)
    soiled = {"dust": 12, "stains": {"count": 6, "depth": 0.12}, "uneven_light": 0.12}
    frames = [
        simulate(system, pose, seed=effort.seed, path="paper", effects=effects).frames[0]
        for effects in (soiled, None)
    ]
    figure = new_figure(9.5, 4.0)
    titles = ("with simulated stains and dust", "clean")
    for axes, frame, title in zip(figure.subplots(1, 2), frames, titles, strict=True):
        show_image(axes, frame, title)
    difference = np.abs(frames[0].astype(float) - frames[1]) > 30
    rows, columns = np.nonzero(difference)
    if len(rows):
        k = int(np.argmax(np.abs(frames[0].astype(float) - frames[1])[rows, columns]))
        place = (columns[k] - 20, rows[k] - 20)
        figure.axes[0].add_patch(Rectangle(place, 40, 40, fill=False, color=VERMILION, lw=1.5))
    caption = (
        "SolidRas images by the paper's generator at (4000, 5000) µm: dark 25, light 252, blur "
        "4.5 µm, σ² = 0.26 + 0.011 Q, 8 bits. Left with stains, dust (the frame marks the "
        "darkest speck) and light that falls off by 12 %, in place of the paper's photograph."
    )
    data = {"pixels_changed_by_more_than_30": int(difference.sum()), "effects": soiled}
    return Outcome("Figs. 13, 14", "SolidRas image", caption, figure, (), data)
