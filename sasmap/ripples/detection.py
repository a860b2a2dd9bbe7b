"""Detection of ripples in a clip: evidence over wave vectors and places.

A peak of the spectrum of the clip or of a part of it (`sasmap.ripples.spectra`) must extend over
several wavelengths, its crests must not be thin lines, and it must not be an object on the sea
floor (`sasmap.ripples.places`). The alternative that explains it best decides.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.fft import fft2
from scipy.special import expit

from sasmap.arrays import BoolArray, FloatArray
from sasmap.ripples.flattening import flattened
from sasmap.ripples.fringes import follows_grazing
from sasmap.ripples.image import Image
from sasmap.ripples.places import (
    contrast_of,
    extents,
    grain_of,
    lines_of,
    objectness,
    undertone,
)
from sasmap.ripples.spectra import (
    MIN_PIXELS,
    MIN_WAVES,
    Peak,
    clip_peaks,
    compared,
    other_peaks,
    taper,
    within_reach,
)

# Most peaks that are examined, to bound the time.
CANDIDATES = 6
# Cosine of the angle between crest normal and look below which height is not identifiable: within
# four degrees of a look along the crests (docs/limits.md).
MIN_ALONG = 0.07
# Log prior odds against a ripple, including the number of cells tested, and extra for parts
# (pipelines/ripples/presence.py, the source of all constants of this file that name no other).
PRIOR, PART_TRIALS = 16.0, 1.5
# Strong waves over several wavelengths are rarely anything else. Largest bonus for them, nats;
# ramps of contrast and extent over which it sets in; ramp of the (negative) number of wavelengths
# over which it ends, as the spectrum suffices with more, and speckle of long grain has as much
# contrast.
STRENGTH, STRONG, WIDE, MANY = 9.0, (0.2, 0.4), (2.65, 2.8), (-12.0, -9.0)
# Ramp of the wavelength over the size of the speckle grain over which the bonus sets in: three to
# five times as long as grains are wide. Clips of grain alone that pass for ripples have 6 to 9,
# recorded ripples 14 and more.
GRAINS = (9.0, 12.0)
# Ramp of the negative excess kurtosis over which the bonus sets in: grain and marks have peaked
# profiles.
ROUND = (-0.3, 0.0)
# Excess kurtosis of a profile above which it counts as lines, and nats per unit of it; allowance
# for a wave train that fills its part of the clip, and ramp of the extent over the number of
# wavelengths over which the allowance sets in: crests whose steep side is seen are a sixth of a
# wavelength wide (0.8 to 1.6 more, at an extent of 0.75 to 0.9; lines of another sonar's
# interference have 0.5 to 0.75).
MAX_KURTOSIS, PER_KURTOSIS, NARROW, FILLING = 0.5, 6.0, 1.5, (0.75, 0.85)
# Power at half the wave number over that at the wave above which blotches explain it, with few and
# with many wavelengths; those numbers of wavelengths; nats per unit of the ratio.
UNDERTONES, FEW_MANY, PER_UNDERTONE = (0.9, 0.4), (5.0, 6.5), 15.0
# Log prior odds against a second system beside a first: about one rippled clip in twenty has one.
SECOND = 3.0
# Cosine above which waves have the same direction, and deviation of their frequency ratio from 2
# within which the shorter may be a harmonic, whose peak is broad where crests bend and fork.
SAME, NEARLY_TWICE = 0.95, 0.3
# Nats in favour of a wave that does not resemble an object at all.
OBJECT = 12.0
# Least extent of a wave along its normal, wavelengths; additional extent required, as a share of
# the available wavelengths beyond twice that (a few lines may be in phase, but not everywhere);
# nats per wavelength.
MIN_EXTENT, OF_MORE, PER_WAVE = 2.5, 0.1, 10.0
# Least extent along the normal over that along the crests, and its upper limit in wavelengths:
# trawl marks, at most four lines, cross a clip from edge to edge (400 such clips have 0.27 to 0.74,
# ripples with forks at least 0.83, recorded ones 0.75).
OF_CRESTS, ENOUGH = 0.7, 5.0
# Loss of phase coherence from crest to crest above which lines may be marks, nats per unit of it,
# and ramp of the (negative) extent along the normal of at most four lines. It is exceeded by 2 % of
# 450 small clips with four to eight forked waves (pipelines/ripples/lookalikes.py), by none of 48
# recorded ones, by 8 of 10 clips of trawl marks that otherwise pass for ripples, and by 2 of 7
# further such clips (the others are in phase by chance or extend farther). Most pairs of parallel
# systems, which are out of phase as well, extend farther.
STEPS, PER_STEP, LINES = 0.25, 60.0, (-4.6, -4.0)
# Share of the spectral evidence that also counts against marks, which are irregularly spaced (of
# 1200 such clips 3 are false positives with it and without).
REGULAR = 0.5
# Evidence below which no further alternative is tested: odds of one in four hundred.
HOPELESS = -6.0
# Evidence above which a wave counts as certain (odds of 20); contrast of the pings' gains, and
# share of their variance, above which they show a wave seen along its crests.
SURE, ALONG_CONTRAST, ALONG_SHARE = 3.0, 0.1, 0.5
# A wave too long for the clip: least wavelengths in the clip, contrast, number of bins that it
# spreads over, share of the clip's variance, and extent over the number of wavelengths.
FEW_WAVES, FEW_CONTRAST, FEW_BINS, FEW_SHARE, FEW_EXTENT = 1.5, 0.3, 3.0, 0.4, 0.6
# Probability of ripples where no peak is examined.
NEVER = 1e-4


class Unclear(StrEnum):
    """Why ripples cannot be detected or excluded in a clip, and what to change."""

    WAVES = "too few wavelengths in the window: choose a larger one"
    PIXELS = "too few pixels per wavelength: use tiles of finer pixels, or bound the frequency"
    ALONG = (
        "seen along the crests, or gain that varies along the track: add a pass on another heading"
    )
    BANDS = (
        "bands along the track, evenly spaced in grazing angle: gain over range, or ripples that "
        "lengthen with it: add a pass on another heading"
    )
    HEIGHT = "no height within the settings' bounds makes ripples of this wavelength: widen them"


class Wave(NamedTuple):
    """A candidate wave.

    Attributes
    ----------
    vector : ndarray (2,)
        Wave vector (east, north), cycles/m.
    evidence : float
        Log posterior odds of a ripple against the best explanation without one.
    energy : float
        Power in its cells, summed over all pixels of the clip.
    whole : bool
        Whether it was found in the spectrum of the whole clip, not only in that of a part.
    """

    vector: FloatArray
    evidence: float
    energy: float
    whole: bool

    @property
    def probability(self) -> float:
        """Probability that it is a ripple."""
        return float(expit(self.evidence))


class Found(NamedTuple):
    """Result of the detection.

    Attributes
    ----------
    waves : list of Wave
        Candidates, the most likely ripple first.
    unclear : Unclear or None
        Why the clip is inconclusive, where it is.
    """

    waves: list[Wave]
    unclear: Unclear | None

    @property
    def probability(self) -> float:
        """Probability that there is a ripple; NaN where the clip is inconclusive."""
        if self.unclear is not None:
            return float("nan")
        return max((w.probability for w in self.waves), default=NEVER)

    @property
    def reason(self) -> str:
        """Why the clip is inconclusive, in words; empty where it is not."""
        return "" if self.unclear is None else str(self.unclear)


def find_waves(image: Image, bounds: tuple[float, float]) -> Found:
    """Look for ripples in a clip.

    Parameters
    ----------
    image : Image
    bounds : tuple of float
        Frequencies to search, cycles/m.
    """
    flat, gains = flattened(image)
    peaks = clip_peaks(flat, image.valid, image.per_pixel(image.look))
    peaks = sorted((p for p in peaks if _within(image, p, bounds)), key=lambda p: -p.evidence)
    cosines = [_along_look(image, p) for p in peaks]
    seen = [p for p, c in zip(peaks, cosines, strict=True) if c > MIN_ALONG][:CANDIDATES]
    along = [p for p, c in zip(peaks, cosines, strict=True) if c <= MIN_ALONG][:CANDIDATES]
    waves = _judged(image, flat, seen)
    if waves and waves[0].evidence > 0:
        first = max((w for w in waves if w.evidence > 0), key=lambda w: w.energy)
        waves += _given(image, flat, image.per_pixel(first.vector), bounds)
    elif seen:
        waves = _crossing(image, flat, seen, bounds) + waves
    unclear = None
    if not waves or waves[0].evidence < 0:
        hidden = any(_wave(image, flat, p).evidence > SURE for p in along)
        unclear = _unclear(image, flat, gains, hidden, bounds)
    shown = np.array([w.vector for w in waves if w.evidence > 0])
    if shown.size and follows_grazing(image, flat, shown):
        return Found([], Unclear.BANDS)
    return Found(waves, unclear)


def _judged(image: Image, flat: FloatArray, peaks: list[Peak]) -> list[Wave]:
    """Judge peaks, the likeliest ripple first; skip parts where the whole clip shows the wave."""
    waves: list[Wave] = []
    there: list[Peak] = []
    for peak in sorted(peaks, key=lambda p: not _whole(p, flat)):
        part = not _whole(peak, flat)
        if part and any(within_reach(peak.per_pixel, p.per_pixel) for p in there):
            continue
        waves.append(_wave(image, flat, peak))
        if not part and waves[-1].evidence > SURE:
            there.append(peak)
    return sorted(waves, key=lambda w: -w.evidence)


def _whole(peak: Peak, flat: FloatArray) -> bool:
    return peak.part == (slice(0, flat.shape[0]), slice(0, flat.shape[1]))


def _given(
    image: Image, flat: FloatArray, known: FloatArray, bounds: tuple[float, float]
) -> list[Wave]:
    """Find waves beside a known one (cycles per column and row) of another system."""
    told = (
        _wave(image, flat, p, beside=True)
        for p in other_peaks(flat, image.valid, image.per_pixel(image.look), known)[:CANDIDATES]
        if _within(image, p, bounds)
        and _along_look(image, p) > MIN_ALONG
        and not _overtone(p.per_pixel, known)
    )
    rarer = (w._replace(evidence=w.evidence - SECOND) for w in told)
    return sorted((w for w in rarer if w.evidence > 0), key=lambda w: -w.evidence)


def _overtone(one: FloatArray, other: FloatArray) -> bool:
    """Whether a wave is about half or twice as long as another one of the same direction."""
    ratio, cosine = compared(one, other)
    return cosine > SAME and abs(max(ratio, 1 / ratio) - 2) < NEARLY_TWICE


def _crossing(
    image: Image, flat: FloatArray, peaks: list[Peak], bounds: tuple[float, float]
) -> list[Wave]:
    """Find two systems, neither detected alone but each certain given the other; else none."""
    whole = next((p.per_pixel for p in peaks if _whole(p, flat)), None)
    others = [] if whole is None else _given(image, flat, whole, bounds)
    if whole is None or not others:
        return []
    known = image.per_pixel(others[0].vector)
    first = [
        w
        for w in _given(image, flat, known, bounds)
        if within_reach(image.per_pixel(w.vector), whole)
    ]
    both = sorted([*first[:1], others[0]], key=lambda w: -w.evidence)
    return both if first and both[-1].evidence > SURE else []


def _within(image: Image, peak: Peak, bounds: tuple[float, float]) -> bool:
    """Whether a peak lies within bounds of the frequency, with a margin for its error."""
    frequency = float(np.hypot(*image.per_metre(peak.per_pixel)))
    slack = 1 + 0.5 / peak.waves
    return bounds[0] / slack <= frequency <= bounds[1] * slack


def _along_look(image: Image, peak: Peak) -> float:
    """Cosine of the angle between a wave's normal and the look."""
    return compared(image.per_metre(peak.per_pixel), image.look)[1]


