"""Boundaries as linked nodes that search along their normals (proposed in G section 4).

Each node may move along the normal of its neighbours; the stretch of image that it answers for, a
chevron between its neighbours' normals, tells by the sum of log p_L / p_R how likely each place is.
Neighbours are linked by a Gaussian prior on how far one moves beyond the other, whose width the
image decides (its evidence, by a forward pass). The best curve of all is found by dynamic
programming, the curve is laid anew through it, and so on until nothing moves; each node's standard
deviation is that of its marginal posterior (forward and backward).

Such a boundary is sharp, the image's is not: the point spread of the sonar, pixels, and windows of
texture mix both sediments. The side whose pixels tell more draws a sharp boundary away from it, by
up to a pixel. All nodes of a curve are moved to where the mean of log p_L / p_R is half-way between
that of both sides, in the sense of equal areas, whatever mixes them.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from scipy.special import logsumexp, ndtri

FloatArray = NDArray[np.float64]

# Pixels between nodes, how far they search, and steps of the search.
SPACING, REACH, STEP = 4.0, 14.0, 0.5
# Lines along the normal between a node's neighbours, and pixels between points on them.
LINES, ALONG = 4, 0.5
# Widths of the prior tried: pixels by which one node moves beyond the next (standard deviation).
WIDTHS = (0.25, 0.5, 1.0, 2.0)
# Factor of the last width: the image is seen from a curve fitted to it, and asks for too narrow a
# one (2 sd held 0.77 to 0.94 of the nodes at 1.5 to 2.4 dB, and hold 0.92 to 1.00; boundaries of
# pipelines/sediments/maps.py).
WIDER = 2.0
# Widths beyond which a neighbour counts for nothing, and the least prior of any leap.
FAR, TINY = 6.0, 1e-60
ROUNDS, STILL = 12, 0.3
# Nodes around which pixels are read at once.
READ = 128
# Reaches from its guess at which a curve has gone astray.
ASTRAY = 1.5
# Nodes over which the last reference curve is smoothed (standard deviation).
SMOOTH = 2.0
# Pixels within which both sediments mix, and to which they are seen alone; prior of the width of
# the mixture, mean and standard deviation, pixels (0.4 from reading between pixels alone, 0.8 in
# coherent scenes with a point spread of half a pixel).
MIXED, ALONE, WIDTH = 5.0, 10.0, (0.6, 0.4)


class Boundary(NamedTuple):
    """A refined boundary.

    Attributes
    ----------
    points : ndarray (n, 2)
        Row and column of each node; pixel centres are whole numbers.
    sd : ndarray (n,)
        Standard deviation of its position along its normal, pixels.
    closed : bool
    rounds : int
        Until nothing moved.
    """

    points: FloatArray
    sd: FloatArray
    closed: bool
    rounds: int


def refine_boundary(
    points: FloatArray,
    ratio: Any,
    *,
    closed: bool = False,
    spacing: float = SPACING,
    reach: float = REACH,
) -> Boundary:
    """Move a boundary to where it is most likely.

    Parameters
    ----------
    points : ndarray (n, 2)
        Row and column along a first guess, the left sediment to the left of the way (rows down).
    ratio : array (rows, columns)
        log p_L / p_R of each pixel; NaN counts for nothing. Of correlated speckle, over the number
        of pixels that one independent sample makes. Anything with a shape whose slices are arrays
        will do: only what lies near the line is read.
    closed : bool
        Whether the last point is followed by the first.
    spacing, reach : float
        Pixels between nodes, and how far they search either way.

    Returns
    -------
    Boundary
        Where nothing holds it, the guess itself, known to its reach alone.

    Raises
    ------
    ValueError
        Where there are fewer than two different points.
    """
    first = nodes = resampled(np.asarray(points, float), spacing, closed)
    places = np.arange(-reach, reach + 0.5 * STEP, STEP)
    rounds, moving = 0, True
    while moving and rounds < ROUNDS:
        rounds += 1
        score = _scores(nodes, ratio, places, closed)
        width = _best_width(score)
        # where nothing tells, nodes stay
        moves = _best_path(score - 1e-3 * (places / reach) ** 2, width, closed)
        shift = gaussian_filter1d(places[moves], 0.7, mode="wrap" if closed else "nearest")
        nodes = nodes + shift[:, None] * normals(nodes, closed)
        nodes = resampled(nodes, spacing, closed)
        if _astray(nodes, first, reach):
            return Boundary(first, np.full(len(first), reach / np.sqrt(3)), closed, rounds)
        moving = np.abs(places[moves]).max() > STILL + STEP / 2
    # a curve that has followed the speckle tells nothing about how far it may stray: from a
    # smooth one the image decides that anew
    smooth = resampled(_smoothed(nodes, closed), spacing, closed)
    score = _scores(smooth, ratio, places, closed)
    weight = _marginals(score, WIDER * _best_width(score))
    mean = weight @ places
    sd = np.sqrt(np.maximum(weight @ places**2 - mean**2, (STEP**2) / 12))
    nodes = smooth + mean[:, None] * normals(smooth, closed)
    offset, error = _offset(_scores(nodes, ratio, places, closed), places)
    return Boundary(nodes + offset * normals(nodes, closed), np.hypot(sd, error), closed, rounds)


def _offset(score: FloatArray, places: FloatArray) -> tuple[float, float]:
    """Offset of the true boundary along the normals, and its standard deviation, pixels.

    Parameters
    ----------
    score : ndarray (nodes, places)
        Sum of log p_L / p_R left of each place.
    places : ndarray (places,)
    """
    at = [int(np.abs(places - end).argmin()) for end in (-ALONE, -MIXED, MIXED, ALONE)]
    alone = ALONE - MIXED
    left = (score[:, at[1]] - score[:, at[0]]) / alone
    right = (score[:, at[3]] - score[:, at[2]]) / alone
    between = score[:, at[2]] - score[:, at[1]]
    step = float((left - right).sum())
    if not (left.sum() > 0 > right.sum()):
        return 0.0, WIDTH[0]
    # where the mixture's mean is zero, in widths: a sharp boundary comes to lie there
    sharp = float(ndtri(left.sum() / step))
    expected, sd = -WIDTH[0] * sharp, max(WIDTH[1] * abs(sharp), 1e-6)
    found = float((between - MIXED * (left + right)).sum()) / step
    rest = between - left * (MIXED + found) - right * (MIXED - found)
    error = float(np.sqrt((rest**2).sum())) / step
    known = sd**2 / (sd**2 + error**2)
    return expected + known * (found - expected), float(error * np.sqrt(known))


def _astray(nodes: FloatArray, first: FloatArray, reach: float) -> bool:
    """Whether a curve has left what its first guess could search: there was no such boundary."""
    return bool(cKDTree(first).query(nodes)[0].max() > ASTRAY * reach)


def _smoothed(nodes: FloatArray, closed: bool) -> FloatArray:
    """Smooth a curve; its ends, if it has any, stay."""
    if closed:
        return np.asarray(gaussian_filter1d(nodes, SMOOTH, axis=0, mode="wrap"))
    pad = min(int(3 * SMOOTH), len(nodes) - 1)
    before = 2 * nodes[0] - nodes[pad:0:-1]
    after = 2 * nodes[-1] - nodes[-2 : -pad - 2 : -1]
    wide = gaussian_filter1d(np.vstack([before, nodes, after]), SMOOTH, axis=0)
    return np.asarray(wide[pad : pad + len(nodes)])


def resampled(points: FloatArray, spacing: float, closed: bool) -> FloatArray:
    """Lay points at even distances along a line.

    Parameters
    ----------
    points : ndarray (n, 2)
    spacing : float
    closed : bool

    Returns
    -------
    ndarray (m, 2)

    Raises
    ------
    ValueError
        Where the line has no length.
    """
    line = np.vstack([points, points[:1]]) if closed else points
    length = np.hypot(*np.diff(line, axis=0).T)
    line = line[np.append(True, length > 0)]
    place = np.append(0.0, np.cumsum(length[length > 0]))
    if place.size < 2:
        raise ValueError("expected a boundary of at least two different points")
    count = max(round(place[-1] / spacing), 3 if closed else 1)
    at = np.linspace(0, place[-1], count + 1)[: count if closed else None]
    return np.asarray(np.stack([np.interp(at, place, line[:, i]) for i in range(2)], axis=1))


def normals(nodes: FloatArray, closed: bool) -> FloatArray:
    """Return unit vectors (row, column) from left to right of the way, by each node's neighbours.

    Parameters
    ----------
    nodes : ndarray (n, 2)
    closed : bool

    Returns
    -------
    ndarray (n, 2)
    """
    if closed:
        way = np.roll(nodes, -1, axis=0) - np.roll(nodes, 1, axis=0)
    else:
        way = np.gradient(nodes, axis=0)
    length = np.maximum(np.hypot(*way.T), 1e-12)
    # rows run down: right of a way (dr, dc) lies (dc, -dr)
    return np.asarray(np.stack([way[:, 1], -way[:, 0]], axis=1) / length[:, None])


def _scores(nodes: FloatArray, ratio: Any, places: FloatArray, closed: bool) -> FloatArray:
    """Log likelihood of each place of each node (nodes, places), up to a constant a node."""
    normal = normals(nodes, closed)
    reach = float(places[-1]) + 1.0
    ahead, behind = (_neighbours(nodes, step, closed) for step in (1, -1))
    # points on lines lie between the outermost of a node and its neighbours
    every = np.stack([nodes, ahead, behind])
    corners = every.min(axis=0) - reach, every.max(axis=0) + reach
    total = np.zeros((len(nodes), places.size))
    for first in range(0, len(nodes), READ):
        part = slice(first, first + READ)
        ends = corners[0][part].min(axis=0), corners[1][part].max(axis=0)
        box = [
            slice(max(int(low), 0), max(min(int(high) + 2, n), 1))
            for low, high, n in zip(*ends, ratio.shape, strict=True)
        ]
        box = [slice(min(s.start, s.stop - 1), s.stop) for s in box]
        values = np.nan_to_num(np.asarray(ratio[box[0], box[1]], float))
        corner = np.array([box[0].start, box[1].start], float)
        _add_scores(
            values, nodes - corner, normal, closed, places, (first, len(total[part])), total
        )
    area = _lengths(nodes, closed) * ALONG / LINES  # pixels that a point on a line stands for
    return np.asarray(total * area[:, None])


def _neighbours(values: FloatArray, step: int, closed: bool) -> FloatArray:
    """Each node's next (1) or previous (-1); at an open end itself."""
    other = np.roll(values, -step, axis=0)
    if not closed:
        end = -1 if step > 0 else 0
        other[end] = values[end]
    return other


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_scores(values, nodes, normal, closed, places, part, total):  # type: ignore[no-untyped-def]
    """Add up, along lines beside each node of a part, what lies left of each place."""
    rows, columns = values.shape
    count = len(nodes)
    for i in range(part[0], part[0] + part[1]):
        for line in range(LINES):
            way = (line + 0.5) / LINES - 0.5  # to the next node, or below 0 to the previous one
            other = i + 1 if way > 0.0 else i - 1
            if other < 0 or other >= count:
                other = other % count if closed else i
            way = abs(way)
            row = nodes[i, 0] + way * (nodes[other, 0] - nodes[i, 0])
            column = nodes[i, 1] + way * (nodes[other, 1] - nodes[i, 1])
            down = normal[i, 0] + way * (normal[other, 0] - normal[i, 0])
            across = normal[i, 1] + way * (normal[other, 1] - normal[i, 1])
            passed = 0.0
            for k in range(places.size):
                r = min(max(row + places[k] * down, 0.0), rows - 1.0)
                c = min(max(column + places[k] * across, 0.0), columns - 1.0)
                top, left = int(r), int(c)
                low, right = min(top + 1, rows - 1), min(left + 1, columns - 1)
                r -= top
                c -= left
                above = values[top, left] + c * (values[top, right] - values[top, left])
                below = values[low, left] + c * (values[low, right] - values[low, left])
                value = above + r * (below - above)
                # of the point itself half lies left
                total[i, k] += passed + 0.5 * value
                passed += value


