"""Sediment classes: how many there are, and their amplitude laws.

Blocks of pixels are described by mean and variance of their log amplitude, less the gain of
the pass and its trend over grazing angle, and grouped by a Gaussian mixture; groups whose laws
differ by too little a pixel are one sediment. Each class is then an amplitude law of its own
(:func:`sasmap.sediments.fitting.choose`). Classes may also be learned from pixels that are marked,
or be those of another survey.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from sasmap.numerics.looks import effective_samples
from sasmap.sediments.bands import Bands, find_bands, steep
from sasmap.sediments.fitting import Law, choose
from sasmap.sediments.floor import (
    TILE,
    Flat,
    Part,
    around,
    chosen_tiles,
    gather,
    marked_values,
    pixels_of,
    tiles,
)
from sasmap.sediments.grouping import grouped, pruned, textured_groups
from sasmap.sediments.texture import DECIDING, MARGIN, Texture, channels, learn, tells_more
from sasmap.sediments.trends import (
    BLOCK,
    AmplitudeGrid,
    Blocks,
    first_trends,
    log_cotangent,
    refit,
    trend_of,
)

FloatArray = NDArray[np.float64]

# Scatter that mean and log variance of blocks of one sediment have beyond their sampling.
FLOOR = (0.02, 0.06)
# Blocks differ from their neighbours' mean by less than so many standard deviations where they hold
# one sediment.
EVEN = 3.0
# Mean log likelihood ratio a pixel (nats) by which laws must differ to be two sediments.
APART = 0.02
# Nats a pixel below which two textures have one histogram.
ALIKE = 0.005
# Share of a texture's blocks that are of one class by amplitude, if it does not cut across those.
WITHIN = 0.7
# Pixels, of all looks, whose texture is described (at most some 250 MB, by blocks) and from which
# textures are learned; and pixels a side of the tiles they are in where a survey has more of them.
DESCRIBED, SAMPLE, SAMPLED_SIDE = 100_000_000, 6_000_000, 256
# Of a class's marked pixels, independent samples that a law takes at least; and share of a block's
# pixels that are marked alike where the block is.
LEAST_SAMPLES, MARKED = 50, 0.9
# Below the survey's median log amplitude by so much (14 dB) there is no sediment, or below that of
# the darkest known one (5 dB); blocks that tell what is there instead, at least.
DARK, DARKER, LEAST_DARK = 1.6, 0.58, 4
# Of another survey's classes: by how much this one's gain may differ (standard deviation of the log
# amplitude: 3 dB), gains that are tried, rounds of a fit.
GAIN_SD = 0.35
GAINS = np.linspace(-1.5, 1.5, 13)
GAIN_ROUNDS = 10
# Gain by range that makes no classes, and that which surely moves them: log amplitude from the
# least to the greatest (0.4 and 1.7 dB).
SLIGHT, PLAIN = 0.05, 0.2
# Scatter of blocks' mean and log variance about their class's.
SCATTER = (0.05, 0.15)


@dataclass(frozen=True)
class Classes:
    """Sediment classes of a survey.

    Attributes
    ----------
    laws : tuple of Law
        By rising mean intensity where they were found, so that numbers are stable.
    trends : ndarray (looks, 3)
        Log gain of each look, and its slope and bend with the log cotangent of the
        grazing angle about `centre`.
    centre : float
        Log of a cotangent.
    noise_factor : float
        Pixels that one independent sample makes.
    dark : Law or None
        Of what is too dark to be sediment: shadow, water column.
    texture : Texture or None
        Laws at several scales, where amplitude alone does not tell the classes.
    bands : Bands or None
        Gain by range that would else have been sediments, though no two looks confirm them.
    """

    laws: tuple[Law, ...]
    trends: FloatArray
    centre: float
    noise_factor: float
    dark: Law | None = None
    texture: Texture | None = None
    bands: Bands | None = None

    @property
    def every(self) -> tuple[Law, ...]:
        """Laws of the classes, and after them that of what is no sediment."""
        return self.laws if self.dark is None else (*self.laws, self.dark)

    def log_trend(self, look: int, cotangent: FloatArray) -> FloatArray:
        """Log of the amplitude that a look's gain and trend make."""
        t = log_cotangent(cotangent) - self.centre
        gain = trend_of(self.trends[look], t)
        return gain if self.bands is None else gain + self.bands.of(look, t)


