"""Altitude of a side-scan sonar from its water column: the first echo is the sea floor below."""

from __future__ import annotations

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from sasmap.arrays import FloatArray, IntArray

# Pings and samples over which the logarithm of amplitude is averaged: this reduces speckle but
# keeps the step from water to floor.
PINGS, SAMPLES = 5, 5
# Extent of the transmitted pulse and its ringing, and largest altitude, as shares of the range
# (less than a fifth of the range of floor is not a record).
PULSE, DEEPEST = 0.02, 0.8
# Floor of amplitude over its mean: 60 dB cover any water column.
SMALLEST = 0.001
# Samples on either side over which the step is computed (a choice).
REACH = 12
# Share of the rise from water to floor that marks its onset (a choice).
RISEN = 0.08
# Most samples that the bottom moves from one ping to the next, and pings of the final median.
STRIDE, MEDIAN = 3, 9


def altitude_of(samples: list[NDArray[np.generic]], spacing: FloatArray) -> FloatArray:
    """Find the sea floor below the sonar in every ping.

    Parameters
    ----------
    samples : list of ndarray (pings, samples)
        One or both sides, nearest sample first.
    spacing : ndarray (pings,)
        Range a sample, m.

    Returns
    -------
    ndarray (pings,)
        Altitude, m. Dynamic programming finds the path through all pings with the largest step of
        the mean log amplitude; it is then moved back to the onset of the rise, because a
        side-looking sonar receives a weak echo from straight below.
    """
    length = min(s.shape[1] for s in samples)
    stacked = np.mean([_logarithm(s[:, :length]) for s in samples], axis=0)
    level = scipy.ndimage.uniform_filter(stacked, (PINGS, SAMPLES))
    total = np.cumsum(level, axis=1)
    first, last = max(int(PULSE * length), REACH + 1), int(DEEPEST * length)
    at = np.arange(first, max(last, first + 1)).clip(max=length - REACH - 1)
    before = (total[:, at - 1] - total[:, at - REACH - 1]) / REACH
    after = (total[:, at + REACH - 1] - total[:, at - 1]) / REACH
    path = _onset(level, at[_best_path(after - before)], first)
    # the average at the last quiet sample contains no floor yet
    path = path + SAMPLES // 2 + 1
    smooth = scipy.ndimage.median_filter(path.astype(float), MEDIAN, mode="nearest")
    return np.asarray(smooth * spacing, float)


def _logarithm(samples: NDArray[np.generic]) -> FloatArray:
    """Logarithm of amplitude over its mean, bounded below."""
    values = samples.astype(float)
    floor = SMALLEST * max(float(values.mean()), np.finfo(float).tiny)
    return np.asarray(np.log1p(values / floor), float)


def _onset(level: FloatArray, path: IntArray, first: int) -> IntArray:
    """Last sample before the step that is close to the level of the water column."""
    onset = path.copy()
    for k, step in enumerate(path):
        water = _water(level[k], first, int(step))
        top = float(level[k, min(step + REACH, level.shape[1] - 1)])
        risen = water + RISEN * np.maximum(top - water, 0.0)
        quiet = np.flatnonzero(level[k, first : step + 1] < risen)
        onset[k] = first + quiet[-1] if quiet.size else step
    return onset


def _water(level: FloatArray, first: int, step: int) -> FloatArray:
    """Level of the water column from sample `first` to the step.

    Time-varied gain raises noise with range: the level is fitted over two thirds of the column and
    extrapolated, linear in the logarithm of range.
    """
    third = max((step - REACH - first) // 3, 1)
    near = float(np.median(level[first : first + third]))
    far = float(np.median(level[first + third : first + 2 * third]))
    place = np.log(np.arange(first, step + 1) + 0.5)
    middle = np.log(first + (0.5 + np.arange(2)) * third)
    slope = max((far - near) / float(middle[1] - middle[0]), 0.0)  # ringing decays: not gain
    return np.asarray(far + slope * np.maximum(place - middle[1], 0.0), float)


def _best_path(score: FloatArray) -> IntArray:
    """Column of each row with the largest sum of scores and short steps."""
    pings, places = score.shape
    total = score[0]
    back = np.zeros((pings, places), np.int64)
    for k in range(1, pings):
        best, origin = total.copy(), np.arange(places)
        for step in (*range(-STRIDE, 0), *range(1, STRIDE + 1)):
            moved = np.full(places, -np.inf)
            moved[max(step, 0) : places + min(step, 0)] = total[
                max(-step, 0) : places - max(step, 0)
            ]
            better = moved > best
            best[better] = moved[better]
            origin[better] = np.flatnonzero(better) - step
        back[k] = origin
        total = best + score[k]
    path = np.empty(pings, np.int64)
    path[-1] = int(total.argmax())
    for k in range(pings - 1, 0, -1):
        path[k - 1] = back[k, path[k]]
    return path
