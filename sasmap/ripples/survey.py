"""What the looks of a survey share, learned from all of them: the second stage of the estimate.

Looks at cells are estimated each by itself, under a broad prior of the scattering law. What they
share is estimated here from their posteriors (Lunn, Barrett, Sweeting and Thompson 2013): the law's
mean and its spread from look to look, each swath's altitude offset, and how far passes over one
cell stray from each other. A look with shadow tells the law that a look without needs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from sasmap.ripples.looks import (
    LAW_MEAN,
    LAW_VARIANCE,
    Information,
    Looks,
    Shared,
    at_height,
    heaviest,
    law_factor,
    multiplied,
    normalised,
    steepness_factor,
)
from sasmap.ripples.sampler import metropolis_hastings, mixture_of_peaks, population
from sasmap.ripples.summary import log_contrast

FloatArray = NDArray[np.float64]

# Prior of the log of the law's spread from look to look (n, c): its mean and standard deviation.
# Sediments of one survey differ by a few tenths of n (Jackson and Richardson 2007, chapter 12).
SPREAD_LOG, SPREAD_SD = np.log([0.25, 0.12]), 0.7
# Largest spread over the law's prior standard deviation.
MOST_SPREAD = 0.95
# Prior of the log of the scatter between passes, of log f, log A_H and azimuth (degrees).
SCATTER_LOG, SCATTER_SD = np.log([3e-4, 0.01, 0.1]), np.array([1.0, 0.8, 0.8])
# Prior of the logit of the share of the law's variance that is of the look: one in five, about.
SHARE_LOGIT, SHARE_SD = -1.4, 1.0
# Passes that differ: how often, and the scatter they have.
ODD, ODD_SCATTER = 0.03, np.array([0.15, 0.4, 10.0])
# Components of a product of looks that are kept; log evidence of what cannot be.
MOST_KEPT, LEAST_LEVEL = 6, -1e9
# Degrees of freedom of the prior of an altitude offset: a wrong one is no Gaussian's tail.
OFFSET_FREEDOM = 4.0
# Looks that the shared values are learned from at most: more would not change them.
MOST_LOOKS = 600
# Edge of the first simplex; step of numerical derivatives; chains and their steps; values that
# stand for the posterior.
SIMPLEX, STEP, CHAINS, STEPS, VALUES = 0.5, 1e-2, 4, 120, 24


class SurveyModel(NamedTuple):
    """Posterior of what looks share.

    Attributes
    ----------
    values : tuple of Shared
        Of equal weight.
    learned : bool
        Whether the law was estimated, not fixed by the settings.
    """

    values: tuple[Shared, ...]
    learned: bool

    @property
    def middle(self) -> Shared:
        """Mean of the values."""
        return Shared._make(np.mean(v, axis=0) for v in zip(*self.values, strict=True))

    @property
    def widest(self) -> Shared:
        """The mean, with a spread that holds what is not known of the law's mean as well."""
        middle = self.middle
        error = np.std([v.law for v in self.values], axis=0)
        most = MOST_SPREAD * np.sqrt(LAW_VARIANCE)
        return middle._replace(spread=np.minimum(np.hypot(middle.spread, error), most))

    def quantiles(self, shares: tuple[float, ...] = (0.05, 0.5, 0.95)) -> dict[str, FloatArray]:
        """Quantiles of the law and its spread (shares, 2), and of the swaths' offsets."""
        return {
            name: np.quantile([getattr(v, name) for v in self.values], shares, axis=0)
            for name in Shared._fields
        }