def _wave(image: Image, flat: FloatArray, peak: Peak, beside: bool = False) -> Wave:
    """Judge a peak by its appearance in the clip: the best alternative explanation decides.

    `beside` says that it belongs to a second system beside a known one.
    """
    whole = _whole(peak, flat)
    places = np.ascontiguousarray(flat[peak.part]), np.ascontiguousarray(image.valid[peak.part])
    evidence = np.inf
    for rival in _rivals(image, flat, places, peak, whole, beside):
        evidence = min(evidence, rival)
        if evidence < HOPELESS:
            break
    return Wave(image.per_metre(peak.per_pixel), evidence, peak.energy, whole)


def _rivals(
    image: Image,
    flat: FloatArray,
    places: tuple[FloatArray, BoolArray],
    peak: Peak,
    whole: bool,
    beside: bool,
) -> Iterator[float]:
    """Log odds of a peak against alternative explanations, the fastest tests first."""
    contrast = contrast_of(*places, peak.per_pixel) * peak.above**1.5  # no texture or relief
    strong = STRENGTH * _ramp(contrast, *STRONG) * _ramp(-peak.waves, *MANY)
    if strong > 0:
        strong *= _ramp(1 / (np.hypot(*peak.per_pixel) * grain_of(flat, image.valid)), *GRAINS)
    told = peak.evidence - PRIOR - (0.0 if whole else PART_TRIALS)
    yield told + strong
    here = extents(*places, peak.per_pixel)
    strong *= _ramp(here.normal, *WIDE)
    yield told + strong
    lines = lines_of(*places, peak.per_pixel)
    yield told + strong * _ramp(-lines, *ROUND)
    filled = _ramp(here.normal / peak.waves, *FILLING)
    yield PER_KURTOSIS * (MAX_KURTOSIS + NARROW * filled - lines)
    least = MIN_EXTENT + OF_MORE * float(np.clip(peak.waves - MIN_EXTENT * 2, 0, 5))
    yield PER_WAVE * (here.normal - least)
    there = here if whole else extents(flat, image.valid, peak.per_pixel)
    across = OF_CRESTS * there.crests * min(there.room, 1.0)
    marks = PER_WAVE * (min(across, ENOUGH) - there.normal)
    marks += PER_STEP * max(there.out_of_step - STEPS, 0.0) * _ramp(-there.normal, *LINES)
    yield REGULAR * max(told, 0.0) - marks
    yield OBJECT * (1 - objectness(flat, image.valid, peak.per_pixel, there))
    if not beside:  # half the wave number may belong to the other system
        amplitude = np.sqrt(np.maximum(image.power[peak.part], 0.0))
        most = np.interp(peak.waves, FEW_MANY, UNDERTONES)
        yield PER_UNDERTONE * (most - undertone(amplitude, places[1], peak.per_pixel))


