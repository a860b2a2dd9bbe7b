"""Sediment classes and their map: how many there are, their laws, and where each lies.

Blocks of pixels are described by mean and variance of their log amplitude, less the gain and range
trend of the pass, and grouped by a Gaussian mixture; groups whose laws differ by too little a pixel
are one sediment. Each class is then an amplitude law of its own
(:func:`sasmap.sediments.fitting.choose`), and pixels are classified by the sum of log likelihoods
over all looks, smoothed by a Potts field that does not smear edges (mean field).

A trend over range and a boundary that runs along the track look alike to a single look; looks from
two sides, or ranges, tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, distance_transform_edt, uniform_filter
from scipy.ndimage import label as measure_label

from sasmap.gaussians import expectation_maximisation
from sasmap.sediments.fitting import Law, choose, effective_samples

FloatArray = NDArray[np.float64]

BLOCK = 16
# Of a block's pixels, how many must be known.
MIN_KNOWN = 0.6
MOST_CLASSES = 8
# Blocks differ from their neighbours' mean by less than so many standard deviations where they hold
# one sediment.
EVEN = 3.0
# Mean log likelihood ratio a pixel (nats) by which laws must differ to be two sediments.
APART = 0.02
# Blocks apart, at most, of pairs that tell the range trend.
LAGS = 4
# How far slope and bend within classes may be from what those say (standard deviation).
SLOPE_SD = (0.12, 0.3)
# Share of a class's blocks that have none of another class beside them, at least.
CORE = 0.12
SAMPLES = 60_000
GRID = 1024
# Potts field: pixels of its window, and its strength in nats where all neighbours agree.
FIELD, STRENGTH, ROUNDS = 9, 9.0, 12
FIRST_WINDOW = 13
# Pixels of the smallest patch that the map shows.
SMALLEST = 300


class Look(NamedTuple):
    """What one look shows, on the map's lattice.

    Attributes
    ----------
    amplitude : ndarray (rows, columns)
        NaN where there is none, or no sediment (shadow, water column).
    ground_range : ndarray (rows, columns)
        m.
    """

    amplitude: FloatArray
    ground_range: FloatArray


@dataclass(frozen=True)
class Classes:
    """Sediment classes of a survey.

    Attributes
    ----------
    laws : tuple of Law
        By rising mean intensity, so that numbers are stable.
    trends : ndarray (looks, 3)
        Log gain of each look, and its slope and bend with log range about `centre`.
    centre : float
        Log of a ground range, m.
    noise_factor : float
        Pixels that one independent sample makes.
    """

    laws: tuple[Law, ...]
    trends: FloatArray
    centre: float
    noise_factor: float

    def log_trend(self, look: int, ground_range: FloatArray) -> FloatArray:
        """Log of the amplitude that a look's gain and range trend make."""
        t = np.log(np.maximum(ground_range, 1e-3)) - self.centre
        return _trend(self.trends[look], t)


class _Blocks(NamedTuple):
    """Statistics of blocks of one look (block rows, block columns)."""

    mean: FloatArray
    variance: FloatArray
    known: FloatArray
    place: FloatArray


def find_classes(looks: Sequence[Look], count: int | None = None) -> Classes:
    """Find the classes of a survey.

    Parameters
    ----------
    looks : sequence of Look
        On one lattice.
    count : int, optional
        How many; found where not given.

    Returns
    -------
    Classes

    Raises
    ------
    ValueError
        Where no block of any look is known.
    """
    centre = float(np.nanmean([np.nanmean(np.log(look.ground_range)) for look in looks]))
    blocks = [_block_statistics(look, centre) for look in looks]
    if not any((b.known > 0).any() for b in blocks):
        raise ValueError("expected a block of known amplitudes")
    first = trends = _first_trends(blocks)
    for _ in range(3):
        features, index = _features(blocks, trends)
        groups = _grouped(features, count or 1)
        trends = _refit(blocks, groups, index, first)
    factor = _noise_factor(looks)
    labels = np.full(blocks[0].mean.shape, -1)
    labels[index] = groups
    laws = _merged(looks, _pruned(labels, count or 1), count, (trends, centre, factor))
    order = np.argsort([law.mean_square for law in laws], kind="stable")
    return Classes(tuple(laws[i] for i in order), trends, centre, factor)


