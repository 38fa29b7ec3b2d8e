"""Mean and variance of every pixel in time, from frames of a still scene read one after another.

What the light and a small motion of the scene do to a frame is common to all pixels: a few
numbers per frame, found by a fit of the frame to the mean image and its gradient. They are
projected out of every pixel's own series, with a slope of its own for each pixel, so the
gradient need not be exact at edges that are narrower than a pixel. What is left is taken from
differences of successive frames, which do not see slow changes of any kind.

Frames are worked on in blocks of some 50, and a block is all that is kept in memory.

Source: differences of pairs of frames for the photon-transfer curve, J. R. Janesick, "Photon
Transfer" (2007), chapter 5; the normalisation for successive differences with terms projected
out is derived here (`_Operator`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["LEAST_FRAMES", "StillSceneError", "TemporalNoise", "temporal_noise"]

#: Frames below which four terms per frame leave too little to measure noise with.
LEAST_FRAMES = 10
_BLOCK = 48
_LEAST_BLOCK = 12
_SECOND_ORDER_FRAMES = 24  # in a block, from which on the products of motion and light are fitted
_BLOCK_BYTES = 2**28
_STRIP_PIXELS = 2**15
_COUNTED_LEVELS = 2**16
# A frame of other light, or with something in front of the scene, is left out.
_LIGHT_JUMP = 0.3
_OTHER_SCENE = 10.0  # times the usual mean square of what the fit leaves
_SAME_SCENE = 0.8  # least correlation of the means of two blocks
_SMALL = 1e-7

Image = NDArray[np.float64]


class StillSceneError(ValueError):
    """Raised for frames that noise cannot be measured from; the message says why."""


@dataclass(frozen=True, eq=False)
class TemporalNoise:
    """Mean and variance in time of every pixel.

    Attributes
    ----------
    mean : ndarray, shape (H, W)
        Grey levels.
    variance : ndarray, shape (H, W)
        Grey levels squared, rounding included; without what all pixels have in common (light,
        motion) and without slow changes. NaN where a frame had no finite value.
    dof : float
        Degrees of freedom nu of each variance: its relative variance is 2 / nu for white noise.
    lowest, highest : ndarray, shape (H, W)
        Least and greatest expected level of each pixel in the set.
    frames, left_out, repeated : int
        Frames used; left out since they showed other light or another scene; left out since
        they equal the one before.
    light : ndarray, shape (frames,)
        Relative change of the light from the mean of the first block.
    x_px, y_px : ndarray, shape (frames,)
        Motion of the scene from the first block's mean, in pixels, right and down.
    row_variance, column_variance : tuple of float
        Variance (grey^2) that the pixels of a row, or column, have in common in one frame, and
        its standard deviation.
    counts : ndarray of int64, or None
        How often each grey level occurs; None if the levels are no whole numbers from 0 to 65535.
    """

    mean: Image
    variance: Image
    dof: float
    lowest: Image
    highest: Image
    frames: int
    left_out: int
    repeated: int
    light: Image
    x_px: Image
    y_px: Image
    row_variance: tuple[float, float]
    column_variance: tuple[float, float]
    counts: NDArray[np.int64] | None


def temporal_noise(frames: Iterable[NDArray[Any]]) -> TemporalNoise:
    """Mean and variance of every pixel from frames of a still scene.

    Parameters
    ----------
    frames : iterable of ndarray, shape (H, W)
        Successive frames, at least `LEAST_FRAMES`. The scene may drift by parts of a pixel, and
        the light may change from frame to frame. Read once; no more than two blocks are kept.

    Returns
    -------
    TemporalNoise

    Raises
    ------
    StillSceneError
        If there are too few frames, they differ in size, or show different scenes.
    """
    sums = _Sums()
    for block in _blocks(_without_repeats(frames, sums), sums):
        sums.add(block)
        block.clear()  # before the next is read
    return sums.result()


def _without_repeats(frames: Iterable[NDArray[Any]], sums: _Sums) -> Iterator[NDArray[Any]]:
    """Frames of one shape; one that equals the frame before is a copy made by the recorder."""
    before: NDArray[Any] | None = None
    for frame in frames:
        if before is not None and frame.shape != before.shape:
            raise StillSceneError(
                f"the frames differ in size: {before.shape[1]} x {before.shape[0]} and "
                f"{frame.shape[1]} x {frame.shape[0]} pixels; give frames of one recording"
            )
        if frame.ndim != 2 or min(frame.shape) < 3:
            raise StillSceneError(f"frames of at least 3 x 3 pixels are needed, not {frame.shape}")
        if before is not None and np.array_equal(frame, before):
            sums.repeated += 1
            continue
        before = frame
        sums.count(frame)
        yield frame


def _blocks(frames: Iterator[NDArray[Any]], sums: _Sums) -> Iterator[list[NDArray[Any]]]:
    """Blocks of about equal length: the rest at the end is not left as a short one."""
    kept: list[NDArray[Any]] = []
    length = _BLOCK
    for frame in frames:
        kept.append(frame)
        if len(kept) == 1:
            length = int(np.clip(_BLOCK_BYTES // (2 * frame.nbytes), _LEAST_BLOCK, _BLOCK))
        if len(kept) == 2 * length:
            yield kept[:length]
            kept = kept[length:]
    if len(kept) < LEAST_FRAMES and sums.frames == 0:
        raise StillSceneError(
            f"{len(kept)} different frames are too few to measure noise: at least {LEAST_FRAMES} "
            "are needed, better 100 or more"
        )
    parts = 2 if len(kept) > 1.5 * length else 1
    half = math.ceil(len(kept) / parts)
    for part in range(parts):
        yield kept[part * half : (part + 1) * half]


# ---------------------------------------------------------------- what a block's frames share


@dataclass(frozen=True)
class _Template:
    """Mean image with its gradient, and the fit of frames to them."""

    mean: Image  # (H, W)
    solver: Image  # (4, H * W): from a difference to (offset, light, -x, -y)
    terms: Image  # (H * W, 4)
    weight: Image  # (H * W,)
    leverage: Image  # (H * W,)

    @classmethod
    def of(cls, mean: Image) -> _Template:
        valid = np.isfinite(mean)
        level = np.where(valid, mean, 0.0)
        along_y, along_x = np.gradient(level)
        # One step beyond a missing pixel the gradient is not known either.
        solid = np.isfinite(sum(np.gradient(mean)))
        terms = np.stack([np.ones(level.size), level.ravel(), along_x.ravel(), along_y.ravel()], 1)
        # About the inverse of shot noise; only the precision of the four numbers hangs on it.
        typical = float(np.abs(level[valid]).mean()) if valid.any() else 1.0
        weight = 1.0 / (np.clip(level, 0, None) + 0.1 * typical + 1e-12).ravel()
        weight *= (valid & solid).ravel()
        size = np.sqrt(weight @ terms**2) + 1e-300
        scaled = terms / size
        normal = scaled.T @ (scaled * weight[:, None])
        inverse = np.linalg.pinv(normal, rcond=1e-10, hermitian=True)
        solver = (inverse / size[:, None]) @ (scaled * weight[:, None]).T
        leverage = weight * np.einsum("pi,ij,pj->p", scaled, inverse, scaled)
        return cls(mean, solver, terms, weight, leverage)

    def fit(self, image: NDArray[Any]) -> tuple[Image, float]:
        """(offset, light, -x, -y) of an image, and the mean square of what is left."""
        difference = np.where(self.weight > 0, (image - self.mean).ravel(), 0.0)
        found = self.solver @ difference
        rest = difference - self.terms @ found
        return found, float((self.weight * rest**2).sum() / max(self.weight.sum(), 1e-300))


def _fitted_block(
    block: list[NDArray[Any]],
) -> tuple[list[NDArray[Any]], _Template, Image]:
    """The frames that belong together, their mean, and (offset, light, x, y) of each."""
    for rounds_left in range(3, -1, -1):
        mean = np.zeros(block[0].shape)
        for frame in block:
            mean += frame
        template = _Template.of(mean / len(block))
        fits = [template.fit(frame) for frame in block]
        series = np.array([found for found, _ in fits])
        series[:, 2:] *= -1
        rest = np.array([left for _, left in fits])
        good = np.abs(series[:, 1] - np.median(series[:, 1])) < _LIGHT_JUMP
        good &= rest <= _OTHER_SCENE * np.median(rest)
        if good.all() or np.count_nonzero(good) < LEAST_FRAMES or not rounds_left:
            break
        block = [frame for frame, keep in zip(block, good, strict=True) if keep]
    return block, template, series


def _regressors(series: Image) -> Image:
    """Time series to be removed from every pixel: Taylor terms of light and motion."""
    offset, light, x, y = (column - column.mean() for column in series.T)
    terms = [offset, light, x, y]
    if len(series) >= _SECOND_ORDER_FRAMES:
        terms += [light * x, light * y, x * x, x * y, y * y]
    return np.stack(terms, axis=1)


def _basis(columns: Image) -> Image:
    """Orthonormal basis of the space of columns, their lengths made equal before."""
    length = np.sqrt((columns**2).sum(axis=0))
    columns = columns[:, length > 0] / length[length > 0]
    vectors, values, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(vectors[:, values > _SMALL * max(values.max(initial=0.0), 1e-300)])


class _Operator:
    """Differences of successive frames with the common terms projected out.

    T = (1 - U U') D, where D takes differences and U spans those of the common terms. For white
    noise of variance s the sum of squares of T y has the mean s tr(K) and the variance
    2 s^2 tr(K^2), K = T T', so the variance it gives has tr(K)^2 / tr(K^2) degrees of freedom.
    """

    def __init__(self, series: Image) -> None:
        n = len(series)
        terms = _regressors(series)
        difference = np.diff(np.eye(n), axis=0)
        span = _basis(difference @ terms)
        self.matrix = difference - span @ (span.T @ difference)
        kernel = self.matrix @ self.matrix.T
        self.trace = float(np.trace(kernel))
        self.trace2 = float((kernel**2).sum())
        self.smooth = _basis(np.column_stack([np.ones(n), terms]))


# ---------------------------------------------------------------- sums over blocks


class _Sums:
    """What is kept of the blocks."""

    def __init__(self) -> None:
        self.frames = self.left_out = self.repeated = 0
        self.counts: NDArray[np.int64] | None = np.zeros(_COUNTED_LEVELS, np.int64)
        self.first: _Template | None = None
        self.trace = self.trace2 = 0.0
        self.series: list[Image] = []

    def count(self, frame: NDArray[Any]) -> None:
        if self.counts is None:
            return
        if frame.dtype.kind not in "ui":
            whole = np.rint(frame)
            if not np.array_equal(whole, frame):
                self.counts = None
                return
            frame = whole.astype(np.int64)
        if frame.min() < 0 or frame.max() >= _COUNTED_LEVELS:
            self.counts = None
            return
        self.counts += np.bincount(frame.ravel(), minlength=_COUNTED_LEVELS)

    def add(self, block: list[NDArray[Any]]) -> None:
        given = len(block)
        block, template, series = _fitted_block(block)
        self.left_out += given - len(block)
        operator = _Operator(series)
        if operator.trace < 2:  # a short rest in which nothing is left to see
            self.left_out += len(block)
            return
        if self.first is None:
            self.first = template
            shape = template.mean.shape
            self.mean, self.squares = np.zeros(shape), np.zeros(shape)
            self.lowest, self.highest = np.full(shape, np.inf), np.full(shape, -np.inf)
            self.in_rows, self.in_columns = np.zeros(shape[0]), np.zeros(shape[1])
        series[:, 1:] += self._changed(template)
        self._add_pixels(block, operator, template)
        self.mean += operator.trace * template.mean
        self.trace += operator.trace
        self.trace2 += operator.trace2
        self.frames += len(block)
        self.series.append(series)

    def _changed(self, template: _Template) -> Image:
        """(light, x, y) of a block's mean against that of the first block."""
        assert self.first is not None
        ok = np.isfinite(template.mean) & np.isfinite(self.first.mean)
        old, new = self.first.mean[ok], template.mean[ok]
        spread = old.std() * new.std()
        contrast = old.std() > 0.05 * max(abs(old.mean()), 1e-12)
        if contrast and spread and np.corrcoef(old, new)[0, 1] < _SAME_SCENE:
            raise StillSceneError(
                f"the scene is not still: about frame {self.frames} it looks different from the "
                "first frames; record a scene that does not move"
            )
        return self.first.fit(template.mean)[0][1:] * (1, -1, -1)

    def _add_pixels(
        self, block: list[NDArray[Any]], operator: _Operator, template: _Template
    ) -> None:
        height, width = template.mean.shape
        leverage = template.leverage.reshape(height, width)
        along = np.zeros((len(operator.matrix), width))
        rows = max(1, _STRIP_PIXELS // width)
        for top in range(0, height, rows):
            strip = slice(top, min(top + rows, height))
            # The level is taken off first: the sums of squares then keep their digits.
            values = np.stack([frame[strip] - template.mean[strip] for frame in block])
            flat = values.reshape(len(block), -1)
            rest = operator.matrix @ flat
            # The common numbers of a frame were fitted to this pixel too.
            squares = (rest**2).sum(axis=0).reshape(values.shape[1:]) / (1 - leverage[strip])
            self.squares[strip] += squares
            expected = operator.smooth @ (operator.smooth.T @ flat)
            low, high = expected.min(axis=0), expected.max(axis=0)
            mean = template.mean[strip]
            self.lowest[strip] = np.minimum(self.lowest[strip], mean + low.reshape(mean.shape))
            self.highest[strip] = np.maximum(self.highest[strip], mean + high.reshape(mean.shape))
            rest = np.nan_to_num(rest).reshape(-1, *values.shape[1:])
            self.in_rows[strip] += (rest.mean(axis=2) ** 2).sum(axis=0)
            along += rest.sum(axis=1)
        self.in_columns += ((along / height) ** 2).sum(axis=0)

    def result(self) -> TemporalNoise:
        if self.frames < LEAST_FRAMES:
            raise StillSceneError(
                f"only {self.frames} frames show the same scene; at least {LEAST_FRAMES} are needed"
            )
        variance = self.squares / self.trace
        height, width = variance.shape
        series = np.concatenate(self.series)
        known = np.nan_to_num(variance)
        rows = _excess(self.in_rows / self.trace, known.mean(axis=1) / width, height)
        columns = _excess(self.in_columns / self.trace, known.mean(axis=0) / height, width)
        # What rows have in common is, in the mean of a column, an offset of the whole frame: it
        # counts in the pixels' variance but has been taken out of the column.
        rows = rows[0] + max(columns[0], 0.0) / width, rows[1]
        columns = columns[0] + max(rows[0], 0.0) / height, columns[1]
        return TemporalNoise(
            mean=self.mean / self.trace,
            variance=variance,
            dof=self.trace**2 / self.trace2,
            lowest=self.lowest,
            highest=self.highest,
            frames=self.frames,
            left_out=self.left_out,
            repeated=self.repeated,
            light=series[:, 1],
            x_px=series[:, 2],
            y_px=series[:, 3],
            row_variance=rows,
            column_variance=columns,
            counts=self.counts,
        )


def _excess(found: Image, expected: Image, lines: int) -> tuple[float, float]:
    """Mean of the variance of lines beyond that of independent pixels, and its error."""
    # The offset of the frame, which is taken out, is a mean over all lines.
    excess = found - expected * (1 - 1 / lines)
    return float(excess.mean()), float(excess.std(ddof=1) / math.sqrt(lines))
