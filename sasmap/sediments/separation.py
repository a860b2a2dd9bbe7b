"""How far amplitude laws differ, and groups of blocks whose laws do not."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from sasmap.sediments.fitting import Law, choose
from sasmap.sediments.floor import Flat, pixels_of

FloatArray = NDArray[np.float64]

# Nats a pixel below which two textures have one histogram.
ALIKE = 0.005
# Blocks (96 pixels) across which an edge lifts the level by nearly as much as classes differ, pairs
# of blocks that tell it, and log amplitude (0.9 and 3.5 dB) by which levels must differ to tell it,
# and beyond which they are two sediments even if one changes into the other slowly.
LAG, ENOUGH, TOLD, APART = 6, 20, 0.1, 0.4
# That of textures, whose levels scatter more.
TOLD_TEXTURED = 0.2
# Share of the classes' difference below which there is no edge: simulated edges have 0.93 and more,
# wavy ones of recorded snippets 0.72 and 0.89, drifts 0.2 to 0.7.
SHARP = 0.5
# Log amplitude (1.7 dB) that relief may make of a bed's level, as its law is not known: 0.16 is
# left of simulated ripples under a law with a peak; and the rippled shares of the two classes, the
# one at most and the other at least, if it is that which parts them: part of a bed may be with the
# flat floor.
RELIEF, PARTLY, WHOLLY = 0.2, 0.65, 0.8
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


def united(
    flat: Sequence[Flat],
    labels: NDArray[np.int64],
    laws: list[Law],
    level: FloatArray,
    factor: float,
    told: float,
    rippled: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int64], list[Law]]:
    """Unite classes that differ in level but change into each other without an edge.

    A floor whose level drifts a little is one sediment; a boundary is where it jumps. Rippled floor
    and flat floor that differ by no more than what relief makes are one sediment as well.

    Parameters
    ----------
    flat : sequence of Flat
    labels : ndarray of int (block rows, block columns)
        From 0; -1 for none.
    laws : list of Law
    level : ndarray (block rows, block columns)
        Mean log amplitude of blocks.
    factor : float
        Pixels to an independent sample.
    told : float
        Log amplitude by which levels must differ to tell whether there is an edge.
    rippled : ndarray of bool (block rows, block columns), optional

    Returns
    -------
    labels : ndarray of int (block rows, block columns)
    laws : list of Law
    """
    beds = [] if rippled is None else _beds(flat, labels, range(len(laws)), rippled)
    while len(laws) > 1:
        each = range(len(laws))
        softest, i, j = min(
            (_sharpness(labels, level, (i, j), told, beds), i, j) for i in each for j in range(i)
        )
        if softest > SHARP:
            break
        labels = np.where(labels == i, j, labels)
        labels = np.where(labels > i, labels - 1, labels)
        laws = [law for k, law in enumerate(laws) if k != i]  # j is less
        laws[j] = law_of(flat, labels == j, factor)
        if rippled is not None:
            del beds[i]
            beds[j] = _beds(flat, labels, [j], rippled)[0]
    return labels, laws


class _Bed(NamedTuple):
    """Log rms amplitude of a class's pixels, which shadow changes little, and its rippled share."""

    power: float
    share: float


def _beds(
    flat: Sequence[Flat],
    labels: NDArray[np.int64],
    classes: Iterable[int],
    rippled: NDArray[np.bool_],
) -> list[_Bed]:
    found = []
    for k in classes:
        power = float(np.mean(pixels_of(flat, labels == k) ** 2))
        share = float(rippled[labels == k].mean())
        found.append(_Bed(float(0.5 * np.log(max(power, 1e-30))), share))
    return found


def _sharpness(
    labels: NDArray[np.int64],
    level: FloatArray,
    pair: tuple[int, int],
    told: float,
    beds: Sequence[_Bed],
) -> float:
    """Difference of two classes' levels across their boundary, of that of the classes as such.

    1 where it cannot be told; 0 where it is as little as relief makes, one class is rippled and the
    other has flat floor.
    """
    i, j = pair
    whole = float(np.median(level[labels == i]) - np.median(level[labels == j]))
    relief = bool(beds) and _parted_by_relief(beds[i], beds[j])
    if not relief and not told < abs(whole) < APART:
        return 1.0
    # blocks beside another class, or beside nothing, hold some of it
    pure = binary_erosion((labels == i) | (labels == j), np.ones((3, 3)), border_value=1)
    inside = np.where(pure, labels, -1)
    jumps = []
    for axis in (0, 1):
        near, far = (np.moveaxis(v, axis, 0) for v in (inside, level))
        step = far[:-LAG] - far[LAG:]
        jumps.append(step[(near[:-LAG] == i) & (near[LAG:] == j)])
        jumps.append(-step[(near[:-LAG] == j) & (near[LAG:] == i)])
    every = np.concatenate(jumps)
    if every.size < ENOUGH:
        return 1.0
    return 0.0 if relief else float(np.median(every)) / whole


def _parted_by_relief(first: _Bed, second: _Bed) -> bool:
    less, more = sorted((first.share, second.share))
    return less < PARTLY and more > WHOLLY and abs(first.power - second.power) < RELIEF


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
