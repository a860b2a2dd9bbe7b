"""Refined boundaries of a class map, and the map repainted to agree with them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from skimage.measure import find_contours

from sasmap.arrays import FloatArray, IntArray
from sasmap.numerics.threads import Workers, mapped
from sasmap.sediments.nodes import Boundary, normals, refine_boundary

Labels = NDArray[np.uint8]

# Pixels beside a contour at which its two classes are looked up, and the shortest line, in pixels.
BESIDE, SHORTEST = 1.0, 24.0
# Distance in pixels from a line within which the map is repainted.
PAINTED = 14.0
# Rows of a map that are traced at once, points around which it is read at once, nodes of a painted
# piece.
STRIPE, READ, PIECE = 1024, 512, 16


class Line(NamedTuple):
    """A boundary between two classes.

    Attributes
    ----------
    left, right : int
        Classes (numbers of the map) on either side along the direction of the points, rows down.
    boundary : Boundary
    """

    left: int
    right: int
    boundary: Boundary


class RefinedMap(NamedTuple):
    """A class map that agrees with its refined boundaries."""

    label: Labels
    lines: tuple[Line, ...]


class Ratio:
    """Log likelihood ratio of two classes, read slice by slice."""

    def __init__(self, first: Any, second: Any) -> None:
        self._first, self._second = first, second

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self._first.shape
        return rows, columns

    def __getitem__(self, part: Any) -> FloatArray:
        """Return nats of a part of the map."""
        return np.asarray(self._first[part] - self._second[part], float)


def refine_map(label: Labels, likelihood: Sequence[Any]) -> RefinedMap:
    """Trace the boundaries of a class map, refine them, and repaint the map to agree with them.

    Parameters
    ----------
    label : ndarray of uint8 (rows, columns)
        Of :func:`sasmap.sediments.classmap.class_map`.
    likelihood : sequence of array (rows, columns)
        One per class, of :func:`sasmap.sediments.classmap.log_likelihoods`; read in slices.

    Returns
    -------
    RefinedMap
        Without lines where there is only one class.
    """
    lines = refined(traced(label), likelihood)
    result = label.copy()
    paint(label, lines, result)
    return RefinedMap(result, tuple(lines))


def refined(
    found: Iterable[tuple[int, int, FloatArray, bool]],
    likelihood: Sequence[Any],
    workers: Workers = 1,
) -> list[Line]:
    """Refine traced lines.

    Parameters
    ----------
    found : iterable of (left, right, points, closed)
        Of :func:`traced`.
    likelihood : sequence of array (rows, columns)
        One per class; read in slices, from several threads.
    workers : int, None or callable
        Number of threads, or a callable that distributes work.

    Returns
    -------
    list of Line
        In the order of `found`.
    """

    def one(line: tuple[int, int, FloatArray, bool]) -> Line:
        left, right, points, closed = line
        ratio = Ratio(likelihood[left - 1], likelihood[right - 1])
        return Line(left, right, refine_boundary(points, ratio, closed=closed))

    return list(mapped(one, found, workers))


def traced(label: Any) -> Iterator[tuple[int, int, FloatArray, bool]]:
    """Trace each line where two classes meet once; lines end at junctions and at nodata.

    Parameters
    ----------
    label : array of uint8 (rows, columns)
        0 where there is none; read in stripes.

    Yields
    ------
    left, right : int
        Classes left and right of the line.
    points : ndarray (n, 2)
        Row and column.
    closed : bool
    """
    for k in _classes_of(label)[:-1]:
        for points in _outlines(label, k):
            closed = bool((points[0] == points[-1]).all())
            points = points[:-1] if closed else points
            if len(points) < 3:
                continue
            left, right = sides(label, points, closed)
            other = np.where(left == k, right, left)
            between = ((left == k) | (right == k)) & (other > k)
            for run, whole in _runs(np.where(between, other, 0), closed):
                line = points[run]
                if np.hypot(*np.diff(line, axis=0).T).sum() < SHORTEST:
                    continue
                middle = run[len(run) // 2]
                if left[middle] and right[middle]:
                    yield int(left[middle]), int(right[middle]), line, whole


def _stripes(label: Any) -> Iterator[slice]:
    for top in range(0, label.shape[0], STRIPE):
        yield slice(top, min(top + STRIPE, label.shape[0]))


def _classes_of(label: Any) -> list[int]:
    """Numbers of the classes on a map, in ascending order."""
    there = np.zeros(256, bool)
    for part in _stripes(label):
        there |= np.bincount(label[part].ravel(), minlength=256) > 0
    return [int(k) for k in np.flatnonzero(there) if k > 0]


def _outlines(label: Any, k: int) -> list[FloatArray]:
    """Trace a class's closed outlines, the map's edge included; stripes share a row of pixels."""
    rows = label.shape[0]
    pieces = []
    for top in range(-1, rows, STRIPE):
        bottom = min(top + STRIPE, rows)
        part = label[max(top, 0) : min(bottom + 1, rows)] == k
        held = np.flatnonzero(part.any(axis=0))
        if not held.size:
            continue
        part = part[:, held[0] : held[-1] + 1]
        part = np.pad(part, ((int(top < 0), int(bottom == rows)), (1, 1)))
        for contour in find_contours(part.astype(float), 0.5):
            pieces.append(contour + np.array([top, held[0] - 1]))
    return _joined(pieces)


def _joined(pieces: list[FloatArray]) -> list[FloatArray]:
    """Join pieces of outlines that end where another begins."""
    begins = {tuple(p[0]): i for i, p in enumerate(pieces)}
    used = np.zeros(len(pieces), bool)
    whole = []
    for i in range(len(pieces)):
        if used[i]:
            continue
        chain: list[FloatArray] = []
        at = i
        while not used[at]:
            used[at] = True
            chain.append(pieces[at][1:] if chain else pieces[at])
            at = begins.get(tuple(pieces[at][-1]), at)
        whole.append(np.concatenate(chain))
    return whole


def sides(label: Any, points: FloatArray, closed: bool) -> tuple[Labels, Labels]:
    """Classes left and right of each point of a line.

    Parameters
    ----------
    label : array of uint8 (rows, columns)
        Only the area around the points is read.
    points : ndarray (n, 2)
        Row and column.
    closed : bool

    Returns
    -------
    left, right : ndarray of uint8 (n,)
        0 beyond the map.
    """
    across = normals(points, closed) * BESIDE
    place = np.rint(np.stack([points - across, points + across])).astype(int)
    found = np.zeros((2, len(points)), np.uint8)
    for first in range(0, len(points), READ):
        part = slice(first, first + READ)
        found[:, part] = _looked_up(label, place[:, part])
    return found[0], found[1]


def _looked_up(label: Any, place: IntArray) -> Labels:
    """Classes at given pixels (..., 2); 0 beyond the map."""
    inside = ((place >= 0) & (place < label.shape)).all(axis=-1)
    result = np.zeros(inside.shape, np.uint8)
    if inside.any():
        low, high = place[inside].min(axis=0), place[inside].max(axis=0) + 1
        part = label[low[0] : high[0], low[1] : high[1]]
        row, column = (place[inside] - low).T
        result[inside] = part[row, column]
    return result


def _runs(values: NDArray[np.integer], closed: bool) -> Iterator[tuple[IntArray, bool]]:
    """Yield indices of runs of one value above 0, and whether a run is the whole closed line.

    Single points with a wrong value at a corner of the staircase do not split a run.
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


