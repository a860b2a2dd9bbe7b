"""Texture in space: amplitude laws at several scales, as one likelihood of what a floor is.

One-point statistics cannot tell a rippled bed, a boulder field and a flat floor of one histogram
apart. Averaging intensity over 2, 4, 8 and 16 pixels turns the correlation of texture into the
law's shape at each scale (speckle goes to a Gaussian at once, correlated texture keeps its shape),
and how much the averages of neighbours differ tells at which scale it ends, in any direction. Each
of these laws is a table of log densities a class. They overlap, so their sum is no likelihood but a
composite one, whose weights are those that best tell the classes' own pixels apart (multinomial
logistic regression; Varin, Reid and Firth 2011, An overview of composite likelihood methods).
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

FloatArray = NDArray[np.float64]
Single = NDArray[np.float32]

# Pixels over which intensity is averaged, and pixels apart (and averaged) of its differences.
SCALES, LAGS = (1, 2, 4, 8, 16), (1, 2, 4, 8)
CHANNELS = len(SCALES) + len(LAGS)
# Pixels a side of the windows that laws are averaged over. On hand-labelled strips 33 alone has a
# mean recall of 0.872, 17 alone 0.858, both 9 and 33 have 0.880.
WINDOWS = (9, 33)
# Pixels of a window's evidence that one boundary may count as its own: a quarter of the largest.
SHARED = 300.0
# Pixels around a place that decide its channels (half the coarsest scale, or half the coarsest lag
# and half of what is averaged), and its evidence: half a window more. Whole blocks.
REACH, MARGIN = 16, 32
BINS, TAILS = 60, 0.0005
# Samples that stand in a bin before any are counted.
PRIOR = 2.0
# Strength of the prior on standardised weights, of the mean log loss (0.001 to 0.01 are alike), and
# pixels of a class that decide the weights.
STIFF, DECIDING = 3e-3, 6000
# Pixels a side of the squares by which it is tried whether texture tells more than amplitude, and
# by how much it must, in mean recall.
FOLD, WORTH = 96, 0.02


@dataclass(frozen=True)
class Texture:
    """Laws of classes at several scales.

    Attributes
    ----------
    low, high : ndarray (channels,)
        Ends of each law's bins.
    table : ndarray (windows, classes, channels, bins)
        What a pixel adds to the log odds of each class.
    offset : ndarray (classes,)
    """

    low: FloatArray
    high: FloatArray
    table: FloatArray
    offset: FloatArray

    def of(self, classes: Sequence[int]) -> Texture:
        """Laws of some classes (from 0)."""
        chosen = list(classes)
        return Texture(self.low, self.high, self.table[:, chosen], self.offset[chosen])


def channels(logs: NDArray[np.floating]) -> Single:
    """Log amplitude at several scales, and differences of what is so averaged.

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
    # single precision holds squares of amplitudes about the middle one, whatever their unit
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
    """Mirror an image at its edges as far as the widest square reaches."""
    half = SCALES[-1] // 2
    return np.pad(values, ((half, half - 1), (half, half - 1)), "symmetric")


def _doubled(sums: Single, side: int) -> Single:
    """Add up squares of twice the side, of those that begin at each pixel."""
    sums = sums[:-side] + sums[side:]
    return np.asarray(sums[:, :-side] + sums[:, side:])


def _inner(sums: Single, side: int, shape: tuple[int, ...]) -> Single:
    """Cut out the sums about each pixel, one pixel more before it than after."""
    first = SCALES[-1] // 2 - side // 2
    return sums[first : first + shape[0], first : first + shape[1]]


def _box(values: Single, share: Single, side: int, every: bool) -> Single:
    """Mean of what is known over squares."""
    mean = uniform_filter(values, side, mode="reflect")
    if every:
        return np.asarray(mean)
    return np.asarray(mean / np.maximum(uniform_filter(share, side, mode="reflect"), 1e-9))


def _apart(level: Single, known: NDArray[np.bool_] | None, axis: int, lag: int) -> Single:
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
    """Learn what classes look like from pixels at which they are known.

    Parameters
    ----------
    parts : sequence of (channels, class)
        Of each look: :func:`channels`, and from 1 the class of each pixel, 0 for none.
    count : int
        Classes; at least two, each of them shown.
    deciding : int
        Pixels of a class in a part that decide the weights.
    cores : bool
        Whether these lie inside areas of one class, so that they tell nothing of boundaries. Where
        not, as marks of a person do, they tell where those lie.

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
    """Lay bins (ends: channels,) and count the log density of each class in them."""
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


def _binned(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.int64]:
    place = (values - low) * (BINS / (high - low))
    return np.asarray(np.clip(np.nan_to_num(place), 0, BINS - 1), np.int64)


def _deciding(marks: NDArray[np.integer], count: int, most: int) -> tuple[NDArray[np.int64], ...]:
    """Pixels of each class, evenly thinned."""
    places = []
    for k in range(1, count + 1):
        index = np.flatnonzero(marks == k)
        # an odd step meets all columns
        places.append(index[:: max(index.size // most, 1) | 1])
    return np.unravel_index(np.concatenate(places), marks.shape)


def _smoothed(
    found: Single,
    low: FloatArray,
    high: FloatArray,
    ratio: FloatArray,
    chosen: tuple[NDArray[np.int64], ...],
) -> FloatArray:
    """Log ratios of laws over windows at chosen pixels (channels x classes - 1 x windows, n)."""
    known = np.isfinite(found[0])
    shares = _window_sums(known.astype(np.float32), chosen)
    rows = []
    for c in range(CHANNELS):
        bins = _binned(found[c], low[c], high[c])
        for table in ratio[c, 1:]:
            values = table.astype(np.float32)[bins] * known
            rows += list(_window_sums(values, chosen) / shares)
    return np.array(rows, np.float64)


def _window_sums(values: Single, chosen: tuple[NDArray[np.int64], ...]) -> FloatArray:
    """Add up all windows about chosen pixels (windows, n), mirrored at the edges."""
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


def _weights(
    features: FloatArray, classes: NDArray[np.int64], count: int
) -> tuple[FloatArray, FloatArray]:
    """Multinomial logistic regression, each class with the same say."""
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


def _midway(scores: FloatArray, classes: NDArray[np.int64]) -> FloatArray:
    """Offsets (classes,) that make a window of two halves undecided.

    The log odds of a window go from what one class has to what the other has as its share grows,
    and are 0 in the middle if both are alike away from it. Where one class has more evidence a
    pixel than the other, the boundary would lie in that one's favour.
    """
    each = range(len(scores))
    level = np.array([np.median(scores[:, classes == k], axis=1) for k in each]).T
    own = np.diag(level)
    ahead = own[:, None] - level.T  # of class k in its own floor, over class j
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
    """Add up, pixel by pixel, what the table of each class says of all channels."""
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
    """Whether texture tells known classes apart better than their amplitude laws do.

    Learned on half of the squares of a chequerboard, it is judged on the other half, and back.

    Parameters
    ----------
    parts : sequence of (channels, class)
        As :func:`learn` takes them.
    amplitude : sequence of ndarray (classes, rows, columns)
        Log likelihoods of the classes' laws at each pixel of each look.
    count, deciding : int

    Returns
    -------
    bool
        No where a half lacks a class: nothing can be judged.
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


def _board(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Chequerboard of 0 and 1."""
    r, c = (np.arange(n) // FOLD for n in shape)
    return np.asarray((r[:, None] + c) % 2)
