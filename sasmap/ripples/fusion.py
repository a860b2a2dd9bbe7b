"""Looks at a cell combined: what the survey knows of its law and altitudes, and every pass.

What a look tells of (f, A_H, azimuth) under the survey's law is a Gaussian mixture. What a cell
knows after several looks is the product of theirs, each widened by a scatter for change and
misregistration and freed of the prior, which is multiplied once (Zare and Cobb 2013, 4.2; the
posterior after one look is the prior of the next). A product knows no order. It is averaged over
the posterior of what the survey shares. Looks that no common value explains are kept apart: the
largest group that agrees stands for the cell.

The published method hands a Gaussian of hand-set width from look to look instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from sasmap.ripples.derived import UNKNOWN as UNDERIVED
from sasmap.ripples.derived import Derived
from sasmap.ripples.looks import (
    LAW,
    Information,
    Looks,
    Shared,
    at_height,
    gather,
    law_factor,
    multiplied,
    normalised,
    placed,
    steepness_factor,
    strayed,
)
from sasmap.ripples.mixture import Marginal, marginals
from sasmap.ripples.posterior import Quality
from sasmap.ripples.priors import Prior
from sasmap.ripples.registration import Moves, left_over, registration
from sasmap.ripples.settings import RippleSettings
from sasmap.ripples.summary import NAN, Summary
from sasmap.ripples.survey import MOST_KEPT, SurveyModel, learn, settled, with_prior

FloatArray = NDArray[np.float64]

# What Zare and Cobb set by hand: cycles/m and m.
PUBLISHED_SD = (0.003, 0.17)
# Squared Mahalanobis distance (chi-squared with 3 degrees of freedom) beyond which two looks
# contradict each other: one honest pair in two thousand.
LIMIT = 17.7
# Looks of which every group is tried; of more, one at a time is dropped.
MOST_TRIED = 10
# Components of less than this weight do not speak for a look.
SLIGHT = 0.02
# Components of less than this weight do not count in a cell's estimate.
NEGLIGIBLE = 1e-4
# Cells that are combined at once: what bounds memory.
CHUNK = 500


@dataclass(frozen=True)
class CellEstimate:
    """What is known of a cell.

    Attributes
    ----------
    mean, sd, q05, q95 : tuple of float
        Of f (cycles/m) and A_H (m).
    azimuth : tuple of float
        Axial mean (0 to 180) and standard deviation, degrees.
    derived : Derived
        Wavelength and steepness.
    """

    mean: tuple[float, float] = (NAN, NAN)
    sd: tuple[float, float] = (NAN, NAN)
    q05: tuple[float, float] = (NAN, NAN)
    q95: tuple[float, float] = (NAN, NAN)
    azimuth: tuple[float, float] = (NAN, NAN)
    derived: Derived = UNDERIVED


UNKNOWN = CellEstimate()
# The prior of a first look: flat.
FLAT = CellEstimate(sd=(float("inf"),) * 2, azimuth=(NAN, float("inf")))


@dataclass(frozen=True)
class FusedCell:
    """A cell's looks, combined.

    Attributes
    ----------
    priors, posteriors : tuple of CellEstimate
        Before and after each look, in their order; unknown where no look has told anything yet.
    disagreements : tuple of float
        Squared Mahalanobis distance of each look from the nearest of the others that agree with
        each other (chi-squared with 3 degrees of freedom by chance); NaN without others.
    group : tuple of int
        Looks that stand for the cell.
    final : CellEstimate
    migration : tuple of (float, float)
        How far the crests of each look lie from those of the first of the group, m along the
        azimuth from 0 to 180 degrees, and its standard deviation; known up to whole wavelengths,
        the passes' registration taken off. NaN for looks outside the group.
    quality : Quality
    qualities : tuple of Quality
        Of each look; one that disagrees with the cell's group, and all where no majority agrees,
        contradict each other.
    registration : tuple of (float, float)
        How far each pass is shifted over the map, east and north, m, as the crests of all cells
        tell; empty where they do not agree on any shift.
    """

    priors: tuple[CellEstimate, ...]
    posteriors: tuple[CellEstimate, ...]
    disagreements: tuple[float, ...]
    group: tuple[int, ...]
    final: CellEstimate
    migration: tuple[tuple[float, float], ...]
    quality: Quality
    qualities: tuple[Quality, ...]
    registration: tuple[tuple[float, float], ...] = ()


def learn_survey(
    cells: Sequence[Sequence[Summary | None]], settings: RippleSettings, seed: int = 0
) -> SurveyModel:
    """Learn what the looks of a survey share; see :func:`sasmap.ripples.survey.learn`.

    Parameters
    ----------
    cells : sequence of sequence of Summary or None
        Of each cell one per swath, None where it does not show the cell.
    settings : RippleSettings
    seed : int

    Returns
    -------
    SurveyModel
    """
    swaths = max((len(c) for c in cells), default=0)
    looks = None if settings.method == "zare-cobb" else gather(cells, _steepness(settings))
    scatter = None if settings.scatter is None else np.array(settings.scatter, float)
    return learn(looks, swaths, scatter, seed)


def fuse(
    summaries: Sequence[Summary | None],
    settings: RippleSettings,
    survey: SurveyModel | None = None,
) -> FusedCell:
    """Combine the looks at one cell: :func:`fuse_cells` of it alone."""
    return fuse_cells([summaries], settings, survey)[0]


def fuse_cells(
    cells: Sequence[Sequence[Summary | None]],
    settings: RippleSettings,
    survey: SurveyModel | None = None,
) -> list[FusedCell]:
    """Combine the looks at each cell.

    Parameters
    ----------
    cells : sequence of sequence of Summary or None
        Of each cell one per swath, None where it does not show the cell.
    settings : RippleSettings
    survey : SurveyModel, optional
        What the looks share; learned from these cells if not given.

    Returns
    -------
    list of FusedCell
    """
    if settings.method == "zare-cobb":
        return [_published(summaries, settings) for summaries in cells]
    survey = survey or learn_survey(cells, settings)
    # cells whose looks have as many components go together, so that little is filled up
    size = [max((len(s.mixture) for s in c if s is not None), default=0) for c in cells]
    order = np.argsort(size, kind="stable")
    found: dict[int, FusedCell] = {}
    for first in range(0, len(cells), CHUNK):
        part = [int(i) for i in order[first : first + CHUNK]]
        found.update(zip(part, _fused([cells[i] for i in part], settings, survey), strict=True))
    return _registered([found[i] for i in range(len(cells))])


def _registered(fused: list[FusedCell]) -> list[FusedCell]:
    """Tell shifts of passes, which all cells share, from the migration of crests."""
    places = [
        (i, k)
        for i, c in enumerate(fused)
        for k in c.group[1:]
        if np.isfinite(c.migration[k][0]) and np.isfinite(c.final.azimuth[0])
    ]
    if not places:
        return fused
    turn = np.radians([fused[i].final.azimuth[0] for i, _ in places])
    moved = np.array([fused[i].migration[k] for i, k in places])
    moves = Moves(
        np.array([fused[i].group[0] for i, _ in places]),
        np.array([k for _, k in places]),
        moved[:, 0],
        moved[:, 1],
        1 / np.array([fused[i].final.mean[0] for i, _ in places]),
        np.column_stack([np.sin(turn), np.cos(turn)]),
    )
    shifts = registration(moves, max(len(c.migration) for c in fused))
    if not shifts.any():
        return fused
    left = [list(c.migration) for c in fused]
    for (i, k), rest, sd in zip(places, left_over(moves, shifts), moves.sd, strict=True):
        left[i][k] = float(rest), float(sd)
    told = tuple((float(east), float(north)) for east, north in shifts)
    return [
        replace(c, migration=tuple(own), registration=told)
        for c, own in zip(fused, left, strict=True)
    ]


def _fused(
    cells: Sequence[Sequence[Summary | None]], settings: RippleSettings, survey: SurveyModel
) -> list[FusedCell]:
    looks = gather(cells, _steepness(settings))
    if looks is None:
        return [_assembled(s, (), {}, {}) for s in cells]
    distances, spreads = _judged(looks, survey, settings, len(cells))
    groups = [_agreeing(d, s) for d, s in zip(distances, spreads, strict=True)]
    known = _products(looks, survey, groups, settings)
    return [
        _assembled(summaries, groups[i], distances[i], known.get(i, {}))
        for i, summaries in enumerate(cells)
    ]


def _assembled(
    summaries: Sequence[Summary | None],
    group: tuple[int, ...],
    distances: dict[tuple[int, int], float],
    known: dict[int, CellEstimate],
) -> FusedCell:
    """Gather what became of a cell's looks; `known` is the estimate after each of the group."""
    qualities = tuple(Quality.NO_DATA if s is None else s.quality for s in summaries)
    quality = cell_quality([s.quality for s in summaries if s is not None])
    looks = {k for k, q in enumerate(qualities) if q is Quality.GOOD}
    if len(group) < len(looks):
        quality = Quality.CONTRADICTION if quality is Quality.GOOD else quality
        lost = looks if 2 * len(group) <= len(looks) else looks - set(group)
        qualities = tuple(
            Quality.CONTRADICTION if k in lost else q for k, q in enumerate(qualities)
        )
    after: list[CellEstimate] = []
    for k in range(len(summaries)):
        after.append(known.get(k, after[-1] if after else UNKNOWN))
    final = after[-1] if after else UNKNOWN
    if not group:
        group, final = _doubtful(summaries)
    if quality is Quality.FAILED:
        group, final = (), UNKNOWN
    before = [UNKNOWN, *after][: len(after)]
    apart = [
        min((distances[min(j, k), max(j, k)] for j in group if j != k and j in looks), default=NAN)
        if k in looks
        else NAN
        for k in range(len(summaries))
    ]
    return FusedCell(
        tuple(FLAT if k is UNKNOWN else k for k in before),
        tuple(after),
        tuple(apart),
        group,
        final,
        migrations(summaries, group, final),
        quality,
        qualities,
    )


