"""Is there a ripple in a clip at all? A narrow peak that all strips of the clip share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft

from sasmap.ripples.clip import BinnedClip

FloatArray = NDArray[np.float64]

# A clip must hold this many wavelengths, and a wavelength this many pixels, to show a ripple.
MIN_WAVES = 3.5
MIN_PIXELS = 4.0
FALSE_ALARM = 1e-3
# A ripple's line stands this far above the spectrum around it; what is left of trends, beam
# pattern and single objects does not.
MIN_PEAK = 15.0
HALF_CHANCE, HALF_STRENGTH = 0.01, 0.2
OVERSAMPLING = 8


class Spectrum(NamedTuple):
    """Search for a ripple along the look.

    Attributes
    ----------
    frequency : ndarray (n,)
        cycles/m.
    power : ndarray (n,)
        Of the mean over strips.
    agreement : ndarray (n,)
        F statistic (2, 2 strips - 2) of the strips' common complex amplitude.
    peak : ndarray (n,)
        Power over the local background; 0 below the lowest frequency searched.
    profiles : ndarray (strips, bins)
        What was transformed: intensity over its trend, less 1.
    u : ndarray (bins,)
        m along the look.
    """

    frequency: FloatArray
    power: FloatArray
    agreement: FloatArray
    peak: FloatArray
    profiles: FloatArray
    u: FloatArray


def spectrum(binned: BinnedClip, bounds: tuple[float, float]) -> Spectrum | None:
    """Compute the strips' spectra along the look and how well they agree.

    Parameters
    ----------
    binned : BinnedClip
        In strips.
    bounds : tuple of float
        Frequencies to search, cycles/m.

    Returns
    -------
    Spectrum or None
        None where the clip is too short or too coarse for any frequency within the bounds, or has
        too little data.
    """
    length, step = binned.length, binned.step
    low, high = max(bounds[0], MIN_WAVES / length), min(bounds[1], 1 / (MIN_PIXELS * step))
    # the spectrum below the lowest ripple shows what trends and objects leave there
    floor = 1 / length
    filled = binned.pixels.sum(axis=1) > 0.25 * binned.pixels.sum() / max(len(binned.pixels), 1)
    count, total = binned.pixels[filled], binned.total[filled]
    if high <= low or len(count) < 4 or total.sum() <= 0:
        return None
    profiles = _detrended(count, total)
    frequency, amplitudes = _strip_amplitudes(profiles, binned, floor, high)
    if frequency.size < 3:
        return None
    power = np.abs(amplitudes.mean(axis=0)) ** 2
    agreement = _agreement(amplitudes)
    peak = np.where(frequency >= low, power / _background(power), 0.0)
    return Spectrum(frequency, power, agreement, peak, profiles, binned.centres)


def _agreement(amplitudes: NDArray[np.complex128]) -> FloatArray:
    """F statistic of a common complex amplitude of strips (first axis)."""
    mean = amplitudes.mean(axis=0)
    scatter = np.mean(np.abs(amplitudes - mean) ** 2, axis=0) + 1e-300
    return np.asarray((len(amplitudes) - 1) * np.abs(mean) ** 2 / scatter)


def _chance(agreement: FloatArray, strips: int) -> FloatArray:
    """Probability that strips without a ripple agree as well: the tail of F(2, 2 strips - 2)."""
    return np.asarray((1 + agreement / (strips - 1)) ** (1.0 - strips))


def _detrended(count: FloatArray, total: FloatArray) -> FloatArray:
    """Strip profiles over the clip's smooth trend, less 1, weighted to be 0 where empty."""
    bins = count.shape[1]
    profile = total.sum(axis=0) / np.maximum(count.sum(axis=0), 1)
    used = count.sum(axis=0) > 0
    u = np.linspace(-1, 1, bins)
    degree = min(4, int(used.sum()) - 1)
    # of the intensity, not its log: shadows would bend that
    fit = np.polynomial.Polynomial.fit(u[used], profile[used], degree, domain=[-1, 1])
    trend = np.maximum(fit(u), 0.1 * profile[used].mean())
    value = np.where(count > 0, total / np.maximum(count, 1) / trend, 0.0)
    weight = count / max(count.max(), 1)
    mean = (weight * value).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)
    # relative to the strip's own level: a dark strip votes as much as a bright one
    level = np.where(mean > 0, mean, 1.0)[:, None]
    return np.asarray(weight * (np.minimum(value / level, 20.0) - 1.0))


