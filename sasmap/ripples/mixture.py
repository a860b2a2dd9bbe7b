"""Gaussian mixtures of (f, A_H, azimuth): what a pass knows, in numbers that can be multiplied."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import logsumexp, ndtr

from sasmap.numerics.gaussians import Mixture, expectation_maximisation, log_densities

FloatArray = NDArray[np.float64]

MOST = 3
# Independent draws that a posterior's draws count as when components are chosen.
EFFECTIVE = 400.0
# Rounds of a fit, the gain in mean log likelihood at which it ends, and the least variance of
# components, over that of all draws.
ROUNDS, ENOUGH, FLOOR = 80, 1e-6, np.full(3, 1e-4)
# Of a product, components of less than this share are left out; no more than so many are kept.
NEGLIGIBLE, MOST_KEPT = 1e-7, 64
# Components of less than this weight do not speak for a pass.
SLIGHT = 0.02
# A density with less of itself within its bounds lies outside.
OUTSIDE = 1e-200


def fit_mixture(points: FloatArray) -> Mixture:
    """Fit a mixture to draws by expectation and maximisation; components as the draws call for.

    Parameters
    ----------
    points : ndarray (n, 3)

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
    covariance = np.cov(z.T) + np.diag(FLOOR)
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
    mixture, _, level = expectation_maximisation(z, share.astype(float), FLOOR, ROUNDS, ENOUGH)
    return mixture, level


def widened(mixture: Mixture, sd: FloatArray) -> Mixture:
    """Add an independent scatter (standard deviations, (3,)) to every component."""
    return mixture._replace(covariance=mixture.covariance + np.diag(sd**2))


def product(first: Mixture, second: Mixture) -> Mixture:
    """Multiply two densities.

    Parameters
    ----------
    first, second : Mixture

    Returns
    -------
    Mixture
        Normalised.
    """
    logs, means, covariances = [], [], []
    for w1, m1, c1 in zip(*first, strict=True):
        for w2, m2, c2 in zip(*second, strict=True):
            gain = np.linalg.solve(c1 + c2, c1).T
            logs.append(np.log(w1) + np.log(w2) + _log_overlap(m1 - m2, c1 + c2))
            means.append(m1 + gain @ (m2 - m1))
            covariance = c1 - gain @ c1
            covariances.append(0.5 * (covariance + covariance.T))
    level = np.array(logs)
    weight = np.exp(level - logsumexp(level))
    kept = np.argsort(-weight, kind="stable")[:MOST_KEPT]
    kept = kept[weight[kept] > NEGLIGIBLE]
    share = weight[kept] / weight[kept].sum()
    return Mixture(share, np.array(means)[kept], np.array(covariances)[kept])


def _log_overlap(offset: FloatArray, covariance: FloatArray) -> float:
    sign, log_determinant = np.linalg.slogdet(covariance)
    square = distance_squared(offset, covariance)
    return float(-0.5 * (square + log_determinant) if sign > 0 else -np.inf)


def distance_squared(offset: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis distance."""
    return float(offset @ np.linalg.solve(covariance, offset))


def disagreement(first: Mixture, second: Mixture) -> float:
    """Squared Mahalanobis distance of two densities' means, of the components nearest each other.

    Parameters
    ----------
    first, second : Mixture

    Returns
    -------
    float
        Of the chi-squared law with 3 degrees of freedom where both speak of the same value.
    """
    return min(
        distance_squared(m1 - m2, c1 + c2)
        for w1, m1, c1 in zip(*first, strict=True)
        for w2, m2, c2 in zip(*second, strict=True)
        if w1 > SLIGHT and w2 > SLIGHT
    )


class Marginal(NamedTuple):
    """Mean, standard deviation and quantiles 0.05 and 0.95 of one parameter."""

    mean: float
    sd: float
    q05: float
    q95: float


def marginal(mixture: Mixture, i: int, bounds: tuple[float, float]) -> Marginal:
    """Summarise one parameter of a mixture, truncated to bounds.

    Parameters
    ----------
    mixture : Mixture
    i : int
    bounds : tuple of float

    Returns
    -------
    Marginal
    """
    mean, sd = mixture.mean[:, i], np.sqrt(mixture.covariance[:, i, i])
    low, high = ((bound - mean) / sd for bound in bounds)
    mass = ndtr(high) - ndtr(low)
    if not mixture.weight @ mass > OUTSIDE:
        return _at_bound(mean, sd, bounds)
    mass = np.maximum(mass, 1e-300)
    density = [np.exp(-0.5 * np.minimum(z**2, 1400)) / np.sqrt(2 * np.pi) for z in (low, high)]
    shift = (density[0] - density[1]) / mass
    edge = [np.where(np.isfinite(z), z, 0) * d for z, d in zip((low, high), density, strict=True)]
    part_mean = np.clip(mean + sd * shift, *bounds)
    part_variance = sd**2 * np.clip(1 + (edge[0] - edge[1]) / mass - shift**2, 1e-12, 1)
    weight = mixture.weight * mass
    weight = weight / weight.sum()
    centre = float(weight @ part_mean)
    variance = float(weight @ (part_variance + (part_mean - centre) ** 2))

    def below(x: float, share: float) -> float:
        return float(weight @ (np.clip(ndtr((x - mean) / sd) - ndtr(low), 0, mass) / mass)) - share

    reach = 12 * float(np.sqrt(variance)) + 1e-300
    ends = max(bounds[0], centre - reach), min(bounds[1], centre + reach)
    q05, q95 = (_root(below, ends, share) for share in (0.05, 0.95))
    return Marginal(centre, float(np.sqrt(variance)), q05, q95)


def _at_bound(mean: FloatArray, sd: FloatArray, bounds: tuple[float, float]) -> Marginal:
    """Summarise what a Gaussian far outside leaves inside: an exponential decline from a bound."""
    beyond = np.maximum(bounds[0] - mean, mean - bounds[1])
    k = int(np.argmin(beyond / sd))
    scale = min(float(sd[k] ** 2 / beyond[k]), bounds[1] - bounds[0])
    places = [scale * -np.log1p(-share) for share in (0.05, 0.95)]
    if mean[k] < bounds[0]:
        q05, q95 = (bounds[0] + place for place in places)
        return Marginal(bounds[0] + scale, scale, q05, min(q95, bounds[1]))
    q95, q05 = (bounds[1] - place for place in places)
    return Marginal(bounds[1] - scale, scale, max(q05, bounds[0]), q95)


def _root(
    function: Callable[[float, float], float], ends: tuple[float, float], share: float
) -> float:
    low, high = (function(end, share) for end in ends)
    if low >= 0 or high <= 0:  # all of it lies at one end
        return ends[0] if low >= 0 else ends[1]
    return float(brentq(function, *ends, args=(share,), xtol=1e-14, rtol=1e-12))