def migrations(
    summaries: Sequence[Summary | None], group: tuple[int, ...], final: CellEstimate
) -> tuple[tuple[float, float], ...]:
    """Distance of the crests of looks from those of the first of their group.

    Parameters
    ----------
    summaries : sequence of Summary or None
    group : tuple of int
        Looks that agree in f, A_H and azimuth.
    final : CellEstimate
        What they know together.

    Returns
    -------
    tuple of (float, float)
        m along the azimuth from 0 to 180 degrees, from minus half to half a wavelength, and its
        standard deviation, of each look.
    """
    nothing = (NAN, NAN)
    if not group or not np.isfinite(final.mean[0]):
        return (nothing,) * len(summaries)
    turn = np.radians(final.azimuth[0])
    normal = np.array([np.sin(turn), np.cos(turn)])
    frequency = final.mean[0]
    first = summaries[group[0]]
    found = [nothing] * len(summaries)
    for k in group:
        summary = summaries[k]
        assert summary is not None
        assert first is not None
        apart = np.subtract(first.centre, summary.centre)
        (before, before_sd), (now, now_sd) = first.crest_phase, summary.crest_phase
        moved = before - now - frequency * float(normal @ apart)
        across = np.array([normal[1], -normal[0]])
        carried = np.hypot(
            final.sd[0] * (normal @ apart),
            frequency * np.radians(final.azimuth[1]) * (across @ apart),
        )
        if np.isfinite(moved):
            sd = 0.0 if k == group[0] else float(np.sqrt(before_sd**2 + now_sd**2 + carried**2))
            found[k] = (moved - round(moved)) / frequency, sd / frequency
    return tuple(found)


