"""The sonar's track, and ground range, altitude and look azimuth of any map point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pyproj

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.errors import InputError
from sasmap.settings.survey import NavigationColumn
from sasmap.survey.lattice import transform_points
from sasmap.survey.lines import find_lines
from sasmap.survey.pings import ROUNDED, Pings, checked_pings, rounding_of
from sasmap.survey.tables import Table, read_table

WGS84 = "EPSG:4326"
COLUMNS = ("x", "y", "longitude", "latitude", "altitude")
# Largest extension of a track beyond its first and last ping, m (a choice: less than half a cell).
MAX_REACH = 5.0
# Length of a degree of latitude, m (a nautical mile of 1852 m is a minute).
METRES_A_DEGREE = 60 * 1852.0
# Port and starboard are determined by the course over this length to either side, m: longer than
# jitter of positions, shorter than turns.
COURSE_LENGTH = 3.0
# Smallest grazing angle (a range of 115 altitudes, beyond any sonar): farther tiles belong to
# another track.
MIN_GRAZING = np.radians(0.5)


class Geometry(NamedTuple):
    """Viewing geometry of map points; NaN where they were not seen. Arrays of the points' shape.

    Attributes
    ----------
    distance : ndarray
        Horizontal distance from the track, m.
    altitude : ndarray
        Height of the sonar above the mean sea floor, m.
    look_azimuth : ndarray
        Direction from the track to the point, degrees clockwise from grid north.
    starboard : ndarray of bool
        Side of the track.
    """

    distance: FloatArray
    altitude: FloatArray
    look_azimuth: FloatArray
    starboard: BoolArray


@dataclass(frozen=True, eq=False)
class Track:
    """A sonar track as a polyline in map coordinates, one vertex per ping.

    Attributes
    ----------
    x, y : ndarray (n,)
        Easting and northing, m, in track order; no two successive ones coincide.
    altitude : ndarray (n,)
        Height above the mean sea floor, m, linear between vertices.
    """

    x: FloatArray
    y: FloatArray
    altitude: FloatArray

    def locate(self, x: FloatArray, y: FloatArray, *, step: int = 1) -> Geometry:
        """Find the track's nearest point (broadside look) for map points.

        Parameters
        ----------
        x, y : ndarray
            Map coordinates, m, of the same shape; fast where neighbours in memory are neighbours on
            the map.
        step : int
            Step in rows and columns between points that are located exactly. Between four such
            points that are seen from one side, distance and altitude are interpolated linearly and
            the azimuth is that of the nearest. With 0.4 m between points and headings that scatter
            by 0.05 radian from ping to ping the distance error is at most 10 mm, or up to half a
            step where two parts of a turning track are equally near.

        Returns
        -------
        Geometry
            NaN where the nearest point is an end of the track: no ping was abeam of the point.
            The ends extend two ping spacings, at most 5 m, beyond the first and last ping.
        """
        shape = np.shape(x)
        if step > 1 and min(shape) > 1:
            return self._between(x, y, step)
        points = np.ascontiguousarray(x, float).ravel(), np.ascontiguousarray(y, float).ravel()
        out = np.empty((3, points[0].size))
        starboard = np.empty(points[0].size, np.bool_)
        _locate(*points, *self._extended, *self._course, self._tree, out, starboard)
        distance, altitude, azimuth = (row.reshape(shape) for row in out)
        return Geometry(distance, altitude, azimuth, starboard.reshape(shape))

    def _between(self, x: FloatArray, y: FloatArray, step: int) -> Geometry:
        """Locate some rows and columns, and points that cannot be interpolated between them."""
        rows, columns = (np.append(np.arange(0, n - 1, step), n - 1) for n in x.shape)
        some = np.ix_(rows, columns)
        out, starboard = np.empty((3, *x.shape)), np.empty(x.shape, np.bool_)
        rest = _interpolate(rows, columns, self.locate(x[some], y[some]), out, starboard)
        for target, values in zip((*out, starboard), self.locate(x[rest], y[rest]), strict=True):
            target[rest] = values
        return Geometry(out[0], out[1], out[2], starboard)

    @cached_property
    def _tree(self) -> tuple[IntArray, FloatArray]:
        x, y, _ = self._extended
        ends, deviation = _tree(x, y)
        return ends, deviation

    @cached_property
    def _extended(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        step = np.hypot(np.diff(self.x), np.diff(self.y))
        reach = min(2 * float(np.median(step)), MAX_REACH)
        first = reach / step[0]
        last = reach / step[-1]
        ends = []
        for v in (self.x, self.y):
            ends.append(
                np.concatenate(
                    [[v[0] - first * (v[1] - v[0])], v, [v[-1] + last * (v[-1] - v[-2])]]
                )
            )
        altitude = np.concatenate([self.altitude[:1], self.altitude, self.altitude[-1:]])
        return ends[0], ends[1], altitude

    @cached_property
    def _course(self) -> tuple[FloatArray, FloatArray]:
        """Direction of the extended track's segments, each over a few metres of track.

        Jitter can make single steps run backwards; they must not turn port into starboard.
        """
        n = self.x.size
        far = min(20, n - 1)
        net = np.hypot(self.x[far:] - self.x[:-far], self.y[far:] - self.y[:-far]) / far
        half = int(np.clip(np.ceil(COURSE_LENGTH / max(float(np.median(net)), 1e-9)), 1, n - 1))
        segment = np.clip(np.arange(-1, n), 0, n - 2)
        behind, ahead = np.maximum(segment - half + 1, 0), np.minimum(segment + half + 1, n)
        course = []
        for v in (self.x, self.y):
            total = np.concatenate([[0.0], np.cumsum(v - v[0])])
            before = (total[segment + 1] - total[behind]) / (segment + 1 - behind)
            after = (total[ahead] - total[segment + 1]) / (ahead - segment - 1)
            course.append(after - before)
        return course[0], course[1]


# Segments per leaf of the tree over a track (changes only the speed).
LEAF = 4


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _tree(tx, ty):  # type: ignore[no-untyped-def]
    """Build a tree by halving a track's segments.

    A binary heap of first and last vertices, and the largest distance of those between from the
    chord.
    """
    size = 1
    while size * LEAF < 2 * (tx.size - 1):
        size *= 2
    ends, deviation = np.zeros((2 * size, 2), np.int64), np.zeros(2 * size)
    ends[1, 1] = tx.size - 1
    for k in range(1, 2 * size):
        first, last = ends[k]
        if last <= first:
            continue
        for v in range(first + 1, last):
            square, _ = _square(tx[v], ty[v], tx[first], ty[first], tx[last], ty[last])
            deviation[k] = max(deviation[k], np.sqrt(square))
        if last - first > LEAF and 2 * k + 1 < 2 * size:
            middle = (first + last) // 2
            ends[2 * k, 0], ends[2 * k, 1] = first, middle
            ends[2 * k + 1, 0], ends[2 * k + 1, 1] = middle, last
    return ends, deviation + 1e-9


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _square(x, y, ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Squared distance of a point from a segment, and the position along it (0 to 1)."""
    dx, dy = bx - ax, by - ay
    length = dx * dx + dy * dy
    along = (x - ax) * dx + (y - ay) * dy
    t = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
    ex, ey = x - ax - t * dx, y - ay - t * dy
    return ex * ex + ey * ey, t


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _locate(px, py, tx, ty, altitude, cx, cy, tree, out, starboard):  # type: ignore[no-untyped-def]
    """Exact nearest point on a polyline; of equally near segments, the first."""
    ends, deviation = tree
    stack = np.empty(128, np.int64)
    last = 0
    for i in range(px.size):
        x, y = px[i], py[i]
        at = last  # the previous point's segment is near this point too
        best, along = _square(x, y, tx[at], ty[at], tx[at + 1], ty[at + 1])
        root = np.sqrt(best)
        stack[0], depth = 1, int(np.isfinite(best))
        while depth > 0:
            depth -= 1
            k = stack[depth]
            a, b = ends[k]
            away, _ = _square(x, y, tx[a], ty[a], tx[b], ty[b])
            if away > (root + deviation[k]) * (root + deviation[k]):
                continue
            if 2 * k + 1 < ends.shape[0] and ends[2 * k, 1] > ends[2 * k, 0]:
                stack[depth], stack[depth + 1] = 2 * k, 2 * k + 1
                depth += 2
                continue
            for s in range(a, b):
                d, t = _square(x, y, tx[s], ty[s], tx[s + 1], ty[s + 1])
                if d < best or (d == best and s < at):
                    best, at, along = d, s, t
                    root = np.sqrt(best)
        last = at
        _see(i, x, y, tx, ty, altitude, cx, cy, root, at, along, out, starboard)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _interpolate(rows, columns, seen, out, starboard):  # type: ignore[no-untyped-def]
    """Fill in the geometry between points seen from one side; returns the mask of the rest."""
    rest = np.zeros(starboard.shape, np.bool_)
    for i in range(rows.size - 1):
        end = rows[i + 1] + int(i == rows.size - 2)
        for j in range(columns.size - 1):
            stop = columns[j + 1] + int(j == columns.size - 2)
            sides = seen.starboard[i : i + 2, j : j + 2].sum()
            told = np.isfinite(seen.distance[i : i + 2, j : j + 2].sum()) and sides % 4 == 0
            rest[rows[i] : end, columns[j] : stop] = not told
            starboard[rows[i] : end, columns[j] : stop] = sides > 0
            for r in range(rows[i], end if told else rows[i]):
                down = (r - rows[i]) / (rows[i + 1] - rows[i])
                for c in range(columns[j], stop):
                    across = (c - columns[j]) / (columns[j + 1] - columns[j])
                    out[0, r, c] = _amid(seen.distance, i, j, down, across)
                    out[1, r, c] = _amid(seen.altitude, i, j, down, across)
                    out[2, r, c] = seen.look_azimuth[i + int(down > 0.5), j + int(across > 0.5)]
    return rest


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _amid(values, i, j, down, across):  # type: ignore[no-untyped-def]
    """Interpolate between four neighbours."""
    above = values[i, j] + across * (values[i, j + 1] - values[i, j])
    below = values[i + 1, j] + across * (values[i + 1, j + 1] - values[i + 1, j])
    return above + down * (below - above)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _see(i, x, y, tx, ty, altitude, cx, cy, best, at, along, out, starboard):  # type: ignore[no-untyped-def]
    """Fill in the geometry of a point seen from the track's nearest point."""
    if not np.isfinite(best) or (at == 0 and along <= 0.0) or (at == tx.size - 2 and along >= 1.0):
        out[0, i] = out[1, i] = out[2, i] = np.nan
        starboard[i] = False
        return
    dx, dy = tx[at + 1] - tx[at], ty[at + 1] - ty[at]
    ex, ey = x - tx[at] - along * dx, y - ty[at] - along * dy
    starboard[i] = cx[at] * ey - cy[at] * ex < 0.0
    if best < 1e-9:  # on the track itself: the beam's direction
        ex, ey = (dy, -dx) if starboard[i] else (-dy, dx)
    out[0, i] = best
    out[1, i] = altitude[at] + along * (altitude[at + 1] - altitude[at])
    out[2, i] = np.degrees(np.arctan2(ex, ey)) % 360.0


