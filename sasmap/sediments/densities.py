"""Densities of the generalised K law (G 5) and integrals of them, arrays in and out.

No computed factor can overflow or cancel: see :mod:`sasmap.sediments.kernel`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import comb, factorial

import numpy as np
from scipy.special import poch

from sasmap.arrays import FloatArray
from sasmap.sediments.kernel import (
    cumulate,
    log_densities,
    log_densities_each,
    log_normaliser,
    mass,
)

# Points and weights of the Gauss-Legendre rule on each smooth piece of a law.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
# Maximum number of Newton steps to a quantile.
STEPS = 60


class Table:
    """Points of one law of scale 1 with the probability below and above each.

    Parameters
    ----------
    nu, kappa : float
    """

    def __init__(self, nu: float, kappa: float) -> None:
        self.nu, self.kappa = nu, kappa
        self.normaliser = log_normaliser(nu)
        self.place, self.below, self.above = cumulate(nu, kappa, NODES, WEIGHTS)

    def cdf(self, x: FloatArray) -> FloatArray:
        """Probability below x (n,); small values to full relative precision."""
        i = np.clip(np.searchsorted(self.place, x, side="right") - 1, 0, self.place.size - 1)
        result = np.empty(x.size)
        for k, (j, value) in enumerate(zip(i, x, strict=True)):
            if value <= self.place[0]:
                power = min(2 * self.nu, 2.0)
                share = (value / self.place[0]) ** power if value > 0 else 0.0
                result[k] = self.below[0] * share
            else:
                result[k] = self.below[j] + self._mass(self.place[j], value)
        return np.minimum(result, 1.0)

    def sf(self, x: FloatArray) -> FloatArray:
        """Probability above x (n,); small values to full relative precision."""
        i = np.searchsorted(self.place, x, side="right")
        result = np.zeros(x.size)
        for k, (j, value) in enumerate(zip(i, x, strict=True)):
            if j == 0:
                result[k] = 1.0 - self.cdf(np.array([value]))[0]
            elif j < self.place.size:
                result[k] = self.above[j] + self._mass(value, self.place[j])
        return np.minimum(result, 1.0)

    def quantile(self, q: FloatArray, upper: bool) -> FloatArray:
        """Points at which the probability below (or above) is q (n,)."""
        return np.array([self._quantile(float(p), upper) for p in q])

    def quadrature(self) -> tuple[FloatArray, FloatArray]:
        """Quadrature points and their probability weights over the whole law (pieces, points)."""
        low, high = self.place[:-1, None], self.place[1:, None]
        x = low + 0.5 * (high - low) * (1 + NODES)
        density = np.exp(log_densities(x.ravel(), self.nu, self.kappa)).reshape(x.shape)
        return x, 0.5 * (high - low) * WEIGHTS * density

    def _mass(self, low: float, high: float) -> float:
        return float(mass(low, high, self.nu, self.kappa, self.normaliser, NODES, WEIGHTS))

    def _quantile(self, q: float, upper: bool) -> float:
        if not 0 < q < 1:
            return float("nan") if not 0 <= q <= 1 else (0.0 if (q == 0) != upper else np.inf)
        known = self.above[::-1] if upper else self.below
        if not upper and q <= known[0]:
            return float(self.place[0] * (q / known[0]) ** (1 / min(2 * self.nu, 2.0)))
        j = int(np.searchsorted(known, q))
        j = self.place.size - j if upper else j
        j = int(np.clip(j, 1, self.place.size - 1))
        low, high = self.place[j - 1], self.place[j]
        anchor, base = (high, self.above[j]) if upper else (low, self.below[j - 1])
        x = 0.5 * (low + high)
        for _ in range(STEPS):
            got = base + (self._mass(x, anchor) if upper else self._mass(anchor, x))
            short = (got - q) if upper else (q - got)
            low, high = (x, high) if short > 0 else (low, x)
            density = float(np.exp(log_densities(np.array([x]), self.nu, self.kappa)[0]))
            step = short / density if density > 0 else np.inf
            next_x = x + step
            if not low < next_x < high:
                next_x = 0.5 * (low + high)
            if abs(next_x - x) <= 1e-15 * x:
                break
            x = next_x
        return float(x)


@lru_cache(maxsize=64)
def table(nu: float, kappa: float) -> Table:
    """Return the table of a law, cached for the next call."""
    return Table(nu, kappa)


def by_law(
    function: Callable[[Table, FloatArray], FloatArray],
    x: FloatArray,
    nu: FloatArray,
    kappa: FloatArray,
) -> FloatArray:
    """Apply a function of a law's table and points to each law; arguments broadcast."""
    x, nu, kappa = (np.asarray(v, float) for v in np.broadcast_arrays(x, nu, kappa))
    flat, result = x.ravel(), np.empty(x.size)
    laws = np.stack([nu.ravel(), kappa.ravel()], axis=1)
    each, index = np.unique(laws, axis=0, return_inverse=True)
    for i, (n, k) in enumerate(each):
        here = index.ravel() == i
        result[here] = function(table(float(n), float(k)), flat[here])
    return result.reshape(x.shape)


def log_density_of(x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
    """Log density at x >= 0 for scale 1; arguments broadcast.

    Parameters
    ----------
    x, nu, kappa : array_like

    Returns
    -------
    ndarray
        At 0 its limit: infinite for nu < 1/2, minus infinity above.
    """
    x, nu, kappa = (np.asarray(v, float) for v in np.broadcast_arrays(x, nu, kappa))
    flat = [np.ascontiguousarray(v.ravel()) for v in (x, nu, kappa)]
    positive = (flat[0] > 0) & np.isfinite(flat[0])
    result = np.full(x.size, -np.inf)
    if positive.any():
        result[positive] = log_densities_each(*(v[positive] for v in flat))
    zero = flat[0] == 0
    result[zero & (flat[1] < 0.5)] = np.inf
    half = zero & (flat[1] == 0.5)
    result[half] = log_densities_each(np.full(half.sum(), 1e-300), *(v[half] for v in flat[1:]))
    return result.reshape(x.shape)


def even_moment(m: int, nu: FloatArray, kappa: FloatArray) -> FloatArray:
    """E[x^(2 m)] for scale 1.

    Parameters
    ----------
    m : int
    nu, kappa : array_like

    Returns
    -------
    ndarray
        Sum over j of C(m, j)^2 (m - j)! kappa^(2 j) E[z^(m + j)] (moments of a Rice law, averaged
        over its texture).
    """
    nu, kappa = np.asarray(nu, float), np.asarray(kappa, float)
    total = np.zeros(np.broadcast_shapes(nu.shape, kappa.shape))
    for j in range(m + 1):
        mean = poch(nu, m + j) / nu ** (m + j)
        total = total + comb(m, j) ** 2 * factorial(m - j) * kappa ** (2 * j) * mean
    return np.asarray(total)


def moment(law: Table, order: FloatArray) -> FloatArray:
    """E[x^order] for scale 1, by integration over the law's smooth pieces."""
    x, weight = law.quadrature()
    total = (weight * x ** float(order[0])).sum()
    return np.full(order.size, total)
