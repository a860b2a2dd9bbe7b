"""The compiled inner loops of the default method, all in one file.

numba keeps compiled code on disk and notices a change only in the file of the function it
compiled; what calls across files could go on using an older version of what it calls.

The intensity of fully developed speckle is exponential about m = G (lit fraction * a*^2 + n0). Its
likelihood over the pixels of a bin depends on them only through their number and sum; the gain G
of each block of range is integrated out exactly under its scale-invariant prior 1/G:

    log L = sum over blocks of  - sum n log s - N log(sum total / s),      s = m / G,  N = sum n

A saturated pixel adds to the sum alone: its intensity is known to be at least that. The likelihood
is raised to the power of one over the noise factor, by which correlated and textured speckle says
less than as many independent pixels.

The parameters theta are those of :mod:`sasmap.ripples.folded`.
"""

from __future__ import annotations

import numba
import numpy as np

from sasmap.ripples.scattering import SIGMA_VARIANCE

SIZE = 6
# Bins of phase in a block, and the width of one, rad.
BINS = 64
BIN = 2.0 * np.pi / BINS
# Receiver noise: about 20 dB below the sea floor, give or take a factor of e^2.
NOISE_MEAN, NOISE_SD = float(np.log(0.01)), 2.0
NOISE_BOUNDS = (float(np.log(1e-6)), float(np.log(10.0)))
# With a phase field the fundamental's phase is the field's, to this standard deviation, rad.
PHASE_SD = 0.1
SINE, STOKES, PEAKED = 0, 1, 2
# Slope of the ray, over that at which shadow sets in, within which its edges are found bin by bin.
ONSET = (0.92, 1.06)
# Rays of a block that meet shadow, over their range of log slope, and their weights (Gauss and
# Legendre).
RAYS = (0.0469100770, 0.2307653449, 0.5, 0.7692346551, 0.9530899230)
RAY_WEIGHTS = (0.1184634425, 0.2393143352, 0.2844444444, 0.2393143352, 0.1184634425)
# Pixels that count in a bin all in shadow: its level is not the same everywhere to better than
# about a fourth.
SHADOW_PIXELS = 16.0
# Weight of steps by differences of two members, and of nuisances drawn from near their prior; the
# others are drawn anew.
LOCAL, NUISANCE = 0.25, 0.15
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
    if np.cos(theta[2] - data.look) <= 0.0:  # the same sea floor, looked at the other way round
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


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _share(position, half, other, leak):  # type: ignore[no-untyped-def]
    """Share of a bin's pixels that lie before a position relative to its centre.

    All but a share `leak` on each side lie as the sum of two even spreads of these half-widths;
    the rest within a bin more.
    """
    wide, narrow = max(half, other), max(min(half, other), 1e-6)
    distance = abs(position)
    tail = 0.0
    if distance <= wide - narrow:
        tail = 0.5 - 0.5 * distance / wide
    elif distance < wide + narrow:
        tail = (wide + narrow - distance) ** 2 / (8.0 * wide * narrow)
    if leak > 0.0:
        beyond = min(max((distance - wide) / BIN, 0.0), 1.0)
        tail = leak * (1.0 - beyond) + (1.0 - 2.0 * leak) * tail
    return 1.0 - tail if position > 0.0 else tail


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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _hidden(past, begin, end, half, first, last, leak):  # type: ignore[no-untyped-def]
    """Share of a bin in shadow: its phase past the crest, edges, half-widths of it and of both."""
    hidden = _share(end - past, half, last, leak) - _share(begin - past, half, first, leak)
    turn, reach = 2.0 * np.pi, half + max(first, last) + BIN
    for k in range(2):
        if k == 0 and past < reach:
            moved = past + turn
        elif k == 1 and past > turn - reach:
            moved = past - turn
        else:
            continue
        hidden += _share(end - moved, half, last, leak) - _share(begin - moved, half, first, leak)
    return min(max(hidden, 0.0), 1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _distance(past, begin, end):  # type: ignore[no-untyped-def]
    """Distance of a phase past the crest from the nearer edge of a shadow, around the circle."""
    first, last = abs(past - begin), abs(past - end)
    return min(first, 2.0 * np.pi - first, last, abs(2.0 * np.pi - last))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def block_intensity(theta, data, block, offset, stretch, blur, shape, weight):  # type: ignore[no-untyped-def]
    """Fill s = lit a*^2 + n0 of straight crests' bins, over the flat sea floor, and weights.

    `offset` is what the ripple's phase is ahead of the bins', `stretch` how that grows along the
    look, rad/m, and `blur` how far (rad) crests stray.
    """
    along = np.cos(theta[2] - data.look)
    full = 2.0 * np.pi * theta[0] * theta[1]
    steepness = full * along
    swing, change = _swing(full, steepness, data, block)
    damping = np.exp(-0.5 * blur * blur)
    swing, change = damping * swing, damping * change
    noise = np.exp(theta[4])
    edges = np.zeros(8)
    shadowed, onset = False, False
    first_past, last_past = 0.0, 2.0 * np.pi  # phases past the crest beyond which all is lit
    if data.shadow > 0 and steepness > 0.0:
        shadowed = _edges_seen(theta, data, block, 0.0, full, steepness, edges)
        limit = _shadow_limit(full, data)
        ratio = data.altitude[block] / data.reach[block] / (steepness * limit)
        onset = ONSET[0] < ratio < ONSET[1]  # edges part too fast for a straight line through them
    widen = np.sqrt(3.0) * blur
    first = np.hypot(data.spread[block] * edges[2], widen)
    last = np.hypot(data.spread[block] * edges[3], widen)
    if onset:
        lowest = data.farther[block].min()
        onset = _edges_seen(theta, data, block, lowest, full, steepness, edges)
        widest = data.half[block].max()
        margin = widest + max(widest + data.guard, widen + BIN)
        first_past, last_past = edges[0] - margin, edges[1] + margin
        shadowed = onset
    cos_offset, sin_offset = np.cos(offset), np.sin(offset)
    for i in range(shape.size):
        weight[i] = 1.0
        if data.total[block, i] == 0.0:
            shape[i] = 1.0  # no pixel asks
            continue
        c = data.cosine[block, i] * cos_offset - data.sine[block, i] * sin_offset
        s = data.sine[block, i] * cos_offset + data.cosine[block, i] * sin_offset
        more = stretch * data.ahead[block, i]
        c, s = c - more * s, s + more * c
        reach = swing + change * data.steeper[block, i]
        a = max(1.0 + reach * _slope_of(c, s, full, data.profile), 0.0)
        value = a * a * data.flat[block, i]
        if shadowed:
            past = data.phase[block, i] + offset + more - 0.5 * np.pi
            past -= 2.0 * np.pi * np.floor(past / (2.0 * np.pi))
            if past < first_past or past > last_past:
                shape[i] = value + noise
                continue
            half, farther = data.half[block, i], data.farther[block, i]
            begin, end = edges[0] + edges[2] * farther, edges[1] + edges[3] * farther
            hidden, near = 0.0, np.inf
            seen = True
            if onset:
                seen = _edges_seen(theta, data, block, farther, full, steepness, edges)
                begin, end, first, last = edges[0], edges[1], widen, widen
            if seen:
                hidden = _hidden(past, begin, end, half, first, last, data.leak)
                near = _distance(past, begin, end)
            value *= 1.0 - hidden
            # of lit and dark pixels together the intensity varies 2 / lit - 1 times as much
            lit = 1.0 - hidden
            dark = min(SHADOW_PIXELS / max(data.pixels[block, i], 1.0), 1.0)
            weight[i] = max(lit / (2.0 - lit), dark)
            beyond = min(max((near - half) / data.guard, 0.0), 1.0)
            weight[i] *= data.dither[block, i] + (1.0 - data.dither[block, i]) * beyond * beyond
        shape[i] = value + noise


@numba.njit(cache=True, nogil=True, error_model="numpy")
def field_intensity(theta, data, block, offset, shape):  # type: ignore[no-untyped-def]
    """Fill s = lit a*^2 + n0 of a block's bins where crests bend, without the field's error.

    Shadow is averaged over the rays of the block, from the steepest to the lowest.
    """
    full = 2.0 * np.pi * theta[0] * theta[1]
    steepness = full * np.cos(theta[2] - data.look)
    swing, _ = _swing(full, steepness, data, block)
    hidden = np.zeros(shape.size)
    edges = np.zeros(8)
    spread = max(data.spread[block], 1e-6)
    length = 0.0  # of the part of the rays, by log slope, that meets shadow
    if data.shadow > 0 and steepness > 0.0:
        ratio = data.altitude[block] / data.reach[block] / steepness
        length = min(spread, np.log(_shadow_limit(full, data) / ratio)) + spread
    for k in range(len(RAYS) if length > 0.0 else 0):
        farther = RAYS[k] * length - spread
        if not _edges_seen(theta, data, block, farther, full, steepness, edges):
            continue
        share = RAY_WEIGHTS[k] * 0.5 * length / spread
        for i in range(shape.size):
            past = data.phase[block, i] + offset - 0.5 * np.pi
            past -= 2.0 * np.pi * np.floor(past / (2.0 * np.pi))
            half = data.half[block, i]
            hidden[i] += share * _hidden(past, edges[0], edges[1], half, 0.0, 0.0, 0.0)
    noise = np.exp(theta[4])
    cos_offset, sin_offset = np.cos(offset), np.sin(offset)
    for i in range(shape.size):
        c = data.cosine[block, i] * cos_offset - data.sine[block, i] * sin_offset
        s = data.sine[block, i] * cos_offset + data.cosine[block, i] * sin_offset
        a = max(1.0 + swing * _slope_of(c, s, full, data.profile), 0.0)
        shape[i] = a * a * (1.0 - hidden[i]) + noise


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fundamental_lag(shape, data, block):  # type: ignore[no-untyped-def]
    """Phase of a pulse's fundamental: how far its brightest part lies past phase zero, rad."""
    real, imaginary = 0.0, 0.0
    for i in range(shape.size):
        real += shape[i] * data.cosine[block, i]
        imaginary += shape[i] * data.sine[block, i]
    return np.arctan2(imaginary, real)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _smeared(shape, sd, scratch):  # type: ignore[no-untyped-def]
    """Convolve a pulse on an even grid of phases with a Gaussian of sd rad, in place."""
    n = shape.size
    step = 2.0 * np.pi / n
    reach = min(int(np.ceil(3.0 * sd / step)), n // 2 - 1)
    if reach < 1:
        return
    scratch[:] = shape
    total = 1.0
    for k in range(1, reach + 1):
        total += 2.0 * np.exp(-0.5 * (k * step / sd) ** 2)
    for i in range(n):
        shape[i] = scratch[i] / total
    for k in range(1, reach + 1):
        share = np.exp(-0.5 * (k * step / sd) ** 2) / total
        for i in range(n):
            shape[i] += share * (scratch[(i + k) % n] + scratch[i - k])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def block_model(theta, data, block, shape, weight, scratch):  # type: ignore[no-untyped-def]
    """Fill a block's intensity bin by bin as the image shows it, and weights; return the lag.

    With a phase field the bins' phase is that of the image's fundamental, which lies past the
    ripple's own by the lag, and the field's error smears the pulse.
    """
    if data.field == 0:
        along = theta[0] * np.cos(theta[2] - data.look) - data.base[0]
        across = theta[0] * np.sin(theta[2] - data.look) - data.base[1]
        place = along * data.along[block] + across * data.across[block]
        offset = theta[3] + 2.0 * np.pi * place
        stretch = 2.0 * np.pi * along
        block_intensity(theta, data, block, offset, stretch, np.exp(theta[5]), shape, weight)
        return 0.0
    field_intensity(theta, data, block, 0.0, shape)
    lag = fundamental_lag(shape, data, block)
    field_intensity(theta, data, block, lag + theta[3], shape)
    _smeared(shape, np.exp(theta[5]), scratch)
    weight[:] = 1.0
    return lag


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_likelihood(theta, data):  # type: ignore[no-untyped-def]
    """Speckle log likelihood with the blocks' gains integrated out, up to a constant."""
    blocks, bins = data.pixels.shape
    shape = np.empty(bins)
    weight = np.empty(bins)
    scratch = np.empty(bins)
    value, bend, previous = 0.0, 0.0, 0.0
    pixels, logs, scaled = 0.0, 0.0, 0.0
    for block in range(blocks):
        lag = block_model(theta, data, block, shape, weight, scratch)
        lag = previous + (lag - previous + np.pi) % (2.0 * np.pi) - np.pi
        previous = lag
        bend += data.lagging[block] * lag
        for i in range(bins):
            if data.total[block, i] == 0.0:
                continue
            n = weight[i] * data.pixels[block, i]
            pixels += n
            # a true model loses half a unit to a bin's own mean: no reason to prefer light bins
            value += 0.5 * weight[i]
            logs += n * (np.log(shape[i]) - data.log_mean[block, i])
            scaled += weight[i] * data.total[block, i] / shape[i]
        if block + 1 == blocks or data.group[block + 1] != data.group[block]:
            if pixels > 0.0:
                value -= logs + pixels * np.log(scaled / pixels)
            pixels, logs, scaled = 0.0, 0.0, 0.0
    value *= data.power
    along = theta[0] * np.cos(theta[2] - data.look) - bend / (2.0 * np.pi) - data.wave[0]
    across = theta[0] * np.sin(theta[2] - data.look) - data.wave[1]
    value -= 0.5 * (along**2 * data.wave_precision[0] + across**2 * data.wave_precision[1])
    return value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pulses(theta, data):  # type: ignore[no-untyped-def]
    """Intensity of each block and bin as the image shows it, gain included (blocks, bins)."""
    blocks, bins = data.pixels.shape
    result = np.empty((blocks, bins))
    weight = np.empty((blocks, bins))
    scratch = np.empty(bins)
    first, pixels, scaled = 0, 0.0, 0.0
    for block in range(blocks):
        block_model(theta, data, block, result[block], weight[block], scratch)
        for i in range(bins):
            if data.total[block, i] > 0.0:
                pixels += weight[block, i] * data.pixels[block, i]
                scaled += weight[block, i] * data.total[block, i] / result[block, i]
        if block + 1 == blocks or data.group[block + 1] != data.group[block]:
            result[first : block + 1] *= scaled / pixels if pixels > 0.0 else 1.0
            first, pixels, scaled = block + 1, 0.0, 0.0
    return result


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
    """Fill a state with another noise floor or blur: steps as wide as the prior, or a tenth."""
    proposed[:] = current
    width = 10.0 ** (-rng.random())
    if rng.random() < 0.6:
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