def find_classes(
    looks: Sequence[AmplitudeGrid], count: int | None = None, workers: int | None = 1
) -> Classes:
    """Find the classes of a survey.

    Amplitude is gathered from all of it, by blocks; texture and laws from a part of a large one.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
        On one lattice; slices are read.
    count : int, optional
        How many; found where not given.
    workers : int, optional
        Threads.

    Returns
    -------
    Classes

    Raises
    ------
    ValueError
        Where no block of any look is known.
    """
    blocks, centre = gather(looks, None, workers)
    found = _found(looks, blocks, centre, count, workers)
    if count is not None or len(found.laws) < 2:
        return found
    bands = find_bands(blocks, first_trends(blocks))
    if bands.span < SLIGHT:
        return found
    flat = [b._replace(mean=b.mean - bands.of(k, b.place)) for k, b in enumerate(blocks)]
    fewer = _found(looks, flat, centre, count, workers, bands)
    # what follows range alone is no sediment; else the trend suffices
    most = len(found.laws) - (bands.span < PLAIN)
    return fewer if len(fewer.laws) <= most else found


def _found(
    looks: Sequence[AmplitudeGrid],
    blocks: list[Blocks],
    centre: float,
    count: int | None,
    workers: int | None,
    bands: Bands | None = None,
) -> Classes:
    """Find classes by blocks that are free of bands of gain, if there are any."""
    first = trends = first_trends(blocks)
    dark = _dark(blocks, trends)
    for _ in range(3):
        features, index = _features(blocks, trends, dark)
        groups = grouped(features, FLOOR, count or 1)
        trends = refit(blocks, groups, index, first)
    factor = noise_factor(looks, blocks)
    labels = np.full(blocks[0].mean.shape, -1)
    labels[index] = groups
    flat = [Flat(looks[k], trend, centre, bands, k) for k, trend in enumerate(trends)]
    none = _dark_law(flat, dark, factor)
    # groups that are one sediment first: each would be beside the other everywhere
    labels, _ = _merged(flat, labels, count or 1, factor, APART)
    labels = pruned(labels, count or 1)
    chosen = _sampled(flat, labels, DESCRIBED)
    unclear = dark if bands is None else dark | steep(bands, blocks)
    textured, mixed = textured_groups(flat, labels, unclear, count, chosen, workers)
    labels, laws = _merged(flat, labels, count or 1, factor, APART if count is None else np.inf)
    others = _laws(flat, textured, factor)
    # where amplitude suffices, it has the sharper boundaries
    nested = _within(textured, labels)
    alike = len(others) > 1 and _too_alike(others) and nested
    same = len(others) == len(laws) and nested and _within(labels, textured)
    needed = alike or (mixed and not same and len(others) >= max(len(laws), 2))
    if needed:
        labels, laws = textured, others
    order = np.argsort([law.mean_square for law in laws], kind="stable")
    sorted_laws = tuple(laws[i] for i in order)
    texture = None
    if needed:
        number = np.append(np.argsort(order), -1) + 1  # the last is of blocks of no class
        texture = _learned(flat, number[labels], len(laws), _sampled(flat, labels, SAMPLE))
    return Classes(sorted_laws, trends, centre, factor, none, texture, bands)