def _lengths(nodes: FloatArray, closed: bool) -> FloatArray:
    """Length of the line that each node answers for."""
    if closed:
        ahead = np.hypot(*(np.roll(nodes, -1, axis=0) - nodes).T)
        return np.asarray(0.5 * (ahead + np.roll(ahead, 1)))
    step = np.hypot(*np.diff(nodes, axis=0).T)
    return np.asarray(0.5 * (np.append(step, step[-1]) + np.append(step[0], step)))


@cache
def _link(n: int, width: float) -> FloatArray:
    """Log prior of one node's place given its neighbour's (n, n).

    Normalised over all places, not those searched alone: ends of the search are no attraction.
    """
    place = STEP * np.arange(2 * n - 1) - STEP * (n - 1)
    norm = logsumexp(-0.5 * (place / width) ** 2)
    apart = STEP * (np.arange(n)[:, None] - np.arange(n))
    return np.asarray(-0.5 * (apart / width) ** 2 - norm)


@cache
def _near(n: int, width: float) -> FloatArray:
    """Prior of a neighbour so many places away, from 0 on, as far as it counts."""
    far = min(int(np.ceil(FAR * width / STEP)) + 1, n)
    return np.asarray(np.exp(_link(n, width)[0, :far]))


def _best_width(score: FloatArray) -> float:
    """Width of the prior under which the image is most likely."""
    mass = _masses(score)
    return max(WIDTHS, key=lambda width: _passed_on(mass, _near(score.shape[1], width))[1])


