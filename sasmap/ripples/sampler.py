"""Metropolis-Hastings for a clip's parameters: state and proposal apart.

The proposal is learned in burn-in and then frozen, so that the kept draws come from one reversible
chain. States are drawn anew from the density of the burn-in population, whose many kernels follow
ridges and several modes, or step by differences of its members (ter Braak and Vrugt 2008).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.folded import FoldData, PriorData, Proposal
from sasmap.ripples.kernel import STUDENT, run_chain

FloatArray = NDArray[np.float64]


class Chain(NamedTuple):
    """Draws of one chain.

    Attributes
    ----------
    draws : ndarray (n, SIZE)
    accepted : int
    """

    draws: FloatArray
    accepted: int


def learn_proposal(
    particles: FloatArray, widen: float = 1.0, width: float | None = None
) -> Proposal:
    """Fit the proposal to a burn-in population.

    Parameters
    ----------
    particles : ndarray (n, SIZE)
    widen : float
        By which the population is spread about its mean first.
    width : float, optional
        Of the kernels; where not given, by how many particles there are.

    Returns
    -------
    Proposal
    """
    n, size = particles.shape
    centre = particles.mean(axis=0)
    particles = centre + widen * (particles - centre)
    factor = covariance_factor(particles, 1e-4)
    white = np.linalg.solve(factor, (particles - centre).T).T
    if width is None:
        width = (4 / ((size + 2) * n)) ** (1 / (size + 4))  # Silverman's
    together = np.sqrt(1 - width**2 * STUDENT / (STUDENT - 2))
    return Proposal(particles.copy(), together * white, centre, factor, width)


def covariance_factor(particles: FloatArray, ridge: float) -> FloatArray:
    """Factor the covariance of particles, kept away from degeneracy.

    Parameters
    ----------
    particles : ndarray (n, SIZE)
    ridge : float
        Added to the diagonal of their correlation matrix.

    Returns
    -------
    ndarray (SIZE, SIZE)
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
    data: FoldData,
    prior: PriorData,
    rng: np.random.Generator,
) -> Chain:
    """Run one chain with a frozen proposal.

    Parameters
    ----------
    state : ndarray (SIZE,)
        Start, with finite log posterior.
    steps : int
    proposal : Proposal
    data : FoldData
    prior : PriorData
    rng : Generator

    Returns
    -------
    Chain
    """
    draws = np.empty((steps, state.size))
    accepted = run_chain(state, proposal, data, prior, rng, draws)
    return Chain(draws, accepted)
