"""Metropolis-Hastings for a clip's four parameters: state and proposal apart.

The proposal is learned from the burn-in population and then frozen, so that the kept draws come from one
reversible chain: a mixture of independent draws from a Student t, and of differences between two
members of the population (ter Braak and Vrugt 2008), of which those at full length cross between
modes.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.likelihood import PriorData, SpeckleData, log_posterior

FloatArray = NDArray[np.float64]

# Weights of differences of two members: scaled for the local mode, and at full length.
LOCAL, CROSSING = 0.35, 0.15
STUDENT = 5.0


class Proposal(NamedTuple):
    """A frozen mixture proposal.

    Attributes
    ----------
    members : ndarray (n, 4)
        The burn-in population.
    centre : ndarray (4,)
        Of the independent draws.
    factor : ndarray (4, 4)
        Lower Cholesky factor of their scale matrix.
    """

    members: FloatArray
    centre: FloatArray
    factor: FloatArray


class Chain(NamedTuple):
    """Draws of one chain.

    Attributes
    ----------
    draws : ndarray (n, 4)
    accepted : int
    """

    draws: FloatArray
    accepted: int


def learn_proposal(particles: FloatArray) -> Proposal:
    """Fit the proposal to a burn-in population.

    Parameters
    ----------
    particles : ndarray (n, 4)

    Returns
    -------
    Proposal
    """
    sd = np.maximum(particles.std(axis=0), 1e-12 * np.maximum(np.abs(particles).max(axis=0), 1e-6))
    centre = particles.mean(axis=0)
    scaled = (particles - centre) / sd
    correlation = scaled.T @ scaled / len(particles) + 1e-4 * np.eye(centre.size)
    return Proposal(particles.copy(), centre, sd[:, None] * np.linalg.cholesky(correlation))


def metropolis(
    state: FloatArray,
    steps: int,
    proposal: Proposal,
    data: SpeckleData,
    prior: PriorData,
    rng: np.random.Generator,
) -> Chain:
    """Run one chain with a frozen proposal.

    Parameters
    ----------
    state : ndarray (4,)
        Start, with finite log posterior.
    steps : int
    proposal : Proposal
    data : SpeckleData
    prior : PriorData
    rng : Generator

    Returns
    -------
    Chain
    """
    draws = np.empty((steps, state.size))
    accepted = _run(state, proposal, data, prior, rng, draws)
    return Chain(draws, accepted)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _run(state, proposal, data, prior, rng, draws):  # type: ignore[no-untyped-def]
    current = state.copy()
    level = log_posterior(current, data, prior)
    proposed = np.empty(state.size)
    accepted = 0
    for step in range(draws.shape[0]):
        correction = _propose(current, proposal, rng, proposed)
        candidate = log_posterior(proposed, data, prior)
        if np.log(rng.random()) < candidate - level + correction:
            current[:] = proposed
            level = candidate
            accepted += 1
        draws[step] = current
    return accepted


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _propose(current, proposal, rng, proposed):  # type: ignore[no-untyped-def]
    """Fill a proposed state; return log q(current | proposed) - log q(proposed | current)."""
    size = current.size
    kind = rng.random()
    if kind < LOCAL + CROSSING:
        length = proposal.members.shape[0]
        first = rng.integers(0, length)
        second = rng.integers(0, length)
        scale = 1.0
        if kind < LOCAL:
            scale = 2.38 / np.sqrt(2.0 * size) * 10.0 ** (-rng.random())
        for i in range(size):
            proposed[i] = current[i] + scale * (
                proposal.members[first, i] - proposal.members[second, i]
            )
            # the population alone spans finitely many points; a little noise reaches all others
            proposed[i] += 1e-3 * proposal.factor[i, i] * rng.normal()
        return 0.0
    heavy = np.sqrt(STUDENT / rng.chisquare(STUDENT))
    normal = np.empty(size)
    for i in range(size):
        normal[i] = rng.normal()
        proposed[i] = proposal.centre[i]
        for j in range(i + 1):
            proposed[i] += heavy * proposal.factor[i, j] * normal[j]
    return _log_student(current, proposal) - _log_student(proposed, proposal)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _log_student(x, proposal):  # type: ignore[no-untyped-def]
    """Log density of the independent draws, up to a constant."""
    size = x.size
    z = np.empty(size)
    square = 0.0
    for i in range(size):
        z[i] = x[i] - proposal.centre[i]
        for j in range(i):
            z[i] -= proposal.factor[i, j] * z[j]
        z[i] /= proposal.factor[i, i]
        square += z[i] * z[i]
    return -0.5 * (STUDENT + size) * np.log1p(square / STUDENT)