def _strip_amplitudes(
    profiles: FloatArray, binned: BinnedClip, low: float, high: float
) -> tuple[FloatArray, NDArray[np.complex128]]:
    """Tapered spectra of strip profiles at frequencies within bounds, phase zero at u = 0."""
    bins = profiles.shape[1]
    size = next_fast_len(OVERSAMPLING * bins, real=True)
    taper = np.sin(np.pi * (np.arange(bins) + 0.5) / bins) ** 2
    every = np.fft.rfftfreq(size, binned.step)
    wanted = (every >= low) & (every <= high)
    frequency = every[wanted]
    turn = np.exp(-2j * np.pi * frequency * binned.centres[0])
    amplitudes = rfft(profiles * taper, size, axis=1)[:, wanted] * turn / taper.sum()
    return np.asarray(frequency, float), amplitudes


def _background(power: FloatArray) -> FloatArray:
    """Power around each frequency, its own line left out: the larger of both sides' medians.

    The spectrum of trends and objects falls with frequency; the median of both sides together
    would let its low end pass as a peak.
    """
    line, reach = 2 * OVERSAMPLING, 16 * OVERSAMPLING
    background = np.full(power.size, power.mean())
    for i in range(power.size):
        sides = (power[max(i - reach, 0) : max(i - line, 0)], power[i + line : i + reach])
        levels = [np.median(side) / np.log(2) for side in sides if side.size >= line]
        if levels:
            background[i] = max(levels)
    return np.asarray(np.maximum(background, 1e-300))


def ripple_peaks(found: Spectrum, most: int = 3) -> NDArray[np.int64]:
    """Return the strongest peaks (indices into the spectrum) that pass as ripples, best first.

    A peak passes where its strips agree beyond chance over all frequencies searched
    (probability 1e-3), it stands out of the spectrum around it, and both halves of the clip along
    the look show it.
    """
    strips = len(found.profiles)
    trials = max(found.frequency.size / OVERSAMPLING, 1.0)
    passed = (_chance(found.agreement, strips) * trials < FALSE_ALARM) & (found.peak > MIN_PEAK)
    passed[[0, -1]] = False
    passed[1:-1] &= (found.power[1:-1] >= found.power[:-2]) & (found.power[1:-1] >= found.power[2:])
    index = np.flatnonzero(passed)
    index = index[np.argsort(-found.power[index], kind="stable")]
    return np.array([i for i in index.tolist() if _in_both_halves(found, i)][:most], np.int64)


def too_long(found: Spectrum, bounds: tuple[float, float]) -> bool:
    """Whether the strips share a strong wave that is too long for the clip to show it is one.

    Parameters
    ----------
    found : Spectrum
    bounds : tuple of float
        Frequencies of the prior, cycles/m.

    Returns
    -------
    bool
        True where a peak between 1.5 and MIN_WAVES wavelengths a clip, within the bounds, has a
        contrast of at least 0.3, strips that agree beyond chance and shows in both halves.
    """
    length = found.u[-1] - found.u[0]
    f, power = found.frequency, found.power
    low = (f >= max(1.5 / length, bounds[0])) & (found.peak == 0)
    agree = _chance(found.agreement, len(found.profiles)) < FALSE_ALARM
    top = np.zeros(f.size, bool)
    top[1:-1] = (power[1:-1] > power[:-2]) & (power[1:-1] > power[2:])
    strong = np.flatnonzero(low & agree & top & (2 * np.sqrt(power) > 0.3))
    return any(_in_both_halves(found, i) for i in strong.tolist())


def _in_both_halves(found: Spectrum, index: int) -> bool:
    """Whether the near and the far half of the clip each show the wave: an edge does not."""
    bins = found.u.size
    strengths = []
    for part in (slice(0, bins // 2), slice(bins // 2, bins)):
        wave = np.exp(-2j * np.pi * found.frequency[index] * found.u[part])
        wave = wave * np.sin(np.pi * (np.arange(wave.size) + 0.5) / wave.size) ** 2
        amplitudes = (found.profiles[:, part] * wave).sum(axis=1, keepdims=True)
        if _chance(_agreement(amplitudes), len(amplitudes))[0] > HALF_CHANCE:
            return False
        strengths.append(abs(amplitudes.mean()))
    return bool(min(strengths) > HALF_STRENGTH * max(strengths))