def _ramp(value: float, low: float, high: float) -> float:
    return float(np.interp(value, (low, high), (0.0, 1.0)))


def _unclear(
    image: Image, flat: FloatArray, gains: FloatArray, hidden: bool, bounds: tuple[float, float]
) -> Unclear | None:
    """Return why a clip without a detected wave is inconclusive, None if it is not."""
    rows, columns = (float(np.ptp(places)) + 1 for places in np.nonzero(image.valid))
    longest = np.hypot(rows, columns) * image.pixel_size / MIN_WAVES
    if longest * bounds[1] < 1:
        return Unclear.WAVES
    if MIN_PIXELS * image.pixel_size * bounds[0] > 1:
        return Unclear.PIXELS
    if hidden or _periodic(gains):
        return Unclear.ALONG
    return Unclear.WAVES if _too_long(image, flat, bounds) else None


def _periodic(gains: FloatArray) -> bool:
    """Whether the pings' gains contain a strong wave, as of crests that run along the look."""
    count = gains.size
    power = np.abs(np.fft.rfft((gains - gains.mean()) * taper(count))) ** 2
    first = int(np.ceil(MIN_WAVES))
    searched = power[first : int(count / MIN_PIXELS) + 1]
    if searched.size < 4 or not searched.max() > 0:
        return False
    k = int(np.argmax(searched))
    here = searched[max(k - 1, 0) : k + 2].sum()
    # half of the energy of a sine under a sine taper lies in its three highest bins
    contrast = 2 * np.sqrt(here / (0.5 * count) / count) * np.sqrt(2)
    a_peak = power[first + k] > power[1:first].max()  # not the tail of a trend
    return bool(a_peak and contrast > ALONG_CONTRAST and here > ALONG_SHARE * searched.sum())


