"""Which looks at a cell agree with each other."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from sasmap.arrays import BoolArray, FloatArray, IntArray
from sasmap.passes.evidence import with_prior
from sasmap.passes.heights import at_height, with_scatter, without_scatter
from sasmap.passes.information import Information, moments
from sasmap.passes.looks import LAW, LOG_HEIGHT, Looks, law_factor, steepness_factor
from sasmap.passes.shared import SurveyModel

# Squared Mahalanobis distance (chi-squared with 3 degrees of freedom) beyond which two looks
# contradict each other: exceeded by one consistent pair in two thousand.
LIMIT = 17.7
# The same for A_H alone (1 degree of freedom), of a look against all others of its group combined.
HEIGHT_LIMIT = 12.1
# Most looks of which every subset is tried; with more, looks are dropped one at a time first
# (bounds the time).
MOST_TRIED = 10
# Least weight of the components that are compared between looks (a choice).
SLIGHT = 0.02


def distances_of(
    looks: Looks, survey: SurveyModel, cells: int
) -> tuple[list[dict[tuple[int, int], float]], list[dict[int, float]]]:
    """Squared distance of each pair of looks at a cell, and log volume of each look's covariance.

    An error of the law moves both looks at a cell the same way, so that the difference has only the
    remaining error. The distance is that of the nearest components.

    Parameters
    ----------
    looks : Looks
    survey : SurveyModel
    cells : int
        Number of cells.

    Returns
    -------
    distances : list of dict of (swath, swath) to float
        One dict per cell.
    volumes : list of dict of swath to float
    """
    middle = survey.middle
    scatter = np.broadcast_to(middle.scatter, (looks.cell.size, 3))
    there = without_scatter(looks, middle)
    plain, factor = (with_scatter(there, middle, s) for s in (0 * scatter, scatter))
    prior = law_factor(survey.widest, looks.with_law)
    prior = with_prior(prior, steepness_factor(factor.linear.shape[-1]))
    single = moments(with_prior(plain, prior))
    heavy = single[0] - single[0].max(axis=1, keepdims=True) > np.log(SLIGHT)
    volume = np.linalg.slogdet(single[2][..., :3, :3])[1]
    volume = np.where(heavy, volume, -np.inf).max(axis=1)
    distances: list[dict[tuple[int, int], float]] = [{} for _ in range(cells)]
    volumes: list[dict[int, float]] = [{} for _ in range(cells)]
    order = np.argsort(looks.cell, kind="stable")
    pairs: list[tuple[int, int]] = []
    for rows in np.split(order, np.flatnonzero(np.diff(looks.cell[order])) + 1):
        for r in rows:
            volumes[looks.cell[r]][int(looks.swath[r])] = float(volume[r])
        pairs += combinations(sorted(rows, key=lambda r: looks.swath[r]), 2)
    if pairs:
        a, b = np.array(pairs).T
        found = _apart(factor, prior, heavy, a, b)
        for i, j, d in zip(a, b, found, strict=True):
            distances[looks.cell[i]][int(looks.swath[i]), int(looks.swath[j])] = float(d)
    return distances, volumes


def _apart(
    factor: Information,
    prior: Information,
    heavy: BoolArray,
    a: IntArray,
    b: IntArray,
) -> FloatArray:
    """Squared distance of pairs of looks (pairs,), given a common law."""
    both = [Information(*(v[rows] for v in factor)) for rows in (a, b)]
    ours, theirs = (given_law(one) for one in both)
    k = factor.level.shape[1]
    best = np.full(len(a), np.inf)
    for i in range(k):
        for j in range(k):
            offset, noise = _difference(
                tuple(v[:, i] for v in ours), tuple(v[:, j] for v in theirs), prior
            )
            solved = np.linalg.solve(noise, offset[..., None])[..., 0]
            square = (offset * solved).sum(axis=1)
            best = np.minimum(best, np.where(heavy[a, i] & heavy[b, j], square, np.inf))
    return best


def _difference(
    first: tuple[FloatArray, ...], second: tuple[FloatArray, ...], prior: Information
) -> tuple[FloatArray, FloatArray]:
    """Difference of log f, log A_H and azimuth (n, 3) given a common law, and its covariance.

    Each look is one component of :func:`given_law`.
    """
    (m1, s1, c1, p1, l1), (m2, s2, c2, p2, l2) = first, second
    offset, noise = m1 - m2, c1 + c2
    if s1.shape[-1]:
        law = np.linalg.inv(prior.precision[0, LAW, LAW] + p1 + p2)
        at = np.einsum("nij,nj->ni", law, prior.linear[0, LAW] + l1 + l2)
        slope = s1 - s2
        offset = offset + np.einsum("nij,nj->ni", slope, at)
        noise = noise + slope @ law @ np.swapaxes(slope, -1, -2)
    return offset, noise


def together(
    looks: Looks,
    survey: SurveyModel,
    groups: list[tuple[int, ...]],
) -> list[tuple[int, ...]]:
    """Drop looks whose A_H differs from that of all others of their group combined.

    Several looks that each determine A_H poorly determine it better when combined.

    Parameters
    ----------
    looks : Looks
    survey : SurveyModel
    groups : list of tuple of int
        For each cell, swaths that agree pair by pair.

    Returns
    -------
    list of tuple of int
        Groups of fewer than three looks are left as they are.
    """
    groups = list(groups)
    rows = np.array(
        [
            r
            for r, (i, k) in enumerate(zip(looks.cell, looks.swath, strict=True))
            if len(groups[i]) > 2 and k in groups[i]
        ],
        int,
    )
    if not rows.size:
        return groups
    some = looks.some(rows)
    middle = survey.middle
    scatter = np.broadcast_to(middle.scatter, (rows.size, 3))
    prior = law_factor(survey.widest, looks.with_law)
    whole = with_prior(prior, steepness_factor(some.factor.linear.shape[-1]))
    own = _matched(at_height(some, middle, scatter), whole)
    while rows.size:
        total = np.zeros((len(groups), *own.precision.shape[1:]))
        linear = np.zeros((len(groups), *own.linear.shape[1:]))
        np.add.at(total, some.cell, own.precision)
        np.add.at(linear, some.cell, own.linear)
        rest = Information(
            own.level, linear[some.cell] - own.linear, total[some.cell] - own.precision
        )
        one, other = (tuple(v[:, 0] for v in given_law(part)) for part in (own, rest))
        offset, noise = _difference(one, other, prior)
        square = offset[:, LOG_HEIGHT] ** 2 / noise[:, LOG_HEIGHT, LOG_HEIGHT]
        worst = np.zeros(len(groups))
        np.maximum.at(worst, some.cell, square)
        lost = (square == worst[some.cell]) & (square > HEIGHT_LIMIT)
        for i, k in zip(some.cell[lost], some.swath[lost], strict=True):
            groups[i] = tuple(g for g in groups[i] if g != k)
        # only cells that lost a look, and still have three, are tested again
        again = np.isin(some.cell, some.cell[lost]) & ~lost
        again &= np.array([len(groups[i]) > 2 for i in some.cell])
        rows, some = rows[again], some.some(np.flatnonzero(again))
        own = Information(*(v[again] for v in own))
    return groups


def _matched(factor: Information, prior: Information) -> Information:
    """Replace each mixture by one component with the moments that the mixture has under a prior."""
    level, mean, covariance = moments(with_prior(factor, prior))
    weight = np.exp(level - level.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    centre = np.einsum("nk,nki->ni", weight, mean)
    apart = mean - centre[:, None]
    spread = covariance + apart[..., :, None] * apart[..., None, :]
    precision = np.linalg.inv(np.einsum("nk,nkij->nij", weight, spread))
    linear = np.einsum("nij,nj->ni", precision, centre)
    return Information(
        np.zeros((len(level), 1)),
        linear[:, None] - prior.linear,
        precision[:, None] - prior.precision,
    )


def given_law(
    factor: Information,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Express log f, log A_H and azimuth as linear functions of the law.

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
        Precision of the law, with the rest integrated out.
    linear : ndarray (..., K, 2)
    """
    precision, linear = factor.precision, factor.linear
    covariance: FloatArray = np.asarray(np.linalg.inv(precision[..., :3, :3]), float)
    mean = np.einsum("...ij,...j->...i", covariance, linear[..., :3])
    cross = precision[..., :3, 3:]
    slope = -covariance @ cross
    own = precision[..., 3:, 3:] + np.swapaxes(cross, -1, -2) @ slope
    left = linear[..., 3:] - np.einsum("...ji,...j->...i", cross, mean)
    return mean, slope, covariance, own, left


def agreeing(distances: dict[tuple[int, int], float], volumes: dict[int, float]) -> tuple[int, ...]:
    """Return the largest group of mutually agreeing looks; among equals the most precise one.

    Parameters
    ----------
    distances : dict of (swath, swath) to float
    volumes : dict of swath to float
        As from :func:`distances_of`, for one cell.

    Returns
    -------
    tuple of int
        Swaths.
    """
    every = tuple(sorted(volumes))
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
            return min(groups, key=lambda g: sum(volumes[k] for k in g))
    return ()
