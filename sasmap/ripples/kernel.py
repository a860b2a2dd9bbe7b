"""The compiled inner loops of the default method, all in one file.

numba keeps compiled code on disk and notices a change only in the file of the function it
compiled; what calls across files could go on using an older version of what it calls.

The intensity of fully developed speckle is exponential about m = G (lit fraction * a*^2 + n0). Its
likelihood over pixels of one m depends on them only through their number and sum; the gain G of
each group of strips is integrated out exactly under its scale-invariant prior 1/G:

    log L = sum over groups of  - sum n log s - N log(sum total / s),      s = m / G,  N = sum n

A saturated pixel adds to the sum alone: its intensity is known to be at least that. The likelihood
is raised to the power of one over the noise factor, by which correlated and textured speckle says
less than as many independent pixels.

Where crests are straight, edges of shadow are known to a part of a pixel: pixels near one are
looked at one by one, and may lie on either side of it. Where crests bend, pulses are modelled on an
even grid of phase.

The parameters theta are those of :mod:`sasmap.ripples.folded`.
"""

from __future__ import annotations

import numba
import numpy as np

from sasmap.ripples.pixels import (
    EDGE_ACROSS,
    EDGE_ALONG,
    EDGE_COSINE,
    EDGE_PAST,
    EDGE_POWER,
    EDGE_SINE,
)
from sasmap.ripples.scattering import SIGMA_VARIANCE

