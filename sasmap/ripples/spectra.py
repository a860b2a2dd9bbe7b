"""Peaks of a clip's spectrum, and the evidence for each against spectra without one.

Amplitude over its trend is transformed, for the whole clip and for its parts, and its power is
summed over cells of wave vectors: a quarter octave of wavelength by twelve degrees. Ripples are a
peak in direction and in wavelength alike, however their crests bend, fork and end: a broad peak
where they do, a narrow one where they do not. The rivals have no such peak: texture and correlated
speckle have power in all directions; trends, edges, bands and grain have more at longer waves;
lines and objects as much at shorter ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft2
from scipy.ndimage import maximum_filter

from sasmap.ripples.image import Image

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# A clip must hold this many wavelengths, and a wavelength this many pixels, to show a ripple.
MIN_WAVES = 3.5
MIN_PIXELS = 4.0
# Larger amplitudes than this many times their trend count as this.
CAP = 3.5
# Cells of wave vectors: directions in half a turn, and cells an octave of wavelength.
DIRECTIONS, OCTAVE = 15, 4
# Directions from a peak on (of 12 degrees) and cells of wavelength (quarter octaves) that tell what
# power is there without it: beyond the reach of a peak whose crests fork every few wavelengths.
ASIDE, LONGER, SHORTER = 4, (4, 7), (-4, -2)
# Zeros added to a side of the image, over its length, and variance of a bin's power that the taper
# and they leave: independent bins over bins.
PADDING, INDEPENDENT = 1.3, 1.5
# Parts of a clip: half as long, at every quarter, where they have this many pixels a side.
MIN_PART, MIN_HALF = 80, 60
# Bins elsewhere that a level without a peak is known from, over a peak's; most bins of a peak (no
# spectrum is so smooth that more would tell more); a ratio beyond which nothing more is told.
REFERENCE, MOST_BINS, MOST = 2.0, 12.0, 300.0
# How uneven in direction grain makes the spectrum of a floor without ripples; power over that at
# shorter waves where there are none.
UNEVEN, NO_SHORTER = 1.3, 2.5
# Nats by which a rival may be further off than the likeliest and still count.
HEADWAY = 5.0
# Bins around a narrow peak that tell its level, and log of the bins that it is the highest of.
LINE_BINS, LINE_TRIALS = 12.0, 2.0
# Peaks of a part that are kept.
MOST_PEAKS = 6
# Evidence below which a peak is not looked at, valid share of a part, share of MIN_WAVES that a
# cell's middle may lie below, and reaches of a peak's centroid, of its wave vector.
WORTH, MIN_VALID, NEARLY, SPANS = 6.0, 0.4, 0.85, (0.3, 0.5)


@dataclass(frozen=True)
class Cells:
    """Cells of wave vectors of a transform of a given shape.

    Attributes
    ----------
    order : ndarray (bins,)
        Places of the bins of the half plane in the transform, cell by cell.
    first : ndarray (cells,)
        Where each filled cell begins in `order`.
    filled : ndarray (cells,)
        Its place among all cells (wavelengths x directions).
    count : ndarray (wavelengths, directions)
        Bins.
    """

    order: NDArray[np.int64]
    first: NDArray[np.int64]
    filled: NDArray[np.int64]
    count: FloatArray


@lru_cache(maxsize=16)
def _cells(shape: tuple[int, int], full: tuple[int, int]) -> Cells:
    """Sort the bins of a transform (of zero-padded size `full`) into cells."""
    down, right = np.fft.fftfreq(full[0])[:, None], np.fft.rfftfreq(full[1])
    length = 1 / np.maximum(np.hypot(down, right), 1e-9)
    number = np.floor(np.log2(length / MIN_PIXELS) * OCTAVE + 0.5).astype(np.int64)
    turn = np.arctan2(down + 0 * right, right + 0 * down)
    direction = np.floor(turn / np.pi * DIRECTIONS + 0.5).astype(np.int64) % DIRECTIONS
    lengths = int(np.ceil(np.log2(1.3 * max(shape) / MIN_PIXELS) * OCTAVE))
    used = (number >= 0) & (number < lengths)
    used[full[0] // 2 + 1 :, 0] = False  # the mirror image of the other half of this column
    cell = (number * DIRECTIONS + direction)[used]
    by_cell = np.argsort(cell, kind="stable")
    filled, first = np.unique(cell[by_cell], return_index=True)
    count = np.bincount(cell, minlength=lengths * DIRECTIONS).reshape(lengths, DIRECTIONS)
    return Cells(np.flatnonzero(used)[by_cell], first, filled, count.astype(float))


class Table(NamedTuple):
    """Power of cells of wave vectors, (wavelengths, directions) each.

    Attributes
    ----------
    level : ndarray
        Mean power around each cell, over the variance of white noise.
    bins : ndarray
        Independent bins that it rests on.
    aside, longer, shorter : ndarray
        Mean power at other directions, longer and shorter waves.
    narrow : ndarray
        Highest bin around each cell.
    power : ndarray
        The transform's.
    full : tuple of int
        Its size.
    """

    level: FloatArray
    bins: FloatArray
    aside: FloatArray
    longer: FloatArray
    shorter: FloatArray
    narrow: FloatArray
    power: FloatArray
    full: tuple[int, int]


def taper(count: int) -> FloatArray:
    """Return the sine taper of a side of so many pixels."""
    return np.asarray(np.sin(np.pi * (np.arange(count) + 0.5) / count))


def _around(values: FloatArray) -> FloatArray:
    """Sum over three by three cells, half of the neighbours'; directions go round."""
    tall = np.pad(values, ((1, 1), (0, 0)))
    tall = 0.5 * tall[:-2] + tall[1:-1] + 0.5 * tall[2:]
    return np.asarray(0.5 * np.roll(tall, 1, 1) + tall + 0.5 * np.roll(tall, -1, 1))