def _masses(score: FloatArray) -> FloatArray:
    """Likelihood of each place over that of the node's best."""
    return np.asarray(np.exp(score - score.max(axis=1, keepdims=True)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _passed_on(mass, near):  # type: ignore[no-untyped-def]
    """Share of all paths up to each node that lead to each place, and the log of their mass."""
    nodes, places = mass.shape
    result = np.empty_like(mass)
    level = np.log(mass[0].sum())
    result[0] = mass[0] / mass[0].sum()
    for i in range(1, nodes):
        total = 0.0
        for k in range(places):
            came = near[0] * result[i - 1, k]
            for j in range(1, near.size):
                if k >= j:
                    came += near[j] * result[i - 1, k - j]
                if k + j < places:
                    came += near[j] * result[i - 1, k + j]
            # no leap is impossible
            result[i, k] = mass[i, k] * (came + TINY)
            total += result[i, k]
        result[i] /= total
        level += np.log(total)
    return result, level


def _marginals(score: FloatArray, width: float) -> FloatArray:
    """Posterior of each node's place (nodes, places)."""
    mass = _masses(score)
    near = _near(score.shape[1], width)
    ahead, _ = _passed_on(mass, near)
    back, _ = _passed_on(mass[::-1].copy(), near)
    both = ahead * back[::-1] / np.maximum(mass, TINY)  # each holds the node's own
    return np.asarray(both / both.sum(axis=1, keepdims=True))


def _best_path(score: FloatArray, width: float, closed: bool) -> NDArray[np.int64]:
    """Places of highest joint posterior, by dynamic programming.

    A closed line is run around twice, so that its beginning knows its end; the middle is kept.
    """
    count = len(score)
    level = np.vstack([score, score, score]) if closed else score
    path = _followed(level, _link(score.shape[1], width))
    return np.asarray(path[count : 2 * count] if closed else path)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _followed(level, link):  # type: ignore[no-untyped-def]
    """Best path through the levels of places (nodes, places)."""
    nodes, places = level.shape
    best = level[0].copy()
    came = np.empty((nodes, places), np.int64)
    reached = np.empty(places)
    for i in range(1, nodes):
        for k in range(places):
            top, at = -np.inf, 0
            for j in range(places):
                value = best[j] + link[j, k]
                if value > top:
                    top, at = value, j
            reached[k], came[i, k] = top + level[i, k], at
        best[:] = reached
    path = np.empty(nodes, np.int64)
    path[-1] = np.argmax(best)
    for i in range(nodes - 1, 0, -1):
        path[i - 1] = came[i, path[i]]
    return path
