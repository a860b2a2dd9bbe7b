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
    evolve,
    half_widths,
    log_targets,
    move_population,
    scan_table,
)
from sasmap.ripples.likelihood import Prior
from sasmap.ripples.sampler import learn_proposal

FloatArray = NDArray[np.float64]

HEIGHTS = 18
PHASES = 12
NOISES = (np.log(0.004), np.log(0.04), np.log(0.4))
BLURS = (0.6, 1.0, 1.7)
PARTICLES = 240
# Moves per temperature, and the share of effective particles that sets the next temperature.
MOVES = 3
KEPT_SHARE = 0.3
MAX_STAGES = 100
# Rounds of importance sampling, draws of each, their degrees of freedom, and the share of effective
# draws from which the proposal is as the posterior.
LEARNING_ROUNDS, LEARNING_DRAWS, TAIL, LEARNED_SHARE = 10, 320, 8.0, 0.3
# Log ratio of heights that are far from each other, and by how much the first population is wider
# than the peak.
FAR = 0.5
WIDEN = 2.0
EDGE = 1e-9
# Width of the kernels, in units of the population's spread, where it has one peak.
ONE_PEAK = 0.7
# Rounds of a climb, and generations of one that evolves.
ROUNDS, FINE_ROUNDS = 24, 6
GENERATIONS = 35
# Cosine of the angle to the look of which a start at least is.
ACROSS = 1e-3
# Spread of the starts' wave vector, in parts of a cycle over the clip.
WAVE_SPREAD = 0.04


def scan(data: FoldData, prior: Prior) -> FloatArray:
    """Evaluate the likelihood over a coarse grid of A_H, noise and phase (or the field's error).

    Parameters
    ----------
    data : FoldData
        On an even grid of phase.
    prior : Prior

    Returns
    -------
    ndarray (n, SIZE + 1)
        theta and log likelihood, at the fold's wave vector (as near as the prior allows).
    """
    wave = data.reference[1:] if data.field == 0 else data.wave
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
    axes = np.meshgrid(heights(prior, frequency), phases, NOISES, blurs, indexing="ij")
    table = np.zeros((axes[0].size, SIZE + 1))
    table[:, 0], table[:, 2] = frequency, azimuth
    for column, axis in zip((1, 3, 4, 5), axes, strict=True):
        table[:, column] = axis.ravel()
    scan_table(table, data)
    return table


def population(
    peak: FloatArray,
    data: FoldData,
    prior: Prior,
    compiled: PriorData,
    rng: np.random.Generator,
) -> tuple[FloatArray, float | None]:
    """Draw an approximate sample of the posterior to start and tune chains from.

    By importance sampling whose proposal is learned from its own draws (Cappe and others 2004);
    where that comes to nothing, by a population that is cooled (sequential Monte Carlo).

    Parameters
    ----------
    peak : ndarray (SIZE,)
        Of :func:`polished`.
    data : FoldData
    prior : Prior
    compiled : PriorData
        The same, compiled.
    rng : Generator

    Returns
    -------
    particles : ndarray (PARTICLES, SIZE)
        Coordinates (see :func:`sasmap.ripples.kernel.log_target`) of equal weight.
    width : float or None
        Of the kernels that suit them; None where their number tells it.
    """
    (h_low, h_high) = prior.bounds[1]
    point = peak.copy()  # at a bound, the way to coordinates and back could step over it
    point[1] = np.clip(point[1], h_low * (1 + EDGE), h_high * (1 - EDGE))
    centre = coordinates(point)
    width = half_widths(centre, _scales(data, prior, peak), data, compiled)
    learned = _learned(centre, width, data, compiled, rng)
    if learned is not None:
        return learned, ONE_PEAK
    return _cool(_spread(centre, width, data, prior, compiled, rng), data, compiled, rng), None


def _learned(
    centre: FloatArray,
    width: FloatArray,
    data: FoldData,
    compiled: PriorData,
    rng: np.random.Generator,
) -> FloatArray | None:
    """Learn one peak by rounds of importance sampling; None where it does not become like it."""
    factor = np.linalg.cholesky(_curvature(centre, width, data, compiled))
    mean, learned = centre, False
    for _ in range(LEARNING_ROUNDS):
        normal = rng.normal(size=(LEARNING_DRAWS, SIZE))
        heavy = np.sqrt(TAIL / rng.chisquare(TAIL, LEARNING_DRAWS))
        draws = mean + heavy[:, None] * normal @ factor.T
        density = -0.5 * (TAIL + SIZE) * np.log1p((normal**2).sum(axis=1) * heavy**2 / TAIL)
        level = log_targets(draws, data, compiled, 1.0) - density
        if not np.isfinite(level).any():
            factor = 0.5 * factor
            continue
        level = np.where(np.isfinite(level), level, -np.inf)
        weight = np.exp(level - level.max())
        share = float(weight.sum() ** 2 / (weight**2).sum() / weight.size)
        if share > LEARNED_SHARE:
            if learned:  # twice: the first time by a few lucky draws
                return draws[_resample(weight, PARTICLES, rng)].copy()
            learned = True
        finite = np.maximum(level - level.max(), -1e6)
        power = min(1.0, _next_power(finite, 0.0, LEARNED_SHARE))
        weight = np.exp(power * finite)
        weight /= weight.sum()
        mean = weight @ draws
        offset = draws - mean
        covariance = (weight[:, None] * offset).T @ offset * (1.2 if power == 1 else 1.0)
        spread = np.sqrt(np.diag(covariance)) + 1e-300
        shape = covariance / spread[:, None] / spread + 0.02 * np.eye(SIZE)
        factor = spread[:, None] * np.linalg.cholesky(shape)
    return None