def _turned(values: FloatArray, steps: range) -> FloatArray:
    """Sum over cells at other directions."""
    return np.asarray(sum(np.roll(values, step, axis=1) for step in steps))


def _shifted(values: FloatArray, steps: range) -> FloatArray:
    """Sum over cells at other wavelengths."""
    reach = max(abs(s) for s in steps)
    tall = np.pad(values, ((reach, reach), (0, 0)))
    rows = len(values)
    return np.asarray(sum(tall[reach + s : reach + s + rows] for s in steps))


def _mean(values: FloatArray, count: FloatArray) -> FloatArray:
    return np.asarray(values / np.maximum(count, 1e-9))


def _power(flat: FloatArray, valid: BoolArray) -> FloatArray:
    """Power of a tapered image's transform, zeros added, over the variance of white noise."""
    rows, columns = (taper(n) for n in flat.shape)
    full = [next_fast_len(int(PADDING * n), True) for n in flat.shape]
    tapered = (flat * rows[:, None] * columns).astype(np.float32)
    pixels = float((rows**2) @ valid @ (columns**2))
    return np.asarray(np.abs(rfft2(tapered, full)) ** 2 / max(pixels, 1e-9))


def _table(flat: FloatArray, valid: BoolArray) -> Table:
    """Transform a clip, or a part of one, and sum its power over cells."""
    full = tuple(next_fast_len(int(PADDING * n), True) for n in flat.shape)
    power = _power(flat, valid)
    cells = _cells((flat.shape[0], flat.shape[1]), (full[0], full[1]))
    by_cell = power.ravel()[cells.order]
    total, highest = (np.zeros(cells.count.shape) for _ in range(2))
    total.flat[cells.filled] = np.add.reduceat(by_cell, cells.first)
    highest.flat[cells.filled] = np.maximum.reduceat(by_cell, cells.first)
    near, far = range(-1, 2), range(ASIDE, DIRECTIONS - ASIDE + 1)
    total3, count3 = (_turned(v, near) for v in (total, cells.count))
    longer, shorter = (
        _mean(_shifted(total3, range(*steps)), _shifted(count3, range(*steps)))
        for steps in (LONGER, SHORTER)
    )
    wide = np.pad(highest, ((1, 1), (0, 0)))
    around = _around(cells.count)
    return Table(
        _mean(_around(total), around),
        around * flat.size / (full[0] * full[1] * INDEPENDENT),
        _mean(_turned(total, far), _turned(cells.count, far)),
        longer,
        shorter,
        np.asarray(maximum_filter(wide, 3, mode=("constant", "wrap"))[1:-1]),
        power,
        (full[0], full[1]),
    )