class _Layout(NamedTuple):
    """Which shared values are estimated, and where they stand in a vector."""

    law: bool
    offset_sd: FloatArray  # (swaths,), 0 where an offset is not estimated
    scatter: FloatArray | None  # fixed, or None where it is estimated
    passes: bool  # whether any cell has two looks

    @property
    def size(self) -> int:
        estimated = self.passes and self.scatter is None
        share = self.law and self.passes
        return 4 * self.law + int((self.offset_sd > 0).sum()) + share + 3 * estimated

    def start(self) -> FloatArray:
        """Means of the prior."""
        parts = [LAW_MEAN, SPREAD_LOG] if self.law else []
        parts.append(np.zeros(int((self.offset_sd > 0).sum())))
        if self.law and self.passes:
            parts.append(np.array([SHARE_LOGIT]))
        if self.passes and self.scatter is None:
            parts.append(SCATTER_LOG)
        return np.concatenate(parts) if parts else np.zeros(0)

    def shared(self, point: FloatArray) -> Shared:
        """Name the values of a vector."""
        law, spread, at = LAW_MEAN, np.exp(SPREAD_LOG), 0
        if self.law:
            law, spread, at = point[:2], np.exp(point[2:4]), 4
        offset = np.zeros(self.offset_sd.size)
        free = self.offset_sd > 0
        offset[free] = point[at : at + int(free.sum())] * self.offset_sd[free]
        at += int(free.sum())
        logit = SHARE_LOGIT
        if self.law and self.passes:
            logit, at = point[at], at + 1
        if self.scatter is not None:
            scatter = self.scatter
        else:
            scatter = np.exp(point[at:] if self.passes else SCATTER_LOG)
        spread = np.minimum(spread, MOST_SPREAD * np.sqrt(LAW_VARIANCE))
        return Shared(law, spread, offset, scatter, float(expit(logit)))

    def log_prior(self, point: FloatArray) -> float:
        """Log prior density, up to a constant."""
        value, at = 0.0, 0
        if self.law:
            value -= 0.5 * ((point[:2] - LAW_MEAN) ** 2 / LAW_VARIANCE).sum()
            value -= 0.5 * (((point[2:4] - SPREAD_LOG) / SPREAD_SD) ** 2).sum()
            at = 4
        count = int((self.offset_sd > 0).sum())
        scaled = point[at : at + count] ** 2 / OFFSET_FREEDOM
        value -= 0.5 * (OFFSET_FREEDOM + 1) * np.log1p(scaled).sum()
        at += count
        if self.law and self.passes:
            value -= 0.5 * ((point[at] - SHARE_LOGIT) / SHARE_SD) ** 2
            at += 1
        if self.passes and self.scatter is None:
            value -= 0.5 * (((point[at:] - SCATTER_LOG) / SCATTER_SD) ** 2).sum()
        return float(value)


