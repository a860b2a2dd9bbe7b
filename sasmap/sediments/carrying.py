"""Sediment classes taken over from another survey."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sasmap.arrays import FloatArray, IntArray
from sasmap.numerics.threads import Workers
from sasmap.sediments.bands import SLIGHT, find_bands, leveled
from sasmap.sediments.classes import Classes, dark_blocks, dark_law, log_moments, noise_factor
from sasmap.sediments.fitting import Law
from sasmap.sediments.floor import flat_looks, gather
from sasmap.sediments.trends import AmplitudeGrid, Blocks, first_trends, refit, trend_of

# Standard deviation of the gain difference between surveys (log amplitude: 3 dB), gains that are
# tried as starting values, iterations of a fit.
GAIN_SD = 0.35
GAINS = np.linspace(-1.5, 1.5, 13)
GAIN_ROUNDS = 10
# Scatter of the mean and of the log variance of blocks about those of their class.
SCATTER = (0.05, 0.15)


def carry_over(
    looks: Sequence[AmplitudeGrid],
    laws: Sequence[Law],
    centre: float,
    workers: Workers = 1,
) -> Classes:
    """Take over another survey's classes: fit each look's gain and range trend to them.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
        On one lattice; read in slices.
    laws : sequence of Law
    centre : float
        Log of the cotangent of the grazing angle at which they hold.
    workers : int, None or callable
        Number of threads, or a callable that distributes work.

    Returns
    -------
    Classes

    Raises
    ------
    ValueError
        Where no block of any look is known.
    """
    blocks, _ = gather(looks, centre, workers)
    moments = np.array([log_moments(law) for law in laws]).T
    trends, score = _trends(blocks, *moments)
    bands = find_bands(blocks, first_trends(blocks))
    taken = None
    if bands.span >= SLIGHT:
        flat_blocks = leveled(blocks, bands)
        others, better = _trends(flat_blocks, *moments)
        # Schwarz's criterion: each bin of range is a parameter
        free = sum(gain.size for gain in bands.gains)
        seen = sum(int((b.known > 0).sum()) for b in flat_blocks)
        if better - score > 0.5 * free * np.log(max(seen, 2)):
            blocks, trends, taken = flat_blocks, others, bands
    factor = noise_factor(looks, blocks)
    flat = flat_looks(looks, trends, centre, taken)
    none = dark_law(flat, dark_blocks(blocks, trends, laws), factor)
    return Classes(tuple(laws), trends, centre, factor, none, bands=taken)


def _trends(
    blocks: list[Blocks], means: FloatArray, spreads: FloatArray
) -> tuple[FloatArray, float]:
    """Fit gain and trend of each look under known classes; also return the log likelihood."""
    first = first_trends(blocks)
    best, best_score = first, -np.inf
    for gain in GAINS:
        trends = first + np.array([gain, 0.0, 0.0])
        for _ in range(GAIN_ROUNDS):
            groups, _ = _assigned(blocks, trends, means, spreads)
            trends = refit(blocks, groups, np.nonzero(groups >= 0), first, means, GAIN_SD)
        _, level = _assigned(blocks, trends, means, spreads)
        score = level - 0.5 * float(trends[0, 0] / GAIN_SD) ** 2
        if score > best_score:
            best, best_score = trends, score
    return best, best_score


def _assigned(
    blocks: list[Blocks], trends: FloatArray, means: FloatArray, spreads: FloatArray
) -> tuple[IntArray, float]:
    """Assign each block to a class, -1 where unknown; also return the total log likelihood."""
    total = np.zeros((means.size, *blocks[0].mean.shape))
    seen = np.zeros(blocks[0].mean.shape, bool)
    for block, trend in zip(blocks, trends, strict=True):
        known = block.known > 0
        level = block.mean - trend_of(trend, block.place)
        error = np.hypot(np.sqrt(block.variance / np.maximum(block.known, 1)), SCATTER[0])
        spread = np.log(np.maximum(block.variance, 1e-6))
        for k in range(means.size):
            z = ((level - means[k]) / error) ** 2 + ((spread - spreads[k]) / SCATTER[1]) ** 2
            total[k] += np.where(known, -0.5 * z - np.log(error), 0.0)
        seen |= known
    return np.where(seen, np.argmax(total, axis=0), -1), float(total.max(axis=0)[seen].sum())
