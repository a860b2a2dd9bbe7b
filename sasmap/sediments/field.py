"""Compiled Potts field of a class map: shares of classes by mean field, tile by tile."""

from __future__ import annotations

import numba
import numpy as np

# Side in pixels of the tiles that are updated or, where nothing near them has changed, skipped.
TILE = 8
# Change of a share above which a tile and its neighbours are updated again.
STILL = 1e-2
# Share above which a class is taken as certain.
SURE = 0.999
# Nats relative to the likeliest class below which a share is negligible.
DEEPEST = np.float32(-16.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def table_sums(logs, table, low, step, weight, result, seen):  # type: ignore[no-untyped-def]
    """Add each class's tabulated log density to its log likelihood, linear between entries.

    Parameters
    ----------
    logs : ndarray (rows, columns)
        Log amplitudes; not finite where there is none.
    table : ndarray (classes, entries)
        Log densities at `low`, `low + step`, ...; constant beyond the ends.
    low, step : float
    weight : float
        Factor of each log density.
    result : ndarray (classes, rows, columns)
        Added to in place.
    seen : ndarray of bool (rows, columns)
        Set to True where there is an amplitude.
    """
    last = table.shape[1] - 1
    for r in range(logs.shape[0]):
        for c in range(logs.shape[1]):
            if not np.isfinite(logs[r, c]):
                continue
            seen[r, c] = True
            place = min(max((logs[r, c] - low) / step, 0.0), float(last))
            k = min(int(place), last - 1)
            part = place - k
            for i in range(table.shape[0]):
                value = table[i, k] + part * (table[i, k + 1] - table[i, k])
                result[i, r, c] += weight * value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def window_sums(level, width, result):  # type: ignore[no-untyped-def]
    """Sum each class over square windows of odd width, cropped at the edges."""
    classes, rows, columns = level.shape
    sums = np.empty((rows, columns))
    for k in range(classes):
        _sum_boxes(level[k], (0, rows, 0, columns), width // 2, sums)
        result[k] = sums


@numba.njit(cache=True, nogil=True, error_model="numpy")
def window_means(values, there, width, result):  # type: ignore[no-untyped-def]
    """Average each class over square windows of odd width, from and at marked pixels only.

    Parameters
    ----------
    values : ndarray (classes, rows, columns)
    there : ndarray of bool (rows, columns)
    width : int
    result : ndarray (classes, rows, columns)
        Overwritten where `there`.
    """
    classes, rows, columns = values.shape
    box = (0, rows, 0, columns)
    count, sums = np.empty((rows, columns)), np.empty((rows, columns))
    _sum_boxes(there.astype(np.float32), box, width // 2, count)
    masked = np.empty((rows, columns), np.float32)
    for k in range(classes):
        for r in range(rows):
            for c in range(columns):
                masked[r, c] = values[k, r, c] if there[r, c] else np.float32(0.0)
        _sum_boxes(masked, box, width // 2, sums)
        for r in range(rows):
            for c in range(columns):
                if there[r, c]:
                    result[k, r, c] = sums[r, c] / count[r, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def softmax(level, seen):  # type: ignore[no-untyped-def]
    """Convert log weights of classes to their shares, in place; 0 where nothing is seen.

    Parameters
    ----------
    level : ndarray of float32 (classes, rows, columns)
    seen : ndarray of bool (rows, columns)
    """
    classes, rows, columns = level.shape
    top, mass = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for r in range(rows):
        top[:] = level[0, r]
        for k in range(1, classes):
            for c in range(columns):
                top[c] = max(top[c], level[k, r, c])
        mass[:] = 0.0
        for k in range(classes):
            _exponentials(level[k, r], top, mass)
        for k in range(classes):
            for c in range(columns):
                level[k, r, c] = level[k, r, c] / mass[c] if seen[r, c] else np.float32(0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mean_field(level, seen, share, window, strength, rounds):  # type: ignore[no-untyped-def]
    """Update shares of classes until they converge (Potts field, mean-field equations).

    Parameters
    ----------
    level : ndarray (classes, rows, columns)
        Log likelihoods.
    seen : ndarray of bool (rows, columns)
        Pixels that count.
    share : ndarray of float32 (classes, rows, columns)
        First guess, 0 where not seen; changed in place.
    window : int
        Side of a neighbourhood in pixels, odd.
    strength : float
        Nats where all neighbours agree.
    rounds : int
        Maximum number of iterations.
    """
    rows, columns = seen.shape
    down, across = (rows + TILE - 1) // TILE, (columns + TILE - 1) // TILE
    moved = np.zeros((down, across), np.bool_)
    for i in range(down):
        for j in range(across):
            top, bottom, left, right = _box(i, j, j + 1, rows, columns)
            part = share[:, top:bottom, left:right]
            moved[i, j] = _doubtful(part, seen[top:bottom, left:right])
    old = share.copy()
    for _ in range(rounds):
        runs = _runs(_spread(moved))
        moved[:] = False
        for i, first, last in runs:
            box = _box(i, first, last, rows, columns)
            _update(level, seen, old, share, box, window // 2, strength, moved[i, first:last])
        if not moved.any():
            return
        for i, first, last in runs:
            top, bottom, left, right = _box(i, first, last, rows, columns)
            for k in range(len(level)):
                for r in range(top, bottom):
                    old[k, r, left:right] = share[k, r, left:right]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def likeliest(share, seen):  # type: ignore[no-untyped-def]
    """Choose the class of the highest share at each pixel.

    Parameters
    ----------
    share : ndarray of float32 (classes, rows, columns)
    seen : ndarray of bool (rows, columns)
        Pixels that count.

    Returns
    -------
    label : ndarray of uint8 (rows, columns)
        From 1; 0 where not seen.
    highest : ndarray of float32 (rows, columns)
    """
    classes, rows, columns = share.shape
    label, highest = np.zeros((rows, columns), np.uint8), share[0].copy()
    for r in range(rows):
        for k in range(classes):
            for c in range(columns):
                if seen[r, c] and (k == 0 or share[k, r, c] > highest[r, c]):
                    label[r, c], highest[r, c] = k + 1, share[k, r, c]
    return label, highest


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _runs(active):  # type: ignore[no-untyped-def]
    """Row, start and end of each run of active tiles."""
    runs = [(0, 0, 0)]
    for i in range(active.shape[0]):
        first = 0
        for j in range(active.shape[1] + 1):
            if j == active.shape[1] or not active[i, j]:
                if j > first:
                    runs.append((i, first, j))
                first = j + 1
    return runs[1:]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _box(i, first, last, rows, columns):  # type: ignore[no-untyped-def]
    """Bounding rows and columns, in pixels, of a run of tiles."""
    return i * TILE, min((i + 1) * TILE, rows), first * TILE, min(last * TILE, columns)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spread(moved):  # type: ignore[no-untyped-def]
    """Mark tiles that have changed or lie beside one that has."""
    active = np.empty_like(moved)
    for i in range(moved.shape[0]):
        for j in range(moved.shape[1]):
            active[i, j] = moved[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].any()
    return active


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _doubtful(share, seen):  # type: ignore[no-untyped-def]
    """Whether a tile is not certainly all of one class."""
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
def _update(level, seen, old, share, box, half, strength, moved):  # type: ignore[no-untyped-def]
    """Update tiles' shares from the old ones around them; mark those that have changed.

    Works on rows in single precision, which the compiler vectorises.
    """
    top, bottom, left, right = box
    classes, rows, columns = level.shape
    width = right - left
    low, high = max(left - half, 0), min(right + half, columns)
    down = np.zeros((classes, width + 2 * half), np.float32)
    first = low - left + half
    for k in range(classes):
        for r in range(max(top - half, 0), min(top + half, rows)):
            _add(down[k, first : first + high - low], old[k, r, low:high], np.float32(1.0))
    sums = np.empty((classes, width), np.float32)
    change = np.zeros(width, np.float32)
    buffers = np.empty((3, width), np.float32)
    for r in range(top, bottom):
        for k in range(classes):
            _lowered(down[k, first : first + high - low], old[k], r, r > top, half, low)
            _widened(down[k], 2 * half + 1, sums[k])
        buffers[0], buffers[1] = np.float32(1e-6), np.float32(-3e38)
        buffers[2] = np.float32(0.0)
        for k in range(classes):
            _add(buffers[0], sums[k], np.float32(1.0))
        for k in range(classes):
            _raised(sums[k], level[k, r, left:right], np.float32(strength), buffers[0], buffers[1])
        for k in range(classes):
            _exponentials(sums[k], buffers[1], buffers[2])
        for k in range(classes):
            _settled(
                sums[k],
                buffers[2],
                seen[r, left:right],
                old[k, r, left:right],
                share[k, r, left:right],
                change,
            )
    for k in range(moved.size):
        moved[k] = moved[k] or change[k * TILE : (k + 1) * TILE].max() > STILL


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lowered(down, old, r, later, half, low):  # type: ignore[no-untyped-def]
    """Move column sums on to the next row: add a row, and drop one except on the first call."""
    high = low + down.size
    if r + half < len(old):
        _add(down, old[r + half, low:high], np.float32(1.0))
    if later and r - half - 1 >= 0:
        _add(down, old[r - half - 1, low:high], np.float32(-1.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _widened(down, width, sums):  # type: ignore[no-untyped-def]
    """Sum columns over windows."""
    sums[:] = down[: sums.size]
    for j in range(1, width):
        _add(sums, down[j : j + sums.size], np.float32(1.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add(sums, values, sign):  # type: ignore[no-untyped-def]
    """Add a row to another, or subtract it."""
    for c in range(sums.size):
        sums[c] += sign * values[c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _raised(sums, level, strength, total, top):  # type: ignore[no-untyped-def]
    """Convert sums of one class's shares to its log weight; keep the highest."""
    for c in range(sums.size):
        value = level[c] + strength * sums[c] / total[c]
        sums[c] = value
        top[c] = value if value > top[c] else top[c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _exponentials(logs, top, mass):  # type: ignore[no-untyped-def]
    """Convert log weights to unnormalised shares, and accumulate their sum.

    exp(x) is computed as (1 + x / 1024)^1024: accurate to 0.1 % where it matters.
    """
    for c in range(logs.size):
        x = logs[c] - top[c]
        x = x if x > DEEPEST else DEEPEST
        e = np.float32(1.0) + x * np.float32(1.0 / 1024.0)
        for _ in range(10):
            e = e * e
        logs[c] = e
        mass[c] += e


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _settled(values, mass, seen, old, share, change):  # type: ignore[no-untyped-def]
    """Write shares of one class, 0 where nothing is seen, and their largest change."""
    for c in range(values.size):
        value = values[c] / mass[c] if seen[c] else np.float32(0.0)
        away = abs(value - old[c])
        change[c] = away if away > change[c] else change[c]
        share[c] = value


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
