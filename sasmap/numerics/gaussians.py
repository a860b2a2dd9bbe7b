"""Gaussian mixtures and their fit by expectation-maximisation."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sasmap.arrays import FloatArray


class Mixture(NamedTuple):
    """Gaussian mixture.

    Attributes
    ----------
    weight : ndarray (n,)
        Weights that sum to 1.
    mean : ndarray (n, size)
    covariance : ndarray (n, size, size)
    """

    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray


def expectation_maximisation(
    points: FloatArray, share: FloatArray, floor: FloatArray, rounds: int, enough: float
) -> tuple[Mixture, FloatArray, float]:
    """Fit a mixture to points, starting from responsibilities.

    Parameters
    ----------
    points : ndarray (n, size)
    share : ndarray (n, components)
        Responsibility of each component for each point.
    floor : ndarray (size,)
        Added to the variances of components.
    rounds : int
        Largest number of iterations.
    enough : float
        Gain in mean log likelihood below which the fit ends.

    Returns
    -------
    mixture : Mixture
    share : ndarray (n, components)
    level : float
        Mean log likelihood per point.
    """
    mixture = _maximised(points, share, floor)
    level = -np.inf
    for _ in range(rounds):
        density = log_densities(points, mixture)
        previous, level = level, _shares(density)
        share = density
        mixture = _maximised(points, share, floor)
        if level - previous < enough:
            break
    return mixture, share, level


def fitted_mixture(
    points: FloatArray, most: int, effective: float, floor: float, rounds: int, enough: float
) -> Mixture:
    """Fit a mixture to points of equal weight, with as many components as they need.

    Parameters
    ----------
    points : ndarray (n, size)
    most : int
        Largest number of components.
    effective : float
        Effective number of independent points.
    floor : float
        Least variance of a component over that of all points.
    rounds, enough
        As for :func:`expectation_maximisation`.

    Returns
    -------
    Mixture
        The number of components is chosen by the Bayesian information criterion.
    """
    centre = points.mean(axis=0)
    scale = np.maximum(points.std(axis=0), 1e-12 * np.maximum(np.abs(centre), 1e-6))
    z = (points - centre) / scale
    size = z.shape[1]
    # start from slices along the coordinate in which the points are least Gaussian
    skewed = np.abs((z**3).mean(axis=0)) + np.abs((z**4).mean(axis=0) / 3 - 1)
    order = np.argsort(np.argsort(z[:, int(np.argmax(skewed))], kind="stable"), kind="stable")
    least = np.full(size, floor)
    best, best_score = None, -np.inf
    for n in range(1, most + 1):
        share = ((order * n // len(z))[:, None] == np.arange(n)).astype(float)
        mixture, _, level = expectation_maximisation(z, share, least, rounds, enough)
        cost = n * (1 + size + size * (size + 1) / 2)
        score = effective * level - 0.5 * cost * np.log(effective)
        if best is not None and score <= best_score:
            break
        best, best_score = mixture, score
    assert best is not None
    outer = scale[:, None] * scale
    return Mixture(best.weight, centre + scale * best.mean, best.covariance * outer)


def _maximised(points: FloatArray, share: FloatArray, floor: FloatArray) -> Mixture:
    total = np.maximum(share.sum(axis=0), 1e-9)
    mean = (share.T @ points) / total[:, None]
    covariance = _spreads(points, share, mean) / total[:, None, None]
    return Mixture(total / total.sum(), mean, covariance + np.diag(floor))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shares(density):  # type: ignore[no-untyped-def]
    """Turn log densities into responsibilities, in place; return the mean log likelihood."""
    n, components = density.shape
    total = 0.0
    for i in range(n):
        top = density[i].max()
        mass = 0.0
        for k in range(components):
            density[i, k] = np.exp(density[i, k] - top)
            mass += density[i, k]
        density[i] /= mass
        total += top + np.log(mass)
    return total / n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spreads(points, share, mean):  # type: ignore[no-untyped-def]
    """Weighted scatter matrices about each component's mean (components, size, size)."""
    n, components = share.shape
    size = points.shape[1]
    result = np.zeros((components, size, size))
    offset = np.empty(size)
    for i in range(n):
        for k in range(components):
            for a in range(size):
                offset[a] = points[i, a] - mean[k, a]
                for b in range(a + 1):
                    result[k, a, b] += share[i, k] * offset[a] * offset[b]
    for k in range(components):
        for a in range(size):
            for b in range(a):
                result[k, b, a] = result[k, a, b]
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_squares(points, mean, inverse, result):  # type: ignore[no-untyped-def]
    """Fill in squared Mahalanobis distances (n, components) of points (n, size).

    `inverse` holds the inverses of the Cholesky factors of their covariances.
    """
    n, size = points.shape
    for k in range(mean.shape[0]):
        for i in range(n):
            square = 0.0
            for a in range(size):
                white = 0.0
                for b in range(a + 1):
                    white += inverse[k, a, b] * (points[i, b] - mean[k, b])
                square += white * white
            result[i, k] = square


def log_densities(points: FloatArray, mixture: Mixture) -> FloatArray:
    """Log of weight times density, for each component.

    Parameters
    ----------
    points : ndarray (n, size)
    mixture : Mixture

    Returns
    -------
    ndarray (n, components)
    """
    result = np.empty((len(points), mixture.weight.size))
    factor = np.linalg.cholesky(mixture.covariance)
    diagonal = np.diagonal(factor, axis1=1, axis2=2)
    norm = np.log(mixture.weight) - np.log(diagonal).sum(axis=1)
    norm -= 0.5 * points.shape[1] * np.log(2 * np.pi)
    inverse = np.linalg.inv(factor)
    fill_squares(points, mixture.mean, inverse, result)
    return np.asarray(norm - 0.5 * result)
