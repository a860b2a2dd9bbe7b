"""Products of Gaussian factors in information form.

A factor is exp(level + linear.u - u.precision.u / 2). Factors are multiplied by adding level,
linear term and precision; mixtures component by component.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sasmap.arrays import FloatArray, IntArray

# Negative log of the weight, relative to the heaviest, below which a component of a product of
# looks is dropped: looks that agree do not differ by as much, so that it stays negligible.
SLIGHTEST = 16.0


class Information(NamedTuple):
    """Gaussian factors exp(level + linear.u - u.precision.u / 2) in information form.

    Attributes
    ----------
    level : ndarray (..., K)
    linear : ndarray (..., K, D)
    precision : ndarray (..., K, D, D)
    """

    level: FloatArray
    linear: FloatArray
    precision: FloatArray


def widened(factor: Information, sd: FloatArray) -> Information:
    """Convolve factors with independent Gaussians.

    Parameters
    ----------
    factor : Information (..., K)
    sd : ndarray (..., K, D)
        Standard deviations, above 0; broadcasts.

    Returns
    -------
    Information (..., K)
    """
    variance = np.ascontiguousarray(np.broadcast_to(sd, factor.linear.shape) ** 2.0)
    new = Information(*(np.array(v, order="C") for v in factor))
    size = variance.shape[-1]
    _widen(
        variance.reshape(-1, size),
        new.level.reshape(-1),
        new.linear.reshape(-1, size),
        new.precision.reshape(-1, size, size),
    )
    return new


def moments(factor: Information) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log of the integral (...), mean (..., D) and covariance (..., D, D) of each component.

    A component without an integral has level minus infinity, mean 0 and covariance 1.
    """
    linear = np.ascontiguousarray(factor.linear)
    size = linear.shape[-1]
    level, mean = np.empty(factor.level.shape), np.zeros(linear.shape)
    covariance = np.empty((*linear.shape, size))
    _moments(
        np.ascontiguousarray(factor.level).reshape(-1),
        linear.reshape(-1, size),
        np.ascontiguousarray(factor.precision).reshape(-1, size, size),
        level.reshape(-1),
        mean.reshape(-1, size),
        covariance.reshape(-1, size, size),
    )
    return level, mean, covariance


def products(factor: Information, ends: IntArray, prior: Information, most: int) -> FloatArray:
    """Log integrals of the products of groups of mixtures and of a prior.

    Parameters
    ----------
    factor : Information (N, K)
        Sorted by group.
    ends : ndarray of int (groups,)
        Index after the last row of each group.
    prior : Information (1,)
    most : int
        Most components of a product that are kept, the heaviest ones.

    Returns
    -------
    ndarray (groups,)
        Minus infinity where no component has an integral.
    """
    result = np.empty(ends.size)
    whole = (np.ascontiguousarray(v) for v in factor)
    _multiply_groups(
        ends, *whole, prior.level[0], prior.linear[0], prior.precision[0], most, result
    )
    return result


