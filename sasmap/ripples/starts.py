"""Where chains start: a coarse scan that sees every mode, then a population cooled into them.

With shadows the likelihood has cliffs and several modes, on which a local search sticks. So a
population is brought from a nearly flat power of the likelihood to its full height by resampling
and Metropolis-Hastings moves (sequential Monte Carlo; Del Moral, Doucet and Jasra 2006). It serves
as burn-in: what is kept comes from the chains of :mod:`sasmap.ripples.sampler`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.kernel import (
    NOISE_BOUNDS,
    PriorData,
    SpeckleData,
    log_likelihood,
    move_population,
    scan_grid,
)
from sasmap.ripples.likelihood import Prior
from sasmap.ripples.presence import MIN_WAVES, Spectrum
from sasmap.ripples.sampler import covariance_factor

FloatArray = NDArray[np.float64]

HEIGHTS = 14
PHASES = 8
NOISE = float(np.log(0.02))
PARTICLES = 96
# Moves per temperature, and the share of effective particles that sets the next temperature.
MOVES = 4
KEPT_SHARE = 0.5
FIRST_SHARE = 0.3
MAX_STAGES = 200


def cooled_population(
    found: Spectrum,
    peaks: NDArray[np.int64],
    data: SpeckleData,
    prior: Prior,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw an approximate sample of the posterior to start and tune chains from.

    Parameters
    ----------
    found : Spectrum
    peaks : ndarray of int
        Candidate peaks of the spectrum, best first; at least one. Their halves and doubles are
        searched too, since shadow can feed a harmonic more than the fundamental.
    data : SpeckleData
    prior : Prior
    rng : Generator

    Returns
    -------
    ndarray (n, 4)
        Particles of equal weight.
    """
    compiled = prior.compiled()
    frequencies, half_step = _frequencies(found, peaks, prior)
    heights = _heights(prior)
    phases = 2 * np.pi * np.arange(PHASES) / PHASES
    table = np.empty((frequencies.size * heights.size * PHASES, 5))
    scan_grid(frequencies, heights, phases, NOISE, data, compiled, table)
    table = table[np.isfinite(table[:, 4])]
    cold = _next_power(table[:, 4], 0.0, min(FIRST_SHARE, 30.0 / len(table)))
    weight = np.exp(cold * (table[:, 4] - table[:, 4].max()))
    chosen = _resample(weight, PARTICLES, rng)
    particles = _jittered(table[chosen, :4], half_step, heights, compiled, rng)
    level = np.array([log_likelihood(p, data) for p in particles])
    return _cool(particles, level, cold, data, compiled, rng)


def _cool(
    particles: FloatArray,
    level: FloatArray,
    power: float,
    data: SpeckleData,
    prior: PriorData,
    rng: np.random.Generator,
) -> FloatArray:
    """Bring particles from a power of the likelihood to its full height; `level` is its log."""
    scale = 1.0
    for _ in range(MAX_STAGES):
        factor = covariance_factor(particles, 1e-6)
        accepted = move_population(particles, level, power, scale * factor, MOVES, data, prior, rng)
        scale = float(np.clip(scale * np.exp(2 * (accepted - 0.3)), 1e-3, 2.0))
        if power >= 1.0:
            break
        step = _next_power(level, power, KEPT_SHARE)
        weight = np.exp((step - power) * (level - level.max()))
        chosen = _resample(weight, len(particles), rng)
        particles, level, power = particles[chosen], level[chosen], step
    return particles


def _frequencies(
    found: Spectrum, peaks: NDArray[np.int64], prior: Prior
) -> tuple[FloatArray, float]:
    """Return frequencies to scan, and half the step between them."""
    low, high = prior.bounds[0]
    step = float(found.frequency[1] - found.frequency[0])
    spot = _bulk(prior, 0)
    if spot is not None and spot[1] < 2 * step:  # the prior is as narrow as a spectral line
        centres, step = [spot[0]], spot[1]
    else:
        centres = [found.frequency[i] * factor for i in peaks for factor in (1.0, 0.5, 2.0)]
        centres += [spot[0]] if spot is not None else []
        low = max(low, min(MIN_WAVES / (found.u[-1] - found.u[0]), high))
    around = np.add.outer(centres, step * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])).ravel()
    return np.unique(np.clip(around, low, high)), step / 2


def _heights(prior: Prior) -> FloatArray:
    low, high = prior.bounds[1]
    spot = _bulk(prior, 1)
    if spot is not None and spot[1] < 0.1 * (high - low):
        return np.unique(np.clip(spot[0] + spot[1] * np.linspace(-2.5, 2.5, HEIGHTS), low, high))
    return np.geomspace(max(low, 2e-3 * high), high, HEIGHTS)


def _bulk(prior: Prior, i: int) -> tuple[float, float] | None:
    """Where a parameter's truncated Gaussian has its mass, and on what scale; None if flat."""
    mean, sd, (low, high) = prior.mean[i], prior.sd[i], prior.bounds[i]
    if not np.isfinite(sd):
        return None
    place = float(np.clip(mean, low, high))
    return place, min(sd, sd**2 / max(abs(mean - place), 1e-300))


def _jittered(
    grid: FloatArray,
    half_step: float,
    heights: FloatArray,
    prior: PriorData,
    rng: np.random.Generator,
) -> FloatArray:
    """Spread grid points over their cells of the scan."""
    n = len(grid)
    moved = grid.copy()
    moved[:, 0] += half_step * rng.uniform(-1, 1, n)
    place = np.searchsorted(heights, grid[:, 1]) + 0.5 * rng.uniform(-1, 1, n)
    moved[:, 1] = np.interp(place, np.arange(heights.size), heights)
    moved[:, 2] += np.pi / PHASES * rng.uniform(-1, 1, n)
    moved[:, 3] += rng.normal(0, 1, n)
    moved[:, :2] = np.clip(moved[:, :2], prior.lower, prior.upper)
    moved[:, 3] = np.clip(moved[:, 3], *NOISE_BOUNDS)
    return np.asarray(moved)


def _next_power(level: FloatArray, power: float, share: float) -> float:
    """Return the power of the likelihood that leaves this share of particles effective."""
    centred = level - level.max()

    def effective(step: float) -> float:
        weight = np.exp(step * centred)
        return float(weight.sum() ** 2 / (weight**2).sum() / level.size)

    if effective(1.0 - power) >= share:
        return 1.0
    low, high = -40.0, np.log(1.0 - power)
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if effective(np.exp(middle)) > share else (low, middle)
    return power + float(np.exp(low))


def _resample(weight: FloatArray, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Systematic resampling."""
    edges = np.cumsum(weight) / weight.sum()
    edges[-1] = 1.0
    return np.searchsorted(edges, (np.arange(n) + rng.random()) / n)