def _judged(
    looks: Looks, survey: SurveyModel, settings: RippleSettings, cells: int
) -> tuple[list[dict[tuple[int, int], float]], list[dict[int, float]]]:
    """Squared distance of each pair of looks at a cell, and the log volume of each look.

    What is not known of the law moves two looks at a cell alike; their difference has the error
    that is left. The distance is that of the components nearest each other.
    """
    middle = survey.middle
    scatter = np.broadcast_to(middle.scatter, (looks.cell.size, 3))
    there = placed(looks, middle)
    plain, factor = (strayed(there, middle, s) for s in (0 * scatter, scatter))
    prior = law_factor(survey.widest, looks.with_law)
    prior = with_prior(prior, steepness_factor(factor.push.shape[-1], _steepness(settings)))
    single = normalised(with_prior(plain, prior))
    heavy = single[0] - single[0].max(axis=1, keepdims=True) > np.log(SLIGHT)
    volume = np.linalg.slogdet(single[2][..., :3, :3])[1]
    volume = np.where(heavy, volume, -np.inf).max(axis=1)
    distances: list[dict[tuple[int, int], float]] = [{} for _ in range(cells)]
    spreads: list[dict[int, float]] = [{} for _ in range(cells)]
    order = np.argsort(looks.cell, kind="stable")
    pairs: list[tuple[int, int]] = []
    for rows in np.split(order, np.flatnonzero(np.diff(looks.cell[order])) + 1):
        for r in rows:
            spreads[looks.cell[r]][int(looks.swath[r])] = float(volume[r])
        pairs += combinations(sorted(rows, key=lambda r: looks.swath[r]), 2)
    if pairs:
        a, b = np.array(pairs).T
        found = _apart(factor, prior, heavy, a, b)
        for i, j, d in zip(a, b, found, strict=True):
            distances[looks.cell[i]][int(looks.swath[i]), int(looks.swath[j])] = float(d)
    return distances, spreads