# Compiled loops over many matrices of three or five rows, for which calls into LAPACK cost more
# than the arithmetic: the second stage is ten times as fast with the loops.


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add(linear, precision, prior_linear, prior_precision, vector, matrix):  # type: ignore[no-untyped-def]
    """Put the sum of two factors into `vector`, and its lower triangle into `matrix`."""
    for i in range(vector.size):
        vector[i] = linear[i] + prior_linear[i]
        for j in range(i + 1):
            matrix[i, j] = precision[i, j] + prior_precision[i, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def integral(level, vector, matrix, pivots):  # type: ignore[no-untyped-def]
    """Log integral of a factor; minus infinity where it has none.

    The matrix is factorised in place into L D L^T, D is stored in `pivots`, and `vector` becomes
    L^-1 `vector`.
    """
    determinant = 1.0
    for j in range(pivots.size):
        pivot, value = matrix[j, j], vector[j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k] * pivots[k]
            value -= matrix[j, k] * vector[k]
        if not pivot > 0:
            return -np.inf
        pivots[j], vector[j] = pivot, value
        level += 0.5 * value * value / pivot
        determinant *= pivot
        inverse = 1 / pivot
        for i in range(j + 1, pivots.size):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k] * pivots[k]
            matrix[i, j] = value * inverse
    return level - 0.5 * np.log(determinant)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def substitute(matrix, pivots, vector):  # type: ignore[no-untyped-def]
    """Solve D L^T x = vector in place, after :func:`integral`, to complete the system."""
    for i in range(vector.size - 1, -1, -1):
        vector[i] /= pivots[i]
        for k in range(i + 1, vector.size):
            vector[i] -= matrix[k, i] * vector[k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def invert(matrix, pivots, column, inverse):  # type: ignore[no-untyped-def]
    """Fill in the leading block of the inverse of a matrix that :func:`integral` factorised."""
    for j in range(len(inverse)):
        column[:] = 0.0
        column[j] = 1.0
        for i in range(j + 1, column.size):
            for k in range(j, i):
                column[i] -= matrix[i, k] * column[k]
        substitute(matrix, pivots, column)
        inverse[:, j] = column[: len(inverse)]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def blur(level, linear, precision, variance, column):  # type: ignore[no-untyped-def]
    """Convolve a factor in place with independent Gaussians, one after the other.

    The new precision is P - P (P + W)^-1 P = W - W (P + W)^-1 W; the latter form loses digits where
    W is large, so that the former is used.
    """
    size = linear.size
    ratios = 1.0
    for i in range(size):
        least = 1 / variance[i]
        pivot = least + precision[i, i]
        ratios *= np.abs(pivot) * variance[i]
        level += 0.5 * linear[i] * linear[i] / pivot
        column[:] = precision[:, i]
        push = linear[i] / pivot
        for j in range(size):
            linear[j] -= column[j] * push
            share = column[j] / pivot
            for k in range(j + 1):
                precision[j, k] -= share * column[k]
                precision[k, j] = precision[j, k]
    return level - 0.5 * np.log(ratios)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _widen(variance, level, linear, precision):  # type: ignore[no-untyped-def]
    """Convolve factors (n,), (n, D), (n, D, D) in place with Gaussians of `variance` (n, D)."""
    column = np.empty(linear.shape[1])
    for r in range(level.size):
        level[r] = blur(level[r], linear[r], precision[r], variance[r], column)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moments(level, linear, precision, result, mean, covariance):  # type: ignore[no-untyped-def]
    """Fill in log integrals (n,), means (n, D) and covariances (n, D, D)."""
    n, size = linear.shape
    matrix, pivots, vector = np.empty((size, size)), np.empty(size), np.empty(size)
    for r in range(n):
        result[r], covariance[r] = -np.inf, np.eye(size)
        if level[r] == -np.inf:
            continue
        matrix[:] = precision[r]
        mean[r] = linear[r]
        result[r] = integral(level[r], mean[r], matrix, pivots)
        if result[r] > -np.inf:
            substitute(matrix, pivots, mean[r])
            invert(matrix, pivots, vector, covariance[r])
        else:
            mean[r] = 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def multiply(  # type: ignore[no-untyped-def]
    count, kept, heavy, level, linear, precision, prior, room, new_linear, new_precision
):
    """Multiply a product of looks by one more look and keep the heaviest components.

    `kept` holds level, linear term and precision of the `count` components of the product, and
    `heavy` their log integrals under the prior, both changed in place; `prior` is level, linear
    term and precision. The other arrays are workspace. Returns the new number of components.
    """
    most, components, size = heavy.size, level.size, linear.shape[1]
    kept_level, kept_linear, kept_precision = kept
    prior_level, prior_linear, prior_precision = prior
    new, total, matrix, pivots, vector = room
    n = 0
    for i in range(count):
        for k in range(components):
            if level[k] == -np.inf:
                continue
            new[n] = kept_level[i] + level[k]
            for a in range(size):
                new_linear[n, a] = kept_linear[i, a] + linear[k, a]
                for b in range(size):
                    new_precision[n, a, b] = kept_precision[i, a, b] + precision[k, a, b]
            add(new_linear[n], new_precision[n], prior_linear, prior_precision, vector, matrix)
            total[n] = integral(new[n] + prior_level, vector, matrix, pivots)
            n += 1
    left = 0
    while left < min(n, most):
        best = 0
        for j in range(1, n):
            if total[j] > total[best]:
                best = j
        if total[best] == -np.inf or (left and total[best] < heavy[0] - SLIGHTEST):
            break
        kept_level[left], heavy[left] = new[best], total[best]
        kept_linear[left] = new_linear[best]
        kept_precision[left] = new_precision[best]
        total[best] = -np.inf
        left += 1
    return left


@numba.njit(cache=True, nogil=True, error_model="numpy")
def begin(kept):  # type: ignore[no-untyped-def]
    """Initialise the product of no looks, which has one component, in place."""
    level, linear, precision = kept
    level[0] = 0.0
    linear[0] = 0.0
    precision[0] = 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def workspace(most, components, size):  # type: ignore[no-untyped-def]
    """Allocate the workspace of :func:`multiply`."""
    n = most * components
    room = np.empty(n), np.empty(n), np.empty((size, size)), np.empty(size), np.empty(size)
    return room, np.empty((n, size)), np.empty((n, size, size))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _multiply_groups(  # type: ignore[no-untyped-def]
    ends, level, linear, precision, prior_level, prior_linear, prior_precision, most, result
):
    """Fill in the log integrals (groups,) of the product of each group's factors and a prior."""
    components, size = linear.shape[1:]
    room, new_linear, new_precision = workspace(most, components, size)
    kept = np.empty(most), np.empty((most, size)), np.empty((most, size, size))
    heavy = np.empty(most)
    prior = prior_level, prior_linear, prior_precision
    first = 0
    for g in range(ends.size):
        count = 1
        begin(kept)
        for r in range(first, ends[g]):
            count = multiply(
                count,
                kept,
                heavy,
                level[r],
                linear[r],
                precision[r],
                prior,
                room,
                new_linear,
                new_precision,
            )
        first = ends[g]
        result[g] = -np.inf
        for i in range(count):
            result[g] = np.logaddexp(result[g], heavy[i])
