"""Posterior of a ripple too weak for its wave to be known: all waves that the prior allows.

Where a survey says that cells are rippled but a clip's spectrum has no clear peak, its posterior
has many modes. To second order in the contrast, intensity q over the flat sea floor's, of mean 1
and exponential, about 1 + a t cos(phase + 2 pi k x) has the log likelihood

    log I0(a |F(k)|) - a^2 sum t^2 / 4,        F(k) = sum (q - 1) t exp(-2 pi i k x)

with the phase integrated out; a = 2 (a* - 1) on the steepest slope, less by the noise, and t is how
contrast grows with range (ZC 5). On a grid of waves and heights it makes a proposal, from which
independent chains draw (Metropolis-Hastings) against the same likelihood off the grid.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2, fftfreq
from scipy.special import ive

from sasmap.ripples.fit import Task, noise_factor
from sasmap.ripples.image import Image
from sasmap.ripples.kernel import NOISE_BOUNDS, NOISE_MEAN, NOISE_SD, SIZE, SLIP_SD
from sasmap.ripples.likelihood import Prior
from sasmap.ripples.pixels import box_sums
from sasmap.ripples.posterior import converged
from sasmap.ripples.presence import smooth_trend
from sasmap.ripples.scattering import SIGMA_VARIANCE

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Boxes a wavelength at the highest frequency, most boxes a side, and cells of the grid of waves per
# one over the clip's length.
BOXES = 8
MAX_BOXES = 128
OVERSAMPLED = (4, 2)
MAX_CELLS = 20_000
# Largest gain in log likelihood of what counts as weak: with more there is one mode.
WEAK = 25.0
ROUND = 400
# Standard deviations of the prior that the grid covers, and its cells of A_H.
REACH, HEIGHTS = 6.0, 24


class Weak(NamedTuple):
    """A clip as the likelihood of a weak ripple reads it.

    Attributes
    ----------
    boxes : ndarray (box rows, box columns)
        Sums of (q - 1) t.
    size : int
        Pixels a side of a box.
    square : float
        Sum of t^2.
    tilt : float
        Mean pi/2 less the grazing angle, rad: t is 1 there.
    power : float
        One over the noise factor.
    """

    boxes: FloatArray
    size: int
    square: float
    tilt: float
    power: float


class Grid(NamedTuple):
    """Cells of waves: their centres and what each holds.

    Attributes
    ----------
    waves : ndarray (cells, 2)
        Cycles a column and a row.
    widths : ndarray (2,)
        Of a cell.
    edges : ndarray (heights + 1,)
        Of cells of A_H, m.
    weight : ndarray (cells, heights)
        Share of the posterior, nearly.
    gain : float
        Largest log likelihood.
    """

    waves: FloatArray
    widths: FloatArray
    edges: FloatArray
    weight: FloatArray
    gain: float


def weak_clip(task: Task, wave: FloatArray) -> Weak:
    """Reduce a clip to what the likelihood of a weak ripple needs.

    Parameters
    ----------
    task : Task
    wave : ndarray (2,)
        Strongest wave (east, north), cycles/m: near it the noise is measured.

    Returns
    -------
    Weak
    """
    image = task.image
    pixels = 1 / (task.prior.bounds[0][1] * image.pixel_size)
    size = int(max(pixels / BOXES, np.ceil(max(image.shape) / MAX_BOXES), 1))
    valid = image.valid
    tilt = np.arctan2(image.ground_range, image.altitude)
    flat = np.where(valid, np.exp(-(tilt**2) / SIGMA_VARIANCE), 1.0)
    ratio = image.power / flat
    ratio = ratio / smooth_trend(ratio, valid)
    ratio = np.where(valid, ratio / ratio[valid].mean(), 0.0)
    mean = float(tilt[valid].mean())
    grows = np.where(valid, tilt / mean, 0.0)
    boxes = box_sums((ratio - 1) * grows, valid, 0.0, 0.0, size)[0].real
    factor = 1.0
    if task.settings.speckle == "measured":
        factor = max(noise_factor(image, wave, np.where(valid, ratio + 1e-9, 0.0)), 1.0)
    return Weak(boxes, size, float((grows**2).sum()), mean, 1 / factor)


def contrast(steepness: FloatArray, tilt: float) -> FloatArray:
    """Modulation a of the intensity by slopes of this steepness at most (ZC 5)."""
    slope = np.arctan(steepness)
    damping = np.exp(-(slope**2) / (2 * SIGMA_VARIANCE))
    return np.asarray(2 * damping * np.sinh(slope * tilt / SIGMA_VARIANCE))


def log_gain(contrast: FloatArray, wave_sum: FloatArray, clip: Weak) -> FloatArray:
    """Log likelihood over that of a flat sea floor, for |F| and contrasts that broadcast."""
    z = contrast * wave_sum
    return np.asarray(clip.power * (np.log(ive(0, z)) + z - 0.25 * contrast**2 * clip.square))


def sums_at(waves: FloatArray, clip: Weak, shape: tuple[int, int]) -> ComplexArray:
    """F at waves (n, 2) in cycles a column and a row; phase 0 at the image's centre."""
    rows, columns = clip.boxes.shape
    right, down = (
        (np.arange(n) + 0.5) * clip.size - 0.5 - (full - 1) / 2
        for n, full in ((columns, shape[1]), (rows, shape[0]))
    )
    across = np.exp(-2j * np.pi * waves[:, :1] * right)
    along = np.exp(-2j * np.pi * waves[:, 1:] * down)
    total = np.einsum("nr,nr->n", along, across @ clip.boxes.T)
    return np.asarray(total)


