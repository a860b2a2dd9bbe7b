"""Compiled loops over a clip's pixels: sums over boxes of the image, and over bins of phase."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.rendering import FAST

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Indices of the sums kept for each bin and for each block of a phase-range histogram.
COUNT, UNSATURATED, INTENSITY, OFFSET, REACH, BIN_SUMS = range(6)
PIXELS, PLACE, RANGE, ALTITUDE, TREND, BLOCK_SUMS = range(6)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def box_sums(values, valid, per_column, per_row, size):  # type: ignore[no-untyped-def]
    """Sum an image, demodulated at a wave, over square boxes.

    Returns the complex sums of values * exp(-i phase) and the number of valid pixels, both (box
    rows, box columns); the phase is 0 at the image's centre.
    """
    rows, columns = values.shape
    shape = ((rows + size - 1) // size, (columns + size - 1) // size)
    turned = np.zeros(shape, np.complex128)
    count = np.zeros(shape)
    phase = -2.0 * np.pi * per_column * (np.arange(columns) - 0.5 * (columns - 1))
    cosine, sine = np.cos(phase), np.sin(phase)
    for i in range(rows):
        turn = np.exp(-2j * np.pi * per_row * (i - 0.5 * (rows - 1)))
        for c in range(shape[1]):
            real, imaginary, pixels = 0.0, 0.0, 0
            for j in range(c * size, min((c + 1) * size, columns)):
                value = values[i, j] if valid[i, j] else 0.0
                real += value * cosine[j]
                imaginary += value * sine[j]
                pixels += valid[i, j]
            turned[i // size, c] += complex(real, imaginary) * turn
            count[i // size, c] += pixels
    return turned, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def wave_boxes(values, valid, per_column, per_row, parts, width):  # type: ignore[no-untyped-def]
    """Sum an image over boxes 1 / `parts` of a wavelength long and `width` pixels wide.

    Returns its sums demodulated at the wave (complex) and as it is, sums of squares and numbers of
    pixels, (parts of wavelengths, boxes across).
    """
    rows, columns = values.shape
    norm = np.hypot(per_column, per_row)
    half = 0.5 * (abs(per_column) * (columns - 1) + abs(per_row) * (rows - 1))
    side = 0.5 * (abs(per_row) * (columns - 1) + abs(per_column) * (rows - 1)) / norm
    shape = (int(2.0 * half * parts) + 1, int(2.0 * side / width) + 1)
    turned = np.zeros(shape, np.complex128)
    total, square, count = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    step = np.exp(-2j * np.pi * per_column)
    for i in range(rows):
        row = i - 0.5 * (rows - 1)
        turn = np.exp(-2j * np.pi * (per_row * row - per_column * 0.5 * (columns - 1)))
        for j in range(columns):
            if valid[i, j]:
                column = j - 0.5 * (columns - 1)
                a = int((per_column * column + per_row * row + half) * parts)
                b = int(((per_column * row - per_row * column) / norm + side) / width)
                turned[a, b] += values[i, j] * turn
                total[a, b] += values[i, j]
                square[a, b] += values[i, j] ** 2
                count[a, b] += 1.0
            turn *= step
    return turned, total, square, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def box_place(i, size, boxes):  # type: ignore[no-untyped-def]
    """Index of the last box centred at or before a pixel, and the fraction of the way to the next.

    Both are clipped to the boxes that exist.
    """
    place = min(max((i + 0.5) / size - 0.5, 0.0), boxes - 1.0)
    low = min(int(place), max(boxes - 2, 0))
    return low, place - low


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def between(field, low_row, down, low_column, right):  # type: ignore[no-untyped-def]
    """Interpolate bilinearly between four boxes."""
    next_row = min(low_row + 1, field.shape[0] - 1)
    next_column = min(low_column + 1, field.shape[1] - 1)
    return (1.0 - down) * (
        (1.0 - right) * field[low_row, low_column] + right * field[low_row, next_column]
    ) + down * ((1.0 - right) * field[next_row, low_column] + right * field[next_row, next_column])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def field_cycles(even, odd, box, stripes, shape):  # type: ignore[no-untyped-def]
    """Phase of a field at every pixel, cycles, from the stripes of the other parity."""
    result = np.empty(shape)
    for i in range(shape[0]):
        low_row, down = box_place(i, box, even.shape[0])
        for j in range(shape[1]):
            low_column, right = box_place(j, box, even.shape[1])
            if np.floor(stripes[0] * (j + 0.5) + stripes[1] * (i + 0.5)) % 2.0 == 0.0:
                z = between(odd, low_row, down, low_column, right)
            else:
                z = between(even, low_row, down, low_column, right)
            result[i, j] = np.arctan2(z.imag, z.real) / (2.0 * np.pi)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def spread_boxes(values, box, shape):  # type: ignore[no-untyped-def]
    """Interpolate values of boxes to every pixel, between their centres."""
    result = np.empty(shape)
    for i in range(shape[0]):
        low_row, down = box_place(i, box, values.shape[0])
        for j in range(shape[1]):
            low_column, right = box_place(j, box, values.shape[1])
            result[i, j] = between(values, low_row, down, low_column, right)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def phase_at(i, j, shape, field, per_pixel):  # type: ignore[no-untyped-def]
    """Phase of a pixel, cycles from 0 to 1.

    `field` is the phase relative to the plane wave, cycles (rows, columns), empty where there is
    none; `per_pixel` the wave's cycles per column, per row, and at the clip's centre.
    """
    cycles = per_pixel[2] + per_pixel[0] * (j - 0.5 * (shape[1] - 1))
    cycles += per_pixel[1] * (i - 0.5 * (shape[0] - 1))
    if field.size > 0:
        cycles += field[i, j]
    return cycles - np.floor(cycles)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def block_table(edges):  # type: ignore[no-untyped-def]
    """Table of the block at many even steps of range, and the number of steps per metre."""
    blocks = edges.size - 1
    scale = 8 * blocks / (edges[-1] - edges[0])
    table = np.empty(8 * blocks, np.int64)
    b = 0
    for k in range(table.size):
        while b + 1 < blocks and edges[b + 1] <= edges[0] + (k + 0.5) / scale:
            b += 1
        table[k] = b
    return table, scale


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sum_pixels(  # type: ignore[no-untyped-def]
    power, used, saturated, ground_range, altitude, trend, field, per_pixel, along, edges, bins, box
):
    """Return sums of bins (blocks, bins, BIN_SUMS) and of blocks (blocks, BLOCK_SUMS).

    `field` and `per_pixel` are as for :func:`phase_at`; `along` holds the metres along the look per
    column and per row.
    """
    rows, columns = power.shape
    blocks = edges.size - 1
    table, scale = block_table(edges)
    sums = np.zeros((blocks, bins, BIN_SUMS))
    places = np.zeros((blocks, BLOCK_SUMS))
    for i in range(rows):
        row = i - 0.5 * (rows - 1)
        low_row, down = box_place(i, box, trend.shape[0])
        for j in range(columns):
            if not used[i, j]:
                continue
            cycles = phase_at(i, j, power.shape, field, per_pixel)
            k = min(int(cycles * bins), bins - 1)
            reach = ground_range[i, j]
            b = table[min(max(int((reach - edges[0]) * scale), 0), table.size - 1)]
            low_column, right = box_place(j, box, trend.shape[1])
            level = between(trend, low_row, down, low_column, right)
            sums[b, k, COUNT] += 1.0
            sums[b, k, UNSATURATED] += 0.0 if saturated[i, j] else 1.0
            sums[b, k, INTENSITY] += power[i, j] / level
            sums[b, k, OFFSET] += cycles - (k + 0.5) / bins
            sums[b, k, REACH] += reach
            places[b, PIXELS] += 1.0
            places[b, PLACE] += along[0] * (j - 0.5 * (columns - 1)) + along[1] * row
            places[b, RANGE] += reach
            places[b, ALTITUDE] += altitude[i, j]
            places[b, TREND] += level
    return sums, places


@numba.njit(cache=True, nogil=True, error_model="numpy")
def paint_pixels(known, ground_range, field, per_pixel, places, pulses):  # type: ignore[no-untyped-def]
    """Spread pulses (blocks, bins) over the pixels that are known; 0 elsewhere.

    `places` are the blocks' mean ranges; pulses are interpolated between blocks and bins.
    """
    rows, columns = known.shape
    blocks, bins = pulses.shape
    image = np.zeros((rows, columns))
    b = 0
    for i in range(rows):
        for j in range(columns):
            if not known[i, j]:
                continue
            x = phase_at(i, j, known.shape, field, per_pixel) * bins + (bins - 0.5)
            low = int(x)
            share = x - low
            low -= bins if low >= bins else 0
            high = low + 1 if low + 1 < bins else 0
            reach = ground_range[i, j]
            while b + 1 < blocks - 1 and places[b + 1] < reach:
                b += 1
            while b > 0 and places[b] > reach:
                b -= 1
            after = min(b + 1, blocks - 1)
            width = places[after] - places[b]
            part = min(max((reach - places[b]) / width, 0.0), 1.0) if width > 0.0 else 0.0
            here = pulses[b, low] + share * (pulses[b, high] - pulses[b, low])
            there = pulses[after, low] + share * (pulses[after, high] - pulses[after, low])
            image[i, j] = here + part * (there - here)
    return image
