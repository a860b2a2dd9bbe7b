"""Compiled Potts field of a class map: shares of classes by mean field, tile by tile."""

from __future__ import annotations

import numba
import numpy as np

# Pixels a side of the tiles that are updated or, where nothing near them has changed, left alone.
TILE = 32
# Change of a share that keeps a tile and its neighbours in play.
STILL = 1e-2
# Share from which a class is beyond doubt.
SURE = 0.999
# Entries a nat of the table of powers.
FINE = 64


@numba.njit(cache=True, nogil=True, error_model="numpy")
def table_sums(logs, where, table, low, step, weight, result):  # type: ignore[no-untyped-def]
    """Add to each class's log likelihood what its table gives, linear between entries.

    Parameters
    ----------
    logs : ndarray (n,)
        Log amplitudes.
    where : ndarray of int (n,)
        Pixel of each.
    table : ndarray (classes, entries)
        Log densities at `low`, `low + step`, ...; the first and last hold beyond the ends.
    low, step : float
    weight : float
        Of each.
    result : ndarray (classes, pixels)
        Added to.
    """
    last = table.shape[1] - 1
    for i in range(logs.size):
        place = min(max((logs[i] - low) / step, 0.0), float(last))
        k = min(int(place), last - 1)
        part = place - k
        for c in range(table.shape[0]):
            value = table[c, k] + part * (table[c, k + 1] - table[c, k])
            result[c, where[i]] += weight * value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def window_sums(level, width, result):  # type: ignore[no-untyped-def]
    """Sum each class over square windows of odd width, those at the edges cut off."""
    classes, rows, columns = level.shape
    sums = np.empty((rows, columns))
    for k in range(classes):
        _sum_boxes(level[k], (0, rows, 0, columns), width // 2, sums)
        result[k] = sums


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mean_field(level, seen, share, window, strength, rounds):  # type: ignore[no-untyped-def]
    """Update shares of classes until nothing moves (Potts field, mean-field equations).

    Parameters
    ----------
    level : ndarray (classes, rows, columns)
        Log likelihoods.
    seen : ndarray of bool (rows, columns)
        Pixels that count.
    share : ndarray of float32 (classes, rows, columns)
        First guess, 0 where not seen; changed in place.
    window : int
        Pixels a side of a neighbourhood, odd.
    strength : float
        Nats where all neighbours agree.
    rounds : int
        At most.
    """
    rows, columns = seen.shape
    down, across = (rows + TILE - 1) // TILE, (columns + TILE - 1) // TILE
    moved = np.zeros((down, across), np.bool_)
    for i in range(down):
        for j in range(across):
            top, bottom, left, right = _box(i, j, rows, columns)
            part = share[:, top:bottom, left:right]
            moved[i, j] = _doubtful(part, seen[top:bottom, left:right])
    powers = np.exp(-np.arange(16 * FINE) / FINE)
    old = share.copy()
    for _ in range(rounds):
        active = _spread(moved)
        moved[:] = False
        for i, j in np.argwhere(active):
            box = _box(i, j, rows, columns)
            moved[i, j] = _update(level, seen, old, share, box, window // 2, strength, powers)
        if not moved.any():
            return
        for i, j in np.argwhere(active):
            top, bottom, left, right = _box(i, j, rows, columns)
            old[:, top:bottom, left:right] = share[:, top:bottom, left:right]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _box(i, j, rows, columns):  # type: ignore[no-untyped-def]
    """First and last rows and columns of a tile."""
    return i * TILE, min((i + 1) * TILE, rows), j * TILE, min((j + 1) * TILE, columns)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spread(moved):  # type: ignore[no-untyped-def]
    """Tiles that have moved or lie beside one that has."""
    active = np.empty_like(moved)
    for i in range(moved.shape[0]):
        for j in range(moved.shape[1]):
            active[i, j] = moved[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].any()
    return active


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _doubtful(share, seen):  # type: ignore[no-untyped-def]
    """Whether a tile is not all one class beyond doubt."""
    _, rows, columns = share.shape
    sure = np.int64(-1)
    for r in range(rows):
        for c in range(columns):
            if seen[r, c]:
                if sure < 0:
                    sure = np.argmax(share[:, r, c])
                if share[sure, r, c] < SURE:
                    return True
    return False


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _update(level, seen, old, share, box, half, strength, powers):  # type: ignore[no-untyped-def]
    """Update one tile's shares from the old ones around it; whether any has moved."""
    top, bottom, left, right = box
    classes = level.shape[0]
    sums = np.zeros((classes, bottom - top, right - left))
    for k in range(classes):
        _sum_boxes(old[k], box, half, sums[k])
    moved = False
    logs = np.empty(classes)
    for r in range(bottom - top):
        for c in range(right - left):
            if not seen[top + r, left + c]:
                continue
            total = 1e-6
            for k in range(classes):
                total += sums[k, r, c]
            highest = -np.inf
            for k in range(classes):
                logs[k] = level[k, top + r, left + c] + strength * sums[k, r, c] / total
                highest = max(highest, logs[k])
            mass = 0.0
            for k in range(classes):
                place = FINE * (highest - logs[k])
                j = int(place)
                if j < powers.size - 1:
                    logs[k] = powers[j] + (place - j) * (powers[j + 1] - powers[j])
                    mass += logs[k]
                else:
                    logs[k] = 0.0
            for k in range(classes):
                value = logs[k] / mass
                moved = moved or abs(value - old[k, top + r, left + c]) > STILL
                share[k, top + r, left + c] = value
    return moved


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sum_boxes(values, box, half, result):  # type: ignore[no-untyped-def]
    """Sum the values around each pixel of a box."""
    top, bottom, left, right = box
    rows, columns = values.shape
    low, high = max(left - half, 0), min(right + half, columns)
    down = np.zeros(high - low)
    first = max(top - half, 0)
    for r in range(first, min(top + half, rows)):
        down += values[r, low:high]
    for r in range(top, bottom):
        if r + half < rows:
            down += values[r + half, low:high]
        if r - half - 1 >= first:
            down -= values[r - half - 1, low:high]
        total = 0.0
        for c in range(low, min(left + half, columns)):
            total += down[c - low]
        for c in range(left, right):
            if c + half < columns:
                total += down[c + half - low]
            if c - half - 1 >= low:
                total -= down[c - half - 1 - low]
            result[r - top, c - left] = total
