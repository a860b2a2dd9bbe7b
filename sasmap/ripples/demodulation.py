"""Demodulation of a clip at a wave, without its trend, in boxes of a sixth of a wavelength."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2, ifft2, next_fast_len
from scipy.ndimage import binary_closing, binary_erosion, fourier_gaussian

from sasmap.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from sasmap.ripples.image import Image
from sasmap.ripples.pixels import box_sums

# Boxes per wavelength, and most boxes along a side of the clip.
BOXES = 6
MAX_BOXES = 160
# Standard deviation, in wavelengths, of the Gaussian that smooths the trend.
TREND_SD = 1.5
# Rounds of the local trend, each on the residual of the last: at a clip's edge a single round is
# wrong by the trend's slope.
TREND_ROUNDS = 2
# Steps of the log of range, and degree of the polynomial in it that is removed first: near the
# track intensity changes by more than smoothing can follow.
RANGE_STEPS, RANGE_DEGREE = 24, 2
# Local amplitude, over that of the clip's rippled part, below which there are no ripples.
BARE = 0.35
# Rippled fraction of a clip above which all of it counts as rippled: a gap at its edge is a fork.
FULL = 0.95
# Boxes at the edge of the ripples that may be bare: half a wavelength, as amplitudes are smoothed.
RIM = BOXES // 2
# Smallest angle from the vertical by which amplitudes are divided, rad; error from speckle over the
# ripples' amplitude above which local amplitudes say nothing.
STEEP, SURE = 0.05, 0.2
# Most iterations of the refinement of the wave.
MAX_ROUNDS = 8


@dataclass(frozen=True)
class BoxSums:
    """A clip demodulated at a wave; arrays (box rows, box columns).

    Attributes
    ----------
    wave : ndarray (2,)
        Wave vector (east, north), cycles/m.
    size : int
        Side length of a box in pixels.
    turned : ndarray of complex
        Sums of (intensity over trend, minus 1) * exp(-i phase of the wave).
    count : ndarray
        Number of valid pixels.
    trend : ndarray
        Local mean intensity.
    wavelength : float
        Wavelength in boxes.
    variance : float
        Variance of intensity over trend.
    stripes : ndarray (2,)
        Number of stripes across the crests per column and per row.
    """

    wave: FloatArray
    size: int
    turned: ComplexArray
    count: FloatArray
    trend: FloatArray
    wavelength: float
    variance: float
    stripes: FloatArray


def demodulate(image: Image, wave: FloatArray) -> BoxSums:
    """Demodulate a clip at a wave and sum it over boxes.

    Trend and fundamental are fitted together, locally: at the clip's edges and holes the mean over
    part of a wavelength is not the trend.

    Parameters
    ----------
    image : Image
    wave : ndarray (2,)
        Wave vector (east, north), cycles/m.
    """
    per_column, per_row = (float(v) for v in image.per_pixel(wave))
    pixels = 1 / np.hypot(per_column, per_row)
    size = int(max(pixels / BOXES, np.ceil(max(image.shape) / MAX_BOXES), 1))
    one = image.valid.astype(float)
    sums = [box_sums(v, image.valid, 0.0, 0.0, size)[0].real for v in (image.power, one)]
    turned = [box_sums(v, image.valid, per_column, per_row, size)[0] for v in (image.power, one)]
    twice = box_sums(one, image.valid, 2 * per_column, 2 * per_row, size)[0]
    wavelength = pixels / size
    smooth = partial(smoothed, sd=TREND_SD * wavelength)
    count, count1, count2 = smooth(sums[1]).real, smooth(turned[1]), smooth(twice)
    trend = range_trend(image, size)
    for _ in range(TREND_ROUNDS):
        level, level1 = smooth(sums[0] / trend).real, smooth(turned[0] / trend)
        trend = np.asarray(trend * _local_trend(level, level1, count, count1, count2))
    flat = turned[0] / trend - turned[1]
    square = box_sums(image.power**2, image.valid, 0.0, 0.0, size)[0].real
    variance = float((square / trend**2).sum() / max(sums[1].sum(), 1)) - 1
    # stripes a third of a wavelength wide that run across the crests: each contains whole waves
    stripes = 3 * np.array([-per_row, per_column])
    return BoxSums(wave, size, flat, sums[1], trend, wavelength, max(variance, 1e-6), stripes)


def range_trend(image: Image, size: int) -> FloatArray:
    """Trend of the clip's intensity over range, roughly a power law, over boxes.

    Parameters
    ----------
    image : Image
    size : int
        Side length of a box in pixels.

    Returns
    -------
    ndarray (box rows, box columns)
        Mean 1 over the boxes that hold a pixel; 1 elsewhere.
    """
    place, count = _log_range(image, size)
    total = box_sums(image.power, image.valid, 0.0, 0.0, size)[0].real
    filled = count > 0
    x = place[filled]
    # take means over even steps of log range first: intensity is far from Gaussian
    step = (x - x.min()) / max(float(np.ptp(x)), 1e-9) * RANGE_STEPS
    step = np.minimum(step, RANGE_STEPS - 1).astype(int)
    pixels, power, where = (
        np.bincount(step, v, RANGE_STEPS) for v in (count[filled], total[filled], x * count[filled])
    )
    some = power > 0
    ratio = power[some] / pixels[some]
    reach = np.exp(where[some] / pixels[some])
    return along_range(image, size, reach, ratio, np.asarray(pixels[some], float))


def along_range(
    image: Image, size: int, reach: FloatArray, ratio: FloatArray, weight: FloatArray
) -> FloatArray:
    """Polynomial in the log of range fitted to the log of ratios, evaluated over boxes.

    Parameters
    ----------
    image : Image
    size : int
        Side length of a box in pixels.
    reach, ratio, weight : ndarray (n,)
        Ground range (m), ratio of intensities there, and the number of pixels it is based on.

    Returns
    -------
    ndarray (box rows, box columns)
        Mean 1 over the boxes that hold a pixel; 1 elsewhere, and where n is too small.
    """
    place, count = _log_range(image, size)
    filled = count > 0
    trend = np.ones(count.shape)
    if len(reach) < 2 * RANGE_DEGREE:
        return trend
    middle, half = float(np.log(reach).mean()), max(float(np.ptp(np.log(reach))), 1e-9)
    x = (np.log(reach) - middle) / half
    line = np.polyfit(x, np.log(ratio), RANGE_DEGREE, w=np.sqrt(weight))
    trend[filled] = np.exp(np.polyval(line, (place[filled] - middle) / half))
    return trend / float(trend[filled].mean())


def _log_range(image: Image, size: int) -> tuple[FloatArray, FloatArray]:
    """Return the log of the mean ground range of boxes, 0 for empty ones, and their pixel count."""
    reach = np.where(image.valid, image.ground_range, 0.0)
    total, count = box_sums(reach, image.valid, 0.0, 0.0, size)
    mean = total.real / np.maximum(count, 1)
    return np.log(np.where(count > 0, mean, 1.0)), count


def rewaved(image: Image, boxes: BoxSums, wave: FloatArray) -> BoxSums:
    """Shift demodulated boxes to a nearby wave by rotating their phase.

    Parameters
    ----------
    image : Image
    boxes : BoxSums
    wave : ndarray (2,)
        Wave vector (east, north), cycles/m, whose phase differs little over a box.
    """
    along, across = image.places(boxes.size)
    change = wave - boxes.wave
    turn = np.exp(-2j * np.pi * (change @ image.look * along + change @ image.beside * across))
    return replace(boxes, wave=wave, turned=boxes.turned * turn)


def turned_back(image: Image, boxes: BoxSums, lag: tuple[FloatArray, FloatArray]) -> BoxSums:
    """Remove a phase lag that depends on range from demodulated boxes.

    Parameters
    ----------
    image : Image
    boxes : BoxSums
    lag : tuple of ndarray (n,)
        Ground ranges, m, increasing, and the ripple's phase at which the fundamental peaks there,
        rad.
    """
    along = image.project(image.look, boxes.size)
    phase = np.interp(image.mean_range + along, *lag)
    return replace(boxes, turned=boxes.turned * np.exp(1j * phase))


def smoothed(values: NDArray[np.generic], sd: float) -> ComplexArray:
    """Smooth an array by a Gaussian of standard deviation `sd`, as if it were zero outside."""
    rows, columns = values.shape
    wide = [next_fast_len(n + int(4 * min(sd, max(values.shape)))) for n in values.shape]
    return np.asarray(ifft2(fourier_gaussian(fft2(values, wide), sd))[:rows, :columns])


def _local_trend(
    power: FloatArray,
    power1: ComplexArray,
    count: FloatArray,
    count1: ComplexArray,
    count2: ComplexArray,
) -> FloatArray:
    """Fit T (1 + z e^(i phase) + its conjugate) to smoothed sums of the image; return T."""
    count = np.maximum(count, 1e-6 * count.max())
    # unknowns T, p = Re(T z), q = Im(T z); z e^(i phase) + conjugate = 2 p cos - 2 q sin
    c1, s1 = count1.real, -count1.imag
    c2, s2 = count2.real, -count2.imag
    matrix = np.empty((*count.shape, 3, 3))
    matrix[..., 0, 0] = count
    matrix[..., 0, 1] = matrix[..., 1, 0] = c1
    matrix[..., 0, 2] = matrix[..., 2, 0] = -s1
    matrix[..., 1, 1] = 0.5 * (count + c2)
    matrix[..., 1, 2] = matrix[..., 2, 1] = -0.5 * s2
    matrix[..., 2, 2] = 0.5 * (count - c2)
    matrix[..., 1, 1] += 1e-3 * count
    matrix[..., 2, 2] += 1e-3 * count
    right = np.stack([power, power1.real, power1.imag], axis=-1)
    level = np.linalg.solve(matrix, right[..., None])[..., 0, 0]
    plain = power / count
    return np.asarray(np.maximum(np.clip(level, 0.5 * plain, 2 * plain), 1e-9))


def refined_wave(image: Image, boxes: BoxSums, weight: BoolArray) -> FloatArray:
    """Wave vector (east, north), cycles/m, at which the demodulated clip is most coherent."""
    along, across = image.places(boxes.size)
    place = np.stack([along[weight], across[weight]])
    values = boxes.turned[weight]
    spread = place.std(axis=1) + 1e-9
    turn = np.zeros(2)  # rad/m
    for _ in range(MAX_ROUNDS):
        now = values * np.exp(-1j * (turn @ place))
        total = now.sum()
        if total == 0:
            break
        now = now * np.conj(total) / abs(total)
        centre = (place * now.real).sum(axis=1) / now.real.sum()
        offset = place - centre[:, None]
        gradient = (offset * now.imag).sum(axis=1)
        curvature = (offset * now.real) @ offset.T
        bound = np.diag(1e-2 * abs(total) * spread**2)
        step = np.linalg.solve(curvature + bound, gradient)
        step = np.clip(step, -1 / spread, 1 / spread)
        turn = turn + step
        if (np.abs(step) * spread).max() < 1e-5:
            break
    return np.asarray(boxes.wave + (turn[0] * image.look + turn[1] * image.beside) / (2 * np.pi))


def covered_boxes(image: Image, boxes: BoxSums) -> BoolArray:
    """Return the boxes that have ripples.

    Contrast grows towards lower grazing angles, so the amplitude is divided by the angle from the
    vertical before it is compared. Where speckle hides local amplitudes, all boxes count as
    rippled. Gaps of up to two wavelengths are filled, and the rim of larger ones is left out.
    """
    filled = boxes.count > 0
    angle = angles_from_vertical(image, boxes.size)
    for sd in (0.8, 1.3, 2.0):
        _, level, error = local_amplitudes(boxes, sd, angle)
        high = float(np.quantile(level[filled], 0.85))
        if float(np.median(error[filled])) > SURE * high:
            continue
        rippled = filled & (level > BARE * high)
        rippled = filled & closed(rippled)  # gaps that forks leave have ripples around them
        if boxes.count[rippled].sum() > FULL * boxes.count.sum():
            return filled
        inside = binary_erosion(rippled | ~filled, iterations=RIM, border_value=1)
        return np.asarray(filled & inside)
    return filled


def local_amplitudes(
    boxes: BoxSums, sd: float, angle: FloatArray
) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Smooth the amplitudes of boxes over `sd` wavelengths.

    Returns
    -------
    field : ndarray of complex (box rows, box columns)
        Complex amplitude.
    level, error : ndarray (box rows, box columns)
        Its size without that of speckle, and speckle's, both over the angle from the vertical.
    """
    reach = sd * boxes.wavelength
    count = np.maximum(smoothed(boxes.count, reach).real, 1e-3 * boxes.count.max())
    field = smoothed(boxes.turned, reach) / count
    # speckle: variance of a mean over the Gaussian's area, which is smaller at edges and holes
    noise = boxes.variance / (4 * np.pi * (reach * boxes.size) ** 2)
    noise = noise * boxes.count.max() / count
    level = np.sqrt(np.maximum(np.abs(field) ** 2 - noise, 0)) / angle
    return field, level, np.sqrt(noise) / angle