@dataclass(frozen=True, eq=False)
class Stretch:
    """A survey line of a navigation file.

    Attributes
    ----------
    track : Track
    rows : tuple of int
        First and last row in the file.
    """

    track: Track
    rows: tuple[int, int]

    @property
    def label(self) -> str:
        """The rows, for messages."""
        return f"rows {self.rows[0]} to {self.rows[1]}"


class Navigation(NamedTuple):
    """Contents of a navigation file: its survey lines, and warnings."""

    stretches: tuple[Stretch, ...]
    warnings: tuple[str, ...]


def read_navigation(
    path: Path,
    crs: str,
    tile_crs: str,
    navigation_crs: str | None,
    columns: Mapping[NavigationColumn, str] | None = None,
) -> Navigation:
    """Read a navigation CSV into tracks in map coordinates.

    Parameters
    ----------
    path : Path
        CSV with a header; columns altitude and either longitude, latitude or x, y; others are
        ignored. One row per ping, in track order.
    crs : str
        CRS of the resulting track.
    tile_crs : str
        CRS of x, y where `navigation_crs` is None.
    navigation_crs : str or None
        CRS of the file's positions.
    columns : mapping, optional
        The file's own column names.

    Returns
    -------
    Navigation

    Raises
    ------
    InputError
        Where the file, a column, or a number is missing or invalid; names the row.
    """
    given: dict[str, str] = {
        key: " ".join(name.lower().split()) for key, name in (columns or {}).items()
    }
    table = read_table(path, frozenset({given.get("altitude", "altitude")}))
    names, source = _position_columns(table, given, navigation_crs, tile_crs)
    values = [table.numbers(given.get(name, name)) for name in names]
    altitude = table.numbers(given.get("altitude", "altitude"), gaps=True)
    rows = np.array(table.rows)
    if names[0] == "longitude":
        _check_degrees(path, rows, *values)
    x, y = transform_points(pyproj.CRS.from_user_input(source).to_wkt(), crs, *values)
    lost = np.flatnonzero(~(np.isfinite(x) & np.isfinite(y)))
    if lost.size:
        raise InputError(
            f"{path}: row {rows[lost[0]]}: positions lie outside the domain of the survey's CRS"
        )
    pings, warnings = checked_pings(Pings(path, rows, x, y, altitude))
    warnings += _rounded(path, names, values, source)
    return _tracks(pings, warnings)


