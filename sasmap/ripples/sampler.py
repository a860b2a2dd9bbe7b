"""Metropolis-Hastings with proposals learned beforehand and then frozen.

The log density may be any function of points; nothing here is specific to ripples. The proposal is
an independence proposal, a mixture of Student t densities fitted to a weighted population
(population Monte Carlo: Cappe, Guillin, Marin and Robert 2004). It is frozen after burn-in, so that
the density is stationary under every step of the kept draws.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from sasmap.arrays import FloatArray, IntArray
from sasmap.numerics.gaussians import Mixture, fill_squares, fitted_mixture

LogDensity = Callable[[FloatArray], FloatArray]

# Degrees of freedom of the proposal's components: heavier tails than the posterior of any clip.
STUDENT = 8.0
# Factor by which the fitted scales are widened: a proposal that is too narrow would go unnoticed,
# but in nine dimensions one 10 % too wide already halves the acceptance rate.
WIDENED = 1.04
# Least log weight of a peak, below that of the first.
LEAST_WEIGHT = 4.0
# Most components, and the least variance of one over that of the whole population.
COMPONENTS, FLOOR = 5, 1e-3
# Local step over the difference of two particles, times the square root of twice the dimension.
LOCAL_STEP = 1.7
# Weight and width of a defensive component, relative to the whole proposal, which limits how far
# the proposal can fall short of the density.
DEFENSIVE, WIDE = 0.15, 2.2
# Draws per chain in the first round (later ones add a quarter), those after which they become
# burn-in and the proposal is learned from them, and how often (pipelines/ripples/coherent.py).
ROUND, RELEARN, LESSONS = 450, 1000, 2
# Independence steps of a chain per local step.
LOCAL = 4
# Most iterations of a mixture's fit, and the gain in mean log likelihood at which it ends.
EM_ROUNDS, EM_ENOUGH = 20, 1e-3
# Approximate share of a chain's draws that are independent.
INDEPENDENT = 0.2
# Importance sampling: points per round, most rounds, effective number of points per dimension to
# which weights are flattened in between, and the one at which it ends.
POINTS, MOST_ROUNDS, ADAPTED, ENOUGH = 300, 12, 4.0, 35.0
# Distinct points per dimension above which a mixture can be fitted.
LEAST_PLACES = 2


class Proposal:
    """A frozen mixture of Student t densities.

    Parameters
    ----------
    mixture : Mixture
        Their weights, centres and scale matrices.
    """

    def __init__(self, mixture: Mixture) -> None:
        self.mixture = mixture
        self._factor = np.linalg.cholesky(mixture.covariance)
        self._inverse = np.linalg.inv(self._factor)
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
        which = rng.choice(self.mixture.weight.size, n, p=self.mixture.weight)
        white = rng.standard_normal((n, self.mixture.mean.shape[1]))
        white /= np.sqrt(rng.chisquare(STUDENT, n) / STUDENT)[:, None]
        moved = np.einsum("nij,nj->ni", self._factor[which], white)
        return np.asarray(self.mixture.mean[which] + moved)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Log density at points (n, size)."""
        squares = np.empty((len(points), self.mixture.weight.size))
        fill_squares(points, self.mixture.mean, self._inverse, squares)
        power = 0.5 * (STUDENT + points.shape[1])
        logs = self._norm - power * np.log1p(squares / STUDENT)
        return np.asarray(np.logaddexp.reduce(logs, axis=1))


class Chains(NamedTuple):
    """Draws of chains that share a proposal.

    Attributes
    ----------
    draws : ndarray (chains, draws, size)
    accepted : float
        Accepted fraction of the independence proposals.
    """

    draws: FloatArray
    accepted: float


