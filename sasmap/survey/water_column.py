"""Check of altitude and kind of range against the water column on the tiles.

A pixel nearer than the altitude shows water in slant range, and sea floor in ground range. The
first echo lies at a slant range of one altitude, whatever the altitude's unit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sasmap.arrays import BoolArray, FloatArray
from sasmap.survey.contents import sample_windows
from sasmap.survey.lattice import Window, transform_points
from sasmap.survey.passes import SonarPass
from sasmap.survey.tiles import Tile, read_tile

# Bins of the profile, distance from the track in altitudes. The transmitted pulse lies before the
# first, and ranges beyond the last carry no information.
FIRST, LAST, STEP = 0.14, 2.6, 0.02
# Points along a tile's longer side, and along a window's sides, that are tested for nearness;
# maximum number of windows that are read, and minimum number of pixels per bin.
POINTS, CORNERS, MOST_WINDOWS, LEAST_PIXELS = 64, 3, 48, 60
# Minimum rise from water to floor, dB (side-scan and SAS have 15 and more; ripples at such ranges
# vary by 6), and the share of the range within which it must occur: with a side-looking beam and a
# weak first echo the level rises over half an altitude.
RISE_DB, SHARP = 10.0, 0.08
# Minimum number of bins before and after a step; length before it, in altitudes, that must be dark
# (shadows are narrower at such ranges), or all of it where a tile begins below the sonar; interval
# after it over which the floor's level is averaged, as a share of its range.
FEWEST_BINS, DARK, AFTER = 4, 0.3, 0.35
# Level in the column, dB below the floor's, above which it is not water; and the intervals, in
# altitudes, over which the levels of column and floor are averaged.
BRIGHT_DB, COLUMN, FLOOR = 6.0, (0.3, 0.9), (1.1, 1.8)
# Ratio of first echo to stated altitude: tolerance for bottom detection and side-looking beams
# (measured: 10 % too far), and the value above which ground range is doubtful.
EARLY, LATE, COLUMN_ENDS = 0.87, 1.2, 0.9
# Other units of altitude, m.
UNITS = {"feet": 0.3048, "fathoms": 1.8288}
# Largest relative deviation of the ratio from a unit's for the unit to be named.
LIKE = 0.08
# Largest scatter, in altitudes, of the edge of valid pixels about one altitude where the water
# column was cut out. Altitude must vary by VARIES, or the edge lie within the tiles: otherwise they
# may begin there by chance.
FOLLOWS, VARIES = 0.015, 0.06
# Groups of pixels by altitude, and the quantile of distance that is taken as their edge.
GROUPS, EDGE = 8, 0.002
# Minimum intensity relative to the largest, and smallest positive number: keep logarithms finite.
SILENCE, TINY = 1e-12, np.finfo(float).tiny
# Amplitude whose square is still finite.
LARGEST = 1e150


class Profile(NamedTuple):
    """Pixels near the track, by their distance in altitudes.

    Attributes
    ----------
    place : ndarray (bins,)
        Middle of each bin, altitudes.
    level : ndarray (bins,)
        Mean intensity, dB; NaN where too few pixels are valid.
    edges : ndarray (groups,)
        Distance of the nearest valid pixel, altitudes, in groups of pixels by increasing altitude.
    follows : bool
        Whether valid pixels have an edge that follows altitude, or that lies within the tiles.
    """

    place: FloatArray
    level: FloatArray
    edges: FloatArray
    follows: bool


def check_column(sonar_pass: SonarPass, crs: str) -> list[str]:
    """Compare the range of the tiles' first echoes with the altitude and the stated kind of range.

    Parameters
    ----------
    sonar_pass : SonarPass
    crs : str
        The survey's.

    Returns
    -------
    list of str
        A warning, or none: nothing is known where the tiles begin too far from the track.
    """
    profile = _profile(sonar_pass, crs)
    if profile is None:
        return []
    middle = float(np.median(sonar_pass.track.altitude))
    step = _step(profile)
    told = (_of_slant if sonar_pass.slant else _of_ground)(profile, step, middle)
    return [f"{sonar_pass.navigation}: altitude: about {middle:.3g} m, but {told}"] if told else []


def _of_slant(profile: Profile, step: float | None, middle: float) -> str:
    """Describe what contradicts slant range or the altitude."""
    if step is not None and not EARLY < step < LATE:
        return (
            f"on the tiles, stated to be in slant range, the first echo is at "
            f"{step * middle:.3g} m: {_remedy(step)}"
        )
    water, floor = (_level(profile, *part) for part in (COLUMN, FLOOR))
    if water > floor - BRIGHT_DB:
        return (
            "pixels nearer than that are as bright as the floor beyond, where slant range has "
            "water: expected range: ground, or a smaller altitude"
        )
    return ""


def _of_ground(profile: Profile, step: float | None, middle: float) -> str:
    """Describe what contradicts ground range."""
    if step is not None and step > COLUMN_ENDS:
        return (
            f"the tiles are dark up to {step * middle:.3g} m from the track, like a water column "
            "in slant range: expected range: slant, or tiles whose floor begins below the sonar"
            + ("" if step < LATE else f"; {_remedy(step)}")
        )
    if profile.follows and np.abs(profile.edges - 1).max() < FOLLOWS:
        return (
            "the tiles begin just that far from the track, as if the water column had been cut out "
            "of slant range: expected range: slant, unless they were cut there in ground range"
        )
    return ""


def _remedy(step: float) -> str:
    """Name the unit that would explain an altitude that is off by a factor."""
    for unit, metres in UNITS.items():
        if abs(step / metres - 1) < LIKE:
            return f"expected altitude in metres: it looks like {unit}; convert it"
    return "expected the sonar's height above the sea floor, in metres"


def _level(profile: Profile, first: float, last: float) -> float:
    part = profile.level[(profile.place > first) & (profile.place < last)]
    part = part[np.isfinite(part)]
    return float(np.median(part)) if part.size >= FEWEST_BINS else np.nan


def _step(profile: Profile) -> float | None:
    """Distance, in altitudes, at which intensity rises from water to floor."""
    known = np.isfinite(profile.level)
    place, level = profile.place[known], profile.level[known]
    best, found = RISE_DB, None
    for k in range(FEWEST_BINS, place.size - FEWEST_BINS):
        dark = place < place[k] * (1 - SHARP / 2)
        lit = (place > place[k] * (1 + SHARP / 2)) & (place < place[k] * (1 + AFTER))
        narrow = place[k] - place[0] < DARK and place[0] > 2 * FIRST
        if narrow or min(dark.sum(), lit.sum()) < FEWEST_BINS:
            continue
        # the whole column is dark, and the whole floor is not
        low, high = float(np.quantile(level[dark], 0.9)), float(np.quantile(level[lit], 0.1))
        if high - low > best:
            risen = (place > place[k] * (1 - SHARP)) & (level > (low + high) / 2)
            best, found = high - low, float(place[risen][0])
    return found


def _profile(sonar_pass: SonarPass, crs: str) -> Profile | None:
    """Average the pixels near the track; None where there are too few."""
    parts = []
    for tile, window in _windows(sonar_pass, crs):
        try:
            parts.append(_pixels(sonar_pass, tile, crs, window))
        except OSError:
            continue  # an undecodable block fails its cells, not the survey
    ratio, altitude, intensity = np.concatenate(parts, axis=1) if parts else np.empty((3, 0))
    seen = np.isfinite(intensity)
    blank = (~seen & (ratio < 1 - FOLLOWS)).sum()
    ratio, altitude, intensity = ratio[seen], altitude[seen], intensity[seen]
    if ratio.size < LEAST_PIXELS * GROUPS:
        return None
    bins = np.arange(FIRST, LAST + STEP / 2, STEP)
    count, _ = np.histogram(ratio, bins)
    total, _ = np.histogram(ratio, bins, weights=intensity)
    mean = np.where(count >= LEAST_PIXELS, total / np.maximum(count, 1), np.nan)
    level = 10 * np.log10(np.maximum(mean, SILENCE * np.nanmax(mean, initial=0.0)) + TINY)
    low, high = float(altitude.min()), float(altitude.max())
    group = (GROUPS * (altitude - low) / max(1.001 * (high - low), TINY)).astype(np.int64)
    groups = [ratio[group == k] for k in range(GROUPS)]
    edges = np.array([np.quantile(g, EDGE) for g in groups if g.size >= LEAST_PIXELS])
    follows = blank >= LEAST_PIXELS or high / low - 1 > VARIES
    return Profile(bins[:-1] + STEP / 2, level, edges, bool(follows))


def _windows(sonar_pass: SonarPass, crs: str) -> list[tuple[Tile, Window]]:
    """Windows of the tiles that hold pixels near the track, spread evenly."""
    found = []
    for tile in sonar_pass.tiles:
        box = _box(sonar_pass, tile, crs)
        for part in sample_windows(box):
            window = Window(part.row + box.row, part.column + box.column, part.height, part.width)
            rows = window.row + np.linspace(0.5, window.height - 0.5, CORNERS)
            columns = window.column + np.linspace(0.5, window.width - 0.5, CORNERS)
            if _is_near(sonar_pass, tile, crs, rows, columns).any():
                found.append((tile, window))
    return found[:: len(found) // MOST_WINDOWS + 1]


def _box(sonar_pass: SonarPass, tile: Tile, crs: str) -> Window:
    """Box of a tile's pixels that lie near the track; empty where there are none."""
    step = max(max(tile.window.height, tile.window.width) / POINTS, 1.0)
    row = np.arange(0, tile.window.height + step, step).clip(max=tile.window.height - 0.5)
    column = np.arange(0, tile.window.width + step, step).clip(max=tile.window.width - 0.5)
    near = _is_near(sonar_pass, tile, crs, row, column)
    if not near.any():
        return Window(0, 0, 0, 0)
    rows, columns = row[near.any(axis=1)], column[near.any(axis=0)]
    top, left = int(max(rows[0] - step, 0)), int(max(columns[0] - step, 0))
    height, width = int(rows[-1] + step) - top + 1, int(columns[-1] + step) - left + 1
    return Window(top, left, height, width).intersect(tile.window)


