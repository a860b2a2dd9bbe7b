"""Where chains start: a coarse scan that sees every mode, then a population cooled into them.

With shadows the likelihood has cliffs and several modes, on which a local search sticks. So a
population is brought from a nearly flat power of the likelihood to its full height by resampling
and Metropolis-Hastings moves (sequential Monte Carlo; Del Moral, Doucet and Jasra 2006). It serves
as burn-in: what is kept comes from the chains of :mod:`sasmap.ripples.sampler`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.folded import FoldData, PriorData
from sasmap.ripples.kernel import (
    NOISE_BOUNDS,
    SIZE,
    climb,
    half_widths,
    log_target,
    move_population,
    scan_table,
)
from sasmap.ripples.likelihood import Prior
from sasmap.ripples.sampler import learn_proposal

FloatArray = NDArray[np.float64]

HEIGHTS = 18
PHASES = 12
NOISES = (np.log(0.004), np.log(0.05))
BLURS = (0.6, 1.0, 1.7)
PARTICLES = 120
# Moves per temperature, and the share of effective particles that sets the next temperature.
MOVES = 3
KEPT_SHARE = 0.3
MAX_STAGES = 100
# Other points of the scan that are climbed from, how far below the best their peaks may be, and by
# how much the first population is wider than the peaks.
RIVALS = 2
RIVAL_MARGIN = 60.0
WIDEN = 2.0
EDGE = 1e-9
# Cosine of the angle to the look of which a start at least is.
ACROSS = 1e-3
# Spread of the starts' wave vector, in parts of a cycle over the clip.
WAVE_SPREAD = 0.04


def scan(data: FoldData, prior: Prior) -> FloatArray:
    """Evaluate the likelihood over a coarse grid of A_H, noise and phase (or the field's error).

    Parameters
    ----------
    data : FoldData
    prior : Prior

    Returns
    -------
    ndarray (n, SIZE + 1)
        theta and log likelihood, at the fold's wave vector (as near as the prior allows).
    """
    wave = data.base if data.field == 0 else data.wave
    # of a wave nearly across the look, the direction that the sonar looks along
    wave = np.array([max(wave[0], ACROSS * np.hypot(*wave)), wave[1]])
    azimuth = data.look + np.arctan2(wave[1], wave[0])
    spot = _bulk(prior, 0)
    frequency = float(np.clip(np.hypot(*wave), *prior.bounds[0]))
    if spot is not None and abs(frequency - spot[0]) > 4 * spot[1]:
        frequency = spot[0]
    phases, blurs = 2 * np.pi * np.arange(PHASES) / PHASES, data.blur[:1]
    if data.field == 1:
        phases, blurs = np.zeros(1), np.clip(data.blur[0] + np.log(BLURS), *data.blur_bounds)
    axes = np.meshgrid(heights(prior), phases, NOISES, blurs, indexing="ij")
    table = np.empty((axes[0].size, SIZE + 1))
    table[:, 0], table[:, 2] = frequency, azimuth
    for column, axis in zip((1, 3, 4, 5), axes, strict=True):
        table[:, column] = axis.ravel()
    scan_table(table, data)
    return table


def cooled_population(
    table: FloatArray,
    peak: FloatArray,
    data: FoldData,
    prior: Prior,
    compiled: PriorData,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw an approximate sample of the posterior to start and tune chains from.

    Parameters
    ----------
    table : ndarray (n, SIZE + 1)
        Of :func:`scan`.
    peak : ndarray (SIZE,)
        Of :func:`polished`.
    data : FoldData
    prior : Prior
    compiled : PriorData
        The same, compiled.
    rng : Generator

    Returns
    -------
    ndarray (PARTICLES, SIZE)
        Coordinates (see :func:`sasmap.ripples.kernel.log_target`) of equal weight.
    """
    peaks = [peak.copy()]
    for start in _rivals(table, peak, data, compiled):
        peaks.append(polished(start, data, compiled)[0])
    (f_low, f_high), (h_low, h_high) = prior.bounds
    for point in peaks:  # at a bound, the way to coordinates and back could step over it
        point[1] = np.clip(point[1], h_low * (1 + EDGE), h_high * (1 - EDGE))
    centres = np.array([coordinates(p) for p in peaks])
    levels = np.array([log_target(x, data, compiled, 1.0) for x in centres])
    centres = centres[levels > levels.max() - RIVAL_MARGIN]
    scale = _scales(data, prior, peak)
    widths = np.array([half_widths(x, scale, data, compiled) for x in centres])
    which = rng.integers(0, len(centres), PARTICLES)
    offset = WIDEN * widths[which] * rng.normal(size=(PARTICLES, SIZE))
    particles = centres[which] + offset
    particles[:, 0] = np.clip(particles[:, 0], f_low, f_high)
    particles[:, 1] = np.abs(particles[:, 1] - h_low) + h_low
    particles[:, 4] = np.clip(particles[:, 4], *NOISE_BOUNDS)
    particles[:, 5] = np.clip(particles[:, 5], *data.blur_bounds)
    bad = ~np.isfinite([log_target(x, data, compiled, 0.0) for x in particles])
    particles[bad] = centres[which[bad]]
    return _cool(particles, data, compiled, rng)


def _rivals(
    table: FloatArray, peak: FloatArray, data: FoldData, compiled: PriorData
) -> list[FloatArray]:
    """Points of the scan that may lead to other peaks: the best at heights far from the peak's."""
    far = np.abs(np.log(np.maximum(table[:, 1], 1e-12) / max(float(peak[1]), 1e-12))) > 0.5
    order = np.argsort(-table[far, SIZE])[:RIVALS]
    return [row[:SIZE] for row in table[far][order]]


def _scales(data: FoldData, prior: Prior, peak: FloatArray) -> FloatArray:
    """Return the largest half-widths of the first population along each coordinate."""
    length = max(float(np.ptp(data.along)), 1.0 / peak[0])
    (f_low, f_high), (h_low, h_high) = prior.bounds
    spread = min(0.25 / length, f_high - f_low)
    return np.array([spread, h_high - h_low, 0.5, np.pi, 1.0, 0.5])


def _cool(
    particles: FloatArray, data: FoldData, prior: PriorData, rng: np.random.Generator
) -> FloatArray:
    """Bring particles to the full height of the likelihood by resampling and moves."""
    power = 0.0
    for _ in range(MAX_STAGES):
        base = np.array([log_target(x, data, prior, 0.0) for x in particles])
        gain = np.array([log_target(x, data, prior, 1.0) for x in particles]) - base
        step = _next_power(gain, power, KEPT_SHARE)
        chosen = _resample(np.exp((step - power) * (gain - gain.max())), len(particles), rng)
        particles, power = particles[chosen].copy(), step
        level = (base + power * gain)[chosen]
        proposal = learn_proposal(particles)
        move_population(particles, level, power, proposal, MOVES, data, prior, rng)
        if power >= 1.0:
            break
    return particles


def coordinates(theta: FloatArray) -> FloatArray:
    """Turn parameters theta (..., SIZE) into the coordinates that are sampled."""
    x = theta.copy()
    x[..., 1] /= 1 + np.exp(x[..., 4])
    return x


def parameters(x: FloatArray) -> FloatArray:
    """Turn sampled coordinates (..., SIZE) into parameters theta."""
    theta = x.copy()
    theta[..., 1] *= 1 + np.exp(theta[..., 4])
    return theta


def heights(prior: Prior) -> FloatArray:
    """Return the values of A_H to scan: evenly over a narrow prior, else in proportion."""
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


def polished(
    start: FloatArray, data: FoldData, compiled: PriorData, rounds: int = 40
) -> tuple[FloatArray, float]:
    """Climb from a point of the scan to the peak of the log posterior near it.

    Parameters
    ----------
    start : ndarray (SIZE,)
    data : FoldData
    compiled : PriorData
    rounds : int

    Returns
    -------
    theta : ndarray (SIZE,)
    level : float
        Log posterior.
    """
    theta = start.copy()
    length = max(float(np.ptp(data.along)), 1 / theta[0])
    across = min(WAVE_SPREAD / length, 1 / np.sqrt(data.wave_precision[1]))
    step = np.array(
        [WAVE_SPREAD / length, 0.15 * theta[1], across / theta[0], np.pi / PHASES, 0.7, 0.3]
    )
    return theta, float(climb(theta, step, data, compiled, rounds))
