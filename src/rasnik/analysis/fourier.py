"""Step 1 of the analysis: the chess lattice from the spectrum of the image.

This is the first half of SOAP (van der Graaf et al., section 4): the strongest peaks of the
two-dimensional spectrum give pitch and rotation, their phases the shift, harmonics refine them;
the field centres follow. No prior knowledge but the pixel size is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from numba import njit
from numpy.typing import NDArray

from rasnik.analysis.coverage import Coverage, coverage, region_of
from rasnik.analysis.flags import Flag
from rasnik.analysis.lattice import Lattice
from rasnik.analysis.levels import fit_levels
from rasnik.analysis.picture import Picture, prepare
from rasnik.analysis.sampling import FieldSamples, sample_fields
from rasnik.analysis.tones import ToneLattice, chess_lattice, primary_pair, refine

__all__ = ["LEAST_PIXELS_PER_FIELD", "find_lattice"]

Array = NDArray[np.float64]

#: Below this the pixel washes out the fields.
LEAST_PIXELS_PER_FIELD = 2.5
_SMALLEST_IMAGE_PX = 16
# Fields larger than this would not show a pattern at all in any image.
_LEAST_FIELDS_PER_PIXEL = 1e-7

# Peaks this close to zero frequency (in bins) are light, not pattern.
_LEAST_BINS = 2.5
_PEAKS = 12
_PAIRS_TRIED = 6
# Power of a primary in units of that of white noise, whose highest peaks reach 15.
_LEAST_PRIMARY = 40.0
# Primaries of a square pattern are equal and perpendicular; a slanted view changes both.
_MOST_LENGTH_RATIO = 1.7
_LEAST_SINE = math.sin(math.radians(55))
# A lattice is accepted at once above the first, and at all above the second agreement, the
# latter raised by this / sqrt(number of fields), since among few fields chance goes far ...
_GOOD_AGREEMENT = 0.80
_LEAST_AGREEMENT = 0.75
_CHANCE = 0.7
_LEAST_JUDGED = 40
# ... if it covers this much of the view.
_LEAST_COVERAGE = 0.12
# Below this coverage the transform is repeated over the part that shows the mask.
_WHOLE_COVERAGE = 0.93
_REGION_PASSES = 3
_LEAST_REGAINED = 0.8
_NOISE_QUANTILE = 0.2
_NOISE_FREQUENCY = 0.2  # cycles per pixel


@njit(cache=True)
def _spectrum_peaks(  # type: ignore[no-untyped-def]  # pragma: no cover
    spectrum, width, least_bins, most, peak_u, peak_v, peak_power
):
    """Strongest local maxima of |spectrum|^2 k^2; returns how many. Also fills `power`."""
    height, half = spectrum.shape
    power = np.zeros((height + 2, half + 2), np.float32)
    for row in range(height):
        bin_v = row if row <= height // 2 else row - height
        kv = bin_v / height
        for column in range(half):
            ku = column / width
            if column * column + bin_v * bin_v < least_bins * least_bins:
                continue
            value = spectrum[row, column]
            power[row + 1, column + 1] = (value.real**2 + value.imag**2) * (ku * ku + kv * kv)
    # the spectrum is periodic in v, and mirrored in the origin beyond u = 0
    for column in range(half + 2):
        power[0, column] = power[height, column]
        power[height + 1, column] = power[1, column]
    for row in range(1, height + 1):
        mirror = 1 if row == 1 else height + 2 - row
        power[row, 0] = power[mirror, 2]
    found = 0
    for row in range(1, height + 1):
        for column in range(1, half + 1):
            value = power[row, column]
            if found == most and value <= peak_power[found - 1]:
                continue
            if (
                value <= power[row - 1, column - 1]
                or value <= power[row - 1, column]
                or value <= power[row - 1, column + 1]
                or value <= power[row, column - 1]
                or value < power[row, column + 1]
                or value < power[row + 1, column - 1]
                or value < power[row + 1, column]
                or value < power[row + 1, column + 1]
            ):
                continue
            bin_v = row - 1 if row - 1 <= height // 2 else row - 1 - height
            if column == 1 and bin_v < 0:
                continue  # the same peak stands at +v
            place = min(found, most - 1)
            while place > 0 and peak_power[place - 1] < value:
                peak_power[place] = peak_power[place - 1]
                peak_u[place] = peak_u[place - 1]
                peak_v[place] = peak_v[place - 1]
                place -= 1
            peak_power[place] = value
            peak_u[place] = column - 1
            peak_v[place] = bin_v
            found = min(found + 1, most)
    return found


@dataclass(frozen=True, eq=False)
class _Trial:
    """A lattice under test; `pixel_matrix` acts on image (column, row, 1)."""

    tones: ToneLattice
    picture: Picture
    pixel_matrix: Array
    samples: FieldSamples
    seen: Coverage
    power: float  # of the weaker primary

    @property
    def pixels_per_field(self) -> float:
        return 1 / math.sqrt(abs(float(np.linalg.det(self.pixel_matrix[:, :2]))))

    @property
    def merit(self) -> float:
        return self.seen.fraction * (self.seen.agreement - 0.5)

    def agrees(self, least: float) -> bool:
        """Whether the fields show the chessboard that the lattice says."""
        chance = _CHANCE / math.sqrt(max(self.seen.judged, 1))
        return (
            self.seen.judged >= _LEAST_JUDGED
            and self.seen.agreement > max(least, _LEAST_AGREEMENT + chance)
            and self.seen.fraction > _LEAST_COVERAGE
        )


def find_lattice(
    image: NDArray[np.float32],
    pixel_um: float,
    valid: NDArray[np.bool_] | None = None,
    *,
    noise_variance: float | None = None,
) -> Lattice | Flag:
    """Find the chess lattice in an image, whatever its scale and rotation.

    Parameters
    ----------
    image : ndarray of float32, shape (height, width)
        Grey levels.
    pixel_um : float
        Pixel pitch.
    valid : ndarray of bool, shape (height, width), optional
        Usable pixels; all finite ones by default.
    noise_variance : float, optional
        Mean variance of a pixel (grey levels squared) for the covariance; by default it is
        estimated from the floor of the spectrum.

    Returns
    -------
    Lattice or Flag
        The flag says why there is none: `Flag.BLANK`, `Flag.NO_MASK` or `Flag.FIELD_TOO_SMALL`.
    """
    image, valid = _clean(image, valid)
    if min(image.shape) < _SMALLEST_IMAGE_PX or (valid is not None and valid.mean() < 0.05):
        return Flag.NO_MASK
    picture = prepare(image, valid)
    if not picture.windowed.any():
        return Flag.BLANK
    spectrum = scipy.fft.rfft2(picture.windowed, workers=1)
    if noise_variance is None:
        noise_variance = _noise_floor(picture, spectrum)
    best: _Trial | None = None
    too_small = 0.0  # power of a lattice below the limit
    for pair in _candidate_pairs(spectrum, picture.windowed.shape[1]):
        trial = _trial(image, valid, picture, pair, noise_variance)
        if trial is not None and trial.pixels_per_field < LEAST_PIXELS_PER_FIELD:
            # or a harmonic of a sharp pattern in step with the pixels, weaker than its primaries
            if trial.agrees(_GOOD_AGREEMENT):
                too_small = max(too_small, trial.power)
            continue
        if trial is not None and (best is None or trial.merit > best.merit):
            best = trial
            if trial.agrees(_GOOD_AGREEMENT):
                break
    if too_small > 0 and (best is None or best.power < too_small):
        return Flag.FIELD_TOO_SMALL
    if best is not None and best.agrees(_LEAST_AGREEMENT) and best.seen.fraction < _WHOLE_COVERAGE:
        best = _within_region(image, valid, best, noise_variance)
    if best is None or not best.agrees(_LEAST_AGREEMENT):
        return Flag.BLANK if _is_blank(image, valid) else Flag.NO_MASK
    return _finish(image.shape, pixel_um, best, noise_variance)


def _clean(
    image: NDArray[np.float32], valid: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
    """Contiguous float32 image with finite values, and the mask that leaves others out."""
    image = np.ascontiguousarray(image, dtype=np.float32)
    if not np.isfinite(image.sum()):
        finite = np.isfinite(image)
        valid = finite if valid is None else valid & finite
    if valid is None or valid.all():
        return image, None
    if not valid.any():
        return image, valid
    return np.where(valid, image, np.median(image[valid])).astype(np.float32), valid


def _is_blank(image: NDArray[np.float32], valid: NDArray[np.bool_] | None) -> bool:
    """Whether the grey levels span no more than noise does at a constant level."""
    values = image[::3, ::3] if valid is None else image[valid]
    low, middle, high = np.percentile(values, (1, 50, 99))
    whole_numbers = bool((values == np.rint(values)).all())
    return bool(high - low <= 0.06 * abs(middle) + (8 if whole_numbers else 0))


def _noise_floor(picture: Picture, spectrum: NDArray[np.complex64]) -> float:
    """Variance per pixel from the spectral power (exponential for noise) where both frequencies
    are high: a low quantile, since the pattern only adds to it.
    """
    height, width = picture.windowed.shape
    high_v = slice(int(_NOISE_FREQUENCY * height), int((1 - _NOISE_FREQUENCY) * height))
    part = spectrum[high_v, int(_NOISE_FREQUENCY * width) :][::2, ::2]
    quantile = float(np.quantile(part.real**2 + part.imag**2, _NOISE_QUANTILE))
    return quantile / -math.log1p(-_NOISE_QUANTILE) / max(picture.noise_moments[2, 2], 1e-12)


def _candidate_pairs(spectrum: NDArray[np.complex64], width: int) -> list[Array]:
    """Pairs of peaks that may be the primaries, most likely first; radians per pixel, (2, 2)."""
    bins_u, bins_v = np.zeros(_PEAKS), np.zeros(_PEAKS)
    power = np.zeros(_PEAKS, np.float32)
    found = _spectrum_peaks(spectrum, width, _LEAST_BINS, _PEAKS, bins_u, bins_v, power)
    wave = 2 * np.pi * np.stack([bins_u / width, bins_v / spectrum.shape[0]], axis=1)[:found]
    length = np.hypot(wave[:, 0], wave[:, 1])
    pairs = []
    for a in range(found):
        for b in range(a + 1, found):
            sine = abs(wave[a, 0] * wave[b, 1] - wave[a, 1] * wave[b, 0]) / length[a] / length[b]
            ratio = max(length[a] / length[b], length[b] / length[a])
            if sine > _LEAST_SINE and ratio < _MOST_LENGTH_RATIO:
                pairs.append((float(power[a]) * float(power[b]), a, b))
    pairs.sort(reverse=True)
    return [wave[[a, b]] for _, a, b in pairs[:_PAIRS_TRIED]]


def _trial(
    image: NDArray[np.float32],
    valid: NDArray[np.bool_] | None,
    picture: Picture,
    pair: Array,
    noise_variance: float,
    steps: int = 2,
) -> _Trial | None:
    """Refine a pair of wave vectors to a lattice and see whether the fields agree with it."""
    found = refine(picture, pair, steps)
    power = np.abs(found.transform) ** 2
    if power.min() < _LEAST_PRIMARY * noise_variance * picture.noise_moments[2, 2]:
        return None
    start = primary_pair(found)
    if not abs(np.linalg.det(start[:, :2])) > _LEAST_FIELDS_PER_PIXEL:
        return None
    tones = chess_lattice(picture, start, noise_variance)
    pixel_matrix = tones.matrix.copy()
    pixel_matrix[:, 2] -= pixel_matrix[:, :2] @ picture.centroid_px
    samples = sample_fields(image, pixel_matrix, picture.bounds_px, valid)
    return _Trial(tones, picture, pixel_matrix, samples, coverage(samples), float(power.min()))


def _within_region(
    image: NDArray[np.float32],
    valid: NDArray[np.bool_] | None,
    trial: _Trial,
    noise_variance: float,
) -> _Trial:
    """Repeat the transform over the part of the image that shows the mask.

    That part may grow: the first lattice is true near the window's centroid only.
    """
    bounds = trial.picture.bounds_px
    for _ in range(_REGION_PASSES):
        samples = trial.samples
        region = region_of(
            trial.seen.fields, samples.first_i, samples.first_j, trial.pixel_matrix, image.shape
        )
        if not region.any():
            return trial
        pair = np.pi * np.array([[1, -1], [1, 1]]) @ trial.pixel_matrix[:, :2]
        picture = prepare(image, valid, region)
        again = _trial(image, valid, picture, pair, noise_variance, steps=4)
        if again is None:
            return trial
        # look for fields in the whole picture again
        samples = sample_fields(image, again.pixel_matrix, bounds, valid)
        again = replace(again, samples=samples, seen=coverage(samples))
        if again.merit < _LEAST_REGAINED * trial.merit:
            return trial
        settled = again.seen.fraction < 1.02 * trial.seen.fraction
        trial = again
        if settled:
            break
    return trial


def _finish(
    shape: tuple[int, int], pixel_um: float, trial: _Trial, noise_variance: float
) -> Lattice | Flag:
    height, width = shape
    matrix = trial.pixel_matrix.copy()
    # from (column, row) to micrometres from the centre of the image
    matrix[:, 2] += matrix[:, :2] @ [(width - 1) / 2, (height - 1) / 2]
    matrix[:, :2] /= pixel_um
    pixels_per_field = trial.pixels_per_field
    samples = replace(trial.samples, present=trial.seen.fields)
    levels = fit_levels(samples)
    if levels is None:
        return Flag.NO_MASK
    blur_px = trial.tones.blur_px
    if math.isnan(blur_px):
        blur_px = _blur_from_mixing(levels.side, levels.own) * pixels_per_field
    return Lattice(
        matrix=matrix,
        covariance=_about_image_centre(trial, shape, pixel_um),
        pixels_per_field=pixels_per_field,
        blur_um=math.sqrt(max(blur_px**2 - 1 / 12, 0.0)) * pixel_um,
        noise_variance=noise_variance,
        score=trial.seen.agreement,
        coverage=trial.seen.fraction,
        shape=(height, width),
        pixel_um=pixel_um,
        tones=trial.tones,
        picture=trial.picture,
        samples=samples,
        levels=levels,
    )


def _about_image_centre(trial: _Trial, shape: tuple[int, int], pixel_um: float) -> Array:
    """Covariance of the matrix about the image's centre in um, from the centroid's in pixels."""
    column, row = trial.picture.centroid_px
    shift_u, shift_v = (shape[1] - 1) / 2 - column, (shape[0] - 1) / 2 - row
    block = np.array([[1 / pixel_um, 0.0, 0.0], [0.0, 1 / pixel_um, 0.0], [shift_u, shift_v, 1.0]])
    change = np.kron(np.eye(2), block)
    result: Array = change @ trial.tones.covariance @ change.T
    return result


def _blur_from_mixing(side: float, own: float) -> float:
    """Gaussian sigma in fields for which a side neighbour gives side/own of the light."""
    ratio = min(max(side / own, 0.0), 0.45)
    if ratio == 0:
        return 0.0
    own_part = 1 / (1 + 2 * ratio)  # in one dimension
    low, high = 0.01, 2.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (
            (middle, high)
            if math.erf(0.5 / middle / math.sqrt(2)) > own_part
            else (
                low,
                middle,
            )
        )
    return low
