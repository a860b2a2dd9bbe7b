"""Ripple phase as a field: straight where that suffices, else as stiff as the clip decides.

The image over its local mean is demodulated at the strongest wave and summed over boxes a sixth of
a wavelength wide; smoothing those gives the phase of the image's fundamental at every place, forks
and all. Odd and even stripes across the crests are smoothed apart, and each pixel's phase is what
the others tell, so that speckle is not taken for phase; the smoothing is the one that predicts the
others best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2, ifft2, next_fast_len
from scipy.ndimage import binary_closing

from sasmap.ripples.image import Image
from sasmap.ripples.pixels import box_sums, field_cycles

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

# BoxSums a wavelength, and the most boxes a side.
BOXES = 6
MAX_BOXES = 160
# Standard deviations, in wavelengths, of the Gaussians that smooth the phase.
STIFFNESS = (0.5, 0.65, 1.0, 1.5, 2.2, 3.3, 5.0)
TREND_SD = 1.5
# Rounds of the local trend, each on what the last left: at a clip's edge one alone is off by the
# trend's slope.
TREND_ROUNDS = 2
# Steps of the log of range, and degree of the polynomial in it that is taken off first: near the
# track intensity changes by more than smoothing can follow.
RANGE_STEPS, RANGE_DEGREE = 24, 2
# What a field of each stiffness must at least predict, of what straight crests do: a stiffness of
# parts of a wave takes the pulse's own shape for phase.
STRAIGHT = np.array([1.03, 1.012, 1.004, 1.004, 1.003, 1.003, 1.003])
# Local amplitude, over that of the clip's rippled part, of places without ripples.
BARE = 0.35
# Rippled fraction of a clip above which all of it counts as rippled.
FULL = 0.8
MAX_ROUNDS = 8
# Share of the phase's wander that its mean slope may be wrong by, and turns over the clip that a
# fork leaves open (root of their number).
WANDER_SHARE, FORK_TURN = 0.2, 0.04


@dataclass(frozen=True)
class BoxSums:
    """A clip demodulated at a wave; arrays (box rows, box columns).

    Attributes
    ----------
    wave : ndarray (2,)
        Wave vector (east, north), cycles/m.
    size : int
        Pixels a side of a box.
    turned : ndarray of complex
        Sums of (intensity over trend, less 1) * exp(-i phase of the wave).
    count : ndarray
        Valid pixels.
    trend : ndarray
        Local mean intensity.
    wavelength : float
        In boxes.
    variance : float
        Of intensity over trend.
    stripes : ndarray (2,)
        Stripes across the crests a column and a row.
    """

    wave: FloatArray
    size: int
    turned: ComplexArray
    count: FloatArray
    trend: FloatArray
    wavelength: float
    variance: float
    stripes: FloatArray


@dataclass(frozen=True)
class PhaseField:
    """Phase of a clip's ripples.

    Attributes
    ----------
    wave : ndarray (2,)
        Wave vector (east, north) that the field is relative to, cycles/m.
    rigid : bool
        Whether crests are straight: there is no field.
    shape : tuple of int
        Of the image: rows, columns.
    box : int
        Pixels a side of a box.
    stripes : ndarray (2,)
        Stripes across the crests a column and a row, of which odd and even alternate.
    even, odd, both : ndarray of complex (box rows, box columns)
        Unit phasors of the field from even stripes, odd ones, and all.
    covered : ndarray of bool (box rows, box columns)
        BoxSums with ripples.
    origin : float
        Phase of a straight wave's image at the clip's centre, cycles.
    mean_wave, wave_sd : ndarray (2,)
        Mean wave vector of the image's phase along and across the look, cycles/m, and its standard
        deviation under independent speckle.
    error : float
        Of the field at a pixel, rad; 0 where rigid.
    coherence_length : float
        Distance over which the phase, less its mean slope, keeps a correlation of 1/e, m; the
        clip's largest where it keeps it throughout.
    rippled_fraction : float
        Of the clip's valid area.
    stiffness : float
        Standard deviation of the Gaussian that smooths the field, m; infinite where rigid.
    """

    wave: FloatArray
    rigid: bool
    shape: tuple[int, int]
    box: int
    stripes: FloatArray
    even: ComplexArray
    odd: ComplexArray
    both: ComplexArray
    covered: BoolArray
    origin: float
    mean_wave: FloatArray
    wave_sd: FloatArray
    error: float
    coherence_length: float
    rippled_fraction: float
    stiffness: float

    def per_pixel(self, image: Image) -> FloatArray:
        """Cycles of the plane wave a column, a row and at the clip's centre (3,)."""
        return np.append(image.per_pixel(self.wave), self.origin)

    @property
    def middle(self) -> float:
        """Mean phase at the clip's centre, cycles, of the wave's image."""
        if self.rigid:
            return self.origin
        total = self.both[self.covered].sum()
        return self.origin + float(np.angle(total) / (2 * np.pi))

    def spread_cover(self) -> BoolArray:
        """Rippled boxes and the holes among them."""
        return np.asarray(binary_closing(np.pad(self.covered, 6), iterations=6)[6:-6, 6:-6])

    @cached_property
    def cycles(self) -> FloatArray:
        """Phase of the field at every pixel, cycles; empty where crests are straight."""
        if self.rigid:
            return np.empty((0, 0))
        return np.asarray(field_cycles(self.even, self.odd, self.box, self.stripes, self.shape))

    def pixels(self, boxes: BoolArray, shape: tuple[int, int]) -> BoolArray:
        """Spread a mask of boxes to the image's pixels."""
        if boxes.all():
            return np.ones(shape, bool)
        wide = np.repeat(np.repeat(boxes, self.box, axis=0), self.box, axis=1)
        return wide[: shape[0], : shape[1]]


