"""Ripple phase: straight crests where they suffice, else a smooth phase field.

Smoothing the demodulated clip gives the phase of the image's fundamental at every place, forks
included. Odd and even stripes across the crests are smoothed separately, and each pixel takes its
phase from the other set, so that speckle is not mistaken for phase. The width of the smoothing is
the one that predicts the other set best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2, ifft2, next_fast_len

from sasmap.arrays import BoolArray, ComplexArray, FloatArray
from sasmap.ripples.demodulation import (
    BoxSums,
    covered_boxes,
    smoothed,
    windings,
)
from sasmap.ripples.image import Image
from sasmap.ripples.pixels import spread_boxes

# Standard deviations, in wavelengths, of the Gaussians that smooth the phase.
STIFFNESS = (0.5, 0.65, 1.0, 1.5, 2.2, 3.3, 5.0)
# Least score of a field of each stiffness, over that of straight crests, for it to be preferred: a
# stiffness below one wavelength mistakes the pulse's own shape for phase.
STRAIGHT = np.array([1.03, 1.012, 1.004, 1.004, 1.003, 1.003, 1.003])
# Error of the phase's mean slope, as a share of the phase's wander, and in cycles over the clip for
# one fork, growing with the square root of their number (pipelines/ripples/coherent.py).
WANDER_SHARE, FORK_TURN = 0.2, 0.075
# The same share for bends that are too slight for a field to be followed (90 coherent cells with a
# wander of 0.2 to 0.9 rad over 5 to 10 m; without it f was off by 2.35 standard deviations, rms).
SLIGHT_SHARE = 0.4


@dataclass(frozen=True)
class PhaseField:
    """Phase of a clip's ripples.

    Attributes
    ----------
    wave : ndarray (2,)
        Wave vector (east, north) that the field is relative to, cycles/m.
    shape : tuple of int
        Shape of the image: rows, columns.
    box : int
        Side length of a box in pixels.
    stripes : ndarray (2,)
        Number of stripes across the crests per column and per row; odd and even ones alternate.
    even, odd, both : ndarray of complex (box rows, box columns)
        Unit phasors of the field from even stripes, from odd ones, and from all.
    covered : ndarray of bool (box rows, box columns)
        Whether a box has ripples, without the rim of gaps.
    origin : float
        Phase of a straight wave's image at the clip's centre, cycles.
    mean_wave, wave_sd : ndarray (2,)
        Mean wave vector of the image's phase along and across the look, cycles/m, and its standard
        deviation due to wander, forks and slight bends.
    error : float
        Error of the field at a pixel, rad; 0 where rigid.
    coherence_length : float
        Distance at which the correlation of the phase, without its mean slope, falls to 1/e, m; the
        clip's largest distance where it stays above that.
    stiffness : float
        Standard deviation of the Gaussian that smooths the field, m; infinite where rigid.
    """

    wave: FloatArray
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
    stiffness: float

    def per_pixel(self, image: Image) -> FloatArray:
        """Cycles of the plane wave per column, per row, and at the clip's centre (3,)."""
        return np.append(image.per_pixel(self.wave), self.origin)

    @property
    def rigid(self) -> bool:
        """Whether crests are straight, so that there is no field."""
        return bool(np.isinf(self.stiffness))

    @property
    def middle(self) -> float:
        """Mean phase of the wave's image, referred to the clip's centre, cycles."""
        if self.rigid:
            return self.origin
        total = self.both[self.covered].sum()
        return self.origin + float(np.angle(total) / (2 * np.pi))

    @cached_property
    def cycles(self) -> FloatArray:
        """Phase of the field at every pixel, cycles; empty where crests are straight."""
        if self.rigid:
            return np.empty((0, 0))
        row, column = np.ogrid[: self.shape[0], : self.shape[1]]
        stripe = np.floor(self.stripes[0] * (column + 0.5) + self.stripes[1] * (row + 0.5))
        even, odd = (spread_boxes(f, self.box, self.shape) for f in (self.even, self.odd))
        return np.asarray(np.angle(np.where(stripe % 2 == 0, odd, even)) / (2 * np.pi))

    def pixels(self, boxes: BoolArray) -> BoolArray:
        """Expand a mask of boxes to the image's pixels."""
        wide = np.repeat(np.repeat(boxes, self.box, axis=0), self.box, axis=1)
        return wide[: self.shape[0], : self.shape[1]]


def straight(image: Image, boxes: BoxSums) -> PhaseField:
    """Return the phase of straight crests: a plane wave and no field.

    Parameters
    ----------
    image : Image
    boxes : BoxSums
        Demodulated at the wave.
    """
    covered = covered_boxes(image, boxes)
    one = np.ones(boxes.count.shape, complex)
    along, across = image.places(boxes.size)
    total = np.where(covered, boxes.turned, 0).sum()
    return PhaseField(
        boxes.wave,
        image.shape,
        boxes.size,
        boxes.stripes,
        one,
        one,
        one,
        covered,
        float(np.angle(total)) / (2 * np.pi),
        _along_and_across(image, boxes.wave),
        np.zeros(2),
        0.0,
        float(np.hypot(np.ptp(along), np.ptp(across))),
        float("inf"),
    )


