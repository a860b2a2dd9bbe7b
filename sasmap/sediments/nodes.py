"""Boundaries as linked nodes that search along their normals (proposed in G section 4).

Each node may move along the normal of its neighbours; the stretch of image that it answers for, a
chevron between its neighbours' normals, tells by the sum of log p_L / p_R how likely each place is.
Neighbours are linked by a Gaussian prior on how far one moves beyond the other, whose width the
image decides (its evidence, by a forward pass). The best curve of all is found by dynamic
programming, the curve is laid anew through it, and so on until nothing moves; each node's standard
deviation is that of its marginal posterior (forward and backward).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.spatial import cKDTree
from scipy.special import logsumexp

FloatArray = NDArray[np.float64]

# Pixels between nodes, how far they search, and steps of the search.
SPACING, REACH, STEP = 4.0, 14.0, 0.5
# Lines along the normal between a node's neighbours, and pixels between points on them.
LINES, ALONG = 4, 0.5
# Widths of the prior tried: pixels by which one node moves beyond the next (standard deviation).
WIDTHS = (0.25, 0.5, 1.0, 2.0)
ROUNDS, STILL = 12, 0.3
# Nodes around which pixels are read at once.
READ = 128
# Reaches from its guess at which a curve has gone astray.
ASTRAY = 1.5
# Nodes over which the last reference curve is smoothed (standard deviation).
SMOOTH = 2.0


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
    weight = _marginals(score, _best_width(score))
    mean = weight @ places
    sd = np.sqrt(np.maximum(weight @ places**2 - mean**2, (STEP**2) / 12))
    return Boundary(smooth + mean[:, None] * normals(smooth, closed), sd, closed, rounds)


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
    total = np.zeros((len(nodes), places.size))
    fine = np.arange(places[0], places[-1] + 0.25 * ALONG, ALONG)
    for line in (np.arange(LINES) + 0.5) / LINES - 0.5:  # of the way to the neighbours
        origin = _between(nodes, line, closed)
        across = _between(normal, line, closed)
        at = origin[:, None] + fine[None, :, None] * across[:, None]
        values = np.concatenate(
            [_sampled(ratio, at[k : k + READ]) for k in range(0, len(nodes), READ)]
        )
        ends = np.concatenate([np.zeros((len(nodes), 1)), np.cumsum(values, axis=1)], axis=1)
        # to each place, what lies left of it
        passed = 0.5 * (ends[:, :-1] + ends[:, 1:])
        total += np.stack([np.interp(places, fine, row) for row in passed])
    area = _lengths(nodes, closed) * ALONG / LINES  # pixels that a point on a line stands for
    return np.asarray(total * area[:, None])


def _sampled(ratio: Any, at: FloatArray) -> FloatArray:
    """Values at places (..., 2), linear between pixels; beyond the edges those at the edges."""
    rows, columns = ratio.shape
    at = np.clip(at, 0, (rows - 1, columns - 1))
    low = np.floor(at.min(axis=(0, 1))).astype(int)
    high = np.ceil(at.max(axis=(0, 1))).astype(int) + 1
    part = np.nan_to_num(np.asarray(ratio[low[0] : high[0], low[1] : high[1]], float))
    where = np.moveaxis(at - low, -1, 0)
    return np.asarray(map_coordinates(part, where, order=1, mode="nearest"))


def _between(values: FloatArray, share: float, closed: bool) -> FloatArray:
    """Values a share of the way to the next (or, below 0, the previous) node."""
    step = -1 if share > 0 else 1
    other = np.roll(values, step, axis=0)
    if not closed:
        other[-1 if share > 0 else 0] = values[-1 if share > 0 else 0]
    return np.asarray(values + abs(share) * (other - values))


def _lengths(nodes: FloatArray, closed: bool) -> FloatArray:
    """Length of the line that each node answers for."""
    if closed:
        ahead = np.hypot(*(np.roll(nodes, -1, axis=0) - nodes).T)
        return np.asarray(0.5 * (ahead + np.roll(ahead, 1)))
    step = np.hypot(*np.diff(nodes, axis=0).T)
    return np.asarray(0.5 * (np.append(step, step[-1]) + np.append(step[0], step)))


def _link(n: int, width: float) -> FloatArray:
    """Log prior of one node's place given its neighbour's (n, n).

    Normalised over all places, not those searched alone: ends of the search are no attraction.
    """
    place = STEP * np.arange(2 * n - 1) - STEP * (n - 1)
    norm = logsumexp(-0.5 * (place / width) ** 2)
    apart = STEP * (np.arange(n)[:, None] - np.arange(n))
    return np.asarray(-0.5 * (apart / width) ** 2 - norm)


def _best_width(score: FloatArray) -> float:
    """Width of the prior under which the image is most likely."""
    return max(WIDTHS, key=lambda width: float(logsumexp(_forward(score, width)[-1])))


def _forward(score: FloatArray, width: float) -> FloatArray:
    first = score[0] - np.log(score.shape[1])
    return np.asarray(_passed_on(score, first, np.exp(_link(score.shape[1], width))))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _passed_on(score, first, link):  # type: ignore[no-untyped-def]
    """Add up, node by node, the log of all paths that lead to each place."""
    result = np.empty_like(score)
    result[0] = first
    for i in range(1, len(score)):
        top = result[i - 1].max()
        mass = np.exp(result[i - 1] - top) @ link
        result[i] = score[i] + top + np.log(mass + 1e-300)
    return result


def _marginals(score: FloatArray, width: float) -> FloatArray:
    """Posterior of each node's place (nodes, places)."""
    link = np.exp(_link(score.shape[1], width))
    back = _passed_on(score[::-1].copy(), score[-1], link)[::-1]
    both = _forward(score, width) + back - score  # each holds the node's own
    return np.asarray(np.exp(both - logsumexp(both, axis=1, keepdims=True)))


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