def _block_statistics(look: Look, centre: float) -> _Blocks:
    amplitude = look.amplitude
    rows, columns = (n // BLOCK * BLOCK for n in amplitude.shape)
    shape = (rows // BLOCK, BLOCK, columns // BLOCK, BLOCK)
    known = np.isfinite(amplitude) & (amplitude > 0)
    logs = np.log(np.where(known, amplitude, 1.0))[:rows, :columns].reshape(shape)
    place = np.log(np.maximum(np.nan_to_num(look.ground_range, nan=1.0), 1e-3)) - centre
    there = known[:rows, :columns].reshape(shape)
    count = there.sum(axis=(1, 3)).astype(float)
    total = np.maximum(count, 1)
    mean = (logs * there).sum(axis=(1, 3)) / total
    square = ((logs - mean[:, None, :, None]) ** 2 * there).sum(axis=(1, 3))
    at = (place[:rows, :columns].reshape(shape) * there).sum(axis=(1, 3)) / total
    enough = count >= MIN_KNOWN * BLOCK**2
    return _Blocks(mean, square / total, np.where(enough, count, 0.0), at)


def _first_trends(blocks: list[_Blocks]) -> FloatArray:
    """Slope and bend of each look by its neighbouring blocks, gain by the blocks that two show."""
    trends = np.zeros((len(blocks), 3))
    for k, block in enumerate(blocks):
        trends[k, 1:] = _slope(block)
        level = block.mean - _trend(trends[k], block.place)
        for j in range(k):
            both = (block.known > 0) & (blocks[j].known > 0)
            if both.any():
                other = blocks[j].mean - _trend(trends[j], blocks[j].place)
                trends[k, 0] = np.median(level[both] - other[both])
                break
    return trends


def _slope(block: _Blocks) -> FloatArray:
    """Slope and bend of log amplitude with log range, by differences of near blocks.

    Of most such pairs both blocks hold the same sediment; those that do not are told by their
    residuals and count for little (Cauchy weights).
    """
    change, step, bend = [], [], []
    for axis in (0, 1):
        for lag in range(1, LAGS + 1):
            first = [np.moveaxis(v, axis, 0)[lag:] for v in block]
            second = [np.moveaxis(v, axis, 0)[:-lag] for v in block]
            both = (first[2] > 0) & (second[2] > 0)
            change.append((first[0] - second[0])[both])
            step.append((first[3] - second[3])[both])
            bend.append((first[3] ** 2 - second[3] ** 2)[both])
    y = np.concatenate(change)
    design = np.column_stack([np.concatenate(step), np.concatenate(bend)])
    if y.size < 20:
        return np.zeros(2)
    found: FloatArray = np.zeros(2)
    weight: FloatArray = np.ones(y.size)
    for _ in range(30):
        heavy = design * weight[:, None]
        # what nothing tells stays at 0
        found = np.asarray(
            np.linalg.solve(heavy.T @ design + np.diag([1e-4, 1e-3]), heavy.T @ y), np.float64
        )
        rest = y - design @ found
        scale = 1.5 * np.median(np.abs(rest)) + 1e-9
        weight = np.asarray(1 / (1 + (rest / scale) ** 2), np.float64)
    return np.asarray(found)


def _features(
    blocks: list[_Blocks], trends: FloatArray
) -> tuple[FloatArray, tuple[NDArray[np.int64], ...]]:
    """Mean and log variance of log amplitude of even blocks (n, 2), and where they are."""
    weight = np.sum([b.known for b in blocks], axis=0)
    level = np.sum(
        [b.known * (b.mean - _trend(t, b.place)) for b, t in zip(blocks, trends, strict=True)],
        axis=0,
    )
    spread = np.sum([b.known * b.variance for b in blocks], axis=0)
    many = np.maximum(weight, 1)
    level, spread = level / many, np.log(np.maximum(spread / many, 1e-6))
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


def _trend(trend: FloatArray, place: FloatArray) -> FloatArray:
    return np.asarray(trend[0] + trend[1] * place + trend[2] * place * place)


def _grouped(points: FloatArray, least: int) -> NDArray[np.int64]:
    """Group points by the Gaussian mixture with the best information criterion."""
    floor = np.array([0.02, 0.06]) ** 2
    best, best_score = np.zeros(len(points), np.int64), -np.inf
    for n in range(least, max(MOST_CLASSES, least + 2) + 1):
        if n * 8 > len(points) and n > least:
            break
        first, enough = _seeded(points, n), 1e-3 / len(points)
        _, share, level = expectation_maximisation(points, first, floor, 100, enough)
        score = level * len(points) - 0.5 * (6 * n - 1) * np.log(len(points))
        if score > best_score:
            best, best_score = np.argmax(share, axis=1), score
    return best


def _pruned(labels: NDArray[np.int64], least: int) -> NDArray[np.int64]:
    """Leave out groups that lie between others alone: blocks that two sediments share."""
    there = np.unique(labels[labels >= 0])
    core = {}
    for k in there:
        mine = labels == k
        # neighbours that are uneven tell nothing
        inside = binary_erosion(mine | (labels < 0), np.ones((3, 3)), border_value=1) & mine
        core[k] = inside.sum() / mine.sum()
    order = sorted(there, key=lambda k: core[k])
    lost = [k for k in order if core[k] < CORE][: max(len(there) - least, 0)]
    kept = [k for k in there if k not in lost]
    result = np.full(labels.shape, -1)
    for number, k in enumerate(kept):
        result[labels == k] = number
    return result


def _seeded(points: FloatArray, n: int) -> FloatArray:
    """First guess of which of n groups each point belongs to: the nearest of spread-out seeds."""
    z = points / (points.std(axis=0) + 1e-9)
    seeds = [int(np.argmin(((z - np.median(z, axis=0)) ** 2).sum(axis=1)))]
    for _ in range(n - 1):  # the point that is farthest from all, but for the last few per cent
        away = np.min([((z - z[s]) ** 2).sum(axis=1) for s in seeds], axis=0)
        seeds.append(int(np.argsort(away)[int(0.98 * (len(z) - 1))]))
    near = np.argmin([((z - z[s]) ** 2).sum(axis=1) for s in seeds], axis=0)
    return np.asarray(np.eye(n)[near])


def _refit(
    blocks: list[_Blocks],
    groups: NDArray[np.int64],
    index: tuple[NDArray[np.int64], ...],
    first: FloatArray,
) -> FloatArray:
    """Fit gain, slope and bend of each look to what its blocks have beyond their classes.

    Not far from the first slopes, which no class can have bent.
    """
    count, size = int(groups.max()) + 1, 3 * len(blocks)
    design, wanted, weight = [], [], []
    for k, block in enumerate(blocks):
        there = block.known[index] > 0
        place = block.place[index][there]
        columns = np.zeros((place.size, size + count))
        columns[:, 3 * k : 3 * k + 3] = np.column_stack([np.ones(place.size), place, place**2])
        columns[np.arange(place.size), size + groups[there]] = 1
        design.append(columns)
        wanted.append(block.mean[index][there])
        error = np.sqrt(block.variance[index][there] / block.known[index][there])
        weight.append(1 / np.hypot(error, 0.03))
    stiff = np.zeros((size, size + count))
    sd = np.tile([10.0, *SLOPE_SD], len(blocks))
    sd[0] = 1e-6  # the first look's gain is the survey's
    stiff[:, :size] = np.diag(1 / sd)
    w = np.concatenate(weight)
    matrix = np.vstack([np.vstack(design) * w[:, None], stiff])
    right = np.concatenate([np.concatenate(wanted) * w, first.ravel() / sd])
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return np.asarray(found[:size].reshape(-1, 3))


def _noise_factor(looks: Sequence[Look]) -> float:
    """Pixels to one independent sample, by the middle of each look."""
    factors = []
    for look in looks:
        known = np.isfinite(look.amplitude)
        row, column = (int(np.median(v)) for v in np.nonzero(known))
        part = look.amplitude[max(row - 64, 0) : row + 64, max(column - 64, 0) : column + 64]
        # texture and edges are longer than speckle: only what is near counts
        factors.append(np.isfinite(part).sum() / max(effective_samples(_whitened(part)), 1.0))
    return float(max(np.median(factors), 1.0))


def _whitened(part: FloatArray) -> FloatArray:
    known = np.isfinite(part)
    filled = np.where(known, part, 0.0)
    share = np.maximum(uniform_filter(known.astype(float), 11), 1e-9)
    local = uniform_filter(filled**2, 11) / share
    return np.where(known, filled / np.sqrt(np.maximum(local, 1e-30)), np.nan)


def _flattened(look: Look, trend: FloatArray, centre: float) -> FloatArray:
    place = np.log(np.maximum(look.ground_range, 1e-3)) - centre
    return np.asarray(look.amplitude * np.exp(-_trend(trend, place)))


def _pixels(
    looks: Sequence[Look], labels: NDArray[np.int64], k: int, trends: FloatArray, centre: float
) -> FloatArray:
    """Amplitudes of a class's blocks, flattened; evenly thinned."""
    mask = np.repeat(np.repeat(labels == k, BLOCK, axis=0), BLOCK, axis=1)
    rows, columns = mask.shape
    found = []
    for look, trend in zip(looks, trends, strict=True):
        values = _flattened(look, trend, centre)[:rows, :columns][mask]
        found.append(values[np.isfinite(values) & (values > 0)])
    values = np.concatenate(found)
    return values[:: max(values.size // SAMPLES, 1)]


def _laws(
    looks: Sequence[Look],
    labels: NDArray[np.int64],
    trends: FloatArray,
    centre: float,
    factor: float,
) -> list[Law]:
    laws = []
    for k in range(int(labels.max()) + 1):
        values = _pixels(looks, labels, k, trends, centre)
        if values.size:
            laws.append(choose(values, samples=values.size / factor).law)
    return laws


def _merged(
    looks: Sequence[Look],
    labels: NDArray[np.int64],
    count: int | None,
    how: tuple[FloatArray, float, float],
) -> list[Law]:
    """Unite classes whose laws tell too little apart, or the nearest until `count` are left."""
    laws = _laws(looks, labels, *how)
    while len(laws) > (count or 1):
        each = range(len(laws))
        pairs = [(separation(laws[i], laws[j]), i, j) for i in each for j in range(i)]
        least, i, j = min(pairs)
        if count is None and least > APART:
            break
        labels = np.where(labels == i, j, labels)
        labels = np.where(labels > i, labels - 1, labels)
        laws = _laws(looks, labels, *how)
    return laws


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


def log_likelihoods(looks: Sequence[Look], classes: Classes) -> NDArray[np.float32]:
    """Log likelihood of each class at each pixel, all looks together.

    Parameters
    ----------
    looks : sequence of Look
    classes : Classes

    Returns
    -------
    ndarray (classes, rows, columns)
        Of independent samples (over the noise factor); NaN where no look shows a pixel.
    """
    shape = looks[0].amplitude.shape
    result = np.zeros((len(classes.laws), *shape), np.float32)
    seen = np.zeros(shape, bool)
    top = max(law.mean_square for law in classes.laws) ** 0.5
    grid = np.linspace(np.log(1e-5 * top), np.log(50 * top), GRID)
    tables = [law.log_density(np.exp(grid)) for law in classes.laws]
    for i, look in enumerate(looks):
        known = np.isfinite(look.amplitude) & (look.amplitude > 0)
        logs = np.log(look.amplitude[known]) - classes.log_trend(i, look.ground_range[known])
        for k, values in enumerate(tables):
            result[k][known] += (np.interp(logs, grid, values) / classes.noise_factor).astype("f4")
        seen |= known
    result[:, ~seen] = np.nan
    return result


class ClassMap(NamedTuple):
    """A sediment map.

    Attributes
    ----------
    label : ndarray of uint8 (rows, columns)
        1 for the first class; 0 where no look shows the floor.
    probability : ndarray (rows, columns)
        Of the class; NaN where there is none.
    """

    label: NDArray[np.uint8]
    probability: NDArray[np.float32]


def class_map(likelihood: NDArray[np.float32]) -> ClassMap:
    """Classify pixels.

    Parameters
    ----------
    likelihood : ndarray (classes, rows, columns)
        Of :func:`log_likelihoods`.

    Returns
    -------
    ClassMap
    """
    seen = np.isfinite(likelihood[0])
    level = np.nan_to_num(likelihood - np.nan_to_num(likelihood).max(axis=0))
    if len(level) == 1:
        one = np.where(seen, 1.0, np.nan).astype(np.float32)
        return ClassMap(seen.astype(np.uint8), one)
    share = _softmax(np.stack([uniform_filter(v, FIRST_WINDOW) for v in level]) * FIRST_WINDOW**2)
    for _ in range(ROUNDS):
        field = np.stack([uniform_filter(np.where(seen, s, 0), FIELD) for s in share])
        share = _softmax(level + STRENGTH * field / np.maximum(field.sum(axis=0), 1e-6))
    label = _sieved(np.where(seen, np.argmax(share, axis=0) + 1, 0).astype(np.uint8))
    return ClassMap(label, np.where(seen, share.max(axis=0), np.nan).astype(np.float32))


def _sieved(label: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Give specks of a class, of too few pixels to tell it, to the class that is nearest."""
    small = np.zeros(label.shape, bool)
    for k in np.unique(label[label > 0]):
        parts, _ = measure_label(label == k)
        size = np.bincount(parts.ravel())
        small |= (size < SMALLEST)[parts] & (parts > 0)
    if not small.any() or (small | (label == 0)).all():
        return label
    nearest = distance_transform_edt(
        small | (label == 0), return_distances=False, return_indices=True
    )
    return np.where(small, label[tuple(nearest)], label).astype(np.uint8)


def _softmax(level: NDArray[np.floating]) -> NDArray[np.float32]:
    rest = np.exp(level - level.max(axis=0))
    return np.asarray(rest / rest.sum(axis=0), np.float32)
