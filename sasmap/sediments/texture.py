"""Spatial texture: amplitude laws at several scales, combined into one likelihood of a class.

One-point statistics cannot separate a rippled bed, a boulder field and a flat floor with the same
histogram. Averaging intensity over 2, 4, 8 and 16 pixels turns the correlation of texture into the
shape of the law at each scale (speckle quickly becomes Gaussian, correlated texture keeps its
shape), and the differences between neighbouring averages show at which scale it ends, in any
direction. Each of these laws is a table of log densities per class. They overlap, so their sum is a
composite likelihood, whose weights are those that best separate the classes' own pixels
(multinomial logistic regression; Varin, Reid and Firth 2011, An overview of composite likelihood
methods).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import minimize

from sasmap.arrays import BoolArray, FloatArray, IntArray

Single = NDArray[np.float32]

# Pixels over which intensity is averaged, and distance in pixels of its differences (and the
# averaging length of these).
SCALES, LAGS = (1, 2, 4, 8, 16), (1, 2, 4, 8)
CHANNELS = len(SCALES) + len(LAGS)
# Side in pixels of the windows over which laws are averaged. On hand-labelled strips 33 alone has a
# mean recall of 0.872, 17 alone 0.858, 9 and 33 together 0.880.
WINDOWS = (9, 33)
# Pixels by which a window's evidence is divided, so that a boundary counts it only once: a quarter
# of the largest window.
SHARED = 300.0
# Margin in pixels that influences a place's channels (half the coarsest scale, or half the coarsest
# lag and half of its average), and its evidence (half a window more). Whole blocks.
REACH, MARGIN = 16, 32
BINS, TAILS = 60, 0.0005
# Pseudo-counts added to each bin.
PRIOR = 2.0
# Strength of the prior on standardised weights, relative to the mean log loss (0.001 to 0.01
# perform the same), and pixels per class from which the weights are fitted.
STIFF, DECIDING = 3e-3, 6000
# Side in pixels of the squares of the cross-validation of texture against amplitude (also the
# minimum number of pixels of a class in each half), and minimum gain in mean recall.
FOLD, WORTH = 96, 0.02


@dataclass(frozen=True)
class Texture:
    """Laws of classes at several scales.

    Attributes
    ----------
    low, high : ndarray (channels,)
        Ends of each law's bins.
    table : ndarray (windows, classes, channels, bins)
        Contribution of a pixel to the log odds of each class.
    offset : ndarray (classes,)
    """

    low: FloatArray
    high: FloatArray
    table: FloatArray
    offset: FloatArray

    def of(self, classes: Sequence[int]) -> Texture:
        """Select the laws of some classes (numbers from 0)."""
        chosen = list(classes)
        return Texture(self.low, self.high, self.table[:, chosen], self.offset[chosen])


def channels(logs: NDArray[np.floating]) -> Single:
    """Log amplitude at several scales, and differences of these averages.

    Parameters
    ----------
    logs : ndarray (rows, columns)
        Log amplitude; NaN where there is none.

    Returns
    -------
    ndarray of float32 (channels, rows, columns)
        NaN where there is none.
    """
    known = np.isfinite(logs)
    every = bool(known.all())
    # relative to the mean level, squares of amplitudes stay in the range of single precision
    middle = float(np.rint(np.mean(logs, where=known))) if known.any() else 0.0
    level = np.where(known, logs - middle, 0.0).astype(np.float32)
    sums = _padded(np.exp(2 * level) * known)
    shares = None if every else _padded(known.astype(np.float32))
    result = np.full((CHANNELS, *logs.shape), np.nan, np.float32)
    for k, scale in enumerate(SCALES):
        if scale > 1:
            sums = _doubled(sums, scale // 2)
            shares = None if shares is None else _doubled(shares, scale // 2)
            mean: NDArray[np.floating] = _inner(sums, scale, logs.shape)
            if shares is None:
                mean = mean / scale**2
            else:
                mean = mean / np.maximum(_inner(shares, scale, logs.shape), 1)
            level = np.log(np.maximum(mean, np.float32(1e-37))) * np.float32(0.5)
        result[k] = level + np.float32(middle)
        if scale in LAGS:
            down, across = (_apart(level, None if every else known, axis, scale) for axis in (0, 1))
            result[len(SCALES) + LAGS.index(scale)] = np.sqrt(down * down + across * across)
    if not every:
        result[:, ~known] = np.nan
    return result


def _padded(values: Single) -> Single:
    """Mirror an image at its edges by the reach of the widest square."""
    half = SCALES[-1] // 2
    return np.pad(values, ((half, half - 1), (half, half - 1)), "symmetric")


def _doubled(sums: Single, side: int) -> Single:
    """Sum over squares of twice the side, from those that begin at each pixel."""
    sums = sums[:-side] + sums[side:]
    return np.asarray(sums[:, :-side] + sums[:, side:])


def _inner(sums: Single, side: int, shape: tuple[int, ...]) -> Single:
    """Cut out the sums about each pixel, one pixel more before it than after."""
    first = SCALES[-1] // 2 - side // 2
    return sums[first : first + shape[0], first : first + shape[1]]


def _box(values: Single, share: Single, side: int, every: bool) -> Single:
    """Mean of known values over squares."""
    mean = uniform_filter(values, side, mode="reflect")
    if every:
        return np.asarray(mean)
    return np.asarray(mean / np.maximum(uniform_filter(share, side, mode="reflect"), 1e-9))


def _apart(level: Single, known: BoolArray | None, axis: int, lag: int) -> Single:
    """Difference across each pixel; 0 where either side is unknown."""
    ahead, behind = lag - lag // 2, lag // 2

    def moved(values: NDArray[Any], step: int) -> NDArray[Any]:
        index = np.clip(np.arange(values.shape[axis]) + step, 0, values.shape[axis] - 1)
        return np.take(values, index, axis)

    apart = moved(level, ahead) - moved(level, -behind)
    if known is not None:
        apart *= moved(known, ahead) & moved(known, -behind)
    return np.asarray(apart)


def learn(
    parts: Sequence[tuple[Single, NDArray[np.integer]]],
    count: int,
    deciding: int = DECIDING,
    cores: bool = False,
) -> Texture:
    """Learn the texture of classes from pixels of known class.

    Parameters
    ----------
    parts : sequence of (channels, class)
        Of each look: :func:`channels`, and the class of each pixel from 1, 0 for none.
    count : int
        Number of classes; at least two, each with marked pixels.
    deciding : int
        Pixels per class in a part from which the weights are fitted.
    cores : bool
        Whether the pixels lie only inside areas of one class, and so carry no information on
        boundaries. Marks made by a person do carry it.

    Returns
    -------
    Texture
    """
    shown = [(found, np.where(np.isfinite(found[0]), marks, 0)) for found, marks in parts]
    low, high, logs = _laws(shown, count)
    ratio = logs - logs[:, :1]
    features, classes = [], []
    for found, marks in shown:
        chosen = _deciding(marks, count, deciding)
        if chosen[0].size:
            features.append(_smoothed(found, low, high, ratio, chosen))
            classes.append(marks[chosen] - 1)
    every, known = np.concatenate(features, axis=1), np.concatenate(classes)
    weight, offset = _weights(every, known, count)
    if cores:
        offset = offset + _midway(weight @ every + offset[:, None], known)
    weight = weight.reshape(count, CHANNELS, count - 1, len(WINDOWS))
    table = np.einsum("kcjw,cjb->wkcb", weight, ratio[:, 1:])
    return Texture(low, high, table, offset)


def _laws(
    shown: Sequence[tuple[Single, NDArray[np.integer]]], count: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Set the bins (ends: channels,) and estimate the log density of each class in them."""
    low, high = np.empty(CHANNELS), np.empty(CHANNELS)
    logs = np.empty((CHANNELS, count, BINS))
    for c in range(CHANNELS):
        values = [[found[c][marks == k + 1] for found, marks in shown] for k in range(count)]
        each = [np.concatenate(v) for v in values]
        ends = np.array([np.quantile(v, [TAILS, 1 - TAILS]) for v in each])
        low[c], high[c] = ends[:, 0].min(), max(ends[:, 1].max(), ends[:, 0].min() + 1e-6)
        for k, v in enumerate(each):
            counts = np.bincount(_binned(v, low[c], high[c]), minlength=BINS) + PRIOR
            logs[c, k] = np.log(counts / counts.sum())
    return low, high, logs