def _apart(
    factor: Information,
    prior: Information,
    heavy: NDArray[np.bool_],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
) -> FloatArray:
    """Squared distance of pairs of looks (pairs,), given a law that both share."""
    both = [Information(*(v[rows] for v in factor)) for rows in (a, b)]
    ours = [given_law(one) for one in both]
    k = factor.level.shape[1]
    best = np.full(len(a), np.inf)
    for i in range(k):
        for j in range(k):
            (m1, s1, c1, p1, l1), (m2, s2, c2, p2, l2) = (
                tuple(v[:, n] for v in one) for one, n in zip(ours, (i, j), strict=True)
            )
            offset, noise = m1 - m2, c1 + c2
            if s1.shape[-1]:
                law = np.linalg.inv(prior.precision[0, LAW, LAW] + p1 + p2)
                at = np.einsum("nij,nj->ni", law, prior.push[0, LAW] + l1 + l2)
                slope = s1 - s2
                offset = offset + np.einsum("nij,nj->ni", slope, at)
                noise = noise + slope @ law @ np.swapaxes(slope, -1, -2)
            solved = np.linalg.solve(noise, offset[..., None])[..., 0]
            square = (offset * solved).sum(axis=1)
            best = np.minimum(best, np.where(heavy[a, i] & heavy[b, j], square, np.inf))
    return best


