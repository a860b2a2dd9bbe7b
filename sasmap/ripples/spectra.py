"""Peaks of a clip's spectrum, and the evidence for each against smooth spectra.

Amplitude over its trend is transformed, for the whole clip and for its parts, and its power is
summed over cells of wave vectors: a quarter octave of wavelength by twelve degrees. Ripples are a
peak in both direction and wavelength, broad where their crests bend, fork and end, narrow where
they do not. The alternatives have no such peak: texture and correlated speckle have power in all
directions, relief without a direction in all but those across the look; trends, edges, bands and
grain have more at longer wavelengths; lines and objects have as much at shorter ones. Constants
without another source were set with pipelines/ripples/presence.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft2
from scipy.ndimage import maximum_filter

from sasmap.arrays import BoolArray, FloatArray

Part = tuple[slice, slice]

# Fewest wavelengths per clip, and pixels per wavelength, for ripples to be detected.
MIN_WAVES = 3.5
MIN_PIXELS = 4.0
# Cells of wave vectors: directions in half a turn, and cells per octave of wavelength.
DIRECTIONS, OCTAVE = 15, 4
# Distance from a peak, in directions (of 12 degrees) and in cells of wavelength (quarter octaves),
# of the cells that give the background level: beyond the width of a peak whose crests fork every
# few wavelengths.
ASIDE, LONGER, SHORTER = 4, (4, 7), (-4, -2)
# Half-width, in cells of wavelength and of direction, of the peak of a wave whose crests bend.
REACH = (2.0, 2.0)
# Padded over original side length of the image, and bins per independent bin after taper and
# padding (computed from the two).
PADDING, INDEPENDENT = 1.3, 1.5
# Least side length, in pixels, of the parts of a clip (half its sides, at every quarter), and of
# its halves.
MIN_PART, MIN_HALF = 80, 60
# Bins of the background level over those of the peak; most bins of a peak that count (no spectrum
# is smooth enough for more); largest ratio of power that counts.
REFERENCE, MOST_BINS, MOST = 2.0, 12.0, 300.0
# Anisotropy of the spectrum that grain causes without ripples; assumed ratio of power to that at
# shorter wavelengths where there are none to compare with.
UNEVEN, NO_SHORTER = 1.3, 2.5
# Squared cosine of the angle between normal and look below which relief hardly shows; least number
# of wavelengths along the look that the means of pings leave; least difference of the squared
# cosines that are compared (with 0.2 one in 150 more of crossing and forked ripples is missed).
ACROSS, TURNED, LEAST_RISE = 0.2, 1.5, 0.3
# Cap on the evidence against an alternative, above that against the best alternative, nats.
HEADWAY = 5.0
# Bins around a narrow peak that give its background level, and log of the number of bins that it is
# chosen from.
LINE_BINS, LINE_TRIALS = 12.0, 2.0
# Most peaks kept per part, to bound the time.
MOST_PEAKS = 6
# Least evidence of a peak, least valid share of a part, least number of wavelengths at a cell's
# centre over MIN_WAVES, and radii of the centroid of a peak over its wave number.
WORTH, MIN_VALID, NEARLY, SPANS = 6.0, 0.4, 0.85, (0.3, 0.5)


class Table(NamedTuple):
    """Power of cells of wave vectors of parts of one shape, (parts, wavelengths, directions) each.

    Attributes
    ----------
    level : ndarray
        Mean power around each cell, over the variance of white noise.
    bins : ndarray
        Number of independent bins in that mean.
    aside, longer, shorter : ndarray
        Power expected from that at other directions, and mean power at longer and at shorter
        wavelengths.
    narrow : ndarray
        Power of the highest bin around each cell.
    power : list of ndarray
        Power of the transforms.
    full : tuple of int
        Size of the transforms.
    flank : ndarray of bool
        Whether no cell around, outside the peak of a known wave, has more power than all of its own
        neighbours: an edge of the ripples and heights that vary raise the flanks of their peak.
    """

    level: FloatArray
    bins: FloatArray
    aside: FloatArray
    longer: FloatArray
    shorter: FloatArray
    narrow: FloatArray
    power: list[NDArray[np.float32]]
    full: tuple[int, int]
    flank: BoolArray


def taper(count: int) -> FloatArray:
    """Return a sine taper of `count` pixels."""
    return np.asarray(np.sin(np.pi * (np.arange(count) + 0.5) / count))


@lru_cache(maxsize=64)
def _ring(steps: tuple[tuple[int, float], ...]) -> FloatArray:
    """Matrix (directions, directions) that sums a table over directions, periodically."""
    return np.asarray(sum(w * np.roll(np.eye(DIRECTIONS), k, axis=1) for k, w in steps))


@lru_cache(maxsize=64)
def _ladder(lengths: int, steps: tuple[tuple[int, float], ...]) -> FloatArray:
    """Matrix (lengths, lengths) that sums a table over wavelengths, weighted."""
    return np.asarray(sum(w * np.eye(lengths, k=k) for k, w in steps))


def _all(first: int, last: int) -> tuple[tuple[int, float], ...]:
    return tuple((k, 1.0) for k in range(first, last))


# Weights of sums over each cell and its neighbours (at half weight), over neighbouring directions,
# and over the other directions.
_SOFT = ((-1, 0.5), (0, 1.0), (1, 0.5))
_NEAR, _ASIDE = _all(-1, 2), _all(ASIDE, DIRECTIONS - ASIDE + 1)


def _mean(values: FloatArray, count: FloatArray) -> FloatArray:
    return np.asarray(values / np.maximum(count, 1e-9))


def _highest_around(values: FloatArray) -> FloatArray:
    """Maximum over three by three cells; directions are periodic."""
    return np.asarray(maximum_filter(values, (1, 3, 3), mode=("nearest", "nearest", "wrap")))


@lru_cache(maxsize=16)
def _cells(shape: tuple[int, int], full: tuple[int, int]) -> tuple[NDArray[np.int32], FloatArray]:
    """Sort the bins of a transform (of zero-padded size `full`) into cells of wave vectors.

    Returns each bin's cell, -1 for none, and the number of bins of each (wavelengths, directions).
    """
    down, right = np.fft.fftfreq(full[0])[:, None], np.fft.rfftfreq(full[1])
    length = 1 / np.maximum(np.hypot(down, right), 1e-9)
    number = np.floor(np.log2(length / MIN_PIXELS) * OCTAVE + 0.5).astype(np.int64)
    turn = np.arctan2(down + 0 * right, right + 0 * down)
    direction = np.floor(turn / np.pi * DIRECTIONS + 0.5).astype(np.int64) % DIRECTIONS
    lengths = int(np.ceil(np.log2(1.3 * max(shape) / MIN_PIXELS) * OCTAVE))
    used = (number >= 0) & (number < lengths)
    used[full[0] // 2 + 1 :, 0] = False  # conjugates of the other half of this column
    cell = np.where(used, number * DIRECTIONS + direction, -1).astype(np.int32)
    counted = np.bincount(cell[used], minlength=lengths * DIRECTIONS)
    return cell, counted.reshape(lengths, DIRECTIONS).astype(float)


def _transform(flat: FloatArray, valid: BoolArray, full: tuple[int, int]) -> NDArray[np.complex64]:
    """Transform a tapered, padded image, scaled so that white noise has its variance as power."""
    rows, columns = (taper(n) for n in flat.shape)
    pixels = float((rows**2) @ (valid @ (columns**2)))
    rows = rows / np.sqrt(max(pixels, 1e-9))
    tapered = (flat * rows[:, None] * columns).astype(np.float32)
    return np.asarray(rfft2(tapered, full))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cell_sums(spectrum, cell, cells):  # type: ignore[no-untyped-def]
    """Power of a transform, and its sum and maximum over cells (-1: none)."""
    rows, columns = spectrum.shape
    power = np.empty((rows, columns), np.float32)
    total, highest = np.zeros(cells), np.zeros(cells)
    for i in range(rows):
        for j in range(columns):
            value = spectrum[i, j].real ** 2 + spectrum[i, j].imag ** 2
            power[i, j] = value
            k = cell[i, j]
            if k >= 0:
                total[k] += value
                highest[k] = max(highest[k], value)
    return power, total, highest


def _apart(shape: tuple[int, ...], known: FloatArray) -> FloatArray:
    """Mask of cells (wavelengths, directions): 1 outside the peak of a known wave, 0 within it."""
    length = np.log2(1 / (float(np.hypot(*known)) * MIN_PIXELS)) * OCTAVE
    turn = np.arctan2(known[1], known[0]) / np.pi * DIRECTIONS
    direction = np.abs((np.arange(shape[1]) - turn + DIRECTIONS / 2) % DIRECTIONS - DIRECTIONS / 2)
    reached = np.abs(np.arange(shape[0])[:, None] - length) <= REACH[0]
    return np.asarray(1.0 - (reached & (direction <= REACH[1])))


def _wavelengths(lengths: int) -> FloatArray:
    """Wavelengths of cells (lengths, 1), pixels."""
    return np.asarray(MIN_PIXELS * 2 ** (np.arange(lengths) / OCTAVE)[:, None])


def _relief(
    total: FloatArray,
    count: FloatArray,
    aside: FloatArray,
    look: FloatArray,
    shape: tuple[int, int],
) -> FloatArray:
    """Power of relief that has no direction, from that at other directions (`aside`).

    Seen from the side, slopes towards the sonar show and slopes across the look do not: above the
    speckle, power follows the squared cosine of the angle between normal and look (`look` in
    pixels: columns, rows). It is compared with the power nearly across the look, but for waves that
    hardly turn along it, of which the means of pings have taken the power.
    """
    turn = np.arctan2(look[1], look[0]) - np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    shown = np.cos(turn) ** 2
    extent = float(np.abs(look) @ shape[::-1]) / float(np.hypot(*look))
    waves = extent / _wavelengths(len(count)) * np.abs(np.cos(turn))
    used, soft = (shown < ACROSS) & (waves > TURNED), _ladder(len(count), _SOFT)
    power, bins, seen = (
        (soft @ (v * used)).sum(axis=-1, keepdims=True) for v in (total, count, count * shown)
    )
    there = _mean((count * shown) @ _ring(_ASIDE), count @ _ring(_ASIDE))
    dark, level = _mean(seen, bins), np.minimum(_mean(power, bins), aside)
    rise = (aside - level) / np.maximum(there - dark, LEAST_RISE)
    return np.asarray(np.where(bins > 0, level + rise * (shown - dark), aside))


def _table(
    flat: FloatArray,
    valid: BoolArray,
    parts: list[Part],
    look: FloatArray,
    known: FloatArray | None = None,
) -> Table:
    """Transform parts of a clip, all of one shape, and sum their power over cells.

    `look` is the direction of the look in pixels: columns, rows.
    Cells within the peak of a known wave (cycles per column and row) are left out.
    """
    shape = flat[parts[0]].shape[0], flat[parts[0]].shape[1]
    rows, columns = (next_fast_len(int(PADDING * n), True) for n in shape)
    number, count = _cells(shape, (rows, columns))
    spectra = (_transform(flat[part], valid[part], (rows, columns)) for part in parts)
    summed = [_cell_sums(v, number, count.size) for v in spectra]
    power = [v[0] for v in summed]
    shown = len(parts), *count.shape
    total, highest = (np.reshape([v[k] for v in summed], shown) for k in (1, 2))
    lengths = len(count)
    soft = _ladder(lengths, _SOFT)
    flank = np.zeros(total.shape, bool)
    if known is not None:
        beside = _apart(count.shape, known)
        mean = _mean(total, count)
        flank = _highest_around(beside * (mean >= _highest_around(mean))) == 0
        count, total, highest = (v * beside for v in (count, total, highest))
        power = [v * beside.ravel()[number].astype(np.float32) for v in power]
    around = soft @ count @ _ring(_SOFT)
    bins = around * (shape[0] * shape[1] / (rows * columns * INDEPENDENT))
    level = _mean(soft @ total @ _ring(_SOFT), around)
    aside = _mean(total @ _ring(_ASIDE), count @ _ring(_ASIDE))
    near, near_count = total @ _ring(_NEAR), count @ _ring(_NEAR)
    expected = np.maximum(aside * UNEVEN, _relief(total, count, aside, look, shape))
    longer, shorter = (
        _mean(_ladder(lengths, steps) @ near, _ladder(lengths, steps) @ near_count)
        for steps in (_all(*LONGER), _all(*SHORTER))
    )
    return Table(
        level,
        np.broadcast_to(bins, total.shape),
        expected,
        longer if known is None else np.where(longer > 0, longer, aside),
        shorter,
        _highest_around(highest),
        power,
        (rows, columns),
        flank,
    )


class Peak(NamedTuple):
    """A peak among cells of wave vectors, of a clip or of a part of it.

    Attributes
    ----------
    per_pixel : ndarray (2,)
        Cycles per column and row.
    evidence : float
        Log likelihood ratio of a peak against a spectrum without one.
    waves : float
        Number of wavelengths in the part.
    energy : float
        Its mean power (white noise has its variance) times its number of independent bins, times
        the part's share of the clip.
    above : float
        Share of its power above that expected from other directions.
    part : tuple of slice
        Rows and columns of the part.
    """

    per_pixel: FloatArray
    evidence: float
    waves: float
    energy: float
    above: float
    part: Part


def _over(bins: FloatArray, ratio: FloatArray) -> FloatArray:
    """Log likelihood ratio for power `ratio` times the level of REFERENCE times as many bins.

    Power is exponentially distributed; separate levels, both estimated, are compared with a common
    one (likelihood ratio of two gamma distributions).
    """
    both = REFERENCE + 1
    level = (ratio + REFERENCE) / both
    value = bins * (both * np.log(level) - np.log(np.maximum(ratio, 1e-9)))
    return np.asarray(np.where(ratio > 1, value, -value))


def _evidence(table: Table) -> FloatArray:
    """Log likelihood ratio of a peak at each cell against spectra without one.

    A broad peak is compared with three spectra: that of texture, which has no direction, that of
    trends and edges, which grows with wavelength, and that of lines and objects, which does not
    fall off at shorter wavelengths. The three are added, each capped at HEADWAY above the least. A
    narrow peak is compared with the highest of the three spectra.
    """
    bins = table.bins / (1 + table.bins / MOST_BINS)
    rivals = np.stack([table.aside, table.longer, table.shorter])
    rivals[2] = np.where(rivals[2] > 0, rivals[2], table.level / NO_SHORTER)
    tiny = 1e-6 * np.maximum(table.level.max(axis=(1, 2), keepdims=True), 1e-30)
    each = _over(bins, np.minimum(table.level / np.maximum(rivals, tiny), MOST))
    broad = np.minimum(each, each.min(axis=0) + HEADWAY).sum(axis=0)
    highest = np.maximum(rivals.max(axis=0), tiny)
    ratio = np.minimum(table.narrow / highest, MOST)
    narrow = (1 + LINE_BINS) * np.log((ratio + LINE_BINS) / (1 + LINE_BINS)) - np.log(
        np.maximum(ratio, 1.0)
    )
    return np.asarray(np.maximum(broad, narrow - LINE_TRIALS))


def _peaks(
    flat: FloatArray,
    valid: BoolArray,
    parts: list[Part],
    look: FloatArray,
    known: FloatArray | None = None,
) -> Iterator[list[Peak]]:
    """Find peaks of the spectra of a clip's parts of one shape, the likeliest first."""
    table = _table(flat, valid, parts, look, known)
    evidence = _evidence(table)
    lengths, directions = table.level.shape[1:]
    rows, columns = flat[parts[0]].shape
    wavelength = _wavelengths(lengths)
    turn = np.arange(directions) * np.pi / directions
    waves = np.hypot(columns * np.cos(turn), rows * np.sin(turn)) / wavelength
    tops = (table.level >= _highest_around(table.level)) & (evidence > WORTH) & ~table.flank
    tops &= waves >= NEARLY * MIN_WAVES
    for k, part in enumerate(parts):
        share = float(valid[part].sum()) / valid.size
        peaks = []
        for i, j in zip(*np.nonzero(tops[k]), strict=True):
            per_pixel = np.array([np.cos(turn[j]), np.sin(turn[j])]) / wavelength[i, 0]
            for span in SPANS:
                per_pixel = _centroid(table.power[k], table.full, per_pixel, span)
            held = float(np.hypot(per_pixel[0] * columns, per_pixel[1] * rows))
            if held < MIN_WAVES or MIN_PIXELS * np.hypot(*per_pixel) > 1:
                continue
            level = float(table.level[k, i, j])
            energy = level * float(table.bins[k, i, j]) * share
            above = max(1 - float(table.aside[k, i, j]) / level, 0.0)
            peaks.append(Peak(per_pixel, float(evidence[k, i, j]), held, energy, above, part))
        yield sorted(peaks, key=lambda p: -p.evidence)[:MOST_PEAKS]


