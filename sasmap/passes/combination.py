"""Products of the looks at each cell, averaged over the posterior of the shared parameters.

For every draw of the shared parameters and each population of laws, looks are expressed in A_H,
widened by their scatter and multiplied. The compiled loops go through one cell after the other, so
that a cell's result does not depend on the others.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from sasmap.arrays import FloatArray
from sasmap.passes.evidence import MOST_KEPT, with_prior
from sasmap.passes.heights import of_look, raised, to_height, told_by
from sasmap.passes.information import (
    Information,
    add,
    begin,
    blur,
    integral,
    invert,
    multiply,
    substitute,
    workspace,
)
from sasmap.passes.looks import LOG_HEIGHT, NONE, Looks, law_factor, steepness_factor
from sasmap.passes.mixture import weighted
from sasmap.passes.shared import SurveyModel

# Least weight of the components of a cell's estimate, times the number of draws.
NEGLIGIBLE = 1e-4
# Change of log A_H between passes up to which the range of a look's draws bounds another pass,
# standard deviations.
SCATTERS = 3.0


class _Draws(NamedTuple):
    """V draws of P populations of laws, for looks over D coordinates.

    Attributes
    ----------
    weight : ndarray (V, P, sediments)
        Share of the population in each sediment.
    law, gain, shift : ndarray (V, P, 2)
        Mean of the law, its precision, and its bias from the echo shape.
    scatter : ndarray (V, P, D)
        Variance of looks about their cell.
    offset : ndarray (V, swaths)
        Altitude offset, m.
    level, linear, precision : ndarray (V, P), (V, P, D), (V, P, D, D)
        Prior of a cell's law and steepness.
    """

    weight: FloatArray
    law: FloatArray
    gain: FloatArray
    shift: FloatArray
    scatter: FloatArray
    offset: FloatArray
    level: FloatArray
    linear: FloatArray
    precision: FloatArray


def after_each(looks: Looks, survey: SurveyModel) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Combine each look with the earlier ones of the same cell.

    Parameters
    ----------
    looks : Looks
        N looks sorted by cell, those at each cell in the order in which they are combined.
    survey : SurveyModel

    Returns
    -------
    weight : ndarray (N, K)
        Weights of the components of the estimate after each look; 0 where there are fewer.
    mean, covariance : ndarray (N, K, 3), (N, K, 3, 3)
        Of log f, log A_H and azimuth.
    """
    draws = _arrays(survey, looks.with_law)
    ends = np.flatnonzero(np.append(np.diff(looks.cell) != 0, True)) + 1
    n, most = looks.cell.size, draws.law[..., 0].size * MOST_KEPT
    weight, mean = np.zeros((n, most)), np.zeros((n, most, 3))
    covariance = np.empty((n, most, 3, 3))
    per_metre = looks.altitude_gain / looks.altitude
    places = looks.swath, looks.sediment, per_metre
    filled = _combine(ends, places, told_by(looks), draws, MOST_KEPT, weight, mean, covariance)
    last = int(filled.max())
    covariance[np.arange(most) >= filled[:, None]] = np.eye(3)
    weight = weight[:, :last]
    weight = weight / weighted(weight, np.ones_like(weight))[:, None]
    return weight, mean[:, :last], covariance[:, :last]


def reach_after_each(looks: Looks, survey: SurveyModel) -> FloatArray:
    """Least and largest A_H (N, 2) that each look and the earlier ones of its cell allow, m.

    The least is above the largest where the looks have no height in common.

    Parameters
    ----------
    looks : Looks
        As for :func:`after_each`.
    survey : SurveyModel
    """
    shared = survey.middle
    several = np.bincount(looks.cell)[looks.cell] > 1  # one look has its own A_H
    wider = SCATTERS * shared.scatter[LOG_HEIGHT] * several
    shift = raised(looks, shared)
    reach = np.asarray(looks.reach * np.exp(np.stack([shift - wider, shift + wider], axis=1)))
    for r in range(1, len(reach)):
        if looks.cell[r] == looks.cell[r - 1]:
            reach[r] = max(reach[r, 0], reach[r - 1, 0]), min(reach[r, 1], reach[r - 1, 1])
    return reach


