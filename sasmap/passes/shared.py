"""Shared parameters of a survey's looks: the second stage of the estimate.

Each look at a cell is estimated alone, under a broad prior of the scattering law. The shared
parameters are estimated here from the looks' posteriors (Lunn, Barrett, Sweeting and Thompson
2013): the laws of up to four sediments with their spreads from look to look, altitude offset of
each swath, and scatter between passes over one cell. Looks with shadow inform the law for looks
without.

A survey may cover several sediments. Laws are drawn from a mixture of populations, each with its
mean, spread, bias of the echo shape, and share of the cells. Where the map has several sediments,
each has its own population, and a cell belongs to that of its sediment except for errors of the
map, so that a sediment without shadow does not take its law from another. Elsewhere there are two
populations with unknown shares. If there is only one law, the two coincide or one has no cells: the
posterior of a mixture with more components than the data need empties or merges them (Rousseau and
Mengersen 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from sasmap.arrays import FloatArray, IntArray
from sasmap.passes.evidence import MOST_SPREAD, SCATTER, SHARE_LOGIT, CellEvidence
from sasmap.passes.looks import (
    LAW_MEAN,
    LAW_VARIANCE,
    SHIFT_SD,
    Looks,
    Shared,
)
from sasmap.passes.summary import contrast_slopes, log_contrast
from sasmap.ripples.sampler import (
    LogDensity,
    metropolis_hastings,
    mixture_of_peaks,
    population,
)

# Prior of the log spread of the law (n, c) from look to look: mean and standard deviation.
# Sediments of one survey differ by a few tenths of n (Jackson and Richardson 2007, chapter 12).
SPREAD_LOG, SPREAD_SD = np.log([0.25, 0.12]), 0.7
# Standard deviation of the prior of the log scatter (log f, log A_H, azimuth) between passes (a
# choice: wide).
SCATTER_SD = np.array([1.0, 0.8, 0.8])
# Standard deviation of the prior of the logit of the share of the law's variance from look to look.
SHARE_SD = 1.0
# Prior of the logit of the share of cells whose passes differ: 3 %, 1 to 10 (a choice: rare).
ODD_LOGIT, ODD_SD = -3.5, 1.2
# Degrees of freedom of the priors of altitude offsets and of the bias from the echo shape: heavier
# tails than a Gaussian.
FREEDOM = 4.0
# Most looks from which shared parameters are estimated: more would not change them.
MOST_LOOKS = 240
# Number of populations of laws, and the scale of the prior of the logit of the share of one: nearly
# uniform from 0 to 1. Offset of n from the first maximum, in prior standard deviations, at which
# the search for a second one starts.
POPULATIONS, WEIGHT_SD, APART = 2, 1.7, 0.8
# Mapped sediments: share of cells whose law is not their sediment's (errors of the map: a choice),
# fewest good looks for a population of its own and most populations (bounds time); other sediments
# may belong to any population.
MISTAKEN, LEAST_LOOKS, MOST_SEDIMENTS = 0.05, 4, 4
# Two populations count as separate where their means differ by this many standard deviations
# (Ashman, Bird and Zepf 1994: 2 is needed for a clear separation) and each has at least this share
# of the cells, in this share of the draws.
SEPARATION, LEAST_WEIGHT, SURE = 2.0, 0.1, 0.95
# Step of numerical derivatives; iterations of the ascent and its largest step, in prior standard
# deviations; chains and their steps; number of draws that represent the posterior: with 60 and 24
# the 0.95 quantile of A_H depends on the seed by half its standard deviation.
STEP, CLIMB, FARTHEST, CHAINS, STEPS, VALUES = 1e-2, 40, 5.0, 4, 240, 64


class Population(NamedTuple):
    """A population of scattering laws: its share of the cells, and its shared parameters.

    Attributes
    ----------
    weight : float
        Share of all looks.
    shared : Shared
    within : ndarray (sediments,)
        Share within each sediment, as numbered in :attr:`Looks.sediment`.
    """

    weight: float
    shared: Shared
    within: FloatArray = np.ones(1)


Populations = tuple[Population, ...]


def merged(populations: Populations) -> Shared:
    """Return the shared parameters with the mean and standard deviation of all laws together."""
    weight = np.array([p.weight for p in populations])
    law, spread, shift = (
        np.array([getattr(p.shared, name) for p in populations])
        for name in ("law", "spread", "shift")
    )
    mean = weight @ law
    total = np.sqrt(weight @ (spread**2 + (law - mean) ** 2))
    most = MOST_SPREAD * np.sqrt(LAW_VARIANCE)
    return populations[0].shared._replace(
        law=mean, spread=np.minimum(total, most), shift=weight @ shift
    )


class SurveyModel(NamedTuple):
    """Posterior of the shared parameters.

    Attributes
    ----------
    values : tuple of Shared
        Draws of equal weight, with all laws as one population.
    learned : bool
        Whether the law was estimated rather than fixed by the settings.
    populations : tuple of tuple of Population
        For each draw one for each of `sediments`, or two in increasing order of contrast; empty
        where `values` suffices.
    apart : bool
        Whether the draws separate two populations, or there is one for each sediment.
    sediments : tuple of int
        Mapped classes with a law of their own.
    looks : int
        Number of good looks that it was estimated from.
    """

    values: tuple[Shared, ...]
    learned: bool
    populations: tuple[Populations, ...] = ()
    apart: bool = False
    sediments: tuple[int, ...] = ()
    looks: int = 0

    @property
    def draws(self) -> tuple[Populations, ...]:
        """Populations of each draw."""
        return self.populations or tuple((Population(1.0, v),) for v in self.values)

    @property
    def found(self) -> tuple[tuple[Population, ...], ...]:
        """Draws of each law that the survey can separate; of one law where it cannot."""
        if self.apart:
            return tuple(zip(*self.populations, strict=True))
        return (tuple(Population(1.0, v) for v in self.values),)

    @property
    def middle(self) -> Shared:
        """Mean over the draws."""
        return Shared._make(np.mean(v, axis=0) for v in zip(*self.values, strict=True))

    @property
    def widest(self) -> Shared:
        """The mean, with a spread that includes the uncertainty of the law's mean."""
        middle = self.middle
        error = np.std([v.law for v in self.values], axis=0)
        most = MOST_SPREAD * np.sqrt(LAW_VARIANCE)
        return middle._replace(spread=np.minimum(np.hypot(middle.spread, error), most))

    def quantiles(self, shares: tuple[float, ...] = (0.05, 0.5, 0.95)) -> dict[str, FloatArray]:
        """Quantiles of the law and its spread (shares, 2), and of the swaths' offsets."""
        return quantiles_of(self.values, shares)