def demodulate(image: Image, wave: FloatArray) -> BoxSums:
    """Demodulate a clip at a wave and sum it over boxes.

    Trend and fundamental are fitted together, locally: at the clip's edges and holes the mean of a
    part of a wave is not the trend.

    Parameters
    ----------
    image : Image
    wave : ndarray (2,)
        Wave vector (east, north), cycles/m.

    Returns
    -------
    BoxSums
    """
    per_column, per_row = (float(v) for v in image.per_pixel(wave))
    pixels = 1 / np.hypot(per_column, per_row)
    size = int(max(pixels / BOXES, np.ceil(max(image.shape) / MAX_BOXES), 1))
    one = image.valid.astype(float)
    sums = [box_sums(v, image.valid, 0.0, 0.0, size)[0].real for v in (image.power, one)]
    turned = [box_sums(v, image.valid, per_column, per_row, size)[0] for v in (image.power, one)]
    twice = box_sums(one, image.valid, 2 * per_column, 2 * per_row, size)[0]
    wavelength = pixels / size
    smooth = _Smoother(sums[0].shape, TREND_SD * wavelength)
    count, count1, count2 = smooth(sums[1]).real, smooth(turned[1]), smooth(twice)
    trend = range_trend(image, size)
    for _ in range(TREND_ROUNDS):
        level, level1 = smooth(sums[0] / trend).real, smooth(turned[0] / trend)
        trend = np.asarray(trend * _local_trend(level, level1, count, count1, count2))
    flat = turned[0] / trend - turned[1]
    square = box_sums(image.power**2, image.valid, 0.0, 0.0, size)[0].real
    variance = float((square / trend**2).sum() / max(sums[1].sum(), 1)) - 1
    # stripes a third of a wavelength wide that run across the crests: each sees whole waves
    stripes = 3 * np.array([-per_row, per_column])
    return BoxSums(wave, size, flat, sums[1], trend, wavelength, max(variance, 1e-6), stripes)