def metropolis_hastings(
    log_density: LogDensity,
    proposal: Proposal,
    particles: FloatArray,
    starts: FloatArray,
    steps: int,
    rng: np.random.Generator,
) -> Chains:
    """Run chains with an independence proposal at each step, every few preceded by a local step.

    The local steps are scaled differences of two particles (ter Braak and Vrugt 2008); they lead
    out of regions where the proposal density is too low.

    Parameters
    ----------
    log_density : callable
        Points (n, size) to log densities (n,), up to a constant.
    proposal : Proposal
    particles : ndarray (n, size)
        The frozen population of the local steps.
    starts : ndarray (chains, size)
        Points of finite log density.
    steps : int
    rng : Generator
    """
    chains, size = starts.shape
    points = proposal.draw(chains * steps, rng)
    levels = log_density(points).reshape(steps, chains)
    densities = proposal.log_density(points).reshape(steps, chains)
    points = points.reshape(steps, chains, size)
    local = -(-steps // LOCAL)
    pairs = rng.integers(len(particles), size=(2, local, chains))
    jumps = LOCAL_STEP / np.sqrt(2 * size) * (particles[pairs[0]] - particles[pairs[1]])
    nearer = np.log(rng.random((local, chains)))
    anew = np.log(rng.random((steps, chains)))
    draws = np.empty((chains, steps, size))
    accepted = 0
    state, level, proposed = starts, log_density(starts), proposal.log_density(starts)
    for k in range(steps):
        if k % LOCAL == 0:
            moved = state + jumps[k // LOCAL]
            reached = log_density(moved)
            near = nearer[k // LOCAL] < reached - level
            state, level = np.where(near[:, None], moved, state), np.where(near, reached, level)
            proposed = proposal.log_density(state) if near.any() else proposed
        far = anew[k] < levels[k] - densities[k] - (level - proposed)
        state = np.where(far[:, None], points[k], state)
        level, proposed = np.where(far, levels[k], level), np.where(far, densities[k], proposed)
        accepted += int(far.sum())
        draws[:, k] = state
    return Chains(draws, accepted / (chains * steps))


def sample(
    log_density: LogDensity,
    proposal: Proposal,
    told: Callable[[FloatArray], bool],
    chains: int,
    most: int,
    rng: np.random.Generator,
) -> tuple[Chains, bool]:
    """Draw from a density until the draws suffice: a population, then a frozen proposal.

    Chains that do not suffice become burn-in, from which the proposal is learned again: they stay
    long where the density is much larger than the proposal, in regions that the population missed.

    Parameters
    ----------
    log_density : callable
    proposal : Proposal
        Initial proposal.
    told : callable
        Whether draws (chains, draws, size) suffice.
    chains : int
    most : int
        Most draws per chain.
    rng : Generator

    Returns
    -------
    chains : Chains
    done : bool
        Whether they suffice.
    """
    particles, proposal = population(log_density, proposal, rng)
    proposal = defended(proposal)
    states = particles[rng.permutation(len(particles))[:chains]]
    rounds: list[Chains] = []
    draws, kept, done, lessons = states[:, None], 0, False, 0
    while kept < most and not done:
        if kept >= RELEARN and lessons < LESSONS:
            particles = draws.reshape(-1, states.shape[1])[rng.permutation(draws[..., 0].size)]
            learnt = refitted(proposal, particles, len(particles) * INDEPENDENT)
            proposal = proposal if learnt is proposal else defended(learnt)
            rounds, kept, lessons = [], 0, lessons + 1
        steps = min(kept // 4 or ROUND, most - kept)
        run = metropolis_hastings(log_density, proposal, particles, states, steps, rng)
        states, kept = run.draws[:, -1], kept + steps
        rounds.append(run)
        draws = np.concatenate([r.draws for r in rounds], axis=1)
        done = told(draws)
    accepted = sum(r.accepted * r.draws.shape[1] for r in rounds) / kept
    return Chains(draws, accepted), done


def defended(proposal: Proposal) -> Proposal:
    """Return a proposal with an extra component wider than all of it (Hesterberg 1995)."""
    known = proposal.mixture
    mean = known.weight @ known.mean
    apart = known.mean - mean
    spread = known.covariance + apart[:, :, None] * apart[:, None, :]
    covariance = WIDE**2 * np.einsum("k,kij->ij", known.weight, spread)
    return Proposal(
        Mixture(
            np.append(known.weight * (1 - DEFENSIVE), DEFENSIVE),
            np.vstack([known.mean, mean]),
            np.concatenate([known.covariance, covariance[None]]),
        )
    )


def mixture_of_peaks(peaks: list[tuple[FloatArray, FloatArray, float]]) -> Proposal:
    """Return a proposal centred on peaks, given as location, covariance and log weight."""
    weight = np.exp(np.maximum([p[2] for p in peaks], -LEAST_WEIGHT))
    covariance = np.array([p[1] for p in peaks]) * WIDENED**2
    return Proposal(Mixture(weight / weight.sum(), np.array([p[0] for p in peaks]), covariance))


def refitted(proposal: Proposal, points: FloatArray, effective: float) -> Proposal:
    """Fit a proposal to a population of equal weights.

    Parameters
    ----------
    proposal : Proposal
        Returned as it is if there are too few distinct points.
    points : ndarray (n, size)
    effective : float
        Effective number of independent points, which limits the number of components (Bayesian
        information criterion).
    """
    if np.unique(points[:, 0]).size <= LEAST_PLACES * points.shape[1]:
        return proposal
    fitted = fitted_mixture(points, COMPONENTS, effective, FLOOR, EM_ROUNDS, EM_ENOUGH)
    return Proposal(fitted._replace(covariance=WIDENED**2 * fitted.covariance))


def population(
    log_density: LogDensity, proposal: Proposal, rng: np.random.Generator
) -> tuple[FloatArray, Proposal]:
    """Adapt a proposal by importance sampling, each round with all points of the rounds before.

    Adaptive multiple importance sampling (Cornuet, Marin, Mira and Robert 2012).

    Parameters
    ----------
    log_density : callable
    proposal : Proposal
        Initial proposal.
    rng : Generator

    Returns
    -------
    points : ndarray (n, size)
        Resampled, of equal weights.
    proposal : Proposal
        Fitted to them.
    """
    proposals: list[Proposal] = []
    points, levels = np.empty((0, 0)), np.empty(0)
    chosen = np.resize(proposal.mixture.mean, (POINTS, proposal.mixture.mean.shape[1]))
    for k in range(MOST_ROUNDS):
        drawn = proposal.draw(POINTS, rng)
        proposals.append(proposal)
        points = np.concatenate([points, drawn]) if k else drawn
        levels = np.concatenate([levels, log_density(drawn)])
        if not np.isfinite(levels).any():
            continue
        together = np.logaddexp.reduce([p.log_density(points) for p in proposals])
        log_weight = levels - together
        weight = tempered(log_weight, ADAPTED * points.shape[1])
        chosen = points[resampled(weight, 3 * POINTS, rng)]
        proposal = refitted(proposal, chosen, effective_number(np.log(weight + 1e-300)))
        if effective_number(log_weight) > ENOUGH * points.shape[1]:
            break
    return chosen, proposal


def effective_number(log_weight: FloatArray) -> float:
    """Effective sample size of importance weights."""
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / (weight**2).sum())


def tempered(log_weight: FloatArray, least: float) -> FloatArray:
    """Flatten importance weights until their effective sample size is at least `least`."""
    power = 1.0
    while effective_number(power * log_weight) < least and power > 1e-4:
        power *= 0.8
    weight = np.exp(power * (log_weight - log_weight.max()))
    return np.asarray(weight / weight.sum())


def resampled(weight: FloatArray, n: int, rng: np.random.Generator) -> IntArray:
    """Draw n indices in proportion to weight by systematic resampling."""
    places = (rng.random() + np.arange(n)) / n
    total = np.cumsum(weight)
    index = np.searchsorted(total / total[-1], places)
    return np.asarray(np.minimum(index, weight.size - 1))
