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

FloatArray = NDArray[np.float64]

# A clip must hold this many wavelengths, and a wavelength this many pixels, to show a ripple.
MIN_WAVES = 3.5
MIN_PIXELS = 4.0
FALSE_ALARM = 1e-4
# Boxes of the spectrum (bins) over which bent crests may spread, and how far above the spectrum
# around it each must stand.
BOXES = ((1, 14.0), (3, 5.0), (7, 3.0))
# Noise-equivalent bins that a Hann taper makes of one in each direction.
TAPER_BINS = 1.5
# Wavelengths along its normal that a wave must extend over (participation ratio of its energy).
MIN_EXTENT = 2.6
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


class Rings(NamedTuple):
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
    flat : ndarray (rows, columns)
        What was transformed, before its taper.
    """

    power: FloatArray
    white: FloatArray
    frequency: FloatArray
    waves: FloatArray
    flat: FloatArray


def flattened(image: Image) -> FloatArray:
    """Amplitude over its smooth trend, less 1; 0 where not valid.

    The trend is a polynomial of degree 4 in row and column through the means of 16 by 16 blocks.
    """
    amplitude = np.sqrt(image.power)
    rows, columns = image.shape
    across, down = min(16, rows), min(16, columns)
    edges = [np.linspace(0, n, k + 1).astype(int)[:-1] for n, k in ((rows, across), (columns, down))]

    def blocks(values: FloatArray) -> FloatArray:
        return np.add.reduceat(np.add.reduceat(values, edges[0], axis=0), edges[1], axis=1)

    count = blocks(image.valid.astype(float))
    mean = blocks(amplitude) / np.maximum(count, 1)
    used = count > 0.1 * count.max()
    y, x = (
        (np.append(e, n)[1:] + e - n) / n for e, n in ((edges[0], rows), (edges[1], columns))
    )
    degree = min(4, int(np.sqrt(used.sum())) - 1)
    terms = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    design = np.stack([np.multiply.outer(y**i, x**j)[used] for i, j in terms], axis=-1)
    weight = np.sqrt(count[used])
    fit = np.linalg.lstsq(design * weight[:, None], mean[used] * weight, rcond=None)[0]
    row = (2 * np.arange(rows) + 1 - rows) / rows
    column = (2 * np.arange(columns) + 1 - columns) / columns
    trend = sum(
        c * np.multiply.outer(row**i, column**j) for c, (i, j) in zip(fit, terms, strict=True)
    )
    low = 0.1 * float(amplitude[image.valid].mean())
    flat = np.minimum(amplitude / np.maximum(trend, low), CAP) - 1.0
    flat = np.where(image.valid, flat, 0.0)
    return np.asarray(np.where(image.valid, flat - flat[image.valid].mean(), 0.0))


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
    taper = [np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2 for n in image.shape]
    power = np.abs(fft2(flat * taper[0][:, None] * taper[1])) ** 2
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
    return Spectrum(power, white, np.hypot(east, north), waves, flat)


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


def find_waves(image: Image, found: Spectrum, bounds: tuple[float, float]) -> list[Wave]:
    """Return the candidate waves of a clip, the most likely ripple first.

    Parameters
    ----------
    image : Image
    found : Spectrum
    bounds : tuple of float
        Frequencies to search, cycles/m.

    Returns
    -------
    list of Wave
        Each half plane of wave vectors once; empty where the clip is too short or too coarse for
        any frequency within the bounds.
    """
    half = np.zeros(image.shape, bool)
    half[: image.shape[0] // 2 + 1, : image.shape[1] // 2 + 1] = True
    half[image.shape[0] // 2 + 1 :, 1 : image.shape[1] // 2 + 1] = True
    radius = _rings(image.shape).radius
    searched = half & (found.waves >= MIN_WAVES) & (radius * MIN_PIXELS <= 1)
    searched &= (found.frequency >= bounds[0]) & (found.frequency <= bounds[1])
    if not searched.any():
        return []
    waves: list[Wave] = []
    trials = float(searched.sum())
    for size, least in BOXES:
        smooth = uniform_filter(found.white, size, mode="wrap") if size > 1 else found.white
        looks = max(size / TAPER_BINS, 1.0) ** 2
        score = np.where(searched, smooth, 0.0)
        for row, column in _tops(score, CANDIDATES):
            ratio = smooth[row, column]
            around = ratio / max(_along_ray(found.white, smooth, row, column), 1.0)
            chance = float(gammaincc(looks, looks * around)) * trials / looks
            if around < 0.5 * least:
                continue
            vector = image.per_metre(_peak(found.power, row, column))
            extent = _extent(image, found.flat, vector)
            energy = float(found.power[row, column])
            chance_of = _probability(chance, around / least, extent)
            waves.append(Wave(vector, chance_of, extent, float(ratio), energy))
    waves.sort(key=lambda w: -w.probability * (1 + np.log1p(w.power)))
    return waves


def _probability(chance: float, strength: float, extent: float) -> float:
    """Probability of a ripple: of its peak against chance, its strength and its extent."""
    odds = min(FALSE_ALARM / max(chance, 1e-300), 1e12)
    gates = strength**8 * (extent / MIN_EXTENT) ** 12
    value = min(odds, 1e12 * gates) * min(gates, 1.0) if gates < 1 else odds
    return float(value / (1 + value))


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


def _along_ray(white: FloatArray, smooth: FloatArray, row: int, column: int) -> float:
    """Mean of the spectrum on the larger side of a peak along its ray from the origin."""
    rows, columns = white.shape
    wave = np.array(
        [row if row <= rows // 2 else row - rows, column if column <= columns // 2 else column - columns]
    )
    across = np.array([-wave[1], wave[0]]) / np.hypot(*wave)
    levels = []
    for near, far in ((0.4, 0.72), (1.35, 1.8)):
        reach = max(int((far - near) * np.hypot(*wave)), 2)
        along = np.linspace(near, far, reach + 1)
        points = [along[:, None] * wave + offset * across for offset in (-1.0, 0.0, 1.0)]
        place = np.rint(np.concatenate(points)).astype(int)
        levels.append(float(np.median(white[place[:, 0] % rows, place[:, 1] % columns]) / np.log(2)))
    return max(levels)


def _peak(power: FloatArray, row: int, column: int) -> FloatArray:
    """Cycles a column and a row of a peak, to a fraction of a bin."""
    rows, columns = power.shape
    box = np.log(
        power[np.ix_((row + np.arange(-1, 2)) % rows, (column + np.arange(-1, 2)) % columns)]
        + 1e-300
    )
    centre = np.unravel_index(int(np.argmax(box)), box.shape)
    row, column = row + int(centre[0]) - 1, column + int(centre[1]) - 1
    offsets = []
    for axis in (1, 0):
        before, after = (
            np.log(power[(row + s * (1 - axis)) % rows, (column + s * axis) % columns] + 1e-300)
            for s in (-1, 1)
        )
        here = np.log(power[row % rows, column % columns] + 1e-300)
        bend = before - 2 * here + after
        offsets.append(float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0)
    per_column = (column + offsets[0]) / columns
    per_row = (row + offsets[1]) / rows
    return np.array([(per_column + 0.5) % 1 - 0.5, (per_row + 0.5) % 1 - 0.5])


def _extent(image: Image, flat: FloatArray, vector: FloatArray) -> float:
    """Wavelengths along its normal over which a wave's energy extends: a participation ratio.

    Coherent sums over boxes a wavelength long and a sixteenth of the clip (at least a wavelength)
    wide, less what speckle leaves in them.
    """
    row, column = image.rows_and_columns
    per_column, per_row = image.per_pixel(vector)
    cycles = per_column * column + per_row * row
    unit = np.array([-per_row, per_column]) / np.hypot(per_column, per_row)
    across = unit[0] * column + unit[1] * row
    width = max(1 / np.hypot(per_column, per_row), np.ptp(across) / 16)
    along = np.floor(cycles - cycles.min()).astype(np.int64)
    strips = int(np.ptp(across) / width) + 1
    index = along * strips + np.floor((across - across.min()) / width).astype(np.int64)
    size = (int(along.max()) + 1) * strips

    def boxes(values: FloatArray) -> FloatArray:
        return np.bincount(index.ravel(), values.ravel(), size).reshape(-1, strips)

    turn = 2 * np.pi * cycles
    energy = boxes(flat * np.cos(turn)) ** 2 + boxes(flat * np.sin(turn)) ** 2
    noise = boxes(flat**2)
    count = boxes(image.valid.astype(float))
    # boxes of one bright thing weigh no more than the rest: energy per expected noise
    mean_noise = noise.sum() / max(count.sum(), 1.0)
    excess = (energy - np.maximum(noise, mean_noise * count)) / np.maximum(count, 1.0)
    line = np.maximum(np.where(count > 0, excess, 0.0).sum(axis=1), 0.0)
    total = line.sum()
    return float(total**2 / (line**2).sum()) if total > 0 else 0.0


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
    rows, columns = image.shape
    taper = 0.25 * image.valid.sum()  # sum of the taper over the valid pixels, nearly
    return bool(2 * np.sqrt(found.power[low].max()) / taper > 0.3)
