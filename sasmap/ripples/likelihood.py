"""Speckle likelihood of a binned clip, and priors (SCIENCE 3).

The intensity of fully developed speckle is exponential about m = G (lit fraction * a*^2 + n0). Its
likelihood over n pixels of a bin depends on them only through n and their sum; the gain G is
integrated out exactly under its scale-invariant prior 1/G:

    log L = - sum n log s - N log(sum total / s),      s = m / G,  N = sum n

Parameters, in this order: f (cycles/m), A_H (m), b (rad, at the clip's centre), log n0 (noise floor
over the flat sea floor's intensity).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr, logsumexp

from sasmap.ripples.clip import BinnedClip
from sasmap.ripples.scattering import SIGMA_VARIANCE, cross_section

FloatArray = NDArray[np.float64]

PARAMETERS = ("frequency", "height", "phase", "log_noise")
SHADOWS = {"none": 0, "line-of-sight": 1, "crest": 2}
# Receiver noise: about 20 dB below the sea floor, give or take a factor of e^2.
NOISE_MEAN, NOISE_SD = float(np.log(0.01)), 2.0
# A bin's pixels count as spread over at least this fraction of it.
MIN_SPREAD = 1e-3
NOISE_BOUNDS = (float(np.log(1e-6)), float(np.log(10.0)))


class SpeckleData(NamedTuple):
    """What the compiled likelihood reads; all arrays (strips, bins) or (strips,)."""

    count: FloatArray
    total: FloatArray
    tilt: FloatArray  # grazing angle less pi/2, rad
    flat: FloatArray  # intensity of flat sea floor, mean 1
    start: float
    step: float
    range0: FloatArray
    range_slope: FloatArray
    altitude0: FloatArray
    altitude_slope: FloatArray
    spread: float
    shadow: int


class PriorData(NamedTuple):
    """Truncated Gaussian of (f, A_H) as the compiled code reads it."""

    mean: FloatArray
    precision: FloatArray
    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True)
class Prior:
    """Truncated Gaussian prior of (f, A_H) (ZC 7-9), flat where a standard deviation is infinite.

    Attributes
    ----------
    mean, sd : tuple of float
        Of f (cycles/m) and A_H (m) before truncation.
    bounds : tuple of tuple of float
        Truncation bounds of f and of A_H.
    correlation : float
        Between f and A_H.
    """

    mean: tuple[float, float]
    sd: tuple[float, float]
    bounds: tuple[tuple[float, float], tuple[float, float]]
    correlation: float = 0.0

    @classmethod
    def flat(cls, frequency: tuple[float, float], height: tuple[float, float]) -> Self:
        """Return the prior that knows the bounds alone."""
        middle = (sum(frequency) / 2, sum(height) / 2)
        return cls(middle, (np.inf, np.inf), (frequency, height))

    def compiled(self) -> PriorData:
        """Return the arrays that the compiled code reads."""
        inverse = 1 / np.array(self.sd)
        rho = self.correlation
        shape = np.array([[1.0, -rho], [-rho, 1.0]]) / (1 - rho**2)
        lower, upper = np.array(self.bounds, float).T
        return PriorData(
            np.array(self.mean, float), inverse[:, None] * shape * inverse, lower.copy(), upper.copy()
        )


def log_truncated_normal(
    x: ArrayLike, mean: float, sd: float, lower: float, upper: float
) -> FloatArray:
    """Log density of a Gaussian truncated to [lower, upper] (ZC 9), exact far outside its bulk.

    Parameters
    ----------
    x : array_like
    mean, sd : float
        Before truncation; sd above 0.
    lower, upper : float

    Returns
    -------
    ndarray
        Minus infinity outside the bounds.
    """
    x = np.asarray(x, float)
    a, b = (lower - mean) / sd, (upper - mean) / sd
    if a > 0:  # the same interval on the side where log_ndtr does not cancel
        a, b = -b, -a
    mass = logsumexp([log_ndtr(b), log_ndtr(a)], b=[1, -1])
    density = -0.5 * ((x - mean) / sd) ** 2 - np.log(sd) - 0.5 * np.log(2 * np.pi) - mass
    return np.asarray(np.where((x >= lower) & (x <= upper), density, -np.inf))


def speckle_data(binned: BinnedClip, shadow: str) -> SpeckleData:
    """Prepare a binned clip for the compiled likelihood.

    Parameters
    ----------
    binned : BinnedClip
    shadow : {"none", "line-of-sight", "crest"}

    Returns
    -------
    SpeckleData
    """
    u = binned.centres
    ground_range = binned.range0[:, None] + binned.range_slope[:, None] * u
    altitude = binned.altitude0[:, None] + binned.altitude_slope[:, None] * u
    grazing = np.arctan2(np.maximum(altitude, 1e-9), np.maximum(ground_range, 1e-9))
    flat = cross_section(grazing) ** 2
    return SpeckleData(
        binned.count,
        binned.total,
        grazing - np.pi / 2,
        flat / np.average(flat, weights=binned.count),
        binned.start,
        binned.step,
        binned.range0,
        binned.range_slope,
        binned.altitude0,
        binned.altitude_slope,
        max(binned.spread, MIN_SPREAD),
        SHADOWS[shadow],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_prior(theta, prior):  # type: ignore[no-untyped-def]
    """Log prior of the four parameters, up to a constant."""
    for i in range(2):
        if not (prior.lower[i] <= theta[i] <= prior.upper[i]):
            return -np.inf
    if not (NOISE_BOUNDS[0] <= theta[3] <= NOISE_BOUNDS[1]):
        return -np.inf
    value = -0.5 * ((theta[3] - NOISE_MEAN) / NOISE_SD) ** 2
    for i in range(2):
        for j in range(2):
            if prior.precision[i, j] != 0.0:
                value -= (
                    0.5
                    * (theta[i] - prior.mean[i])
                    * prior.precision[i, j]
                    * (theta[j] - prior.mean[j])
                )
    return value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def lit_fractions(theta, data, strip, lit):  # type: ignore[no-untyped-def]
    """Fill the fraction of each bin's pixels that are not in shadow.

    A margin is followed over edges and centres of the bins, positive in shadow: the running maximum
    of (h - altitude) / range less its value here, or the published ray over the crest less h.
    """
    wave = 2.0 * np.pi * theta[0]
    half = 0.5 * data.step
    before = 2 * int(np.ceil(1.0 / (theta[0] * data.step))) if data.shadow == 1 else 0
    highest = -np.inf
    left, centre, margin = -1.0, -1.0, -1.0
    first = wave * (data.start - before * half) + theta[2]
    c, s = np.cos(first), np.sin(first)
    turn_c, turn_s = np.cos(wave * half), np.sin(wave * half)
    for i in range(-before, 2 * lit.size + 1):
        u = data.start + i * half
        r = data.range0[strip] + data.range_slope[strip] * u
        h = theta[1] * s
        if r > half:
            altitude = data.altitude0[strip] + data.altitude_slope[strip] * u
            if data.shadow == 1:
                rise = (h - altitude) / r
                margin = highest - rise
                highest = max(highest, rise)
            else:
                d = ((wave * u + theta[2] - 0.5 * np.pi) % (2.0 * np.pi)) / wave
                margin = theta[1] - altitude * d / (r - d) - h if 0.0 < d < r else -1e-12
        if i >= 0 and i % 2 == 1:
            centre = margin
        elif i >= 0:
            if i > 0:
                lit[i // 2 - 1] = _lit_part(left, centre, margin, data.spread)
            left = margin
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _lit_part(left, centre, right, spread):  # type: ignore[no-untyped-def]
    if left <= 0.0 and centre <= 0.0 and right <= 0.0:
        return 1.0
    if left > 0.0 and centre > 0.0 and right > 0.0:
        return 0.0
    return _lit_half(left, centre, 0.0, spread) + _lit_half(centre, right, 0.5, spread)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _lit_half(left, right, at, spread):  # type: ignore[no-untyped-def]
    """Share of pixels in the lit part of half a bin, margins linear between its ends."""
    low, high = at, at + 0.5
    if left > 0.0 and right > 0.0:
        return 0.0
    if left > 0.0:
        low = at + 0.5 * left / (left - right)
    elif right > 0.0:
        high = at + 0.5 * left / (left - right)
    return _share(high, spread) - _share(low, spread)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _share(position, spread):  # type: ignore[no-untyped-def]
    """Share of a bin's pixels that lie before a position in it."""
    return min(max((position - 0.5) / spread + 0.5, 0.0), 1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def relative_intensity(theta, data, strip, shape):  # type: ignore[no-untyped-def]
    """Fill s = lit a*^2 + n0 for the bins of a strip, in units of the flat sea floor's mean."""
    if data.shadow == 0:
        shape[:] = 1.0
    else:
        lit_fractions(theta, data, strip, shape)
    wave = 2.0 * np.pi * theta[0]
    tilt = np.arctan(wave * theta[1])
    damping = np.exp(-tilt * tilt / (2.0 * SIGMA_VARIANCE))
    noise = np.exp(theta[3])
    # cos(phase) by rotation: one sine and cosine a strip
    first = wave * (data.start + 0.5 * data.step) + theta[2]
    c, s = np.cos(first), np.sin(first)
    turn_c, turn_s = np.cos(wave * data.step), np.sin(wave * data.step)
    for i in range(shape.size):
        grow = np.exp(-tilt * data.tilt[strip, i] / SIGMA_VARIANCE)
        a = 1.0 + damping * 0.5 * (grow - 1.0 / grow) * c
        a = max(a, 0.0)
        shape[i] = shape[i] * data.flat[strip, i] * a * a + noise
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_likelihood(theta, data):  # type: ignore[no-untyped-def]
    """Speckle log likelihood with the gain integrated out, up to a constant."""
    strips, bins = data.count.shape
    shape = np.empty(bins)
    pixels, logs, scaled = 0.0, 0.0, 0.0
    for strip in range(strips):
        relative_intensity(theta, data, strip, shape)
        for i in range(bins):
            n = data.count[strip, i]
            if n > 0.0:
                pixels += n
                logs += n * np.log(shape[i])
                scaled += data.total[strip, i] / shape[i]
    return -logs - pixels * np.log(scaled)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_posterior(theta, data, prior):  # type: ignore[no-untyped-def]
    """Log posterior of the four parameters, up to a constant."""
    value = log_prior(theta, prior)
    if value == -np.inf:
        return value
    return value + log_likelihood(theta, data)