def _binned(values: NDArray[np.floating], low: float, high: float) -> IntArray:
    place = (values - low) * (BINS / (high - low))
    return np.asarray(np.clip(np.nan_to_num(place), 0, BINS - 1), np.int64)


def _deciding(marks: NDArray[np.integer], count: int, most: int) -> tuple[IntArray, ...]:
    """Select pixels of each class, evenly thinned."""
    places = []
    for k in range(1, count + 1):
        index = np.flatnonzero(marks == k)
        # an odd step reaches all columns
        places.append(index[:: max(index.size // most, 1) | 1])
    return np.unravel_index(np.concatenate(places), marks.shape)


def _smoothed(
    found: Single,
    low: FloatArray,
    high: FloatArray,
    ratio: FloatArray,
    chosen: tuple[IntArray, ...],
) -> FloatArray:
    """Log ratios of laws over windows at chosen pixels (channels x (classes - 1) x windows, n)."""
    known = np.isfinite(found[0])
    shares = _window_sums(known.astype(np.float32), chosen)
    rows = []
    for c in range(CHANNELS):
        bins = _binned(found[c], low[c], high[c])
        for table in ratio[c, 1:]:
            values = table.astype(np.float32)[bins] * known
            rows += list(_window_sums(values, chosen) / shares)
    return np.array(rows, np.float64)


def _window_sums(values: Single, chosen: tuple[IntArray, ...]) -> FloatArray:
    """Sum over all windows about chosen pixels (windows, n), mirrored at the edges."""
    half = WINDOWS[-1] // 2
    wide = np.pad(values, half, "symmetric").astype(float)
    total = np.pad(wide.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = []
    for window in WINDOWS:
        first, last = half - window // 2, half + window // 2 + 1
        rows, columns = ((c + first, c + last) for c in chosen)
        sums.append(
            total[rows[1], columns[1]]
            - total[rows[0], columns[1]]
            - total[rows[1], columns[0]]
            + total[rows[0], columns[0]]
        )
    return np.array(sums)


def _weights(features: FloatArray, classes: IntArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Fit a multinomial logistic regression in which each class has the same weight."""
    n, total = features.shape
    mean, sd = features.mean(axis=1), features.std(axis=1) + 1e-9
    z = (features - mean[:, None]) / sd[:, None]
    say = (1 / (count * np.bincount(classes, minlength=count)))[classes]
    each = np.arange(total)

    def loss(p: FloatArray) -> tuple[float, FloatArray]:
        weight, offset = p[: count * n].reshape(count, n), p[count * n :]
        level = weight @ z + offset[:, None]
        level -= level.max(axis=0)
        share = np.exp(level)
        share /= share.sum(axis=0)
        value = -float(say @ np.log(share[classes, each] + 1e-12)) + STIFF * float(
            (weight**2).sum()
        )
        share[classes, each] -= 1
        share *= say
        slope = np.concatenate([(share @ z.T + 2 * STIFF * weight).ravel(), share.sum(axis=1)])
        return value, slope

    best = minimize(
        loss, np.zeros(count * (n + 1)), jac=True, method="L-BFGS-B", options={"maxiter": 200}
    ).x
    weight = best[: count * n].reshape(count, n) / sd
    return weight, best[count * n :] - weight @ mean


def _midway(scores: FloatArray, classes: IntArray) -> FloatArray:
    """Offsets (classes,) that make the log odds of a half-and-half window zero.

    The log odds of a window go from those of one class to those of the other as its share grows,
    and are 0 in the middle if both are equally large. Where one class has more evidence per pixel
    than the other, the boundary would be shifted in its favour.
    """
    each = range(len(scores))
    level = np.array([np.median(scores[:, classes == k], axis=1) for k in each]).T
    own = np.diag(level)
    ahead = own[:, None] - level.T  # log odds of class k over class j on floor of class k
    return np.asarray((ahead.T - ahead).mean(axis=1) / 2)


def evidence(texture: Texture, found: Single) -> Single:
    """Log odds of each class at each pixel, up to a constant.

    Parameters
    ----------
    texture : Texture
    found : ndarray of float32 (channels, rows, columns)
        Of :func:`channels`.

    Returns
    -------
    ndarray of float32 (classes, rows, columns)
        NaN where there is no amplitude.
    """
    known = np.isfinite(found[0])
    share, every = known.astype(np.float32), bool(known.all())
    count = texture.offset.size
    result = np.empty((count, *known.shape), np.float32)
    result[:] = texture.offset[:, None, None]
    sums = np.empty_like(result)
    scale = BINS / (texture.high - texture.low)
    for window, table in zip(WINDOWS, texture.table, strict=True):
        _add_up(found, texture.low, scale, table.astype(np.float32), sums)
        for k in range(count):
            result[k] += _box(sums[k], share, window, every)
    result[:, ~known] = np.nan
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_up(found, low, scale, table, result):  # type: ignore[no-untyped-def]
    """Sum each class's table values over all channels, pixel by pixel."""
    channels, rows, columns = found.shape
    classes, _, bins = table.shape
    for r in range(rows):
        for c in range(columns):
            for k in range(classes):
                result[k, r, c] = 0.0
            if np.isnan(found[0, r, c]):
                continue
            for i in range(channels):
                place = int(min(max((found[i, r, c] - low[i]) * scale[i], 0.0), bins - 1.0))
                for k in range(classes):
                    result[k, r, c] += table[k, i, place]


def tells_more(
    parts: Sequence[tuple[Single, NDArray[np.integer]]],
    amplitude: Sequence[NDArray[np.floating]],
    count: int,
    deciding: int = DECIDING,
) -> bool:
    """Whether texture separates known classes better than their amplitude laws do.

    Cross-validated: learned on half of a chequerboard's squares, tested on the other, and swapped.

    Parameters
    ----------
    parts : sequence of (channels, class)
        As for :func:`learn`.
    amplitude : sequence of ndarray (classes, rows, columns)
        Log likelihoods of the classes' laws at each pixel of each look.
    count, deciding : int

    Returns
    -------
    bool
        False where a half has too few pixels of a class for a test.
    """
    right = np.zeros((2, count))
    total = np.zeros(count)
    for half in (0, 1):
        learned = [
            (found, np.where(_board(marks.shape) == half, marks, 0)) for found, marks in parts
        ]
        judged = [np.where(_board(marks.shape) != half, marks, 0) for _, marks in parts]
        for side in ([m for _, m in learned], judged):
            there = sum(np.bincount(m.ravel(), minlength=count + 1)[1:] for m in side)
            if np.min(there) < FOLD:
                return False
        texture = learn(learned, count, deciding)
        for (found, _), marks, level in zip(parts, judged, amplitude, strict=True):
            known = np.isfinite(found[0]) & (marks > 0)
            windowed = np.stack(
                [uniform_filter(np.nan_to_num(v), WINDOWS[-1], mode="reflect") for v in level]
            )
            for i, scores in enumerate((windowed, evidence(texture, found))):
                hit = known & (np.argmax(np.nan_to_num(scores), axis=0) + 1 == marks)
                right[i] += np.bincount(marks[hit], minlength=count + 1)[1:]
            total += np.bincount(marks[known], minlength=count + 1)[1:]
    recall = (right / np.maximum(total, 1)).mean(axis=1)
    return bool(recall[1] > recall[0] + WORTH)


def _board(shape: tuple[int, ...]) -> IntArray:
    """Chequerboard of 0 and 1."""
    r, c = (np.arange(n) // FOLD for n in shape)
    return np.asarray((r[:, None] + c) % 2)
