"""The exact image: what every pixel is expected to hold, without discretisation.

The hard-edged mask, blurred by the optics and integrated over square pixels, is band-limited
where the optics transfer no detail. A window of fields somewhat larger than the view, taken
as periodic, is then a finite Fourier series whose coefficients are known in closed form:

    sum over fields (sinc sinc, with its phase) x optics (OTF) x pixel (sinc sinc),

the last two at the frequency that the harmonic has on the sensor, hence right under any
rotation or affine map. Summing the series at the pixel centres gives the image to `ACCURACY`
of the step from black to white. Nothing here is shared with the image model of the fit, so
that each can be tested against the other.

Source: van der Graaf et al., section 4, "Image simulations", whose generator (points sampled
within the pixel, blur spread over 11 x 11 pixels) this one replaces by its exact limit.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from rasnik.imaging.deviations import CoherentLight, Deviations, EdgeErrors
from rasnik.imaging.levels import LevelMap, level_at
from rasnik.imaging.projection import Projection, sensor_grid_um
from rasnik.imaging.series import Scene, Tile
from rasnik.imaging.transfer import (
    GaussianTransfer,
    OpticalTransfer,
    PupilTransfer,
    ScaledTransfer,
)
from rasnik.instrument import System
from rasnik.mask import ChessField

__all__ = ["ACCURACY", "exact_image", "exact_pattern", "grey_levels"]

#: Largest error of the pattern, in units of the step from black to white (affine maps).
ACCURACY = 1e-7

# Transferred detail up to which the work stays bearable: a blur of 1/20 pixel.
_MAX_CYCLES_PER_PIXEL = 16.8
# A blur that varies over the image is interpolated between images of these many blurs, which
# for a change by half is right to 1e-6 of the step.
_BLUR_NODES = 7
# Points along the side of a pixel at which the intensity of coherent light is taken.
_COHERENT_POINTS = 5


def exact_image(
    system: System,
    projection: Projection,
    *,
    light_map: LevelMap | float | None = None,
    dark_map: LevelMap | float | None = None,
    shape: tuple[int, int] | None = None,
    transfer: OpticalTransfer | None = None,
    deviations: Deviations | None = None,
    workers: int = 1,
) -> NDArray[np.float64]:
    """Expected grey level of every pixel: ``dark + (light - dark) * pattern``.

    Parameters
    ----------
    system : System
        Gives mask, pixel pitch (with binning), blur, and dark and light level.
    projection : Projection
        From the sensor to the mask, about the middle of the image.
    light_map, dark_map : callable or float, optional
        Grey level of a wide white or black area as a function of (u_um, v_um), e.g. a
        `QuadraticLevel`; taken at the pixel's centre. By default the system's levels.
    shape : tuple of int, optional
        (height, width); by default that of the system's read-out image.
    transfer : OpticalTransfer, optional
        Blur of the optics; by default Gaussian with the system's ``optics.blur_um``.
    deviations : Deviations, optional
        How the instrument deviates from the ideal one.
    workers : int
        Threads.

    Returns
    -------
    ndarray of float64, shape (height, width)
        Not rounded, not limited to the range of the sensor, without noise.

    Raises
    ------
    ValueError
        If the system has no blur (a hard edge has no finite Fourier series), or as
        `exact_pattern`.
    """
    shape = system.shape if shape is None else shape
    change = deviations or Deviations()
    transfer = transfer or change.transfer or GaussianTransfer(system.optics.blur_um)

    def pattern_of(transfer: OpticalTransfer) -> NDArray[np.float64]:
        return exact_pattern(
            system.mask,
            projection,
            shape,
            system.pitch_um,
            transfer,
            gap_um=change.gap_um,
            points_um=change.points_um,
            edges=change.edges,
            workers=workers,
        )

    if change.blur_ratio is not None:
        pattern = _with_varying_blur(pattern_of, transfer, change.blur_ratio)
    else:
        pattern = pattern_of(transfer)
    if change.coherent is not None:
        share = change.coherent.share
        pattern *= 1 - share
        pattern += share * _coherent_pattern(system, projection, shape, change, change.coherent)
    return grey_levels(pattern, system, light_map, dark_map, change)


def grey_levels(
    pattern: NDArray[np.float64],
    system: System,
    light_map: LevelMap | float | None,
    dark_map: LevelMap | float | None,
    deviations: Deviations,
) -> NDArray[np.float64]:
    """Grey levels of a pattern (changed in place); arguments as for `exact_image`."""
    u, v = sensor_grid_um(pattern.shape, system.pitch_um)
    dark = level_at("dark_map", dark_map, system.sensor.dark_level, u, v[:, None])
    light = level_at("light_map", light_map, system.sensor.light_level, u, v[:, None])
    pattern *= light - dark
    pattern += dark
    if deviations.illumination is not None:
        pattern *= deviations.illumination
    return pattern


def _with_varying_blur(
    pattern_of: Callable[[OpticalTransfer], NDArray[np.float64]],
    transfer: OpticalTransfer,
    ratio: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Every pixel with its own blur: images with Chebyshev nodes of the squared ratio.

    An image is an analytic function of the variance of its Gaussian blur.
    """
    square = ratio**2
    low, high = float(square.min()), float(square.max())
    if not low > 0:
        raise ValueError("the blur must stay positive everywhere on the sensor")
    if high - low < 1e-12 * high:
        return pattern_of(ScaledTransfer(transfer, high**0.5))
    node = np.cos(np.pi * (np.arange(_BLUR_NODES) + 0.5) / _BLUR_NODES)
    at = (2 * square - low - high) / (high - low)
    total = np.zeros_like(at)
    for k, own in enumerate(node):
        others = np.delete(node, k)
        weight = np.prod([(at - other) / (own - other) for other in others], axis=0)
        width = np.sqrt((low + high + own * (high - low)) / 2)
        total += weight * pattern_of(ScaledTransfer(transfer, float(width)))
    return total


