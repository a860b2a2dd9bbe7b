"""Fits of amplitude laws by Griffiths' methods: even moments, log-moments, histograms (G 3.4).

For comparison, and for ``method="MM"`` of :mod:`sasmap.sediments.distributions`; sasmap itself uses
:mod:`sasmap.sediments.fitting`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from sasmap.arrays import FloatArray
from sasmap.sediments import likelihood as ml
from sasmap.sediments.densities import Table, even_moment
from sasmap.sediments.fitting import (
    FAMILIES,
    FREE,
    NODES,
    WEIGHTS,
    Bins,
    Family,
    Law,
    divergence_of,
    gathered,
    histogram,
    starts_of,
)


def fit_moments(data: ArrayLike) -> Law:
    """Fit the generalised K law by its even moments 2, 4 and 6 (G 3.4).

    Parameters
    ----------
    data : array_like

    Returns
    -------
    Law
        Without errors or test of fit.
    """
    bins, share, square = _shares(data)
    wanted = np.log([share @ bins.centre**4 / square**2, share @ bins.centre**6 / square**3])

    def short(u: FloatArray) -> FloatArray:
        nu, kappa = np.exp(u[0]), np.sqrt(np.expm1(u[1]))
        two, four, six = (float(even_moment(m, nu, kappa)) for m in (1, 2, 3))
        return np.asarray(np.log([four / two**2, six / two**3]) - wanted)

    return _by_shape(bins, short, square)


def fit_log_moments(data: ArrayLike) -> Law:
    """Fit the generalised K law by the mean square and the variance and skew of log amplitude.

    Parameters
    ----------
    data : array_like

    Returns
    -------
    Law
        Without errors or test of fit.
    """
    bins, share, square = _shares(data)
    logs = np.log(bins.centre) - share @ np.log(bins.centre)
    wanted = np.array([share @ logs**2, share @ logs**3])

    def short(u: FloatArray) -> FloatArray:
        law = Table(float(np.exp(u[0])), float(np.sqrt(np.expm1(u[1]))))
        found = _log_cumulants(law)
        return np.asarray((found - wanted) / np.array([wanted[0], wanted[0] ** 1.5]))

    return _by_shape(bins, short, square)


def _shares(data: ArrayLike | Bins) -> tuple[Bins, FloatArray, float]:
    """Gather samples; return the share of each bin and the mean square as well."""
    bins = data if isinstance(data, Bins) else gathered(data)
    share = bins.samples / bins.samples.sum()
    return bins, share, float(share @ bins.centre**2)


def _log_cumulants(law: Table) -> FloatArray:
    x, weight = law.quadrature()
    logs = np.log(x)
    mean = (weight * logs).sum()
    return np.array([(weight * (logs - mean) ** k).sum() for k in (2, 3)])


def _by_shape(bins: Bins, short: object, square: float) -> Law:
    found = [
        least_squares(short, start, bounds=([np.log(0.02), 0.0], [np.log(1e5), np.log1p(1e6)]))
        for start in ([0.5, 0.1], [1.5, 1.0])
    ]
    u = min(found, key=lambda f: f.cost).x
    nu, kappa = float(np.exp(u[0])), float(np.sqrt(np.expm1(u[1])))
    return _law_of(bins, nu, kappa, square)


def _law_of(bins: Bins, nu: float, kappa: float, square: float) -> Law:
    """Return a generalised K law that was not fitted by likelihood."""
    scale = float(np.sqrt(square / (1 + kappa**2 * (1 + 1 / nu))))
    total = float(bins.samples.sum())
    nothing = (float("nan"),) * 3
    law = Law("generalized_k", nu, kappa, scale, nothing, square, 0.0, total, np.nan, np.nan)
    kind, free = FAMILIES.index(law.family), FREE[law.family]
    divergence, p_value = divergence_of(kind, law.coordinates, bins, 1.0, sum(free))
    level = float(bins.samples @ law.log_density(bins.centre))
    return replace(law, log_likelihood=level, divergence=divergence, p_value=p_value)


class HistogramFit(NamedTuple):
    """A law fitted to a histogram by least squares, as in G.

    Attributes
    ----------
    family : str
    parameters : ndarray
        Shapes, then the scale.
    offset : float
        DC offset of the amplitudes.
    misfit : float
        Mean square difference of the densities.
    """

    family: Family
    parameters: FloatArray
    offset: float
    misfit: float


def fit_histogram(
    edges: ArrayLike, density: ArrayLike, family: Family, offset: bool = False
) -> HistogramFit:
    """Fit a law to a normalised histogram by least squares (G 3.4).

    Parameters
    ----------
    edges : array_like (n + 1,)
    density : array_like (n,)
        Share of samples divided by the width of each bin.
    family : str
    offset : bool
        Whether a constant added to the amplitudes is fitted (G's DC offset).

    Returns
    -------
    HistogramFit
    """
    edge, wanted = np.asarray(edges, float), np.asarray(density, float)
    width = np.diff(edge)
    bins = histogram(edge, np.maximum(wanted * width, 0.0))
    kind, free = FAMILIES.index(family), FREE[family]
    index = [i for i in range(3) if free[i]]

    def densities(v: FloatArray) -> FloatArray:
        u = np.array([0.5, 0.2, 0.0])
        u[index] = v[: len(index)]
        moved = np.maximum(edge - (v[-1] if offset else 0.0), 0.0)
        value = np.full(width.size, -np.inf)
        some = np.diff(moved) > 0
        part = np.empty(int(some.sum()))
        low, high = moved[:-1][some], moved[1:][some]
        ml.fill(kind, u, low, high, low, NODES, WEIGHTS, part)
        value[some] = part
        return np.asarray(np.exp(value) / width)

    best = None
    for start in starts_of(bins, family):
        first = np.append(start[index], [0.0] if offset else [])
        lower = np.append(ml.LOWER[index], [-edge[-1]] if offset else [])
        upper = np.append(ml.UPPER[index], [edge[-1]] if offset else [])
        found = least_squares(
            lambda v: densities(v) - wanted, first, bounds=(lower, upper), x_scale=0.1
        )
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    u = np.array([0.5, 0.2, 0.0])
    u[index] = best.x[: len(index)]
    shapes = [np.exp(u[0])] * free[0] + [np.sqrt(np.expm1(u[1]))] * free[1]
    return HistogramFit(
        family,
        np.array([*shapes, np.exp(ml.scale_of(kind, u))]),
        float(best.x[-1]) if offset else 0.0,
        float(np.mean(best.fun**2)),
    )