def range_trend(image: Image, size: int) -> FloatArray:
    """Power of range, nearly, that the clip's intensity follows, over boxes.

    Parameters
    ----------
    image : Image
    size : int
        Pixels a side of a box.

    Returns
    -------
    ndarray (box rows, box columns)
        Mean 1 over the boxes that hold a pixel; 1 elsewhere.
    """
    place, count = _log_range(image, size)
    total = box_sums(image.power, image.valid, 0.0, 0.0, size)[0].real
    filled = count > 0
    x = place[filled]
    # means of even steps of log range first: intensity is far from Gaussian
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
    """Polynomial in the log of range through the log of ratios, over boxes.

    Parameters
    ----------
    image : Image
    size : int
        Pixels a side of a box.
    reach, ratio, weight : ndarray (n,)
        Ground range (m), what is found there, and the pixels that it rests on.

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
    """Log of the mean ground range of boxes, 0 where there is none, and their pixels."""
    reach = np.where(image.valid, image.ground_range, 0.0)
    total, count = box_sums(reach, image.valid, 0.0, 0.0, size)
    mean = total.real / np.maximum(count, 1)
    return np.log(np.where(count > 0, mean, 1.0)), count


def rewaved(image: Image, boxes: BoxSums, wave: FloatArray) -> BoxSums:
    """Demodulate at a nearby wave what is demodulated already: turn the boxes.

    Parameters
    ----------
    image : Image
    boxes : BoxSums
    wave : ndarray (2,)
        Wave vector (east, north), cycles/m, off by little over a box.

    Returns
    -------
    BoxSums
    """
    along, across = _places(image, boxes)
    look = image.look
    change = wave - boxes.wave
    beside = change @ np.array([look[1], -look[0]])
    turn = np.exp(-2j * np.pi * (change @ look * along + beside * across))
    return replace(boxes, wave=wave, turned=boxes.turned * turn)


def turned_back(image: Image, boxes: BoxSums, lag: tuple[FloatArray, FloatArray]) -> BoxSums:
    """Take a phase that follows range off demodulated boxes.

    Parameters
    ----------
    image : Image
    boxes : BoxSums
    lag : tuple of ndarray (n,)
        Ground ranges, m, increasing, and the ripple's phase at which the fundamental peaks there,
        rad.

    Returns
    -------
    BoxSums
    """
    along, _ = _places(image, boxes)
    phase = np.interp(image.mean_range + along, *lag)
    return replace(boxes, turned=boxes.turned * np.exp(1j * phase))


class _Smoother:
    """Gaussian smoothing of arrays of a shape, zero outside."""

    def __init__(self, shape: tuple[int, int], sd: float) -> None:
        self._shape = shape
        pad = int(4 * min(sd, max(shape)))
        full = [next_fast_len(n + pad) for n in shape]
        frequency = [
            np.fft.fftfreq(n)[:, None] if i == 0 else np.fft.fftfreq(n) for i, n in enumerate(full)
        ]
        self._full = (full[0], full[1])
        self._window = np.exp(-2 * (np.pi * sd) ** 2 * (frequency[0] ** 2 + frequency[1] ** 2))

    def __call__(self, values: NDArray[np.generic]) -> ComplexArray:
        wide = ifft2(fft2(values, self._full) * self._window)
        return np.asarray(wide[: self._shape[0], : self._shape[1]])


def _local_trend(
    power: FloatArray,
    power1: ComplexArray,
    count: FloatArray,
    count1: ComplexArray,
    count2: ComplexArray,
) -> FloatArray:
    """Mean of T (1 + z e^(i phase) + its conjugate) that explains smoothed sums of the image."""
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


def _places(image: Image, boxes: BoxSums) -> tuple[FloatArray, FloatArray]:
    """Places of box centres along and across the look from the clip's centre, m."""
    rows, columns = image.shape
    down = (np.arange(boxes.count.shape[0]) + 0.5) * boxes.size - 0.5 - (rows - 1) / 2
    right = (np.arange(boxes.count.shape[1]) + 0.5) * boxes.size - 0.5 - (columns - 1) / 2
    look = image.look
    result = []
    for direction in (look, np.array([look[1], -look[0]])):
        per_column, per_row = direction @ image.steps
        result.append(per_column * right[None, :] + per_row * down[:, None])
    return result[0], result[1]


