"""Separation of amplitude laws, and merging of groups of blocks whose laws do not differ."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_erosion

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.sediments.fitting import Law, choose
from sasmap.sediments.floor import Flat, pixels_of

# Nats per pixel below which two textures have the same histogram.
ALIKE = 0.005
# Distance in blocks (96 pixels) over which the step at an edge is measured, minimum number of pairs
# of blocks, and log amplitude (0.9 and 3.5 dB) by which levels must differ to test for an edge, and
# beyond which they are two sediments even if one changes into the other slowly.
LAG, ENOUGH, TOLD, APART = 6, 20, 0.1, 0.4
# The same minimum difference of levels for textures, whose levels scatter more.
TOLD_TEXTURED = 0.2
# Step as a share of the classes' difference below which there is no edge: simulated edges have 0.93
# and more, wavy ones of recorded snippets 0.72 and 0.89, drifts 0.2 to 0.7.
SHARP = 0.5
# Log amplitude (1.7 dB) by which relief may change a bed's level, as its scattering law is unknown
# (0.16 remains for simulated ripples under a law with a peak); maximum rippled share of the one
# class and minimum of the other where relief separates them (part of a bed may be classed with the
# flat floor).
RELIEF, PARTLY, WHOLLY = 0.2, 0.65, 0.8
# Minimum share of a texture's blocks in one class by amplitude, for it not to cut across classes.
WITHIN = 0.7


def law_of(flat: Sequence[Flat], blocks: BoolArray, factor: float) -> Law:
    """Fit the law of the pixels of some blocks."""
    values = pixels_of(flat, blocks)
    return choose(values, samples=values.size / factor).law


def laws_of(flat: Sequence[Flat], labels: IntArray, factor: float) -> list[Law]:
    """Fit the law of each group.

    Parameters
    ----------
    flat : sequence of Flat
    labels : ndarray of int (block rows, block columns)
        From 0; -1 for none.
    factor : float
        Pixels per independent sample.

    Returns
    -------
    list of Law
    """
    return [law_of(flat, labels == k, factor) for k in range(int(labels.max()) + 1)]


def merged(
    flat: Sequence[Flat],
    labels: IntArray,
    least: int,
    factor: float,
    apart: float,
) -> tuple[IntArray, list[Law]]:
    """Merge classes less than `apart` from each other, nearest first, down to `least`."""
    laws = laws_of(flat, labels, factor)
    while len(laws) > least:
        each = range(len(laws))
        pairs = [(separation(laws[i], laws[j]), i, j) for i in each for j in range(i)]
        nearest, i, j = min(pairs)
        if nearest > apart:
            break
        labels = np.where(labels == i, j, labels)
        labels = np.where(labels > i, labels - 1, labels)
        del laws[i]  # j < i
        laws[j] = law_of(flat, labels == j, factor)
    return labels, laws


def united(
    flat: Sequence[Flat],
    labels: IntArray,
    laws: list[Law],
    level: FloatArray,
    factor: float,
    told: float,
    rippled: BoolArray | None = None,
) -> tuple[IntArray, list[Law]]:
    """Merge classes that differ in level but change into each other without an edge.

    A floor whose level drifts slightly is one sediment; at a boundary the level jumps. Rippled and
    flat floor that differ by no more than the effect of relief are one sediment as well.

    Parameters
    ----------
    flat : sequence of Flat
    labels : ndarray of int (block rows, block columns)
        From 0; -1 for none.
    laws : list of Law
    level : ndarray (block rows, block columns)
        Mean log amplitude of blocks.
    factor : float
        Pixels per independent sample.
    told : float
        Log amplitude by which levels must differ to test for an edge.
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
        laws = [law for k, law in enumerate(laws) if k != i]  # j < i
        laws[j] = law_of(flat, labels == j, factor)
        if rippled is not None:
            del beds[i]
            beds[j] = _beds(flat, labels, [j], rippled)[0]
    return labels, laws


class _Bed(NamedTuple):
    """Log rms amplitude of a class's pixels (shadow changes it little), and its rippled share."""

    power: float
    share: float


def _beds(
    flat: Sequence[Flat],
    labels: IntArray,
    classes: Iterable[int],
    rippled: BoolArray,
) -> list[_Bed]:
    found = []
    for k in classes:
        power = float(np.mean(pixels_of(flat, labels == k) ** 2))
        share = float(rippled[labels == k].mean())
        found.append(_Bed(float(0.5 * np.log(max(power, 1e-30))), share))
    return found


def _sharpness(
    labels: IntArray,
    level: FloatArray,
    pair: tuple[int, int],
    told: float,
    beds: Sequence[_Bed],
) -> float:
    """Level step at the boundary of two classes, relative to the difference of their levels.

    1 where it cannot be determined; 0 where relief can explain the difference and one class is
    rippled and the other has flat floor.
    """
    i, j = pair
    whole = float(np.median(level[labels == i]) - np.median(level[labels == j]))
    relief = bool(beds) and _parted_by_relief(beds[i], beds[j])
    if not relief and not told < abs(whole) < APART:
        return 1.0
    # blocks beside other classes, or beside no class, are mixed
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


def within(groups: IntArray, classes: IntArray) -> bool:
    """Whether each group of blocks lies mostly within one class, and so does not cut across any."""
    both = (groups >= 0) & (classes >= 0)
    table = np.zeros((int(groups.max()) + 1, int(classes.max()) + 1))
    np.add.at(table, (groups[both], classes[both]), 1)
    return bool((table.max(axis=1) >= WITHIN * table.sum(axis=1)).all())


def too_alike(laws: Sequence[Law]) -> bool:
    """Whether there are laws that amplitude does not separate."""
    return any(separation(a, b) < ALIKE for i, a in enumerate(laws) for b in laws[:i])


def separation(first: Law, second: Law) -> float:
    """Mean log likelihood ratio per pixel of two laws, nats: the smaller of both directions.

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
