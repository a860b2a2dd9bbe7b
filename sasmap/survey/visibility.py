"""Checks that the sonar can have seen the tiles from its track, and assignment to lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sasmap.arrays import BoolArray, FloatArray
from sasmap.errors import InputError
from sasmap.survey.contents import sample_windows
from sasmap.survey.lattice import Window, transform_points
from sasmap.survey.navigation import MIN_GRAZING, WGS84
from sasmap.survey.passes import SonarPass, view
from sasmap.survey.tiles import Tile, read_tile

# Points along the longer side of a tile that represent its pixels.
POINTS = 64
# A line saw a tile if it saw this share of the points that the best line saw; of several such
# lines, the only one to see it above this grazing angle (a range of 19 altitudes, which few sonars
# exceed).
SHARE, USUAL_GRAZING = 0.9, np.radians(3.0)
# Grazing angle of a pass's farthest pixel above which altitude is refused, and above which it is
# doubtful: side-looking sonars see far beyond their altitude, and ranges under one and a half
# altitudes are usually cut off (altitude in feet and ranges in metres give 39 degrees).
STEEPEST, STEEP = np.radians(72.0), np.radians(35.0)
# Grazing angle of its nearest pixel below which altitude is doubtful.
LOW = np.radians(2.0)
# Share of a tile's pixels beyond the ends of the line above which a warning is given, and sampling
# step of the check, pixels.
MOST_LEFT_OUT, STRIDE = 0.1, 8
# Distance of a track from a tile, m, that indicates a mix-up: no sonar sees so far.
FAR = 5000.0
# Pixels read at once in the search for a valid one: bounds memory.
CHECKED_PIXELS = 1_000_000


class _Sight(NamedTuple):
    """Visibility of a tile's points from a line."""

    grazing: FloatArray
    wanted: BoolArray  # on a side that the pass shows
    abeam: BoolArray


def _sight(sonar_pass: SonarPass, tile: Tile, crs: str) -> _Sight:
    """Visibility of a coarse raster of a tile's pixels from a track."""
    window = tile.window
    step = max(window.height, window.width) / POINTS
    row, column = np.meshgrid(
        np.arange(0, window.height + step / 2, step).clip(0.5, window.height - 0.5),
        np.arange(0, window.width + step / 2, step).clip(0.5, window.width - 0.5),
        indexing="ij",
    )
    t = tile.lattice.transform
    x, y = t.c + t.a * column + t.b * row, t.f + t.d * column + t.e * row
    seen = sonar_pass.track.locate(*transform_points(tile.lattice.crs, crs, x, y))
    grazing = np.arctan2(seen.altitude, seen.distance)
    with np.errstate(invalid="ignore"):
        near = grazing >= MIN_GRAZING
    wanted = np.zeros_like(near)
    for side in sonar_pass.sides:
        wanted |= near & (seen.starboard == (side == "starboard"))
    return _Sight(grazing, wanted, near)


def assign_tiles(
    lines: list[SonarPass], labels: list[str], crs: str, warnings: list[str]
) -> list[SonarPass]:
    """Assign each tile to the line of the navigation that saw it.

    Parameters
    ----------
    lines : list of SonarPass
        The pass as seen from each line of its navigation, with all tiles.
    labels : list of str
        Rows of each line in the file.
    crs : str
        The survey's.
    warnings : list of str
        Warnings are appended.

    Returns
    -------
    list of SonarPass
        Lines that saw tiles, with them.

    Raises
    ------
    InputError
        Where no line, or more than one, can have seen a tile; one message per tile.
    """
    faults: list[str] = []
    owned: dict[int, list[Tile]] = {}
    for tile in lines[0].tiles:
        sights = [_sight(line, tile, crs) for line in lines]
        able = _able([s.wanted for s in sights])
        if not able:
            faults.append(_unseen(lines[0], tile, any(s.abeam.any() for s in sights), crs))
        elif len(able) > 1 and len(near := _usual(sights, able)) != 1:
            told = " and ".join(labels[k] for k in near[:3])
            faults.append(
                f"{tile.path}: {lines[0].navigation.name} holds {len(lines)} lines, and those of "
                f"{told} can both have seen it: give each line its own file and pass, with "
                "the tiles that it saw"
            )
        else:
            owned.setdefault(able[0] if len(able) == 1 else near[0], []).append(tile)
    if faults:
        raise InputError(faults)
    if len(lines) > 1:
        used = " and ".join(labels[k] for k in sorted(owned))
        warnings.append(
            f"{lines[0].navigation}: holds {len(lines)} lines ({', '.join(labels[:9])}), split at "
            f"turns: tiles are assigned to {used}"
        )
    several = len(owned) > 1
    return [
        replace(
            lines[k],
            tiles=tuple(owned[k]),
            name=f"{lines[k].settings_name} line {k + 1}" if several else lines[k].name,
        )
        for k in sorted(owned)
    ]


def _able(masks: list[BoolArray]) -> list[int]:
    """Find the lines that saw about as much as the best one."""
    counts = [int(mask.sum()) for mask in masks]
    return [k for k, count in enumerate(counts) if count and count >= SHARE * max(counts)]


def _usual(sights: list[_Sight], able: list[int]) -> list[int]:
    """Find the line that alone saw a tile at usual grazing angles; all if there is not one."""
    masks = [sights[k].wanted & (sights[k].grazing >= USUAL_GRAZING) for k in able]
    found = [able[k] for k in _able(masks)]
    return found or able