def refined_wave(image: Image, boxes: BoxSums, weight: BoolArray) -> FloatArray:
    """Wave vector (east, north), cycles/m, at which the demodulated clip is most coherent."""
    along, across = _places(image, boxes)
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
    look = image.look
    return np.asarray(
        boxes.wave + (turn[0] * look + turn[1] * np.array([look[1], -look[0]])) / (2 * np.pi)
    )


def covered_boxes(image: Image, boxes: BoxSums) -> tuple[BoolArray, float]:
    """BoxSums where ripples are, and the fraction of the valid area that they make up.

    Contrast grows as the sound grazes lower, so amplitude is compared over the angle from
    the vertical; where speckle hides what one place shows, all count as rippled.
    """
    filled = boxes.count > 0
    size = boxes.size
    reach, altitude = (
        box_sums(np.nan_to_num(v), image.valid, 0.0, 0.0, size)[0].real
        for v in (image.ground_range, image.altitude)
    )
    incidence_angle = np.arctan2(reach, np.maximum(altitude, 1e-9))
    everywhere = filled, 1.0
    for sd in (0.8, 1.3, 2.0):
        smooth = _Smoother(filled.shape, sd * boxes.wavelength)
        count = np.maximum(smooth(boxes.count).real, 1e-3 * boxes.count.max())
        noise = boxes.variance / (4 * np.pi * (sd * boxes.wavelength * size) ** 2)
        noise = noise * boxes.count.max() / count
        local = np.maximum(np.abs(smooth(boxes.turned) / count) ** 2 - noise, 0)
        level = np.sqrt(local) / np.maximum(incidence_angle, 0.05)
        high = float(np.quantile(level[filled], 0.85))
        error = float(np.median((np.sqrt(noise) / np.maximum(incidence_angle, 0.05))[filled]))
        if error > 0.2 * high:
            continue
        rippled = filled & (level > BARE * high)
        fraction = float(boxes.count[rippled].sum() / boxes.count.sum())
        if fraction > FULL:
            return filled, max(fraction, FULL) if fraction < 0.97 else 1.0
        return rippled, fraction
    return everywhere


def straight(image: Image, boxes: BoxSums) -> PhaseField:
    """Return the phase of straight crests: a plane wave and no field.

    Parameters
    ----------
    image : Image
    boxes : BoxSums
        Demodulated at the wave.

    Returns
    -------
    PhaseField
    """
    covered, fraction = covered_boxes(image, boxes)
    one = np.ones(boxes.count.shape, complex)
    along, across = _places(image, boxes)
    weight = np.where(covered, boxes.count, 0.0)
    total, pixels = np.where(covered, boxes.turned, 0).sum(), weight.sum()
    # slope of the phase of a sine of this amplitude in noise of this variance, by least squares
    noise = np.sqrt(0.5 * boxes.variance * pixels) / max(abs(total), 1e-9)
    spreads = [
        np.sqrt(np.average((v - np.average(v, weights=weight)) ** 2, weights=weight))
        for v in (along, across)
    ]
    sd = np.array([noise / max(2 * np.pi * v, 1e-9) for v in spreads])
    return PhaseField(
        boxes.wave,
        True,
        image.shape,
        boxes.size,
        boxes.stripes,
        one,
        one,
        one,
        covered,
        float(np.angle(total)) / (2 * np.pi),
        _along_and_across(image, boxes.wave),
        sd,
        0.0,
        float(np.hypot(np.ptp(along), np.ptp(across))),
        fraction,
        float("inf"),
    )


def _along_and_across(image: Image, wave: FloatArray) -> FloatArray:
    """Components of a wave vector (east, north) along and across the look."""
    look = image.look
    return np.array([wave @ look, wave @ np.array([look[1], -look[0]])])