def given_law(
    factor: Information,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Log f, log A_H and azimuth as linear functions of the law.

    Parameters
    ----------
    factor : Information (..., K)

    Returns
    -------
    mean : ndarray (..., K, 3)
        For a law of zeros.
    slope : ndarray (..., K, 3, 2)
    covariance : ndarray (..., K, 3, 3)
    precision : ndarray (..., K, 2, 2)
        Of the law, the rest integrated out.
    push : ndarray (..., K, 2)
    """
    precision, push = factor.precision, factor.push
    covariance: FloatArray = np.asarray(np.linalg.inv(precision[..., :3, :3]), float)
    mean = np.einsum("...ij,...j->...i", covariance, push[..., :3])
    cross = precision[..., :3, 3:]
    slope = -covariance @ cross
    own = precision[..., 3:, 3:] + np.swapaxes(cross, -1, -2) @ slope
    left = push[..., 3:] - np.einsum("...ji,...j->...i", cross, mean)
    return mean, slope, covariance, own, left


def _agreeing(
    distances: dict[tuple[int, int], float], spreads: dict[int, float]
) -> tuple[int, ...]:
    """Return the largest group of looks that all agree with each other; the surest of equals."""
    every = tuple(sorted(spreads))
    agree = {pair: d <= LIMIT for pair, d in distances.items()}

    def good(group: tuple[int, ...]) -> bool:
        return all(agree[pair] for pair in combinations(group, 2))

    while len(every) > MOST_TRIED and not good(every):
        friends = {k: sum(agree[p] for p in combinations(every, 2) if k in p) for k in every}
        lonely = min(every, key=lambda k: (friends[k], k))
        every = tuple(k for k in every if k != lonely)
    if good(every):
        return every
    for size in range(len(every) - 1, 0, -1):
        groups = [g for g in combinations(every, size) if good(g)]
        if groups:
            return min(groups, key=lambda g: sum(spreads[k] for k in g))
    return ()


def _products(
    looks: Looks,
    survey: SurveyModel,
    groups: list[tuple[int, ...]],
    settings: RippleSettings,
) -> dict[int, dict[int, CellEstimate]]:
    """Estimates of each cell after each look of its group, averaged over what the survey shares."""
    size = np.array([len(g) for g in groups])
    used = np.array([k in groups[i] for i, k in zip(looks.cell, looks.swath, strict=True)])
    several = (size[looks.cell] > 1)[:, None]
    parts = [_after_each(looks, s, used, several, settings) for s in survey.values]
    result: dict[int, dict[int, CellEstimate]] = {}
    for k in parts[0]:
        rows = parts[0][k][0]
        level, mean, covariance = (
            np.concatenate([p[k][i] for p in parts], axis=1) for i in (1, 2, 3)
        )
        found = estimates(level, mean, covariance, settings)
        for r, estimate in zip(rows, found, strict=True):
            result.setdefault(int(looks.cell[r]), {})[k] = estimate
    return result


def _after_each(
    looks: Looks,
    shared: Shared,
    used: NDArray[np.bool_],
    several: NDArray[np.bool_],
    settings: RippleSettings,
) -> dict[int, tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]]:
    """Multiply looks swath by swath.

    For each swath its rows, and the log weight, mean and covariance of log f, log A_H and azimuth
    of their cells after it.
    """
    factor = at_height(looks, shared, np.where(several, shared.scatter, 0.0))
    law = law_factor(shared, looks.with_law)
    prior = with_prior(law, steepness_factor(factor.push.shape[-1], _steepness(settings)))
    cells, size = int(looks.cell.max()) + 1, factor.push.shape[-1]
    state = Information(
        np.full((cells, MOST_KEPT), -np.inf),
        np.zeros((cells, MOST_KEPT, size)),
        np.tile(np.eye(size), (cells, MOST_KEPT, 1, 1)),
    )
    count = np.zeros(cells, int)
    result = {}
    for k in np.unique(looks.swath):
        rows = np.flatnonzero((looks.swath == k) & used)
        for some in (rows[count[looks.cell[rows]] == 0], rows[count[looks.cell[rows]] > 0]):
            here = looks.cell[some]
            total = Information(*(v[some] for v in factor))
            if some.size and count[here[0]]:
                total = multiplied(Information(*(v[here] for v in state)), total)
            _, total = settled(total, prior)
            n = total.level.shape[1]
            for kept, new in zip(state, total, strict=True):
                kept[here, :n] = new
        count[looks.cell[rows]] += 1
        if rows.size:
            here = looks.cell[rows]
            total = Information(*(v[here] for v in state))
            weight, mean, covariance = normalised(with_prior(total, prior))
            weight = weight - logsumexp(weight, axis=1, keepdims=True)
            result[int(k)] = (rows, weight, mean[..., :3], covariance[..., :3, :3])
    return result


def estimates(
    level: FloatArray, mean: FloatArray, covariance: FloatArray, settings: RippleSettings
) -> list[CellEstimate]:
    """Summarise mixtures over log f, log A_H and azimuth.

    Parameters
    ----------
    level : ndarray (cells, K)
        Log weights.
    mean : ndarray (cells, K, 3)
    covariance : ndarray (cells, K, 3, 3)
    settings : RippleSettings

    Returns
    -------
    list of CellEstimate
    """
    weight = np.exp(level - level.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    # what counts for nothing is left out
    weight[weight < NEGLIGIBLE] = 0.0
    last = int((weight > 0).sum(axis=1).max())
    heavy = np.argsort(-weight, axis=1, kind="stable")[:, :last]
    weight = np.take_along_axis(weight, heavy, 1)
    weight /= weight.sum(axis=1, keepdims=True)
    mean = np.take_along_axis(mean, heavy[..., None], 1)
    covariance = np.take_along_axis(covariance, heavy[..., None, None], 1)
    variance = np.diagonal(covariance, axis1=2, axis2=3)
    with np.errstate(divide="ignore"):
        bounds = np.log([settings.frequency, settings.height])
    # f is far better known than A_H, whose bounds are those of the steepness at the cell's f
    steep = np.log(2) + (weight * mean[..., 0]).sum(axis=1) + bounds[1][:, None]
    ratio = variance[..., 0] + variance[..., 1] + 2 * covariance[..., 0, 1]
    logs = [
        (mean[..., 0], variance[..., 0], bounds[0]),
        (mean[..., 1], variance[..., 1], bounds[1]),
        (np.log(2) + mean[..., 0] + mean[..., 1], ratio, steep),
        (-mean[..., 0], variance[..., 0], -bounds[0][::-1]),
    ]
    found = [marginals(weight, m, np.sqrt(np.maximum(v, 1e-20)), b) for m, v, b in logs]
    turn = (weight * mean[..., 2]).sum(axis=1)
    spread = (weight * (variance[..., 2] + (mean[..., 2] - turn[:, None]) ** 2)).sum(axis=1)
    return [
        CellEstimate(
            mean=_pair(found, "mean", i),
            sd=_pair(found, "sd", i),
            q05=_pair(found, "q05", i),
            q95=_pair(found, "q95", i),
            azimuth=(float(turn[i] % 180), float(np.sqrt(spread[i]))),
            derived=_derived(found, i),
        )
        for i in range(len(level))
    ]


def _pair(found: list[Marginal], name: str, i: int) -> tuple[float, float]:
    """Return a statistic of f and of A_H."""
    return float(getattr(found[0], name)[i]), float(getattr(found[1], name)[i])


def _derived(found: list[Marginal], i: int) -> Derived:
    mean, sd, q05, q95 = (float(values[i]) for values in found[2])
    length = found[3]
    return Derived((float(length.mean[i]), float(length.sd[i])), (mean, sd, q05, q95))


def _steepness(settings: RippleSettings) -> tuple[float, float]:
    return Prior.natural(settings.frequency, settings.height).steepness


def of_summary(summary: Summary) -> CellEstimate:
    """Return what a look alone knows."""
    s = summary
    return CellEstimate(s.mean, s.sd, s.q05, s.q95, s.azimuth, s.derived)


def _doubtful(summaries: Sequence[Summary | None]) -> tuple[tuple[int, ...], CellEstimate]:
    """Better a flagged value than none: of looks not converged, the one that came nearest."""
    found = {
        k: float(np.nan_to_num(min(s.ess_bulk)))
        for k, s in enumerate(summaries)
        if s is not None and s.quality is Quality.NOT_CONVERGED
    }
    if not found:
        return (), UNKNOWN
    best = max(found, key=lambda k: found[k])
    summary = summaries[best]
    assert summary is not None
    return (best,), of_summary(summary)


def next_prior(earlier: Sequence[Summary | None], settings: RippleSettings) -> Prior:
    """Return the prior that a look is sampled under, given what earlier looks said.

    Parameters
    ----------
    earlier : sequence of Summary or None
        In order.
    settings : RippleSettings

    Returns
    -------
    Prior
        The survey's flat prior: what looks know is multiplied afterwards. With the published
        method the last posterior, as a Gaussian of hand-set width.
    """
    index = _last_published(earlier) if settings.method == "zare-cobb" else None
    last = None if index is None else earlier[index]
    if last is None:
        flat = settings.method == "zare-cobb"
        return (Prior.flat if flat else Prior.natural)(settings.frequency, settings.height)
    return Prior(last.mean, PUBLISHED_SD, (settings.frequency, settings.height))


def _last_published(summaries: Sequence[Summary | None]) -> int | None:
    found = [
        k
        for k, s in enumerate(summaries)
        if s is not None and s.quality in (Quality.GOOD, Quality.NOT_CONVERGED)
    ]
    return found[-1] if found else None


def _published(summaries: Sequence[Summary | None], settings: RippleSettings) -> FusedCell:
    quality = cell_quality([s.quality for s in summaries if s is not None])
    priors: list[CellEstimate] = []
    posteriors: list[CellEstimate] = []
    for k, summary in enumerate(summaries):
        index = _last_published(summaries[:k])
        prior = next_prior(summaries[:k], settings)
        known_before = CellEstimate(prior.mean, PUBLISHED_SD)
        priors.append(FLAT if index is None else known_before)
        known = summary is not None and summary.quality in (Quality.GOOD, Quality.NOT_CONVERGED)
        posteriors.append(of_summary(summary) if known and summary else (*posteriors, UNKNOWN)[-1])
    last = _last_published(summaries)
    nothing = (NAN,) * len(summaries)
    failed = quality is Quality.FAILED or last is None
    group = () if failed or last is None else (last,)
    final = UNKNOWN if failed else posteriors[-1]
    qualities = tuple(Quality.NO_DATA if s is None else s.quality for s in summaries)
    still = ((NAN, NAN),) * len(summaries)
    return FusedCell(
        tuple(priors), tuple(posteriors), nothing, group, final, still, quality, qualities
    )


def cell_quality(qualities: Sequence[Quality]) -> Quality:
    """Quality of a cell from those of its looks: the most telling one."""
    order = (
        Quality.FAILED,
        Quality.GOOD,
        Quality.NOT_CONVERGED,
        Quality.NO_RIPPLES,
        Quality.NOT_IDENTIFIABLE,
        Quality.TOO_FEW_PIXELS,
    )
    return next((q for q in order if q in qualities), Quality.NO_DATA)