def box_response(waves: FloatArray, size: int) -> FloatArray:
    """Return what boxes leave of the contrast of waves (n, 2) in cycles a column and a row."""
    return np.asarray(np.sinc(waves * size).prod(axis=1))


def _log_prior(f: FloatArray, height: FloatArray, turn: FloatArray, task: Task) -> FloatArray:
    """Of f, A_H and azimuth less the look's (rad), up to a constant; they broadcast."""
    compiled = task.compiled
    look = np.radians(task.image.azimuth)
    off = [f - compiled.mean[0], height - compiled.mean[1], turn + look - compiled.mean[2]]
    value = np.zeros(np.broadcast_shapes(f.shape, height.shape, turn.shape))
    for i in range(3):
        for j in range(3):
            if compiled.precision[i, j] != 0:
                value = value - 0.5 * compiled.precision[i, j] * off[i] * off[j]
    (f_low, f_high), (h_low, h_high) = task.prior.bounds
    inside = (f >= f_low) & (f <= f_high) & (height >= h_low) & (height <= h_high)
    inside = inside & (np.cos(turn) > 0) & (2 * np.pi * f * height <= task.prior.steepest)
    return np.where(inside, value, -np.inf)


def _polar(waves: FloatArray, image: Image) -> tuple[FloatArray, FloatArray]:
    """Frequency (cycles/m) and azimuth less the look's (rad) of waves in cycles a pixel."""
    east, north = image.per_metre(waves.T)
    turn = np.arctan2(east, north) - np.radians(image.azimuth)
    return np.hypot(east, north), (turn + np.pi) % (2 * np.pi) - np.pi


def _covered(prior: Prior, i: int) -> tuple[float, float]:
    """Least and largest value of f or A_H that the prior leaves likely."""
    low, high = prior.bounds[i]
    place, reach = float(np.clip(prior.mean[i], low, high)), REACH * prior.sd[i]
    return max(low, place - reach), min(high, place + reach)


def _height_edges(prior: Prior) -> FloatArray:
    low, high = _covered(prior, 1)
    if low > 0.05 * high:
        return np.linspace(low, high, HEIGHTS + 1)
    return np.concatenate([[low], np.geomspace(max(low, 0.02 * high), high, HEIGHTS + 1)[1:]])


def wave_grid(clip: Weak, task: Task) -> Grid | None:
    """Posterior over cells of waves and heights.

    Parameters
    ----------
    clip : Weak
    task : Task

    Returns
    -------
    Grid or None
        None where no wave that the prior allows fits in the clip.
    """
    image, prior = task.image, task.prior
    low, high = _covered(prior, 0)
    for times in OVERSAMPLED:
        shape = tuple(times * n for n in clip.boxes.shape)
        axes = [fftfreq(n) / clip.size for n in shape]
        row, column = np.meshgrid(*axes, indexing="ij")
        waves = np.stack([column.ravel(), row.ravel()], axis=1)
        f, turn = _polar(waves, image)
        inside = (f >= low) & (f <= high) & (np.cos(turn) > 0)
        if inside.sum() < MAX_CELLS:
            break
    if not inside.any():
        return None
    known = np.abs(fft2(clip.boxes, shape)).ravel()[inside]
    waves, f, turn = waves[inside], f[inside], turn[inside]
    edges = _height_edges(prior)
    middle = 0.5 * (edges[1:] + edges[:-1])
    steepness = 2 * np.pi * (f * np.cos(turn))[:, None] * middle
    a = contrast(steepness, clip.tilt) * box_response(waves, clip.size)[:, None]
    gain = log_gain(a, known[:, None], clip)
    # density over cells of waves: that over (f, azimuth) by f
    level = gain + _log_prior(f[:, None], middle, turn[:, None], task) - np.log(f)[:, None]
    level = level + np.log(np.maximum(np.diff(edges), 1e-300))
    if not np.isfinite(level).any():
        return None
    weight = np.exp(level - level[np.isfinite(level)].max())
    widths = np.array([1 / (n * clip.size) for n in (shape[1], shape[0])])
    return Grid(waves, widths, edges, weight / weight.sum(), float(gain.max()))


