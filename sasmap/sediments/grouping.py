"""Groups of blocks: of alike amplitudes, and of alike texture among those."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, uniform_filter

from sasmap.numerics.gaussians import expectation_maximisation, log_densities
from sasmap.numerics.threads import mapped
from sasmap.sediments.floor import Flat, Part, around, blocks_in
from sasmap.sediments.texture import LAGS, MARGIN, SCALES, channels
from sasmap.sediments.trends import BLOCK, MIN_KNOWN

FloatArray = NDArray[np.float64]
Labels = NDArray[np.int64]

MOST_CLASSES = 8
# Share of a class's blocks that have none of another class beside them, at least.
CORE = 0.12
# Blocks a side over which texture is described: 48 pixels.
AROUND = 3
# Blocks a side that must be free of other groups around one whose texture is its own: texture is
# described by 24 pixels to each side, of averages over 16.
CLEAR = 5
# Scatter that textures of one bed have beyond their sampling (log variances, mean amplitude).
SCATTER = 0.05
# Bhattacharyya distance (of Gaussians, nats) by which the textures of two beds must differ: 4
# standard deviations where their spread is the same.
APART = 2.0
# Blocks from which groups are found, at most.
FITTED = 2000
# Blocks that can tell two textures of one class, and share of them that the rarer has.
ENOUGH, RARE = 60, 0.04


def grouped(
    points: FloatArray, scatter: Sequence[float], least: int, most: int | None = None
) -> Labels:
    """Group points by the Gaussian mixture with the best information criterion (Schwarz).

    Parameters
    ----------
    points : ndarray (n, size)
    scatter : sequence of float (size,)
        Standard deviations that each group has at least.
    least : int
        Groups.
    most : int, optional
        Default as many as are tried.

    Returns
    -------
    ndarray of int (n,)
    """
    floor = np.array(scatter) ** 2
    every, size = points, points.shape[1]
    points = np.ascontiguousarray(every[:: max(len(every) // FITTED, 1)])
    free = 1 + size + size * (size + 1) // 2
    best, best_score = None, -np.inf
    for n in range(least, (most or max(MOST_CLASSES, least + 2)) + 1):
        if n * 8 > len(points) and n > least:
            break
        for first in (_seeded(points, n), _sliced(points, n)):
            mixture, _, level = expectation_maximisation(
                points, first, floor, 100, 1e-3 / len(points)
            )
            score = level * len(points) - 0.5 * (free * n - 1) * np.log(len(points))
            if score > best_score:
                best, best_score = mixture, score
    assert best is not None
    return np.asarray(np.argmax(log_densities(every, best), axis=1))


def pruned(labels: Labels, least: int, judged: NDArray[np.bool_] | None = None) -> Labels:
    """Leave out groups that lie between others alone: blocks that two sediments share.

    Parameters
    ----------
    labels : ndarray of int (block rows, block columns)
        -1 for none.
    least : int
        Groups that are left.
    judged : ndarray of bool (block rows, block columns), optional
        Blocks whose neighbours were all looked at. Default all.

    Returns
    -------
    ndarray of int (block rows, block columns)
    """
    there = np.unique(labels[labels >= 0])
    core = {}
    for k in there:
        mine = labels == k
        # neighbours that are uneven tell nothing
        inside = binary_erosion(mine | (labels < 0), np.ones((3, 3)), border_value=1) & mine
        known = mine if judged is None or not (mine & judged).any() else mine & judged
        core[k] = (inside & known).sum() / known.sum()
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


def _sliced(points: FloatArray, n: int) -> FloatArray:
    """First guess of groups: even slices along the direction of the greatest scatter."""
    z = (points - points.mean(axis=0)) / (points.std(axis=0) + 1e-9)
    along = z @ np.linalg.eigh(z.T @ z)[1][:, -1]
    rank = np.argsort(np.argsort(along, kind="stable"), kind="stable")
    return np.asarray(np.eye(n)[rank * n // len(points)])


def textured_groups(
    flat: Sequence[Flat],
    labels: Labels,
    dark: NDArray[np.bool_],
    count: int | None,
    chosen: Sequence[Part],
    workers: int | None = 1,
) -> tuple[Labels, bool]:
    """Group blocks by amplitude and texture.

    Parameters
    ----------
    flat : sequence of Flat
        Each look without its trend.
    labels : ndarray of int (block rows, block columns)
        Groups by amplitude; -1 for none.
    dark : ndarray of bool (block rows, block columns)
        Blocks of no sediment.
    count : int or None
        Groups; found where None.
    chosen : sequence of tuple of slice
        Tiles whose texture is described.
    workers : int or None
        Threads.

    Returns
    -------
    groups : ndarray of int (block rows, block columns)
        -1 for none.
    needed : bool
        Whether amplitude alone has put unlike textures together.
    """
    described = _described(flat, dark, chosen, workers)
    shown = _inner(chosen, dark.shape)
    described[~shown] = np.nan
    judged = binary_erosion(shown, np.ones((3, 3)), border_value=1)
    index = np.nonzero(np.isfinite(described[..., 0]))
    points = np.ascontiguousarray(described[index])
    groups = grouped(points, (SCATTER,) * points.shape[1], count or 1, count)
    result = np.full(labels.shape, -1)
    result[index] = _united(points, groups, count or 1, APART)
    result = pruned(result, count or 1, judged)
    points, groups = described[result >= 0], result[result >= 0]
    result[result >= 0] = _united(points, groups, count or 1, APART if count is None else np.inf)
    return result, any(
        _mixed(described, labels, dark, k, judged) for k in range(int(labels.max()) + 1)
    )


def _described(
    flat: Sequence[Flat],
    dark: NDArray[np.bool_],
    chosen: Sequence[Part],
    workers: int | None,
) -> FloatArray:
    """Texture of blocks and those around them (block rows, block columns, 9), NaN where unknown.

    Mean log amplitude, log variances of it at each scale but the coarsest, and log mean squares of
    differences; the mean over all looks.
    """
    total = np.zeros((*dark.shape, len(SCALES) + len(LAGS)))
    looks = np.zeros(dark.shape)
    near = binary_dilation(dark, np.ones((CLEAR, CLEAR)))
    for look in flat:
        sums = _texture_sums(look, dark.shape, chosen, workers) * ~dark[..., None]
        sums = np.stack([_around(s) for s in np.moveaxis(sums, -1, 0)])
        count, means = sums[0], sums[1:] / np.maximum(sums[0], 1)
        enough = (count >= MIN_KNOWN * BLOCK**2) & ~near
        split = len(SCALES) - 1
        levels, squares, apart = means[:split], means[split : 2 * split], means[2 * split :]
        parts = [
            levels[:1],
            np.log(np.maximum(squares - levels**2, 1e-6)),
            np.log(np.maximum(apart, 0) + 1e-6),
        ]
        described = np.moveaxis(np.concatenate(parts), 0, -1)
        total += np.where(enough[..., None], described, 0.0)
        looks += enough
    return np.where(looks[..., None] > 0, total / np.maximum(looks, 1)[..., None], np.nan)


def _texture_sums(
    look: Flat, shape: tuple[int, ...], chosen: Sequence[Part], workers: int | None
) -> NDArray[np.float32]:
    """Add up over blocks (block rows, block columns, 13), tile by tile; 0 in no tile.

    Of known pixels; of their log amplitude at each scale but the coarsest, and its squares; of the
    squares of differences.
    """
    split = len(SCALES) - 1
    result = np.zeros((*shape, 1 + 2 * split + len(LAGS)), np.float32)

    def add(part: Part) -> None:
        wide, inner = around(part, MARGIN, look.shape)
        found = channels(look.logs(wide))[:, *inner]
        known = np.isfinite(found[0]).astype(np.float32)
        found = np.nan_to_num(found)
        layers = [known, *found[:split], *(v**2 for v in (*found[:split], *found[split + 1 :]))]
        result[blocks_in(part)] = np.stack([_block_sums(v) for v in layers], axis=-1)

    for _ in mapped(add, chosen, workers):
        pass
    return result


def _block_sums(values: NDArray[np.floating]) -> FloatArray:
    rows, columns = (n // BLOCK for n in values.shape)
    parts = values[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    return np.asarray(parts.sum(axis=(1, 3), dtype=np.float64))


def _around(sums: FloatArray) -> FloatArray:
    """Mean of a block and those around it."""
    return np.asarray(uniform_filter(sums, AROUND, mode="constant"))


def _inner(chosen: Sequence[Part], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Blocks of some tiles, all neighbours of which are in tiles."""
    mask = np.zeros(shape, bool)
    for part in chosen:
        mask[blocks_in(part)] = True
    return np.asarray(binary_erosion(mask, np.ones((AROUND, AROUND)), border_value=1))


