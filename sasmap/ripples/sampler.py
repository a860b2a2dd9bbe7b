"""Metropolis-Hastings with proposals learned in burn-in and then frozen.

The log density may be any function of points; nothing here knows of ripples. States are proposed
anew from a mixture of Student densities that is fitted to a weighted population (population Monte
Carlo: Cappe, Guillin, Marin and Robert 2004), so that the kept draws come from one reversible chain.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from sasmap.gaussians import Mixture, expectation_maximisation

FloatArray = NDArray[np.float64]
LogDensity = Callable[[FloatArray], FloatArray]

# Degrees of freedom of the proposal's components: tails that no posterior of a clip outlives.
STUDENT = 6.0
# By how much the fitted covariances are widened: a proposal too narrow would not find out.
WIDENED = 1.15
# Most components, and the least variance of one over that of the whole population.
COMPONENTS, FLOOR = 3, 1e-3


class Proposal:
    """A mixture of Student densities, frozen.

    Parameters
    ----------
    mixture : Mixture
        Of their centres and scales.
    """

    def __init__(self, mixture: Mixture) -> None:
        self._mixture = mixture
        self._factor = np.linalg.cholesky(mixture.covariance)
        size = mixture.mean.shape[1]
        diagonal = np.diagonal(self._factor, axis1=1, axis2=2)
        self._norm = (
            np.log(mixture.weight)
            - np.log(diagonal).sum(axis=1)
            + gammaln(0.5 * (STUDENT + size))
            - gammaln(0.5 * STUDENT)
            - 0.5 * size * np.log(np.pi * STUDENT)
        )

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points (n, size)."""
        which = rng.choice(self._mixture.weight.size, n, p=self._mixture.weight)
        white = rng.standard_normal((n, self._mixture.mean.shape[1]))
        white /= np.sqrt(rng.chisquare(STUDENT, n) / STUDENT)[:, None]
        return self._mixture.mean[which] + np.einsum("nij,nj->ni", self._factor[which], white)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Log density at points (n, size)."""
        size = points.shape[1]
        logs = np.empty((self._mixture.weight.size, len(points)))
        for k, (mean, factor) in enumerate(zip(self._mixture.mean, self._factor, strict=True)):
            white = np.linalg.solve(factor, (points - mean).T)
            square = (white**2).sum(axis=0)
            logs[k] = self._norm[k] - 0.5 * (STUDENT + size) * np.log1p(square / STUDENT)
        return np.asarray(logsumexp(logs, axis=0))


class Chains(NamedTuple):
    """Draws of chains that share a proposal.

    Attributes
    ----------
    draws : ndarray (chains, draws, size)
    accepted : float
        Fraction of the proposals.
    """

    draws: FloatArray
    accepted: float


def metropolis_hastings(
    log_density: LogDensity,
    proposal: Proposal,
    starts: FloatArray,
    steps: int,
    rng: np.random.Generator,
) -> Chains:
    """Run chains whose proposals do not depend on their state.

    Parameters
    ----------
    log_density : callable
        Points (n, size) to log densities (n,), up to a constant.
    proposal : Proposal
    starts : ndarray (chains, size)
        Of finite log density.
    steps : int
    rng : Generator

    Returns
    -------
    Chains
    """
    chains, size = starts.shape
    points = proposal.draw(chains * steps, rng)
    weights = log_density(points) - proposal.log_density(points)
    weights = weights.reshape(chains, steps)
    points = points.reshape(chains, steps, size)
    draws = np.empty((chains, steps, size))
    chance = np.log(rng.random((chains, steps)))
    accepted = 0
    now = log_density(starts) - proposal.log_density(starts)
    for c in range(chains):
        state, weight = starts[c], now[c]
        for k in range(steps):
            if chance[c, k] < weights[c, k] - weight:
                state, weight = points[c, k], weights[c, k]
                accepted += 1
            draws[c, k] = state
    return Chains(draws, accepted / (chains * steps))


def mixture_of_peaks(peaks: list[tuple[FloatArray, FloatArray, float]]) -> Proposal:
    """Return a proposal about peaks: their place, covariance and log weight."""
    level = np.array([p[2] for p in peaks])
    weight = np.maximum(np.exp(0.5 * level), 0.05)
    covariance = np.array([p[1] for p in peaks]) * WIDENED**2
    return Proposal(Mixture(weight / weight.sum(), np.array([p[0] for p in peaks]), covariance))


def fit_proposal(points: FloatArray) -> Proposal:
    """Fit a proposal to a population of equal weights.

    Parameters
    ----------
    points : ndarray (n, size)

    Returns
    -------
    Proposal
        Of as many components as the population's size supports.
    """
    centre, scale = points.mean(axis=0), points.std(axis=0) + 1e-300
    z = (points - centre) / scale
    size = z.shape[1]
    best, best_score = None, -np.inf
    for n in range(1, COMPONENTS + 1):
        mixture, level = _fitted(z, n)
        cost = n * (1 + size + size * (size + 1) / 2)
        score = len(z) * level - 0.5 * cost * np.log(len(z))
        if score > best_score:
            best, best_score = mixture, score
    assert best is not None
    outer = WIDENED**2 * scale[:, None] * scale
    return Proposal(Mixture(best.weight, centre + scale * best.mean, best.covariance * outer))


def _fitted(z: FloatArray, n: int) -> tuple[Mixture, float]:
    """Fit n components, from slices along the direction in which the points are least Gaussian."""
    skewed = np.abs((z**3).mean(axis=0)) + np.abs((z**4).mean(axis=0) / 3 - 1)
    order = np.argsort(np.argsort(z[:, int(np.argmax(skewed))], kind="stable"), kind="stable")
    share = (order * n // len(z))[:, None] == np.arange(n)
    floor = np.full(z.shape[1], FLOOR)
    mixture, _, level = expectation_maximisation(z, share.astype(float), floor, 40, 1e-4)
    return mixture, level


def population(
    log_density: LogDensity,
    proposal: Proposal,
    sizes: tuple[int, ...],
    rng: np.random.Generator,
) -> tuple[FloatArray, Proposal]:
    """Adapt a proposal by importance sampling, again and again.

    Parameters
    ----------
    log_density : callable
    proposal : Proposal
        To begin with.
    sizes : tuple of int
        Points of each round.
    rng : Generator

    Returns
    -------
    points : ndarray (n, size)
        The last round's, resampled.
    proposal : Proposal
        Fitted to them.
    """
    points = np.empty((0, 0))
    for n in sizes:
        drawn = proposal.draw(n, rng)
        weight = log_density(drawn) - proposal.log_density(drawn)
        points = drawn[resampled(tempered(weight), n, rng)]
        points = points + 0.0
        proposal = fit_proposal(points)
    return points, proposal


def tempered(log_weight: FloatArray, least: float = 0.1) -> FloatArray:
    """Flatten importance weights until their effective number is a share of them all."""
    power = 1.0
    while True:
        weight = np.exp(power * (log_weight - log_weight.max()))
        weight /= weight.sum()
        if 1 / (weight**2).sum() >= least * weight.size or power < 1e-3:
            return np.asarray(weight)
        power *= 0.7


def resampled(weight: FloatArray, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Systematic resampling: n indices by weight."""
    places = (rng.random() + np.arange(n)) / n
    index = np.searchsorted(np.cumsum(weight), places)
    return np.asarray(np.minimum(index, weight.size - 1))
