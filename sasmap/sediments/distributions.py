"""Amplitude laws of sea floors under the conventions of scipy.stats: generalised K and K.

Rayleigh, Rice, Weibull and lognormal are scipy's own. Of the generalised K (G 5) no
factor is computed that could overflow or cancel: see :mod:`sasmap.sediments.kernel`.
"""

from __future__ import annotations

from functools import lru_cache
from math import comb, factorial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, poch
from scipy.stats import rv_continuous

from sasmap.sediments.kernel import (
    cumulate,
    log_densities,
    log_densities_each,
    log_normaliser,
    mass,
)

FloatArray = NDArray[np.float64]

# Points of the Gauss-Legendre rule on each of a law's smooth pieces.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
# Newton steps, at most, to a quantile.
STEPS = 60


class Table:
    """Places of one law of scale 1 with the probability below and above each.

    Parameters
    ----------
    nu, kappa : float
    """

    def __init__(self, nu: float, kappa: float) -> None:
        self.nu, self.kappa = nu, kappa
        self.normaliser = log_normaliser(nu)
        self.place, self.below, self.above = cumulate(nu, kappa, NODES, WEIGHTS)

    def cdf(self, x: FloatArray) -> FloatArray:
        """Probability below x (n,); small values to their own precision."""
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
        """Probability above x (n,); small values to their own precision."""
        i = np.searchsorted(self.place, x, side="right")
        result = np.zeros(x.size)
        for k, (j, value) in enumerate(zip(i, x, strict=True)):
            if j == 0:
                result[k] = 1.0 - self.cdf(np.array([value]))[0]
            elif j < self.place.size:
                result[k] = self.above[j] + self._mass(value, self.place[j])
        return np.minimum(result, 1.0)

    def quantile(self, q: FloatArray, upper: bool) -> FloatArray:
        """Where the probability below (or above) is q (n,)."""
        return np.array([self._quantile(float(p), upper) for p in q])

    def quadrature(self) -> tuple[FloatArray, FloatArray]:
        """Places, and probability that each stands for, over all of the law (pieces, points)."""
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
    """Table of a law, kept for the next call."""
    return Table(nu, kappa)


