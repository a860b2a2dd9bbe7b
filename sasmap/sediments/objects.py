"""Objects on the floor that are not sediment: bright, hard-edged, with a shadow behind them.

Intensity is averaged over small squares and compared with a median over the surrounding floor,
which an object does not affect. A much brighter part with a much darker one next to it on the far
side is an object; the area between its parts (a wreck's hold, ribs and planks) belongs to it. Where
a dozen such parts stand close together they are the floor itself, a boulder field or rock, and are
left to texture.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_closing,
    binary_dilation,
    binary_fill_holes,
    center_of_mass,
    generate_binary_structure,
    grey_dilation,
    median_filter,
    zoom,
)
from scipy.ndimage import label as measure_label

from sasmap.arrays import BoolArray, IntArray
from sasmap.sediments.waves import COARSE, coarse

Mask = BoolArray
Part = tuple[slice, slice]

# Side in squares of the blocks whose medians give the floor's level, and side in blocks of the
# window over which their median is taken: 576 pixels, nearly half of which a wreck may fill.
BLOCK, AROUND = 16, 9
# Log intensity above and below the floor's (7 and 10 dB) of bright parts and of shadow: neither is
# reached by a connected dozen of 16-pixel speckle averages, nor by adjacent sediments.
BRIGHT, SHADOW = 1.6, 2.3
# Size in squares of the smallest bright part and shadow (100 and 130 pixels).
LEAST_BRIGHT, LEAST_SHADOW = 6, 8
# Maximum number of squares between an object and its shadow.
BESIDE = 2
# Maximum number of squares between parts of one object.
APART = 6
# Number of bright parts and shadows in a window (576 pixels) above which they are the floor itself.
FIELD = 14
# Cotangent of the grazing angle; at steeper angles objects cast negligible shadow, and the water
# column may begin.
STEEP = 0.5
# Squares beyond an edge with which the inside is compared, and minimum contrast in log intensity
# (4 dB) of a hard edge.
EDGE, STEP = 3, 0.9
# Maximum share of an object that may show ripples.
RIPPLED = 0.3


class Objects(NamedTuple):
    """Masks of what is not floor.

    Attributes
    ----------
    object, shadow : ndarray of bool (rows, columns)
        Objects, and the shadow that they cast.
    """

    object: Mask
    shadow: Mask


def find_objects(
    amplitude: NDArray[np.floating],
    cotangent: NDArray[np.floating],
    rippled: Mask,
    inner: Part,
) -> Objects:
    """Find objects and their shadows in an image.

    Parameters
    ----------
    amplitude : ndarray (rows, columns)
        With ripples removed; NaN where there is none. Starts at the edge of a block of squares.
    cotangent : ndarray (rows, columns)
        Of the grazing angle.
    rippled : ndarray of bool (rows, columns)
    inner : tuple of slice
        Part of the image to return; objects that reach beyond the image are seen in part.

    Returns
    -------
    Objects
        Within `inner`.
    """
    shape = tuple(s.stop - s.start for s in inner)
    nothing = Objects(np.zeros(shape, bool), np.zeros(shape, bool))
    level, known = coarse(amplitude)
    there = known > 0
    if there.mean() < 0.01:
        return nothing
    far = _thinned(cotangent, level.shape)
    over = np.where(there, level - _floor(level, there), 0.0)
    bright = _hard((over > BRIGHT) & (far > STEEP), over, there, LEAST_BRIGHT)
    if not bright.any():
        return nothing
    shadow = _hard(over < -SHADOW, over, there, LEAST_SHADOW)
    if not shadow.any():
        return nothing
    places, count = _paired(bright, shadow, far)
    kept = _apart(places, count, (bright, shadow), _thinned(rippled, level.shape) > 0)
    if not kept.any():
        return nothing
    solid, behind = _filled(kept, shadow)
    # edges lie inside squares
    solid = binary_dilation(solid) & ~(behind & ~solid)
    behind = binary_dilation(behind) & ~solid
    return Objects(_fine(solid, amplitude.shape)[inner], _fine(behind, amplitude.shape)[inner])


def _thinned(values: NDArray[np.generic], shape: tuple[int, ...]) -> NDArray[np.floating]:
    """One value per square."""
    middle = values[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE]
    return np.asarray(middle[: shape[0], : shape[1]], float)


def _floor(level: NDArray[np.floating], there: Mask) -> NDArray[np.floating]:
    """Level of the floor around each square."""
    rows, columns = (-(-n // BLOCK) * BLOCK for n in level.shape)
    wide = np.full((rows, columns), np.nan)
    wide[: level.shape[0], : level.shape[1]] = np.where(there, level, np.nan)
    squares = wide.reshape(rows // BLOCK, BLOCK, columns // BLOCK, BLOCK).swapaxes(1, 2)
    blocks = squares.reshape(rows // BLOCK, columns // BLOCK, -1)
    share = np.isfinite(blocks).mean(axis=2)
    whole = np.nanmedian(level[there])
    medians = np.full(share.shape, whole)
    enough = share > 0.25
    medians[enough] = np.nanmedian(blocks[enough], axis=1)
    smooth = median_filter(medians, AROUND, mode="nearest")
    fine = zoom(smooth, BLOCK, order=1, mode="nearest", grid_mode=True)
    return np.asarray(fine[: level.shape[0], : level.shape[1]])


def _hard(mask: Mask, over: NDArray[np.floating], there: Mask, least: int) -> Mask:
    """Keep connected parts with hard edges and at least `least` squares."""
    parts, count = measure_label(mask)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    large = sizes >= least
    large[0] = False
    if not large.any():
        return np.zeros_like(mask)
    parts = np.where(large[parts], parts, 0)
    # a step edge is two squares wide; beyond it is floor
    near = generate_binary_structure(2, 2)
    ring = (_grown(parts, EDGE) * ~binary_dilation(mask, near, 1) * there).astype(np.int64)
    inside = _means(parts, over, count)
    outside = _means(ring, over, count)
    hard = np.abs(inside - outside) > STEP
    hard[0] = False
    return np.asarray(hard[parts])


def _paired(bright: Mask, shadow: Mask, far: NDArray[np.floating]) -> tuple[IntArray, int]:
    """Give neighbouring bright parts one number, if one of them has a shadow behind it."""
    near = generate_binary_structure(2, 2)
    parts, count = measure_label(bright, near)
    shadows, dark_count = measure_label(shadow, near)
    touch = binary_dilation(bright, near, BESIDE)
    wide = _grown(parts, BESIDE)
    both = touch & shadow
    pairs = np.unique(np.stack([wide[both], shadows[both]], axis=1), axis=0)
    middle = _means(parts, far, count)
    behind = _means(shadows, far, dark_count)
    cast = np.zeros(count + 1, bool)
    for i, j in pairs:
        cast[i] |= bool(i and j and behind[j] > middle[i])
    joined = binary_dilation(bright, near, APART // 2)
    places, number = measure_label(joined, near)
    has = np.zeros(number + 1, bool)
    has[places[cast[parts]]] = True
    has[0] = False
    return np.where(bright & has[places], places, 0), number


def _grown(parts: IntArray, steps: int) -> IntArray:
    """Spread part numbers over unnumbered squares."""
    grown = grey_dilation(parts, size=2 * steps + 1)
    return np.where(parts > 0, parts, grown)


def _means(parts: IntArray, values: NDArray[np.floating], count: int) -> NDArray[np.floating]:
    """Mean of each numbered part."""
    flat = parts.ravel()
    total = np.bincount(flat, np.nan_to_num(values).ravel(), minlength=count + 1)
    return np.asarray(total / np.maximum(np.bincount(flat, minlength=count + 1), 1))


def _apart(places: IntArray, count: int, parts: tuple[Mask, Mask], rippled: Mask) -> Mask:
    """Keep objects that stand alone and not on ripples."""
    kept = np.zeros(count + 1, bool)
    every = []
    for mask in parts:
        numbers, n = measure_label(binary_dilation(mask, iterations=APART // 2))
        every += center_of_mass(numbers > 0, numbers, np.arange(1, n + 1))
    centres = np.array(every)
    half = BLOCK * AROUND / 2
    for k in np.unique(places[places > 0]):
        cells = np.argwhere(places == k)
        beside = (np.abs(centres - cells.mean(axis=0)) <= half).all(axis=1).sum()
        kept[k] = beside <= FIELD and rippled[tuple(cells.T)].mean() <= RIPPLED
    return np.asarray(kept[places])


def _filled(bright: Mask, shadow: Mask) -> tuple[Mask, Mask]:
    """Return whole objects with gaps between their parts filled, and the shadow touching them."""
    near = generate_binary_structure(2, 2)
    shadows, _ = measure_label(shadow, near)
    touched = np.unique(shadows[binary_dilation(bright, near, BESIDE)])
    behind = np.isin(shadows, touched[touched > 0])
    closed = binary_closing(np.pad(bright, APART), near, APART)[APART:-APART, APART:-APART]
    return np.asarray((binary_fill_holes(closed) & ~behind) | bright), behind


def _fine(squares: Mask, shape: tuple[int, ...]) -> Mask:
    """Expand squares to pixels."""
    whole = np.repeat(np.repeat(squares, COARSE, axis=0), COARSE, axis=1)
    result = np.zeros(shape, bool)
    result[: whole.shape[0], : whole.shape[1]] = whole
    return result
