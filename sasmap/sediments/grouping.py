"""Groups of blocks with similar amplitudes, and among those with similar texture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_erosion

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.numerics.gaussians import expectation_maximisation, log_densities
from sasmap.sediments.description import CLEAR

Labels = IntArray

MOST_CLASSES = 8
# Minimum share of a class's blocks without another class beside them.
CORE = 0.12
# Side in blocks of the window over which rippled floor is judged: 112 pixels, one to five
# wavelengths.
WAVES = 7
# Side in blocks of the window at the core of a textured group: texture is described over 48 pixels,
# of averages and differences that reach farther, so that the rim between two beds is about four
# blocks wide. In scenes of many small beds, 7 loses some of them.
CORE_WIDTH = 5
# Scatter of texture within one bed beyond sampling noise (log variances, mean log amplitude).
SCATTER = 0.05
# Minimum Bhattacharyya distance (of Gaussians, nats) between the textures of two beds: 4 standard
# deviations where their spread is the same.
APART = 2.0
# Maximum number of blocks (about) from which groups are found; gain in total log likelihood at
# which a fit stops; number of further groups tried after the best number; maximum iterations. Both
# initial guesses are iterated fully: the better one after a dozen is not always the better at last.
FITTED, ENOUGH_GAIN, PATIENCE = 2000, 1e-2, 2
ROUNDS = 100
# Minimum number of blocks of a class to be tested for two textures, and minimum share of the rarer.
ENOUGH, RARE = 60, 0.04


def grouped(
    points: FloatArray, scatter: Sequence[float], least: int, most: int | None = None
) -> Labels:
    """Group points by the Gaussian mixture with the best information criterion (Schwarz).

    Parameters
    ----------
    points : ndarray (n, size)
    scatter : sequence of float (size,)
        Minimum standard deviations of each group.
    least : int
        Minimum number of groups.
    most : int, optional
        Maximum number of groups; default as many as are tried.

    Returns
    -------
    ndarray of int (n,)
        From 0, without gaps.
    """
    floor = np.array(scatter) ** 2
    every, size = points, points.shape[1]
    points = np.ascontiguousarray(every[:: max(len(every) // FITTED, 1)])
    free = 1 + size + size * (size + 1) // 2
    best, best_score, best_count = None, -np.inf, least
    for n in range(least, (most or max(MOST_CLASSES, least + 2)) + 1):
        if n > least and (n * 8 > len(points) or n > best_count + PATIENCE):
            break
        # for one group both initial guesses are the same
        for first in (_seeded(points, n), _sliced(points, n))[: min(n, 2)]:
            mixture, _, level = expectation_maximisation(
                points, first, floor, ROUNDS, ENOUGH_GAIN / len(points)
            )
            score = level * len(points) - 0.5 * (free * n - 1) * np.log(len(points))
            if score > best_score:
                best, best_score, best_count = mixture, score, n
    assert best is not None
    nearest = np.argmax(log_densities(every, best), axis=1)
    return np.asarray(np.unique(nearest, return_inverse=True)[1])  # a group may have no points


def pruned(
    labels: Labels,
    least: int,
    judged: BoolArray | None = None,
    across: int = 3,
    rippled: BoolArray | None = None,
) -> Labels:
    """Drop groups that lie only between others: blocks that contain two sediments.

    Parameters
    ----------
    labels : ndarray of int (block rows, block columns)
        -1 for none.
    least : int
        Minimum number of groups that remain.
    judged : ndarray of bool (block rows, block columns), optional
        Blocks whose neighbours were all examined. Default all.
    across : int
        Side in blocks of the window that must be of one group at a group's core; odd.
    rippled : ndarray of bool (block rows, block columns), optional
        Blocks that are judged with those around them (``WAVES``): the core of a group of mostly
        such blocks is wider, and the area beyond the survey does not count towards it.

    Returns
    -------
    ndarray of int (block rows, block columns)
    """
    there = np.unique(labels[labels >= 0])
    core = {}
    for k in there:
        mine = labels == k
        bed = rippled is not None and bool(rippled[mine].mean() > 0.5)
        width = WAVES if bed else across
        # uneven neighbours (-1) are no evidence of another group
        whole = mine | (labels < 0)
        inside = binary_erosion(whole, np.ones((width, width)), border_value=int(not bed))
        inside &= mine
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
    """Assign points to n groups as a first guess: to the nearest of spread-out seeds."""
    z = points / (points.std(axis=0) + 1e-9)
    seeds = [int(np.argmin(((z - np.median(z, axis=0)) ** 2).sum(axis=1)))]
    for _ in range(n - 1):  # the point farthest from all seeds, except for the last 2 %
        away = np.min([((z - z[s]) ** 2).sum(axis=1) for s in seeds], axis=0)
        seeds.append(int(np.argsort(away)[int(0.98 * (len(z) - 1))]))
    near = np.argmin([((z - z[s]) ** 2).sum(axis=1) for s in seeds], axis=0)
    return np.asarray(np.eye(n)[near])


def _sliced(points: FloatArray, n: int) -> FloatArray:
    """Assign points to groups as a first guess: equal slices along the greatest scatter."""
    z = (points - points.mean(axis=0)) / (points.std(axis=0) + 1e-9)
    along = z @ np.linalg.eigh(z.T @ z)[1][:, -1]
    rank = np.argsort(np.argsort(along, kind="stable"), kind="stable")
    return np.asarray(np.eye(n)[rank * n // len(points)])


def textured_groups(
    described: FloatArray,
    shown: BoolArray,
    labels: Labels,
    dark: BoolArray,
    count: int | None,
) -> tuple[Labels, bool]:
    """Group blocks by amplitude and texture.

    Parameters
    ----------
    described : ndarray (block rows, block columns, 9)
        Texture of blocks, NaN where unknown.
    shown : ndarray of bool (block rows, block columns)
        Blocks that could be described.
    labels : ndarray of int (block rows, block columns)
        Groups by amplitude; -1 for none.
    dark : ndarray of bool (block rows, block columns)
        Blocks that are not sediment.
    count : int or None
        Number of groups; found from the data where None.

    Returns
    -------
    groups : ndarray of int (block rows, block columns)
        -1 for none.
    needed : bool
        Whether amplitude alone has put different textures in one group.
    """
    judged = binary_erosion(shown, np.ones((CORE_WIDTH, CORE_WIDTH)), border_value=1)
    index = np.nonzero(np.isfinite(described[..., 0]))
    points = np.ascontiguousarray(described[index])
    result = np.full(labels.shape, -1)
    if len(points) <= points.shape[1]:
        return result, False
    groups = grouped(points, (SCATTER,) * points.shape[1], count or 1, count)
    result[index] = _united(points, groups, count or 1, APART)
    result = pruned(result, count or 1, judged, CORE_WIDTH)
    points, groups = described[result >= 0], result[result >= 0]
    result[result >= 0] = _united(points, groups, count or 1, APART if count is None else np.inf)
    return result, any(
        _mixed(described, labels, dark, k, judged) for k in range(int(labels.max()) + 1)
    )


def _mixed(
    described: FloatArray,
    groups: Labels,
    dark: BoolArray,
    k: int,
    judged: BoolArray,
) -> bool:
    """Whether a group by amplitude holds two textures, each with an area of its own."""
    mine = groups == k
    # blocks of no group are uneven and no evidence; shadow and other groups are foreign
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
    """Merge groups that are less than `apart` from each other, nearest first, down to `least`."""
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