def _by_law(function: Any, x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
    """Apply a function of a law's table and points law by law."""
    x, nu, kappa = (np.asarray(v, float) for v in np.broadcast_arrays(x, nu, kappa))
    flat, result = x.ravel(), np.empty(x.size)
    laws = np.stack([nu.ravel(), kappa.ravel()], axis=1)
    each, index = np.unique(laws, axis=0, return_inverse=True)
    for i, (n, k) in enumerate(each):
        here = index.ravel() == i
        result[here] = function(table(float(n), float(k)), flat[here])
    return result.reshape(x.shape)


def log_density_of(x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
    """Log density of scale 1 at x >= 0, of arguments that broadcast.

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


class GeneralizedK(rv_continuous):  # type: ignore[misc]
    """Generalised K law of an amplitude (G 5): shapes nu and kappa = delta / a; the scale is a.

    Texture z ~ Gamma(nu, mean 1) scales drift and variance of the speckle alike; kappa = 0 is the K
    law, nu to infinity Rice, both Rayleigh. E[x^2] = a^2 (1 + kappa^2 (1 + 1 / nu)).

    Examples
    --------
    >>> from sasmap.sediments import generalized_k
    >>> generalized_k.logpdf([0.5, 1.0], 1e8, 0.0).round(4)  # Rayleigh: log(2 x) - x^2
    array([-0.25  , -0.3069])
    >>> x = generalized_k.rvs(2.0, 1.0, scale=3.0, size=1000, random_state=1)
    >>> float(generalized_k.cdf(x, 2.0, 1.0, scale=3.0).mean().round(1))
    0.5
    """

    def _argcheck(self, nu: FloatArray, kappa: FloatArray) -> NDArray[np.bool_]:
        return np.asarray((nu > 0) & (kappa >= 0) & np.isfinite(nu) & np.isfinite(kappa))

    def _logpdf(self, x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return log_density_of(x, nu, kappa)

    def _pdf(self, x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return np.exp(log_density_of(x, nu, kappa))

    def _cdf(self, x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return _by_law(Table.cdf, x, nu, kappa)

    def _sf(self, x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return _by_law(Table.sf, x, nu, kappa)

    def _ppf(self, q: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return _by_law(lambda law, p: law.quantile(p, upper=False), q, nu, kappa)

    def _isf(self, q: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return _by_law(lambda law, p: law.quantile(p, upper=True), q, nu, kappa)

    def _rvs(
        self,
        nu: FloatArray,
        kappa: FloatArray,
        size: Any = None,
        random_state: Any = None,
    ) -> FloatArray:
        texture = random_state.standard_gamma(nu, size) / nu
        noise = random_state.standard_normal((2, *np.shape(texture))) * np.sqrt(0.5)
        return np.asarray(
            np.hypot(texture * kappa + np.sqrt(texture) * noise[0], np.sqrt(texture) * noise[1])
        )

    def _munp(self, n: int, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        if n % 2 == 0:
            return np.asarray(even_moment(n // 2, nu, kappa))
        return _by_law(_moment, np.array(float(n)), nu, kappa)

    def fit(self, data: FloatArray, *args: Any, **kwds: Any) -> tuple[float, ...]:
        """Fit by maximum likelihood: nu, kappa, loc (0) and scale.

        Parameters
        ----------
        data : array_like
            Amplitudes, at least 0.
        **kwds
            ``floc`` may be given and must be 0; ``method="MM"`` fits by moments.

        Returns
        -------
        tuple of float

        Raises
        ------
        ValueError
            Where data are empty, negative or not finite, or another loc is asked for.
        """
        from sasmap.sediments.fitting import fit
        from sasmap.sediments.moments import fit_moments

        _check_loc(kwds)
        law = fit_moments(data) if kwds.get("method") == "MM" else fit(data)
        return law.nu, law.kappa, 0.0, law.scale


class KDistribution(GeneralizedK):
    """K law of an amplitude (G 3): shape nu; the scale is a, E[x^2] = a^2."""

    def _argcheck(self, nu: FloatArray) -> NDArray[np.bool_]:  # type: ignore[override]
        return np.asarray((nu > 0) & np.isfinite(nu))

    def _logpdf(self, x: FloatArray, nu: FloatArray) -> FloatArray:  # type: ignore[override]
        return super()._logpdf(x, nu, np.zeros(1))

    def _pdf(self, x: FloatArray, nu: FloatArray) -> FloatArray:  # type: ignore[override]
        return super()._pdf(x, nu, np.zeros(1))

    def _cdf(self, x: FloatArray, nu: FloatArray) -> FloatArray:  # type: ignore[override]
        return super()._cdf(x, nu, np.zeros(1))

    def _sf(self, x: FloatArray, nu: FloatArray) -> FloatArray:  # type: ignore[override]
        return super()._sf(x, nu, np.zeros(1))

    def _ppf(self, q: FloatArray, nu: FloatArray) -> FloatArray:  # type: ignore[override]
        return super()._ppf(q, nu, np.zeros(1))

    def _isf(self, q: FloatArray, nu: FloatArray) -> FloatArray:  # type: ignore[override]
        return super()._isf(q, nu, np.zeros(1))

    def _rvs(  # type: ignore[override]
        self, nu: FloatArray, size: Any = None, random_state: Any = None
    ) -> FloatArray:
        return super()._rvs(nu, np.zeros(()), size, random_state)

    def _munp(self, n: int, nu: FloatArray) -> FloatArray:  # type: ignore[override]
        # E[x^n] = Gamma(1 + n / 2) Gamma(nu + n / 2) / (Gamma(nu) nu^(n / 2))
        return np.asarray(np.exp(gammaln(1 + n / 2)) * np.exp(_log_power_mean(nu, n / 2)))

    def fit(self, data: FloatArray, *args: Any, **kwds: Any) -> tuple[float, ...]:
        """Fit by maximum likelihood: nu, loc (0) and scale; see :meth:`GeneralizedK.fit`."""
        from sasmap.sediments.fitting import fit

        _check_loc(kwds)
        law = fit(data, "k")
        return law.nu, 0.0, law.scale


def _check_loc(options: dict[str, Any]) -> None:
    if options.get("floc", 0) != 0 or options.get("loc", 0) != 0:
        raise ValueError("floc: expected 0, amplitudes begin there")


def _log_power_mean(nu: FloatArray, power: float) -> FloatArray:
    """Log of the mean of z^power of a Gamma law of mean 1."""
    nu = np.asarray(nu, float)
    series = power * (power - 1) / (2 * nu)  # where the difference of logs would cancel
    with np.errstate(over="ignore"):
        exact = gammaln(nu + power) - gammaln(nu) - power * np.log(nu)
    return np.asarray(np.where(nu > 1e7, series, exact))


def even_moment(m: int, nu: FloatArray, kappa: FloatArray) -> FloatArray:
    """E[x^(2 m)] of scale 1.

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


def _moment(law: Table, order: FloatArray) -> FloatArray:
    """E[x^order] of scale 1 by integration over the law's smooth pieces."""
    x, weight = law.quadrature()
    total = (weight * x ** float(order[0])).sum()
    return np.full(order.size, total)


generalized_k = GeneralizedK(a=0.0, name="generalized_k", shapes="nu, kappa")
k_distribution = KDistribution(a=0.0, name="k_distribution", shapes="nu")
