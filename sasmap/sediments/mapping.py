"""From a class map to boundaries that can be trusted, and back to a map that agrees with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from sasmap.sediments.nodes import Boundary, normals, refine_boundary

FloatArray = NDArray[np.float64]
Labels = NDArray[np.uint8]

# Pixels beside a contour at which its two classes are looked up, and the shortest line, in pixels.
BESIDE, SHORTEST = 1.0, 24.0
# Pixels around a line that its refinement reads, and within which the map is painted anew.
MARGIN = 40
PAINTED = 14.0


class Line(NamedTuple):
    """A boundary between two classes.

    Attributes
    ----------
    left, right : int
        Classes (numbers of the map) on either side of the way along the points, rows down.
    boundary : Boundary
    """

    left: int
    right: int
    boundary: Boundary


class RefinedMap(NamedTuple):
    """A class map that agrees with its refined boundaries."""

    label: Labels
    lines: tuple[Line, ...]


def refine_map(label: Labels, likelihood: Sequence[Any]) -> RefinedMap:
    """Trace the boundaries of a class map, refine each, and paint the map to agree with them.

    Parameters
    ----------
    label : ndarray of uint8 (rows, columns)
        Of :func:`sasmap.sediments.segmentation.class_map`.
    likelihood : sequence of array (rows, columns)
        One a class, of :func:`sasmap.sediments.segmentation.log_likelihoods`; only slices are read.

    Returns
    -------
    RefinedMap
        Without lines where there is one class.
    """
    lines = []
    for left, right, points, closed in traced(label):
        lines.append(Line(left, right, _refined(points, likelihood, left, right, closed)))
    return RefinedMap(painted(label, lines), tuple(lines))


def traced(label: Labels) -> Iterator[tuple[int, int, FloatArray, bool]]:
    """Trace the lines where two classes meet, each once; they end at junctions and at nodata.

    Parameters
    ----------
    label : ndarray of uint8 (rows, columns)
        0 where there is none.

    Yields
    ------
    left, right : int
        Classes left and right of the way.
    points : ndarray (n, 2)
        Row and column.
    closed : bool
    """
    for k in np.unique(label[label > 0])[:-1]:
        for contour in find_contours(np.pad((label == k).astype(float), 1), 0.5):
            points = contour - 1
            closed = bool((points[0] == points[-1]).all())
            points = points[:-1] if closed else points
            if len(points) < 3:
                continue
            sides = _sides(label, points, closed)
            other = np.where(sides[0] == k, sides[1], sides[0])
            between = ((sides[0] == k) | (sides[1] == k)) & (other > k)
            for run, whole in _runs(np.where(between, other, 0), closed):
                line = points[run]
                if np.hypot(*np.diff(line, axis=0).T).sum() < SHORTEST:
                    continue
                middle = run[len(run) // 2]
                left, right = int(sides[0][middle]), int(sides[1][middle])
                if left and right:
                    yield left, right, line, whole


def _sides(label: Labels, points: FloatArray, closed: bool) -> tuple[Labels, Labels]:
    """Classes left and right of each point of a way."""
    across = normals(points, closed) * BESIDE
    found = []
    for sign in (-1, 1):
        row, column = np.rint(points + sign * across).astype(int).T
        inside = (row >= 0) & (row < label.shape[0]) & (column >= 0) & (column < label.shape[1])
        values = np.zeros(len(points), label.dtype)
        values[inside] = label[row[inside], column[inside]]
        found.append(values)
    return found[0], found[1]


def _runs(values: NDArray[np.integer], closed: bool) -> Iterator[tuple[NDArray[np.int64], bool]]:
    """Yield indices of stretches of one value above 0, and whether one is the whole closed way.

    Single points that a corner of the staircase sends astray do not part a stretch.
    """
    values = values.copy()
    for shift in (1, 2):
        before, after = np.roll(values, shift), np.roll(values, -shift)
        values = np.where(before == after, before, values)
    n = values.size
    if closed and (values == values[0]).all():
        if values[0] > 0:
            yield np.arange(n), True
        return
    start = int(np.flatnonzero(values != np.roll(values, 1))[0]) if closed else 0
    order = (np.arange(n) + start) % n
    turned = values[order]
    ends = np.flatnonzero(np.append(np.diff(turned) != 0, True)) + 1
    first = 0
    for end in ends:
        if turned[first] > 0 and end - first > 2:
            yield order[first:end], False
        first = int(end)


def _refined(
    points: FloatArray, likelihood: Sequence[Any], left: int, right: int, closed: bool
) -> Boundary:
    low = np.maximum(np.floor(points.min(axis=0)).astype(int) - MARGIN, 0)
    high = np.ceil(points.max(axis=0)).astype(int) + MARGIN + 1
    part = (slice(low[0], high[0]), slice(low[1], high[1]))
    ratio = likelihood[left - 1][part] - likelihood[right - 1][part]
    found = refine_boundary(points - low, ratio.astype(float), closed=closed)
    return Boundary(found.points + low, found.sd, found.closed, found.rounds)


def painted(label: Labels, lines: list[Line]) -> Labels:
    """Paint a map to agree with refined lines: near one, each side is its class.

    Parameters
    ----------
    label : ndarray of uint8 (rows, columns)
    lines : list of Line

    Returns
    -------
    ndarray of uint8 (rows, columns)
        Changed only where one of a line's own two classes was.
    """
    result = label.copy()
    for line in lines:
        nodes = line.boundary.points
        low = np.maximum(np.floor(nodes.min(axis=0) - PAINTED).astype(int), 0)
        high = np.minimum(np.ceil(nodes.max(axis=0) + PAINTED).astype(int) + 1, label.shape)
        row, column = np.mgrid[low[0] : high[0], low[1] : high[1]]
        place = np.column_stack([row.ravel(), column.ravel()]).astype(float)
        away, nearest = cKDTree(nodes).query(place, distance_upper_bound=PAINTED)
        mine = np.isin(label[row, column].ravel(), [line.left, line.right]) & np.isfinite(away)
        if not line.boundary.closed:  # beyond its ends a line says nothing
            mine &= (nearest > 0) & (nearest < len(nodes) - 1)
        across = normals(nodes, line.boundary.closed)
        nearest = np.minimum(nearest, len(nodes) - 1)
        side = ((place - nodes[nearest]) * across[nearest]).sum(axis=1)
        value = np.where(side < 0, line.left, line.right)
        result[row.ravel()[mine], column.ravel()[mine]] = value[mine]
    return result