def _arrays(survey: SurveyModel, with_law: bool) -> _Draws:
    """Collect the draws of a survey's shared parameters as arrays."""
    every = [[p.shared for p in draw] for draw in survey.draws]

    def array(values: list[list[FloatArray]]) -> FloatArray:
        return np.ascontiguousarray(values, float)

    steep = steepness_factor(5 if with_law else 3)
    priors = [[with_prior(law_factor(s, with_law), steep) for s in draw] for draw in every]
    variance = [[np.maximum(s.scatter, NONE) ** 2 for s in draw] for draw in every]
    scatter = array(variance)
    if with_law:
        own = array([[of_look(s) ** 2 for s in draw] for draw in every])
        scatter = np.concatenate([scatter, own], axis=2)
    return _Draws(
        array([[p.within for p in draw] for draw in survey.draws]),
        array([[s.law for s in draw] for draw in every]),
        array([[s.spread**-2.0 for s in draw] for draw in every]),
        array([[s.shift for s in draw] for draw in every]),
        np.ascontiguousarray(scatter),
        array([[s.offset for s in draw] for draw in every])[:, 0],
        *(
            array([[getattr(p, name)[0] for p in draw] for draw in priors])
            for name in Information._fields
        ),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _combine(ends, places, told, draws, most, weight, mean, covariance):  # type: ignore[no-untyped-def]
    """Fill in the components after each look; return their number (N,)."""
    swath, sediment, per_metre = places
    size, populations = told.linear.shape[2], draws.weight.shape[1]
    looks, first = 1, 0
    for end in ends:
        looks, first = max(looks, end - first), end
    states = (
        np.zeros((looks, populations), np.int64),
        np.empty((looks, populations, most)),
        np.empty((looks, populations, most, size)),
        np.empty((looks, populations, most, size, size)),
    )
    filled = np.zeros(swath.size, np.int64)
    first = 0
    for end in ends:
        for v in range(draws.weight.shape[0]):
            _products(first, end, swath, per_metre, told, draws, v, most, states)
            for r in range(first, end):
                shares = draws.weight[v, :, sediment[r]]
                filled[r] = _components(
                    r - first,
                    states,
                    draws,
                    v,
                    shares,
                    weight[r],
                    mean[r],
                    covariance[r],
                    filled[r],
                )
        first = end
    return filled


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _products(first, end, swath, per_metre, told, draws, v, most, states):  # type: ignore[no-untyped-def]
    """Multiply the looks of a cell under draw v, for each population; fill in `states`."""
    components, size = told.linear.shape[1:]
    room, new_linear, new_precision = workspace(most, components, size)
    level, linear = np.empty(components), np.empty((components, size))
    precision, column = np.empty((components, size, size)), np.empty(size)
    kept = np.empty(most), np.empty((most, size)), np.empty((most, size, size))
    heavy, variance = np.empty(most), np.empty(size)
    counts, heavies, linears, precisions = states
    for p in range(draws.weight.shape[1]):
        variance[:] = draws.scatter[v, p]
        if end - first == 1:  # one look has its own f, A_H and azimuth
            variance[:3] = NONE**2
        prior = draws.level[v, p], draws.linear[v, p], draws.precision[v, p]
        law, gain, shift = draws.law[v, p], draws.gain[v, p], draws.shift[v, p]
        count = 1
        begin(kept)
        for r in range(first, end):
            raised_by = per_metre[r] * draws.offset[v, swath[r]]
            for k in range(components):
                level[k] = told.level[r, k]
                if level[k] > -np.inf:
                    level[k] = to_height(
                        told, r, k, raised_by, law, gain, shift, linear[k], precision[k]
                    )
                    level[k] = blur(level[k], linear[k], precision[k], variance, column)
            count = multiply(
                count,
                kept,
                heavy,
                level,
                linear,
                precision,
                prior,
                room,
                new_linear,
                new_precision,
            )
            counts[r - first, p] = count
            heavies[r - first, p, :count] = heavy[:count]
            linears[r - first, p, :count] = kept[1][:count]
            precisions[r - first, p, :count] = kept[2][:count]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _components(number, states, draws, v, shares, weight, mean, covariance, filled):  # type: ignore[no-untyped-def]
    """Add the components of draw v with enough weight after look `number` of a cell.

    Populations are weighted by their share and evidence. Returns the number of components so far.
    """
    counts, heavies, linears, precisions = states
    size = linears.shape[-1]
    matrix, pivots = np.empty((size, size)), np.empty(size)
    vector, column = np.empty(size), np.empty(size)
    highest, total = -np.inf, 0.0
    for p in range(counts.shape[1]):
        for i in range(counts[number, p]):
            highest = max(highest, heavies[number, p, i] + np.log(shares[p]))
    for p in range(counts.shape[1]):
        for i in range(counts[number, p]):
            total += shares[p] * np.exp(heavies[number, p, i] - highest)
    for p in range(counts.shape[1]):
        for i in range(counts[number, p]):
            share = shares[p] * np.exp(heavies[number, p, i] - highest) / total
            if not share >= NEGLIGIBLE * len(draws.weight):
                continue
            linear, precision = linears[number, p, i], precisions[number, p, i]
            add(linear, precision, draws.linear[v, p], draws.precision[v, p], vector, matrix)
            integral(0.0, vector, matrix, pivots)
            substitute(matrix, pivots, vector)
            invert(matrix, pivots, column, covariance[filled])
            weight[filled] = share
            mean[filled] = vector[:3]
            filled += 1
    return filled