SIZE = 6
# Receiver noise: about 20 dB below the sea floor, give or take a factor of e^2.
NOISE_MEAN, NOISE_SD = float(np.log(0.01)), 2.0
NOISE_BOUNDS = (float(np.log(1e-6)), float(np.log(10.0)))
# With a phase field the fundamental's phase is the field's, to this standard deviation, rad.
PHASE_SD = 0.1
# How far behind its place the beginning of shadow may be seen, pixels: there the ray only grazes
# the floor, and an image knows the floor by its pixels.
SLIP_SD = 0.25
SINE, STOKES, PEAKED = 0, 1, 2
# Rays of a strip that meet shadow, over their range of log slope, and their weights (Gauss and
# Legendre).
RAYS = (0.0469100770, 0.2307653449, 0.5, 0.7692346551, 0.9530899230)
RAY_WEIGHTS = (0.1184634425, 0.2393143352, 0.2844444444, 0.2393143352, 0.1184634425)
# Children a generation of the evolution that climbs.
CHILDREN = 12
# Weight of steps by differences of two members, and of nuisances drawn from near their prior; the
# others are drawn anew.
LOCAL, NUISANCE = 0.05, 0.08
# Degrees of freedom of the kernels: with SIZE 6 their density is an inverse seventh power.
STUDENT = 8.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_prior(theta, data, prior):  # type: ignore[no-untyped-def]
    """Log prior of the parameters, up to a constant."""
    for i in range(3):
        if not (prior.lower[i] <= theta[i] <= prior.upper[i]):
            return -np.inf
    if not (NOISE_BOUNDS[0] <= theta[4] <= NOISE_BOUNDS[1]):
        return -np.inf
    # across the look: the same sea floor, looked at the other way round
    across = np.cos(theta[2] - data.look) <= 0.0
    if across or theta[0] * theta[1] * 2.0 * np.pi > prior.steepest:
        return -np.inf
    value = -0.5 * ((theta[4] - NOISE_MEAN) / NOISE_SD) ** 2
    if not (data.blur_bounds[0] <= theta[5] <= data.blur_bounds[1]):
        return -np.inf
    value -= 0.5 * (theta[5] - data.blur[0]) ** 2 * data.blur[1]
    if data.field == 1:
        value -= 0.5 * (theta[3] / PHASE_SD) ** 2
    for i in range(3):
        for j in range(3):
            if prior.precision[i, j] != 0.0:
                product = (theta[i] - prior.mean[i]) * (theta[j] - prior.mean[j])
                value -= 0.5 * prior.precision[i, j] * product
    return value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shadow_edges(ratio, steepness, data, edges):  # type: ignore[no-untyped-def]
    """Fill begin and end of shadow past the crest and their changes with log ratio.

    Return whether there is any shadow.
    """
    place = min(steepness / data.table_steepness, 1.0) * (data.table.shape[0] - 1)
    low = min(int(place), max(data.table.shape[0] - 2, 0))
    high = min(low + 1, data.table.shape[0] - 1)
    share = place - low
    limit = (1.0 - share) * data.table[low, 2, 0] + share * data.table[high, 2, 0]
    if not ratio < limit:
        return False
    n = data.table.shape[2] - 1
    x = 2.0 / np.pi * np.arcsin(np.sqrt(ratio / limit)) * n
    i = min(int(x), n - 1)
    for k in range(2):
        first = (1.0 - share) * data.table[low, k, i] + share * data.table[high, k, i]
        second = (1.0 - share) * data.table[low, k, i + 1] + share * data.table[high, k, i + 1]
        edges[k] = first + (x - i) * (second - first)
        # d x / d log ratio = n / pi tan(pi x / 2 n)
        edges[2 + k] = (second - first) * n / np.pi * min(np.tan(0.5 * np.pi * x / n), 50.0)
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _slope_of(c, s, steepness, profile):  # type: ignore[no-untyped-def]
    """Slope over the steepest, from cosine and sine of the phase."""
    if profile == SINE:
        return c
    if profile == PEAKED:
        return (1.0 + s) * c / (0.75 * np.sqrt(3.0))
    sine = 4.0 * steepness / (1.0 + np.sqrt(1.0 + 32.0 * steepness * steepness))
    extreme = np.sqrt(1.0 - sine * sine) * (1.0 + 2.0 * steepness * sine)
    return c * (1.0 + 2.0 * steepness * s) / extreme


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _steepest(steepness, profile):  # type: ignore[no-untyped-def]
    """Steepest slope over A_H 2 pi f."""
    if profile == SINE:
        return 1.0
    if profile == PEAKED:
        return 0.75 * np.sqrt(3.0)
    sine = 4.0 * steepness / (1.0 + np.sqrt(1.0 + 32.0 * steepness * steepness))
    return np.sqrt(1.0 - sine * sine) * (1.0 + 2.0 * steepness * sine)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _swing(full, steepness, data, block):  # type: ignore[no-untyped-def]
    """Relative amplitude of a block's steepest slope, and its change with the ray's tilt (ZC 5)."""
    tilt = np.arctan(steepness * _steepest(full, data.profile))
    damping = 0.5 * np.exp(-tilt * tilt / (2.0 * SIGMA_VARIANCE))
    grow = np.exp(tilt * data.tilt[block] / SIGMA_VARIANCE)
    return damping * (grow - 1.0 / grow), damping * (grow + 1.0 / grow) * tilt / SIGMA_VARIANCE


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shadow_limit(full, data):  # type: ignore[no-untyped-def]
    """Slope of the ray over the steepness at which shadow sets in."""
    limit = data.table[0, 2, 0]
    return limit * _steepest(full, STOKES) if data.profile == STOKES else limit


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _edges_seen(theta, data, block, farther, full, steepness, edges):  # type: ignore[no-untyped-def]
    """Fill the shadow edges at a log slope of the ray from the block's; return whether any.

    The slope of the ray is that of the point's own height; by the crest rule, that at the crest.
    The second half of `edges` is scratch.
    """
    ratio = data.altitude[block] / data.reach[block] / steepness * np.exp(farther)
    if not shadow_edges(ratio, full, data, edges):
        return False
    wave = 2.0 * np.pi * theta[0] * np.cos(theta[2] - data.look)
    own = edges[4:]
    for k in range(2):
        for _ in range(2):
            if data.shadow == 2:
                factor = 1.0 / max(1.0 - edges[k] / (wave * data.reach[block]), 0.05)
            else:
                factor = 1.0 - theta[1] * np.cos(edges[k]) / data.altitude[block]
            if not shadow_edges(ratio * max(factor, 0.05), full, data, own):
                return False
            edges[k], edges[2 + k] = own[k], own[2 + k]
    return edges[1] > edges[0]


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _lit(i, block, turn, swing, change, full, data):  # type: ignore[no-untyped-def]
    """Intensity a*^2 of a bin of straight crests out of shadow.

    `turn` holds cosine and sine of the phase that bins are ahead, and how that grows, rad/m.
    """
    c = data.cosine[block, i] * turn[0] - data.sine[block, i] * turn[1]
    s = data.sine[block, i] * turn[0] + data.cosine[block, i] * turn[1]
    more = turn[2] * data.ahead[block, i]
    c, s = c - more * s, s + more * c
    reach = swing + change * data.steeper[block, i]
    a = max(1.0 + reach * _slope_of(c, s, full, data.profile), 0.0)
    return a * a * data.flat[block, i]


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _turned(c, s, turn):  # type: ignore[no-untyped-def]
    """Cosine and sine of a phase that is a turn ahead, which is small as a rule."""
    if abs(turn) > 0.3:
        x, y = np.cos(turn), np.sin(turn)
    else:
        x = 1.0 - 0.5 * turn * turn
        y = turn * (1.0 - turn * turn / 6.0)
    return c * x - s * y, s * x + c * y


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _edge_value(block, begin, end, theta, along, across, swing, full, gain, data):  # type: ignore[no-untyped-def]
    """Log likelihood of a block's pixels near edges of shadow, each on either side of its edge.

    `begin` and `end` of shadow are cycles past the crest, `along` and `across` the wave vector
    beyond the fold's. Gaussian jitter of the edge as a logistic law of the same spread.
    """
    first, last = data.edge_start[block], data.edge_start[block + 1]
    shift = theta[3] - data.reference[0]
    x, y = np.cos(shift), np.sin(shift)
    noise = np.exp(theta[4])
    dark, flat, sharp = 1.0 / noise, data.flat[block, 0], 1.7 / data.edge_sd
    middle = 0.5 * (begin + end)
    half = 0.5 * (end - begin) if end > begin else -1.0
    value = 0.0
    for k in range(first, last):
        turn = along * data.edges[k, EDGE_ALONG] + across * data.edges[k, EDGE_ACROSS]
        # from the middle of the shadow, and the half of it that is nearer
        past = data.edges[k, EDGE_PAST] + turn + shift / (2.0 * np.pi) - middle
        past -= np.floor(past + 0.5)
        inside = half - abs(past)
        c, s = data.edges[k, EDGE_COSINE], data.edges[k, EDGE_SINE]
        c, s = _turned(c * x - s * y, s * x + c * y, 2.0 * np.pi * turn)
        a = max(1.0 + swing * _slope_of(c, s, full, data.profile), 0.0)
        lit = 1.0 / (a * a * flat + noise)
        power = data.edges[k, EDGE_POWER] / gain
        odds = np.exp(min(max(sharp * inside, -60.0), 60.0))
        # log of (dark odds exp(-power dark) + lit exp(-power lit)) / (1 + odds)
        less = np.exp(min(power * (lit - dark), 60.0))
        value += np.log((odds * dark * less + lit) / (1.0 + odds)) - power * lit
    return value + (last - first) * (1.0 - np.log(gain))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shadow_of(theta, data, block, edges):  # type: ignore[no-untyped-def]
    """Begin and end of a block's shadow, cycles past the crest; end first where there is none."""
    full = 2.0 * np.pi * theta[0] * theta[1]
    steepness = full * np.cos(theta[2] - data.look)
    if data.shadow == 0 or not steepness > 0.0:
        return 1.0, 0.0
    if not _edges_seen(theta, data, block, 0.0, full, steepness, edges):
        return 1.0, 0.0
    begin, end = edges[0] / (2.0 * np.pi), edges[1] / (2.0 * np.pi)
    return begin + min(theta[5] * data.pixel, 0.5 * (end - begin)), end


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shadow_places(theta, data):  # type: ignore[no-untyped-def]
    """Begin and end of shadow in each block, cycles past the crest (blocks, 2)."""
    result = np.empty((data.reach.size, 2))
    edges = np.zeros(8)
    for block in range(data.reach.size):
        result[block] = _shadow_of(theta, data, block, edges)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def straight_likelihood(theta, data):  # type: ignore[no-untyped-def]
    """Speckle log likelihood of straight crests, pixel by pixel near the edges of shadow."""
    strips, bins = data.group.size, data.known.shape[1]
    blocks = data.along.size // strips
    full = 2.0 * np.pi * theta[0] * theta[1]
    along = theta[0] * np.cos(theta[2] - data.look) - data.reference[1]
    across = theta[0] * np.sin(theta[2] - data.look) - data.reference[2]
    steepness = full * np.cos(theta[2] - data.look)
    noise = np.exp(theta[4])
    log_noise = np.log(noise)
    places, turn = np.zeros(8), np.zeros(3)
    near = np.zeros((data.along.size, 3))
    turn[2] = 2.0 * np.pi * along
    value, altitude, first = 0.0, 0.0, 0
    pixels, logs, scaled = 0.0, 0.0, 0.0
    swing, change, begin, end = 0.0, 0.0, 1.0, 0.0
    for block in range(data.along.size):
        if block % blocks == 0 or data.altitude[block] != altitude:
            altitude = data.altitude[block]
            swing, change = _swing(full, steepness, data, block)
            begin, end = _shadow_of(theta, data, block, places)
        near[block, 0], near[block, 1], near[block, 2] = begin, end, swing
        place = along * data.along[block] + across * data.across[block]
        offset = theta[3] - data.reference[0] + 2.0 * np.pi * place
        turn[0], turn[1] = np.cos(offset), np.sin(offset)
        for i in range(bins):
            if data.total[block, i] > 0.0:
                level = _lit(i, block, turn, swing, change, full, data) + noise
                logs += data.known[block, i] * np.log(level)
                scaled += data.total[block, i] / level
                pixels += data.known[block, i]
        logs += data.dark[block, 0] * log_noise
        scaled += data.dark[block, 1] / noise
        pixels += data.dark[block, 0]
        strip = (block + 1) // blocks
        if (block + 1) % blocks > 0 or (
            strip < strips and data.group[strip] == data.group[strip - 1]
        ):
            continue
        if pixels > 0.0:
            gain = scaled / pixels
            value -= logs + pixels * np.log(gain)
            for k in range(first, block + 1):
                value += _edge_value(
                    k, near[k, 0], near[k, 1], theta, along, across, near[k, 2], full, gain, data
                )
        pixels, logs, scaled = 0.0, 0.0, 0.0
        first = block + 1
    return value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _hide(hidden, begin, end, share):  # type: ignore[no-untyped-def]
    """Add a shadow (phases past the crest, rad) to the steps of the hidden share over bins."""
    n = hidden.size - 2
    for k in range(2):
        place = ((begin if k == 0 else end) / (2.0 * np.pi) + 0.25) * n
        wound = np.floor(place / n)
        place -= wound * n
        i = min(int(place), n - 1)
        sign = share if k == 0 else -share
        hidden[i] += sign * (i + 1.0 - place)
        hidden[i + 1] += sign * (place - i)
        hidden[n + 1] += sign * wound  # taken from or added to the whole circle


