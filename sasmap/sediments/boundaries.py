"""Boundaries between two sediments of known laws, row by row: the published method (G section 4).

Arrays (rows, N) hold log densities of the amplitudes under the left and the right law; positions c
run from 0 to N, position c lying before pixel c. Two windows of u pixels meet at c (G figure 6).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from sasmap.arrays import FloatArray, IntArray

WINDOW = 40


class Windows(NamedTuple):
    """Log likelihoods of two windows that meet at each position, (rows, N + 1).

    Attributes
    ----------
    left, right, joint : ndarray
        L, R and Z (G 7, 8), or L', R' and Z' (G 9, 10), in logs; NaN where a window does not fit.
    """

    left: FloatArray
    right: FloatArray
    joint: FloatArray


def window_likelihoods(log_left: FloatArray, log_right: FloatArray, u: int = WINDOW) -> Windows:
    """Log likelihoods that windows hold one sediment each: L, R and Z (G 7, 8).

    Parameters
    ----------
    log_left, log_right : ndarray (rows, N)
        Log densities under the left and the right law.
    u : int
        Pixels of a window.

    Returns
    -------
    Windows

    Raises
    ------
    ValueError
        Where shapes differ or rows are shorter than two windows.
    """
    left, right = _before(log_left, u), _after(log_right, u)
    if left.shape != right.shape:
        raise ValueError(f"expected arrays of one shape, got {log_left.shape}, {log_right.shape}")
    return Windows(left, right, left + right)


def window_ratios(log_left: FloatArray, log_right: FloatArray, u: int = WINDOW) -> Windows:
    """Log likelihood ratios of windows: L', R' and Z' (G 9, 10).

    Parameters and result as in :func:`window_likelihoods`.
    """
    ratio = np.asarray(log_left, float) - np.asarray(log_right, float)
    return window_likelihoods(ratio, -ratio, u)


def _before(values: FloatArray, u: int) -> FloatArray:
    """Sum the u pixels before each position."""
    values = np.asarray(values, float)
    rows, n = values.shape
    if n < 2 * u or u < 1:
        raise ValueError(f"expected rows of at least two windows of {u} pixels, got {n}")
    total = np.concatenate([np.zeros((rows, 1)), np.cumsum(values, axis=1)], axis=1)
    result = np.full((rows, n + 1), np.nan)
    result[:, u : n - u + 1] = total[:, u : n - u + 1] - total[:, : n - 2 * u + 1]
    return result


def _after(values: FloatArray, u: int) -> FloatArray:
    return _before(np.asarray(values, float)[:, ::-1], u)[:, ::-1]


class Profiles(NamedTuple):
    """Profiles fitted to log likelihoods, row by row.

    Attributes
    ----------
    position : ndarray of int (rows,)
        Position c of the best fit.
    filtered : ndarray (rows, N + 1)
        The profile itself; NaN where the data are.
    """

    position: IntArray
    filtered: FloatArray


def fit_profiles(values: FloatArray, side: Literal["left", "right"], u: int = WINDOW) -> Profiles:
    """Fit the profile that a window's log likelihood has across a boundary (G figures 7, 12, 13).

    Two plateaus and a ramp of u pixels between them: from c to c + u for L', whose window lies
    before its position, from c - u to c for R'. Least squares over c and both levels.

    Parameters
    ----------
    values : ndarray (rows, N + 1)
        Of :class:`Windows`.
    side : {"left", "right"}
    u : int

    Returns
    -------
    Profiles
    """
    known = np.isfinite(values).all(axis=0)
    y = values[:, known]
    place = np.flatnonzero(known)
    first = 0 if side == "left" else -u
    share = np.clip((place[None, :] - place[:, None] - first) / u, 0, 1)  # of the far plateau
    # least squares of levels a, b in a (1 - share) + b share, for every c at once
    near = 1 - share
    aa, ab, bb = (near**2).sum(axis=1), (near * share).sum(axis=1), (share**2).sum(axis=1)
    ya, yb = y @ near.T, y @ share.T
    determinant = aa * bb - ab**2
    usable = determinant > 1e-9 * aa.max() * max(bb.max(), 1.0)
    safe = np.where(usable, determinant, 1.0)
    a, b = (ya * bb - yb * ab) / safe, (yb * aa - ya * ab) / safe
    explained = np.where(usable, a * ya + b * yb, -np.inf)
    best = np.argmax(explained, axis=1)
    row = np.arange(y.shape[0])
    filtered = np.full(values.shape, np.nan)
    filtered[:, known] = a[row, best, None] * near[best] + b[row, best, None] * share[best]
    return Profiles(place[best], filtered)


def filtered_joint(windows: Windows, u: int = WINDOW) -> FloatArray:
    """Sum of the profiles fitted to L' and to R' (G figure 16).

    Parameters
    ----------
    windows : Windows
        Of :func:`window_ratios`.
    u : int

    Returns
    -------
    ndarray (rows, N + 1)
    """
    left = fit_profiles(windows.left, "left", u).filtered
    return left + fit_profiles(windows.right, "right", u).filtered


def row_maxima(joint: FloatArray) -> IntArray:
    """Position of the maximum of each row (G figure 17).

    Parameters
    ----------
    joint : ndarray (rows, N + 1)

    Returns
    -------
    ndarray of int (rows,)
    """
    return np.asarray(np.nanargmax(joint, axis=1))


def best_positions(log_left: FloatArray, log_right: FloatArray) -> IntArray:
    """Most likely position of one boundary in each row, by all its pixels.

    Parameters
    ----------
    log_left, log_right : ndarray (rows, N)

    Returns
    -------
    ndarray of int (rows,)
        The maximum of the cumulative sum of log p_L / p_R (docs/science.md).
    """
    ratio = np.asarray(log_left, float) - np.asarray(log_right, float)
    total = np.concatenate([np.zeros((ratio.shape[0], 1)), np.cumsum(ratio, axis=1)], axis=1)
    return np.asarray(np.argmax(total, axis=1))