def propose(
    grid: Grid, clip: Weak, task: Task, rng: np.random.Generator, n: int
) -> tuple[FloatArray, FloatArray]:
    """Draw independent states from a grid.

    Parameters
    ----------
    grid : Grid
    clip : Weak
    task : Task
    rng : Generator
    n : int

    Returns
    -------
    states : ndarray (n, SIZE)
        theta.
    weight : ndarray (n,)
        Log of the posterior over the proposal, up to a constant.
    """
    flat = grid.weight.ravel()
    chosen = np.minimum(np.searchsorted(np.cumsum(flat), rng.random(n)), flat.size - 1)
    cell, k = np.unravel_index(chosen, grid.weight.shape)
    waves = grid.waves[cell] + grid.widths * (rng.random((n, 2)) - 0.5)
    edges = np.diff(grid.edges)
    height = grid.edges[k] + edges[k] * rng.random(n)
    proposed = np.log(flat[chosen] / np.maximum(edges[k], 1e-300))
    noise = rng.normal(NOISE_MEAN, NOISE_SD, n)
    f, turn = _polar(waves, task.image)
    total = sums_at(waves, clip, task.image.shape)
    steepness = 2 * np.pi * f * np.maximum(np.cos(turn), 0) * height
    a = contrast(steepness, clip.tilt) / (1 + np.exp(noise)) * box_response(waves, clip.size)
    level = log_gain(a, np.abs(total), clip) + _log_prior(f, height, turn, task) - np.log(f)
    level[(noise < NOISE_BOUNDS[0]) | (noise > NOISE_BOUNDS[1])] = -np.inf
    states = np.empty((n, SIZE))
    states[:, 0], states[:, 1] = f, height
    states[:, 2] = turn + np.radians(task.image.azimuth)
    sharp = np.minimum(clip.power * a * np.abs(total), 1e6)
    states[:, 3] = np.angle(total) + rng.vonmises(0.0, sharp)
    states[:, 4] = noise
    states[:, 5] = SLIP_SD * np.clip(rng.normal(size=n), -3, 3)
    return states, level - proposed


def sample_weak(
    task: Task, wave: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, float, bool] | None:
    """Sample the posterior of a ripple whose wave the clip does not show clearly.

    Parameters
    ----------
    task : Task
    wave : ndarray (2,)
        Strongest wave (east, north), cycles/m.
    rng : Generator

    Returns
    -------
    draws : ndarray (chain, draw, SIZE)
        theta.
    accepted : float
        Accepted fraction.
    done : bool
        Whether the chains converged.
        None instead of all where some wave is clear after all, or none fits in the clip.
    """
    clip = weak_clip(task, wave)
    grid = wave_grid(clip, task)
    if grid is None or grid.gain > WEAK:
        return None
    settings = task.settings
    kept = np.empty((settings.chains, 0, SIZE))
    last: list[tuple[FloatArray, float] | None] = [None] * settings.chains
    accepted, done = 0, False
    while kept.shape[1] < settings.draws and not done:
        steps = min(max(ROUND, kept.shape[1]), settings.draws - kept.shape[1])
        chains = []
        for i in range(settings.chains):
            states, weight = propose(grid, clip, task, rng, steps)
            draws, level, moved = _independent_chain(states, weight, last[i], rng)
            last[i] = (draws[-1], level)
            accepted += moved
            chains.append(draws)
        kept = np.concatenate([kept, np.stack(chains)], axis=1)
        done = all(converged(kept[..., i]) for i in range(3))
    return kept, accepted / (kept.shape[0] * kept.shape[1]), done


def _independent_chain(
    states: FloatArray,
    weight: FloatArray,
    start: tuple[FloatArray, float] | None,
    rng: np.random.Generator,
) -> tuple[FloatArray, float, int]:
    """Metropolis-Hastings over independent proposals.

    Returns the states it is in (n, SIZE), the weight of the last and the number of moves. `start`
    is its state and weight so far.
    """
    uniform = np.log(rng.random(len(states)))
    draws = states.copy()
    now, level = start if start is not None else (states[0], -np.inf)
    moved = 0
    for i in range(len(states)):
        if np.isfinite(weight[i]) and uniform[i] < weight[i] - level:
            now, level = states[i], float(weight[i])
            moved += 1
        draws[i] = now
    return draws, level, moved