def _centroid(
    power: NDArray[np.float32], full: tuple[int, int], per_pixel: FloatArray, span: float
) -> FloatArray:
    """Centroid of the squared power around a wave, cycles per column and row.

    `span` is the radius of the region over the wave number: crests that bend and fork spread power.
    """
    rows, columns = full
    reach = span * float(np.hypot(*per_pixel))
    sides = zip((columns, rows), per_pixel, strict=True)
    right, down = (
        np.arange(int(np.floor(n * (m - reach))), int(np.ceil(n * (m + reach))) + 1)
        for n, m in sides
    )
    # the transform of a real image is symmetric: its other half plane was not computed
    mirrored = np.where(right < 0, -1, 1)
    here = power[(mirrored * down[:, None]) % rows, np.minimum(np.abs(right), power.shape[1] - 1)]
    east, north = right / columns, down[:, None] / rows
    near = np.hypot(east - per_pixel[0], north - per_pixel[1]) <= reach
    weight = np.where(near, here.astype(np.float64), 0.0) ** 2
    total = max(float(weight.sum()), 1e-300)
    return np.array([float((weight * v).sum()) / total for v in (east, north)])


def _parts(shape: tuple[int, int]) -> list[Part]:
    """Rows and columns of the whole, of halves and of quarters of a clip, at every quarter.

    Halves of large clips are left out: their quarters hold enough wavelengths.
    """

    def pieces(size: int) -> list[slice]:
        half = size // 2
        return [slice(k * size // 4, k * size // 4 + half) for k in range(3)]

    rows, columns = (pieces(n) for n in shape)
    whole = slice(0, shape[0]), slice(0, shape[1])
    parts = [whole]
    if 2 * MIN_HALF <= min(shape) < 4 * MIN_PART:
        parts += [(r, whole[1]) for r in rows] + [(whole[0], c) for c in columns]
    if min(shape) >= 2 * MIN_PART:
        parts += [(r, c) for r in rows for c in columns]
    return parts


def clip_peaks(flat: FloatArray, valid: BoolArray, look: FloatArray) -> list[Peak]:
    """Find the peaks of the spectra of a clip and of its parts, those of the whole first.

    Parameters
    ----------
    flat : ndarray (rows, columns)
        Amplitude over its trend, minus 1; 0 where not valid.
    valid : ndarray of bool (rows, columns)
    look : ndarray (2,)
        Direction of the look in pixels: columns, rows.
    """
    shape = flat.shape[0], flat.shape[1]
    groups: dict[tuple[int, int], list[Part]] = {}
    for part in _parts(shape):
        if valid[part].mean() >= MIN_VALID:
            rows, columns = (p.stop - p.start for p in part)
            groups.setdefault((rows, columns), []).append(part)
    return [
        peak
        for parts in groups.values()
        for found in _peaks(flat, valid, parts, look)
        for peak in found
    ]


def other_peaks(
    flat: FloatArray, valid: BoolArray, look: FloatArray, known: FloatArray
) -> list[Peak]:
    """Find the peaks of a clip's spectrum beside a known wave.

    Two systems of waves mask each other in the comparison with other directions and wavelengths.

    Parameters
    ----------
    flat : ndarray (rows, columns)
        Amplitude over its trend, minus 1; 0 where not valid.
    valid : ndarray of bool (rows, columns)
    look : ndarray (2,)
        Direction of the look in pixels: columns, rows.
    known : ndarray (2,)
        Cycles per column and row.

    Returns
    -------
    list of Peak
        The likeliest first, none within the peak of the known wave.
    """
    whole = slice(0, flat.shape[0]), slice(0, flat.shape[1])
    if valid.mean() < MIN_VALID:
        return []
    found = next(_peaks(flat, valid, [whole], look, known))
    return [peak for peak in found if not within_reach(peak.per_pixel, known)]


def within_reach(one: FloatArray, other: FloatArray) -> bool:
    """Whether a wave lies within the peak of another one whose crests bend.

    Parameters
    ----------
    one, other : ndarray (2,)
        Cycles per column and row.
    """
    ratio, cosine = compared(one, other)
    turn = np.arccos(cosine) / np.pi * DIRECTIONS
    return bool(abs(np.log2(ratio)) * OCTAVE <= REACH[0] and turn <= REACH[1])


def compared(one: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Ratio of the lengths of two wave vectors (2,), and cosine of the angle between them.

    The cosine is at least 0, as a wave has two vectors of opposite sign.
    """
    first, second = float(np.hypot(*one)), float(np.hypot(*other))
    return first / second, min(abs(float(one @ other)) / (first * second), 1.0)
