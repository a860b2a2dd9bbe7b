"""Compiled loops over a clip's pixels: sums over boxes of the image, and over bins of phase."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Sums of a fold over each bin, in this order.
COUNT, KNOWN, TOTAL, PHASE, ALONG, SUMS = range(6)
# What is kept of a pixel near an edge of shadow: its block, its phase past the crest, less how far
# the edge there lies from the block's (cycles), its place along and across the look (m), its
# intensity, and cosine and sine of its phase.
EDGE_BLOCK, EDGE_PAST, EDGE_ALONG, EDGE_ACROSS, EDGE_POWER, EDGE_COSINE, EDGE_SINE, EDGE_PARTS = (
    range(8)
)
# The golden ratio's multiples are even on the circle: they tell which pixels are kept.
GOLDEN = 0.6180339887498949


@numba.njit(cache=True, nogil=True, error_model="numpy")
def box_sums(values, valid, per_column, per_row, size):  # type: ignore[no-untyped-def]
    """Sum an image, turned by a wave, over square boxes.

    Returns the complex sums of values * exp(-i phase) and the number of valid pixels, both (box
    rows, box columns); phase 0 at the image's centre.
    """
    rows, columns = values.shape
    shape = ((rows + size - 1) // size, (columns + size - 1) // size)
    turned = np.zeros(shape, np.complex128)
    count = np.zeros(shape)
    step = np.exp(-2j * np.pi * per_column)
    for i in range(rows):
        phase = per_row * (i - 0.5 * (rows - 1)) - per_column * 0.5 * (columns - 1)
        turn = np.exp(-2j * np.pi * phase)
        for j in range(columns):
            if valid[i, j]:
                turned[i // size, j // size] += values[i, j] * turn
                count[i // size, j // size] += 1.0
            turn *= step
    return turned, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def wave_boxes(values, valid, per_column, per_row, width):  # type: ignore[no-untyped-def]
    """Sum an image over boxes a wavelength long and `width` pixels wide, turned by the wave.

    Returns complex sums, sums of squares and pixels, (wavelengths, boxes across).
    """
    rows, columns = values.shape
    norm = np.hypot(per_column, per_row)
    half = 0.5 * (abs(per_column) * (columns - 1) + abs(per_row) * (rows - 1))
    side = 0.5 * (abs(per_row) * (columns - 1) + abs(per_column) * (rows - 1)) / norm
    shape = (int(2.0 * half) + 1, int(2.0 * side / width) + 1)
    turned = np.zeros(shape, np.complex128)
    square = np.zeros(shape)
    count = np.zeros(shape)
    step = np.exp(-2j * np.pi * per_column)
    for i in range(rows):
        row = i - 0.5 * (rows - 1)
        turn = np.exp(-2j * np.pi * (per_row * row - per_column * 0.5 * (columns - 1)))
        for j in range(columns):
            if valid[i, j]:
                column = j - 0.5 * (columns - 1)
                a = int(per_column * column + per_row * row + half)
                b = int(((per_column * row - per_row * column) / norm + side) / width)
                turned[a, b] += values[i, j] * turn
                square[a, b] += values[i, j] ** 2
                count[a, b] += 1.0
            turn *= step
    return turned, square, count


class FoldPlan(NamedTuple):
    """How pixels are folded.

    Attributes
    ----------
    per_pixel : ndarray (2,)
        Cycles a column and a row of the wave.
    origin : float
        Phase at the clip's centre, cycles.
    along, across : ndarray (2,)
        Metres along and across the look a column and a row.
    start, cells : float
        Where cells of `strip` begin along the look, m, and their number a metre.
    strip : ndarray of int (cells,)
        Strip of each cell.
    centre : ndarray (strips,)
        Place of strips along the look, m.
    side, sides : float
        Where blocks begin across the look, m, and their number a metre.
    blocks : int
        A strip.
    bins : int
    bend : ndarray (strips, 5)
        Phases (cycles) where shadow begins and ends, by how much these move a metre along the look,
        and whether it is unsure that any falls there; 0 where there is none.
    zone : float
        Half the width of what is near an edge, cycles.
    share : float
        Of the pixels there, how many are kept.
    most : int
        Of these, no more.
    """

    per_pixel: FloatArray
    origin: float
    along: FloatArray
    across: FloatArray
    start: float
    cells: float
    strip: NDArray[np.int64]
    centre: FloatArray
    side: float
    sides: float
    blocks: int
    bins: int
    bend: FloatArray
    zone: float
    share: float
    most: int


@numba.njit(cache=True, nogil=True, error_model="numpy")
def box_place(i, size, boxes):  # type: ignore[no-untyped-def]
    """Lower box whose centre is at or before a pixel, and how far to the next one."""
    place = min(max((i + 0.5) / size - 0.5, 0.0), boxes - 1.0)
    low = min(int(place), max(boxes - 2, 0))
    return low, place - low


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def between(field, low_row, down, low_column, right):  # type: ignore[no-untyped-def]
    """Interpolate between four boxes."""
    next_row = min(low_row + 1, field.shape[0] - 1)
    next_column = min(low_column + 1, field.shape[1] - 1)
    return (1.0 - down) * (
        (1.0 - right) * field[low_row, low_column] + right * field[low_row, next_column]
    ) + down * ((1.0 - right) * field[next_row, low_column] + right * field[next_row, next_column])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def field_cycles(even, odd, box, tiles, shape):  # type: ignore[no-untyped-def]
    """Phase of a field at every pixel, cycles, by the boxes of the other parity."""
    result = np.empty(shape)
    for i in range(shape[0]):
        low_row, down = box_place(i, box, even.shape[0])
        for j in range(shape[1]):
            low_column, right = box_place(j, box, even.shape[1])
            if (i // (box * tiles) + j // (box * tiles)) % 2 == 0:
                z = between(odd, low_row, down, low_column, right)
            else:
                z = between(even, low_row, down, low_column, right)
            result[i, j] = np.arctan2(z.imag, z.real) / (2.0 * np.pi)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def spread_boxes(values, box, shape):  # type: ignore[no-untyped-def]
    """Values of boxes at every pixel, between their centres."""
    result = np.empty(shape)
    for i in range(shape[0]):
        low_row, down = box_place(i, box, values.shape[0])
        for j in range(shape[1]):
            low_column, right = box_place(j, box, values.shape[1])
            result[i, j] = between(values, low_row, down, low_column, right)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _keep(edge, block, phase, moved, along, across, power):  # type: ignore[no-untyped-def]
    """Fill what is kept of a pixel near an edge of shadow."""
    edge[EDGE_BLOCK] = block
    edge[EDGE_PAST] = phase / (2.0 * np.pi) - 0.25 - moved
    edge[EDGE_ALONG] = along
    edge[EDGE_ACROSS] = across
    edge[EDGE_POWER] = power
    edge[EDGE_COSINE] = np.cos(phase)
    edge[EDGE_SINE] = np.sin(phase)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fold_pixels(power, valid, saturated, ground_range, altitude, field, plan, zero):  # type: ignore[no-untyped-def]
    """Sum pixels over bins of phase and blocks; `field` is their phase beyond the plan's, if any.

    `zero` is the ripple's phase, rad, at the first bin's beginning.

    Returns sums (all blocks, bins, SUMS) of lit pixels; number not saturated and total intensity of
    those in shadow (all blocks, 2); for each block sums of one, place along and across, ground
    range and altitude (all blocks, 5); and pixels near an edge of shadow (n, EDGE_PARTS).
    """
    rows, columns = power.shape
    every = plan.centre.size * plan.blocks
    sums = np.zeros((every, plan.bins, SUMS))
    dark = np.zeros((every, 2))
    places = np.zeros((every, 5))
    edges = np.empty((plan.most, EDGE_PARTS))
    # taken out of the plan once: numba counts references to arrays at each access
    strips, centre, bend = plan.strip, plan.centre, plan.bend
    per_pixel, step, side_step = plan.per_pixel, plan.along, plan.across
    near, kept = 0, 0
    for i in range(rows):
        row = i - 0.5 * (rows - 1)
        for j in range(columns):
            if not valid[i, j]:
                continue
            column = j - 0.5 * (columns - 1)
            cycles = plan.origin + per_pixel[0] * column + per_pixel[1] * row
            if field.size > 0:
                cycles += field[i, j]
            cycles -= np.floor(cycles)
            along = step[0] * column + step[1] * row
            across = side_step[0] * column + side_step[1] * row
            strip = strips[min(max(int((along - plan.start) * plan.cells), 0), strips.size - 1)]
            side = min(max(int((across - plan.side) * plan.sides), 0), plan.blocks - 1)
            block = strip * plan.blocks + side
            places[block, 0] += 1.0
            places[block, 1] += along
            places[block, 2] += across
            places[block, 3] += ground_range[i, j]
            places[block, 4] += altitude[i, j]
            if bend[strip, 1] > 0.0:
                offset = along - centre[strip]
                begin = bend[strip, 0] + bend[strip, 2] * offset
                end = bend[strip, 1] + bend[strip, 3] * offset
                last = cycles - begin > end - cycles
                distance = min(cycles - begin, end - cycles)
                if bend[strip, 4] > 0.0 and distance > -plan.zone:
                    continue
                if abs(distance) < plan.zone:
                    near += 1
                    turn = near * GOLDEN
                    chosen = turn - np.floor(turn) < plan.share and kept < plan.most
                    if chosen and not saturated[i, j]:
                        moved = (bend[strip, 3] if last else bend[strip, 2]) * offset
                        phase = 2.0 * np.pi * cycles + zero
                        _keep(edges[kept], block, phase, moved, along, across, power[i, j])
                        kept += 1
                    continue
                if distance > 0.0:
                    dark[block, 0] += 0.0 if saturated[i, j] else 1.0
                    dark[block, 1] += power[i, j]
                    continue
            k = min(int(cycles * plan.bins), plan.bins - 1)
            sums[block, k, COUNT] += 1.0
            sums[block, k, KNOWN] += 0.0 if saturated[i, j] else 1.0
            sums[block, k, TOTAL] += power[i, j]
            sums[block, k, PHASE] += cycles - (k + 0.5) / plan.bins
            sums[block, k, ALONG] += along
    return sums, dark, places, edges[:kept]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def unfold_pixels(known, field, plan, pulses):  # type: ignore[no-untyped-def]
    """Spread pulses (all blocks, bins) back over the pixels that are known; 0 elsewhere.

    The opposite of :func:`fold_pixels`.
    """
    rows, columns = known.shape
    image = np.zeros((rows, columns))
    strips = plan.strip
    per_pixel, step, side_step = plan.per_pixel, plan.along, plan.across
    for i in range(rows):
        row = i - 0.5 * (rows - 1)
        for j in range(columns):
            if not known[i, j]:
                continue
            column = j - 0.5 * (columns - 1)
            cycles = plan.origin + per_pixel[0] * column + per_pixel[1] * row
            if field.size > 0:
                cycles += field[i, j]
            cycles -= np.floor(cycles)
            along = step[0] * column + step[1] * row
            across = side_step[0] * column + side_step[1] * row
            strip = strips[min(max(int((along - plan.start) * plan.cells), 0), strips.size - 1)]
            side = min(max(int((across - plan.side) * plan.sides), 0), plan.blocks - 1)
            k = min(int(cycles * plan.bins), plan.bins - 1)
            image[i, j] = pulses[strip * plan.blocks + side, k]
    return image