@numba.njit(cache=True, nogil=True, error_model="numpy")
def even_intensity(theta, data, strip, shape, hidden):  # type: ignore[no-untyped-def]
    """Fill lit a*^2 on an even grid of the ripple's phase.

    Shadow is averaged over the rays of the strip, from the steepest to the lowest. `hidden` is
    scratch, two longer than `shape`.
    """
    n = shape.size
    full = 2.0 * np.pi * theta[0] * theta[1]
    steepness = full * np.cos(theta[2] - data.look)
    swing, _ = _swing(full, steepness, data, strip)
    hidden[:] = 0.0
    edges = np.zeros(8)
    spread = max(data.spread[strip], 1e-6)
    length = 0.0  # of the part of the rays, by log slope, that meets shadow
    if data.shadow > 0 and steepness > 0.0:
        ratio = data.altitude[strip] / data.reach[strip] / steepness
        length = min(spread, np.log(_shadow_limit(full, data) / ratio)) + spread
    for k in range(len(RAYS) if length > 0.0 else 0):
        farther = RAYS[k] * length - spread
        if _edges_seen(theta, data, strip, farther, full, steepness, edges):
            _hide(hidden, edges[0], edges[1], RAY_WEIGHTS[k] * 0.5 * length / spread)
    dark = -hidden[n + 1]
    for i in range(n):
        dark += hidden[i]
        slope = _slope_of(data.cosine[strip, i], data.sine[strip, i], full, data.profile)
        a = max(1.0 + swing * slope, 0.0)
        shape[i] = a * a * (1.0 - min(max(dark, 0.0), 1.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shifted(shape, shift, sd, seen):  # type: ignore[no-untyped-def]
    """Fill a pulse on an even grid of phases, seen `shift` rad later and smeared by sd rad."""
    n = shape.size
    place = shift * n / (2.0 * np.pi)
    whole = int(np.floor(place + 0.5))
    width = sd * n / (2.0 * np.pi)
    reach = min(int(np.ceil(3.0 * width + 0.5)), n // 2 - 1)
    seen[:] = 0.0
    total = 0.0
    for k in range(-reach, reach + 1):
        weight = np.exp(-0.5 * ((k + whole - place) / width) ** 2)
        total += weight
        start = (k + whole) % n
        for i in range(n - start):
            seen[i] += weight * shape[i + start]
        for i in range(n - start, n):
            seen[i] += weight * shape[i + start - n]
    seen /= total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fundamental_lag(shape, data, strip):  # type: ignore[no-untyped-def]
    """Phase of a pulse's fundamental: how far its brightest part lies past phase zero, rad."""
    real, imaginary = 0.0, 0.0
    for i in range(shape.size):
        real += shape[i] * data.cosine[strip, i]
        imaginary += shape[i] * data.sine[strip, i]
    return np.arctan2(imaginary, real)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def even_pulse(theta, data, strip, shape, hidden, seen):  # type: ignore[no-untyped-def]
    """Fill a strip's intensity as the image shows it on an even grid of phase; return the lag.

    With a phase field the bins' phase is that of the image's fundamental, which lies past the
    ripple's own by the lag, and the field's error smears the pulse.
    """
    even_intensity(theta, data, strip, shape, hidden)
    lag = 0.0
    if data.field == 1:
        lag = fundamental_lag(shape, data, strip)
        _shifted(shape, lag + theta[3], np.exp(theta[5]), seen)
    else:
        along = theta[0] * np.cos(theta[2] - data.look) - data.reference[1]
        across = theta[0] * np.sin(theta[2] - data.look) - data.reference[2]
        place = along * data.along[strip] + across * data.across[strip]
        _shifted(shape, theta[3] - data.reference[0] + 2.0 * np.pi * place, np.exp(theta[5]), seen)
    noise = np.exp(theta[4])
    for i in range(seen.size):
        seen[i] = seen[i] * data.flat[strip, i] + noise
    return lag


@numba.njit(cache=True, nogil=True, error_model="numpy")
def even_likelihood(theta, data):  # type: ignore[no-untyped-def]
    """Speckle log likelihood of pulses on an even grid of phase."""
    strips, bins = data.known.shape
    shape, seen = np.empty(bins), np.empty(bins)
    hidden = np.empty(bins + 2)
    value, bend, previous = 0.0, 0.0, 0.0
    pixels, logs, scaled = 0.0, 0.0, 0.0
    for strip in range(strips):
        lag = even_pulse(theta, data, strip, shape, hidden, seen)
        lag = previous + (lag - previous + np.pi) % (2.0 * np.pi) - np.pi
        previous = lag
        bend += data.lagging[strip] * lag
        for i in range(bins):
            if data.total[strip, i] > 0.0:
                pixels += data.known[strip, i]
                logs += data.known[strip, i] * np.log(seen[i])
                scaled += data.total[strip, i] / seen[i]
        if strip + 1 == strips or data.group[strip + 1] != data.group[strip]:
            if pixels > 0.0:
                value -= logs + pixels * np.log(scaled / pixels)
            pixels, logs, scaled = 0.0, 0.0, 0.0
    value *= data.power
    if data.field == 1:
        along = theta[0] * np.cos(theta[2] - data.look) - bend / (2.0 * np.pi) - data.wave[0]
        across = theta[0] * np.sin(theta[2] - data.look) - data.wave[1]
        value -= 0.5 * (along**2 * data.wave_precision[0] + across**2 * data.wave_precision[1])
    return value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_likelihood(theta, data):  # type: ignore[no-untyped-def]
    """Speckle log likelihood with the gains integrated out, up to a constant."""
    if data.fine > 0:
        return straight_likelihood(theta, data) * data.power
    return even_likelihood(theta, data)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def straight_pulse(theta, data, block, edges, seen, clear):  # type: ignore[no-untyped-def]
    """Fill the mean intensity of a straight block's bins, and which are lit and clear of edges."""
    n = seen.size
    full = 2.0 * np.pi * theta[0] * theta[1]
    steepness = full * np.cos(theta[2] - data.look)
    swing, change = _swing(full, steepness, data, block)
    begin, end = _shadow_of(theta, data, block, edges)
    along = theta[0] * np.cos(theta[2] - data.look) - data.reference[1]
    across = theta[0] * np.sin(theta[2] - data.look) - data.reference[2]
    place = along * data.along[block] + across * data.across[block]
    offset = theta[3] - data.reference[0] + 2.0 * np.pi * place
    turn = np.array([np.cos(offset), np.sin(offset), 2.0 * np.pi * along])
    first = (data.zero + offset) / (2.0 * np.pi) - 0.25
    margin = 2.0 * data.pixel + 0.5 / n
    for i in range(n):
        hidden = 0.0
        clear[i] = True
        if end > begin:
            past = first + (i + 0.5) / n
            past -= np.floor(past)
            inside = min(past - begin, end - past)
            hidden = min(max(0.5 + inside * n, 0.0), 1.0)
            clear[i] = inside < -margin and past - 1.0 - begin < -margin
        lit = _lit(i, block, turn, swing, change, full, data)
        seen[i] = lit * (1.0 - hidden) + np.exp(theta[4])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pulses(theta, data):  # type: ignore[no-untyped-def]
    """Intensity of each block and bin as the image shows it, gain included (blocks, bins).

    And which bins are lit throughout (blocks, bins), and the gain: that of flat floor (blocks,).
    """
    blocks, bins = data.known.shape
    sides = blocks // data.group.size
    result = np.empty((blocks, bins))
    clear = np.ones((blocks, bins), np.bool_)
    gain = np.ones(blocks)
    shape, hidden, edges = np.empty(bins), np.empty(bins + 2), np.zeros(8)
    first, pixels, scaled = 0, 0.0, 0.0
    for block in range(blocks):
        if data.fine > 0:
            straight_pulse(theta, data, block, edges, result[block], clear[block])
        else:
            even_pulse(theta, data, block, shape, hidden, result[block])
        for i in range(bins):
            if data.total[block, i] > 0.0:
                pixels += data.known[block, i]
                scaled += data.total[block, i] / result[block, i]
        strip = (block + 1) // sides
        ends = (block + 1) % sides == 0 and (
            strip == data.group.size or data.group[strip] != data.group[strip - 1]
        )
        if ends:
            gain[first : block + 1] = scaled / pixels if pixels > 0.0 else 1.0
            for k in range(first, block + 1):
                result[k] *= gain[k]
            first, pixels, scaled = block + 1, 0.0, 0.0
    return result, clear, gain


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_posterior(theta, data, prior):  # type: ignore[no-untyped-def]
    """Log posterior of the parameters, up to a constant."""
    value = log_prior(theta, data, prior)
    if value == -np.inf:
        return value
    return value + log_likelihood(theta, data)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def climb(theta, step, data, prior, rounds):  # type: ignore[no-untyped-def]
    """Climb the log posterior in place by a pattern search; return it.

    Each parameter is tried a step up and down; steps grow by success and shrink by failure.
    """
    level = log_posterior(theta, data, prior)
    for _ in range(rounds):
        for i in range(theta.size):
            if step[i] == 0.0:
                continue
            old = theta[i]
            moved = False
            for sign in (1.0, -1.0):
                theta[i] = old + sign * step[i]
                candidate = log_posterior(theta, data, prior)
                if candidate > level:
                    level = candidate
                    moved = True
                    break
                theta[i] = old
            step[i] *= 1.6 if moved else 0.45
    return level


@numba.njit(cache=True, nogil=True, error_model="numpy")
def evolve(theta, step, data, prior, generations, rng):  # type: ignore[no-untyped-def]
    """Climb the log posterior in place by evolution; return it.

    Covariance matrix adaptation (Hansen 2016, arXiv 1604.00772), which follows the bent ridges
    that edges of shadow make.
    """
    n = theta.size
    weights = np.log(CHILDREN // 2 + 0.5) - np.log(np.arange(1.0, CHILDREN // 2 + 1.0))
    weights /= weights.sum()
    mass = 1.0 / (weights**2).sum()
    path_rate = (mass + 2.0) / (n + mass + 5.0)
    damping = 1.0 + path_rate + 2.0 * max(0.0, np.sqrt((mass - 1.0) / (n + 1.0)) - 1.0)
    long_rate = (4.0 + mass / n) / (n + 4.0 + 2.0 * mass / n)
    one = 2.0 / ((n + 1.3) ** 2 + mass)
    many = min(1.0 - one, 2.0 * (mass - 2.0 + 1.0 / mass) / ((n + 2.0) ** 2 + mass))
    usual = np.sqrt(n) * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n))
    mean, size = theta.copy(), 1.0
    shape, path, long_path = np.eye(n), np.zeros(n), np.zeros(n)
    normal, moves = np.empty((CHILDREN, n)), np.empty((CHILDREN, n))
    levels = np.empty(CHILDREN)
    best = log_posterior(theta, data, prior)
    for _ in range(generations):
        factor = np.linalg.cholesky(shape + 1e-9 * np.eye(n))
        for k in range(CHILDREN):
            normal[k] = rng.standard_normal(n)
            moves[k] = factor @ normal[k]
            child = mean + size * step * moves[k]
            levels[k] = log_posterior(child, data, prior)
            if levels[k] > best:
                best = levels[k]
                theta[:] = child
        order = np.argsort(-levels)[: CHILDREN // 2]
        move, white = np.zeros(n), np.zeros(n)
        for k in range(order.size):
            move += weights[k] * moves[order[k]]
            white += weights[k] * normal[order[k]]
        mean += size * step * move
        path = (1.0 - path_rate) * path + np.sqrt(path_rate * (2.0 - path_rate) * mass) * white
        length = np.sqrt((path**2).sum())
        steady = 1.0 if length < 1.8 * usual else 0.0
        long_path = (1.0 - long_rate) * long_path
        long_path += steady * np.sqrt(long_rate * (2.0 - long_rate) * mass) * move
        shape *= 1.0 - one - many
        for i in range(n):
            for j in range(n):
                shape[i, j] += one * long_path[i] * long_path[j]
                for k in range(order.size):
                    shape[i, j] += many * weights[k] * moves[order[k], i] * moves[order[k], j]
        size *= np.exp(min(path_rate / damping * (length / usual - 1.0), 0.6))
    return best


@numba.njit(cache=True, nogil=True, error_model="numpy")
def half_widths(x, step, data, prior):  # type: ignore[no-untyped-def]
    """Distance along each coordinate over which the log density falls by about 2, from a peak."""
    level = log_target(x, data, prior, 1.0)
    result = step.copy()
    moved = x.copy()
    for i in range(x.size):
        for _ in range(40):
            moved[i] = x[i] + result[i]
            up = level - log_target(moved, data, prior, 1.0)
            moved[i] = x[i] - result[i]
            down = level - log_target(moved, data, prior, 1.0)
            if min(up, down) < 4.0:
                break
            result[i] *= 0.5
        moved[i] = x[i]
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def scan_table(table, data):  # type: ignore[no-untyped-def]
    """Fill the last column of rows (theta, log likelihood)."""
    for row in range(table.shape[0]):
        table[row, SIZE] = log_likelihood(table[row, :SIZE], data)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_target(x, data, prior, power):  # type: ignore[no-untyped-def]
    """Log density that is sampled: the posterior with its likelihood to a power, of coordinates x.

    They are theta, but A_H / (1 + n0) for A_H: contrast tells that ratio, and samplers dislike the
    bent ridge that it makes of A_H and log n0.
    """
    theta = x.copy()
    stretch = 1.0 + np.exp(x[4])
    theta[1] = x[1] * stretch
    value = log_prior(theta, data, prior)
    if value == -np.inf:
        return value
    value += np.log(stretch)
    return value + power * log_likelihood(theta, data) if power > 0.0 else value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_targets(points, data, prior, power):  # type: ignore[no-untyped-def]
    """:func:`log_target` of several points (n, SIZE)."""
    result = np.empty(points.shape[0])
    for k in range(points.shape[0]):
        result[k] = log_target(points[k], data, prior, power)
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def move_population(particles, level, power, proposal, moves, data, prior, rng):  # type: ignore[no-untyped-def]
    """Move particles in place by Metropolis-Hastings; return the accepted fraction.

    `level` is their log density at this power.
    """
    n, size = particles.shape
    accepted = 0
    proposed = np.empty(size)
    for k in range(n):
        for _ in range(moves):
            if rng.random() < NUISANCE:
                _refresh(particles[k], data, rng, proposed)
            else:
                _step(particles[k], proposal, rng, proposed)
            candidate = log_target(proposed, data, prior, power)
            if np.log(rng.random()) < candidate - level[k]:
                particles[k] = proposed
                level[k] = candidate
                accepted += 1
    return accepted / (n * moves)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def run_chain(state, proposal, data, prior, rng, draws):  # type: ignore[no-untyped-def]
    """Fill draws (n, SIZE) with a Metropolis-Hastings chain; return how many steps it accepted."""
    current = state.copy()
    level = log_target(current, data, prior, 1.0)
    density = log_density(current, proposal)
    proposed = np.empty(state.size)
    accepted = 0
    for step in range(draws.shape[0]):
        kind = rng.random()
        correction = 0.0
        if kind < LOCAL:
            _step(current, proposal, rng, proposed)
        elif kind < LOCAL + NUISANCE:
            _refresh(current, data, rng, proposed)
        else:
            _draw(proposal, rng, proposed)
        candidate = log_target(proposed, data, prior, 1.0)
        there = log_density(proposed, proposal)
        if kind >= LOCAL + NUISANCE:
            correction = density - there
        gain = candidate - level + correction
        if np.log(rng.random()) < gain:
            current[:] = proposed
            level, density = candidate, there
            accepted += 1
        draws[step] = current
    return accepted


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _refresh(current, data, rng, proposed):  # type: ignore[no-untyped-def]
    """Fill a state with another nuisance: a step as wide as its prior, or down to a tenth."""
    proposed[:] = current
    width = 10.0 ** (-rng.random())
    if rng.random() < 0.5:
        proposed[4] += width * NOISE_SD * rng.normal()
    else:
        proposed[5] += width / np.sqrt(data.blur[1]) * rng.normal()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step(current, proposal, rng, proposed):  # type: ignore[no-untyped-def]
    """Fill a state that the difference of two members leads to."""
    size, length = current.size, proposal.members.shape[0]
    first = rng.integers(0, length)
    second = rng.integers(0, length)
    scale = 2.38 / np.sqrt(2.0 * size) * 10.0 ** (-rng.random())
    for i in range(size):
        step = proposal.members[first, i] - proposal.members[second, i]
        # the population alone spans finitely many points; a little noise reaches all others
        proposed[i] = current[i] + scale * step + 1e-3 * proposal.factor[i, i] * rng.normal()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw(proposal, rng, proposed):  # type: ignore[no-untyped-def]
    """Fill a state drawn from the population's density."""
    size = proposed.size
    member = rng.integers(0, proposal.white.shape[0])
    heavy = proposal.width * np.sqrt(STUDENT / rng.chisquare(STUDENT))
    proposed[:] = proposal.centre
    for j in range(size):
        z = proposal.white[member, j] + heavy * rng.normal()
        for i in range(j, size):
            proposed[i] += proposal.factor[i, j] * z


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_density(x, proposal):  # type: ignore[no-untyped-def]
    """Log density of the population, spread by Student kernels, up to a constant."""
    size = x.size
    z = np.empty(size)
    for i in range(size):
        z[i] = x[i] - proposal.centre[i]
        for j in range(i):
            z[i] -= proposal.factor[i, j] * z[j]
        z[i] /= proposal.factor[i, i]
    total = 0.0
    scale = 1.0 / (STUDENT * proposal.width * proposal.width)
    for k in range(proposal.white.shape[0]):
        square = 1.0
        for i in range(size):
            offset = z[i] - proposal.white[k, i]
            square += offset * offset * scale
        fourth = square * square * square * square
        total += square / (fourth * fourth)  # to the power of -7
    return np.log(total)