def _unseen(sonar_pass: SonarPass, tile: Tile, abeam: bool, crs: str) -> str:
    if not abeam:
        return (
            f"{tile.path}: lies outside the navigation: no ping of {sonar_pass.navigation} "
            "is abeam of it within the range of a sonar at that altitude"
            f"{_where_else(sonar_pass, tile, crs)}"
        )
    other = "port" if sonar_pass.sides == ("starboard",) else "starboard"
    return (
        f"{tile.path}: lies on the {other} side of the track; expected {sonar_pass.sides[0]}: "
        "correct side:, or the navigation's rows if they run against time"
    )


def _where_else(sonar_pass: SonarPass, tile: Tile, crs: str) -> str:
    """Describe how far away a track is, and the mix-up that would explain it."""
    track = sonar_pass.track
    ping = np.array([np.median(track.x)]), np.array([np.median(track.y)])
    at = np.array([np.mean(v) for v in tile.outline_in(crs)])
    away = float(np.hypot(ping[0][0] - at[0], ping[1][0] - at[1]))
    if not away > FAR:
        return ""
    longitude, latitude = transform_points(crs, WGS84, *ping)
    mixed = {
        "x and y may be swapped": (ping[1], ping[0]),
        "positions may be in kilometres": (1000 * ping[0], 1000 * ping[1]),
        "longitude may lack its minus sign": transform_points(WGS84, crs, -longitude, latitude),
        "latitude may lack its minus sign": transform_points(WGS84, crs, longitude, -latitude),
    }
    told = f": the track is {away / 1000:.0f} km away"
    for text, (x, y) in mixed.items():
        if np.hypot(x[0] - at[0], y[0] - at[1]) < FAR:
            return f"{told}: {text}"
    return f"{told}: check columns: and navigation_crs:"


def check_altitude(sonar_pass: SonarPass, crs: str, warnings: list[str]) -> None:
    """Refuse altitudes that contradict the ranges of the tiles; warn about doubtful ones.

    Parameters
    ----------
    sonar_pass : SonarPass
    crs : str
        The survey's.
    warnings : list of str
        Warnings are appended.

    Raises
    ------
    InputError
        Where all pixels lie almost below the sonar.
    """
    sights = [_sight(sonar_pass, tile, crs) for tile in sonar_pass.tiles]
    grazing = np.concatenate([s.grazing[s.wanted] for s in sights])
    if sonar_pass.slant:  # sine instead of tangent; pixels nearer than the altitude are water
        sine = np.tan(grazing)
        grazing = np.arcsin(sine[sine < 1])
        if not grazing.size:
            return  # no floor at all, which is reported elsewhere
    farthest, nearest = float(grazing.min()), float(grazing.max())
    middle = float(np.median(sonar_pass.track.altitude))
    start = f"{sonar_pass.navigation}: altitude: about {middle:.3g} m, but the tiles' "
    advice = "expected the sonar's height above the sea floor, in metres"
    if farthest > STEEPEST:
        raise InputError(
            f"{start}farthest pixel is only {middle / np.tan(farthest):.3g} m from the track: "
            f"{advice} (not the antenna's, the ellipsoid's, or centimetres)"
        )
    if farthest > STEEP:
        warnings.append(
            f"{start}farthest pixel is only {middle / np.tan(farthest):.3g} m from the track: "
            f"{advice} (not its depth, or feet); check it"
        )
    if nearest < LOW:
        warnings.append(
            f"{start}nearest pixel is {middle / np.tan(nearest):.3g} m from the track: {advice}; "
            "check it"
        )


def shows_floor(sonar_pass: SonarPass, tile: Tile, crs: str) -> bool:
    """Test whether a pass shows a pixel of sea floor on a tile.

    Parameters
    ----------
    sonar_pass : SonarPass
    tile : Tile
    crs : str
        The survey's.

    Returns
    -------
    bool

    Raises
    ------
    OSError
        Where a block cannot be decoded.
    """
    for part in (*sample_windows(tile.window), *_bands(tile.window)):
        valid = ~np.isnan(read_tile(tile, part))
        if not valid.any():
            continue
        seen = view(sonar_pass, crs, tile.lattice, part)["ground_range"]
        if (valid & ~np.isnan(seen)).any():
            return True
    return False


def left_out(sonar_pass: SonarPass, tile: Tile, crs: str) -> str:
    """Describe the part of a tile's valid pixels that no ping is abeam of.

    Parameters
    ----------
    sonar_pass : SonarPass
    tile : Tile
    crs : str
        The survey's.

    Returns
    -------
    str
        A message; empty where the part is small.

    Raises
    ------
    OSError
        Where a block cannot be decoded.
    """
    if np.isnan(_sight(sonar_pass, tile, crs).grazing).mean() < MOST_LEFT_OUT:
        return ""  # however many of its pixels are valid
    valid, lost = 0, 0
    for part in sample_windows(tile.window):
        there = ~np.isnan(read_tile(tile, part)[::STRIDE, ::STRIDE])
        x, y = (np.broadcast_to(v, (part.height, part.width))[::STRIDE, ::STRIDE][there]
                for v in tile.lattice.centres(part))  # fmt: skip
        seen = sonar_pass.track.locate(*transform_points(tile.lattice.crs, crs, x, y))
        valid, lost = valid + x.size, lost + int(np.isnan(seen.distance).sum())
    if lost < MOST_LEFT_OUT * valid:
        return ""
    return (
        f"{tile.path}: {lost / valid:.0%} of its pixels lie beyond the ends of the line of "
        f"{sonar_pass.navigation}, not abeam of any ping, and are left out: export navigation of "
        "the whole line"
    )


def _bands(whole: Window) -> Iterator[Window]:
    """Windows of full rows that together cover a tile."""
    rows = max(1, CHECKED_PIXELS // max(whole.width, 1))
    for row in range(0, whole.height, rows):
        yield Window(row, 0, min(rows, whole.height - row), whole.width)
