"""Removal of the smooth trend and of the pings' gains from a clip's amplitude."""

from __future__ import annotations

import numpy as np

from sasmap.arrays import FloatArray, IntArray
from sasmap.ripples.image import Image

# Amplitudes are clipped at this multiple of their trend (Rayleigh speckle exceeds it in 1e-4 of
# pixels).
CAP = 3.5
# Number of blocks along a side to which the trend is fitted, and degree of its polynomial, which is
# smoother than 3.5 waves per clip.
BLOCKS, DEGREE = 16, 4
# Least trend over the mean amplitude; bounds of a ping's gain.
LEAST_TREND, GAINS = 0.1, (0.2, 5.0)


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


def _edges(count: int) -> IntArray:
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
    edges = [_edges(n) for n in image.shape]
    total, count = (_in_blocks(v, edges) for v in (np.sqrt(image.power), image.valid.astype(float)))
    factors = _trend(total, count, image.shape)
    powers = np.arange(len(factors))
    down, right = (_places(n)[:, None] ** powers for n in image.shape)
    least = LEAST_TREND * float(total.sum()) / max(float(count.sum()), 1.0)
    level = np.sqrt(image.power) / np.maximum(down @ factors @ right.T, least)
    level = np.minimum(level, CAP)
    ping = _pings(image)
    pixels = np.bincount(ping[image.valid], minlength=int(ping.max()) + 1)
    mean = np.bincount(ping.ravel(), level.ravel()) / np.maximum(pixels, 1)
    overall = max(float(level.sum()) / max(int(pixels.sum()), 1), 1e-9)
    gains = np.asarray(np.clip(np.where(pixels > 0, mean / overall, 1.0), *GAINS))
    level = level / (gains * overall)[ping]
    return np.where(image.valid, level - level[image.valid].mean(), 0.0), gains


def _in_blocks(values: FloatArray, edges: list[IntArray]) -> FloatArray:
    """Sum values (rows, columns) over blocks between edges."""
    rows = np.add.reduceat(values, edges[0][:-1], axis=0)
    return np.asarray(np.add.reduceat(rows, edges[1][:-1], axis=1))


def _pings(image: Image) -> IntArray:
    """Return the number of each pixel's ping (rows, columns), from 0; a ping is a pixel wide."""
    across = image.beside @ image.steps / image.pixel_size
    row, column = np.ogrid[: image.shape[0], : image.shape[1]]
    place = across[0] * column + across[1] * row
    return np.asarray(np.rint(place - place.min()), np.int64)
