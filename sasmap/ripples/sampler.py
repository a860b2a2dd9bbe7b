"""Metropolis-Hastings for a clip's four parameters: state and proposal apart.

The proposal is learned from the burn-in population and then frozen, so that the kept draws come
from one reversible chain: a mixture of independent draws from a Student t, and of differences
between two members of the population (ter Braak and Vrugt 2008), of which those at full length
cross between modes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.kernel import PriorData, Proposal, SpeckleData, run_chain

FloatArray = NDArray[np.float64]


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
    return Proposal(particles.copy(), particles.mean(axis=0), covariance_factor(particles, 1e-4))


def covariance_factor(particles: FloatArray, ridge: float) -> FloatArray:
    """Factor the covariance of particles, kept away from degeneracy.

    Parameters
    ----------
    particles : ndarray (n, 4)
    ridge : float
        Added to the diagonal of their correlation matrix.

    Returns
    -------
    ndarray (4, 4)
        Lower Cholesky factor.
    """
    sd = np.maximum(particles.std(axis=0), 1e-12 * np.maximum(np.abs(particles).max(axis=0), 1e-6))
    scaled = (particles - particles.mean(axis=0)) / sd
    correlation = scaled.T @ scaled / len(particles) + ridge * np.eye(particles.shape[1])
    return np.asarray(sd[:, None] * np.linalg.cholesky(correlation))


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
    accepted = run_chain(state, proposal, data, prior, rng, draws)
    return Chain(draws, accepted)