def _curvature(
    centre: FloatArray, width: FloatArray, data: FoldData, compiled: PriorData
) -> FloatArray:
    """Covariance that the curvature of the log density tells, on the scale of its half-widths.

    Parameters of straight crests are correlated: what each is on its own is too narrow.
    """
    step = 0.5 * width
    shift = np.eye(SIZE) * step
    pairs = [(i, j) for i in range(SIZE) for j in range(i)]
    points = [centre, *(centre + shift), *(centre - shift)]
    points += [centre + shift[i] + shift[j] for i, j in pairs]
    points += [centre - shift[i] - shift[j] for i, j in pairs]
    level = log_targets(np.array(points), data, compiled, 1.0)
    level = np.where(np.isfinite(level), level, level[0] - 4.0)
    up, down = level[1 : 1 + SIZE], level[1 + SIZE : 1 + 2 * SIZE]
    bend = np.diag(np.clip(2 * level[0] - up - down, 0.05, 8.0))
    first, second = np.split(level[1 + 2 * SIZE :], 2)
    for k, (i, j) in enumerate(pairs):
        both = 2 * level[0] - first[k] - second[k]
        cross = 0.5 * (both - bend[i, i] - bend[j, j])
        bound = 0.95 * np.sqrt(bend[i, i] * bend[j, j])
        bend[i, j] = bend[j, i] = np.clip(cross, -bound, bound)
    value, vector = np.linalg.eigh(bend)
    inverse = (vector / np.maximum(value, 0.05)) @ vector.T
    return np.asarray(1.3 * step[:, None] * inverse * step)


def _spread(
    centre: FloatArray,
    width: FloatArray,
    data: FoldData,
    prior: Prior,
    compiled: PriorData,
    rng: np.random.Generator,
) -> FloatArray:
    """Particles about a peak, wider than it is."""
    particles = centre + WIDEN * width * rng.normal(size=(PARTICLES, SIZE))
    h_low = prior.bounds[1][0]
    particles[:, 0] = np.clip(particles[:, 0], *prior.bounds[0])
    particles[:, 1] = np.abs(particles[:, 1] - h_low) + h_low
    particles[:, 4] = np.clip(particles[:, 4], *NOISE_BOUNDS)
    particles[:, 5] = np.clip(particles[:, 5], *data.blur_bounds)
    bad = ~np.isfinite(log_targets(particles, data, compiled, 0.0))
    particles[bad] = centre
    return np.asarray(particles)


def rivals(table: FloatArray, peak: FloatArray) -> list[FloatArray]:
    """Return points of the scan that may lead to other peaks.

    The best at heights far from the peak's, and the best with each other noise than the best's: a
    floor that is bright in its shadow and one that has none look alike.

    Parameters
    ----------
    table : ndarray (n, SIZE + 1)
        Of :func:`scan`.
    peak : ndarray (SIZE,)

    Returns
    -------
    list of ndarray (SIZE,)
    """
    best = table[np.argmax(table[:, SIZE])]
    apart = np.abs(np.log(np.maximum(table[:, 1], 1e-12) / max(float(peak[1]), 1e-12))) > FAR
    others = [apart] + [table[:, 4] == noise for noise in NOISES if noise != best[4]]
    return [table[o][np.argmax(table[o, SIZE]), :SIZE] for o in others if o.any()]


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
        base = log_targets(particles, data, prior, 0.0)
        gain = log_targets(particles, data, prior, 1.0) - base
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


def heights(prior: Prior, frequency: float) -> FloatArray:
    """Return the values of A_H to scan: evenly over a narrow prior, else in proportion."""
    low, high = prior.bounds[1]
    high = max(min(high, 0.999 * prior.steepest / (2 * np.pi * frequency)), low)
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
    start: FloatArray, data: FoldData, compiled: PriorData, near: bool = False
) -> tuple[FloatArray, float]:
    """Climb from a point of the scan to the peak of the log posterior near it.

    Parameters
    ----------
    start : ndarray (SIZE,)
    data : FoldData
    compiled : PriorData
    near : bool
        Whether the peak is near.

    Returns
    -------
    theta : ndarray (SIZE,)
    level : float
        Log posterior.
    """
    theta = start.copy()
    length = max(float(np.ptp(data.along)), 1 / theta[0])
    width = max(float(np.ptp(data.across)), length / 4)
    turn = WAVE_SPREAD / width / theta[0]
    step = np.array([WAVE_SPREAD / length, 0.15 * theta[1], turn, np.pi / PHASES, 0.7, 0.2])
    if data.fine == 0 and data.field == 0:
        # one block a strip tells nothing across the look, one strip nothing along it
        step[2] = 0.0
        step[0] *= data.group[-1] > 1
    if data.fine == 0 and not near:
        return theta, float(climb(theta, step, data, compiled, ROUNDS))
    if data.shadow:  # edges of shadow make bent ridges
        step = step * (0.05 if near else 0.2)
        generations = GENERATIONS // 2 if near else GENERATIONS
        evolve(theta, step, data, compiled, generations, np.random.default_rng(0))
        step = step / 4
    return theta, float(climb(theta, step, data, compiled, FINE_ROUNDS))
