"""Gain of looks that no training marks, by how their floor looks beside that of marked classes.

Passes are seldom gained alike, and a look without marks has no class to be compared with. Where it
overlaps a look whose gain is known, the floor that both show tells. Elsewhere its blocks are taken
for a mixture of the classes, each a Gaussian of what marked blocks show (mean log amplitude, its
variance at several scales, differences of neighbours): shares and gain are the likeliest ones.
Texture does not depend on gain, so it tells a gain from other shares.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from sasmap.numerics.threads import Workers
from sasmap.sediments.description import described
from sasmap.sediments.floor import TILE, Flat, tiles
from sasmap.sediments.trends import BLOCK, Blocks, gain_over

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

# By how much gains of a survey's passes differ (standard deviation of the log amplitude: 1 dB), and
# gains that are tried. On hand-labelled strips 1 and 1.7 dB are alike.
GAIN_SD = 0.12
GAINS = np.linspace(-0.6, 0.6, 61)
# Blocks that those of a look count as: what its floor has in common is in no class's scatter. On
# hand-labelled strips 30, 100 and 300 are alike.
COUNTED = 30.0
# Least scatter of a class's blocks (as of their level in a fit of trends), and blocks by which a
# class's scatter is drawn to that of all.
SCATTER, SHRINK = 0.03, 20.0
# Blocks that tell what a class looks like, at least; tiles of a look that are seen, at most; rounds
# of a mixture's shares.
LEAST, SEEN, ROUNDS = 5, 6, 30


def align(
    flat: Sequence[Flat],
    blocks: Sequence[Blocks],
    labels: NDArray[np.int64],
    count: int,
    workers: Workers = 1,
) -> FloatArray:
    """Find the gain of each look that has no marked block.

    Parameters
    ----------
    flat : sequence of Flat
        By the trends so far.
    blocks : sequence of Blocks
        Less gain by range, where there is any.
    labels : ndarray of int (block rows, block columns)
        Class of marked blocks, -1 elsewhere.
    count : int
        Classes. Where one has too few marked blocks, only overlap tells gains.
    workers : int, None or callable
        Threads, or what spreads work.

    Returns
    -------
    ndarray (looks, 3)
        Gain, slope and bend; gains of marked looks, and all slopes and bends, are as they were.
    """
    trends = np.array([f.trend for f in flat])
    known = np.array([bool(((labels >= 0) & (b.known > 0)).any()) for b in blocks])
    if known.all() or not known.any():
        return trends
    classes = _classes(flat, blocks, labels, count, workers)
    while not known.all():
        look, gain = _by_overlap(blocks, trends, known)
        if gain is None and classes:
            seen = _thinned(blocks[look].known > 0)
            gain = trends[look, 0] + _likeliest_gain(_shown(flat[look], seen, workers), classes)
        trends[look, 0] = trends[look, 0] if gain is None else gain
        known[look] = True
    return trends


def _by_overlap(
    blocks: Sequence[Blocks], trends: FloatArray, known: Mask
) -> tuple[int, float | None]:
    """Return a look of unknown gain and its gain by floor that one of known gain shows, if any."""
    for look, other in product(np.flatnonzero(~known), np.flatnonzero(known)):
        gain = gain_over(blocks[int(look)], trends[look], blocks[int(other)], trends[other])
        if gain is not None:
            return int(look), gain
    return int(np.argmin(known)), None


class _Class:
    """Gaussian of what a class's blocks show."""

    def __init__(self, blocks: FloatArray, common: FloatArray) -> None:
        self.mean = blocks.mean(axis=0)
        rest = blocks - self.mean
        scatter = (rest.T @ rest + SHRINK * common) / (len(blocks) + SHRINK)
        self.factor = np.linalg.cholesky(scatter + SCATTER**2 * np.eye(len(scatter)))

    def log_density(self, blocks: FloatArray, gain: float) -> FloatArray:
        """Log density (blocks,), up to a constant of all classes, under a gain."""
        rest = blocks - self.mean
        rest[:, 0] -= gain
        z = solve_triangular(self.factor, rest.T, lower=True)
        return np.asarray(-0.5 * (z * z).sum(axis=0) - np.log(np.diag(self.factor)).sum())


def _classes(
    flat: Sequence[Flat],
    blocks: Sequence[Blocks],
    labels: NDArray[np.int64],
    count: int,
    workers: Workers,
) -> list[_Class]:
    """Classes as marked blocks show them; none where some class has too few."""
    shown, group = [], []
    for one, block in zip(flat, blocks, strict=True):
        there = (labels >= 0) & (block.known > 0)
        if there.any():
            values = described(one, there, workers)
            there &= np.isfinite(values[..., 0])
            shown.append(values[there])
            group.append(labels[there])
    values, which = np.concatenate(shown), np.concatenate(group)
    each = [values[which == k] for k in range(count)]
    if min(len(v) for v in each) < LEAST:
        return []
    rest = np.concatenate([v - v.mean(axis=0) for v in each])
    return [_Class(v, rest.T @ rest / len(rest)) for v in each]


def _shown(look: Flat, seen: Mask, workers: Workers) -> FloatArray:
    values = described(look, seen, workers)
    return np.asarray(values[seen & np.isfinite(values[..., 0])])


def _thinned(known: Mask) -> Mask:
    """Blocks of some tiles, at random, where a look is seen in more."""
    shape = known.shape
    held = [part for part in tiles(shape, TILE // BLOCK) if known[part].any()]
    chosen = np.random.default_rng(0).permutation(len(held))[:SEEN]
    result = np.zeros(shape, bool)
    for i in chosen:
        result[held[i]] = known[held[i]]
    return result


def _likeliest_gain(shown: FloatArray, classes: Sequence[_Class]) -> float:
    """Gain under which blocks (blocks, values) are likeliest a mixture of classes."""
    if not len(shown):
        return 0.0
    scores = []
    for gain in GAINS:
        density = np.stack([one.log_density(shown, gain) for one in classes])
        shares = np.full((len(classes), 1), 1 / len(classes))
        for _ in range(ROUNDS):
            level = density + np.log(np.maximum(shares, 1e-12))
            total = logsumexp(level, axis=0)
            shares = np.exp(level - total).mean(axis=1, keepdims=True)
        scores.append(COUNTED * total.mean() - 0.5 * (gain / GAIN_SD) ** 2)
    return float(GAINS[np.argmax(scores)])