def numbered(classes: Sequence[int] | None, sediments: tuple[int, ...]) -> IntArray | None:
    """Return the number of each cell's sediment among those with a law, from 1; 0 for others.

    Parameters
    ----------
    classes : sequence of int or None
        Mapped class of each cell, 0 where it has several or none; None gives None.
    sediments : tuple of int
        Classes that have a law of their own.
    """
    if classes is None:
        return None
    places = {one: k for k, one in enumerate(sediments, 1)}
    return np.array([places.get(one, 0) for one in classes], np.int64)


def quantiles_of(
    values: Sequence[Shared], shares: tuple[float, ...] = (0.05, 0.5, 0.95)
) -> dict[str, FloatArray]:
    """Quantiles of each shared parameter over draws."""
    return {
        name: np.quantile([getattr(v, name) for v in values], shares, axis=0)
        for name in Shared._fields
    }


class _Layout:
    """Layout of the estimated shared parameters in a vector.

    Elements are standardised: 0 is the centre of the prior, 1 its scale.

    Parameters
    ----------
    law : bool
        Whether the law is estimated.
    offset_sd : ndarray (swaths,)
        Prior standard deviation of altitude offsets, m; 0 where an offset is not estimated.
    scatter : ndarray (3,) or None
        Fixed scatter, or None where it is estimated.
    passes : bool
        Whether any cell has two looks.
    cells : ndarray (1 + sediments,)
        Number of looks at cells whose sediment has no law of its own, then for each that has one.
    """

    def __init__(
        self,
        law: bool,
        offset_sd: FloatArray,
        scatter: FloatArray | None,
        passes: bool,
        cells: FloatArray,
    ) -> None:
        self.law, self.offset_sd, self.scatter, self.cells = law, offset_sd, scatter, cells
        sediments = cells.size - 1
        self.count = (sediments or POPULATIONS) if law else 1
        each = 2 * self.count * law
        sizes = {
            "law": each,
            "spread": each,
            "weight": int(law and not sediments),
            "share": int(law and passes),
            "odd": int(passes),
            "scatter": 3 * int(passes and scatter is None),
            "shift": each,
            "offset": int((offset_sd > 0).sum()),
        }
        ends = np.cumsum(list(sizes.values()))
        self.place = {
            name: slice(int(end) - size, int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }
        self.size = int(ends[-1])
        # heavy-tailed priors: shift and offsets
        self._gaussian = self.place["shift"].start

    def populations(self, point: FloatArray) -> Populations:
        """Return the populations, each with its shared parameters, of a vector."""

        def at(name: str, count: int) -> FloatArray:
            values = point[self.place[name]]
            return values if values.size else np.zeros(count)

        most = MOST_SPREAD * np.sqrt(LAW_VARIANCE)
        offset = np.zeros(self.offset_sd.size)
        free = self.offset_sd > 0
        offset[free] = point[self.place["offset"]] * self.offset_sd[free]
        scatter = self.scatter
        if scatter is None:
            scatter = SCATTER * np.exp(SCATTER_SD * at("scatter", 3))
        law, spread, shift = (
            at(name, 2 * self.count).reshape(self.count, 2) for name in ("law", "spread", "shift")
        )
        of_look = float(expit(SHARE_LOGIT + SHARE_SD * at("share", 1)[0]))
        odd = float(expit(ODD_LOGIT + ODD_SD * at("odd", 1)[0]))
        return tuple(
            Population(
                float(within @ self.cells / self.cells.sum()),
                Shared(
                    LAW_MEAN + np.sqrt(LAW_VARIANCE) * law[k],
                    np.minimum(np.exp(SPREAD_LOG + SPREAD_SD * spread[k]), most),
                    SHIFT_SD * shift[k],
                    offset,
                    scatter,
                    of_look,
                    odd,
                ),
                within,
            )
            for k, within in enumerate(self._shares(at("weight", 1)))
        )

    def _shares(self, weight: FloatArray) -> FloatArray:
        """Share of each population in the cells of each sediment, (populations, 1 + sediments)."""
        if self.count == 1:
            return np.ones((1, self.cells.size))
        if self.cells.size == 1:
            first = float(expit(WEIGHT_SD * weight[0]))
            return np.array([[first], [1 - first]])
        others = MISTAKEN / (self.count - 1)
        of_none = self.cells[1:] / self.cells[1:].sum()
        own = np.where(np.eye(self.count, dtype=bool), 1 - MISTAKEN, others)
        return np.column_stack([of_none, own])

    def split(self, point: FloatArray, apart: float) -> FloatArray:
        """Move the means of n of the two populations apart, and their shifts the opposite way."""
        moved = point.copy()
        for name, step in (("law", apart), ("shift", -apart)):
            moved[self.place[name]] += step * np.array([1.0, 0.0, -1.0, 0.0])
        return moved

    def log_prior(self, point: FloatArray) -> float:
        """Log prior density, up to a constant."""
        squares = point**2
        value = -0.5 * squares[: self._gaussian].sum()
        tails = np.log1p(squares[self._gaussian :] / FREEDOM).sum()
        return float(value - 0.5 * (FREEDOM + 1) * tails)


def learn(
    looks: Looks | None,
    swaths: int,
    scatter: FloatArray | None,
    seed: int,
    sediments: tuple[int, ...] = (),
) -> SurveyModel:
    """Estimate the shared parameters of a survey's looks.

    Parameters
    ----------
    looks : Looks or None
        If None, the result is the prior.
    swaths : int
    scatter : ndarray (3,) or None
        Fixed scatter between passes (log f, log A_H, degrees); None to estimate it.
    seed : int
        The same seed and looks give the same model to the bit.
    sediments : tuple of int
        Mapped classes in the order of the looks' sediment numbers, from 1.

    Returns
    -------
    SurveyModel
    """
    rng = np.random.default_rng(seed)
    rank = np.arange(swaths)
    if looks is not None:
        looks, rank = _in_order(looks, swaths)
    layout = _layout(looks, swaths, scatter, len(sediments))
    if layout.size == 0:
        first = layout.populations(np.zeros(0))[0].shared
        return SurveyModel((first,), False)  # offsets are all 0
    some = None if looks is None else _thinned(looks)

    cells = None if some is None else CellEvidence(some)

    def log_density(points: FloatArray) -> FloatArray:
        values = [_log_posterior(np.clip(p, -9.0, 9.0), layout, cells) for p in points]
        return np.array(values)

    peaks = _peaks(layout, log_density)
    particles, proposal = population(log_density, mixture_of_peaks(peaks), rng)
    states = particles[rng.permutation(len(particles))[:CHAINS]]
    chains = metropolis_hastings(log_density, proposal, particles, states, STEPS, rng)
    points = chains.draws[:, STEPS // 4 :].reshape(-1, layout.size)
    count = 0 if looks is None else looks.cell.size
    model = _model(points, layout, some, rank)._replace(looks=count)
    return model._replace(sediments=sediments) if layout.law else model


def _peaks(layout: _Layout, log_density: LogDensity) -> list[tuple[FloatArray, FloatArray, float]]:
    """Find the maxima with equal and with different populations: place, covariance, log weight."""
    starts = [np.zeros(layout.size)]
    peaks: list[tuple[FloatArray, FloatArray, float]] = []
    best = -np.inf
    while starts:
        reached = minimize(
            lambda p: -log_density(p[None])[0],
            starts.pop(),
            method="L-BFGS-B",
            bounds=[(-FARTHEST, FARTHEST)] * layout.size,
            options={"maxiter": CLIMB, "ftol": 1e-6, "eps": STEP},
        )
        if layout.law and not peaks and layout.cells.size == 1:
            starts = [layout.split(reached.x, APART)]
        covariance = _covariance(reached.x, log_density)
        level = 0.5 * np.linalg.slogdet(covariance)[1] - float(reached.fun)
        peaks.append((reached.x, covariance, level))
        best = max(best, level)
    return [(place, covariance, level - best) for place, covariance, level in peaks]


def _model(points: FloatArray, layout: _Layout, looks: Looks | None, rank: IntArray) -> SurveyModel:
    """Choose draws that represent the posterior, evenly over the contrast that A_H depends on."""
    draws = [layout.populations(p) for p in points]
    key = points[:, 0]
    if layout.law and looks is not None:
        tangent = float(np.median(looks.tangent))
        if layout.cells.size == 1:
            draws = [tuple(sorted(d, key=lambda p: _contrast(p, tangent))) for d in draws]
        key = log_contrast(np.array([merged(d).law for d in draws]), tangent)
    order = np.argsort(key, kind="stable")
    chosen = order[((np.arange(VALUES) + 0.5) * len(order) / VALUES).astype(int)]
    kept = [
        tuple(p._replace(shared=p.shared._replace(offset=p.shared.offset[rank])) for p in draws[i])
        for i in chosen
    ]
    apart = layout.law and looks is not None
    apart = apart and (layout.cells.size > 1 or _told_apart(draws, tangent))
    return SurveyModel(
        tuple(merged(d) for d in kept), layout.law, tuple(kept) if layout.law else (), apart
    )


def _contrast(one: Population, tangent: float) -> float:
    return float(log_contrast(one.shared.law, tangent))


def _told_apart(draws: Sequence[Populations], tangent: float) -> bool:
    """Whether nearly all draws have two populations that do not overlap in contrast."""
    apart = 0
    for first, second in draws:
        variance = sum(
            float(((contrast_slopes(p.shared.law, tangent) * p.shared.spread) ** 2).sum())
            for p in (first, second)
        )
        gap = abs(_contrast(first, tangent) - _contrast(second, tangent))
        clear = gap > SEPARATION * np.sqrt(0.5 * variance)
        apart += clear and min(first.weight, second.weight) > LEAST_WEIGHT
    return apart >= SURE * len(draws)


def _in_order(looks: Looks, swaths: int) -> tuple[Looks, IntArray]:
    """Sort swaths by their data, so that their order in the survey file does not matter.

    Returns the looks by cell and swath, and the new number of each swath.
    """
    seen = np.column_stack([looks.altitude, looks.tangent, looks.factor.linear[:, 0, 1]])
    means = np.zeros((swaths, 3))
    for k in range(swaths):
        here = looks.swath == k
        means[k] = seen[here].mean(axis=0) if here.any() else np.inf
    rank = np.empty(swaths, int)
    rank[np.lexsort(means.T)] = np.arange(swaths)
    numbered = looks._replace(swath=rank[looks.swath])
    return numbered.some(np.lexsort([numbered.swath, numbered.cell])), rank


def _layout(
    looks: Looks | None, swaths: int, scatter: FloatArray | None, sediments: int
) -> _Layout:
    offset_sd = np.zeros(swaths)
    if looks is None:
        return _Layout(False, offset_sd, scatter, False, np.ones(1 + sediments))
    for k in range(swaths):
        here = looks.swath == k
        if here.any() and np.abs(looks.altitude_gain[here]).max() > 0:
            offset_sd[k] = looks.altitude_sd[here].max()
    _, count = np.unique(looks.cell, return_counts=True)
    cells = np.bincount(looks.sediment, minlength=1 + sediments).astype(float)
    return _Layout(looks.with_law, offset_sd, scatter, bool(count.max() > 1), cells)


def _thinned(looks: Looks) -> Looks:
    """Keep about MOST_LOOKS looks: whole cells, evenly over the survey."""
    cells = np.unique(looks.cell)
    if looks.cell.size <= MOST_LOOKS:
        return looks
    kept = max(int(cells.size * MOST_LOOKS / looks.cell.size), 1)
    chosen = cells[np.linspace(0, cells.size - 1, kept).astype(int)]
    return looks.some(np.flatnonzero(np.isin(looks.cell, chosen)))


def _log_posterior(point: FloatArray, layout: _Layout, cells: CellEvidence | None) -> float:
    value = layout.log_prior(point)
    if cells is None:
        return value
    each = [
        np.log(p.within)[cells.sediment] + cells.evidence(p.shared)
        for p in layout.populations(point)
    ]
    return value + float(np.logaddexp.reduce(each).sum())


def _covariance(point: FloatArray, log_density: LogDensity) -> FloatArray:
    """Inverse of the numerical curvature of a log density, kept positive."""
    size = point.size
    steps = STEP * np.eye(size)
    rows, columns = np.tril_indices(size, -1)
    corners = np.vstack(
        [point[None], point + steps, point - steps, point + steps[rows] + steps[columns]]
    )
    levels = log_density(corners)
    middle, ahead, behind = levels[0], levels[1 : size + 1], levels[size + 1 : 2 * size + 1]
    curvature = np.diag(2 * middle - ahead - behind) / STEP**2
    mixed = levels[2 * size + 1 :] - ahead[rows] - ahead[columns] + middle
    # f(x + i + j) - f(x + i) - f(x + j) + f(x), second order in the step
    curvature[rows, columns] = curvature[columns, rows] = -mixed / STEP**2
    values, turn = np.linalg.eigh(curvature)
    return np.asarray((turn / np.maximum(values, 0.5)) @ turn.T)
