"""How far amplitude laws differ, and groups of blocks whose laws do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasmap.sediments.fitting import Law, choose
from sasmap.sediments.floor import Flat, pixels_of

# Nats a pixel below which two textures have one histogram.
ALIKE = 0.005
# Share of a texture's blocks that are of one class by amplitude, if it does not cut across those.
WITHIN = 0.7


def law_of(flat: Sequence[Flat], blocks: NDArray[np.bool_], factor: float) -> Law:
    """Fit the law of the pixels of some blocks."""
    values = pixels_of(flat, blocks)
    return choose(values, samples=values.size / factor).law


def laws_of(flat: Sequence[Flat], labels: NDArray[np.int64], factor: float) -> list[Law]:
    """Fit the law of each group.

    Parameters
    ----------
    flat : sequence of Flat
    labels : ndarray of int (block rows, block columns)
        From 0; -1 for none.
    factor : float
        Pixels to an independent sample.

    Returns
    -------
    list of Law
    """
    return [law_of(flat, labels == k, factor) for k in range(int(labels.max()) + 1)]


def merged(
    flat: Sequence[Flat],
    labels: NDArray[np.int64],
    least: int,
    factor: float,
    apart: float,
) -> tuple[NDArray[np.int64], list[Law]]:
    """Unite classes whose laws differ by less than so much, the nearest first; `least` are left."""
    laws = laws_of(flat, labels, factor)
    while len(laws) > least:
        each = range(len(laws))
        pairs = [(separation(laws[i], laws[j]), i, j) for i in each for j in range(i)]
        nearest, i, j = min(pairs)
        if nearest > apart:
            break
        labels = np.where(labels == i, j, labels)
        labels = np.where(labels > i, labels - 1, labels)
        del laws[i]  # j is less
        laws[j] = law_of(flat, labels == j, factor)
    return labels, laws


def within(groups: NDArray[np.int64], classes: NDArray[np.int64]) -> bool:
    """Whether each group of blocks lies mostly within one class, and so cuts across none."""
    both = (groups >= 0) & (classes >= 0)
    table = np.zeros((int(groups.max()) + 1, int(classes.max()) + 1))
    np.add.at(table, (groups[both], classes[both]), 1)
    return bool((table.max(axis=1) >= WITHIN * table.sum(axis=1)).all())


def too_alike(laws: Sequence[Law]) -> bool:
    """Whether there are laws that amplitude does not tell apart."""
    return any(separation(a, b) < ALIKE for i, a in enumerate(laws) for b in laws[:i])


def separation(first: Law, second: Law) -> float:
    """Mean log likelihood ratio a pixel of two laws, nats: the smaller of both directions.

    Parameters
    ----------
    first, second : Law

    Returns
    -------
    float
    """
    top = 6 * np.sqrt(max(first.mean_square, second.mean_square))
    x = np.geomspace(1e-4 * top, top, 800)
    logs = [law.log_density(x) for law in (first, second)]
    step = np.gradient(x)
    return float(
        min(
            np.sum(np.exp(logs[i]) * (logs[i] - logs[1 - i]) * step)
            / np.sum(np.exp(logs[i]) * step)
            for i in range(2)
        )
    )
