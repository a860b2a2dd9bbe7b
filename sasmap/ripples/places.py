"""What a wave of a clip's spectrum looks like in the clip: ripples, lines, or a thing on the floor.

A spectrum does not tell several waves of a floor from one edge, a few lines or a wreck's ribs.
Where the wave's energy lies, and the shape of its crests, do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.pixels import box_sums, profile_boxes, wave_boxes

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Least strip along the crest normal, over the clip's longer side.
STRIP = 1 / 16
# Parts of a wavelength in which a crest's shape is told, of waves that are long enough.
FINE, LONG_ENOUGH = 6, 12.0
# Share of a profile's variance that is not speckle from which its shape begins to count, and fully.
SHAPE_FROM, SHAPE_SURE = 0.3, 0.6
# Skewness of a profile whose lines are dark, and of one whose lines are not: where shadow sets in
# it is -0.7 to -0.9, of marks and things on the floor 0 to 3 (pipelines/ripples/floors.py).
DARK_SKEW = (-0.5, -0.2)
# Share of a clip that a thing's waves cover at most, and surely; level (of the clip's) of shadow;
# weights of brightness and of shadow. Of simulated wrecks: 1.2 to 1.6 times as bright as the floor,
# 1 to 8 % of the clip in shadow, 3 to 13 % of it covered; ripples are 0.96 to 1.05 times as bright.
LARGE, SMALL, DARK, BRIGHT, SHADED = 0.35, 0.2, 0.5, 14.0, 55.0
# Pixels a side of the boxes that tell how an image was compressed, standard deviation of Rayleigh
# speckle over its mean, and the least power that is believed.
SPECKLED, RAYLEIGH, LEAST_POWER = 8, 0.523, 0.3


class Extents(NamedTuple):
    """Over how many wavelengths a wave extends.

    Attributes
    ----------
    normal, crests : float
        Along its normal, and along its crests.
    room : float
        What there is to extend over along the normal, over that along the crests.
    """

    normal: float
    crests: float
    room: float


def _width(shape: tuple[int, ...], wave: tuple[float, float]) -> float:
    return max(1 / float(np.hypot(*wave)), STRIP * max(shape))


def extents(flat: FloatArray, valid: BoolArray, per_pixel: FloatArray) -> Extents:
    """Tell how far a wave's energy extends in a clip, or in a part of it: participation ratios.

    Mean over strips along the normal (and over wavelengths, along the crests), by their energy: a
    boundary crosses each strip once. Coherent sums over boxes a wavelength long and a strip wide,
    less what speckle leaves in them.

    Parameters
    ----------
    flat : ndarray (rows, columns)
        Amplitude over its trend, less 1; 0 where not valid.
    valid : ndarray of bool (rows, columns)
    per_pixel : ndarray (2,)
        Cycles per column and row.

    Returns
    -------
    Extents
    """
    wave = float(per_pixel[0]), float(per_pixel[1])
    width = _width(flat.shape, wave)
    turned, noise, count = wave_boxes(flat, valid, *wave, width)
    full = count > 0.5 * np.quantile(count[count > 0], 0.9)
    mean_noise = noise.sum() / max(count.sum(), 1.0)
    # a box of one bright thing weighs no more than the rest
    excess = np.abs(turned) ** 2 - np.maximum(noise, mean_noise * count)
    energy = np.maximum(np.where(full, excess / np.maximum(count, 1.0), 0.0), 0.0)
    wide = width * float(np.hypot(*wave))
    room = full.any(axis=1).sum() / (full.any(axis=0).sum() * wide)
    return Extents(_participation(energy, 0), _participation(energy, 1) * wide, float(room))


def _participation(energy: FloatArray, axis: int) -> float:
    """Boxes along an axis that energy is spread over, a mean by energy."""
    line, square = energy.sum(axis=axis), (energy**2).sum(axis=axis)
    if not square.max() > 0:
        return 0.0
    ratio = line**2 / np.where(square > 0, square, 1.0)
    return float((line * ratio).sum() / line.sum())


def contrast_of(flat: FloatArray, valid: BoolArray, per_pixel: FloatArray) -> float:
    """Amplitude of a wave where it is: mean over boxes a wavelength a side, by their energy.

    Parameters
    ----------
    flat, valid, per_pixel
        As of :func:`extents`.

    Returns
    -------
    float
    """
    size = max(round(1 / float(np.hypot(*per_pixel))), 2)
    turned, count = box_sums(flat, valid, float(per_pixel[0]), float(per_pixel[1]), size)
    full = count > 0.4 * size * size
    variance = float((flat**2).sum()) / max(int(valid.sum()), 1)
    energy = np.maximum(np.abs(turned[full]) ** 2 / count[full] - variance, 0.0)
    total = float(energy.sum())
    return 2 * float(np.sqrt((energy**2).sum() / total)) / size if total > 0 else 0.0


def lines_of(flat: FloatArray, valid: BoolArray, per_pixel: FloatArray) -> float:
    """Tell how far crests are thin bright lines with wide gaps.

    Parameters
    ----------
    flat, valid, per_pixel
        As of :func:`extents`.

    Returns
    -------
    float
        Excess kurtosis of profiles across the crests: -1.5 of a sine, 0 of crests of a fifth of a
        wave, positive of lines. Speckle, averaged, gives none; thin dark lines are the shadows of
        low ripples and count for nothing.
    """
    wave = float(per_pixel[0]), float(per_pixel[1])
    variance = float((flat**2).sum()) / max(int(valid.sum()), 1)
    length = 1 / float(np.hypot(*wave))
    parts = FINE if length > LONG_ENOUGH else max(int(length / 2), 2)
    total, count = profile_boxes(flat, valid, *wave, parts, _width(flat.shape, wave))
    full = count > 0.5 * np.quantile(count[count > 0], 0.9)
    level = np.where(full, total / np.maximum(count, 1.0), 0.0)
    level = level - level.sum(axis=0) / np.maximum(full.sum(axis=0), 1)
    shown = level[full]
    speckle = variance / float(np.median(count[full]))
    second, third, fourth = (float((shown**k).mean()) for k in (2, 3, 4))
    signal = max(second - speckle, 1e-12)
    sure = np.clip((signal / max(second, 1e-12) - SHAPE_FROM) / (SHAPE_SURE - SHAPE_FROM), 0, 1)
    bright = np.clip((third / signal**1.5 - DARK_SKEW[0]) / (DARK_SKEW[1] - DARK_SKEW[0]), 0, 1)
    return float(sure * bright * (fourth - 3 * second**2) / signal**2)


def objectness(flat: FloatArray, valid: BoolArray, per_pixel: FloatArray) -> float:
    """How much a wave looks like a thing on the floor: bright, in one place, with a shadow.

    Ripples scatter as much as the floor around them, over a wavelength, and their shadow is
    shorter than one. What a wreck's ribs show is small, brighter than the floor, and beside it the
    floor lies dark.

    Parameters
    ----------
    flat : ndarray (rows, columns)
        Amplitude of the whole clip over its trend, less 1; 0 where not valid.
    valid : ndarray of bool (rows, columns)
    per_pixel : ndarray (2,)
        Cycles per column and row.

    Returns
    -------
    float
        1 where it is as likely a thing as not.
    """
    wave = float(per_pixel[0]), float(per_pixel[1])
    size = max(round(1 / float(np.hypot(*wave))), 2)
    turned, count = box_sums(flat, valid, *wave, size)
    total = box_sums(flat, valid, 0.0, 0.0, size)[0].real
    full = count > 0.4 * size * size
    if full.sum() < 4:
        return 0.0
    variance = float((flat[valid] ** 2).mean())
    energy = np.maximum(np.abs(turned[full]) ** 2 / count[full] - variance, 0.0)
    if not energy.max() > 0:
        return 0.0
    level = 1 + total[full] / count[full]
    share = float(energy.sum() ** 2 / (energy.size * (energy**2).sum()))
    weight = np.sqrt(energy)
    around = max(float(np.median(level[energy <= np.median(energy)])), 1e-9)
    level = (np.maximum(level, 0) / around) ** (1 / _compression(flat, valid))
    bright = float((weight * level).sum() / weight.sum()) - 1
    dark = float((level < DARK * np.median(level)).mean())
    small = float(np.clip((LARGE - share) / (LARGE - SMALL), 0, 1))
    return small * (BRIGHT * max(bright, 0.0) + SHADED * dark)


def _compression(flat: FloatArray, valid: BoolArray) -> float:
    """Power of the amplitude that a clip shows: below 1 where it was scaled for display.

    Tells by the speckle of small boxes, which has a standard deviation of 0.52 of its mean.
    """
    mean, count = box_sums(flat, valid, 0.0, 0.0, SPECKLED)
    square = box_sums(flat**2, valid, 0.0, 0.0, SPECKLED)[0].real
    full = count > 0.5 * SPECKLED**2
    if not full.any():
        return 1.0
    level = mean[full].real / count[full]
    variance = square[full] / count[full] - level**2
    spread = float(np.median(np.sqrt(np.maximum(variance, 0)) / np.maximum(1 + level, 0.05)))
    return float(np.clip(spread / RAYLEIGH, LEAST_POWER, 1.0))
