"""Fits of amplitude laws by maximum likelihood, and the choice among them.

Takes raw or weighted samples (gathered in narrow bins of log amplitude, each at its own mean) or
histograms, over whose bins the density is integrated: an 8-bit image holds probabilities of bins,
not densities at their centres (docs/science.md, fitting).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from sasmap.arrays import BoolArray, FloatArray
from sasmap.sediments import likelihood as ml
from sasmap.sediments.densities import NODES as NODES16
from sasmap.sediments.densities import WEIGHTS as WEIGHTS16

Family = Literal["rayleigh", "k", "rice", "weibull", "lognormal", "generalized_k"]

FAMILIES: tuple[Family, ...] = ("rayleigh", "k", "rice", "weibull", "lognormal", "generalized_k")
# Which coordinates (log shape, log(1 + kappa^2), log mean square) are free in each family.
FREE = {
    "rayleigh": (False, False, True),
    "k": (True, False, True),
    "rice": (False, True, True),
    "weibull": (True, False, True),
    "lognormal": (True, False, True),
    "generalized_k": (True, True, True),
}
# Width of the bins of log amplitude that samples are gathered in.
BIN = 0.05
# Log amplitude relative to the root mean square below which bins are wider, the factor by which
# they are wider, and the lowest log amplitude.
TAIL, WIDER, LOWEST = -2.5, 5.0, -40.0
# Smaller samples are raised to this share of the root mean square.
LEAST = 1e-9
# Points of the Gauss-Legendre rule within a bin of a histogram.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)
# Expected samples above which a bin enters the goodness-of-fit test; p-value below which a law is
# rejected.
FEW, REJECTED = 8.0, 0.01
# Nats of log likelihood within which laws of one group count as equally good.
WORTH = 2.0
FIRST_ROUNDS = 6


class Bins(NamedTuple):
    """Gathered samples: points (of zero width) or bins.

    Attributes
    ----------
    low, high : ndarray (n,)
        Edges; equal for points, infinite where censored.
    centre : ndarray (n,)
    samples : ndarray (n,)
        Number of samples, or their weight.
    """

    low: FloatArray
    high: FloatArray
    centre: FloatArray
    samples: FloatArray


@dataclass(frozen=True)
class Law:
    """A fitted amplitude law.

    Attributes
    ----------
    family : str
    shape : float
        nu of K and generalised K, c of Weibull, s of the lognormal; NaN for Rayleigh and Rice.
    kappa : float
        delta / a of Rice and generalised K; 0 for others.
    scale : float
        a, or the scale of scipy's Weibull and lognormal.
    errors : tuple of float
        Standard errors of log shape, log(1 + kappa^2) and log mean square; NaN where not free or at
        a bound.
    mean_square : float
    log_likelihood : float
        Of all samples.
    samples : float
        Effective number of samples.
    divergence : float
        Kullback-Leibler divergence of the histogram from the law, nats per sample.
    p_value : float
        Probability of so large a divergence by chance.
    """

    family: Family
    shape: float
    kappa: float
    scale: float
    errors: tuple[float, float, float]
    mean_square: float
    log_likelihood: float
    samples: float
    divergence: float
    p_value: float

    @property
    def nu(self) -> float:
        """Shape of the texture: infinite except for K and generalised K."""
        return self.shape if self.family in ("k", "generalized_k") else float("inf")

    @property
    def coordinates(self) -> FloatArray:
        """Log shape (0 without one), log(1 + kappa^2) and log mean square (3,)."""
        shape = np.log(self.shape) if np.isfinite(self.shape) else 0.0
        return np.array([shape, np.log1p(self.kappa**2), np.log(self.mean_square)])

    def log_density(self, x: ArrayLike) -> FloatArray:
        """Log density at amplitudes above 0, by the fast kernel.

        Parameters
        ----------
        x : array_like

        Returns
        -------
        ndarray
        """
        x = np.asarray(x, float)
        u = self.coordinates
        flat = np.maximum(x.ravel(), LEAST * np.sqrt(self.mean_square))
        result = np.empty(flat.size)
        ml.fill(FAMILIES.index(self.family), u, flat, flat, flat, NODES, WEIGHTS, result)
        return result.reshape(x.shape)


def _places(x: FloatArray) -> FloatArray:
    """Bin numbers of amplitudes in units of the root mean square.

    Bins are wider in the low tail, where laws are power laws.
    """
    y = np.log(x)
    return np.floor((np.where(y > TAIL, y, TAIL + (y - TAIL) / WIDER) - LOWEST) / BIN)


def gathered(data: ArrayLike, weights: ArrayLike | None = None) -> Bins:
    """Gather samples in narrow bins of log amplitude, each at the mean of its samples.

    Parameters
    ----------
    data : array_like
        Amplitudes; NaN are left out.
    weights : array_like, optional
        Of the same shape.

    Returns
    -------
    Bins

    Raises
    ------
    ValueError
        Where nothing is left, or an amplitude is negative, infinite or all are 0.
    """
    x = np.asarray(data, float).ravel()
    known = ~np.isnan(x)
    x = x[known]
    w = np.ones(x.size) if weights is None else np.asarray(weights, float).ravel()[known]
    if x.size == 0 or not w.sum() > 0:
        raise ValueError("expected at least one amplitude")
    if x.min() < 0 or not np.isfinite(x.max()):
        raise ValueError("expected finite amplitudes of at least 0")
    largest = float(x.max())
    if largest == 0:
        raise ValueError("expected an amplitude above 0")
    rms = largest * float(np.sqrt(np.average((x / largest) ** 2, weights=w)))
    x = np.maximum(x, LEAST * rms)
    index = (_places(x / rms) - _places(x.min() / rms)).astype(np.int64)
    count = np.bincount(index, w).astype(np.float64)
    filled = count > 0
    # the geometric mean: laws are smooth in log amplitude
    centre = np.exp(np.bincount(index, w * np.log(x))[filled] / count[filled])
    return Bins(centre, centre, centre, count[filled])


def histogram(edges: ArrayLike, counts: ArrayLike) -> Bins:
    """Use a histogram's bins unchanged.

    Parameters
    ----------
    edges : array_like (n + 1,)
        Rising, the first at least 0, the last infinite where the last bin holds all above.
    counts : array_like (n,)

    Returns
    -------
    Bins

    Raises
    ------
    ValueError
        Where edges do not rise from 0 or more, or counts do not match them or are negative.
    """
    edge, count = np.asarray(edges, float), np.asarray(counts, float)
    if edge.ndim != 1 or count.shape != (edge.size - 1,):
        raise ValueError("expected n + 1 edges for n counts")
    if edge[0] < 0 or not (np.diff(edge) > 0).all():
        raise ValueError("expected edges that rise from 0 or more")
    if (count < 0).any() or not count.sum() > 0:
        raise ValueError("expected counts of at least 0, and one above")
    used = count > 0
    finite = np.where(np.isinf(edge[1:]), 1.5 * edge[:-1], edge[1:])
    return Bins(edge[:-1][used], edge[1:][used], 0.5 * (edge[:-1] + finite)[used], count[used])


def grey_histogram(values: ArrayLike, saturated: int | None = 255) -> Bins:
    """Histogram of rounded grey values; 0 means below one half, `saturated` that and all above.

    Parameters
    ----------
    values : array_like of int
    saturated : int or None
        Value that stands for all above it; None where none does.

    Returns
    -------
    Bins
    """
    counts = np.bincount(np.asarray(values).ravel().astype(np.int64)).astype(float)
    edges = np.concatenate([[0.0], np.arange(counts.size) + 0.5])
    if saturated is not None and counts.size == saturated + 1:
        edges[-1] = np.inf
    return histogram(edges, counts)


def fit(
    data: ArrayLike | Bins,
    family: Family = "generalized_k",
    *,
    weights: ArrayLike | None = None,
    samples: float | None = None,
) -> Law:
    """Fit a law by maximum likelihood.

    Parameters
    ----------
    data : array_like or Bins
        Amplitudes, or the result of :func:`histogram` or :func:`grey_histogram`.
    family : str
    weights : array_like, optional
    samples : float, optional
        Effective number of samples (:func:`effective_samples`), which scales the errors; default
        all.

    Returns
    -------
    Law

    Raises
    ------
    ValueError
        Where data are not amplitudes (see :func:`gathered`) or the family is not known.
    """
    if family not in FAMILIES:
        raise ValueError(f"family: expected one of {', '.join(FAMILIES)}, got {family!r}")
    bins = data if isinstance(data, Bins) else gathered(data, weights)
    total = float(bins.samples.sum())
    kind, free = FAMILIES.index(family), np.array(FREE[family])
    packed = (bins.low, bins.high, bins.centre, bins.samples, NODES, WEIGHTS)
    begun = [ml.climb(kind, s, free, packed, FIRST_ROUNDS) for s in starts_of(bins, family)]
    best = max(begun, key=lambda b: b[1])
    u, level, information = ml.climb(kind, best[0], free, packed, ml.ROUNDS)
    share = (samples or total) / total
    divergence, p_value = divergence_of(kind, u, bins, share, int(free.sum()))
    scale = float(np.exp(ml.scale_of(kind, u)))
    return Law(
        family,
        float(np.exp(u[0])) if free[0] else float("nan"),
        float(np.sqrt(np.expm1(u[1]))) if free[1] else 0.0,
        scale,
        _errors(u, free, information * share),
        float(np.exp(u[2])),
        float(level),
        share * total,
        divergence,
        p_value,
    )


def starts_of(bins: Bins, family: Family) -> list[FloatArray]:
    """Return starting points, from moments; for generalised K also at both ends of its ridge."""
    share = bins.samples / bins.samples.sum()
    largest = float(bins.centre.max())
    rms = largest * float(np.sqrt(share @ (bins.centre / largest) ** 2))
    ratio = float(share @ (bins.centre / rms) ** 4)
    logs = np.log(np.maximum(bins.centre / rms, 1e-9))
    spread = float(np.sqrt(share @ (logs - share @ logs) ** 2))
    power = 2 * np.log(rms)
    nu = np.log(np.clip(2 / max(ratio - 2, 1e-3), 0.05, 1e3))
    if family == "weibull":
        return [np.array([np.log(1.28 / max(spread, 1e-3)), 0.0, power])]
    if family == "lognormal":
        return [np.array([np.log(max(spread, 1e-3)), 0.0, power])]
    # for a Rice law E[x^4] / E[x^2]^2 = 2 - (kappa^2 / (1 + kappa^2))^2
    steady = np.sqrt(np.clip(2 - ratio, 0.0, 0.999))
    rice = -np.log1p(-steady)
    if family in ("rayleigh", "k", "rice"):
        return [np.array([nu, max(rice, 0.1), power])]
    heavy = np.array([max(nu, np.log(0.2)), 0.05, power])
    # between them the likelihood has saddles, at similar K laws
    middle = np.array([min(nu, np.log(8.0)), 0.7, power])
    return [heavy, middle, np.array([np.log(3.0), max(rice, 0.7), power])]


def _errors(u: FloatArray, free: BoolArray, information: FloatArray) -> tuple[float, float, float]:
    inside = free & (u > ml.LOWER + 1e-9) & (u < ml.UPPER - 1e-9)
    result = np.full(3, np.nan)
    if inside.any():
        part = information[np.ix_(inside, inside)]
        variance = np.diag(np.linalg.pinv(part))
        result[inside] = np.sqrt(np.maximum(variance, 0))
    return float(result[0]), float(result[1]), float(result[2])


def divergence_of(
    kind: int, u: FloatArray, bins: Bins, share: float, parameters: int
) -> tuple[float, float]:
    """Deviance of a histogram per sample, in nats, and its p-value (chi-squared)."""
    if (bins.high > bins.low).all():
        low, high, count = bins.low, bins.high, bins.samples
    else:  # points: bins with equal shares of the samples
        edges = _even_edges(bins)
        low, high = edges[:-1], edges[1:]
        count = np.histogram(bins.centre, edges, weights=bins.samples)[0]
    value = np.empty(low.size)
    ml.fill(kind, u, low, high, low, NODES16, WEIGHTS16, value)
    total = count.sum()
    expected = np.exp(value) * total
    expected *= total / max(expected.sum(), 1e-300) if expected.sum() > 0.5 * total else 1.0
    enough = (expected * share > FEW) & (count > 0)
    if enough.sum() <= parameters + 1:
        return 0.0, 1.0
    c, e = count[enough], expected[enough]
    deviance = float((c * np.log(c / e) - c + e).sum())
    freedom = int(enough.sum()) - 1 - parameters
    return max(deviance / total, 0.0), float(stats.chi2.sf(2 * share * deviance, freedom))


TESTED_BINS = 24


def _even_edges(bins: Bins) -> FloatArray:
    """Edges between points, from 0 to infinity, with nearly equal shares of the samples."""
    below = np.cumsum(bins.samples) / bins.samples.sum()
    cut = np.unique(np.searchsorted(below, np.arange(1, TESTED_BINS) / TESTED_BINS))
    cut = cut[cut < bins.centre.size - 1]
    # samples were gathered on a lattice of log amplitude: its lines, not the means, are the edges
    rms = np.sqrt(bins.samples @ bins.centre**2 / bins.samples.sum())
    y = (_places(bins.centre[cut] / rms) + 1) * BIN + LOWEST
    y = np.where(y > TAIL, y, TAIL + (y - TAIL) * WIDER)
    return np.unique(np.concatenate([[0.0], rms * np.exp(y), [np.inf]]))


class Choice(NamedTuple):
    """A law that the data do not reject, and all laws tried.

    Attributes
    ----------
    law : Law
    tried : tuple of Law
        In the order tried, up to the group that was needed.
    """

    law: Law
    tried: tuple[Law, ...]


def choose(
    data: ArrayLike | Bins,
    *,
    weights: ArrayLike | None = None,
    samples: float | None = None,
) -> Choice:
    """Fit the simplest law that the data do not reject: Rayleigh, a two-parameter law, or GK.

    Parameters
    ----------
    data : array_like or Bins
    weights : array_like, optional
    samples : float, optional
        Effective number of samples.

    Returns
    -------
    Choice
        Where all are rejected, the law with the best Bayesian information criterion (Schwarz).

    Raises
    ------
    ValueError
        See :func:`gathered`.
    """
    bins = data if isinstance(data, Bins) else gathered(data, weights)
    tried: list[Law] = []
    for group in (FAMILIES[:1], FAMILIES[1:5], FAMILIES[5:]):
        laws = [fit(bins, family, samples=samples) for family in group]
        tried += laws
        best = _first_best(laws)
        if best.p_value > REJECTED:
            return Choice(best, tuple(tried))
    return Choice(max(tried, key=_criterion), tuple(tried))


def _first_best(laws: Sequence[Law]) -> Law:
    """Return the first law that is nearly as good as the best."""
    share = laws[0].samples
    top = max(law.log_likelihood for law in laws)
    total = max(law.samples for law in laws)
    return next(law for law in laws if (top - law.log_likelihood) * min(share / total, 1) < WORTH)


def _criterion(law: Law) -> float:
    parameters = sum(FREE[law.family])
    return law.log_likelihood - 0.5 * parameters * float(np.log(max(law.samples, 2.0)))


def shares(law: Law, edges: FloatArray) -> FloatArray:
    """Probabilities of bins of amplitude, and of all amplitudes above the last edge.

    Parameters
    ----------
    law : Law
    edges : ndarray (n,)
        Rising, from 0.

    Returns
    -------
    ndarray (n,)
        Their sum is 1.
    """
    # nearly all probability lies between 1e-7 and 100 times the root mean square
    logs = np.linspace(-16, 4.6, 4000) + 0.5 * np.log(law.mean_square)
    weight = np.exp(law.log_density(np.exp(logs)) + logs)
    below = np.interp(np.log(edges[1:]), logs, np.cumsum(weight) / weight.sum())
    return np.diff(np.concatenate([[0.0], below, [1.0]]))
