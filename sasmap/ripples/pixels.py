"""Compiled loops over a clip's pixels: sums over boxes of the image, and over bins of phase."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.arrays import FloatArray
from sasmap.ripples.rendering import FAST


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


def _between(size: int, boxes: int, pixels: int) -> FloatArray:
    """Weights (pixels, boxes) that interpolate between the centres of boxes, linear."""
    place = np.clip((np.arange(pixels) + 0.5) / size - 0.5, 0.0, boxes - 1.0)
    return np.asarray(np.maximum(1.0 - np.abs(place[:, None] - np.arange(boxes)), 0.0))


def spread_boxes(
    values: NDArray[np.inexact], box: int, shape: tuple[int, int]
) -> NDArray[np.inexact]:
    """Interpolate values of boxes to every pixel, between their centres."""
    down, right = (_between(box, n, m) for n, m in zip(values.shape, shape, strict=True))
    return np.asarray(down @ values @ right.T)


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
def sum_pixels(  # type: ignore[no-untyped-def]
    power, used, saturated, ground_range, field, per_pixel, edges, bins
):
    """Sum the used pixels over bins of phase, in blocks of range between edges.

    `field` and `per_pixel` are as for :func:`phase_at`. Return the block of each pixel, -1
    where not used, and (blocks, bins) each: the number of pixels, that of those not saturated, and
    the sums of intensity, phase from the bin's middle (cycles) and ground range.
    """
    rows, columns = power.shape
    blocks, b = edges.size - 1, 0
    shape = blocks, bins
    count, clear, total = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    offset, reaches = np.zeros(shape), np.zeros(shape)
    block = np.full(power.shape, -1, np.int64)
    for i in range(rows):
        for j in range(columns):
            if not used[i, j]:
                continue
            cycles = phase_at(i, j, power.shape, field, per_pixel)
            k = min(int(cycles * bins), bins - 1)
            reach = ground_range[i, j]
            while b + 1 < blocks and edges[b + 1] <= reach:
                b += 1
            while b > 0 and edges[b] > reach:
                b -= 1
            count[b, k] += 1.0
            clear[b, k] += 0.0 if saturated[i, j] else 1.0
            total[b, k] += power[i, j]
            offset[b, k] += cycles - (k + 0.5) / bins
            reaches[b, k] += reach
            block[i, j] = b
    return block, count, clear, total, offset, reaches


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
