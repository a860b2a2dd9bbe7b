"""Gaussian mixtures of what a look knows: their fit to draws, and marginals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sasmap.numerics.gaussians import Mixture, expectation_maximisation, log_densities

FloatArray = NDArray[np.float64]

MOST = 3
# Independent draws that a posterior's draws count as when components are chosen.
EFFECTIVE = 400.0
# Rounds of a fit, the gain in mean log likelihood at which it ends, and the least variance of
# components, over that of all draws.
ROUNDS, ENOUGH, FLOOR = 80, 1e-6, 1e-4
# Standard deviations within which quantiles are looked for, steps at most, and the precision over
# the width of where they are looked for.
REACH, STEPS, PRECISION = 12.0, 50, 1e-10
# Largest log of a moment: of components that have no weight.
LARGEST = 200.0
# A density with less of itself within its bounds lies outside.
OUTSIDE = 1e-200


def fit_mixture(points: FloatArray) -> Mixture:
    """Fit a mixture to draws by expectation and maximisation; components as the draws call for.

    Parameters
    ----------
    points : ndarray (n, size)

    Returns
    -------
    Mixture
        Of one to three components, by the Bayesian information criterion.
    """
    centre = points.mean(axis=0)
    scale = np.maximum(points.std(axis=0), 1e-12 * np.maximum(np.abs(centre), 1e-6))
    z = (points - centre) / scale
    size = z.shape[1]
    parameters = 1 + size + size * (size + 1) / 2
    best, best_score = _moments(z), -np.inf
    for n in range(1, MOST + 1):
        mixture, level = _fitted(z, n)
        score = EFFECTIVE * level - 0.5 * n * parameters * np.log(EFFECTIVE)
        if score <= best_score:
            break
        best, best_score = mixture, score
    outer = scale[:, None] * scale
    return Mixture(best.weight, centre + scale * best.mean, best.covariance * outer)


def _moments(z: FloatArray) -> Mixture:
    covariance = np.cov(z.T) + np.diag(np.full(z.shape[1], FLOOR))
    return Mixture(np.ones(1), z.mean(axis=0)[None], covariance[None])


def _fitted(z: FloatArray, n: int) -> tuple[Mixture, float]:
    """Fit n components; return the mean log likelihood as well."""
    if n == 1:
        mixture = _moments(z)
        return mixture, float(log_densities(z, mixture)[:, 0].mean())
    # starts as slices along the direction in which the draws are least like one Gaussian
    skewed = np.abs((z**3).mean(axis=0)) + np.abs((z**4).mean(axis=0) / 3 - 1)
    order = np.argsort(np.argsort(z[:, int(np.argmax(skewed))], kind="stable"), kind="stable")
    share = (order * n // len(z))[:, None] == np.arange(n)
    floor = np.full(z.shape[1], FLOOR)
    mixture, _, level = expectation_maximisation(z, share.astype(float), floor, ROUNDS, ENOUGH)
    return mixture, level


class Marginal(NamedTuple):
    """Mean, standard deviation and quantiles 0.05 and 0.95 of one parameter, arrays (n,)."""

    mean: FloatArray
    sd: FloatArray
    q05: FloatArray
    q95: FloatArray


def marginals(weight: FloatArray, mean: FloatArray, sd: FloatArray, bounds: FloatArray) -> Marginal:
    """Summarise parameters whose logs are Gaussian mixtures, truncated to bounds.

    Parameters
    ----------
    weight, mean, sd : ndarray (n, K)
        Of the logs.
    bounds : ndarray (2,) or (2, n)
        Of the log.

    Returns
    -------
    Marginal
        Of the parameters, not of their logs.
    """
    low, high = ((np.reshape(b, (-1, 1)) - mean) / sd for b in bounds)
    mass = ndtr(high) - ndtr(low)
    total = (weight * mass).sum(axis=1)
    inside = total > OUTSIDE
    total = np.where(inside, total, 1.0)
    ends = np.clip((weight * mean).sum(axis=1), *bounds)  # all of it lies beyond a bound
    apart = mean - ends[:, None]
    one, two = (
        (weight * np.exp(np.minimum(k * apart + 0.5 * (k * sd) ** 2, LARGEST)) * part).sum(axis=1)
        / total
        for k, part in ((k, ndtr(high - k * sd) - ndtr(low - k * sd)) for k in (1, 2))
    )
    centre = np.where(inside, one, 1.0) * np.exp(ends)
    spread = np.sqrt(np.where(inside, np.maximum(two - one**2, 0.0), 0.0)) * np.exp(ends)
    quantile = [
        np.where(inside, np.exp(_quantile(weight, mean, sd, low, total, share)), np.exp(ends))
        for share in (0.05, 0.95)
    ]
    return Marginal(centre, spread, *quantile)


def _quantile(
    weight: FloatArray,
    mean: FloatArray,
    sd: FloatArray,
    low: FloatArray,
    total: FloatArray,
    share: float,
) -> FloatArray:
    """Quantile of truncated Gaussian mixtures (n,), by Newton's method within halved brackets."""
    heavy = weight > 0
    left = np.where(heavy, mean - REACH * sd, np.inf).min(axis=1)
    right = np.where(heavy, mean + REACH * sd, -np.inf).max(axis=1)
    enough = PRECISION * (right - left)
    before, middle = ndtr(low), 0.5 * (left + right)
    rest = np.arange(len(middle))  # those that are not found yet
    for _ in range(STEPS):
        part = (middle[rest, None] - mean[rest]) / sd[rest]
        mass = weight[rest] * (part > low[rest])
        excess = (mass * (ndtr(part) - before[rest])).sum(axis=1) - share * total[rest]
        slope = (mass * np.exp(-0.5 * part**2) / sd[rest]).sum(axis=1)
        left[rest] = np.where(excess < 0, middle[rest], left[rest])
        right[rest] = np.where(excess < 0, right[rest], middle[rest])
        with np.errstate(divide="ignore", invalid="ignore"):
            step = middle[rest] - excess * np.sqrt(2 * np.pi) / slope
        good = (step > left[rest]) & (step < right[rest])
        moved = np.where(good, step, 0.5 * (left[rest] + right[rest]))
        far = np.abs(moved - middle[rest]) > enough[rest]
        middle[rest] = moved
        rest = rest[far]
        if not rest.size:
            break
    return np.asarray(middle)