def closed(boxes: BoolArray) -> BoolArray:
    """Fill gaps of up to two wavelengths in a mask of boxes."""
    wide = binary_closing(np.pad(boxes, BOXES), iterations=BOXES)
    return np.asarray(wide[BOXES:-BOXES, BOXES:-BOXES])


def angles_from_vertical(image: Image, size: int) -> FloatArray:
    """Mean angle of the look from the vertical over boxes, at least STEEP, rad."""
    reach, altitude = (
        box_sums(v, image.valid, 0.0, 0.0, size)[0].real
        for v in (image.ground_range, image.altitude)
    )
    return np.asarray(np.maximum(np.arctan2(reach, np.maximum(altitude, 1e-9)), STEEP))


def windings(field: ComplexArray) -> IntArray:
    """Compute the winding number of a field's phase around each group of four neighbours.

    Parameters
    ----------
    field : ndarray of complex (rows, columns)

    Returns
    -------
    ndarray of int (rows - 1, columns - 1)
        1 or -1 where a crest splits or ends, else 0.
    """
    corners = [field[:-1, :-1], field[:-1, 1:], field[1:, 1:], field[1:, :-1]]
    after = corners[1:] + corners[:1]
    turns = [np.angle(b * np.conj(a)) for a, b in zip(corners, after, strict=True)]
    return np.asarray(np.rint(np.sum(turns, axis=0) / (2 * np.pi)), np.int64)


def local_ratio(
    image: Image, wave: FloatArray, box: int, used: BoolArray, model: FloatArray
) -> FloatArray:
    """Smooth ratio of an image to its model over boxes: the trend that the model leaves.

    Parameters
    ----------
    image : Image
    wave : ndarray (2,)
        Wave vector (east, north), cycles/m.
    box : int
        Side length of a box in pixels.
    used : ndarray of bool (rows, columns)
    model : ndarray (rows, columns)
        Expected intensity where used.

    Returns
    -------
    ndarray (box rows, box columns)
        1 far from all used pixels.
    """
    sums = [box_sums(v, used, 0.0, 0.0, box)[0].real for v in (image.power, model)]
    wavelength = 1 / float(np.hypot(*image.per_pixel(wave)) * box)
    seen, expected = (smoothed(v, TREND_SD * wavelength).real for v in sums)
    known = expected > 1e-3 * expected.max()
    return np.where(known, np.maximum(seen, 0.05 * expected) / np.where(known, expected, 1.0), 1.0)
