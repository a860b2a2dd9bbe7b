"""Is there a ripple in a clip at all? A narrow peak that all strips of the clip share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft

from sasmap.ripples.clip import BinnedClip

FloatArray = NDArray[np.float64]

# A clip must hold this many wavelengths, and a wavelength this many pixels, to show a ripple.
MIN_WAVES = 3.0
MIN_PIXELS = 4.0
FALSE_ALARM = 1e-3
# A ripple's line stands this far above the spectrum around it; what is left of trends, beam
# pattern and single objects does not.
MIN_PEAK = 15.0
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
        Power over the local background.
    phase : ndarray (n,)
        Of cos(2 pi f u + phase), rad, at the clip's centre.
    strips : int
    """

    frequency: FloatArray
    power: FloatArray
    agreement: FloatArray
    peak: FloatArray
    phase: FloatArray
    strips: int


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
    filled = binned.count.sum(axis=1) > 0.25 * binned.count.sum() / max(len(binned.count), 1)
    count, total = binned.count[filled], binned.total[filled]
    if high <= low or len(count) < 4 or total.sum() <= 0:
        return None
    frequency, amplitudes = _strip_amplitudes(_detrended(count, total), binned, low, high)
    if frequency.size < 3:
        return None
    mean = amplitudes.mean(axis=0)
    power = np.abs(mean) ** 2
    strips = len(amplitudes)
    scatter = np.mean(np.abs(amplitudes - mean) ** 2, axis=0) + 1e-300
    agreement = (strips - 1) * power / scatter
    return Spectrum(frequency, power, agreement, power / _background(power), np.angle(mean), strips)


def _detrended(count: FloatArray, total: FloatArray) -> FloatArray:
    """Strip profiles over the clip's smooth trend, less 1, weighted to be 0 where empty."""
    bins = count.shape[1]
    profile = total.sum(axis=0) / np.maximum(count.sum(axis=0), 1)
    used = count.sum(axis=0) > 0
    u = np.linspace(-1, 1, bins)
    floor = 1e-3 * profile[used].mean()
    degree = min(4, int(used.sum()) - 1)
    fit = np.polynomial.Polynomial.fit(
        u[used], np.log(np.maximum(profile[used], floor)), degree, domain=[-1, 1]
    )
    trend = np.exp(np.clip(fit(u), np.log(floor), None))
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
    return frequency, rfft(profiles * taper, size, axis=1)[:, wanted] * turn / taper.sum()


def _background(power: FloatArray) -> FloatArray:
    """Median power around each frequency, its own line left out."""
    line, reach = 3 * OVERSAMPLING, 16 * OVERSAMPLING
    background = np.empty_like(power)
    for i in range(power.size):
        low, high = max(i - reach, 0), min(i + reach, power.size)
        around = np.concatenate([power[low : max(i - line, 0)], power[i + line : high]])
        background[i] = np.median(around) / np.log(2) if around.size >= line else power.mean()
    return np.maximum(background, 1e-300)


def ripple_peaks(found: Spectrum, most: int = 3) -> NDArray[np.int64]:
    """Return the strongest peaks (indices into the spectrum) that pass as ripples, best first.

    A peak passes where its strips agree beyond chance over all frequencies searched
    (probability 1e-3) and it stands out of the spectrum around it.
    """
    trials = max(found.frequency.size / OVERSAMPLING, 1.0)
    freedom = found.strips - 1
    chance = (1 + found.agreement / freedom) ** (-freedom)
    passed = (chance * trials < FALSE_ALARM) & (found.peak > MIN_PEAK)
    passed[1:-1] &= (found.power[1:-1] >= found.power[:-2]) & (found.power[1:-1] >= found.power[2:])
    index = np.flatnonzero(passed)
    return index[np.argsort(-found.power[index], kind="stable")][:most]