def smooth_trend(values: FloatArray, valid: NDArray[np.bool_]) -> FloatArray:
    """Polynomial of degree 4 in row and column through the means of 16 by 16 blocks.

    Parameters
    ----------
    values : ndarray (rows, columns)
        0 where not valid.
    valid : ndarray of bool (rows, columns)

    Returns
    -------
    ndarray (rows, columns)
        At least a tenth of the mean.
    """
    rows, columns = values.shape
    edges = [np.linspace(0, n, min(16, n) + 1).astype(int)[:-1] for n in values.shape]

    def blocks(values: FloatArray) -> FloatArray:
        return np.add.reduceat(np.add.reduceat(values, edges[0], axis=0), edges[1], axis=1)

    count = blocks(valid.astype(float))
    mean = blocks(values) / np.maximum(count, 1)
    used = count > 0.1 * count.max()
    y, x = ((np.append(e, n)[1:] + e - n) / n for e, n in ((edges[0], rows), (edges[1], columns)))
    degree = min(4, int(np.sqrt(used.sum())) - 1)
    terms = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    design = np.stack([np.multiply.outer(y**i, x**j)[used] for i, j in terms], axis=-1)
    weight = np.sqrt(count[used])
    fit = np.linalg.lstsq(design * weight[:, None], mean[used] * weight, rcond=None)[0]
    factors = np.zeros((degree + 1, degree + 1))
    for factor, (i, j) in zip(fit, terms, strict=True):
        factors[i, j] = factor
    powers = np.arange(degree + 1)
    row = ((2 * np.arange(rows) + 1 - rows) / rows)[:, None] ** powers
    column = ((2 * np.arange(columns) + 1 - columns) / columns)[:, None] ** powers
    return np.asarray(np.maximum(row @ factors @ column.T, 0.1 * float(values[valid].mean())))


def flattened(image: Image) -> tuple[FloatArray, FloatArray]:
    """Take trend and gains of pings off a clip's amplitude.

    Parameters
    ----------
    image : Image

    Returns
    -------
    flat : ndarray (rows, columns)
        Amplitude over its smooth trend and over the mean along each ping, less 1; 0 where not
        valid.
    gains : ndarray (pings,)
        The means, a pixel across the look each; 1 where there is none.
    """
    amplitude, valid = np.sqrt(image.power), image.valid
    level = np.minimum(amplitude / smooth_trend(amplitude, valid), CAP)
    look = image.look
    place = image.project(np.array([look[1], -look[0]])) / image.pixel_size
    ping = np.rint(place - place.min()).astype(np.int64)
    pixels = np.bincount(ping[valid])
    total = np.bincount(ping[valid], level[valid])
    mean = float(total.sum()) / max(int(pixels.sum()), 1)
    gains = np.where(pixels > 0, total / np.maximum(pixels, 1) / max(mean, 1e-9), 1.0)
    gains = np.asarray(np.clip(gains, 0.2, 5.0))
    padded = np.ones(int(ping.max()) + 1)
    padded[: gains.size] = gains
    level = level / padded[ping] / max(mean, 1e-9)
    return np.asarray(np.where(valid, level - level[valid].mean(), 0.0)), padded


class Peak(NamedTuple):
    """A peak among cells of wave vectors, of a clip or of a part of it.

    Attributes
    ----------
    per_pixel : ndarray (2,)
        Cycles a column and a row.
    evidence : float
        Log Bayes factor of a peak against a spectrum without one.
    waves : float
        Wavelengths that the part holds along it.
    energy : float
        Its power over the variance of white noise, times the share of the clip that the part is.
    above : float
        Share of its power that is not in other directions too.
    part : tuple of slice
        Rows and columns of the part.
    """

    per_pixel: FloatArray
    evidence: float
    waves: float
    energy: float
    above: float
    part: tuple[slice, slice]


def _over(bins: FloatArray, ratio: FloatArray) -> FloatArray:
    """Log Bayes factor of power `ratio` times what twice as many bins elsewhere have.

    Of exponential laws with a level of their own against one level, levels known by the bins alone
    (likelihood ratio of two Gamma laws).
    """
    both = REFERENCE + 1
    level = (ratio + REFERENCE) / both
    value = bins * (both * np.log(level) - np.log(np.maximum(ratio, 1e-9)))
    return np.asarray(np.where(ratio > 1, value, -value))


