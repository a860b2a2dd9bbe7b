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
LARGE, SMALL, DARK, BRIGHT, SHADED = 0.35, 0.2, 0.5, 8.0, 28.0


class Look(NamedTuple):
    """What a wave looks like in a clip.

    Attributes
    ----------
    extent : float
        Wavelengths along its normal that it extends over.
    contrast : float
        Of the amplitude, where the wave is.
    lines : float
        How far its crests are thin bright lines with wide gaps: excess kurtosis of the profile
        across them (-1.5 for a sine, 0 for crests of a fifth of a wave, positive for lines).
    """

    extent: float
    contrast: float
    lines: float


def look_at(flat: FloatArray, valid: BoolArray, per_pixel: FloatArray) -> Look:
    """Tell what a wave looks like in a clip, or in a part of it.

    Parameters
    ----------
    flat : ndarray (rows, columns)
        Amplitude over its trend, less 1; 0 where not valid.
    valid : ndarray of bool (rows, columns)
    per_pixel : ndarray (2,)
        Cycles a column and a row.

    Returns
    -------
    Look
    """
    variance = float((flat[valid] ** 2).mean())
    wave = float(per_pixel[0]), float(per_pixel[1])
    extent = _extent(flat, valid, wave)
    contrast = _contrast(flat, valid, wave, variance)
    return Look(extent, contrast, _lines(flat, valid, wave, variance))


def _width(shape: tuple[int, ...], wave: tuple[float, float]) -> float:
    return max(1 / float(np.hypot(*wave)), STRIP * max(shape))


def _extent(flat: FloatArray, valid: BoolArray, wave: tuple[float, float]) -> float:
    """Wavelengths along its normal over which a wave's energy extends: a participation ratio.

    Mean over strips along the normal, by their energy: a boundary crosses each strip once.
    Coherent sums over boxes a wavelength long and a strip wide, less what speckle leaves in them.
    """
    turned, noise, count = wave_boxes(flat, valid, *wave, _width(flat.shape, wave))
    full = count > 0.5 * np.quantile(count[count > 0], 0.9)
    mean_noise = noise.sum() / max(count.sum(), 1.0)
    # a box of one bright thing weighs no more than the rest
    excess = np.abs(turned) ** 2 - np.maximum(noise, mean_noise * count)
    energy = np.maximum(np.where(full, excess / np.maximum(count, 1.0), 0.0), 0.0)
    strip, square = energy.sum(axis=0), (energy**2).sum(axis=0)
    if not square.max() > 0:
        return 0.0
    ratio = strip**2 / np.where(square > 0, square, 1.0)
    return float((strip * ratio).sum() / strip.sum())


def _contrast(
    flat: FloatArray, valid: BoolArray, wave: tuple[float, float], variance: float
) -> float:
    """Amplitude of a wave where it is: mean over boxes a wavelength a side, by their energy."""
    size = max(round(1 / float(np.hypot(*wave))), 2)
    turned, count = box_sums(flat, valid, *wave, size)
    full = count > 0.4 * size * size
    energy = np.maximum(np.abs(turned[full]) ** 2 / count[full] - variance, 0.0)
    total = float(energy.sum())
    return 2 * float(np.sqrt((energy**2).sum() / total)) / size if total > 0 else 0.0


def _lines(flat: FloatArray, valid: BoolArray, wave: tuple[float, float], variance: float) -> float:
    """Excess kurtosis of profiles across crests; speckle, averaged, gives them none.

    Thin dark lines are the shadows of low ripples: they count for nothing.
    """
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
        Cycles a column and a row.

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
    bright = float((weight * level).sum() / weight.sum()) / around - 1
    dark = float((level < DARK * np.median(level)).mean())
    small = float(np.clip((LARGE - share) / (LARGE - SMALL), 0, 1))
    return small * (BRIGHT * max(bright, 0.0) + SHADED * dark)