def _too_long(image: Image, flat: FloatArray, bounds: tuple[float, float]) -> bool:
    """Whether a clip is mostly one strong wave with too few wavelengths."""
    tall, wide = (taper(n) ** 2 for n in image.shape)
    size = max(min(image.shape) // 32, 1)
    rows, columns = (np.arange(0, n, size) for n in image.shape)
    strips = np.add.reduceat(flat * tall[:, None], rows, axis=0)
    power = np.abs(fft2(np.add.reduceat(strips * wide, columns, axis=1))) ** 2
    down, right = (np.fft.fftfreq(n, size) for n in power.shape)
    waves = np.hypot(down[:, None] * image.shape[0], right * image.shape[1])
    along = np.stack(np.meshgrid(right, down), axis=-1) @ np.linalg.inv(image.steps)
    frequency = np.hypot(along[..., 0], along[..., 1])
    low = (waves >= FEW_WAVES) & (waves < MIN_WAVES)
    low &= (frequency >= bounds[0]) & (frequency <= bounds[1])
    if not low.any():
        return False
    peak = np.unravel_index(int(np.where(low, power, 0.0).argmax()), power.shape)
    highest = float(power[peak])
    whole = float(tall @ (image.valid @ wide))
    # a wave and its mirror image, each over FEW_BINS bins under a Hann taper
    share = 2 * FEW_BINS * highest / max(float(power[waves > 0].sum()), 1e-300)
    if 2 * np.sqrt(highest) / whole < FEW_CONTRAST or share < FEW_SHARE:
        return False
    wave = np.array([right[peak[1]], down[peak[0]]])
    if extents(flat, image.valid, wave).normal <= FEW_EXTENT * waves[peak]:
        return False
    return lines_of(flat, image.valid, wave) < MAX_KURTOSIS
