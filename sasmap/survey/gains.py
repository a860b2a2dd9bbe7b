"""Check that tiles of a pass agree where they overlap or meet: in gain, and in place."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import shapely

from sasmap.arrays import FloatArray
from sasmap.numerics.threads import mapped
from sasmap.survey.lattice import Window, bounding_window
from sasmap.survey.offsets import offset_between
from sasmap.survey.tiles import Amplitude, Tile, read_mosaic

# Largest difference, dB, between overlapping tiles, and between the two sides of a seam, which are
# not the same sea floor (choices: 1 dB of gain is 12 % of amplitude).
OVERLAP_DB, SEAM_DB = 1.0, 3.0
# Minimum significance of a difference, in standard errors of the mean of speckle, and independent
# samples per pixel (speckle correlated over two pixels in each direction).
ERRORS, INDEPENDENT = 4.0, 0.25
# Decibels per unit of relative change of intensity.
DB = 10.0 / np.log(10.0)
# Side in pixels of the compared pieces, widths of strips along a seam (a crest or trough along it
# fills the narrow one, not the wide one), and minimum number of pixels (400 give a gain to 0.4 dB).
SIDE, STRIPS, LEAST = 192, (24, 192), 400
# Maximum number of pairs of tiles that are compared: bounds the time, as each opens a file twice.
MOST_PAIRS = 3000


def compare_tiles(tiles: tuple[Tile, ...], crs: str) -> list[str]:
    """Report tiles of a pass whose gain or place differs from a neighbour's.

    Parameters
    ----------
    tiles : tuple of Tile
        Of one survey line.
    crs : str
        The survey's.

    Returns
    -------
    list of str
        One line per tile that differs.
    """
    pairs = list(_neighbours(tiles, crs))[:MOST_PAIRS]
    told: dict[Tile, str] = {}
    for (_, tile), text in zip(pairs, mapped(_compare, pairs, os.cpu_count()), strict=True):
        if text is not None:
            told.setdefault(tile, text)
    return list(told.values())


def _neighbours(tiles: tuple[Tile, ...], crs: str) -> Iterator[tuple[Tile, Tile]]:
    """Pairs of tiles that overlap or meet, in the tiles' order."""
    if len(tiles) < 2:
        return
    shapes = []
    for tile in tiles:
        x, y = tile.outline_in(crs)
        hull = shapely.convex_hull(shapely.multipoints(np.column_stack([x, y])))
        shapes.append(hull.buffer(tile.pixel_size))
    tree = shapely.STRtree(shapes)
    found = tree.query(shapes, predicate="intersects").T
    for i, j in sorted((int(i), int(j)) for i, j in found if i < j):
        yield tiles[i], tiles[j]


def _compare(pair: tuple[Tile, Tile]) -> str | None:
    """Describe how a tile's place or gain differs from another's, if it does."""
    first, second = pair
    try:
        box = _box(first, second, 0).intersect(first.window)
        shown = [_both(first, second, part) for part in _pieces(box)]
        if away := _away(shown, first.pixel_size):
            return (
                f"{second.path}: shows the same sea floor {away:.2g} m from where "
                f"{first.path.name} shows it: f and A_H are wrong where they overlap; check the "
                "origins of the tiles"
            )
        difference, limit, where = _overlapping(shown) or _meeting(first, second)
    except OSError:
        return None  # an undecodable block fails its cells, not the survey
    if not abs(difference) > limit:
        return None
    word = "brighter" if difference > 0 else "darker"
    return (
        f"{second.path}: {abs(difference):.1f} dB {word} than {first.path.name} where they "
        f"{where}: expected one gain in a pass; give each gain its own pass, or scale "
        "the tiles alike"
    )


def _both(first: Tile, second: Tile, part: Window) -> tuple[Amplitude, Amplitude]:
    """Read what two tiles show in a window of the first."""
    a, b = (read_mosaic((tile,), first.lattice, part) for tile in (first, second))
    return a, b


def _away(shown: list[tuple[Amplitude, Amplitude]], pixel_size: float) -> float:
    """Distance, m, between the places where two tiles show the same floor; 0 where they agree."""
    for a, b in shown:
        moved = offset_between(a, b)
        if moved is not None:
            return float(np.hypot(*moved)) * pixel_size
    return 0.0


def _overlapping(
    shown: list[tuple[Amplitude, Amplitude]],
) -> tuple[float, float, str] | None:
    """Difference over the pixels that both show, and its limit."""
    for a, b in shown:
        both = np.isfinite(a) & np.isfinite(b)
        if both.sum() >= LEAST:
            return _difference(a[both], b[both], OVERLAP_DB, "overlap")
    return None


def _meeting(first: Tile, second: Tile) -> tuple[float, float, str]:
    """Difference between strips along a seam: the smallest over all strip widths."""
    found = [_at_seam(first, second, width) for width in STRIPS]
    if min(f[0] for f in found) < 0 < max(f[0] for f in found):
        return 0.0, SEAM_DB, ""
    return min(found, key=lambda f: abs(f[0]))


def _at_seam(first: Tile, second: Tile, width: int) -> tuple[float, float, str]:
    """Difference between the strips of one width."""
    one = _box(first, second, width).intersect(first.window)
    other = _box(second, first, width).intersect(second.window)
    parts: list[FloatArray] = []
    for tile, box in ((first, one), (second, other)):
        values = [read_mosaic((tile,), tile.lattice, part) for part in _pieces(box)]
        known = [np.asarray(v[np.isfinite(v)], float) for v in values]
        parts.append(np.concatenate(known) if known else np.empty(0))
    if min(part.size for part in parts) < LEAST:
        return 0.0, SEAM_DB, ""
    return _difference(parts[0], parts[1], SEAM_DB, "meet")


def _difference(a: Amplitude, b: Amplitude, limit: float, where: str) -> tuple[float, float, str]:
    """Ratio of mean intensity of `b` to that of `a`, dB, and the limit of its absolute value."""
    means = [float(np.mean(np.square(v, dtype=float))) for v in (a, b)]
    if min(means) <= 0:
        return 0.0, limit, where
    error = DB * np.sqrt(1 / (INDEPENDENT * a.size) + 1 / (INDEPENDENT * b.size))
    return 10.0 * float(np.log10(means[1] / means[0])), max(limit, ERRORS * error), where


def _box(tile: Tile, other: Tile, margin: int) -> Window:
    """Box of another tile in a tile's pixels, with a margin."""
    row, column = tile.lattice.pixel_of(*other.outline_in(tile.lattice.crs))
    box = bounding_window(row, column)
    return Window(
        box.row - margin, box.column - margin, box.height + 2 * margin, box.width + 2 * margin
    )


def _pieces(box: Window) -> Iterator[Window]:
    """Pieces of a box: its middle, then towards its corners."""
    if box.empty:
        return
    height, width = min(SIDE, box.height), min(SIDE, box.width)
    for share in (0.5, 0.1, 0.9):
        row = box.row + int(share * (box.height - height))
        column = box.column + int(share * (box.width - width))
        yield Window(row, column, height, width)
        if (height, width) == (box.height, box.width):
            return