def _along_and_across(image: Image, wave: FloatArray) -> FloatArray:
    """Components of a wave vector (east, north) along and across the look."""
    return np.array([wave @ image.look, wave @ image.beside])


class FieldTrials(NamedTuple):
    """Phase fields, and how well they predict boxes that were not used to estimate them.

    Attributes
    ----------
    scores : ndarray
        Predicted amplitude for each of STIFFNESS, over that of a plane wave.
    fields : list of tuple of ndarray of complex
        The fields of even and of odd stripes, smoothed.
    """

    scores: FloatArray
    fields: list[tuple[ComplexArray, ComplexArray]]


def trial_fields(boxes: BoxSums) -> FieldTrials:
    """Smooth the phase at several stiffnesses and score each on the boxes it did not use.

    Parameters
    ----------
    boxes : BoxSums
        Demodulated at a refined wave.
    """
    stripes = boxes.stripes
    row, column = (np.indices(boxes.count.shape) + 0.5) * boxes.size
    even = np.floor(stripes[0] * column + stripes[1] * row) % 2 == 0
    whole = abs(boxes.turned.sum())
    scores, fields = [], []
    for stiffness in STIFFNESS:
        sd = max(stiffness * boxes.wavelength, 0.8)
        first = smoothed(np.where(even, boxes.turned, 0), sd)
        second = smoothed(np.where(even, 0, boxes.turned), sd)
        fields.append((first, second))
        unseen = np.where(even, _unit(second), _unit(first))
        scores.append(float((boxes.turned * np.conj(unseen)).sum().real) / max(whole, 1e-300))
    return FieldTrials(np.array(scores), fields)


def with_slight_bends(image: Image, phase: PhaseField, trials: FieldTrials) -> PhaseField:
    """Give straight crests the error of the mean slope due to bends that are too slight to follow.

    A field of an rms of s rad predicts the clip better than a plane wave by s^2 / 2.
    """
    gain = max(float((trials.scores - 1)[np.array(STIFFNESS) >= 1].max()), 0.0)
    length = max(image.shape) * image.pixel_size
    sd = SLIGHT_SHARE * np.sqrt(2 * gain) / (2 * np.pi * length)
    return replace(phase, wave_sd=np.full(2, sd))


def _unit(values: ComplexArray) -> ComplexArray:
    size = np.abs(values)
    return np.asarray(np.where(size > 0, values / np.where(size > 0, size, 1), 1.0))


def best_field(image: Image, boxes: BoxSums, trials: FieldTrials) -> PhaseField:
    """Return the phase field that predicts the clip best."""
    best = int(np.argmax(trials.scores / STRAIGHT))
    even, odd = trials.fields[best]
    field = _unit(even + odd)
    covered = covered_boxes(image, boxes)
    weight = np.where(covered, boxes.count, 0.0)
    product = even * np.conj(odd)
    agree = (weight * _unit(product)).sum().real / max(weight.sum(), 1.0)
    smear = float(np.clip(np.sqrt(-np.log(np.clip(agree, 0.1, 0.9999))), 0.05, 1.2))
    # the stiffer fields pass over some forks; none is counted where crests only wander
    forks = max(_forks(_unit(one + other), weight) for one, other in trials.fields)
    mean, sd = _mean_wave(image, boxes, field, weight, smear, forks)
    return PhaseField(
        boxes.wave,
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
        float(STIFFNESS[best] * boxes.wavelength * boxes.size * image.pixel_size),
    )


def _mean_wave(
    image: Image,
    boxes: BoxSums,
    field: ComplexArray,
    weight: FloatArray,
    smear: float,
    forks: int,
) -> tuple[FloatArray, FloatArray]:
    """Mean wave vector of the phase along and across the look, and its error, cycles/m.

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
        # the wander that remains leaves the mean slope uncertain
        rest = (turn - slope) * (parabola > 0)
        wander = np.cumsum((rest * both).sum(axis=1) / np.maximum(both.sum(axis=1), 1e-9))
        spreads.append(float(wander.std() + smear) / max(high - low, 1))
    per_pixel = image.per_pixel(boxes.wave) + np.array(slopes)
    mean = _along_and_across(image, image.per_metre(per_pixel))
    length = boxes.size * image.pixel_size
    sd = WANDER_SHARE * float(np.hypot(*spreads)) / (2 * np.pi * length)
    turned = FORK_TURN * np.sqrt(forks) / (max(weight.shape) * length)
    return mean, np.full(2, np.hypot(sd, turned))


def _forks(field: ComplexArray, weight: FloatArray) -> int:
    """Count phase singularities, where crests split or end."""
    inside = (weight[:-1, :-1] > 0) & (weight[1:, 1:] > 0)
    return int((np.abs(windings(field)) * inside).sum())


def _coherence_length(
    image: Image, boxes: BoxSums, field: ComplexArray, weight: FloatArray, mean: FloatArray
) -> float:
    """Lag at which the correlation of exp(i field), without its mean slope, falls to 1/e, m."""
    vector = mean[0] * image.look + mean[1] * image.beside - boxes.wave
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
