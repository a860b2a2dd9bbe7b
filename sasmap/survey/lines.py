"""The survey lines of a navigation file, split at turns and gaps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sasmap.arrays import FloatArray
from sasmap.survey.pings import Pings

# The course is computed over this length to either side, m, and at least this many pings: jitter of
# decimetres then changes it by a few degrees.
COURSE_LENGTH, COURSE_PINGS = 3.0, 5
# Step, in ping spacings, above which it is a jump; where the course before and after it agrees
# within this angle, degrees, it is a gap in the line, not its end (choices).
JUMP, STRAIGHT_ON = 20.0, 30.0
# Degrees (choices). A file whose course spans less than TURN is one line; otherwise pieces that
# span at most SPAN are lines where they are straight: their median rate of turn times their length
# is under BENT (for an arc it is SPAN). Ends are cut where the course differs from its median by
# TRIMMED.
TURN, SPAN, BENT, TRIMMED = 90.0, 60.0, 20.0, 15.0
# Minimum number of pings of a line.
FEWEST = 2
# Maximum number of points along a track at which its course is computed: bounds the time.
PLACES = 5000


class Span(NamedTuple):
    """Pings [first, last] of a survey line, by their index."""

    first: int
    last: int


def find_lines(pings: Pings) -> tuple[list[Span], list[str]]:
    """Find the survey lines of a file.

    Parameters
    ----------
    pings : Pings
        No two successive ones at the same position.

    Returns
    -------
    lines : list of Span
        In the file's order. A track that turns throughout (a circle) is one line.
    warnings : list of str
        Gaps within lines.
    """
    warnings: list[str] = []
    found: list[Span] = []
    for part in _parts(pings, warnings):
        found += _straight(pings, part)
    return found, warnings


def _parts(pings: Pings, warnings: list[str]) -> Iterator[Span]:
    """Split a file where a ping is far from the previous one, and not straight ahead."""
    dx, dy = np.diff(pings.x), np.diff(pings.y)
    step = np.hypot(dx, dy)
    first = 0
    for k in np.flatnonzero(step > JUMP * np.median(step)):
        if _goes_on(pings, int(k), first):
            warnings.append(
                f"{pings.path}: no ping between rows {pings.rows[k]} and {pings.rows[k + 1]}, over "
                f"{step[k]:.1f} m: the track is taken as straight there"
            )
        else:
            if k - first + 1 >= FEWEST:
                yield Span(first, int(k))
            first = int(k) + 1
    if pings.x.size - first >= FEWEST:
        yield Span(first, pings.x.size - 1)


def _goes_on(pings: Pings, k: int, first: int) -> bool:
    """Whether the step from ping k runs along the course before and after it."""
    before, after = max(k - COURSE_PINGS, first), min(k + 1 + COURSE_PINGS, pings.x.size - 1)
    ends = [(before, k), (k, k + 1), (k + 1, after)]
    course = [np.arctan2(pings.x[b] - pings.x[a], pings.y[b] - pings.y[a]) for a, b in ends]
    turn = [abs((d + np.pi) % (2 * np.pi) - np.pi) for d in np.diff(course)]
    return bool(before < k and k + 1 < after and np.degrees(max(turn)) < STRAIGHT_ON)


def _straight(pings: Pings, part: Span) -> list[Span]:
    """Split a stretch without jumps at its turns."""
    pick = slice(part.first, part.last + 1)
    x, y = pings.x[pick], pings.y[pick]
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    place = np.linspace(0.0, length[-1], min(PLACES, 4 * x.size))
    course = _course(x, y, length, place)
    if np.ptp(course) <= TURN:
        return [part]
    lines = []
    for a, b in _pieces(course):
        cut = _cut(course, place, a, b)
        if cut is None:
            continue
        low, high = np.searchsorted(length, [place[cut[0]] - 1e-9, place[cut[1]] + 1e-9])
        if high - low >= FEWEST:
            lines.append(Span(part.first + int(low), part.first + int(high) - 1))
    return lines or [part]


def _course(x: FloatArray, y: FloatArray, length: FloatArray, place: FloatArray) -> FloatArray:
    """Course at points along a track, degrees without jumps of 360."""
    reach = max(COURSE_LENGTH, COURSE_PINGS * float(np.median(np.diff(length))))
    reach = min(reach, length[-1] / 4)
    ahead, behind = place + reach, place - reach
    dx = np.interp(ahead, length, x) - np.interp(behind, length, x)
    dy = np.interp(ahead, length, y) - np.interp(behind, length, y)
    return np.asarray(np.degrees(np.unwrap(np.arctan2(dx, dy))), float)


def _pieces(course: FloatArray) -> Iterator[tuple[int, int]]:
    """Split points so that the course spans no more than SPAN within each piece."""
    first, low, high = 0, course[0], course[0]
    for k in range(1, course.size):
        low, high = min(low, course[k]), max(high, course[k])
        if high - low > SPAN:
            yield first, k - 1
            first, low, high = k, course[k], course[k]
    yield first, course.size - 1


def _cut(course: FloatArray, place: FloatArray, a: int, b: int) -> tuple[int, int] | None:
    """Cut off a piece's curved ends; None where it is an arc."""
    if b - a < COURSE_PINGS:
        return None
    turn = np.abs(np.gradient(course[a : b + 1], place[a : b + 1]))
    if float(np.median(turn)) * (place[b] - place[a]) > BENT:
        return None
    near = np.abs(course[a : b + 1] - np.median(course[a : b + 1])) <= TRIMMED
    inside = np.flatnonzero(near)
    return a + int(inside[0]), a + int(inside[-1])
