"""Gain of looks without training marks, from comparing their floor with the marked classes.

Passes seldom have the same gain, and a look without marks has no class to be compared with. Where
it overlaps a look of known gain, the shared floor determines its gain. Elsewhere its blocks are
modelled as a mixture of the classes, each a Gaussian of the statistics of marked blocks (mean log
amplitude, its variance at several scales, differences of neighbours); the most probable shares and
gain are taken. Texture does not depend on gain, so it separates a change of gain from a change of
shares.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.numerics.threads import Workers
from sasmap.sediments.description import described
from sasmap.sediments.floor import TILE, Flat, tiles
from sasmap.sediments.trends import BLOCK, Blocks, gain_over

Mask = BoolArray

# Standard deviation of gain between passes of a survey (log amplitude: 1 dB), and the gains that
# are tried. On hand-labelled strips 1 and 1.7 dB perform the same.
GAIN_SD = 0.12
GAINS = np.linspace(-0.6, 0.6, 61)
# Effective number of blocks of a look: its blocks share deviations that no class's scatter
# includes. On hand-labelled strips 30, 100 and 300 perform the same.
COUNTED = 30.0
# Minimum scatter of a class's blocks (the same as for their level in a fit of trends), and number
# of blocks that the pooled scatter counts as when a class's is shrunk towards it.
SCATTER, SHRINK = 0.03, 20.0
# Minimum number of marked blocks of a class; maximum number of tiles of a look that are read;
# iterations for the shares of the mixture.
LEAST, SEEN, ROUNDS = 5, 6, 30


def align(
    flat: Sequence[Flat],
    blocks: Sequence[Blocks],
    labels: IntArray,
    count: int,
    workers: Workers = 1,
) -> FloatArray:
    """Find the gain of each look that has no marked block.

    Parameters
    ----------
    flat : sequence of Flat
        Flattened by the trends so far.
    blocks : sequence of Blocks
        With gain by range subtracted, where there is any.
    labels : ndarray of int (block rows, block columns)
        Class of marked blocks, -1 elsewhere.
    count : int
        Number of classes. Where one has too few marked blocks, only overlap determines gains.
    workers : int, None or callable
        Number of threads, or a callable that distributes work.

    Returns
    -------
    ndarray (looks, 3)
        Gain, slope and bend; gains of marked looks, and all slopes and bends, are unchanged.
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
    """Return a look of unknown gain, and its gain from overlap with one of known gain, if any."""
    for look, other in product(np.flatnonzero(~known), np.flatnonzero(known)):
        gain = gain_over(blocks[int(look)], trends[look], blocks[int(other)], trends[other])
        if gain is not None:
            return int(look), gain
    return int(np.argmin(known)), None


class _Class:
    """Gaussian of the statistics of a class's blocks."""

    def __init__(self, blocks: FloatArray, common: FloatArray) -> None:
        self.mean = blocks.mean(axis=0)
        rest = blocks - self.mean
        scatter = (rest.T @ rest + SHRINK * common) / (len(blocks) + SHRINK)
        self.factor = np.linalg.cholesky(scatter + SCATTER**2 * np.eye(len(scatter)))

    def log_density(self, blocks: FloatArray, gain: float) -> FloatArray:
        """Log density (blocks,) under a gain, up to a constant common to all classes."""
        rest = blocks - self.mean
        rest[:, 0] -= gain
        z = solve_triangular(self.factor, rest.T, lower=True)
        return np.asarray(-0.5 * (z * z).sum(axis=0) - np.log(np.diag(self.factor)).sum())


def _classes(
    flat: Sequence[Flat],
    blocks: Sequence[Blocks],
    labels: IntArray,
    count: int,
    workers: Workers,
) -> list[_Class]:
    """Fit classes to marked blocks; return none where a class has too few."""
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
    """Keep the blocks of some random tiles where a look has more."""
    shape = known.shape
    held = [part for part in tiles(shape, TILE // BLOCK) if known[part].any()]
    chosen = np.random.default_rng(0).permutation(len(held))[:SEEN]
    result = np.zeros(shape, bool)
    for i in chosen:
        result[held[i]] = known[held[i]]
    return result


def _likeliest_gain(shown: FloatArray, classes: Sequence[_Class]) -> float:
    """Find the gain under which blocks (blocks, values) are likeliest as a mixture of classes."""
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
