"""Boundaries as linked nodes that search along their normals (proposed in G section 4).

Each node may move along the normal defined by its neighbours. The likelihood of each position is
the sum of log p_L / p_R over the node's part of the image, a chevron between its neighbours'
normals. Neighbours are linked by a Gaussian prior on the difference of their moves, whose width is
chosen by its evidence (a forward pass). The best joint curve is found by dynamic programming, the
nodes are resampled along it, and this repeats until nothing moves; each node's standard deviation
is that of its marginal posterior (forward-backward).

Such a boundary is sharp, but the one in the image is not: the sonar's point spread, pixels and
texture windows mix both sediments. A sharp boundary is biased away from the side with the more
informative pixels, by up to a pixel. All nodes of a curve are therefore moved to where the mean of
log p_L / p_R is half-way between its values on both sides, in the sense of equal areas, whatever
the cause of the mixing.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from scipy.special import logsumexp, ndtri

from sasmap.arrays import FloatArray, IntArray

# Pixels between nodes, distance that they search either way, and step of the search.
SPACING, REACH, STEP = 4.0, 14.0, 0.5
# Lines along the normal between a node's neighbours, and pixels between points on them.
LINES, ALONG = 4, 0.5
# Widths of the prior that are tried: standard deviation, in pixels, of the difference of moves of
# neighbouring nodes.
WIDTHS = (0.25, 0.5, 1.0, 2.0)
# Factor of the last width: since the curve has been fitted to the image, the evidence favours too
# narrow a prior (2 sd contained 0.77 to 0.94 of the nodes at 1.5 to 2.4 dB without the factor, and
# contain 0.92 to 1.00 with it; boundaries of pipelines/sediments/maps.py).
WIDER = 2.0
# Distance in widths beyond which the prior is cut off, and the minimum prior of any jump.
FAR, TINY = 6.0, 1e-60
ROUNDS, STILL = 12, 0.3
# Nodes around which pixels are read at once.
READ = 128
# Distance from the first guess, in units of the reach, at which a curve has gone astray.
ASTRAY = 1.5
# Nodes over which the last reference curve is smoothed (standard deviation).
SMOOTH = 2.0
# Distance in pixels within which both sediments mix, and that to which each is unmixed beyond it;
# prior of the mixing width, mean and standard deviation, pixels (0.4 from interpolation between
# pixels alone, 0.8 in coherent scenes with a point spread of half a pixel).
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
        Number of iterations until nothing moved.
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
    """Move a boundary to its most likely position.

    Parameters
    ----------
    points : ndarray (n, 2)
        Row and column along a first guess, with the left sediment on its left (rows down).
    ratio : array (rows, columns)
        log p_L / p_R of each pixel; NaN is ignored. For correlated speckle, divided by the number
        of pixels per independent sample. May be any object with a shape whose slices are arrays:
        only the area near the line is read.
    closed : bool
        Whether the last point is followed by the first.
    spacing, reach : float
        Pixels between nodes, and how far they search either way.

    Returns
    -------
    Boundary
        Where the image does not constrain it, the first guess, with the reach as its uncertainty.

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
        # where the image is uninformative, nodes stay
        moves = _best_path(score - 1e-3 * (places / reach) ** 2, width, closed)
        shift = gaussian_filter1d(places[moves], 0.7, mode="wrap" if closed else "nearest")
        nodes = nodes + shift[:, None] * normals(nodes, closed)
        nodes = resampled(nodes, spacing, closed)
        if _astray(nodes, first, reach):
            return Boundary(first, np.full(len(first), reach / np.sqrt(3)), closed, rounds)
        moving = np.abs(places[moves]).max() > STILL + STEP / 2
    # a curve that has followed the speckle underestimates its own uncertainty: evaluate the
    # posterior again about a smoothed one
    smooth = resampled(_smoothed(nodes, closed), spacing, closed)
    score = _scores(smooth, ratio, places, closed)
    weight = _marginals(score, WIDER * _best_width(score))
    mean = weight @ places
    sd = np.sqrt(np.maximum(weight @ places**2 - mean**2, (STEP**2) / 12))
    nodes = smooth + mean[:, None] * normals(smooth, closed)
    offset, error = _offset(_scores(nodes, ratio, places, closed), places)
    return Boundary(nodes + offset * normals(nodes, closed), np.hypot(sd, error), closed, rounds)