def _sampled(flat: Sequence[Flat], labels: NDArray[np.int64], pixels: int) -> list[Part]:
    """Tiles of so many pixels, of all looks, at most."""
    shape = flat[0].shape
    if shape[0] * shape[1] * len(flat) <= pixels:
        return tiles(shape)
    most = max(pixels // (SAMPLED_SIDE**2 * len(flat)), 4)
    return chosen_tiles(shape, SAMPLED_SIDE, most, labels)


def _learned(
    flat: Sequence[Flat], labels: NDArray[np.int64], count: int, chosen: Sequence[Part]
) -> Texture:
    """Learn textures of blocks' classes (from 1, 0 for none) from some tiles."""
    parts = []
    for part in chosen:
        wide, inner = around(part, MARGIN, flat[0].shape)
        rows, columns = (slice(s.start // BLOCK, -(-s.stop // BLOCK)) for s in part)
        marks = _marks_of(labels[rows, columns], [s.stop - s.start for s in part])
        if marks.any():
            parts += [(channels(one.logs(wide))[:, *inner], marks) for one in flat]
    return learn(parts, count, -(-DECIDING * len(flat) // len(parts)))


def _marks_of(blocks: NDArray[np.int64], shape: Sequence[int]) -> NDArray[np.int64]:
    """Classes of blocks on their pixels; 0 beyond the last whole block."""
    whole = np.repeat(np.repeat(blocks, BLOCK, axis=0), BLOCK, axis=1)
    whole = whole[: shape[0], : shape[1]]
    return np.pad(whole, [(0, n - m) for n, m in zip(shape, whole.shape, strict=True)])


def train_classes(
    looks: Sequence[AmplitudeGrid], marks: Any, count: int, workers: int | None = 1
) -> Classes:
    """Learn classes from pixels at which they are known.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
        On one lattice; slices are read.
    marks : array of uint8 (rows, columns)
        1 for the first class, 0 where none is known; slices are read.
    count : int
    workers : int, optional
        Threads.

    Returns
    -------
    Classes
        In the order of their numbers.

    Raises
    ------
    ValueError
        Where the looks show too few of a class's pixels; or no block at all.
    """
    blocks, centre = gather(looks, None, workers)
    trends = first_trends(blocks)
    labels = _marked_blocks(marks, blocks[0].mean.shape, count)
    index = np.nonzero(labels >= 0)
    if index[0].size:
        _, groups = np.unique(labels[index], return_inverse=True)
        trends = refit(blocks, groups, index, trends)
    factor = noise_factor(looks, blocks)
    flat = [Flat(look, trend, centre) for look, trend in zip(looks, trends, strict=True)]
    laws = []
    for k, (values, known) in enumerate(marked_values(flat, marks, count), 1):
        if known < LEAST_SAMPLES * factor:
            raise ValueError(
                f"class {k}: {known} known pixels are marked; expected at least "
                f"{int(np.ceil(LEAST_SAMPLES * factor))}"
            )
        laws.append(choose(values, samples=values.size / factor).law)
    none = _dark_law(flat, _dark(blocks, trends, laws), factor)
    texture = _trained_texture(flat, marks, laws) if count > 1 else None
    return Classes(tuple(laws), trends, centre, factor, none, texture)


def _trained_texture(flat: Sequence[Flat], marks: Any, laws: Sequence[Law]) -> Texture | None:
    """Laws at several scales, if they tell the marked pixels apart better than amplitude does."""
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
    """Boxes of marks in tiles, at random so many pixels of them and some of each class."""
    found, total, seen = [], 0, np.zeros(256, bool)
    every = tiles(shape)
    for i in np.random.default_rng(0).permutation(len(every)):
        part = every[i]
        here = np.asarray(marks[part])
        there = np.bincount(here.ravel(), minlength=256)[:256] > 0
        there[0] = False
        if not there.any() or (total > most and not (there & ~seen).any()):
            continue
        # no more of a tile than its marks
        ends = [np.flatnonzero(here.any(axis=axis))[[0, -1]] for axis in (1, 0)]
        rows, columns = (
            slice(s.start + int(e[0]), s.start + int(e[1]) + 1)
            for s, e in zip(part, ends, strict=True)
        )
        found.append((rows, columns))
        total += (rows.stop - rows.start) * (columns.stop - columns.start)
        seen |= there
    return found


def _marked_blocks(marks: Any, lattice: tuple[int, ...], count: int) -> NDArray[np.int64]:
    """Class (from 0) of each block that is marked alike, -1 of others."""
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


def carry_over(
    looks: Sequence[AmplitudeGrid],
    laws: Sequence[Law],
    centre: float,
    workers: int | None = 1,
) -> Classes:
    """Take another survey's classes: find each look's gain and range trend under them.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
        On one lattice; slices are read.
    laws : sequence of Law
    centre : float
        Log of the cotangent of the grazing angle at which they hold.
    workers : int, optional
        Threads.

    Returns
    -------
    Classes

    Raises
    ------
    ValueError
        Where no block of any look is known.
    """
    blocks, _ = gather(looks, centre, workers)
    means, spreads = np.array([_log_moments(law) for law in laws]).T
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
    factor = noise_factor(looks, blocks)
    flat = [Flat(look, trend, centre) for look, trend in zip(looks, best, strict=True)]
    none = _dark_law(flat, _dark(blocks, best, laws), factor)
    return Classes(tuple(laws), best, centre, factor, none)


def _log_moments(law: Law) -> tuple[float, float]:
    """Mean and log variance of a law's log amplitude."""
    t = np.log(law.mean_square) / 2 + np.linspace(-14, 5, 2000)
    weight = np.exp(law.log_density(np.exp(t)) + t)
    weight /= weight.sum()
    mean = float(weight @ t)
    return mean, float(np.log(weight @ (t - mean) ** 2))


def _assigned(
    blocks: list[Blocks], trends: FloatArray, means: FloatArray, spreads: FloatArray
) -> tuple[NDArray[np.int64], float]:
    """Class of each block, -1 where none is known, and the log likelihood of all."""
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


def _dark(blocks: list[Blocks], trends: FloatArray, laws: Sequence[Law] = ()) -> NDArray[np.bool_]:
    """Blocks too dark to be sediment, by their neighbourhood's; or by the laws of sediments."""
    level, weight = _levels(blocks, trends)
    seen = weight > 0
    limit = float(np.median(level[seen])) - DARK
    if laws:
        limit = min(limit, min(_log_moments(law)[0] for law in laws) - DARKER)
    return seen & (level < limit)


def _dark_law(flat: Sequence[Flat], dark: NDArray[np.bool_], factor: float) -> Law | None:
    if dark.sum() < LEAST_DARK:
        return None
    values = pixels_of(flat, dark)
    return choose(values, samples=values.size / factor).law


def _levels(blocks: list[Blocks], trends: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean log amplitude of blocks over all looks, and how many pixels tell it."""
    weight = np.sum([b.known for b in blocks], axis=0)
    level = np.sum(
        [b.known * (b.mean - trend_of(t, b.place)) for b, t in zip(blocks, trends, strict=True)],
        axis=0,
    )
    return level / np.maximum(weight, 1), weight


def _features(
    blocks: list[Blocks], trends: FloatArray, dark: NDArray[np.bool_]
) -> tuple[FloatArray, tuple[NDArray[np.int64], ...]]:
    """Mean and log variance of log amplitude of even blocks (n, 2), and where they are."""
    level, weight = _levels(blocks, trends)
    weight = np.where(dark, 0.0, weight)
    spread = np.sum([b.known * b.variance for b in blocks], axis=0)
    many = np.maximum(weight, 1)
    spread = np.log(np.maximum(spread / many, 1e-6))
    seen = (weight > 0).astype(float)
    around = uniform_filter(level * seen, 3, mode="nearest") / np.maximum(
        uniform_filter(seen, 3, mode="nearest"), 1e-9
    )
    error = np.sqrt(np.exp(spread) / many)
    known = (weight > 0) & (np.abs(level - around) < EVEN * np.sqrt(8 / 9) * 2 * error)
    if known.sum() < 0.3 * (weight > 0).sum():
        known = weight > 0
    index = np.nonzero(known)
    return np.column_stack([level[index], spread[index]]), index


def noise_factor(looks: Sequence[AmplitudeGrid], blocks: Sequence[Blocks] | None = None) -> float:
    """Pixels to one independent sample, by the middle of each look.

    Parameters
    ----------
    looks : sequence of AmplitudeGrid
    blocks : sequence of Blocks, optional
        Of the looks, if they are to be read in slices.

    Returns
    -------
    float
    """
    factors = []
    for k, look in enumerate(looks):
        known = np.isfinite(look.amplitude) if blocks is None else blocks[k].known > 0
        rows, columns = np.nonzero(known)
        if rows.size == 0:
            continue
        row, column = int(rows[rows.size // 2]), int(columns[rows.size // 2])
        if blocks is not None:
            row, column = row * BLOCK + BLOCK // 2, column * BLOCK + BLOCK // 2
        box = slice(max(row - 64, 0), row + 64), slice(max(column - 64, 0), column + 64)
        part = np.asarray(look.amplitude[box], float)
        # texture and edges are longer than speckle: only what is near counts
        factors.append(np.isfinite(part).sum() / max(effective_samples(_whitened(part)), 1.0))
    return float(max(np.median(factors), 1.0))


def _whitened(part: FloatArray) -> FloatArray:
    known = np.isfinite(part)
    filled = np.where(known, part, 0.0)
    share = np.maximum(uniform_filter(known.astype(float), 11), 1e-9)
    local = uniform_filter(filled**2, 11) / share
    return np.where(known, filled / np.sqrt(np.maximum(local, 1e-30)), np.nan)


def _laws(flat: Sequence[Flat], labels: NDArray[np.int64], factor: float) -> list[Law]:
    laws = []
    for k in range(int(labels.max()) + 1):
        values = pixels_of(flat, labels == k)
        if values.size:
            laws.append(choose(values, samples=values.size / factor).law)
    return laws


def _merged(
    flat: Sequence[Flat],
    labels: NDArray[np.int64],
    least: int,
    factor: float,
    apart: float,
) -> tuple[NDArray[np.int64], list[Law]]:
    """Unite classes whose laws differ by less than so much, the nearest first; `least` are left."""
    laws = _laws(flat, labels, factor)
    while len(laws) > least:
        each = range(len(laws))
        pairs = [(separation(laws[i], laws[j]), i, j) for i in each for j in range(i)]
        nearest, i, j = min(pairs)
        if nearest > apart:
            break
        labels = np.where(labels == i, j, labels)
        labels = np.where(labels > i, labels - 1, labels)
        laws = _laws(flat, labels, factor)
    return labels, laws


def _within(groups: NDArray[np.int64], classes: NDArray[np.int64]) -> bool:
    """Whether each group of blocks lies mostly within one class, and so cuts across none."""
    both = (groups >= 0) & (classes >= 0)
    table = np.zeros((int(groups.max()) + 1, int(classes.max()) + 1))
    np.add.at(table, (groups[both], classes[both]), 1)
    return bool((table.max(axis=1) >= WITHIN * table.sum(axis=1)).all())


def _too_alike(laws: Sequence[Law]) -> bool:
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
