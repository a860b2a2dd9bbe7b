"""Mixtures of Gaussians and their fit by expectation and maximisation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

FloatArray = NDArray[np.float64]


class Mixture(NamedTuple):
    """Gaussian mixture.

    Attributes
    ----------
    weight : ndarray (n,)
        Sum 1.
    mean : ndarray (n, size)
    covariance : ndarray (n, size, size)
    """

    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray


def expectation_maximisation(
    points: FloatArray, share: FloatArray, floor: FloatArray, rounds: int, enough: float
) -> tuple[Mixture, FloatArray, float]:
    """Fit a mixture to points, from a first guess of which belong to which component.

    Parameters
    ----------
    points : ndarray (n, size)
    share : ndarray (n, components)
        Of each point in each component.
    floor : ndarray (size,)
        Added to the variances of components.
    rounds : int
        At most.
    enough : float
        Gain in mean log likelihood at which the fit ends.

    Returns
    -------
    mixture : Mixture
    share : ndarray (n, components)
    level : float
        Mean log likelihood of a point.
    """
    mixture = _maximised(points, share, floor)
    level = -np.inf
    for _ in range(rounds):
        density = log_densities(points, mixture)
        total = logsumexp(density, axis=1)
        share = np.exp(density - total[:, None])
        previous, level = level, float(total.mean())
        mixture = _maximised(points, share, floor)
        if level - previous < enough:
            break
    return mixture, share, level


def _maximised(points: FloatArray, share: FloatArray, floor: FloatArray) -> Mixture:
    total = np.maximum(share.sum(axis=0), 1e-9)
    mean = (share.T @ points) / total[:, None]
    offset = points[None] - mean[:, None]
    covariance = np.einsum("kn,kni,knj->kij", share.T, offset, offset) / total[:, None, None]
    return Mixture(total / total.sum(), mean, covariance + np.diag(floor))


def log_densities(points: FloatArray, mixture: Mixture) -> FloatArray:
    """Log of weight times density of each component.

    Parameters
    ----------
    points : ndarray (n, size)
    mixture : Mixture

    Returns
    -------
    ndarray (n, components)
    """
    result = np.empty((len(points), mixture.weight.size))
    for k, (weight, mean, covariance) in enumerate(zip(*mixture, strict=True)):
        factor = np.linalg.cholesky(covariance)
        white = np.linalg.solve(factor, (points - mean).T)
        norm = np.log(np.diag(factor)).sum() + 0.5 * mean.size * np.log(2 * np.pi)
        result[:, k] = np.log(weight) - norm - 0.5 * (white**2).sum(axis=0)
    return result
