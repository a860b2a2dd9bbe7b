"""Appearance of a spectral peak in the clip: ripples, lines, or an object.

A spectrum alone does not separate ripples from an edge, a few lines or the ribs of a wreck. The
distribution of the wave's energy over the clip, and the shape of its crests, separate them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sasmap.arrays import BoolArray, ComplexArray, FloatArray
from sasmap.ripples.pixels import box_sums, wave_boxes
from sasmap.ripples.spectra import taper

# Narrowest strip along the crest normal, over the clip's longer side (a choice).
STRIP = 1 / 16
# Least share of the measured energy that is attributed to the wave where speckle explains more (a
# choice: it keeps the ratio of two small numbers bounded).
LEAST_OWN = 0.5
# Bounds of the correlation of neighbouring pixels: those of grains of 0.3 and 7 pixels.
LEAST_SHARE, MOST_SHARE = 0.004, 0.99
# Bins of the profile per wavelength, where it has enough pixels.
FINE, LONG_ENOUGH = 6, 12.0
# Offsets from a wave number at which power is averaged, bins (a choice: as wide as the main lobe).
AROUND = np.linspace(-1.5, 1.5, 5)
# Ramp of the share of a profile's variance that is not speckle, over which its shape starts to
# count.
SHAPE_FROM, SHAPE_SURE = 0.3, 0.6
# Ramp of the skewness between profiles with dark lines and others: at the onset of shadow it is
# -0.7 to -0.9, for marks and objects 0 to 3 (pipelines/ripples/floors.py).
DARK_SKEW = (-0.5, -0.2)
# Ramp of the share of a clip that an object covers; level over the clip's below which a box is in
# shadow; weights of brightness and of shadow. Simulated wrecks are 1.2 to 1.6 times as bright as
# the floor, have 1 to 8 % of the clip in shadow and cover 3 to 13 % of it; ripples are 0.96 to 1.05
# times as bright.
LARGE, SMALL, DARK, BRIGHT, SHADED = 0.35, 0.2, 0.5, 14.0, 55.0
# Ramp of the extent of ribs along the hull over that across it, and its weight. Hulls are three to
# seven times as long as wide; 2 % of 280 patches of ripples of any outline have more than 1.9, as
# do half of 35 wrecks that resemble ripples (pipelines/ripples/lookalikes.py, presence.py).
LONG, LONGER, RIBBED = 2.0, 2.5, 0.5
# Speckle power subtracted from that of a box, over its mean; being exponential, an eighth of it
# remains.
TAKEN_OFF = 2.0
# Side length in pixels of the boxes in which the display power is estimated, standard deviation of
# Rayleigh speckle over its mean, and least plausible display power.
SPECKLED, RAYLEIGH, LEAST_POWER = 8, 0.523, 0.3


class Extents(NamedTuple):
    """Extent of a wave in wavelengths, and whether its crests stay in phase.

    Attributes
    ----------
    normal, crests : float
        Along its normal, and along its crests.
    room : float
        Available length along the normal over that along the crests.
    out_of_step : float
        Correlation of neighbouring places on a crest minus that of neighbouring crests: about 0 for
        ripples, forked or not, because a fork disturbs both; up to 1 for separate lines.
    """

    normal: float
    crests: float
    room: float
    out_of_step: float


def _width(shape: tuple[int, ...], wave: tuple[float, float]) -> float:
    return max(1 / float(np.hypot(*wave)), STRIP * max(shape))


def extents(flat: FloatArray, valid: BoolArray, per_pixel: FloatArray) -> Extents:
    """Measure how far a wave's energy extends in a clip or a part of it, by participation ratios.

    The extent along the normal is an energy-weighted mean over strips (along the crests, over
    wavelengths): a boundary crosses each strip once. Energies are those of coherent sums over boxes
    a wavelength long and a strip wide, with that of speckle subtracted.

    Parameters
    ----------
    flat : ndarray (rows, columns)
        Amplitude over its trend, minus 1; 0 where not valid.
    valid : ndarray of bool (rows, columns)
    per_pixel : ndarray (2,)
        Cycles per column and row.
    """
    wave = float(per_pixel[0]), float(per_pixel[1])
    width = _width(flat.shape, wave)
    turned, _, noise, count = wave_boxes(flat, valid, *wave, 1, width)
    full = count > 0.5 * np.quantile(count[count > 0], 0.9)
    mean_noise = noise.sum() / max(count.sum(), 1.0)
    # keeps a box with one bright object from weighing more than the rest
    excess = np.abs(turned) ** 2 - np.maximum(noise, mean_noise * count)
    energy = np.maximum(np.where(full, excess / np.maximum(count, 1.0), 0.0), 0.0)
    wide = width * float(np.hypot(*wave))
    room = full.any(axis=1).sum() / (full.any(axis=0).sum() * wide)
    mean = np.where(full, turned / np.maximum(count, 1.0), 0.0)
    speckle = np.where(full, mean_noise / np.maximum(count, 1.0), 0.0)
    step = _step(mean.T, speckle.T) - _step(mean, speckle)
    return Extents(_participation(energy, 0), _participation(energy, 1) * wide, float(room), step)


def _step(mean: ComplexArray, speckle: FloatArray) -> float:
    """Correlation of a wave between neighbouring rows of boxes.

    Parameters
    ----------
    mean : ndarray (rows, columns)
        Complex amplitude of boxes, 0 where a box has too few pixels.
    speckle : ndarray (rows, columns)
        Mean square amplitude of speckle in a box, 0 where it has too few pixels.
    """
    both = (speckle[1:] > 0) & (speckle[:-1] > 0)
    here, there = mean[1:][both], mean[:-1][both]
    measured = [float((np.abs(v) ** 2).sum()) for v in (here, there)]
    added = [float(v[both].sum()) for v in (speckle[1:], speckle[:-1])]
    own = [max(m - a, LEAST_OWN * m) for m, a in zip(measured, added, strict=True)]
    return float(abs(np.vdot(there, here)) / max(np.sqrt(own[0] * own[1]), 1e-12))


def _participation(energy: FloatArray, axis: int) -> float:
    """Count the boxes along an axis over which energy is spread, an energy-weighted mean."""
    line, square = energy.sum(axis=axis), (energy**2).sum(axis=axis)
    if not square.max() > 0:
        return 0.0
    ratio = line**2 / np.where(square > 0, square, 1.0)
    return float((line * ratio).sum() / line.sum())


def contrast_of(flat: FloatArray, valid: BoolArray, per_pixel: FloatArray) -> float:
    """Local amplitude of a wave: energy-weighted mean over square boxes of one wavelength.

    Parameters
    ----------
    flat, valid, per_pixel
        As for :func:`extents`.
    """
    size = max(round(1 / float(np.hypot(*per_pixel))), 2)
    turned, count = box_sums(flat, valid, float(per_pixel[0]), float(per_pixel[1]), size)
    full = count > 0.4 * size * size
    variance = float((flat**2).sum()) / max(int(valid.sum()), 1)
    energy = np.maximum(np.abs(turned[full]) ** 2 / count[full] - variance, 0.0)
    total = float(energy.sum())
    return 2 * float(np.sqrt((energy**2).sum() / total)) / size if total > 0 else 0.0


def grain_of(flat: FloatArray, valid: BoolArray) -> float:
    """Estimate the size of the grain of speckle from the correlation of neighbouring pixels.

    Parameters
    ----------
    flat : ndarray (rows, columns)
        Amplitude over its trend, minus 1; 0 where not valid.
    valid : ndarray of bool (rows, columns)

    Returns
    -------
    float
        Standard deviation s, pixels, of the Gaussian that smooths the complex image, in the
        direction in which it is smaller: the correlation at a distance t is exp(-t^2 / (2 s^2)).
    """
    power = max(float((flat[valid] ** 2).mean()), 1e-12)
    pairs = (flat[1:], flat[:-1], valid[1:], valid[:-1]), (
        flat[:, 1:], flat[:, :-1], valid[:, 1:], valid[:, :-1]
    )  # fmt: skip
    shares = [float((a * b).sum()) / max(int((u & v).sum()), 1) / power for a, b, u, v in pairs]
    return float(1 / np.sqrt(-2 * np.log(np.clip(min(shares), LEAST_SHARE, MOST_SHARE))))


def undertone(amplitude: FloatArray, valid: BoolArray, per_pixel: FloatArray) -> float:
    """Power at half the wave number over that at the wave; blotches have most at long wavelengths.

    Parameters
    ----------
    amplitude : ndarray (rows, columns)
        Trend included, as removing it would remove long wavelengths too.
    valid : ndarray of bool (rows, columns)
    per_pixel : ndarray (2,)
        Cycles per column and row.

    Returns
    -------
    float
        At most 0.1 for simulated ripples, 0.02 to 0.4 for recorded ones with four forked waves (one
        0.7), mostly 0.5 to 6 for elongated blotches.
    """
    rows, columns = amplitude.shape
    level = np.where(valid, amplitude / amplitude[valid].mean() - 1, 0.0)
    level *= taper(rows)[:, None] * taper(columns)
    power = []
    for scale in (0.5, 1.0):
        down, across = (
            np.exp(-2j * np.pi * np.arange(n)[:, None] * (scale * k + AROUND / n))
            for n, k in ((rows, per_pixel[1]), (columns, per_pixel[0]))
        )
        near = np.hypot(AROUND[:, None], AROUND) <= AROUND[-1]
        power.append(float((np.abs(down.T @ (level @ across)) ** 2)[near].mean()))
    return power[0] / max(power[1], 1e-300)


def lines_of(flat: FloatArray, valid: BoolArray, per_pixel: FloatArray) -> float:
    """Measure how much crests resemble thin bright lines with wide gaps.

    Parameters
    ----------
    flat, valid, per_pixel
        As for :func:`extents`.

    Returns
    -------
    float
        Excess kurtosis of profiles across the crests: -1.5 for a sine, 0 for crests a fifth of a
        wavelength wide, positive for lines. Averaged speckle gives 0; thin dark lines are shadows
        of low ripples and do not count.
    """
    wave = float(per_pixel[0]), float(per_pixel[1])
    variance = float((flat**2).sum()) / max(int(valid.sum()), 1)
    length = 1 / float(np.hypot(*wave))
    parts = FINE if length > LONG_ENOUGH else max(int(length / 2), 2)
    _, total, _, count = wave_boxes(flat, valid, *wave, parts, _width(flat.shape, wave))
    full = count > 0.5 * np.quantile(count[count > 0], 0.9)
    level = np.where(full, total / np.maximum(count, 1.0), 0.0)
    level = level - level.sum(axis=0) / np.maximum(full.sum(axis=0), 1)
    shown = level[full]
    speckle = variance / float(np.median(count[full]))
    second, third, fourth = (float((shown**k).mean()) for k in (2, 3, 4))
    signal = max(second - speckle, 1e-12)
    sure = np.clip((signal / max(second, 1e-12) - SHAPE_FROM) / (SHAPE_SURE - SHAPE_FROM), 0, 1)
    bright = np.clip((third / signal**1.5 - DARK_SKEW[0]) / (DARK_SKEW[1] - DARK_SKEW[0]), 0, 1)
    return float(sure * bright * (fourth - 3 * second**2) / signal**2)


def objectness(flat: FloatArray, valid: BoolArray, per_pixel: FloatArray, there: Extents) -> float:
    """Measure how much a wave resembles an object: bright, in one place, with a shadow.

    Averaged over a wavelength, ripples scatter as much as the floor around them, and their shadow
    is shorter than a wavelength. The ribs of a wreck are small, brighter than the floor, next to a
    dark shadow, and side by side along a narrow hull.

    Parameters
    ----------
    flat : ndarray (rows, columns)
        Amplitude of the whole clip over its trend, minus 1; 0 where not valid.
    valid : ndarray of bool (rows, columns)
    per_pixel : ndarray (2,)
        Cycles per column and row.
    there : Extents
        Of the wave in the whole clip.

    Returns
    -------
    float
        1 where an object is as likely as not.
    """
    wave = float(per_pixel[0]), float(per_pixel[1])
    size = max(round(1 / float(np.hypot(*wave))), 2)
    turned, count = box_sums(flat, valid, *wave, size)
    total = box_sums(flat, valid, 0.0, 0.0, size)[0].real
    full = count > 0.4 * size * size
    if full.sum() < 4:
        return 0.0
    variance = float((flat[valid] ** 2).mean())
    energy = np.maximum(np.abs(turned[full]) ** 2 / count[full] - TAKEN_OFF * variance, 0.0)
    if not energy.max() > 0:
        return 0.0
    level = 1 + total[full] / count[full]
    share = float(energy.sum() ** 2 / (energy.size * (energy**2).sum()))
    weight = np.sqrt(energy)
    around = max(float(np.median(level[energy <= np.median(energy)])), 1e-9)
    level = (np.maximum(level, 0) / around) ** (1 / _compression(flat, valid))
    bright = float((weight * level).sum() / weight.sum()) - 1
    dark = float((level < DARK * np.median(level)).mean())
    small = float(np.clip((LARGE - share) / (LARGE - SMALL), 0, 1))
    shape = there.normal / max(there.crests * there.room, 1e-9)
    narrow = float(np.clip((shape - LONG) / (LONGER - LONG), 0, 1))
    return small * (BRIGHT * max(bright, 0.0) + SHADED * dark + RIBBED * narrow)


def _compression(flat: FloatArray, valid: BoolArray) -> float:
    """Estimate the display power of a clip, below 1 where the amplitude was compressed.

    Uses the speckle of small boxes, whose standard deviation is 0.52 of the mean in amplitude.
    """
    mean, count = box_sums(flat, valid, 0.0, 0.0, SPECKLED)
    square = box_sums(flat**2, valid, 0.0, 0.0, SPECKLED)[0].real
    full = count > 0.5 * SPECKLED**2
    if not full.any():
        return 1.0
    level = mean[full].real / count[full]
    variance = square[full] / count[full] - level**2
    spread = float(np.median(np.sqrt(np.maximum(variance, 0)) / np.maximum(1 + level, 0.05)))
    return float(np.clip(spread / RAYLEIGH, LEAST_POWER, 1.0))