def _offset(score: FloatArray, places: FloatArray) -> tuple[float, float]:
    """Estimate the offset of the true boundary along the normals and its sd, pixels.

    Parameters
    ----------
    score : ndarray (nodes, places)
        Sum of log p_L / p_R to the left of each place.
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
    # position, in widths, at which the mixture's mean is zero: a sharp boundary settles there
    sharp = float(ndtri(left.sum() / step))
    expected, sd = -WIDTH[0] * sharp, max(WIDTH[1] * abs(sharp), 1e-6)
    found = float((between - MIXED * (left + right)).sum()) / step
    rest = between - left * (MIXED + found) - right * (MIXED - found)
    error = float(np.sqrt((rest**2).sum())) / step
    known = sd**2 / (sd**2 + error**2)
    return expected + known * (found - expected), float(error * np.sqrt(known))


def _astray(nodes: FloatArray, first: FloatArray, reach: float) -> bool:
    """Whether a curve has left the search area of its first guess: there is no such boundary."""
    return bool(cKDTree(first).query(nodes)[0].max() > ASTRAY * reach)


def _smoothed(nodes: FloatArray, closed: bool) -> FloatArray:
    """Smooth a curve; the ends of an open one stay fixed."""
    if closed:
        return np.asarray(gaussian_filter1d(nodes, SMOOTH, axis=0, mode="wrap"))
    pad = min(int(3 * SMOOTH), len(nodes) - 1)
    before = 2 * nodes[0] - nodes[pad:0:-1]
    after = 2 * nodes[-1] - nodes[-2 : -pad - 2 : -1]
    wide = gaussian_filter1d(np.vstack([before, nodes, after]), SMOOTH, axis=0)
    return np.asarray(wide[pad : pad + len(nodes)])


def resampled(points: FloatArray, spacing: float, closed: bool) -> FloatArray:
    """Place points at equal distances along a line.

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
    """Return unit vectors (row, column) from left to right of the line, by each node's neighbours.

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
    # rows run down: to the right of a direction (dr, dc) lies (dc, -dr)
    return np.asarray(np.stack([way[:, 1], -way[:, 0]], axis=1) / length[:, None])


def _scores(nodes: FloatArray, ratio: Any, places: FloatArray, closed: bool) -> FloatArray:
    """Log likelihood of each place of each node (nodes, places), up to a constant per node."""
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
    area = _lengths(nodes, closed) * ALONG / LINES  # area in pixels per point on a line
    return np.asarray(total * area[:, None])


def _neighbours(values: FloatArray, step: int, closed: bool) -> FloatArray:
    """Each node's next (1) or previous (-1) node; at an open end the node itself."""
    other = np.roll(values, -step, axis=0)
    if not closed:
        end = -1 if step > 0 else 0
        other[end] = values[end]
    return other


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_scores(values, nodes, normal, closed, places, part, total):  # type: ignore[no-untyped-def]
    """Sum the values to the left of each place, along lines beside each node of a part."""
    rows, columns = values.shape
    count = len(nodes)
    for i in range(part[0], part[0] + part[1]):
        for line in range(LINES):
            way = (line + 0.5) / LINES - 0.5  # towards the next node, or if negative the previous
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
                # half of the point itself lies to the left
                total[i, k] += passed + 0.5 * value
                passed += value


def _lengths(nodes: FloatArray, closed: bool) -> FloatArray:
    """Length of the line that belongs to each node."""
    if closed:
        ahead = np.hypot(*(np.roll(nodes, -1, axis=0) - nodes).T)
        return np.asarray(0.5 * (ahead + np.roll(ahead, 1)))
    step = np.hypot(*np.diff(nodes, axis=0).T)
    return np.asarray(0.5 * (np.append(step, step[-1]) + np.append(step[0], step)))


@cache
def _link(n: int, width: float) -> FloatArray:
    """Log prior of one node's place given its neighbour's (n, n).

    Normalised over all places, not only those searched, so that the ends do not attract nodes.
    """
    place = STEP * np.arange(2 * n - 1) - STEP * (n - 1)
    norm = logsumexp(-0.5 * (place / width) ** 2)
    apart = STEP * (np.arange(n)[:, None] - np.arange(n))
    return np.asarray(-0.5 * (apart / width) ** 2 - norm)


@cache
def _near(n: int, width: float) -> FloatArray:
    """Prior by the distance to a neighbour's place, from 0 up to the cut-off."""
    far = min(int(np.ceil(FAR * width / STEP)) + 1, n)
    return np.asarray(np.exp(_link(n, width)[0, :far]))


def _best_width(score: FloatArray) -> float:
    """Width of the prior with the highest evidence."""
    mass = _masses(score)
    return max(WIDTHS, key=lambda width: _passed_on(mass, _near(score.shape[1], width))[1])


def _masses(score: FloatArray) -> FloatArray:
    """Likelihood of each place relative to the node's best."""
    return np.asarray(np.exp(score - score.max(axis=1, keepdims=True)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _passed_on(mass, near):  # type: ignore[no-untyped-def]
    """Forward pass: posterior of each place given the nodes so far, and the log evidence."""
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
            # no jump has probability zero
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
    both = ahead * back[::-1] / np.maximum(mass, TINY)  # each contains the node's own likelihood
    return np.asarray(both / both.sum(axis=1, keepdims=True))


def _best_path(score: FloatArray, width: float, closed: bool) -> IntArray:
    """Places of highest joint posterior, by dynamic programming.

    A closed line is repeated three times, so that its ends are linked; the middle copy is kept.
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