class _Stretch(NamedTuple):
    """Some nodes of a line, and the box of pixels that they may be nearest to."""

    line: int
    first: int
    last: int
    low: tuple[int, int]
    high: tuple[int, int]


def paint(label: Any, lines: Sequence[Line], result: Any, workers: Workers = 1) -> None:
    """Repaint a map to agree with refined lines: near a line, each side takes its class.

    Parameters
    ----------
    label : array of uint8 (rows, columns)
    lines : sequence of Line
    result : array of uint8 (rows, columns)
        Copy of `label`; changed where it held one of a line's own two classes.
    workers : int, None or callable
        Number of threads, or a callable that distributes work.
    """
    stretches = [s for k, line in enumerate(lines) for s in _stretches(k, line, label.shape)]
    across = [normals(line.boundary.points, line.boundary.closed) for line in lines]
    low = np.array([s.low for s in stretches]).reshape(-1, 2)
    high = np.array([s.high for s in stretches]).reshape(-1, 2)

    def one(corner: tuple[int, ...]) -> None:
        end = [min(c + STRIPE, n) for c, n in zip(corner, label.shape, strict=True)]
        mine = np.flatnonzero(((low < end) & (high > corner)).all(axis=1))
        if not mine.size:
            return
        part = slice(corner[0], end[0]), slice(corner[1], end[1])
        before, after = np.asarray(label[part]), np.array(result[part])
        for k in mine:
            line = stretches[k].line
            _paint_stretch(before, after, corner, lines[line], across[line], stretches[k])
        result[part] = after

    corners = product(*(range(0, n, STRIPE) for n in label.shape))
    deque(mapped(one, corners, workers), 0)


