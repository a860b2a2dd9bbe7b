"""What the correlation of speckle tells: independent samples, noise at a wave, point spread.

:func:`effective_samples` and :func:`noise_factor` estimate one quantity, the spectrum of the
relative intensity over that of independent speckle: towards zero, for averages over an area, and at
the wave number of a ripple, for fits to the ripple.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft2, next_fast_len, rfft2

from sasmap.arrays import BoolArray, FloatArray

# Bounds of the noise factor: two looks averaged give 0.5; no recorded texture came near the upper.
NOISE_BOUNDS = (0.5, 50.0)
# Cosine of the angle to the ripple's wave vector below which the residual is speckle alone (37
# degrees: outside the spread of crests that wander).
BESIDE = 0.8
# Relative intensity above which speckle is clipped (exponential speckle exceeds it in 6e-6).
CLIP = 12.0
# Distance in pixels at which what remains of the correlation is texture, no speckle: point spread
# functions of up to two pixels do not reach it (of wider ones up to 3.4 are measured).
TEXTURED = 6
# Bounds of the correlation of speckle between neighbouring pixels.
CORRELATION = (1e-3, 0.97)
# Most by which a blur is longer in one diagonal direction than in the other, as a correlation.
UPRIGHT = 0.9


def effective_samples(amplitude: ArrayLike) -> float:
    """Effective number of independent samples in an image of correlated speckle.

    Parameters
    ----------
    amplitude : array_like (rows, columns)
        NaN where there is none.

    Returns
    -------
    float
        Number of pixels over the sum of the intensity's autocorrelation where it is significant.
    """
    image = np.asarray(amplitude, float)
    known = np.isfinite(image)
    power = np.where(known, image, 0.0) ** 2
    count = float(known.sum())
    if count < 4 or not power.max() > 0:
        return count
    flat = np.where(known, power - power.sum() / count, 0.0)
    shape = [next_fast_len(2 * n) for n in image.shape]
    product = irfft2(np.abs(rfft2(flat, shape)) ** 2, shape)
    pairs = irfft2(np.abs(rfft2(known.astype(float), shape)) ** 2, shape)
    reach = max(min(min(image.shape) // 4, 16), 1)
    rows, columns = np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)
    near = np.ix_(rows % shape[0], columns % shape[1])
    correlation = product[near] / np.maximum(pairs[near], 1.0) / max(product[0, 0] / count, 1e-300)
    chance = 3 / np.sqrt(np.maximum(pairs[near], 1.0))
    total = float(correlation[correlation > chance].sum())
    return count / max(total, 1.0)


def noise_factor(ratio: FloatArray, wave: FloatArray) -> float:
    """Speckle variance around the ripple's wave number over that of independent speckle.

    Correlated pixels and texture raise the spectrum of the residual there; averaging of looks
    lowers it. The mean over the ring about the wave number is geometric, which suppresses lines.

    Parameters
    ----------
    ratio : ndarray (rows, columns)
        Intensity over its expectation; 0 where there is none.
    wave : ndarray (2,)
        Cycles per column and row.

    Returns
    -------
    float
    """
    used = ratio > 0
    count = int(used.sum())
    mean = ratio[used].mean()
    flat = np.where(used, np.minimum(ratio / mean, CLIP) - 1.0, 0.0)
    power = np.abs(rfft2(flat)) ** 2 / count
    per_column, per_row = wave
    rows, columns = ratio.shape
    radius = np.hypot(np.fft.rfftfreq(columns), np.fft.fftfreq(rows)[:, None])
    number = np.hypot(per_column, per_row)
    # away from the wave's direction, where a misfit of the model has its power
    along = np.fft.rfftfreq(columns) * per_column + np.fft.fftfreq(rows)[:, None] * per_row
    beside = np.abs(along) < BESIDE * number * radius
    ring = (radius > 0.6 * number) & (radius < 1.6 * number) & beside
    if ring.sum() < 20:
        return 1.0
    level = float(np.log(power[ring] + 1e-12).mean() + np.euler_gamma)
    if abs(level) < 2 * np.pi / np.sqrt(6 * ring.sum()):  # two standard deviations
        return 1.0
    return float(np.clip(np.exp(level), *NOISE_BOUNDS))


def point_spread(ratio: FloatArray) -> FloatArray:
    """Estimate how much an image is blurred from the correlation of its speckle.

    Speckle is the sum of many echoes, each with the amplitude's point spread function. Where that
    is a Gaussian of covariance S, the intensity is blurred by one of covariance S / 2 and its
    correlation at a distance t is exp(-t S^-1 t / 2) (Goodman 2007, section 4.5).

    Parameters
    ----------
    ratio : ndarray (rows, columns)
        Intensity over its expectation; 0 where there is none.

    Returns
    -------
    ndarray (2, 2)
        Covariance S / 2 over columns and rows, squared pixels; 0 where neighbouring pixels are
        independent.
    """
    used = ratio > 0
    flat = np.minimum(ratio / ratio[used].mean(), CLIP)
    flat = np.where(used, flat - flat[used].mean(), 0.0)
    steps = (1, 0), (0, 1), (1, 1), (1, -1), (TEXTURED, 0), (0, TEXTURED)
    variance = max(_covariance(flat, used, 0, 0), 1e-300)
    correlation = np.array([_covariance(flat, used, *step) for step in steps]) / variance
    near, texture = correlation[:4], max(correlation[4:].min(), 0.0)
    if near[:2].max() < CORRELATION[0]:
        return np.zeros((2, 2))
    speckle = np.clip((near - texture) / (1.0 - texture), *CORRELATION)
    column, row, falling, rising = -2.0 * np.log(speckle)
    # diagonal neighbours may be independent, which says only that the blur is small
    most = UPRIGHT * np.sqrt(column * row)
    cross = float(np.clip((falling - rising) / 4.0, -most, most))
    return np.asarray(0.5 * np.linalg.inv(np.array([[column, cross], [cross, row]])))


def _covariance(flat: FloatArray, used: BoolArray, column: int, row: int) -> float:
    """Covariance of used pixels of mean 0 with those `column` and `row` (of any sign) farther."""
    rows, columns = flat.shape
    here = (
        slice(max(-row, 0), max(rows - max(row, 0), 0)),
        slice(0, max(columns - column, 0)),
    )
    there = slice(max(row, 0), rows - max(-row, 0)), slice(column, columns)
    both = max(int((used[here] & used[there]).sum()), 1)
    return float((flat[here] * flat[there]).sum()) / both
