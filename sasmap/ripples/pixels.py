"""Compiled loops over a clip's pixels: sums over boxes of the image, and over bins of phase."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.scattering import SIGMA_VARIANCE

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Parts of a bin of phase, to tell pixels spread over it from whole columns at one phase.
DITHER = 32
# Sums of a fold over each bin, in this order.
COUNT, KNOWN, TOTAL, PHASE, PHASE2, LOG_SLOPE, LOG_SLOPE2, TILT, FLAT, ALONG, SUMS = range(11)


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
    along, across : ndarray (2,)
        Metres along and across the look a column and a row.
    start, width : float
        Of blocks along the look, m.
    blocks, bins : int
    box : int
        Pixels a box of the arrays below.
    trend : ndarray (box rows, box columns)
        What the intensity is divided by.
    even, odd : ndarray of complex (box rows, box columns)
        Unit phasors of the phase field from even and odd boxes; ones without a field.
    tiles : int
        Boxes a side of the squares of which odd and even ones alternate.
    field : bool
        Whether a pixel takes its phase from the field of the other parity.
    """

    per_pixel: FloatArray
    along: FloatArray
    across: FloatArray
    start: float
    width: float
    blocks: int
    bins: int
    box: int
    trend: FloatArray
    even: NDArray[np.complex128]
    odd: NDArray[np.complex128]
    tiles: int
    field: bool


@numba.njit(cache=True, nogil=True, error_model="numpy")
def box_place(i, size, boxes):  # type: ignore[no-untyped-def]
    """Lower box whose centre is at or before a pixel, and how far to the next one."""
    place = min(max((i + 0.5) / size - 0.5, 0.0), boxes - 1.0)
    low = min(int(place), max(boxes - 2, 0))
    return low, place - low


@numba.njit(cache=True, nogil=True, error_model="numpy")
def between(field, low_row, down, low_column, right):  # type: ignore[no-untyped-def]
    """Interpolate between four boxes."""
    next_row = min(low_row + 1, field.shape[0] - 1)
    next_column = min(low_column + 1, field.shape[1] - 1)
    return (1.0 - down) * (
        (1.0 - right) * field[low_row, low_column] + right * field[low_row, next_column]
    ) + down * ((1.0 - right) * field[next_row, low_column] + right * field[next_row, next_column])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fold_pixels(power, valid, saturated, ground_range, altitude, plan):  # type: ignore[no-untyped-def]
    """Sum pixels over bins of phase and blocks along the look.

    Returns sums (SUMS, blocks, bins); for each block sums of one, place along and across, ground
    range and altitude (5, blocks); and which of a bin's DITHER parts any pixel meets, as bits.
    """
    rows, columns = power.shape
    sums = np.zeros((SUMS, plan.blocks, plan.bins))
    places = np.zeros((5, plan.blocks))
    met = np.zeros((plan.blocks, plan.bins), np.int64)
    box_rows, box_columns = plan.trend.shape
    for i in range(rows):
        low_row, down = box_place(i, plan.box, box_rows)
        row = i - 0.5 * (rows - 1)
        for j in range(columns):
            if not valid[i, j]:
                continue
            column = j - 0.5 * (columns - 1)
            low_column, right = box_place(j, plan.box, box_columns)
            cycles = plan.per_pixel[0] * column + plan.per_pixel[1] * row
            if plan.field:
                parity = (i // (plan.box * plan.tiles) + j // (plan.box * plan.tiles)) % 2
                phasors = plan.odd if parity == 0 else plan.even
                z = between(phasors, low_row, down, low_column, right)
                cycles += np.arctan2(z.imag, z.real) / (2.0 * np.pi)
            cycles -= np.floor(cycles)
            k = min(int(cycles * plan.bins), plan.bins - 1)
            along = plan.along[0] * column + plan.along[1] * row
            block = min(max(int((along - plan.start) / plan.width), 0), plan.blocks - 1)
            r, a = ground_range[i, j], altitude[i, j]
            log_slope = np.log(a / r)
            tilt = np.arctan2(r, a)
            offset = cycles - (k + 0.5) / plan.bins
            y = power[i, j] / between(plan.trend, low_row, down, low_column, right)
            sums[COUNT, block, k] += 1.0
            sums[KNOWN, block, k] += 0.0 if saturated[i, j] else 1.0
            sums[TOTAL, block, k] += y
            sums[PHASE, block, k] += offset
            sums[PHASE2, block, k] += offset * offset
            sums[LOG_SLOPE, block, k] += log_slope
            sums[LOG_SLOPE2, block, k] += log_slope * log_slope
            sums[TILT, block, k] += tilt
            sums[FLAT, block, k] += np.exp(-tilt * tilt / SIGMA_VARIANCE)
            sums[ALONG, block, k] += along
            met[block, k] |= 1 << int((cycles * plan.bins - k) * DITHER)
            places[0, block] += 1.0
            places[1, block] += along
            places[2, block] += plan.across[0] * column + plan.across[1] * row
            places[3, block] += r
            places[4, block] += a
    return sums, places, met


@numba.njit(cache=True, nogil=True, error_model="numpy")
def unfold_pixels(known, plan, pulses):  # type: ignore[no-untyped-def]
    """Spread pulses (blocks, bins) back over the pixels that are known, trend included.

    The opposite of :func:`fold_pixels`; 0 elsewhere.
    """
    rows, columns = known.shape
    image = np.zeros((rows, columns))
    box_rows, box_columns = plan.trend.shape
    for i in range(rows):
        low_row, down = box_place(i, plan.box, box_rows)
        row = i - 0.5 * (rows - 1)
        for j in range(columns):
            if not known[i, j]:
                continue
            column = j - 0.5 * (columns - 1)
            low_column, right = box_place(j, plan.box, box_columns)
            cycles = plan.per_pixel[0] * column + plan.per_pixel[1] * row
            if plan.field:
                parity = (i // (plan.box * plan.tiles) + j // (plan.box * plan.tiles)) % 2
                phasors = plan.odd if parity == 0 else plan.even
                z = between(phasors, low_row, down, low_column, right)
                cycles += np.arctan2(z.imag, z.real) / (2.0 * np.pi)
            cycles -= np.floor(cycles)
            k = min(int(cycles * plan.bins), plan.bins - 1)
            along = plan.along[0] * column + plan.along[1] * row
            block = min(max(int((along - plan.start) / plan.width), 0), plan.blocks - 1)
            image[i, j] = pulses[block, k] * between(plan.trend, low_row, down, low_column, right)
    return image
