"""Products of Gaussian factors in information form.

A factor is exp(level + linear.u - u.precision.u / 2). Factors are multiplied by adding level,
linear term and precision; mixtures component by component.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


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


def transformed(
    level: FloatArray,
    linear: FloatArray,
    precision: FloatArray,
    constant: FloatArray,
    matrix: FloatArray | None,
) -> Information:
    """Express factors of v as factors of u, where v = matrix u + constant.

    Parameters
    ----------
    level, linear, precision : ndarray (N, K), (N, K, D), (N, K, D, D)
        As :class:`Information`, of v.
    constant : ndarray (N, K, D)
    matrix : ndarray (N, K, D, D) or None
        None for the identity.

    Returns
    -------
    Information (N, K)
    """
    pulled = (precision @ constant[..., None])[..., 0]
    level = level + ((linear - 0.5 * pulled) * constant).sum(axis=-1)
    linear = linear - pulled
    if matrix is None:
        return Information(level, linear, precision)
    back = np.swapaxes(matrix, -1, -2)
    return Information(level, (back @ linear[..., None])[..., 0], back @ precision @ matrix)


def widened(factor: Information, sd: FloatArray) -> Information:
    """Convolve factors with independent Gaussians.

    Parameters
    ----------
    factor : Information (..., K)
    sd : ndarray (..., K, D)
        Above 0; broadcasts.

    Returns
    -------
    Information (..., K)
    """
    linear = np.ascontiguousarray(factor.linear)
    least = np.ascontiguousarray(np.broadcast_to(sd, linear.shape) ** -2.0)
    new = Information(factor.level.copy(), linear.copy(), factor.precision.copy())
    size = linear.shape[-1]
    _widen(
        least.reshape(-1, size),
        linear.reshape(-1, size),
        np.ascontiguousarray(factor.precision).reshape(-1, size, size),
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


def log_integrals(factor: Information) -> FloatArray:
    """Log of the integral of each component (...); minus infinity where it has none."""
    size = factor.linear.shape[-1]
    result = np.empty(factor.level.shape)
    _integrate(
        np.ascontiguousarray(factor.level).reshape(-1),
        np.ascontiguousarray(factor.linear).reshape(-1, size),
        np.ascontiguousarray(factor.precision).reshape(-1, size, size),
        result.reshape(-1),
    )
    return result


def products(
    factor: Information, ends: NDArray[np.int64], prior: Information, most: int
) -> FloatArray:
    """Log integrals of the products of groups of mixtures and of a prior.

    Parameters
    ----------
    factor : Information (N, K)
        Sorted by group.
    ends : ndarray of int (groups,)
        Where each group ends.
    prior : Information (1,)
    most : int
        Components of a product that are kept, the heaviest.

    Returns
    -------
    ndarray (groups,)
        Minus infinity where no component has an integral.
    """
    result = np.empty(ends.size)
    whole = (np.ascontiguousarray(v) for v in factor)
    _multiply_groups(ends, *whole, *(v[0] for v in prior), most, result)
    return result


# Loops over many matrices of three or five rows, for which the calls into LAPACK cost more than
# the arithmetic: the second stage is ten times as fast with them.


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _factorise(matrix, pivots):  # type: ignore[no-untyped-def]
    """Factorise a symmetric matrix in place into L D L^T; D goes to `pivots`."""
    size = pivots.size
    for j in range(size):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k] * pivots[k]
        pivots[j] = pivot
        for i in range(j + 1, size):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k] * pivots[k]
            matrix[i, j] = value / pivot


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve(matrix, pivots, vector):  # type: ignore[no-untyped-def]
    """Solve in place by the factors of :func:`_factorise`."""
    size = pivots.size
    for i in range(size):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
    for i in range(size - 1, -1, -1):
        vector[i] /= pivots[i]
        for k in range(i + 1, size):
            vector[i] -= matrix[k, i] * vector[k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _integral(level, linear, precision, matrix, pivots, vector):  # type: ignore[no-untyped-def]
    """Log integral of a factor; the last three are room to work in."""
    matrix[:] = precision
    vector[:] = linear
    _factorise(matrix, pivots)
    _solve(matrix, pivots, vector)
    for i in range(pivots.size):
        if not pivots[i] > 0:
            return -np.inf
        level += 0.5 * (linear[i] * vector[i] - np.log(pivots[i]))
    return level


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _integrate(level, linear, precision, result):  # type: ignore[no-untyped-def]
    """Fill in log integrals (n,) of factors (n,), (n, D), (n, D, D)."""
    n, size = linear.shape
    matrix, pivots, vector = np.empty((size, size)), np.empty(size), np.empty(size)
    for r in range(n):
        result[r] = _integral(level[r], linear[r], precision[r], matrix, pivots, vector)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moments(level, linear, precision, result, mean, covariance):  # type: ignore[no-untyped-def]
    """Fill in log integrals (n,), means (n, D) and covariances (n, D, D)."""
    n, size = linear.shape
    matrix, pivots, vector = np.empty((size, size)), np.empty(size), np.empty(size)
    for r in range(n):
        result[r] = -np.inf
        if level[r] > -np.inf:
            result[r] = _integral(level[r], linear[r], precision[r], matrix, pivots, vector)
        there = result[r] > -np.inf
        if there:
            mean[r] = vector
        for j in range(size):
            vector[:] = 0.0
            vector[j] = 1.0
            if there:
                _solve(matrix, pivots, vector)
            covariance[r, :, j] = vector


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _keep(number, level, linear, precision, kept, total, kept_linear, kept_precision, heavy):  # type: ignore[no-untyped-def]
    """Move the heaviest of `number` components to `kept`; return how many."""
    n = 0
    while n < min(number, kept.size):
        best = 0
        for j in range(1, number):
            if total[j] > total[best]:
                best = j
        if total[best] == -np.inf:
            break
        kept[n], heavy[n] = level[best], total[best]
        kept_linear[n] = linear[best]
        kept_precision[n] = precision[best]
        total[best] = -np.inf
        n += 1
    return n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _multiply_groups(  # type: ignore[no-untyped-def]
    ends, level, linear, precision, prior_level, prior_linear, prior_precision, most, result
):
    """Fill in the log integrals (groups,) of the product of each group's factors and a prior."""
    components, size = linear.shape[1:]
    matrix, pivots, vector = np.empty((size, size)), np.empty(size), np.empty(size)
    room = most * components
    total, new = np.empty(room), np.empty(room)
    new_linear, new_precision = np.empty((room, size)), np.empty((room, size, size))
    kept, heavy = np.empty(most), np.empty(most)
    kept_linear, kept_precision = np.empty((most, size)), np.empty((most, size, size))
    first = 0
    for g in range(ends.size):
        count = 1
        kept[0], kept_linear[0], kept_precision[0] = 0.0, 0.0, 0.0
        for r in range(first, ends[g]):
            n = 0
            for i in range(count):
                for k in range(components):
                    if level[r, k] == -np.inf:
                        continue
                    new[n] = kept[i] + level[r, k]
                    new_linear[n] = kept_linear[i] + linear[r, k]
                    new_precision[n] = kept_precision[i] + precision[r, k]
                    total[n] = _integral(
                        new[n] + prior_level,
                        new_linear[n] + prior_linear,
                        new_precision[n] + prior_precision,
                        matrix,
                        pivots,
                        vector,
                    )
                    n += 1
            count = _keep(
                n, new, new_linear, new_precision, kept, total, kept_linear, kept_precision, heavy
            )
        first = ends[g]
        result[g] = -np.inf
        for i in range(count):
            result[g] = np.logaddexp(result[g], heavy[i])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _widen(least, linear, precision, new_level, new_linear, new_precision):  # type: ignore[no-untyped-def]
    """Convolve factors (n,), (n, D), (n, D, D) with Gaussians of precisions `least` (n, D)."""
    n, size = linear.shape
    matrix, pivots, vector = np.empty((size, size)), np.empty(size), np.empty(size)
    for r in range(n):
        matrix[:] = precision[r]
        for i in range(size):
            matrix[i, i] += least[r, i]
        _factorise(matrix, pivots)
        # P - P (P + W)^-1 P = W - W (P + W)^-1 W loses digits where W is large: the former
        for j in range(size):
            vector[:] = precision[r, j]
            _solve(matrix, pivots, vector)
            for i in range(size):
                for k in range(size):
                    new_precision[r, i, j] -= precision[r, i, k] * vector[k]
        vector[:] = linear[r]
        _solve(matrix, pivots, vector)
        for i in range(size):
            ratio = abs(pivots[i]) / least[r, i]
            new_level[r] += 0.5 * (linear[r, i] * vector[i] - np.log(ratio))
            for k in range(size):
                new_linear[r, i] -= precision[r, i, k] * vector[k]
        for i in range(size):
            for j in range(i):
                middle = 0.5 * (new_precision[r, i, j] + new_precision[r, j, i])
                new_precision[r, i, j] = new_precision[r, j, i] = middle


def multiplied(first: Information, second: Information) -> Information:
    """Multiply mixtures: every component of one with every component of the other.

    Parameters
    ----------
    first, second : Information (..., K1) and (..., K2)

    Returns
    -------
    Information (..., K1 K2)
    """
    level = first.level[..., :, None] + second.level[..., None, :]
    linear = first.linear[..., :, None, :] + second.linear[..., None, :, :]
    precision = first.precision[..., :, None, :, :] + second.precision[..., None, :, :, :]
    lead, size = level.shape[:-2], linear.shape[-1]
    return Information(
        level.reshape(*lead, -1),
        linear.reshape(*lead, -1, size),
        precision.reshape(*lead, -1, size, size),
    )


def heaviest(factor: Information, level: FloatArray, most: int) -> Information:
    """Keep the components with the largest `level` (..., K), at most `most`."""
    if level.shape[-1] <= most:
        return factor
    kept = np.argsort(-level, axis=-1, kind="stable")[..., :most]
    return Information(
        np.take_along_axis(factor.level, kept, -1),
        np.take_along_axis(factor.linear, kept[..., None], -2),
        np.take_along_axis(factor.precision, kept[..., None, None], -3),
    )