def _coherent_pattern(
    system: System,
    projection: Projection,
    shape: tuple[int, int],
    change: Deviations,
    light: CoherentLight,
) -> NDArray[np.float64]:
    """Intensity where the light is coherent: the amplitude squared, averaged over the pixel.

    The amplitude at a point is exact; its square has no finite series on the mask, so that the
    mean over the pixel is taken by Gauss-Legendre quadrature.
    """
    pitch_um = system.pitch_um
    u, v = sensor_grid_um(shape, pitch_um)
    points = change.points_um or tuple(np.meshgrid(u, v))
    node, weight = np.polynomial.legendre.leggauss(_COHERENT_POINTS)
    offset = node * (pitch_um - change.gap_um) / 2
    parts = (False, True) if light.defocus_um else (False,)
    total = np.zeros(shape)
    for du, weight_u in zip(offset, weight / 2, strict=True):
        for dv, weight_v in zip(offset, weight / 2, strict=True):
            for imaginary in parts:
                amplitude = exact_pattern(
                    system.mask,
                    projection,
                    shape,
                    pitch_um,
                    PupilTransfer(
                        light.wavelength_um, light.numerical_aperture, light.defocus_um, imaginary
                    ),
                    gap_um=pitch_um,
                    points_um=(points[0] + du, points[1] + dv),
                    edges=change.edges,
                )
                total += weight_u * weight_v * amplitude**2
    return total


def exact_pattern(
    mask: ChessField,
    projection: Projection,
    shape: tuple[int, int],
    pitch_um: float,
    transfer: OpticalTransfer,
    *,
    gap_um: float = 0.0,
    points_um: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    edges: EdgeErrors | None = None,
    workers: int = 1,
) -> NDArray[np.float64]:
    """Share of the light of a wide white area that every pixel receives.

    Parameters
    ----------
    mask : ChessField
        Opaque beyond its extent.
    projection : Projection
        From the sensor to the mask, about the middle of the image. For an affine map the
        result is exact to `ACCURACY`. For a projective one pixel centres are mapped
        exactly, while blur and outline of the pixel are those in the middle of the
        tile of the image that is computed at once; tiles are made so small that this
        changes no pixel by more than 1e-4.
    shape : tuple of int
        (height, width) in pixels.
    pitch_um : float
        Distance of neighbouring pixels.
    transfer : OpticalTransfer
        Blur of the optics.
    gap_um : float
        Dead area between the light-sensitive squares of neighbouring pixels; at the full
        pitch a pixel is a point.
    points_um : tuple of ndarray, optional
        (u, v) of shape `shape`: sensor points to take the pixels at, in place of their
        grid (distorted images, misplaced pixels). Each is mapped exactly; blur and pixel
        keep their outline.
    edges : EdgeErrors, optional
        Errors of the printed contours; to second order in their size over the blur, but
        for the products of two of them where contours cross.
    workers : int
        Threads.

    Returns
    -------
    ndarray of float64, shape (height, width)
        0 for black, 1 for white.

    Raises
    ------
    ValueError
        If the shape is not positive, the blur is below 1/20 of a pixel, the gap is not
        between nothing and a pixel, or the map is singular or sends points of the sensor to
        infinity.
    """
    if min(shape) < 1:
        raise ValueError(f"the image must have pixels, its shape cannot be {shape}")
    if transfer.cutoff_per_um * pitch_um > _MAX_CYCLES_PER_PIXEL:
        raise ValueError(
            f"the blur is too small against the {pitch_um:g} um pixel for the exact image, which "
            "needs a Gaussian sigma of 1/20 pixel at least: raise optics.blur_um"
        )
    if not 0 <= gap_um <= pitch_um:
        raise ValueError(f"the dead area of {gap_um:g} um does not fit a {pitch_um:g} um pixel")
    scene = Scene(mask, projection, shape, pitch_um, transfer, pitch_um - gap_um, points_um, edges)
    scene.check()
    image = np.empty(shape)
    tiles = scene.tiles()

    def fill(tile: Tile) -> None:
        image[tile.rows, tile.columns] = scene.render(tile)

    if workers > 1 and len(tiles) > 1:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(fill, tiles))
    else:
        for tile in tiles:
            fill(tile)
    return image