class FieldTrials(NamedTuple):
    """How well phase fields predict boxes that they did not see.

    Attributes
    ----------
    scores : ndarray
        Predicted amplitude for each of STIFFNESS, over that of a plane wave.
    even, odd, both : list of ndarray of complex
        The fields, smoothed.
    """

    scores: FloatArray
    even: list[ComplexArray]
    odd: list[ComplexArray]
    both: list[ComplexArray]


def trial_fields(boxes: BoxSums) -> FieldTrials:
    """Smooth the phase at several stiffnesses and score each on boxes that it did not see.

    Parameters
    ----------
    boxes : BoxSums
        Demodulated at a refined wave.

    Returns
    -------
    FieldTrials
    """
    stripes = boxes.stripes
    row, column = (np.indices(boxes.count.shape) + 0.5) * boxes.size
    even = np.floor(stripes[0] * column + stripes[1] * row) % 2 == 0
    whole = abs(boxes.turned.sum())
    scores, fields = [], []
    for stiffness in STIFFNESS:
        smooth = _Smoother(boxes.count.shape, max(stiffness * boxes.wavelength, 0.8))
        first = smooth(np.where(even, boxes.turned, 0))
        second = smooth(np.where(even, 0, boxes.turned))
        fields.append((first, second))
        unseen = np.where(even, _unit(second), _unit(first))
        scores.append(float((boxes.turned * np.conj(unseen)).sum().real) / max(whole, 1e-300))
    return FieldTrials(
        np.array(scores),
        [f for f, _ in fields],
        [s for _, s in fields],
        [f + s for f, s in fields],
    )


def _unit(values: ComplexArray) -> ComplexArray:
    size = np.abs(values)
    return np.asarray(np.where(size > 0, values / np.where(size > 0, size, 1), 1.0))


def best_field(image: Image, boxes: BoxSums, trials: FieldTrials) -> PhaseField:
    """Return the phase field that predicts the clip best.

    Parameters
    ----------
    image : Image
    boxes : BoxSums
    trials : FieldTrials

    Returns
    -------
    PhaseField
    """
    best = int(np.argmax(trials.scores / STRAIGHT))
    even, odd, both = (f[best] for f in (trials.even, trials.odd, trials.both))
    covered, fraction = covered_boxes(image, boxes)
    weight = np.where(covered, boxes.count, 0.0)
    product = even * np.conj(odd)
    agree = (weight * _unit(product)).sum().real / max(weight.sum(), 1.0)
    smear = float(np.clip(np.sqrt(-np.log(np.clip(agree, 0.1, 0.9999))), 0.05, 1.2))
    mean, sd = _mean_wave(image, boxes, _unit(both), weight, smear)
    field = _unit(both)
    return PhaseField(
        boxes.wave,
        False,
        image.shape,
        boxes.size,
        boxes.stripes,
        _unit(even),
        _unit(odd),
        field,
        covered,
        0.0,
        mean,
        sd,
        smear,
        _coherence_length(image, boxes, field, weight, mean),
        fraction,
        float(STIFFNESS[best] * boxes.wavelength * boxes.size * image.pixel_size),
    )


