"""Forward model: the rendered sonar image of one ripple wavelength, and the likelihood of a clip.

One wavelength of sea floor is cut into facets. Each has its local grazing angle, its area, its
place in the image (an echo is placed by its slant range as if the floor were flat, so that crests
lean towards the sonar) and is lit or in shadow by line of sight. Their power is summed in bins of
image phase and blurred. This works for any crest profile and any scattering law; the estimate, the
modelled image and ripple removal all use it. The model of Zare and Cobb (2013, equations 3 and 4)
is rendered by the same loop where a survey asks for it.

The intensity of fully developed speckle is exponential about its mean m = g P + n0, with P the
pulse, g the gain that a few blocks of range share and n0 the noise floor. A clip enters through the
number n of pixels and the mean intensity in each bin of a phase-range histogram:

    log L = - sum w n (log m + mean intensity / m)

with w the weight of a pixel: less than one where speckle is correlated or the model may be wrong.

All compiled functions that call each other are in this file: numba caches compiled code on disk and
notices a change only in the file of the function that it compiled.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sasmap.arrays import FloatArray, IntArray

# Facets per bin: with 1.5 the bins alias by 10 % in A_H, with 4 they do not.
FACETS = 3
# Stride of the blocks of range that are rendered where no shadow falls; others are interpolated.
RENDERED = 3
# Fast-math flags: sums may be taken in any order, so that they can be vectorised.
FAST = {"reassoc", "contract", "nsz", "arcp"}
# Convergence limit of a gain: square of its last step, in standard deviations.
GAIN_TOLD = 1e-4
# Nodes of the scattering law over the sine of the local grazing angle.
NODES = 512
SINES = np.maximum(np.arange(NODES), 0.1) / (NODES - 1.0)
LOG_SINES, OFFSETS = np.log(SINES), (np.arcsin(SINES) - 0.5 * np.pi) ** 2
# Third harmonic of the crest profile over the square of the asymmetry: 1/2 in sin(x + a sin(x)),
# 4/3 in a sawtooth. Stokes's second-order and the peaked profile have none.
BOUND = 0.75
# Prior of the second harmonics of the crest profile over A_H, mean and standard deviation, and
# their largest value: 0 is a sine, 0.25 in phase with the crest is the peaked profile
# 2((1 + sin)/2)^2 - 1, and beyond 0.4 a second crest grows in the trough.
PEAKEDNESS, ASYMMETRY, MOST_HARMONIC = (0.06, 0.09), (0.0, 0.2), 0.4
# Prior of the scattering law sin^n exp(-c (theta - pi/2)^2), mean and standard deviation: n = 0,
# c = 3/pi is Zare and Cobb's, n = 2, c = 0 Lambert's, near which real sand is at 5 to 40 degrees
# (Boehme 1985; Olson et al. 2016); n = 4 is reached below a critical angle (APL-UW TR 9407). The
# bounds, of n and of c, lie beyond any sea floor.
EXPONENT, CONCENTRATION = (1.6, 1.2), (0.5, 0.6)
LAW_BOUNDS = (-1.5, 6.0)
# Grazing angles between which a law's departure from the family is linear in the log of the sine.
LAW_KNOTS = np.log(np.sin(np.radians(np.array([4.0, 9.0, 18.0, 33.0, 50.0, 70.0]))))
# The knot below each node, and the node's share of the way to the next.
KNOT = np.clip(np.searchsorted(LAW_KNOTS, LOG_SINES) - 1, 0, LAW_KNOTS.size - 2)
PAST_KNOT = np.clip((LOG_SINES - LAW_KNOTS[KNOT]) / np.diff(LAW_KNOTS)[KNOT], 0.0, 1.0)
# Log of the noise floor over the clip's mean intensity (20 dB down, 90 % within -31 and -9 dB), and
# the power of range that it follows in the image: 0 as received, 2 to 3 where the range trend was
# removed under Lambert's law. Mean and standard deviation of the priors.
NOISE_LOG, NOISE_SLOPE = (float(np.log(0.01)), 1.5), (1.0, 1.25)
# Standard deviation of the log of the blur about its expectation.
BLUR_SD = 0.35
# Least altitude over that from the navigation (a choice).
LEAST_SCALE = 0.1
# Change of log A_H over the range of a clip: standard deviations of its first cosines. Of 53 cells
# of an independent simulator, whose heights change by factors of 1.3 to 10 or come in groups, 8
# were off by 4 standard deviations and 20 % without it, 1 with 0.07 and 1 with 0.1, where
# calibration is worse (pipelines/ripples/calibration.py).
HEIGHT_TREND = (0.07, 0.07, 0.07)
# Sampling coordinates that change no pulse: phase, noise floor and its power of range.
NO_PULSE = (1, 7, 8)
# Relative change below which two terms of its series give its log to a relative 3e-5.
SMALL = 0.01
LINE_OF_SIGHT, CREST = 1, 2


class Parameters(NamedTuple):
    """Model parameters of one look at a clip.

    Attributes
    ----------
    wave_offset : float
        Wave number of the image's fundamental along the look minus that of the histogram, cycles/m.
    phase : float
        Phase of the image's fundamental at the clip's centre minus that of the histogram, rad.
    height : float
        A_H, half the height from trough to crest, m.
    exponent, concentration : float
        n and c of the scattering law, intensity sin^n(theta) exp(-c (theta - pi/2)^2).
    peakedness, asymmetry : float
        p and q of the profile sin(x) - p cos(2x) - q sin(2x) + 3/4 q^2 sin(3x), scaled so that half
        its range is 1.
    noise, noise_slope : float
        Noise floor over the clip's mean intensity at mean range, and its power of range.
    blur : float
        Standard deviation of the image's blur along the crest normal, cycles.
    altitude_scale : float
        True altitude over the altitude from the navigation.
    trend_1, trend_2, trend_3 : float
        Change of log A_H over the clip's range: amplitudes of its first cosines.
    """

    wave_offset: float
    phase: float
    height: float
    exponent: float
    concentration: float
    peakedness: float
    asymmetry: float
    noise: float
    noise_slope: float
    blur: float
    altitude_scale: float
    trend_1: float = 0.0
    trend_2: float = 0.0
    trend_3: float = 0.0


class Histogram(NamedTuple):
    """Histogram of a clip by phase and range: arrays (blocks, bins) or (blocks,).

    Attributes
    ----------
    pixel_count, intensity_sum : ndarray (blocks, bins)
        Number of pixels that are not saturated, and sum of their intensity over the clip's local
        mean; both times the weight of a pixel.
    phase_offset : ndarray (blocks, bins)
        Mean phase of a bin's pixels relative to its middle, cycles.
    range_offset : ndarray (blocks, bins)
        Mean ground range of a bin's pixels minus the block's, m: the edge of a shadow moves within
        a block, and with straight crests each bin samples only one place of the block.
    place : ndarray (blocks,)
        Mean position along the look relative to the clip's centre, m.
    ground_range, altitude : ndarray (blocks,)
        m.
    trend : ndarray (blocks,)
        Local mean intensity over the clip's.
    group : ndarray of int (blocks,)
        Consecutive blocks that share a gain, numbered from 0.
    errors : ndarray (errors, blocks, bins)
        Possible errors of the log of the expected intensity, one standard deviation each.
    error_axes : ndarray (errors, errors)
        Columns are the directions in which the errors' information is diagonal.
    error_information : ndarray (errors,)
        Along each of these, without the prior's.
    error_signal : float
        Share of the mean intensity that was not noise floor where the errors were computed.
    error_fitted : ndarray (errors,)
        Amplitude of each that the fit already contains, standard deviations.
    speckle_share : ndarray (blocks, bins)
        Speckle's share of the variance of each bin's relative residual; the rest is the model's.
    """

    pixel_count: FloatArray
    intensity_sum: FloatArray
    phase_offset: FloatArray
    range_offset: FloatArray
    place: FloatArray
    ground_range: FloatArray
    altitude: FloatArray
    trend: FloatArray
    group: IntArray
    errors: FloatArray
    error_axes: FloatArray
    error_information: FloatArray
    error_signal: float
    error_fitted: FloatArray
    speckle_share: FloatArray


class Geometry(NamedTuple):
    """Geometry, priors and options with which a histogram is modelled.

    Attributes
    ----------
    along, across : float
        Wave numbers of the histogram along and across the look, cycles/m; `along` is above 0.
    range_middle, altitude_middle : float
        Mean ground range and altitude over the pixels, m.
    altitude_sd : float
        Standard deviation of the navigation's altitude, m, not counting the ripples under the
        sonar.
    expected_blur : float
        Cycles.
    wave_sd, phase_sd : float
        Prior standard deviations of the wave number along the look and of the phase about the
        histogram's, cycles/m and rad.
    bent : bool
        Whether the histogram's phase is a field that follows the image's fundamental at every
        range. Where crests are straight, it follows a line.
    published : bool
        Whether the wavelength is rendered by Zare and Cobb's equation 3.
    shadow : int
        LINE_OF_SIGHT or CREST, 0 where no shadow can fall.
    law_error : ndarray (LAW_KNOTS.size,)
        Departure of the log of the scattering law from its family, at the knots.
    third_harmonic : ndarray (2,)
        Third harmonic of the crest profile over A_H, sine and cosine.
    fixed : ndarray (4,)
        Exponent, concentration, peakedness and asymmetry where they are fixed; NaN where they are
        estimated.
    height_mean, height_sd, height_least, height_most : float
        Truncated Gaussian prior of A_H (ZC 7 and 9), m.
    steepness_middle, steepness_sd : float
        Log-normal prior of the steepness (crest to trough over wavelength): its median and the
        standard deviation of its log; a standard deviation of infinity means no such prior.
    """

    along: float
    across: float
    range_middle: float
    altitude_middle: float
    altitude_sd: float
    expected_blur: float
    wave_sd: float
    phase_sd: float
    bent: bool
    published: bool
    shadow: int
    law_error: FloatArray
    third_harmonic: FloatArray
    fixed: FloatArray
    height_mean: float
    height_sd: float
    height_least: float
    height_most: float
    steepness_middle: float
    steepness_sd: float


@numba.njit(cache=True, nogil=True, error_model="numpy")
def contrast_per_slope(exponent, concentration, tangent):  # type: ignore[no-untyped-def]
    """Relative change of intensity with slope at a grazing angle, to first order: law plus lean."""
    grazing = np.arctan(tangent)
    law = exponent / tangent - 2.0 * concentration * (grazing - 0.5 * np.pi)
    return law + tangent


@numba.njit(cache=True, nogil=True, error_model="numpy")
def parameters_at(z, geometry):  # type: ignore[no-untyped-def]
    """Return parameters at sampling coordinates, standard Gaussian a priori except the first three.

    The third is the log of the first-order contrast that A_H makes. An image constrains the
    contrast directly, but A_H only through the scattering law.
    """
    fixed = geometry.fixed
    exponent, concentration, peakedness, asymmetry = fixed[0], fixed[1], fixed[2], fixed[3]
    if np.isnan(exponent):
        exponent = EXPONENT[0] + EXPONENT[1] * z[3]
        concentration = CONCENTRATION[0] + CONCENTRATION[1] * z[4]
    if np.isnan(peakedness):
        peakedness = PEAKEDNESS[0] + PEAKEDNESS[1] * z[5]
        asymmetry = ASYMMETRY[0] + ASYMMETRY[1] * z[6]
    contrast = np.exp(z[2])
    middle = geometry.altitude_middle
    tangent = middle / geometry.range_middle
    rough = contrast / max(contrast_per_slope(exponent, concentration, tangent), 1e-9)
    # altitude may have been measured over a crest or a trough
    sd = np.sqrt(geometry.altitude_sd**2 + 0.5 * rough * rough)
    scale = max(1.0 + z[10] * sd / middle, LEAST_SCALE)
    # keeps coordinates 2 and 10 independent where shadow and contrast give height over altitude
    per_slope = contrast_per_slope(exponent, concentration, tangent * scale)
    height = contrast / per_slope if per_slope > 0.0 else np.inf
    return Parameters(
        z[0],
        z[1],
        height,
        exponent,
        concentration,
        peakedness,
        asymmetry,
        np.exp(NOISE_LOG[0] + NOISE_LOG[1] * z[7]),
        NOISE_SLOPE[0] + NOISE_SLOPE[1] * z[8],
        geometry.expected_blur * np.exp(BLUR_SD * z[9]),
        scale,
        HEIGHT_TREND[0] * z[11],
        HEIGHT_TREND[1] * z[12],
        HEIGHT_TREND[2] * z[13],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_prior(z, ripple, geometry):  # type: ignore[no-untyped-def]
    """Log prior density of the sampling coordinates, up to a constant."""
    height = ripple.height
    if not geometry.height_least <= height <= geometry.height_most:
        return -np.inf
    if not ripple.altitude_scale > LEAST_SCALE:
        return -np.inf
    if max(abs(ripple.peakedness), abs(ripple.asymmetry)) > MOST_HARMONIC:
        return -np.inf
    least, most = LAW_BOUNDS
    if not (least < ripple.exponent < most and least < ripple.concentration < most):
        return -np.inf
    along = geometry.along + ripple.wave_offset
    frequency = np.hypot(along, geometry.across)
    # sand is no steeper than 45 degrees
    if along <= 0.0 or 2.0 * np.pi * frequency * height > 1.0:
        return -np.inf
    value = np.log(height)  # Jacobian of the change from A_H to the log of contrast
    value -= 0.5 * ((height - geometry.height_mean) / geometry.height_sd) ** 2
    if geometry.steepness_sd < np.inf:
        ratio = np.log(2.0 * height * frequency / geometry.steepness_middle)
        value -= np.log(height) + 0.5 * (ratio / geometry.steepness_sd) ** 2
    for i in range(3, z.size):
        value -= 0.5 * z[i] * z[i]
    return value - 0.5 * ((z[0] / geometry.wave_sd) ** 2 + (z[1] / geometry.phase_sd) ** 2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_profile(peakedness, asymmetry, third, heights, slopes):  # type: ignore[no-untyped-def]
    """Fill the crest profile over A_H, of mean 0, and its phase derivative at facets' middles."""
    n = heights.size
    sine3, cosine3 = third[0] + BOUND * asymmetry * asymmetry, third[1]
    least, most = np.inf, -np.inf
    half = np.pi / n
    turn = np.cos(2.0 * half), np.sin(2.0 * half)
    c, s = np.cos(half), np.sin(half)
    for i in range(n):
        c2, s2 = c * c - s * s, 2.0 * s * c
        c3, s3 = c2 * c - s2 * s, s2 * c + c2 * s
        heights[i] = s - peakedness * c2 - asymmetry * s2 + sine3 * s3 + cosine3 * c3
        slopes[i] = c + 2.0 * peakedness * s2 - 2.0 * asymmetry * c2
        slopes[i] += 3.0 * (sine3 * c3 - cosine3 * s3)
        least, most = min(least, heights[i]), max(most, heights[i])
        c, s = c * turn[0] - s * turn[1], s * turn[0] + c * turn[1]
    scale = 2.0 / (most - least)
    for i in range(n):
        heights[i] *= scale
        slopes[i] *= scale


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_lit(elevation, part_of_range, crest, lit):  # type: ignore[no-untyped-def]
    """Fill the share of each facet that the sonar sees, not hidden by anything nearer.

    `elevation` is the height relative to the sonar (below 0) of a wavelength's facets along the
    look, the highest of them at `crest`, spaced by `part_of_range` of the ground range. A point
    nearer by D hides one at range r where it is above the ray: h' - A > (h - A) (1 - D / r). It
    suffices to look back one wavelength. Edges of shadow are resolved to a fraction of a facet.
    """
    n = elevation.size
    lit[:] = 0.0
    first = crest - 1 if crest > 0 else n - 1  # the facet before the crest, which is never hidden
    horizon, apart = elevation[first], 0
    before, rise = 0.0, 0.0
    last = first
    for k in range(1, n + 2):
        i = last + 1 if last + 1 < n else 0
        apart += 1
        margin = elevation[i] * (1.0 - apart * part_of_range) - horizon
        if margin > 0.0:
            share = margin / (margin - before)
            if k <= n:
                lit[i] = min(1.0, 0.5 + share)
            if k > 1 and apart == 2:  # shadow starts, or is about to end, between two facets
                lit[last] = share
            elif k > 1 and 0.5 < share < 1.0:
                lit[last] += share - 0.5
            horizon, apart, before, rise = elevation[i], 0, 0.0, margin
        else:
            if k > 1 and apart == 1 and rise > 0.0:
                # the highest point lies within half a facet of the horizon
                lit[last] *= 0.5 + 0.5 * (rise + margin) / (rise - margin)
            before = margin
        last = i


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_crest_rule(elevation, altitude, wave, ground_range, crest, lit):  # type: ignore[no-untyped-def]
    """Fill each facet's lit share by the published rule (ZC 4): a ray over the preceding crest.

    `elevation` is relative to the sonar, as for :func:`fill_lit`.
    """
    n = lit.size
    before = 0.0
    for k in range(n + 1):  # from crest to crest
        past = (k + 0.5) / n
        i = (k + crest + 1) % n
        distance = past / wave
        gap = ground_range - distance
        margin = -1.0
        if gap > 0.0:
            margin = elevation[crest] - elevation[i] - altitude * distance / gap
        step = abs(margin - before) if k > 0 else 0.0
        if k < n:  # the crest itself is not hidden
            share = 0.5 - margin / max(step, 1e-12) if k > 0 else 1.0
            lit[i] = min(max(share, 0.0), 1.0)
        before = margin


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_shadow(  # type: ignore[no-untyped-def]
    shadow, elevation, altitude, wave, ground_range, crest, lit
):
    """Fill each facet's lit share by the rule `shadow`; leave it where there is none."""
    if shadow == CREST:
        fill_crest_rule(elevation, altitude, wave, ground_range, crest, lit)
    elif shadow == LINE_OF_SIGHT:
        fill_lit(elevation, 1.0 / (wave * lit.size * ground_range), crest, lit)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def deposit(pulse, place, power, beyond):  # type: ignore[no-untyped-def]
    """Add each facet's power to the two phase bins nearest its place (cycles).

    `place` is overwritten with the lower bin's number, `beyond` with the power of the upper one.
    """
    bins = pulse.size
    for i in range(place.size):
        x = (place[i] - np.floor(place[i])) * bins + (bins - 0.5)
        lower = np.int32(x)
        beyond[i] = (x - lower) * power[i]
        lower -= bins if lower >= bins else 0
        place[i] = min(max(lower, 0), bins - 1)  # a valid bin even where the place is NaN
    last, here, above = 0, 0.0, 0.0
    for i in range(place.size):
        low = int(place[i])
        if low != last:  # neighbours mostly share their bins
            pulse[last] += here
            pulse[last + 1 if last + 1 < bins else 0] += above
            last, here, above = low, 0.0, 0.0
        here += power[i] - beyond[i]
        above += beyond[i]
    pulse[last] += here
    pulse[last + 1 if last + 1 < bins else 0] += above


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_law(exponent, concentration, error, law):  # type: ignore[no-untyped-def]
    """Fill the scattered intensity at NODES sines of the local grazing angle, from 0 to 1.

    `law` is (2, NODES); its second row is the step to the next node.
    """
    for i in range(NODES):
        k = KNOT[i]
        off = error[k] + PAST_KNOT[i] * (error[k + 1] - error[k])
        law[0, i] = np.exp(exponent * LOG_SINES[i] - concentration * OFFSETS[i] + off)
    for i in range(NODES - 1):
        law[1, i] = law[0, i + 1] - law[0, i]
    law[1, NODES - 1] = 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_facets(height, wave, across, profile, facets):  # type: ignore[no-untyped-def]
    """Fill rows 0 to 2 with heights (m), slopes along the look and areas of a wavelength's facets.

    Areas are relative to the facets' horizontal area. `profile` (2, facets) is as
    :func:`fill_profile` fills it. Return the steepest slope away from the sonar.
    """
    steepness, steepest = 2.0 * np.pi * height, 0.0
    for i in range(facets.shape[1]):
        along, beside = steepness * wave * profile[1, i], steepness * across * profile[1, i]
        facets[0, i] = height * profile[0, i]
        facets[1, i] = along
        facets[2, i] = np.sqrt(1.0 + along * along + beside * beside)
        steepest = max(steepest, -along)
    return steepest


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_scales(ripple, place, scales):  # type: ignore[no-untyped-def]
    """Fill A_H at each block over its mean (geometric), from cosines over range of its log."""
    near, far = place.min(), place.max()
    for b in range(place.size):
        angle = np.pi * (place[b] - near) / max(far - near, 1e-9)
        change = ripple.trend_1 * np.cos(angle) + ripple.trend_2 * np.cos(2.0 * angle)
        scales[b] = np.exp(change + ripple.trend_3 * np.cos(3.0 * angle))


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def fill_echoes(  # type: ignore[no-untyped-def]
    wave, tangent, ground_range, shadow, crest, facets, law, power, place
):
    """Fill the power and image phase (cycles) of a wavelength's facets at a ground range.

    `shadow` is as in :class:`Geometry`, `crest` the index of the highest facet. `facets` is as
    :func:`fill_facets` leaves it; rows 3 and 4 are scratch.
    """
    n = facets.shape[1]
    heights, slopes, areas, elevation, lit = facets[0], facets[1], facets[2], facets[3], facets[4]
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    altitude = tangent * ground_range
    for i in range(n):
        elevation[i] = heights[i] - altitude
    fill_shadow(shadow, elevation, altitude, wave, ground_range, crest, lit)
    per_range = 1.0 / ground_range
    bend = 0.5 * (1.0 + tangent * tangent) * per_range
    for i in range(n):
        h = heights[i]
        # the ray to a facet of height h has a grazing angle less by about h / range
        grazing = (sine + (slopes[i] - h * per_range) * cosine) / areas[i]
        power[i] = min(max(grazing, 0.0), 1.0) * (NODES - 1)
        # imaged at range r' = sqrt(r^2 + (A - h)^2 - A^2), to second order
        place[i] = (i + 0.5) / n - h * (tangent - h * bend) * wave
    # with shadow `lit` is known: part of a facet may be lit though its middle is turned away
    if not shadow:
        for i in range(n):
            lit[i] = 1.0 if power[i] > 0.0 else 0.0
    for i in range(n):
        low = np.uint32(min(max(np.int32(power[i]), 0), NODES - 1))  # type: ignore[arg-type]
        power[i] = areas[i] * lit[i] * (law[0, low] + (power[i] - low) * law[1, low])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def published_amplitude(grazing, concentration):  # type: ignore[no-untyped-def]
    """Gaussian amplitude about normal incidence (ZC 3.2.3), up to a factor."""
    offset = grazing - 0.5 * np.pi
    return np.exp(-0.5 * concentration * offset * offset)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_published(  # type: ignore[no-untyped-def]
    ripple, wave, tangent, ground_range, shadow, facets, power, place
):
    """Fill the published intensity a*^2 (ZC 3 and 4) of facets: no area and no lean."""
    n = facets.shape[1]
    unit, derivative, elevation, lit = facets[0], facets[1], facets[3], facets[4]
    fill_profile(0.0, 0.0, np.zeros(2), unit, derivative)
    altitude = tangent * ground_range
    lit[:] = 1.0
    for i in range(n):
        elevation[i] = ripple.height * unit[i] - altitude
    fill_shadow(shadow, elevation, altitude, wave, ground_range, np.argmax(unit), lit)
    grazing, slope_angle = np.arctan(tangent), np.arctan(2.0 * np.pi * ripple.height * wave)
    c = ripple.concentration
    flat = published_amplitude(grazing, c)
    span = published_amplitude(grazing + slope_angle, c) - published_amplitude(
        grazing - slope_angle, c
    )
    for i in range(n):
        amplitude = max(flat + 0.5 * span * derivative[i], 0.0)
        power[i] = lit[i] * amplitude * amplitude
        place[i] = (i + 0.5) / n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_blur(width, kernel):  # type: ignore[no-untyped-def]
    """Fill one side of a Gaussian of standard deviation `width` (bins); return its last index."""
    # deposit and interpolation each add a sixth of a square bin of variance
    rest = width * width - 1.0 / 3.0
    variance = 0.5 * (rest + np.sqrt(rest * rest + 0.01))
    reach = min(int(4.0 * np.sqrt(variance)) + 1, kernel.size - 1)
    total = 0.0
    for i in range(reach + 1):
        kernel[i] = np.exp(-0.5 * i * i / variance)
        total += kernel[i] if i == 0 else 2.0 * kernel[i]
    for i in range(reach + 1):
        kernel[i] /= total
    return reach


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_blurred(pulse, kernel, reach, blurred):  # type: ignore[no-untyped-def]
    """Blur a pulse along phase and scale it to a mean of 1."""
    bins = pulse.size
    mean = 0.0
    for i in range(bins):
        mean += pulse[i] / bins
    scale = 1.0 / max(mean, 1e-300)
    for i in range(bins):
        value = pulse[i] * kernel[0]
        for k in range(1, reach + 1):
            high = i + k if i + k < bins else i + k - bins
            value += kernel[k] * (pulse[high] + pulse[i - k])
        blurred[i] = value * scale


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def fill_between(ground_range, first, last, pulses):  # type: ignore[no-untyped-def]
    """Interpolate pulses of the blocks between two rendered ones, linear in range."""
    for b in range(first + 1, last):
        share = ground_range[b] - ground_range[first]
        share /= ground_range[last] - ground_range[first]
        for i in range(pulses.shape[1]):
            pulses[b, i] = pulses[first, i] + share * (pulses[last, i] - pulses[first, i])


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def fill_lags(pulses, lags):  # type: ignore[no-untyped-def]
    """Fill the phase at which each pulse's fundamental peaks, rad."""
    blocks, bins = pulses.shape
    turn = np.cos(2.0 * np.pi / bins), np.sin(2.0 * np.pi / bins)
    for b in range(blocks):
        cosine, sine = 0.0, 0.0
        c, s = np.cos(np.pi / bins), np.sin(np.pi / bins)
        for i in range(bins):
            cosine += pulses[b, i] * c
            sine += pulses[b, i] * s
            c, s = c * turn[0] - s * turn[1], s * turn[0] + c * turn[1]
        lags[b] = np.arctan2(sine, cosine)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_pulses(ripple, data, geometry, pulses):  # type: ignore[no-untyped-def]
    """Fill the pulse of each block over ripple phase (blocks, bins), of mean 1."""
    blocks, bins = data.pixel_count.shape
    n = FACETS * bins
    facets, power, place = np.empty((5, n)), np.empty(n), np.empty(n)
    profile, scales = np.empty((2, n)), np.ones(blocks)
    law, pulse, kernel = np.empty((2, NODES)), np.empty(bins), np.empty(bins)
    wave = geometry.along + ripple.wave_offset
    varies = ripple.trend_1 != 0.0 or ripple.trend_2 != 0.0 or ripple.trend_3 != 0.0
    reach, crest = fill_blur(ripple.blur * bins, kernel), -1
    if not geometry.published:
        fill_law(ripple.exponent, ripple.concentration, geometry.law_error, law)
        third = geometry.third_harmonic
        fill_profile(ripple.peakedness, ripple.asymmetry, third, profile[0], profile[1])
        crest = int(np.argmax(profile[0]))
        if varies:
            fill_scales(ripple, data.place, scales)
    before, stride, steepest = 0, 1 if geometry.shadow else RENDERED, 0.0
    for b in range(blocks):
        if b % stride != 0 and b < blocks - 1:
            continue
        distance = data.ground_range[b]
        tangent = data.altitude[b] * ripple.altitude_scale / distance
        if geometry.published:
            fill_published(ripple, wave, tangent, distance, geometry.shadow, facets, power, place)
        else:
            if varies or b == 0:
                highest = ripple.height * scales[b]
                steepest = fill_facets(highest, wave, geometry.across, profile, facets)
            # a slope less steep than the ray over the crest casts no shadow
            shaded = steepest > tangent - facets[0, crest] / distance
            rule = geometry.shadow if shaded else 0
            fill_echoes(wave, tangent, distance, rule, crest, facets, law, power, place)
        pulse[:] = 0.0
        deposit(pulse, place, power, facets[3])
        fill_blurred(pulse, kernel, reach, pulses[b])
        fill_between(data.ground_range, before, b, pulses)
        before = b


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def _gain(first, last, data, pulses, floors):  # type: ignore[no-untyped-def]
    """Return the maximum likelihood log gain of blocks that share one, and its information.

    By Fisher scoring.
    """
    counts, sums = data.pixel_count, data.intensity_sum
    seen, expected = 0.0, 0.0
    for b in range(first, last):
        for i in range(pulses.shape[1]):
            seen += sums[b, i] - floors[b] * counts[b, i]
            expected += pulses[b, i] * counts[b, i]
    log_gain = np.log(max(seen / max(expected, 1e-300), 1e-3))
    information = 1.0
    for _ in range(8):
        score, information = 0.0, 1e-9
        gain = np.exp(log_gain)
        for b in range(first, last):
            for i in range(pulses.shape[1]):
                over = 1.0 / (gain * pulses[b, i] + floors[b])
                share = 1.0 - floors[b] * over
                score += share * (sums[b, i] * over - counts[b, i])
                information += share * share * counts[b, i]
        step = min(max(score / information, -1.0), 1.0)
        log_gain += step
        if step * step * information < GAIN_TOLD:
            break
    return log_gain, information


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def pulse_at(pulse, phase):  # type: ignore[no-untyped-def]
    """Interpolate a pulse at a phase, cycles from its first bin.

    `pulse` ends with its first two bins again.
    """
    # a phase just below 0 rounds up to a whole cycle
    bins = pulse.size - 2
    place = (phase - np.floor(phase)) * bins
    low = np.uint32(min(max(np.int32(place), 0), bins))
    return pulse[low] + (place - low) * (pulse[low + np.uint32(1)] - pulse[low])


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def fill_means(data, closed, shifts, wave_offset, means):  # type: ignore[no-untyped-def]
    """Fill the expected pulse of each bin, at the mean phase and range of its pixels.

    Pulses are interpolated between blocks. `closed` holds each block's pulse followed by its first
    two bins again, `shifts` the image's phase and the lag there, cycles.
    """
    blocks, bins = means.shape
    reach = data.ground_range
    for b in range(blocks):
        # extrapolate from the inner neighbour at either end
        before, after = (b - 1 if b > 0 else b + 1), (b + 1 if b + 1 < blocks else b - 1)
        if blocks == 1:
            before, after = 0, 0
        nearer, farther = closed[before], closed[after]
        for i in range(bins):
            off = data.range_offset[b, i]
            phase = i / bins + data.phase_offset[b, i] + wave_offset * (data.place[b] + off)
            here = pulse_at(closed[b], phase + shifts[b])
            other = after if off > 0.0 else before
            apart = reach[other] - reach[b]
            share = off / apart if apart != 0.0 else 0.0
            beside = farther if off > 0.0 else nearer
            beyond = pulse_at(beside, phase + shifts[other])
            means[b, i] = max(here + share * (beyond - here), 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def line_of_lags(lags, data):  # type: ignore[no-untyped-def]
    """Fit a line to lags (blocks,), rad, which are unwrapped in place.

    Returns its slope over the place along the look, rad/m, and its value at the clip's centre, rad.
    """
    total, place, mean = 0.0, 0.0, 0.0
    for b in range(lags.size):
        if b > 0:
            lags[b] -= 2.0 * np.pi * np.rint((lags[b] - lags[b - 1]) / (2.0 * np.pi))
        weight = data.pixel_count[b].sum()
        total += weight
        place += weight * data.place[b]
        mean += weight * lags[b]
    place, mean = place / total, mean / total
    square, product = 1e-12, 0.0
    for b in range(lags.size):
        weight, apart = data.pixel_count[b].sum() / total, data.place[b] - place
        square += weight * apart**2
        product += weight * apart * (lags[b] - mean)
    return product / square, mean - product / square * place


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_rendered(ripple, data, geometry, pulses, lags):  # type: ignore[no-untyped-def]
    """Fill pulses (blocks, bins) and the part of their lags that the phase follows (blocks,), rad.

    A phase field follows all of them, the phase of straight crests a line through them.
    """
    fill_pulses(ripple, data, geometry, pulses)
    fill_lags(pulses, lags)
    if not geometry.bent:
        slope, centre = line_of_lags(lags, data)
        for b in range(lags.size):
            lags[b] = centre + slope * data.place[b]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_expected(ripple, data, geometry, means, gains):  # type: ignore[no-untyped-def]
    """Fill the expected intensity of each bin, (blocks, bins), and the gain of each block.

    Return the gains' term of the log likelihood: they are integrated out under the prior 1 / gain.
    """
    pulses, lags = np.empty(means.shape), np.empty(gains.size)
    fill_rendered(ripple, data, geometry, pulses, lags)
    return fill_shown(ripple, data, geometry, pulses, lags, means, gains)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_shown(ripple, data, geometry, pulses, lags, means, gains):  # type: ignore[no-untyped-def]
    """Fill the same as :func:`fill_expected`, from pulses and lags that are already rendered."""
    blocks, bins = means.shape
    floors, shifts = np.empty(blocks), np.empty(blocks)
    closed = np.empty((blocks, bins + 2))
    for b in range(blocks):
        shifts[b] = (ripple.phase + lags[b]) / (2.0 * np.pi)
        closed[b, :bins], closed[b, bins:] = pulses[b], pulses[b, :2]
        ratio = data.ground_range[b] / geometry.range_middle
        floors[b] = ripple.noise * ratio**ripple.noise_slope / data.trend[b]
    fill_means(data, closed, shifts, ripple.wave_offset, means)
    value, first = 0.0, 0
    for last in range(1, blocks + 1):
        if last < blocks and data.group[last] == data.group[first]:
            continue
        log_gain, information = _gain(first, last, data, means, floors)
        gain = np.exp(log_gain)
        for b in range(first, last):
            gains[b] = gain
            for i in range(bins):
                means[b, i] = gain * means[b, i] + floors[b]
        value -= 0.5 * np.log(information)
        first = last
    return value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_posterior(z, data, geometry):  # type: ignore[no-untyped-def]
    """Log posterior density at sampling coordinates, up to a constant."""
    ripple = parameters_at(z, geometry)
    value = log_prior(z, ripple, geometry)
    if not value > -np.inf:
        return -np.inf
    means = np.empty(data.pixel_count.shape)
    value += fill_expected(ripple, data, geometry, means, np.empty(means.shape[0]))
    residuals = np.empty(means.shape)
    value += fill_residuals(means, data, residuals, np.empty(means.shape))
    if data.errors.shape[0] > 0:
        shapes = data.errors.reshape(data.errors.shape[0], means.size)
        # errors change the echo: of a model that is mostly noise floor they can explain little
        signal = min(max(1.0 - ripple.noise, 0.0) / data.error_signal, 1.0)
        pull = signal * np.dot(shapes, residuals.ravel()) - data.error_fitted
        along = np.dot(data.error_axes.T, pull)
        value += 0.5 * np.sum(along**2 / (1.0 + signal**2 * data.error_information))
        value -= 0.5 * np.dot(data.error_fitted, data.error_fitted)
    return value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_residuals(means, data, residuals, pulls):  # type: ignore[no-untyped-def]
    """Fill residuals and derivatives of the log likelihood, (blocks, bins); return the likelihood.

    A residual times its pixels is squared in the likelihood. It lies between the signed root
    deviance of speckle and the log of the intensity over the expected one, by the speckle's share:
    a model is wrong by a factor, and as likely too bright as too dark, but speckle's deviance of a
    bin ten times too bright is five times that of one ten times too dark. `pulls` are derivatives
    with respect to the log of the expected intensity. The likelihood is relative to that of the
    observed means of the bins.
    """
    counts, sums = data.pixel_count, data.intensity_sum
    level = 0.0
    for b in range(means.shape[0]):
        for i in range(means.shape[1]):
            n, m = counts[b, i], means[b, i]
            residuals[b, i] = 0.0
            if n <= 0.0:
                level -= sums[b, i] / m
                pulls[b, i] = sums[b, i] / m
                continue
            ratio = max(sums[b, i] / (n * m), 1e-12)
            log, share = np.log(ratio), data.speckle_share[b, i]
            size = np.sqrt(max(2.0 * (ratio - 1.0 - log), 1e-24))
            residual = share * (size if ratio > 1.0 else -size) + (1.0 - share) * log
            level -= 0.5 * n * residual * residual
            residuals[b, i] = n * residual
            pulls[b, i] = n * residual * (share * abs(ratio - 1.0) / size + 1.0 - share)
    return level


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_posteriors(points, data, geometry):  # type: ignore[no-untyped-def]
    """Log posterior density of points (n, coordinates)."""
    values = np.empty(points.shape[0])
    for i in range(values.size):
        values[i] = log_posterior(points[i], data, geometry)
    return values


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_priors(points, geometry):  # type: ignore[no-untyped-def]
    """Log prior density of points (n, coordinates)."""
    values = np.empty(points.shape[0])
    for i in range(values.size):
        values[i] = log_prior(points[i], parameters_at(points[i], geometry), geometry)
    return values


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_parameters(points, geometry, values):  # type: ignore[no-untyped-def]
    """Fill the parameters (n, fields of :class:`Parameters`) at points (n, coordinates)."""
    for i in range(points.shape[0]):
        values[i] = parameters_at(points[i], geometry)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_slopes(z, free, size, data, geometry, means, slopes, prior):  # type: ignore[no-untyped-def]
    """Fill the derivatives of the log expected intensity, (free coordinates, all bins).

    By finite differences of step `size`, smaller for the wave number. `means` becomes the expected
    intensity (blocks, bins), `prior` the derivative of the log prior and minus its second
    derivative (free coordinates, 2).
    """
    gains, lags = np.empty(means.shape[0]), np.empty(means.shape[0])
    moved, pulses = np.empty(means.shape), np.empty(means.shape)
    ripple = parameters_at(z, geometry)
    known = log_prior(z, ripple, geometry)
    fill_rendered(ripple, data, geometry, pulses, lags)
    fill_shown(ripple, data, geometry, pulses, lags, means, gains)
    for k in range(free.size):
        i = free[k]
        step = size / max(geometry.range_middle, 1.0) if i == 0 else size
        beside = z.copy()
        beside[i] = z[i] - step
        below = parameters_at(beside, geometry)
        before = log_prior(beside, below, geometry)
        beside[i] = z[i] + step
        ripple = parameters_at(beside, geometry)
        after = log_prior(beside, ripple, geometry)
        prior[k], slopes[k] = 0.0, 0.0
        if after > -np.inf and before > -np.inf:
            prior[k, 0] = (after - before) / (2.0 * step)
            prior[k, 1] = max((2.0 * known - after - before) / step**2, 0.0)
        elif before > -np.inf:
            ripple, step = below, -step
        elif not after > -np.inf:  # outside the prior a ripple may be impossible to render
            continue
        if i in NO_PULSE:
            fill_shown(ripple, data, geometry, pulses, lags, moved, gains)
        else:
            fill_expected(ripple, data, geometry, moved, gains)
        for b in range(means.shape[0]):
            for j in range(means.shape[1]):
                change = moved[b, j] / means[b, j] - 1.0
                # the log of 1 + change, two terms of its series where it is small
                small = abs(change) < SMALL
                log = change - 0.5 * change * change if small else np.log1p(change)
                slopes[k, b * means.shape[1] + j] = log / step


def error_gain(data: Histogram) -> FloatArray:
    """Inverse of the errors' information and prior precision together, (errors, errors)."""
    return np.asarray(data.error_axes / (1.0 + data.error_information) @ data.error_axes.T)


def pulses_of(
    ripple: Parameters, data: Histogram, geometry: Geometry
) -> tuple[FloatArray, FloatArray]:
    """Render pulses (blocks, bins) over ripple phase, and the lags of their fundamentals, rad."""
    pulses, lags = np.empty(data.pixel_count.shape), np.empty(len(data.place))
    fill_pulses(ripple, data, geometry, pulses)
    fill_lags(pulses, lags)
    return pulses, lags


def named_parameters(points: FloatArray, geometry: Geometry) -> dict[str, FloatArray]:
    """Return the parameters (...,) by name at sampling coordinates (..., coordinates)."""
    flat = points.reshape(-1, points.shape[-1])
    values = np.empty((len(flat), len(Parameters._fields)))
    fill_parameters(flat, geometry, values)
    columns = values.T.reshape(-1, *points.shape[:-1])
    return dict(zip(Parameters._fields, columns.copy(), strict=True))