def _position_columns(
    table: Table, given: Mapping[str, str], navigation_crs: str | None, tile_crs: str
) -> tuple[tuple[str, str], str]:
    """Find the columns of positions, and their CRS."""
    path, header = table.path, {*table.header, *table.full}
    lacking = sorted(name for name in given.values() if name not in header)
    if lacking:
        raise InputError(
            f"{path}: no column {lacking[0]!r}, which `columns:` names; got {table.header}"
        )
    if given.get("altitude", "altitude") not in header:
        raise InputError(
            f"{path}: no column 'altitude': expected metres above the sea floor; got "
            f"{table.header[:9]}; if it has another name: columns: {{altitude: NAME}}"
        )
    wanted = pyproj.CRS.from_user_input(navigation_crs or WGS84)
    known = {name for name in COLUMNS if given.get(name, name) in header}
    geographic = {"longitude", "latitude"} <= known and not (
        wanted.is_projected and {"x", "y"} <= known
    )
    if geographic and not wanted.is_geographic:
        raise InputError(
            f"{path}: navigation_crs {wanted.name!r} needs columns x, y; got {table.header}"
        )
    names = ("longitude", "latitude") if geographic else ("x", "y")
    if not set(names) <= known:
        raise InputError(
            f"{path}: expected columns longitude, latitude or x, y; got {table.header[:9]}; if "
            "they have other names: columns: {x: NAME, y: NAME}"
        )
    return names, navigation_crs or (WGS84 if geographic else tile_crs)