def _mean_wave(
    image: Image, boxes: BoxSums, field: ComplexArray, weight: FloatArray, smear: float
) -> tuple[FloatArray, FloatArray]:
    """Slope of the plane that fits the phase best, along and across the look, cycles/m.

    The least-squares slope over an interval is the mean of the local slope weighted by a parabola,
    which needs no unwrapping.
    """
    slopes, spreads = [], []
    for axis in (1, 0):
        ahead = np.moveaxis(field, axis, 0)
        heavy = np.moveaxis(weight, axis, 0)
        turn = np.angle(ahead[1:] * np.conj(ahead[:-1]))
        both = np.sqrt(heavy[1:] * heavy[:-1])
        used = np.flatnonzero(heavy.sum(axis=1) > 0)
        low, high = used[0], used[-1]
        place = (np.arange(turn.shape[0]) + 0.5 - low) / max(high - low, 1)
        parabola = np.maximum(place * (1 - place), 0)[:, None] * both
        total = max(float(parabola.sum()), 1e-300)
        slope = float((parabola * turn).sum()) / total
        slopes.append(slope / (2 * np.pi * boxes.size))
        # what remains of the wander, averaged over what the clip holds of it, is not known
        rest = (turn - slope) * (parabola > 0)
        wander = np.cumsum((rest * both).sum(axis=1) / np.maximum(both.sum(axis=1), 1e-9))
        spreads.append(float(wander.std() + smear) / max(high - low, 1))
    per_pixel = image.per_pixel(boxes.wave) + np.array(slopes)
    mean = _along_and_across(image, image.per_metre(per_pixel))
    length = boxes.size * image.pixel_size
    sd = WANDER_SHARE * float(np.hypot(*spreads)) / (2 * np.pi * length)
    forks = FORK_TURN * np.sqrt(_forks(field, weight)) / (max(weight.shape) * length)
    return mean, np.full(2, np.hypot(sd, forks))


def _forks(field: ComplexArray, weight: FloatArray) -> int:
    """Places that the phase winds around: where crests split or end."""
    corners = [field[:-1, :-1], field[:-1, 1:], field[1:, 1:], field[1:, :-1]]
    turns = [
        np.angle(b * np.conj(a)) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    wound = np.abs(np.sum(turns, axis=0)) > np.pi
    inside = (weight[:-1, :-1] > 0) & (weight[1:, 1:] > 0)
    return int((wound & inside).sum())


def _coherence_length(
    image: Image, boxes: BoxSums, field: ComplexArray, weight: FloatArray, mean: FloatArray
) -> float:
    """Lag at which the correlation of exp(i field), less its mean slope, falls to 1/e, m."""
    look = image.look
    vector = mean[0] * look + mean[1] * np.array([look[1], -look[0]]) - boxes.wave
    per_column, per_row = image.per_pixel(vector) * boxes.size
    row, column = np.indices(weight.shape)
    level = field * np.exp(-2j * np.pi * (per_column * column + per_row * row)) * (weight > 0)
    shape = [next_fast_len(2 * n) for n in weight.shape]

    def correlate(values: NDArray[np.generic]) -> ComplexArray:
        return np.asarray(ifft2(np.abs(fft2(values, shape)) ** 2))

    product, pairs = correlate(level), correlate(weight > 0).real
    lag = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n, 1 / n) for n in shape), indexing="ij"))
    ring = np.rint(lag).astype(np.int64).ravel()
    known = np.bincount(ring, pairs.ravel())
    together = np.bincount(ring, product.real.ravel())
    enough = np.flatnonzero(known > 0.02 * known.max())
    reach = np.arange(enough.max() + 1)
    ratio = together[reach] / np.maximum(known[reach], 1e-9)
    below = np.flatnonzero(ratio < np.exp(-1))
    first = int(below[0]) if below.size else int(reach[-1])
    return float(first * boxes.size * image.pixel_size)


def local_ratio(image: Image, phase: PhaseField, used: BoolArray, model: FloatArray) -> FloatArray:
    """Smooth ratio of an image and its model over boxes: what trend a model leaves.

    Parameters
    ----------
    image : Image
    phase : PhaseField
    used : ndarray of bool (rows, columns)
    model : ndarray (rows, columns)
        Expected intensity where used.

    Returns
    -------
    ndarray (box rows, box columns)
        1 far from all pixels that are used.
    """
    sums = [box_sums(v, used, 0.0, 0.0, phase.box)[0].real for v in (image.power, model)]
    wavelength = 1 / float(np.hypot(*image.per_pixel(phase.wave)) * phase.box)
    smooth = _Smoother(sums[0].shape, TREND_SD * wavelength)
    seen, expected = (smooth(v).real for v in sums)
    known = expected > 1e-3 * expected.max()
    return np.where(known, np.maximum(seen, 0.05 * expected) / np.where(known, expected, 1.0), 1.0)
