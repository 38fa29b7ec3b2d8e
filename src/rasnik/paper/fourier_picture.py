"""A Rasnik image and its spectrum, each peak with the phase that the analysis reads from it."""

from __future__ import annotations

import numpy as np
import scipy.fft
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.signal.windows import hann

from rasnik.imaging.simulate import simulate
from rasnik.instrument import load_system
from rasnik.paper.images import show_image
from rasnik.paper.outcome import Effort, Outcome, new_figure

__all__ = ["image_spectrum", "peaks", "spectrum"]

_FIELD_UM = 120.0  # of the mask in the paper's picture
_POSE = (4000.0, 5000.0, 0.03)
#: Peaks are shown down to this part of the strongest.
_FAINTEST = 4e-3
_SHOWN = 0.12  # cycles per pixel


def image_spectrum(effort: Effort) -> Outcome:
    """Fig. 7: a typical image with 120 µm fields, and its Fourier transform."""
    system = load_system("solidras", {"mask.field_um": _FIELD_UM})
    frame = simulate(system, _POSE, seed=effort.seed).frames[0]
    transform = spectrum(frame)
    found = peaks(transform)
    figure = new_figure(10.5, 4.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    show_image(left, frame, f"simulated image, fields of {_FIELD_UM:g} µm")
    _draw(right, transform, found)
    caption = (
        "Left: an image as SolidRas makes it with fields of 120 µm, rotated by 30 mrad. Right: "
        "its spectrum under a Hann window. Grey: amplitude. Discs: the local peaks, their colour "
        "and the hand in them the phase about the image centre (hand to the right: 0, up: +90 "
        "degrees). The four strongest are the chess fields' fundamental; the others are its "
        "harmonics and, around each, sidebands of the code lines at a ninth of the period."
    )
    strongest = found[: min(12, len(found))]
    data = {
        "peaks": [
            {"u_per_px": u, "v_per_px": v, "amplitude": a, "phase_rad": p}
            for u, v, a, p in strongest
        ],
        "count": len(found),
    }
    return Outcome("Fig. 7", "Image and spectrum", caption, figure, (), data)


def spectrum(image: NDArray[np.generic]) -> NDArray[np.complex128]:
    """Fourier transform under a Hann window, zero frequency and phase origin in the middle."""
    grey = np.asarray(image, dtype=np.float64)
    window = np.outer(hann(grey.shape[0], sym=False), hann(grey.shape[1], sym=False))
    level = (grey * window).sum() / window.sum()
    centred = scipy.fft.ifftshift((grey - level) * window)
    return np.asarray(scipy.fft.fftshift(scipy.fft.fft2(centred)))


def peaks(transform: NDArray[np.complex128], faintest: float = _FAINTEST) -> NDArray[np.float64]:
    """Local maxima, strongest first: rows of (u, v, amplitude, phase), in cycles per pixel."""
    amplitude = np.abs(transform)
    highest = maximum_filter(amplitude, size=7) == amplitude
    rows, columns = np.nonzero(highest & (amplitude > faintest * amplitude.max()))
    v = scipy.fft.fftshift(scipy.fft.fftfreq(transform.shape[0]))[rows]
    u = scipy.fft.fftshift(scipy.fft.fftfreq(transform.shape[1]))[columns]
    found = transform[rows, columns]
    order = np.argsort(-np.abs(found))
    return np.stack([u, v, np.abs(found), np.angle(found)], axis=1)[order]


def _draw(axes: Axes, transform: NDArray[np.complex128], found: NDArray[np.float64]) -> None:
    amplitude = np.abs(transform)
    top = float(amplitude.max())
    u = scipy.fft.fftshift(scipy.fft.fftfreq(transform.shape[1]))
    v = scipy.fft.fftshift(scipy.fft.fftfreq(transform.shape[0]))
    axes.pcolormesh(
        u, v, np.maximum(amplitude, 1e-5 * top), cmap="gray_r",
        norm=LogNorm(1e-4 * top, top), shading="nearest", rasterized=True,
    )  # fmt: skip
    near = found[np.maximum(np.abs(found[:, 0]), np.abs(found[:, 1])) < _SHOWN]
    strength = 1 + np.log10(near[:, 2] / near[:, 2].min())
    strength /= strength.max()
    discs = axes.scatter(
        near[:, 0], near[:, 1], s=170 * strength**2, c=near[:, 3], cmap="twilight",
        vmin=-np.pi, vmax=np.pi, edgecolors="black", linewidths=0.6,
    )  # fmt: skip
    # The hand of the clock says the phase where there are no colours.
    reach = 0.0055 * strength
    for (u0, v0, _, phase), length in zip(near, reach, strict=True):
        tip = (u0 + length * np.cos(phase), v0 - length * np.sin(phase))
        axes.plot([u0, tip[0]], [v0, tip[1]], color="white", linewidth=1.6, solid_capstyle="butt")
        axes.plot([u0, tip[0]], [v0, tip[1]], color="black", linewidth=0.8)
    axes.set_xlim(-_SHOWN, _SHOWN)
    axes.set_ylim(_SHOWN, -_SHOWN)  # rows grow downwards, as in the image
    axes.set_aspect("equal")
    axes.set_xlabel("u, cycles per pixel")
    axes.set_ylabel("v, cycles per pixel")
    axes.set_title("spectrum with phases")
    if axes.figure is not None:
        bar = axes.figure.colorbar(discs, ax=axes, label="phase, rad", shrink=0.85)
        bar.set_ticks(
            [-np.pi, -np.pi / 2, 0, np.pi / 2, np.pi], labels=["−π", "−π/2", "0", "π/2", "π"]
        )
