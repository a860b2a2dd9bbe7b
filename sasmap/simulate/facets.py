"""Compiled inner loops of coherent scenes: line of sight, random numbers, summation.

They are all in one file: numba caches compiled code on disk per file and misses changes in others.

Random numbers are counter-based: each is a hash (SplitMix64: Steele, Lea & Flood 2014) of a key and
of its place on the sea floor or in the image, so that any part of a pass can be rendered
separately.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np

from sasmap.arrays import ComplexArray, FloatArray, IntArray

# Truncation of the point spread function, standard deviations (1e-14 of its power lies beyond).
REACH = 5.5
# Margin of grid points for differences of fourth order.
HALO = 2

F = TypeVar("F", bound=Callable[..., Any])


def _compiled(function: F) -> F:
    """Compile, keeping the function's type."""
    result: F = numba.njit(cache=True, nogil=True)(function)
    return result


_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_STRIDE = np.uint64(0xD1B54A32D192ED03)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)


@_compiled
def _mix(z: np.uint64) -> np.uint64:
    """Scramble 64 bits (SplitMix64)."""
    z = (z ^ (z >> np.uint64(30))) * _FIRST
    z = (z ^ (z >> np.uint64(27))) * _SECOND
    return z ^ (z >> np.uint64(31))


@_compiled
def _place(key: np.uint64, row: int, column: int) -> np.uint64:
    """Key of a place on a grid."""
    line = _mix(key + np.uint64(row) * _STRIDE)
    return _mix(line + np.uint64(column) * _GOLDEN)


@_compiled
def _uniform(place: np.uint64, count: int) -> float:
    """Return the number `count` of a place, within (0, 1)."""
    z = _mix(place + np.uint64(count + 1) * _GOLDEN)
    return (float(z >> np.uint64(11)) + 0.5) * 2.0**-53


@_compiled
def _circular(key: np.uint64, row: int, column: int) -> complex:
    """Circular complex Gaussian of unit mean square (Box & Muller)."""
    place = _place(key, row, column)
    size = np.sqrt(-np.log(_uniform(place, 0)))
    turn = 2 * np.pi * _uniform(place, 1)
    return complex(size * np.cos(turn), size * np.sin(turn))


@_compiled
def _gamma(place: np.uint64, nu: float) -> float:
    """Gamma variate of shape nu and mean 1 (Marsaglia & Tsang 2000)."""
    d = max(nu, nu + (nu < 1)) - 1 / 3
    c = 1 / np.sqrt(9 * d)
    count = 1
    while True:
        size = np.sqrt(-2 * np.log(_uniform(place, count)))
        x = size * np.cos(2 * np.pi * _uniform(place, count + 1))
        v = (1 + c * x) ** 3
        u = _uniform(place, count + 2)
        count += 3
        if v > 0 and np.log(u) < 0.5 * x * x + d - d * v + d * np.log(v):
            break
    boost = _uniform(place, 0) ** (1 / nu) if nu < 1 else 1.0
    return float(d * v * boost / nu)


@_compiled
def patch_texture(key: np.uint64, rows: IntArray, columns: IntArray, nu: float) -> FloatArray:
    """Draw the texture of pixel-sized patches.

    Parameters
    ----------
    key : uint64
        Key of the stream of random numbers.
    rows, columns : ndarray of int64
        Indices of the patches; the same patch always gets the same texture.
    nu : float
        Shape of the gamma distribution, whose mean is 1.

    Returns
    -------
    ndarray (rows, columns)
    """
    result = np.empty((rows.size, columns.size))
    for i in range(rows.size):
        for j in range(columns.size):
            result[i, j] = _gamma(_place(key, rows[i], columns[j]), nu)
    return result


