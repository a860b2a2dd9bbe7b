"""Removal of the smooth trend and of the pings' gains from a clip's amplitude."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.image import Image

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Amplitudes are clipped at this multiple of their trend (Rayleigh speckle exceeds it in 1e-4 of
# pixels).
CAP = 3.5
# Number of blocks along a side to which the trend is fitted, and degree of its polynomial, which is
# smoother than 3.5 waves per clip.
BLOCKS, DEGREE = 16, 4
# Least trend over the mean amplitude; bounds of a ping's gain.
LEAST_TREND, GAINS = 0.1, (0.2, 5.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _block_sums(power, valid, row_block, column_block):  # type: ignore[no-untyped-def]
    """Sum amplitudes and count valid pixels in blocks; return the amplitude as well."""
    rows, columns = power.shape
    amplitude = np.zeros((rows, columns))
    total = np.zeros((row_block[-1] + 1, column_block[-1] + 1))
    count = np.zeros_like(total)
    for i in range(rows):
        a = row_block[i]
        for j in range(columns):
            if valid[i, j]:
                value = np.sqrt(power[i, j])
                amplitude[i, j] = value
                total[a, column_block[j]] += value
                count[a, column_block[j]] += 1.0
    return amplitude, total, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _over_trend(amplitude, valid, by_row, column, least, per_pixel, pings):  # type: ignore[no-untyped-def]
    """Divide an amplitude by its trend, in place, and sum it by pings.

    `by_row` (rows, degree + 1) are the coefficients of powers of `column`, the column's coordinate;
    `per_pixel` holds the pings per column and row, and the first pixel's ping. Returns sums and
    numbers of pixels.
    """
    rows, columns = amplitude.shape
    total, pixels = np.zeros(pings), np.zeros(pings)
    for i in range(rows):
        for j in range(columns):
            if not valid[i, j]:
                continue
            trend = 0.0
            for k in range(by_row.shape[1] - 1, -1, -1):
                trend = trend * column[j] + by_row[i, k]
            value = min(amplitude[i, j] / max(trend, least), CAP)
            amplitude[i, j] = value
            ping = int(np.rint(per_pixel[2] + per_pixel[0] * j + per_pixel[1] * i))
            total[ping] += value
            pixels[ping] += 1.0
    return total, pixels


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _without_gains(level, valid, gains, per_pixel):  # type: ignore[no-untyped-def]
    """Divide by the gains of pings and subtract the mean, in place."""
    rows, columns = level.shape
    total, count = 0.0, 0
    for i in range(rows):
        for j in range(columns):
            if valid[i, j]:
                ping = int(np.rint(per_pixel[2] + per_pixel[0] * j + per_pixel[1] * i))
                level[i, j] /= gains[ping]
                total += level[i, j]
                count += 1
    mean = total / max(count, 1)
    for i in range(rows):
        for j in range(columns):
            if valid[i, j]:
                level[i, j] -= mean


def _trend(total: FloatArray, count: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Fit a polynomial of degree 4 in row and column to the means of blocks.

    Returns its coefficients (powers of the row coordinate, powers of the column coordinate), both
    coordinates from -1 to 1.
    """
    used = count > 0.1 * count.max()
    mean = total / np.maximum(count, 1)
    y, x = ((_edges(n)[1:] + _edges(n)[:-1] - n) / n for n in shape)
    degree = min(DEGREE, int(np.sqrt(used.sum())) - 1)
    terms = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    design = np.stack([np.multiply.outer(y**i, x**j)[used] for i, j in terms], axis=-1)
    weight = np.sqrt(count[used])
    fit = np.linalg.lstsq(design * weight[:, None], mean[used] * weight, rcond=None)[0]
    factors = np.zeros((degree + 1, degree + 1))
    for factor, (i, j) in zip(fit, terms, strict=True):
        factors[i, j] = factor
    return factors


def _edges(count: int) -> NDArray[np.int64]:
    """Edges of the blocks along a side."""
    return np.linspace(0, count, min(BLOCKS, count) + 1).astype(np.int64)


def _places(count: int) -> FloatArray:
    return np.asarray((2 * np.arange(count) + 1 - count) / count)


def flattened(image: Image) -> tuple[FloatArray, FloatArray]:
    """Remove trend and gains of pings from a clip's amplitude.

    Returns
    -------
    flat : ndarray (rows, columns)
        Amplitude over its smooth trend and over the mean along each ping, minus 1; 0 where not
        valid.
    gains : ndarray (pings,)
        The means, one per pixel across the look; 1 where there is none.
    """
    blocks = [np.repeat(np.arange(len(e) - 1), np.diff(e)) for e in map(_edges, image.shape)]
    level, total, count = _block_sums(image.power, image.valid, *blocks)
    factors = _trend(total, count, image.shape)
    by_row = _places(image.shape[0])[:, None] ** np.arange(len(factors)) @ factors
    least = LEAST_TREND * float(total.sum()) / max(float(count.sum()), 1.0)
    per_pixel, pings = _pings(image)
    column = _places(image.shape[1])
    total, pixels = _over_trend(level, image.valid, by_row, column, least, per_pixel, pings)
    mean = max(float(total.sum()) / max(float(pixels.sum()), 1.0), 1e-9)
    gains = np.where(pixels > 0, total / np.maximum(pixels, 1) / mean, 1.0)
    gains = np.asarray(np.clip(gains, *GAINS))
    _without_gains(level, image.valid, gains * mean, per_pixel)
    return level, gains


def _pings(image: Image) -> tuple[FloatArray, int]:
    """Pings per column, per row, and at the first pixel, and their number; one is a pixel wide."""
    across = image.beside @ image.steps / image.pixel_size
    ends = across * (np.array(image.shape[::-1]) - 1)
    first = -float(np.minimum(ends, 0).sum())
    return np.array([*across, first]), int(np.rint(np.abs(ends).sum())) + 1
