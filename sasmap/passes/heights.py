"""Looks expressed in A_H rather than contrast, given the shared parameters of a survey.

Loops are compiled, as the second stage does this for each look and every draw of the shared
parameters.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sasmap.arrays import FloatArray
from sasmap.passes.information import Information, widened
from sasmap.passes.looks import NONE, Looks, Shared
from sasmap.passes.summary import LEAST_CONTRAST


class Told(NamedTuple):
    """Inputs of :func:`to_height` from N looks with K components each.

    Attributes
    ----------
    level, linear, precision : ndarray (N, K), (N, K, D), (N, K, D, D)
        Of the looks' likelihoods.
    law_linear, law_precision : ndarray (N, K, 2), (N, K, 2, 2)
        Of the likelihoods of the law.
    by_shape : ndarray (N,)
        As in :class:`sasmap.passes.looks.LawLikelihood`.
    contrast : ndarray (N, 3)
        Contrast per slope: coefficients of n and of c, and the part that is independent of the law.
    """

    level: FloatArray
    linear: FloatArray
    precision: FloatArray
    law_linear: FloatArray
    law_precision: FloatArray
    by_shape: FloatArray
    contrast: FloatArray


def told_by(looks: Looks) -> Told:
    """Return the inputs of :func:`to_height` from looks."""
    n, k = looks.factor.level.shape
    law = looks.law
    tangent = looks.tangent
    # as summary.log_contrast
    contrast = np.stack([1 / tangent, 2 * (0.5 * np.pi - np.arctan(tangent)), tangent], axis=1)
    level, linear, precision = (np.ascontiguousarray(v) for v in looks.factor)
    return Told(
        level,
        linear,
        precision,
        np.zeros((n, k, 2)) if law is None else np.ascontiguousarray(law.linear),
        np.zeros((n, k, 2, 2)) if law is None else np.ascontiguousarray(law.precision),
        np.zeros(n) if law is None else law.by_shape,
        contrast,
    )


def raised(looks: Looks, shared: Shared) -> FloatArray:
    """Shift of log A_H (N,) due to the altitude offsets of the looks' swaths."""
    return np.asarray(looks.altitude_gain * shared.offset[looks.swath] / looks.altitude)


def at_height(looks: Looks, shared: Shared, scatter: FloatArray) -> Information:
    """Likelihood of log f, log A_H, azimuth and the law of the cell.

    Parameters
    ----------
    looks : Looks
    shared : Shared
    scatter : ndarray (N, 3)
        Standard deviations of a look about its cell: of log f, log A_H and azimuth.

    Returns
    -------
    Information (N, K)
        Over log f, log A_H, azimuth, n and c; without n and c where the law is fixed.
    """
    return with_scatter(without_scatter(looks, shared), shared, scatter)


def without_scatter(looks: Looks, shared: Shared) -> Information:
    """Express looks in A_H through the survey's law and altitudes, without scatter.

    Parameters
    ----------
    looks : Looks
    shared : Shared

    Returns
    -------
    Information (N, K)
        Over the coordinates of :func:`at_height`.
    """
    told = told_by(looks)
    level, linear, precision = (np.empty(v.shape) for v in looks.factor)
    _all_to_height(
        told,
        raised(looks, shared),
        shared.law,
        shared.spread**-2.0,
        shared.shift,
        level,
        linear,
        precision,
    )
    return Information(level, linear, precision)


def with_scatter(factor: Information, shared: Shared, scatter: FloatArray) -> Information:
    """Widen looks by their scatter about their cell: f, A_H, azimuth and law.

    Parameters
    ----------
    factor : Information (N, K)
    shared : Shared
    scatter : ndarray (N, 3)

    Returns
    -------
    Information (N, K)
    """
    wide = np.maximum(scatter, NONE)
    if factor.linear.shape[-1] == 5:
        wide = np.concatenate([wide, np.broadcast_to(of_look(shared), (len(wide), 2))], axis=1)
    return widened(factor, wide[:, None, :])


def of_look(shared: Shared) -> FloatArray:
    """Return the standard deviation of n and c (2,) of a look about its cell's law."""
    return np.asarray(np.sqrt(shared.of_look) * shared.spread)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def to_height(told, r, k, raised_by, law, gain, shift, linear, precision):  # type: ignore[no-untyped-def]
    """Express component k of look r in A_H, using the survey's law and altitude.

    `law` and `gain` are the mean and precision of the law, `shift` its bias from the echo shape.
    Fills in the linear term and precision, and returns the level.
    """
    level = told.level[r, k]
    linear[:] = told.linear[r, k]
    precision[:] = told.precision[r, k]
    constant = -raised_by
    with_law = linear.size > 3
    by_n = by_c = 0.0
    if with_law:
        own = told.law_precision[r, k]
        first, second = told.by_shape[r] * shift[0], told.by_shape[r] * shift[1]
        push = own[0, 0] * first + own[0, 1] * second, own[1, 0] * first + own[1, 1] * second
        at = told.law_linear[r, k]
        level += first * (at[0] - 0.5 * push[0]) + second * (at[1] - 0.5 * push[1])
        linear[3] -= push[0]
        linear[4] -= push[1]
        # the look's law given the survey's: log contrast is linearised in the law there
        a, b, d = own[0, 0] + gain[0], own[0, 1], own[1, 1] + gain[1]
        x, y = at[0] - push[0] + gain[0] * law[0], at[1] - push[1] + gain[1] * law[1]
        determinant = a * d - b * own[1, 0]
        n, c = (d * x - b * y) / determinant, (a * y - own[1, 0] * x) / determinant
        parts = told.contrast[r]
        per_slope = max(n * parts[0] + c * parts[1] + parts[2], LEAST_CONTRAST)
        by_n, by_c = parts[0] / per_slope, parts[1] / per_slope
        constant += np.log(per_slope) - by_n * n - by_c * c
    # log contrast = log A_H + by_n n + by_c c + constant
    level += constant * (linear[1] - 0.5 * precision[1, 1] * constant)
    for i in range(linear.size):
        linear[i] -= precision[i, 1] * constant
    if with_law:
        linear[3] += by_n * linear[1]
        linear[4] += by_c * linear[1]
        for i in range(linear.size):
            precision[i, 3] += precision[i, 1] * by_n
            precision[i, 4] += precision[i, 1] * by_c
        for i in range(linear.size):
            precision[3, i] += by_n * precision[1, i]
            precision[4, i] += by_c * precision[1, i]
    return level


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _all_to_height(told, raised_by, law, gain, shift, level, linear, precision):  # type: ignore[no-untyped-def]
    """Fill in level (N, K), linear term and precision of all looks by :func:`to_height`."""
    for r in range(level.shape[0]):
        for k in range(level.shape[1]):
            level[r, k] = to_height(
                told, r, k, raised_by[r], law, gain, shift, linear[r, k], precision[r, k]
            )