@_compiled
def see_facets(
    elevation: FloatArray,
    ground_range: FloatArray,
    altitude: FloatArray,
    steps: tuple[float, float],
    slant: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Trace the lines of sight to a strip's facets.

    Parameters
    ----------
    elevation : ndarray (rows + 2 HALO, columns + 2 HALO)
        Height h of the sea floor, m, with a margin on all sides.
    ground_range : ndarray (columns,)
        Increasing and above 0, m.
    altitude : ndarray (rows,)
        Altitude of the array above h = 0, m.
    steps : tuple of float
        Spacing of rows and of columns, m.
    slant : bool
        Whether the image is in slant range.

    Returns
    -------
    sine, area, shown : ndarray (rows, columns)
        Sine of the local grazing angle, 0 where a facet faces away or lies in shadow (a nearer one
        has a larger (h - altitude) / range); ratio of the facet's area to its map area; range at
        which its echo appears in the image, m, NaN where there is none.
    """
    rows, columns = altitude.size, ground_range.size
    sine, area, shown = np.empty((3, rows, columns))
    for i in range(rows):
        highest = -np.inf
        for j in range(columns):
            y, x = i + HALO, j + HALO
            # differences of fourth order: wavelengths may be only a few pixels
            across = 8 * (elevation[y, x + 1] - elevation[y, x - 1])
            across = (across - elevation[y, x + 2] + elevation[y, x - 2]) / (12 * steps[1])
            along = 8 * (elevation[y + 1, x] - elevation[y - 1, x])
            along = (along - elevation[y + 2, x] + elevation[y - 2, x]) / (12 * steps[0])
            r, drop = ground_range[j], altitude[i] - elevation[y, x]
            area[i, j] = np.sqrt(1 + across**2 + along**2)
            distance = np.sqrt(r * r + drop * drop)
            facing = (r * across + drop) / (distance * area[i, j])
            rise = -drop / r
            sine[i, j] = min(facing, 1.0) if facing > 0 and rise >= highest else 0.0
            highest = max(highest, rise)
            if slant:
                shown[i, j] = distance
            else:
                square = distance * distance - altitude[i] ** 2
                shown[i, j] = np.sqrt(square) if square > 0 else np.nan
    return sine, area, shown


@_compiled
def sum_rows(
    amplitude: FloatArray,
    shown: FloatArray,
    key: np.uint64,
    first: tuple[int, int],
    sigma: float,
    columns: int,
) -> ComplexArray:
    """Sum the facets' echoes along range, each spread by the point spread function.

    Parameters
    ----------
    amplitude : ndarray (rows, facets)
        Root mean square of the facets' echoes; 0 for none.
    shown : ndarray (rows, facets)
        Positions at which they appear, in columns from the image's first.
    key : uint64
    first : tuple of int
        Row and column of the first facet on the grid of the pass.
    sigma : float
        Standard deviation of the point spread function, columns.
    columns : int
        Number of columns of the image.

    Returns
    -------
    ndarray of complex (rows, columns)
    """
    rows, facets = amplitude.shape
    field = np.zeros((rows, columns), np.complex128)
    half = int(np.ceil(REACH * sigma))
    scale = -0.5 / sigma**2
    bend = np.exp(2 * scale)
    for i in range(rows):
        for j in range(facets):
            if amplitude[i, j] == 0:
                continue
            middle = int(np.rint(shown[i, j]))
            low, high = middle - half, middle + half
            if high < 0 or low >= columns:
                continue
            echo = amplitude[i, j] * _circular(key, first[0] + i, first[1] + j)
            # exp(scale (k - shown)^2) from one column to the next
            away = low - shown[i, j]
            weight = np.exp(scale * away * away)
            ratio = np.exp(scale * (2 * away + 1))
            for k in range(low, high + 1):
                if 0 <= k < columns:
                    field[i, k] += weight * echo
                weight *= ratio
                ratio *= bend
    return field


@_compiled
def take_pixels(
    field: ComplexArray,
    kernel: FloatArray,
    rows: IntArray,
    columns: IntArray,
    key: np.uint64,
    first: tuple[int, int],
    noise: float,
) -> FloatArray:
    """Sum echoes along the track and add receiver noise at the pixels of an image.

    Parameters
    ----------
    field : ndarray of complex (rows, columns)
        From :func:`sum_rows`.
    kernel : ndarray (2 n + 1,)
        Point spread function along the track.
    rows, columns : ndarray of int (pixels,)
        Places in the field, rows at least n from its edges.
    key : uint64
    first : tuple of int
        Row and column of the field's first place on the grid of the pass.
    noise : float
        Intensity of the receiver's noise.

    Returns
    -------
    ndarray (pixels,)
        Amplitude.
    """
    result = np.empty(rows.size)
    half = kernel.size // 2
    size = np.sqrt(noise)
    for p in range(rows.size):
        echo = complex(0.0, 0.0)
        for k in range(kernel.size):
            echo += kernel[k] * field[rows[p] - half + k, columns[p]]
        if noise > 0:
            echo += size * _circular(key, first[0] + rows[p], first[1] + columns[p])
        result[p] = abs(echo)
    return result