def _evidence(table: Table) -> FloatArray:
    """Log Bayes factor of a peak at each cell against spectra without one.

    A broad peak stands out of three spectra: that of texture, which has no direction, that of
    trends and edges, which grows with the wavelength, and that of lines and objects, which does not
    fall off at shorter waves. No one of them may count for much more than the least. A narrow one
    stands out of the highest.
    """
    bins = table.bins / (1 + table.bins / MOST_BINS)
    rivals = np.stack([table.aside * UNEVEN, table.longer, table.shorter])
    rivals[2] = np.where(rivals[2] > 0, rivals[2], table.level / NO_SHORTER)
    tiny = 1e-6 * max(float(table.level.max()), 1e-30)
    each = _over(bins, np.minimum(table.level / np.maximum(rivals, tiny), MOST))
    broad = np.minimum(each, each.min(axis=0) + HEADWAY).sum(axis=0)
    highest = np.maximum(rivals.max(axis=0), tiny)
    ratio = np.minimum(table.narrow / highest, MOST)
    narrow = (1 + LINE_BINS) * np.log((ratio + LINE_BINS) / (1 + LINE_BINS)) - np.log(
        np.maximum(ratio, 1.0)
    )
    return np.asarray(np.maximum(broad, narrow - LINE_TRIALS))


def _peaks(flat: FloatArray, valid: BoolArray, part: tuple[slice, slice]) -> list[Peak]:
    """Find peaks of the spectrum of a part of a clip, the likeliest first."""
    part_valid = valid[part]
    share = float(part_valid.mean())
    if share < MIN_VALID:
        return []
    table = _table(flat[part], part_valid)
    evidence = _evidence(table)
    lengths, directions = table.level.shape
    rows, columns = part_valid.shape
    wavelength = MIN_PIXELS * 2 ** (np.arange(lengths) / OCTAVE)[:, None]
    turn = np.arange(directions) * np.pi / directions
    waves = np.hypot(columns * np.cos(turn), rows * np.sin(turn)) / wavelength
    top = maximum_filter(np.pad(table.level, ((1, 1), (0, 0))), 3, mode=("constant", "wrap"))[1:-1]
    tops = (table.level >= top) & (waves >= NEARLY * MIN_WAVES) & (evidence > WORTH)
    peaks = []
    for i, j in zip(*np.nonzero(tops), strict=True):
        per_pixel = np.array([np.cos(turn[j]), np.sin(turn[j])]) / wavelength[i, 0]
        for span in SPANS:
            per_pixel = _centroid(table, per_pixel, span)
        held = float(np.hypot(per_pixel[0] * columns, per_pixel[1] * rows))
        energy = float(table.level[i, j] * table.bins[i, j]) * share * part_valid.size / valid.size
        if held >= MIN_WAVES and MIN_PIXELS * np.hypot(*per_pixel) <= 1:
            above = max(1 - float(table.aside[i, j] / table.level[i, j]), 0.0)
            peaks.append(Peak(per_pixel, float(evidence[i, j]), held, energy, above, part))
    return sorted(peaks, key=lambda p: -p.evidence)[:MOST_PEAKS]


def _centroid(table: Table, per_pixel: FloatArray, span: float) -> FloatArray:
    """Centre of the squared power around a wave, cycles a column and a row.

    `span` is how far around, over the wave number: crests that bend and fork spread power.
    """
    rows, columns = table.full
    reach = span * float(np.hypot(*per_pixel))
    sides = zip((columns, rows), per_pixel, strict=True)
    right, down = (
        np.arange(int(np.floor(n * (m - reach))), int(np.ceil(n * (m + reach))) + 1)
        for n, m in sides
    )
    # of a real image's transform, the half plane that was not computed is the other one turned
    mirrored = np.where(right < 0, -1, 1)
    power = table.power[
        (mirrored * down[:, None]) % rows, np.minimum(np.abs(right), table.power.shape[1] - 1)
    ]
    east, north = right / columns, down[:, None] / rows
    near = np.hypot(east - per_pixel[0], north - per_pixel[1]) <= reach
    weight = np.where(near, power, 0.0) ** 2
    total = max(float(weight.sum()), 1e-300)
    return np.array([float((weight * v).sum()) / total for v in (east, north)])


def _parts(shape: tuple[int, int]) -> list[tuple[slice, slice]]:
    """Rows and columns of the whole, of halves and of quarters of a clip, at every quarter.

    Halves of large clips are left out: their quarters hold enough waves.
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


def clip_peaks(flat: FloatArray, valid: BoolArray) -> list[Peak]:
    """Find the peaks of a clip's spectrum and of its parts', the whole's first.

    Parameters
    ----------
    flat : ndarray (rows, columns)
        Amplitude over its trend, less 1; 0 where not valid.
    valid : ndarray of bool (rows, columns)

    Returns
    -------
    list of Peak
    """
    shape = flat.shape[0], flat.shape[1]
    return [peak for part in _parts(shape) for peak in _peaks(flat, valid, part)]