def learn(
    looks: Looks | None,
    swaths: int,
    scatter: FloatArray | None,
    steepness: tuple[float, float],
    seed: int,
) -> SurveyModel:
    """Estimate what the looks of a survey share.

    Parameters
    ----------
    looks : Looks or None
        None where there is none: the prior remains.
    swaths : int
    scatter : ndarray (3,) or None
        Fixed scatter between passes (log f, log A_H, degrees); None to learn it.
    steepness : tuple of float
        Median and log standard deviation of the prior of natural steepness.
    seed : int
        The same seed and looks give the same model to the bit.

    Returns
    -------
    SurveyModel
    """
    rng = np.random.default_rng(seed)
    layout = _layout(looks, swaths, scatter)
    if layout.size == 0:
        return SurveyModel((layout.shared(np.zeros(0)),), False)
    some = None if looks is None else _thinned(looks)

    def log_density(points: FloatArray) -> FloatArray:
        return np.array([_log_posterior(p, layout, some, steepness) for p in points])

    start = layout.start()
    best = minimize(
        lambda p: -log_density(p[None])[0],
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": np.vstack([start, start + SIMPLEX * np.eye(start.size)]),
            "maxfev": 150 * start.size,
            "fatol": 0.05,
            "xatol": 0.05,
            "adaptive": True,
        },
    )
    proposal = mixture_of_peaks([(best.x, _covariance(best.x, log_density), 0.0)])
    particles, proposal = population(log_density, proposal, rng)
    states = particles[rng.permutation(len(particles))[:CHAINS]]
    chains = metropolis_hastings(log_density, proposal, particles, states, STEPS, rng)
    points = chains.draws[:, STEPS // 4 :].reshape(-1, layout.size)
    # values that stand for the posterior: evenly over what A_H depends on
    key = points[:, 0]
    if layout.law and some is not None:
        key = log_contrast(points[:, :2], np.median(some.tangent))
    order = np.argsort(key, kind="stable")
    chosen = order[((np.arange(VALUES) + 0.5) * len(order) / VALUES).astype(int)]
    return SurveyModel(tuple(layout.shared(points[i]) for i in chosen), layout.law)


def _layout(looks: Looks | None, swaths: int, scatter: FloatArray | None) -> _Layout:
    offset_sd = np.zeros(swaths)
    if looks is None:
        return _Layout(False, offset_sd, scatter, False)
    for k in range(swaths):
        here = looks.swath == k
        if here.any() and np.abs(looks.altitude_gain[here]).max() > 0:
            offset_sd[k] = looks.altitude_sd[here].max()
    _, count = np.unique(looks.cell, return_counts=True)
    return _Layout(looks.with_law, offset_sd, scatter, bool(count.max() > 1))


def _thinned(looks: Looks) -> Looks:
    """Keep whole cells, evenly over the survey."""
    cells = np.unique(looks.cell)
    if looks.cell.size <= MOST_LOOKS:
        return looks
    kept = max(int(cells.size * MOST_LOOKS / looks.cell.size), 1)
    chosen = cells[np.linspace(0, cells.size - 1, kept).astype(int)]
    return looks.some(np.flatnonzero(np.isin(looks.cell, chosen)))


def _log_posterior(
    point: FloatArray, layout: _Layout, looks: Looks | None, steepness: tuple[float, float]
) -> float:
    value = layout.log_prior(point)
    if looks is None:
        return value
    return value + float(evidence(looks, layout.shared(point), steepness).sum())


def evidence(looks: Looks, shared: Shared, steepness: tuple[float, float]) -> FloatArray:
    """Log evidence of each cell (cells,): that its looks speak of one f, A_H, azimuth and law.

    Parameters
    ----------
    looks : Looks
    shared : Shared
    steepness : tuple of float
        Median and log standard deviation of the prior of natural steepness.

    Returns
    -------
    ndarray
        In the order of the cells' numbers. A cell whose passes differ counts by a wider scatter.
    """
    _, cell, count = np.unique(looks.cell, return_inverse=True, return_counts=True)
    several = count[cell] > 1
    scatter = np.where(several[:, None], shared.scatter, 0.0)
    honest = _evidence(looks, shared, scatter, steepness, cell, count)
    if not several.any():
        return honest
    part = np.flatnonzero(several)
    wide = np.hypot(scatter[part], ODD_SCATTER)
    place = np.unique(cell[part], return_inverse=True)[1]
    some = count[count > 1]
    odd = _evidence(looks.some(part), shared, wide, steepness, place, some)
    both = np.logaddexp(np.log1p(-ODD) + honest[count > 1], np.log(ODD) + odd)
    honest[count > 1] = both
    return honest


def _evidence(
    looks: Looks,
    shared: Shared,
    scatter: FloatArray,
    steepness: tuple[float, float],
    cell: NDArray[np.int64],
    count: NDArray[np.int64],
) -> FloatArray:
    factor = at_height(looks, shared, scatter)
    order = np.argsort(cell, kind="stable")
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    total = Information(*(v[order[first]] for v in factor))
    every, before = np.full(count.size, -np.inf), count > 0
    for k in range(int(count.max())):  # the k-th look of every cell that has one
        has = count > k
        if k > 0:
            here = Information(*(v[has[before]] for v in total))
            one = Information(*(v[order[(first + k)[has]]] for v in factor))
            total, before = multiplied(here, one), has
        others = np.full(int(has.sum()), k)
        level, total = settled(total, shared, steepness, others)
        top = np.maximum(level.max(axis=1), LEAST_LEVEL)
        every[has] = top + np.log(np.exp(level - top[:, None]).sum(axis=1) + 1e-300)
    return every


def settled(
    total: Information, shared: Shared, steepness: tuple[float, float], others: NDArray[np.int64]
) -> tuple[FloatArray, Information]:
    """Log evidence of components of looks that were multiplied, the heaviest of which are kept.

    Parameters
    ----------
    total : Information (cells, K)
    shared : Shared
    steepness : tuple of float
        Median and log standard deviation of the prior of natural steepness.
    others : ndarray of int (cells,)
        Looks less one: as often too many that prior is in the product.

    Returns
    -------
    level : ndarray (cells, at most MOST_KEPT)
    total : Information (cells, at most MOST_KEPT)
    """
    level = normalised(with_priors(total, shared, steepness, others))[0]
    kept = heaviest(total, level, MOST_KEPT)
    return heaviest(Information(level, total.push, total.precision), level, MOST_KEPT).level, kept


def with_priors(
    total: Information, shared: Shared, steepness: tuple[float, float], others: NDArray[np.int64]
) -> Information:
    """Multiply looks by the law's prior, and divide them by the steepness's that they share."""
    size = total.push.shape[-1]
    law, natural = law_factor(shared, size == 5), steepness_factor(size, steepness)
    return Information(
        total.level + law.level - others[:, None] * natural.level,
        total.push + law.push - others[:, None, None] * natural.push,
        total.precision + law.precision - others[:, None, None, None] * natural.precision,
    )


def _covariance(point: FloatArray, log_density: object) -> FloatArray:
    """Inverse of the curvature of a log density by differences, kept positive."""
    assert callable(log_density)
    size = point.size
    steps = STEP * np.eye(size)
    pairs = [(i, j) for i in range(size) for j in range(i + 1)]
    corners = np.array(
        [
            point + a * steps[i] + b * steps[j]
            for i, j in pairs
            for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
        ]
    )
    levels = log_density(corners).reshape(-1, 4)
    curvature = np.empty((size, size))
    for (i, j), (pp, pm, mp, mm) in zip(pairs, levels, strict=True):
        curvature[i, j] = curvature[j, i] = -(pp - pm - mp + mm) / (4 * STEP**2)
    values, turn = np.linalg.eigh(curvature)
    return np.asarray((turn / np.maximum(values, 0.5)) @ turn.T)
