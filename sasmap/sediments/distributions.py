"""Amplitude laws of sea floors in the conventions of scipy.stats: generalised K and K.

Rayleigh, Rice, Weibull and lognormal are scipy's own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats
from scipy.special import gammaln

from sasmap.arrays import BoolArray, FloatArray
from sasmap.sediments.densities import Table, by_law, even_moment, log_density_of, moment
from sasmap.sediments.fitting import Law, fit
from sasmap.sediments.moments import fit_moments

# Largest nu and smallest kappa at which a search with a fixed parameter starts: beyond, the
# likelihood of speckle is flat in nu (Rayleigh or Rice) or kappa is at its bound.
FREE_NU, FREE_KAPPA = 50.0, 0.1


class GeneralizedK(stats.rv_continuous):  # type: ignore[misc]
    """Generalised K law of an amplitude (G 5): shapes nu and kappa = delta / a; the scale is a.

    Texture z ~ Gamma(nu, mean 1) scales both drift and variance of the speckle; kappa = 0 is the K
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

    def _argcheck(self, nu: FloatArray, kappa: FloatArray) -> BoolArray:
        return np.asarray((nu > 0) & (kappa >= 0) & np.isfinite(nu) & np.isfinite(kappa))

    def _logpdf(self, x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return log_density_of(x, nu, kappa)

    def _pdf(self, x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return np.exp(log_density_of(x, nu, kappa))

    def _cdf(self, x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return by_law(Table.cdf, x, nu, kappa)

    def _sf(self, x: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return by_law(Table.sf, x, nu, kappa)

    def _ppf(self, q: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return by_law(lambda law, p: law.quantile(p, upper=False), q, nu, kappa)

    def _isf(self, q: FloatArray, nu: FloatArray, kappa: FloatArray) -> FloatArray:
        return by_law(lambda law, p: law.quantile(p, upper=True), q, nu, kappa)

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
        return by_law(moment, np.array(float(n)), nu, kappa)

    def fit(self, data: FloatArray, *args: Any, **kwds: Any) -> tuple[float, ...]:
        """Fit by maximum likelihood: nu, kappa, loc (0) and scale.

        Parameters
        ----------
        data : array_like
            Amplitudes, at least 0.
        **kwds
            As in scipy, ``f0`` (or ``fnu``, ``fix_nu``) fixes nu, ``f1`` (or ``fkappa``,
            ``fix_kappa``) kappa, ``fscale`` the scale; ``floc`` must be 0. ``method="MM"`` fits by
            moments, with nothing fixed.

        Returns
        -------
        tuple of float

        Raises
        ------
        ValueError
            Where data are empty, negative or not finite, or loc is not 0.
        TypeError
            For any other keyword, and for starting values, which this fit does not need.
        """
        held, moments = _held(self.shapes, args, kwds)
        if moments:
            law = fit_moments(data)
        else:
            law = fit(data)
            if held:
                start = min(law.nu, FREE_NU), max(law.kappa, FREE_KAPPA)
                return _constrained(self, data, held, start, law.scale)
        return law.nu, law.kappa, 0.0, law.scale


class KDistribution(GeneralizedK):
    """K law of an amplitude (G 3): shape nu; the scale is a, E[x^2] = a^2."""

    def _argcheck(self, nu: FloatArray) -> BoolArray:  # type: ignore[override]
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
        held, moments = _held(self.shapes, args, kwds)
        if moments:
            raise ValueError("method: expected MLE: the K law is not fitted by moments")
        law = fit(data, "k")
        if held:
            return _constrained(self, data, held, (min(law.nu, FREE_NU),), law.scale)
        return law.nu, 0.0, law.scale


def _held(
    shapes: str, starts: tuple[Any, ...], options: dict[str, Any]
) -> tuple[dict[str, float], bool]:
    """Read the options of a fit under scipy's names.

    Returns the fixed parameters, under the names ``f0``, ``f1`` and ``fscale``, and whether a fit
    by moments is requested.
    """
    if starts:
        raise TypeError("fit() takes no starting values: hold a shape with f0=, f1= or fscale=")
    names = {"fscale": "fscale"}
    for k, shape in enumerate(shapes.split(", ")):
        names |= dict.fromkeys((f"f{k}", f"f{shape}", f"fix_{shape}"), f"f{k}")
    unknown = sorted(set(options) - set(names) - {"floc", "loc", "method"})
    if unknown:
        known = ", ".join((*names, "floc", "method"))
        raise TypeError(f"fit() got an unexpected keyword {unknown[0]!r}; it knows {known}")
    if options.get("floc", 0) != 0 or options.get("loc", 0) != 0:
        raise ValueError("floc: expected 0, amplitudes begin there")
    held = [(names[k], float(v)) for k, v in options.items() if k in names and v is not None]
    if len(dict(held)) < len(held):
        raise TypeError("fit() got two values of one parameter")
    method = str(options.get("method", "MLE")).upper()
    if method not in ("MLE", "MM"):
        raise ValueError(f"method: expected MLE or MM, got {options['method']!r}")
    if method == "MM" and held:
        raise ValueError("method: a fit by moments can hold no parameter")
    return dict(held), method == "MM"


def _constrained(
    law: GeneralizedK,
    data: FloatArray,
    held: dict[str, float],
    start: tuple[float, ...],
    scale: float,
) -> tuple[float, ...]:
    """Fit the parameters that are not fixed by scipy's own search, starting from the free fit."""
    if len(held) == len(start) + 1:
        raise ValueError("all parameters are held: there is nothing to fit")
    found = stats.rv_continuous.fit(law, np.asarray(data), *start, scale=scale, floc=0.0, **held)
    return tuple(float(v) for v in found)


def _log_power_mean(nu: FloatArray, power: float) -> FloatArray:
    """Log of the mean of z^power of a Gamma law of mean 1."""
    nu = np.asarray(nu, float)
    series = power * (power - 1) / (2 * nu)  # where the difference of logs would cancel
    with np.errstate(over="ignore"):
        exact = gammaln(nu + power) - gammaln(nu) - power * np.log(nu)
    return np.asarray(np.where(nu > 1e7, series, exact))


generalized_k = GeneralizedK(a=0.0, name="generalized_k", shapes="nu, kappa")
k_distribution = KDistribution(a=0.0, name="k_distribution", shapes="nu")


def frozen(law: Law) -> stats.rv_continuous:
    """Return a fitted law as a frozen distribution of scipy.stats.

    Parameters
    ----------
    law : Law

    Returns
    -------
    rv_frozen
    """
    root = np.sqrt(0.5)
    made = {
        "rayleigh": lambda: stats.rayleigh(scale=root * law.scale),
        "k": lambda: k_distribution(law.shape, scale=law.scale),
        "rice": lambda: stats.rice(law.kappa / root, scale=root * law.scale),
        "weibull": lambda: stats.weibull_min(law.shape, scale=law.scale),
        "lognormal": lambda: stats.lognorm(law.shape, scale=law.scale),
        "generalized_k": lambda: generalized_k(law.shape, law.kappa, scale=law.scale),
    }
    return made[law.family]()
