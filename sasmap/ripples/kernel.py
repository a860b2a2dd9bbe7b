"""The compiled inner loops of the default method, all in one file.

numba keeps compiled code on disk and notices a change only in the file of the function it
compiled; what calls across files could go on using an older version of what it calls.

The intensity of fully developed speckle is exponential about m = G (lit fraction * a*^2 + n0). Its
likelihood over n pixels of a bin depends on them only through n and their sum; the gain G is
integrated out exactly under its scale-invariant prior 1/G:

    log L = - sum n log s - N log(sum total / s) + saturated,      s = m / G,  N = sum n

less that of a saturated model, so that bins can be given less weight: 500 rows of pixels would
claim to know where a shadow's edge lies to a thousandth of a pixel, which no sonar's image, no
navigation and no model of a sea floor can bear. Pixels at an edge therefore count little, which
leaves the edge known to about a pixel.

Parameters theta, in this order: f (cycles/m), A_H (m), b (rad, at the clip's centre), log n0 (noise
floor over the flat sea floor's intensity).
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.scattering import SIGMA_VARIANCE

FloatArray = NDArray[np.float64]

# Receiver noise: about 20 dB below the sea floor, give or take a factor of e^2.
NOISE_MEAN, NOISE_SD = float(np.log(0.01)), 2.0
NOISE_BOUNDS = (float(np.log(1e-6)), float(np.log(10.0)))
# Weight of pixels in bins at a shadow's edge, and the shortest wavelength, in bins, at which they
# may weigh less than others.
EDGE_WEIGHT = 0.02
EDGE_WAVELENGTH = 32.0
# Weights of proposals by differences of two members: scaled for the local mode, and in full.
LOCAL, CROSSING = 0.35, 0.15
STUDENT = 5.0


class SpeckleData(NamedTuple):
    """What the compiled likelihood reads; all arrays (strips, bins) or (strips,)."""

    pixels: FloatArray
    total: FloatArray
    log_mean: FloatArray  # log of total / pixels, 0 where empty
    tilt: FloatArray  # grazing angle less pi/2, rad
    flat: FloatArray  # intensity of flat sea floor, mean 1
    start: float
    step: float
    range0: FloatArray
    range_slope: FloatArray
    altitude0: FloatArray
    altitude_slope: FloatArray
    shift: FloatArray  # mean place of a bin's pixels, in bins from its centre
    spread: float
    smear: float
    shadow: int


class PriorData(NamedTuple):
    """Truncated Gaussian of (f, A_H) as the compiled code reads it."""

    mean: FloatArray
    precision: FloatArray
    lower: FloatArray
    upper: FloatArray


class Proposal(NamedTuple):
    """A frozen mixture proposal.

    Attributes
    ----------
    members : ndarray (n, 4)
        The burn-in population.
    centre : ndarray (4,)
        Of the independent draws.
    factor : ndarray (4, 4)
        Lower Cholesky factor of their scale matrix.
    """

    members: FloatArray
    centre: FloatArray
    factor: FloatArray


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

    Half bin by half bin along the look a margin tells shadow, positive within: the running maximum
    of (h - altitude) / range less its value here, or the published ray over the crest less h.
    """
    lit[:] = 1.0
    wave = 2.0 * np.pi * theta[0]
    half = 0.5 * data.step
    before = 2 * int(np.ceil(1.0 / (theta[0] * data.step))) if data.shadow == 1 else 0
    first = wave * (data.start - before * half) + theta[2]
    c, s = np.cos(first), np.sin(first)
    turn_c, turn_s = np.cos(wave * half), np.sin(wave * half)
    highest, margin, rise, earlier, entered = -np.inf, -1.0, -np.inf, -np.inf, -1.0
    inside = False
    for i in range(-before, 2 * lit.size + 1):
        u = data.start + i * half
        r = data.range0[strip] + data.range_slope[strip] * u
        if r > half:
            h = theta[1] * s
            altitude = data.altitude0[strip] + data.altitude_slope[strip] * u
            last = margin
            if data.shadow == 1:
                latest = (h - altitude) / r
                margin = highest - latest
                if margin > 0.0 and not inside:
                    entered, highest = _vertex(i, earlier, rise, latest)
                highest = max(highest, latest)
                earlier, rise = rise, latest
            else:
                d = ((wave * u + theta[2] - 0.5 * np.pi) % (2.0 * np.pi)) / wave
                margin = theta[1] - altitude * d / (r - d) - h if 0.0 < d < r else -1e-12
                if margin > 0.0 and not inside:
                    entered = i - 1 + last / (last - margin)
            if inside and margin <= 0.0:
                _hide(lit, entered, i - 1 + last / (last - margin), data)
            inside = margin > 0.0
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
    if inside:
        _hide(lit, entered, 2.0 * lit.size + 4.0, data)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _vertex(i, earlier, middle, latest):  # type: ignore[no-untyped-def]
    """Return where between i - 2 and i three values are highest, by a parabola, and how high."""
    bend = earlier - 2.0 * middle + latest
    if not (bend < 0.0 and np.isfinite(earlier)):
        return i - 1.0, middle
    offset = 0.5 * (earlier - latest) / bend
    return i - 1.0 + offset, middle - 0.25 * (earlier - latest) * offset


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _hide(lit, begin, end, data):  # type: ignore[no-untyped-def]
    """Take a shadow between two places, in half bins, off the lit fractions.

    Altitude stretches a shadow: its far edge smears over the strip, its near one hardly.
    """
    begin, end = 0.5 * begin, 0.5 * end
    smeared = min(data.spread + data.smear * (end - begin), 1.0)
    for i in range(max(int(begin) - 1, 0), min(int(end) + 2, lit.size)):
        at = i + data.shift[i]
        hidden = _share(end - at, smeared) - _share(begin - at, data.spread)
        lit[i] = max(lit[i] - hidden, 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _share(position, spread):  # type: ignore[no-untyped-def]
    """Share of a bin's pixels that lie before a position in it."""
    return min(max((position - 0.5) / spread + 0.5, 0.0), 1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def relative_intensity(theta, data, strip, shape, weight):  # type: ignore[no-untyped-def]
    """Fill s = lit a*^2 + n0 for the bins of a strip, in units of the flat sea floor's mean.

    Bins that touch a shadow's edge get the edges' weight, others 1; at short wavelengths, where
    edges would make up the clip and excuse any misfit, all get 1.
    """
    weight[:] = 1.0
    if data.shadow == 0:
        shape[:] = 1.0
    else:
        lit_fractions(theta, data, strip, shape)
        if theta[0] * data.step * EDGE_WAVELENGTH < 1.0:
            for i in range(1, shape.size):
                if shape[i] != shape[i - 1]:
                    weight[i - 1] = weight[i] = EDGE_WEIGHT
    wave = 2.0 * np.pi * theta[0]
    tilt = np.arctan(wave * theta[1])
    damping = np.exp(-tilt * tilt / (2.0 * SIGMA_VARIANCE))
    noise = np.exp(theta[3])
    first = wave * (data.start + 0.5 * data.step) + theta[2]
    turn = wave * data.step
    for i in range(shape.size):
        c = np.cos(first + turn * (i + data.shift[i]))
        grow = np.exp(-tilt * data.tilt[strip, i] / SIGMA_VARIANCE)
        a = 1.0 + damping * 0.5 * (grow - 1.0 / grow) * c
        a = max(a, 0.0)
        shape[i] = shape[i] * data.flat[strip, i] * a * a + noise


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_likelihood(theta, data):  # type: ignore[no-untyped-def]
    """Speckle log likelihood with the gain integrated out, up to a constant."""
    strips, bins = data.pixels.shape
    shape = np.empty(bins)
    weight = np.empty(bins)
    pixels, logs, scaled = 0.0, 0.0, 0.0
    for strip in range(strips):
        relative_intensity(theta, data, strip, shape, weight)
        for i in range(bins):
            n = weight[i] * data.pixels[strip, i]
            if n > 0.0:
                pixels += n
                logs += n * (np.log(shape[i]) - data.log_mean[strip, i])
                scaled += weight[i] * data.total[strip, i] / shape[i]
    return -logs - pixels * np.log(scaled / pixels)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_posterior(theta, data, prior):  # type: ignore[no-untyped-def]
    """Log posterior of the four parameters, up to a constant."""
    value = log_prior(theta, prior)
    if value == -np.inf:
        return value
    return value + log_likelihood(theta, data)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def scan_grid(frequencies, heights, phases, noise, data, prior, table):  # type: ignore[no-untyped-def]
    """Fill rows (theta, log posterior) of a table over a grid of f, A_H and b."""
    row = 0
    theta = np.empty(4)
    theta[3] = noise
    for f in frequencies:
        for height in heights:
            for b in phases:
                theta[0], theta[1], theta[2] = f, height, b
                table[row, :4] = theta
                table[row, 4] = log_likelihood(theta, data) + log_prior(theta, prior)
                row += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def move_population(particles, level, power, factor, moves, data, prior, rng):  # type: ignore[no-untyped-def]
    """Move particles in place by Metropolis-Hastings at a power of the likelihood.

    Returns the accepted fraction; `factor` is the Cholesky factor of the steps' covariance.
    """
    n, size = particles.shape
    accepted = 0
    proposed = np.empty(size)
    normal = np.empty(size)
    for k in range(n):
        before = log_prior(particles[k], prior)
        for _ in range(moves):
            # steps of several sizes: one covariance does not fit all modes
            scale = 1.2 * 10.0 ** (-1.5 * rng.random())
            for i in range(size):
                normal[i] = rng.normal()
            for i in range(size):
                proposed[i] = particles[k, i]
                for j in range(i + 1):
                    proposed[i] += scale * factor[i, j] * normal[j]
            after = log_prior(proposed, prior)
            if after == -np.inf:
                continue
            candidate = log_likelihood(proposed, data)
            gain = power * (candidate - level[k]) + after - before
            if np.log(rng.random()) < gain:
                particles[k] = proposed
                level[k] = candidate
                before = after
                accepted += 1
    return accepted / (n * moves)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def run_chain(state, proposal, data, prior, rng, draws):  # type: ignore[no-untyped-def]
    """Fill draws (n, 4) with a Metropolis-Hastings chain; return how many steps it accepted."""
    current = state.copy()
    level = log_posterior(current, data, prior)
    proposed = np.empty(state.size)
    accepted = 0
    for step in range(draws.shape[0]):
        correction = _propose(current, proposal, rng, proposed)
        candidate = log_posterior(proposed, data, prior)
        if np.log(rng.random()) < candidate - level + correction:
            current[:] = proposed
            level = candidate
            accepted += 1
        draws[step] = current
    return accepted


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _propose(current, proposal, rng, proposed):  # type: ignore[no-untyped-def]
    """Fill a proposed state; return log q(current | proposed) - log q(proposed | current)."""
    size = current.size
    kind = rng.random()
    if kind < LOCAL + CROSSING:
        length = proposal.members.shape[0]
        first = rng.integers(0, length)
        second = rng.integers(0, length)
        scale = 1.0
        if kind < LOCAL:
            scale = 2.38 / np.sqrt(2.0 * size) * 10.0 ** (-rng.random())
        for i in range(size):
            proposed[i] = current[i] + scale * (
                proposal.members[first, i] - proposal.members[second, i]
            )
            # the population alone spans finitely many points; a little noise reaches all others
            proposed[i] += 1e-3 * proposal.factor[i, i] * rng.normal()
        return 0.0
    heavy = np.sqrt(STUDENT / rng.chisquare(STUDENT))
    normal = np.empty(size)
    for i in range(size):
        normal[i] = rng.normal()
        proposed[i] = proposal.centre[i]
        for j in range(i + 1):
            proposed[i] += heavy * proposal.factor[i, j] * normal[j]
    return _log_student(current, proposal) - _log_student(proposed, proposal)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _log_student(x, proposal):  # type: ignore[no-untyped-def]
    """Log density of the independent draws, up to a constant."""
    size = x.size
    z = np.empty(size)
    square = 0.0
    for i in range(size):
        z[i] = x[i] - proposal.centre[i]
        for j in range(i):
            z[i] -= proposal.factor[i, j] * z[j]
        z[i] /= proposal.factor[i, i]
        square += z[i] * z[i]
    return -0.5 * (STUDENT + size) * np.log1p(square / STUDENT)
