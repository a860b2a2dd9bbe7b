"""Gaussian mixtures for the posterior of a look: their fit to draws, and marginals."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from sasmap.arrays import FloatArray
from sasmap.numerics.gaussians import Mixture, fitted_mixture

# Most components.
MOST = 3
# Effective number of independent draws assumed when the number of components is chosen.
EFFECTIVE = 400.0
# Draws that a fit uses, evenly thinned: five times the number of independent ones.
USED = 2000
# Most iterations of a fit, the gain in mean log likelihood at which it ends, and the least variance
# of components, over that of all draws.
ROUNDS, ENOUGH, FLOOR = 80, 1e-6, 1e-4
# Search for quantiles: its range in standard deviations, most steps, and size of the last Newton
# step over the width of the range; the remaining error is of the order of its square.
REACH, STEPS, PRECISION = 12.0, 60, 1e-8
# Quantiles, and the 0.95 quantile of a standard Gaussian, at which the search starts.
SHARES, TAIL = (0.05, 0.95), 1.645
# Standard deviations beyond which a Gaussian has no mass in double precision: above, and below.
CERTAIN, REACH_BELOW = 8.3, 38.5
# Cap on the log of a moment, which only components of no weight reach.
LARGEST = 200.0
# Mass within the bounds below which a density counts as lying outside them.
OUTSIDE = 1e-200


def fit_mixture(points: FloatArray) -> Mixture:
    """Fit a mixture to draws by expectation-maximisation, with as many components as needed.

    Parameters
    ----------
    points : ndarray (n, size)

    Returns
    -------
    Mixture
        With one to three components, chosen by the Bayesian information criterion.
    """
    some = points[:: -(-len(points) // USED)]
    return fitted_mixture(some, MOST, EFFECTIVE, FLOOR, ROUNDS, ENOUGH)


class Marginal(NamedTuple):
    """Mean, standard deviation and quantiles 0.05 and 0.95 of one parameter, arrays (n,)."""

    mean: FloatArray
    sd: FloatArray
    q05: FloatArray
    q95: FloatArray


def marginals(weight: FloatArray, mean: FloatArray, sd: FloatArray, bounds: FloatArray) -> Marginal:
    """Summarise parameters whose logs are Gaussian mixtures, truncated to bounds.

    Parameters
    ----------
    weight, mean, sd : ndarray (n, K)
        Of the mixtures of the logs.
    bounds : ndarray (2,) or (2, n)
        Bounds of the logs.

    Returns
    -------
    Marginal
        Of the parameters, not of their logs.
    """
    low, high = (np.ascontiguousarray(np.broadcast_to(b, len(weight)), float) for b in bounds)
    result = np.empty((4, len(weight)))
    _summarise(*(np.ascontiguousarray(v) for v in (weight, mean, sd)), low, high, result)
    return Marginal(*result)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def weighted(weight, values):  # type: ignore[no-untyped-def]
    """Weighted sums (n,) of values (n, K), in a fixed order, so that padding changes no digit."""
    result = np.zeros(len(weight))
    for r in range(weight.shape[0]):
        for k in range(weight.shape[1]):
            result[r] += weight[r, k] * values[r, k]
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _below(z):  # type: ignore[no-untyped-def]
    """Cumulative probability of a standard Gaussian."""
    if z > CERTAIN:
        return 1.0
    return 0.5 * math.erfc(-z * math.sqrt(0.5)) if z > -REACH_BELOW else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _summarise(weight, mean, sd, low, high, result):  # type: ignore[no-untyped-def]
    """Fill in mean, standard deviation and quantiles (4, n)."""
    for r in range(low.size):
        heavy = np.flatnonzero(weight[r] > 0)
        w, m, s = weight[r][heavy], mean[r][heavy], sd[r][heavy]
        total, middle = 0.0, 0.0
        before = np.empty(w.size)
        for k in range(w.size):
            before[k] = _below((low[r] - m[k]) / s[k])
            total += w[k] * (_below((high[r] - m[k]) / s[k]) - before[k])
            middle += w[k] * m[k]
        middle = min(max(middle, low[r]), high[r])
        result[:, r] = np.exp(middle)
        if not total > OUTSIDE:  # the whole density lies beyond a bound
            result[1, r] = 0.0
            continue
        one, two, spread = 0.0, 0.0, 0.0
        for k in range(w.size):
            apart = m[k] - middle
            for power in (1, 2):
                moment = np.exp(min(power * apart + 0.5 * (power * s[k]) ** 2, LARGEST))
                beyond = _below((low[r] - m[k]) / s[k] - power * s[k])
                moment *= _below((high[r] - m[k]) / s[k] - power * s[k]) - beyond
                if power == 1:
                    one += w[k] * moment / total
                else:
                    two += w[k] * moment / total
            spread += w[k] * (s[k] ** 2 + apart**2)
        result[0, r] *= one
        result[1, r] *= math.sqrt(max(two - one**2, 0.0))
        for q in range(2):
            start = middle + (2 * q - 1) * TAIL * math.sqrt(spread)
            goal = SHARES[q] * total
            result[2 + q, r] = math.exp(_quantile(w, m, s, low[r], before, goal, start))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _quantile(weight, mean, sd, low, before, goal, start):  # type: ignore[no-untyped-def]
    """Value at which the mass above `low` reaches `goal`, by Newton's method with bisection.

    `before` is the mass of each component below `low`, and `start` the initial value.
    """
    left, right = np.inf, -np.inf
    for k in range(weight.size):
        left, right = min(left, mean[k] - REACH * sd[k]), max(right, mean[k] + REACH * sd[k])
    enough = PRECISION * (right - left)
    middle = start if left < start < right else 0.5 * (left + right)
    for _ in range(STEPS):
        excess, slope = -goal, 0.0
        for k in range(weight.size):
            part = (middle - mean[k]) / sd[k]
            if middle > low:
                excess += weight[k] * (_below(part) - before[k])
                if abs(part) < CERTAIN:
                    slope += weight[k] * math.exp(-0.5 * part * part) / sd[k]
        if excess < 0:
            left = middle
        else:
            right = middle
        moved = middle - excess * math.sqrt(2 * math.pi) / slope if slope > 0 else left
        if not left < moved < right:
            moved = 0.5 * (left + right)
        far = abs(moved - middle) > enough
        middle = moved
        if not far:
            break
    return middle
