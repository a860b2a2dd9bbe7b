"""Products of Gaussian factors in information form.

A factor is exp(level + linear.u - u.precision.u / 2). Factors are multiplied by adding level,
linear term and precision; mixtures component by component.
"""

from __future__ import annotations

from typing import NamedTuple

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
    pulled = np.einsum("nkij,nkj->nki", precision, constant)
    level = level + ((linear - 0.5 * pulled) * constant).sum(axis=-1)
    linear = linear - pulled
    if matrix is None:
        return Information(level, linear, precision)
    back = np.swapaxes(matrix, -1, -2)
    return Information(level, np.einsum("nkij,nkj->nki", back, linear), back @ precision @ matrix)


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
    size = factor.linear.shape[-1]
    least = np.broadcast_to(sd, factor.linear.shape) ** -2.0
    both = factor.precision + least[..., :, None] * np.eye(size)
    right = np.concatenate([factor.precision, factor.linear[..., None]], axis=-1)
    solved = np.linalg.solve(both, right)
    linear = factor.linear - np.einsum("...ij,...j->...i", factor.precision, solved[..., -1])
    precision = factor.precision - factor.precision @ solved[..., :-1]
    level = factor.level + 0.5 * (factor.linear * solved[..., -1]).sum(axis=-1)
    level = level - 0.5 * (np.linalg.slogdet(both)[1] - np.log(least).sum(axis=-1))
    return Information(level, linear, 0.5 * (precision + np.swapaxes(precision, -1, -2)))


def moments(factor: Information) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log of the integral (...), mean (..., D) and covariance (..., D, D) of each component."""
    covariance: FloatArray = np.asarray(np.linalg.inv(factor.precision), float)
    mean: FloatArray = np.einsum("...ij,...j->...i", covariance, factor.linear)
    sign, determinant = np.linalg.slogdet(factor.precision)
    level = factor.level + 0.5 * (factor.linear * mean).sum(axis=-1) - 0.5 * determinant
    return np.where(sign > 0, level, -np.inf), mean, covariance


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
