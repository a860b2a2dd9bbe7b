"""Compiled maximum likelihood of amplitude laws over points or bins.

The compiled code is in this file and :mod:`sasmap.sediments.kernel`. A law has two shape
coordinates, u0 = log nu (or log of the Weibull or lognormal shape) and u1 = log(1 + kappa^2), and
u2, the log of its mean square. kappa = 0 is a regular bound of u1.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from sasmap.sediments.kernel import log_density, log_i0e, log_normaliser

RAYLEIGH, K, RICE, WEIBULL, LOGNORMAL, GENERALIZED_K = range(6)
LOWER = np.array([math.log(1e-3), 0.0, -700.0])
UPPER = np.array([math.log(1e6), math.log1p(1e8), 700.0])
DELTA = 1e-5
# Maximum number of steps of a maximisation, and gain in log likelihood (nats) below which it stops.
ROUNDS, ENOUGH = 60, 1e-3
HALVINGS = 80


@numba.njit(cache=True, nogil=True, error_model="numpy")
def scale_of(family, u):  # type: ignore[no-untyped-def]
    """Log of a law's scale from its coordinates."""
    kappa2 = math.expm1(u[1])
    if family in (RAYLEIGH, K):
        return 0.5 * u[2]
    if family == RICE:
        return 0.5 * (u[2] - u[1])
    if family == GENERALIZED_K:
        return 0.5 * (u[2] - math.log1p(kappa2 * (1.0 + math.exp(-u[0]))))
    if family == WEIBULL:  # E[x^2] = scale^2 Gamma(1 + 2 / c)
        return 0.5 * (u[2] - math.lgamma(1.0 + 2.0 * math.exp(-u[0])))
    return 0.5 * u[2] - math.exp(2.0 * u[0])  # lognormal: exp(2 mu + 2 s^2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def log_law(family, x, shape, kappa, normaliser):  # type: ignore[no-untyped-def]
    """Log density at x > 0 for scale 1."""
    if family == RAYLEIGH:
        return math.log(2.0 * x) - x * x
    if family == RICE:
        return math.log(2.0 * x) - (x - kappa) ** 2 + log_i0e(2.0 * kappa * x)
    if family == WEIBULL:
        power = shape * math.log(x)
        return math.log(shape / x) + power - math.exp(min(power, 700.0))
    if family == LOGNORMAL:
        z = math.log(x) / shape
        return -0.5 * z * z - math.log(x * shape * math.sqrt(2.0 * math.pi))
    return log_density(x, shape, kappa, normaliser)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill(family, u, low, high, centre, nodes, weights, result):  # type: ignore[no-untyped-def]
    """Fill the log probability of bins, or the log density of points (bins of zero width).

    A bin that is wide relative to its position is halved towards 0; an infinite bin holds the tail,
    by quadrature out to where the rest is negligible.
    """
    scale = scale_of(family, u)
    shape, kappa = math.exp(u[0]), math.sqrt(max(math.expm1(u[1]), 0.0))
    if family == K:
        kappa = 0.0
    gamma = family in (K, GENERALIZED_K)
    normaliser = log_normaliser(shape) if gamma else 0.0
    inverse = math.exp(-scale)
    for i in range(low.size):
        if high[i] <= low[i]:
            result[i] = log_law(family, centre[i] * inverse, shape, kappa, normaliser) - scale
            continue
        a, b = low[i] * inverse, high[i] * inverse
        total, right = 0.0, b
        if np.isinf(b):  # outwards in growing pieces
            left, step = max(a, 1e-3), 0.1 * max(a, 1e-3)
            for _ in range(120):
                part = _piece(family, left, left + step, shape, kappa, normaliser, nodes, weights)
                total += part
                left += step
                step *= 1.15
                if part < 1e-12 * total:
                    break
            result[i] = math.log(max(total, 1e-300))
            continue
        for _ in range(HALVINGS):
            left = max(0.5 * right, a)
            total += _piece(family, left, right, shape, kappa, normaliser, nodes, weights)
            right = left
            if left <= a:
                break
        if a <= 0.0:  # the rest is a power law
            level = log_law(family, right, shape, kappa, normaliser)
            total += math.exp(level) * right / (min(2.0 * shape, 2.0) if gamma else 1.0)
        result[i] = math.log(max(total, 1e-300))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _piece(family, low, high, shape, kappa, normaliser, nodes, weights):  # type: ignore[no-untyped-def]
    total, half = 0.0, 0.5 * (high - low)
    for k in range(nodes.size):
        x = low + half * (1.0 + nodes[k])
        total += weights[k] * math.exp(log_law(family, x, shape, kappa, normaliser))
    return total * half


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _scores(family, u, free, data, value, scores):  # type: ignore[no-untyped-def]
    """Fill log probabilities and their derivatives along the free coordinates."""
    low, high, centre, _, nodes, weights = data
    fill(family, u, low, high, centre, nodes, weights, value)
    other = np.empty(value.size)
    for j in range(free.size):
        if free[j]:
            moved = u.copy()
            step = DELTA if u[j] + DELTA <= UPPER[j] else -DELTA
            moved[j] += step
            fill(family, moved, low, high, centre, nodes, weights, other)
            for i in range(value.size):
                scores[j, i] = (other[i] - value[i]) / step


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _system(family, u, free, data, value, scores):  # type: ignore[no-untyped-def]
    """Return the log likelihood, its gradient and the information matrix from the scores."""
    _scores(family, u, free, data, value, scores)
    count = data[3]
    weighted = scores * count  # rows of coordinates that are not free stay zero
    return (count * value).sum(), weighted.sum(axis=1), weighted @ scores.T


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step(u, gradient, information, free, damping):  # type: ignore[no-untyped-def]
    """Damped scoring step in the coordinates that are free and not at a bound."""
    n = free.size
    matrix, right = np.eye(n), np.zeros(n)
    for j in range(n):
        low, high = u[j] <= LOWER[j] and gradient[j] < 0.0, u[j] >= UPPER[j] and gradient[j] > 0.0
        if not free[j] or low or high:
            continue
        right[j] = gradient[j]
        for k in range(n):
            if right[k] != 0.0:
                matrix[j, k] = matrix[k, j] = information[j, k]
        matrix[j, j] = information[j, j] * (1.0 + damping) + 1e-12
    step = np.linalg.solve(matrix, right)
    return np.minimum(np.maximum(step, -2.0), 2.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def climb(family, start, free, data, rounds):  # type: ignore[no-untyped-def]
    """Maximise the log likelihood by damped scoring steps within the bounds.

    Returns coordinates, log likelihood and information (zero for coordinates that are not free).
    """
    size = data[0].size
    value, scores, trial = np.empty(size), np.zeros((free.size, size)), np.empty(size)
    u = np.minimum(np.maximum(start, LOWER), UPPER)
    level, gradient, information = _system(family, u, free, data, value, scores)
    damping = 1e-3
    for _ in range(rounds):
        step = _step(u, gradient, information, free, damping)
        proposed = np.minimum(np.maximum(u + step, LOWER), UPPER)
        fill(family, proposed, data[0], data[1], data[2], data[4], data[5], trial)
        gain = (data[3] * trial).sum() - level
        if gain > 0.0:
            u = proposed
            level, gradient, information = _system(family, u, free, data, value, scores)
            damping = max(0.1 * damping, 1e-6)
            if gain < ENOUGH:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    return u, level, information