def _rounded(
    path: Path, names: tuple[str, str], values: list[FloatArray], source: str
) -> list[str]:
    """Warn about positions that are rounded so coarsely that ranges are wrong."""
    crs = pyproj.CRS.from_user_input(source)
    unit = METRES_A_DEGREE if crs.is_geographic else crs.axis_info[0].unit_conversion_factor
    steps = [rounding_of(v) * unit for v in values]
    if max(steps) < ROUNDED:
        return []
    name = names[int(np.argmax(steps))]
    return [
        f"{path}: {name} is rounded to steps of {max(steps):.2g} m: ranges are wrong by half of "
        "that or more; export more digits"
    ]


def _check_degrees(path: Path, rows: IntArray, longitude: FloatArray, latitude: FloatArray) -> None:
    wrong = np.flatnonzero((np.abs(longitude) > 360) | (np.abs(latitude) > 90))
    if wrong.size:
        row = rows[wrong[0]]
        raise InputError(f"{path}: row {row}: expected longitude, latitude in degrees")


def _tracks(pings: Pings, warnings: list[str]) -> Navigation:
    """Split pings into survey lines, each a track."""
    moved = np.concatenate([[True], np.hypot(np.diff(pings.x), np.diff(pings.y)) > 1e-6])
    if moved.sum() < 2:
        raise InputError(f"{pings.path}: expected at least two pings at different positions")
    pings = pings.at(moved)
    lines, gaps = find_lines(pings)
    if not lines:
        raise InputError(f"{pings.path}: no two successive pings lie on a line")
    stretches = []
    for first, last in lines:
        line = pings.at(slice(first, last + 1))
        rows = int(line.rows[0]), int(line.rows[-1])
        stretches.append(Stretch(Track(line.x, line.y, line.altitude), rows))
    return Navigation(tuple(stretches), (*warnings, *gaps))