def _is_near(
    sonar_pass: SonarPass, tile: Tile, crs: str, rows: FloatArray, columns: FloatArray
) -> BoolArray:
    """Whether points at some rows and columns of a tile lie near the track."""
    t = tile.lattice.transform
    x = t.c + t.a * columns + t.b * rows[:, None]
    y = t.f + t.d * columns + t.e * rows[:, None]
    return np.asarray(_seen(sonar_pass, *transform_points(tile.lattice.crs, crs, x, y))[0] < LAST)


def _seen(sonar_pass: SonarPass, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance of points from the track, in altitudes, and altitude, m; NaN where not seen."""
    seen = sonar_pass.locate(x, y)
    return seen.distance / seen.altitude, seen.altitude


def _pixels(sonar_pass: SonarPass, tile: Tile, crs: str, window: Window) -> FloatArray:
    """Distance in altitudes, altitude and intensity (NaN: none) of a window's near pixels."""
    values = np.minimum(np.asarray(read_tile(tile, window), float), LARGEST)
    x, y = np.broadcast_arrays(
        *transform_points(tile.lattice.crs, crs, *tile.lattice.centres(window))
    )
    ratio, altitude = _seen(sonar_pass, x, y)
    kept = ratio < LAST
    return np.stack([ratio[kept], altitude[kept], values[kept] ** 2])