def _mixed(
    described: FloatArray,
    groups: Labels,
    dark: NDArray[np.bool_],
    k: int,
    judged: NDArray[np.bool_],
) -> bool:
    """Whether a group by amplitude holds two textures, each with a place of its own."""
    mine = groups == k
    # blocks of no group are uneven and tell nothing, but shadow and other groups are near
    foreign = dark | ((groups >= 0) & ~mine)
    inside = binary_erosion(~foreign, np.ones((CLEAR, CLEAR)), border_value=1) & mine
    inside &= np.isfinite(described[..., 0])
    if inside.sum() < ENOUGH:
        return False
    points = np.ascontiguousarray(described[inside][:, 1:])
    labels = np.full(mine.shape, -1)
    labels[inside] = _united(points, grouped(points, (SCATTER,) * points.shape[1], 1), 1, APART)
    labels = pruned(labels, 1, judged)
    shares = np.bincount(labels[labels >= 0]) / inside.sum()
    return bool((shares > RARE).sum() > 1)


def _united(points: FloatArray, groups: Labels, least: int, apart: float) -> Labels:
    """Unite groups that differ by less than so much, the nearest first; `least` are left."""
    _, groups = np.unique(groups, return_inverse=True)
    while groups.max() + 1 > least:
        each = range(int(groups.max()) + 1)
        normal = [_normal(points[groups == k]) for k in each]
        pairs = [(bhattacharyya(normal[i], normal[j]), i, j) for i in each for j in range(i)]
        if not pairs or min(pairs)[0] > apart:
            break
        _, i, j = min(pairs)
        _, groups = np.unique(np.where(groups == i, j, groups), return_inverse=True)
    return np.asarray(groups)


def _normal(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    size = points.shape[1]
    spread = np.cov(points.T) if len(points) > size else np.diag(points.var(axis=0))
    return points.mean(axis=0), spread + SCATTER**2 * np.eye(size)


def bhattacharyya(
    first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray]
) -> float:
    """Bhattacharyya distance of two Gaussians (mean, covariance), nats.

    Parameters
    ----------
    first, second : tuple of ndarray
        Mean (n,) and covariance (n, n).

    Returns
    -------
    float
    """
    middle = 0.5 * (first[1] + second[1])
    away = first[0] - second[0]
    volumes = [np.linalg.slogdet(m)[1] for m in (middle, first[1], second[1])]
    square = float(away @ np.linalg.solve(middle, away))
    return square / 8 + 0.5 * float(volumes[0] - 0.5 * (volumes[1] + volumes[2]))
