"""Is there a ripple in a clip at all? Narrow peaks of the whitened two-dimensional spectrum.

Amplitude over its trend is transformed; a ripple stands out of the spectrum around it (on its ring
and along its ray) beyond chance over all wave vectors searched, and its wave extends over several
wavelengths. Sediment, texture and correlated speckle raise whole rings, trends and edges whole
rays; an object has one place.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2
from scipy.ndimage import uniform_filter
from scipy.special import gammaincc

from sasmap.ripples.image import Image
from sasmap.ripples.pixels import wave_boxes

FloatArray = NDArray[np.float64]

# A clip must hold this many wavelengths, and a wavelength this many pixels, to show a ripple.
MIN_WAVES = 3.5
MIN_PIXELS = 4.0
FALSE_ALARM = 1e-8
# Boxes of the spectrum (bins a side) over which bent crests may spread: independent bins in them
# after a Hann taper, and how far above the spectrum around it each must stand.
BOXES = ((1, 1.0, 16.0), (3, 3.5, 8.5), (7, 15.0, 4.5))
# Share of that which is as likely a ripple as not.
ENOUGH = 0.7
# Waves as long as this share of the clip must stand as far above it as a single bin: there trends
# and edges have their power.
LONG_WAVES, LONG_PEAK = 7.0, 16.0
# Wavelengths along its normal that a wave must extend over (participation ratio of its energy).
MIN_EXTENT = 2.6
# Of a wave that extends over as many, and this share of the clip, the ray may hold so much more:
# crests that bend put power there, but an edge, a band or an object lies in one place.
WIDESPREAD, WIDESPREAD_SHARE, WIDESPREAD_RELIEF = 4.0, 0.45, 6.0
# Bins to which the lobe of a line reaches after a Hann taper.
LOBE = 2.1
# Larger amplitudes than this many times their trend count as this.
CAP = 3.5
CANDIDATES = 6
EULER = 0.5772156649015329


class Wave(NamedTuple):
    """A candidate wave.

    Attributes
    ----------
    vector : ndarray (2,)
        Wave vector (east, north), cycles/m.
    probability : float
        That it is a ripple.
    extent : float
        Wavelengths along its normal that it extends over.
    power : float
        Over the spectrum around it.
    energy : float
        Its periodogram.
    """

    vector: FloatArray
    probability: float
    extent: float
    power: float
    energy: float


@dataclass(frozen=True)
class Rings:
    """Rings of a spectrum of a given shape."""

    index: NDArray[np.int64]
    count: FloatArray
    radius: FloatArray


@dataclass(frozen=True)
class Spectrum:
    """Whitened spectrum of a clip.

    Attributes
    ----------
    power : ndarray (rows, columns)
        Periodogram, frequencies as `numpy.fft.fftfreq` orders them.
    white : ndarray (rows, columns)
        `power` over the geometric mean of its ring.
    frequency : ndarray (rows, columns)
        cycles/m.
    waves : ndarray (rows, columns)
        Wavelengths that the clip's valid part holds along each wave vector.
    plain : ndarray (rows, columns)
        Amplitude over its mean, less 1: with its trend.
    with_trend : ndarray (rows, columns)
        Periodogram of that.
    """

    power: FloatArray
    white: FloatArray
    frequency: FloatArray
    waves: FloatArray
    plain: FloatArray
    with_trend: FloatArray


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


def flattened(image: Image) -> FloatArray:
    """Amplitude over its smooth trend, less 1; 0 where not valid."""
    amplitude = np.sqrt(image.power)
    return _centred(amplitude / smooth_trend(amplitude, image.valid), image.valid)


def _centred(level: FloatArray, valid: NDArray[np.bool_]) -> FloatArray:
    """Level, at most CAP, less its mean; 0 where not valid."""
    capped = np.minimum(level, CAP)
    return np.asarray(np.where(valid, capped - capped[valid].mean(), 0.0))


def spectrum(image: Image) -> Spectrum | None:
    """Compute the whitened spectrum of a clip.

    Parameters
    ----------
    image : Image

    Returns
    -------
    Spectrum or None
        None where the clip is of one value.
    """
    flat = flattened(image)
    if not np.abs(flat).max() > 0:
        return None
    amplitude = np.sqrt(image.power)
    plain = _centred(amplitude / amplitude[image.valid].mean(), image.valid)
    taper = [np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2 for n in image.shape]
    # one transform of two real images
    both = fft2((flat + 1j * plain) * taper[0][:, None] * taper[1])
    turned = np.conj(np.roll(both[::-1, ::-1], 1, axis=(0, 1)))
    power, with_trend = (np.abs(0.5 * (both + sign * turned)) ** 2 for sign in (1, -1))
    rings = _rings(image.shape)
    level = np.bincount(rings.index.ravel(), np.log(power + 1e-300).ravel()) / rings.count
    white = power / np.exp(level + EULER)[rings.index]
    per_row, per_column = (np.fft.fftfreq(n) for n in image.shape)
    to_map = np.linalg.inv(image.steps)  # cycles/m (row vector) = cycles/pixel @ to_map
    east = per_column * to_map[0, 0] + per_row[:, None] * to_map[1, 0]
    north = per_column * to_map[0, 1] + per_row[:, None] * to_map[1, 1]
    rows, columns = np.nonzero(image.valid)
    extent = np.array([np.ptp(columns) + 1, np.ptp(rows) + 1])
    waves = np.hypot(per_column * extent[0], per_row[:, None] * extent[1])
    return Spectrum(power, white, np.hypot(east, north), waves, plain, with_trend)


@lru_cache(maxsize=8)
def _rings(shape: tuple[int, int]) -> Rings:
    """Rings a twelfth of their radius wide, at least two bins of the shorter side."""
    radius = np.hypot(np.fft.fftfreq(shape[1]), np.fft.fftfreq(shape[0])[:, None])
    step = 2.0 / min(shape)
    number = np.where(
        radius < 12 * step, radius / step, 12 + 12 * np.log(np.maximum(radius, 1e-9) / (12 * step))
    )
    index = np.floor(number).astype(np.int64)
    return Rings(index, np.maximum(np.bincount(index.ravel()), 1).astype(float), radius)


def find_waves(image: Image, found: Spectrum, bounds: tuple[float, float]) -> list[Wave] | None:
    """Return the candidate waves of a clip, the most likely ripple first.

    Parameters
    ----------
    image : Image
    found : Spectrum
    bounds : tuple of float
        Frequencies to search, cycles/m.

    Returns
    -------
    list of Wave or None
        Each half plane of wave vectors once; the strongest, of probability 0, where none is worth
        a closer look; None where the clip is too short or too coarse for any frequency within the
        bounds.
    """
    half = np.zeros(image.shape, bool)
    half[: image.shape[0] // 2 + 1, : image.shape[1] // 2 + 1] = True
    half[image.shape[0] // 2 + 1 :, 1 : image.shape[1] // 2 + 1] = True
    radius = _rings(image.shape).radius
    searched = half & (found.waves >= MIN_WAVES) & (radius * MIN_PIXELS <= 1)
    bin_half = 0.5 * found.frequency / np.maximum(found.waves, MIN_WAVES)
    searched &= found.frequency >= bounds[0] - bin_half
    searched &= found.frequency <= bounds[1] + bin_half
    if not searched.any():
        return None
    waves: list[Wave] = []
    extents: dict[tuple[float, float], float] = {}
    trials = float(searched.sum())
    strongest = np.where(searched, found.white, 0.0)
    for size, looks, enough in BOXES:
        smooth = uniform_filter(found.white, size, mode="wrap") if size > 1 else found.white
        score = np.where(searched, smooth, 0.0)
        for row, column in _tops(score, CANDIDATES):
            ratio = float(smooth[row, column])
            least = enough if found.waves[row, column] >= LONG_WAVES else LONG_PEAK
            chance = float(gammaincc(looks, looks * ratio)) * trials / looks
            if ratio < 0.5 * least or chance > 1:
                continue
            over_ray = _over_ray(found.with_trend, row, column, size)
            if WIDESPREAD_RELIEF * over_ray < 0.5 * least:
                continue
            peak = _peak(found.power, row, column, max(size, 3))
            vector, key = image.per_metre(peak), (float(peak[0]), float(peak[1]))
            if key not in extents:  # boxes of several sizes find the same peak
                extents[key] = _extent(image, found.plain, vector)
            extent = extents[key]
            if extent > max(WIDESPREAD_SHARE * found.waves[row, column], WIDESPREAD):
                over_ray *= WIDESPREAD_RELIEF
            around = min(ratio, over_ray)
            if around < 0.5 * least:
                continue
            energy = float(found.power[row, column])
            chance_of = _probability(chance, around / least, extent)
            waves.append(Wave(vector, chance_of, extent, float(ratio), energy))
    if not waves:
        row, column = (int(i) for i in np.unravel_index(int(strongest.argmax()), image.shape))
        vector = image.per_metre(_peak(found.power, row, column, 3))
        power, energy = float(strongest[row, column]), float(found.power[row, column])
        return [Wave(vector, 0.0, 0.0, power, energy)]
    return sorted(waves, key=lambda w: -w.probability * (1 + np.log1p(w.power)))


def _probability(chance: float, strength: float, extent: float) -> float:
    """Probability of a ripple: of its peak against chance, its strength and its extent."""
    odds = FALSE_ALARM / max(chance, 1e-12)
    gates = [1 / (1 + np.exp(-s)) for s in (16 * (strength - ENOUGH), 6 * (extent - MIN_EXTENT))]
    return float(odds / (1 + odds) * np.prod(gates))


def _tops(score: FloatArray, most: int) -> list[tuple[int, int]]:
    """Row and column of the highest places, each the highest of the bins around it."""
    left = score.copy()
    rows, columns = score.shape
    places = []
    for _ in range(most):
        row, column = np.unravel_index(int(np.argmax(left)), score.shape)
        if left[row, column] <= 0:
            break
        places.append((int(row), int(column)))
        reach = np.arange(-3, 4)
        left[np.ix_((row + reach) % rows, (column + reach) % columns)] = 0.0
    return places


def _over_ray(power: FloatArray, row: int, column: int, size: int) -> float:
    """Power of a peak (mean of a box) over that on the larger side along its ray."""
    rows, columns = power.shape
    wave = np.array(
        [
            row if row <= rows // 2 else row - rows,
            column if column <= columns // 2 else column - columns,
        ]
    )
    across = np.array([-wave[1], wave[0]]) / np.hypot(*wave)
    reach = np.arange(size) - size // 2
    here = power[np.ix_((row + reach) % rows, (column + reach) % columns)].mean()
    levels = []
    bins = float(np.hypot(*wave))
    clear = LOBE / bins  # of the peak's own lobe
    for near, far in (
        (min(0.45, 0.9 - clear), min(0.72, 1 - clear)),
        (max(1.35, 1 + clear), max(1.8, 1.2 + clear)),
    ):
        steps = max(int((far - near) * bins), 2)
        along = np.linspace(near, far, steps + 1)
        points = [along[:, None] * wave + offset * across for offset in (-1.0, 0.0, 1.0)]
        place = np.rint(np.concatenate(points)).astype(int)
        levels.append(float(power[place[:, 0] % rows, place[:, 1] % columns].mean()))
    return float(here / max(*levels, 1e-300))


def _peak(power: FloatArray, row: int, column: int, size: int) -> FloatArray:
    """Cycles a column and a row of the highest bin of a box, to a fraction of a bin."""
    rows, columns = power.shape
    reach = np.arange(size) - size // 2
    box = power[np.ix_((row + reach) % rows, (column + reach) % columns)]
    centre = np.unravel_index(int(np.argmax(box)), box.shape)
    row, column = row + int(reach[centre[0]]), column + int(reach[centre[1]])
    offsets = []
    for axis in (1, 0):
        before, after = (
            np.log(power[(row + s * (1 - axis)) % rows, (column + s * axis) % columns] + 1e-300)
            for s in (-1, 1)
        )
        here = np.log(power[row % rows, column % columns] + 1e-300)
        bend = before - 2 * here + after
        offsets.append(
            float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0
        )
    per_column = (column + offsets[0]) / columns
    per_row = (row + offsets[1]) / rows
    return np.array([(per_column + 0.5) % 1 - 0.5, (per_row + 0.5) % 1 - 0.5])


def _extent(image: Image, plain: FloatArray, vector: FloatArray) -> float:
    """Wavelengths along its normal over which a wave's energy extends: a participation ratio.

    Mean over strips along the normal, by their energy: a boundary crosses each strip once.
    Coherent sums over boxes a wavelength long and a sixteenth of the clip (at least a wavelength)
    wide, less what speckle leaves in them.
    """
    per_column, per_row = (float(v) for v in image.per_pixel(vector))
    width = max(1 / np.hypot(per_column, per_row), max(image.shape) / 16)
    turned, noise, count = wave_boxes(plain, image.valid, per_column, per_row, width)
    full = count > 0.5 * np.quantile(count[count > 0], 0.9)
    mean_noise = noise.sum() / max(count.sum(), 1.0)
    # a box of one bright thing weighs no more than the rest
    excess = np.abs(turned) ** 2 - np.maximum(noise, mean_noise * count)
    energy = np.maximum(np.where(full, excess / np.maximum(count, 1.0), 0.0), 0.0)
    strip, square = energy.sum(axis=0), (energy**2).sum(axis=0)
    if not square.max() > 0:
        return 0.0
    ratio = strip**2 / np.where(square > 0, square, 1.0)
    return float((strip * ratio).sum() / strip.sum())


def too_long(image: Image, found: Spectrum, bounds: tuple[float, float]) -> bool:
    """Whether the clip shows a strong wave that is too long for it to tell whether it is one.

    Parameters
    ----------
    image : Image
    found : Spectrum
    bounds : tuple of float
        Frequencies of the prior, cycles/m.

    Returns
    -------
    bool
        True where the strongest wave between 1.5 and MIN_WAVES wavelengths a clip, within the
        bounds, has a contrast of at least 0.3 of the amplitude.
    """
    low = (found.waves >= 1.5) & (found.waves < MIN_WAVES)
    low &= (found.frequency >= bounds[0]) & (found.frequency <= bounds[1])
    if not low.any():
        return False
    taper = 0.25 * image.valid.sum()  # sum of the taper over the valid pixels, nearly
    return bool(2 * np.sqrt(found.power[low].max()) / taper > 0.3)
