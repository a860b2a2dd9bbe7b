"""The published sampler, as published (ZC 3 and Algorithm 1; docs/science.md).

Median-filtered and normalised amplitudes, a Gaussian likelihood of variance 1 about the raw a*,
phase zero at the track, the crest rule for shadow. It is kept for comparison, with the failures of
the published method.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from scipy.ndimage import median_filter

from sasmap.arrays import FloatArray
from sasmap.ripples.clip import Clip, mean_look
from sasmap.ripples.priors import Prior

# Variance of the Gaussian scattering cross section, rad^2 (ZC 3.2.3).
SIGMA_VARIANCE = np.pi / 3
FILTER = 5
NARROW_WEIGHT = 0.7
# Variances of the proposal's two Gaussians, the same for f and A_H (ZC 3.2.3).
NARROW_VARIANCE, WIDE_VARIANCE = 0.01, 0.1
# The paper gives no number; this one reproduces the printed errors (docs/science.md).
ITERATIONS = 5000


class PriorData(NamedTuple):
    """Truncated Gaussian prior of f and A_H: arrays (2,); precision 0 where flat."""

    mean: FloatArray
    precision: FloatArray
    lower: FloatArray
    upper: FloatArray


def prior_data(prior: Prior) -> PriorData:
    """Convert a prior to the form that the compiled code reads."""
    lower, upper = np.array(prior.bounds, float).T
    return PriorData(np.array(prior.mean, float), 1 / np.array(prior.sd) ** 2, lower, upper)


class PublishedData(NamedTuple):
    """Sufficient statistics of the Gaussian likelihood, one value per range bin."""

    pixels: FloatArray
    mean: FloatArray
    ground_range: FloatArray
    altitude: FloatArray


def normalise(clip: Clip) -> FloatArray:
    """Filter and scale a clip's amplitudes as published.

    Returns
    -------
    ndarray (rows, columns)
        Median filtered over 5 x 5 pixels, minus its mean, over its maximum before the mean was
        subtracted (docs/science.md); NaN outside the valid pixels.
    """
    valid = clip.valid
    middle = float(np.median(clip.amplitude[valid]))
    smooth = median_filter(np.where(valid, clip.amplitude, middle), size=FILTER, mode="reflect")
    largest = smooth[valid].max()
    scaled = (smooth - smooth[valid].mean()) / (largest if largest > 0 else 1.0)
    return np.asarray(np.where(valid, scaled, np.nan))


def reduce(clip: Clip, image: FloatArray) -> PublishedData:
    """Average a normalised clip over range bins one pixel wide, which suffices for the likelihood.

    Parameters
    ----------
    clip : Clip
    image : ndarray (rows, columns)
        As from :func:`normalise`.

    Returns
    -------
    PublishedData
        Of the bins along the mean look that contain pixels.
    """
    valid = clip.valid
    look = np.radians(mean_look(clip))
    x, y = clip.x[valid], clip.y[valid]
    place = ((x - x.mean()) * np.sin(look) + (y - y.mean()) * np.cos(look)) / clip.pixel_size
    bins = np.floor(place - place.min() + 0.5 + 1e-6).astype(np.int64)
    count = np.bincount(bins)
    used = count > 0

    def mean_of(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(bins, values[valid])[used] / count[used])

    means = (mean_of(values) for values in (image, clip.ground_range, clip.altitude))
    return PublishedData(count[used].astype(float), *means)


def initial(data: PublishedData, image: FloatArray, prior: PriorData) -> FloatArray:
    """Return start values: f at the FFT peak of the cross-range mean, A_H at the clip's RMS."""
    step = float(np.median(np.diff(data.ground_range)))
    power = np.abs(np.fft.rfft(data.mean - data.mean.mean()))
    frequency = np.fft.rfftfreq(data.mean.size, step)
    peak = frequency[1 + int(np.argmax(power[1:]))]
    rms = np.sqrt(np.nanmean(image**2))
    return np.asarray(np.clip(np.array([peak, rms]), prior.lower, prior.upper))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def published_amplitude(frequency, height, data):  # type: ignore[no-untyped-def]
    """Raw a* of each range bin (ZC 3 and 4), phase zero at the track."""
    norm = 1.0 / np.sqrt(2.0 * np.pi * SIGMA_VARIANCE)
    wave = 2.0 * np.pi * frequency
    slope_angle = np.arctan(wave * height)
    result = np.zeros(data.mean.size)
    for i in range(result.size):
        r, altitude = data.ground_range[i], data.altitude[i]
        phase = wave * r
        if frequency > 0.0:
            d = ((phase - 0.5 * np.pi) % (2.0 * np.pi)) / wave
            if 0.0 < d < r and height - altitude * d / (r - d) >= height * np.sin(phase):
                continue
        offset = np.arctan2(altitude, r) - 0.5 * np.pi
        flat = np.exp(-(offset**2) / (2 * SIGMA_VARIANCE))
        above = np.exp(-((offset + slope_angle) ** 2) / (2 * SIGMA_VARIANCE))
        below = np.exp(-((offset - slope_angle) ** 2) / (2 * SIGMA_VARIANCE))
        result[i] = norm * (flat + 0.5 * (above - below) * np.cos(phase))
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def published_log_posterior(theta, data, prior):  # type: ignore[no-untyped-def]
    """Log of ZC 12 and 15 up to a constant: Gaussian of variance 1, truncated Gaussian priors."""
    value = 0.0
    for i in range(2):
        if not (prior.lower[i] <= theta[i] <= prior.upper[i]):
            return -np.inf
        value -= 0.5 * prior.precision[i] * (theta[i] - prior.mean[i]) ** 2
    model = published_amplitude(theta[0], theta[1], data)
    for i in range(model.size):
        value -= 0.5 * data.pixels[i] * (data.mean[i] - model[i]) ** 2
    return value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def algorithm_one(start, data, prior, rng, draws):  # type: ignore[no-untyped-def]
    """Fill draws (n, 2) with ZC's Algorithm 1: f, then A_H, each by a two-Gaussian walk."""
    theta = start.copy()
    level = published_log_posterior(theta, data, prior)
    proposed = np.empty(2)
    accepted = 0
    for step in range(draws.shape[0]):
        for i in range(2):
            variance = NARROW_VARIANCE if rng.random() < NARROW_WEIGHT else WIDE_VARIANCE
            proposed[:] = theta
            proposed[i] += np.sqrt(variance) * rng.normal()
            candidate = published_log_posterior(proposed, data, prior)
            if np.log(rng.random()) < candidate - level:
                theta[:] = proposed
                level = candidate
                accepted += 1
        draws[step] = theta
    return accepted


def sample_published(
    clip: Clip, prior: Prior, rng: np.random.Generator
) -> tuple[FloatArray, float]:
    """Run the published sampler on a clip: one chain from the published start.

    Returns
    -------
    draws : ndarray (1, ITERATIONS / 2, 2)
        f (cycles/m) and A_H (m); the first half of the iterations is discarded.
    acceptance : float
    """
    image = normalise(clip)
    data, compiled = reduce(clip, image), prior_data(prior)
    draws = np.empty((ITERATIONS, 2))
    accepted = algorithm_one(initial(data, image, compiled), data, compiled, rng, draws)
    return draws[None, ITERATIONS // 2 :], accepted / (2.0 * ITERATIONS)