def _stretches(number: int, line: Line, shape: tuple[int, int]) -> Iterator[_Stretch]:
    nodes = line.boundary.points
    for first in range(0, len(nodes), PIECE):
        mine = nodes[first : first + PIECE]
        low = np.maximum(np.floor(mine.min(axis=0) - PAINTED).astype(int), 0)
        high = np.minimum(np.ceil(mine.max(axis=0) + PAINTED).astype(int) + 1, shape)
        if (high > low).all():
            last = min(first + PIECE, len(nodes))
            yield _Stretch(number, first, last, (low[0], low[1]), (high[0], high[1]))


def _paint_stretch(
    before: Labels,
    after: Labels,
    corner: tuple[int, ...],
    line: Line,
    across: FloatArray,
    stretch: _Stretch,
) -> None:
    """Paint the pixels of a block whose nearest node belongs to a stretch of a line."""
    nodes, closed = line.boundary.points, line.boundary.closed
    low = np.maximum(np.array(stretch.low) - corner, 0)
    high = np.minimum(np.array(stretch.high) - corner, before.shape)
    beside = (nodes > low + corner - PAINTED - 1) & (nodes < high + corner + PAINTED + 1)
    near = np.flatnonzero(beside.all(axis=1))
    side = sides_of(
        (low + corner).astype(float),
        (int(high[0] - low[0]), int(high[1] - low[1])),
        (nodes[near], across[near], near),
        # beyond its ends a line does not constrain the class
        (
            max(stretch.first, 0 if closed else 1),
            min(stretch.last, len(nodes) if closed else len(nodes) - 1),
        ),
        PAINTED,
    )
    part = slice(low[0], high[0]), slice(low[1], high[1])
    here = ((before[part] == line.left) | (before[part] == line.right)) & (side != 0)
    after[part][here] = np.where(side[here] < 0, line.left, line.right)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sides_of(corner, shape, line, piece, reach):  # type: ignore[no-untyped-def]
    """Side of a line (-1 left, 1 right) on which pixels lie; 0 where another piece is nearer.

    Parameters
    ----------
    corner : ndarray (2,)
        Row and column of the first pixel.
    shape : tuple of int
        Rows and columns.
    line : tuple of ndarray
        Nodes (n, 2), normals (n, 2) and numbers (n,) of nodes.
    piece : tuple of int
        First number, and the one after the last.
    reach : float
        Maximum distance to a node, pixels.
    """
    nodes, across, numbers = line
    rows, columns = shape
    side = np.zeros(shape, np.int8)
    best = np.full(shape, reach * reach)
    for i in range(len(nodes)):
        row, column = nodes[i, 0] - corner[0], nodes[i, 1] - corner[1]
        mine = piece[0] <= numbers[i] < piece[1]
        for r in range(max(int(row - reach), 0), min(int(row + reach) + 2, rows)):
            for c in range(max(int(column - reach), 0), min(int(column + reach) + 2, columns)):
                away = (r - row) ** 2 + (c - column) ** 2
                if away < best[r, c]:
                    best[r, c] = away
                    side[r, c] = 0
                    if mine:
                        offset = (r - row) * across[i, 0] + (c - column) * across[i, 1]
                        side[r, c] = -1 if offset < 0.0 else 1
    return side
