"""Sediment classes from pixels of known class (training marks)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sasmap.arrays import IntArray
from sasmap.numerics.threads import Workers
from sasmap.sediments.aligning import align
from sasmap.sediments.bands import SLIGHT, Bands, find_bands, leveled
from sasmap.sediments.classes import Classes, dark_blocks, dark_law, noise_factor
from sasmap.sediments.fitting import Law, choose
from sasmap.sediments.floor import TILE, Flat, Part, flat_looks, gather, marked_values, tiles
from sasmap.sediments.texture import DECIDING, Texture, channels, learn, tells_more
from sasmap.sediments.trends import BLOCK, AmplitudeGrid, Blocks, first_trends, refit, trend_of

# Minimum number of independent samples in a class's marked pixels for a law; minimum share of a
# block's pixels with one mark for the block to have it.
LEAST_SAMPLES, MARKED = 50, 0.9
# Gain by range is accepted where removing it leaves less than this share of the scatter within
# marked classes.
AGREE = 0.8
# Number of pixels, over all looks, from which textures are learned.
SAMPLE = 6_000_000


def train_classes(
    looks: Sequence[AmplitudeGrid], marks: Any, count: int, workers: Workers = 1
) -> Classes:
    """Learn classes from pixels of known class.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
        On one lattice; read in slices.
    marks : array of uint8 (rows, columns)
        1 for the first class, 0 where none is known; read in slices.
    count : int
    workers : int, None or callable
        Number of threads, or a callable that distributes work.

    Returns
    -------
    Classes
        In the order of their numbers.

    Raises
    ------
    ValueError
        Where the looks show too few pixels of a class, or no block at all.
    """
    blocks, centre = gather(looks, None, workers)
    labels = _marked_blocks(marks, blocks[0].mean.shape, count)
    index = np.nonzero(labels >= 0)
    bands = _confirmed(blocks, labels)
    if bands is not None:
        blocks = leveled(blocks, bands)
    trends = first_trends(blocks)
    if index[0].size:
        _, groups = np.unique(labels[index], return_inverse=True)
        trends = refit(blocks, groups, index, trends)
    factor = noise_factor(looks, blocks)
    flat = flat_looks(looks, trends, centre, bands)
    trends = align(flat, blocks, labels, count, workers)
    flat = flat_looks(looks, trends, centre, bands)
    laws = []
    for k, (values, known) in enumerate(marked_values(flat, marks, count), 1):
        if known < LEAST_SAMPLES * factor:
            raise ValueError(
                f"class {k}: {known} known pixels are marked; expected at least "
                f"{int(np.ceil(LEAST_SAMPLES * factor))}"
            )
        laws.append(choose(values, samples=values.size / factor).law)
    none = dark_law(flat, dark_blocks(blocks, trends, laws), factor)
    texture = _trained_texture(flat, marks, laws) if count > 1 else None
    return Classes(tuple(laws), trends, centre, factor, none, texture, bands)


def _confirmed(blocks: list[Blocks], labels: IntArray) -> Bands | None:
    """Return gain by range, if marked blocks of one class agree better with it removed.

    Sediments at different ranges along a whole line are not taken for gain where they are marked.
    """
    bands = find_bands(blocks, first_trends(blocks))
    if bands.span < SLIGHT:
        return None
    scatter = [_scatter(some, labels) for some in (blocks, leveled(blocks, bands))]
    return bands if scatter[1] < AGREE * scatter[0] else None


def _scatter(blocks: list[Blocks], labels: IntArray) -> float:
    """Within-class share of the variance of marked blocks' levels, over all looks.

    With a single class, its variance.
    """
    levels, groups = [], []
    for k, (block, trend) in enumerate(zip(blocks, first_trends(blocks), strict=True)):
        there = (labels >= 0) & (block.known > 0)
        levels.append((block.mean - trend_of(trend, block.place))[there])
        groups.append(labels[there] + k * (labels.max() + 1))
    level, group = np.concatenate(levels), np.concatenate(groups)
    if not level.size:
        return 0.0
    _, group = np.unique(group, return_inverse=True)
    counts = np.bincount(group)
    rest = level - (np.bincount(group, level) / counts)[group]
    total = float(np.var(level)) if (labels.max() > 0) else 1.0
    return float(np.mean(rest**2)) / max(total, 1e-12)


def _trained_texture(flat: Sequence[Flat], marks: Any, laws: Sequence[Law]) -> Texture | None:
    """Learn laws at several scales, if they separate the marked pixels better than amplitude."""
    middle = np.log(max(law.mean_square for law in laws)) / 2
    grid = np.linspace(middle - 12, middle + 4, 800)
    table = [law.log_density(np.exp(grid)) for law in laws]
    parts, amplitude = [], []
    for box in _marked_boxes(marks, flat[0].shape, SAMPLE // len(flat)):
        here = np.asarray(marks[box])
        for look in flat:
            logs = look.logs(box)
            if (np.isfinite(logs) & (here > 0)).any():
                parts.append((channels(logs), here.astype(np.int64)))
                amplitude.append(np.stack([np.interp(logs, grid, t) for t in table]))
    most = -(-DECIDING * len(flat) // max(len(parts), 1))
    if not tells_more(parts, amplitude, len(laws), most):
        return None
    return learn(parts, len(laws), most)


def _marked_boxes(marks: Any, shape: tuple[int, ...], most: int) -> list[Part]:
    """Choose boxes of marks in random tiles, up to about `most` pixels, with some of each class."""
    found, total, seen = [], 0, np.zeros(256, bool)
    every = tiles(shape)
    for i in np.random.default_rng(0).permutation(len(every)):
        part = every[i]
        here = np.asarray(marks[part])
        there = np.bincount(here.ravel(), minlength=256)[:256] > 0
        there[0] = False
        if not there.any() or (total > most and not (there & ~seen).any()):
            continue
        # crop the tile to its marks
        ends = [np.flatnonzero(here.any(axis=axis))[[0, -1]] for axis in (1, 0)]
        rows, columns = (
            slice(s.start + int(e[0]), s.start + int(e[1]) + 1)
            for s, e in zip(part, ends, strict=True)
        )
        found.append((rows, columns))
        total += (rows.stop - rows.start) * (columns.stop - columns.start)
        seen |= there
    return found


def _marked_blocks(marks: Any, lattice: tuple[int, ...], count: int) -> IntArray:
    """Class (from 0) of each uniformly marked block, -1 for others."""
    result = np.full(lattice, -1)
    step = TILE // BLOCK
    for top in range(0, lattice[0], step):
        rows = slice(top, min(top + step, lattice[0]))
        here = np.asarray(marks[slice(rows.start * BLOCK, rows.stop * BLOCK)])
        here = here[:, : lattice[1] * BLOCK]
        parts = here.reshape(-1, BLOCK, lattice[1], BLOCK)
        share = np.stack([(parts == k).mean(axis=(1, 3)) for k in range(1, count + 1)])
        result[rows] = np.where(share.max(axis=0) >= MARKED, np.argmax(share, axis=0), -1)
    return result
