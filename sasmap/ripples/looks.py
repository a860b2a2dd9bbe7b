"""All looks of a survey at rippled cells as arrays: what they say of a cell and of its law.

A look's posterior of its own is a Gaussian mixture over the log of f, the log of the contrast that
A_H makes to first order, the azimuth, and the exponent n and concentration c of the scattering law.
An image tells the contrast; A_H follows from it by way of the law. Looks are kept as likelihoods in
information form (precision and its product with the mean), the prior that they were sampled under
taken off, so that those that share a cell or a law are multiplied by adding.

A look tells the law in two ways. Where A_H is known by geometry (shadow), contrast tells the law's
slope. Where it is not, only the pulse's shape is left, its overtones: the law's bend, of which the
family has none of its own. A law outside the family shifts what all those looks tell alike; that
shift is one more thing that a survey's looks share.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from sasmap.ripples.posterior import Quality
from sasmap.ripples.rendering import CONCENTRATION, EXPONENT
from sasmap.ripples.summary import Summary, contrast_slopes, log_contrast

FloatArray = NDArray[np.float64]

# Prior of the law that looks are sampled under: mean and variance of n and c.
LAW_MEAN = np.array([EXPONENT[0], CONCENTRATION[0]])
LAW_VARIANCE = np.array([EXPONENT[1], CONCENTRATION[1]]) ** 2
# Least share of the variance of log contrast that remains when altitude is told.
REMAINING = 0.1
# By how much n and c that the pulse's shape tells are wrong where the law is outside the family, in
# the survey and once more in each look: a law with a critical angle shifts n by -0.7. How far the
# law at one angle is from that over all angles, of log contrast (pipelines/ripples/surveys.py).
SHIFT_SD, LOCAL_LAW = np.array([0.8, 0.5]), 0.05
# How closely log contrast follows the law: below the first the law is known by the pulse's shape,
# above the second by geometry. Looks without shadow have 0.05 to 0.5, those with shadow 0.8 to 1.1
# (pipelines/ripples/surveys.py).
LEAST_KNOWN, MOST_KNOWN = 0.5, 0.8
LOG_F, LOG_HEIGHT, AZIMUTH, LAW = 0, 1, 2, slice(3, 5)
# Stands for no scatter; log evidence of what cannot be.
NONE, LEAST_LEVEL = 1e-12, -1e9


class Shared(NamedTuple):
    """What the looks of a survey share.

    Attributes
    ----------
    law, spread : ndarray (2,)
        Mean of n and c, and their standard deviations from look to look.
    shift : ndarray (2,)
        n and c that the pulse's shape tells less those that its contrast goes by.
    offset : ndarray (swaths,)
        True altitude less that of the navigation, m.
    scatter : ndarray (3,)
        Change and misregistration between passes: standard deviations of log f, log A_H and
        azimuth (degrees).
    of_look : float
        Share of the law's variance that is of the look, not of the cell: a law outside the family
        is another member of it at every angle.
    """

    law: FloatArray
    spread: FloatArray
    shift: FloatArray
    offset: FloatArray
    scatter: FloatArray
    of_look: float


class Information(NamedTuple):
    """Gaussian factors exp(level + push u - u precision u / 2), arrays (..., K) and so on.

    Attributes
    ----------
    level : ndarray (..., K)
    push : ndarray (..., K, D)
    precision : ndarray (..., K, D, D)
    """

    level: FloatArray
    push: FloatArray
    precision: FloatArray


class LawTold(NamedTuple):
    """What looks tell of their law when f, contrast and azimuth are left open.

    Attributes
    ----------
    level, push, precision : ndarray (N, K), (N, K, 2), (N, K, 2, 2)
        As :class:`Information`, of n and c.
    by_shape : ndarray (N,)
        1 where it is the pulse's shape that tells it, 0 where geometry tells A_H and so the law.
    """

    level: FloatArray
    push: FloatArray
    precision: FloatArray
    by_shape: FloatArray


class Looks(NamedTuple):
    """Looks at cells: N of them, of K components each (padded with level minus infinity).

    Attributes
    ----------
    cell, swath : ndarray of int (N,)
    factor : Information (N, K)
        Likelihood over log f, log contrast, azimuth (degrees), n and c; where the law is fixed,
        over log f, log A_H and azimuth.
    law : LawTold or None
        None where the law is fixed.
    tangent, altitude : ndarray (N,)
        Of the grazing angle, and of the sonar, m, at the clip's middle.
    altitude_gain : ndarray (N,)
        Change of log A_H with log altitude.
    altitude_sd : ndarray (N,)
        Accuracy of the navigation's altitude, m.
    """

    cell: NDArray[np.int64]
    swath: NDArray[np.int64]
    factor: Information
    law: LawTold | None
    tangent: FloatArray
    altitude: FloatArray
    altitude_gain: FloatArray
    altitude_sd: FloatArray

    @property
    def with_law(self) -> bool:
        """Whether the law is part of the looks' posteriors."""
        return self.law is not None

    def some(self, which: NDArray[np.int64]) -> Looks:
        """Return some of the looks."""
        factor = Information(*(values[which] for values in self.factor))
        law = None if self.law is None else LawTold(*(values[which] for values in self.law))
        rest = {n: getattr(self, n)[which] for n in self._fields if n not in ("factor", "law")}
        return Looks(factor=factor, law=law, **rest)


def gather(
    cells: Sequence[Sequence[Summary | None]], steepness: tuple[float, float]
) -> Looks | None:
    """Lay the good looks at cells as arrays.

    Parameters
    ----------
    cells : sequence of sequence of Summary or None
        Of each cell, one per swath.
    steepness : tuple of float
        Prior that they were sampled under: median and log standard deviation of crest to trough
        over wavelength; infinite for none.

    Returns
    -------
    Looks or None
        None where no cell has a good look.
    """
    good = [
        (i, k, s, s.density)
        for i, summaries in enumerate(cells)
        for k, s in enumerate(summaries)
        if s is not None and s.quality is Quality.GOOD and s.mixture
    ]
    if not good:
        return None
    densities = [d for _, _, _, d in good if d is not None]
    size = densities[0].mean.shape[1]
    most = max(d.weight.size for d in densities)
    n = len(good)
    weight, mean = np.zeros((n, most)), np.zeros((n, most, size))
    covariance = np.tile(np.eye(size), (n, most, 1, 1))
    for row, density in enumerate(densities):
        k = density.weight.size
        weight[row, :k], mean[row, :k], covariance[row, :k] = density
        mean[row, k:] = density.mean[0]
    cell, swath = (np.array(v, int) for v in zip(*((i, k) for i, k, _, _ in good), strict=True))
    _turn_to_one_axis(cell, weight, mean)
    told = [(s.tangent, s.altitude, s.altitude_gain, s.altitude_sd) for _, _, s, _ in good]
    tangent, altitude, gain, sd = np.array(told, float).T
    covariance = _altitude_told(covariance, gain * sd / altitude)
    factor = _likelihood(weight, mean, covariance, tangent, steepness)
    law = None
    if size == 5:
        by_shape = _by_shape(weight, mean, covariance, tangent)
        law = _law_told(factor, by_shape)
        factor, law = _doubted(factor, law)
    return Looks(
        cell,
        swath,
        factor,
        law,
        tangent,
        altitude,
        gain,
        sd,
    )


def _turn_to_one_axis(cell: NDArray[np.int64], weight: FloatArray, mean: FloatArray) -> None:
    """Turn azimuths, which are axial, to within 90 degrees of their cell's mean; in place."""
    twice = np.radians(2 * (weight * mean[:, :, AZIMUTH]).sum(axis=1))
    sines, cosines = (np.bincount(cell, v) for v in (np.sin(twice), np.cos(twice)))
    centre = 0.5 * np.degrees(np.arctan2(sines, cosines))
    offset = mean[:, :, AZIMUTH] - centre[cell][:, None]
    mean[:, :, AZIMUTH] -= 180 * np.rint(offset / 180)


def _altitude_told(covariance: FloatArray, sd: FloatArray) -> FloatArray:
    """Take the part of altitude that a swath's looks share off the error of log contrast."""
    variance = covariance[:, :, LOG_HEIGHT, LOG_HEIGHT]
    left = np.maximum(variance - sd[:, None] ** 2, REMAINING * variance)
    # what correlates with it shrinks with it, so that the matrix stays positive
    scale = np.ones(covariance.shape[:3])
    scale[:, :, LOG_HEIGHT] = np.sqrt(left / variance)
    return np.asarray(covariance * scale[..., :, None] * scale[..., None, :])


def _likelihood(
    weight: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    tangent: FloatArray,
    steepness: tuple[float, float],
) -> Information:
    """Posterior components over the priors of law and steepness."""
    precision: FloatArray = np.asarray(np.linalg.inv(covariance), float)
    push = np.einsum("nkij,nkj->nki", precision, mean)
    with np.errstate(divide="ignore"):
        level = np.log(weight)
    level = level - 0.5 * (np.linalg.slogdet(covariance)[1] + (push * mean).sum(axis=-1))
    natural = _steepness_of_looks(mean, tangent, steepness)
    level, push, precision = (a - b for a, b in zip((level, push, precision), natural, strict=True))
    if mean.shape[2] == 5:
        precision[:, :, LAW, LAW] -= np.diag(1 / LAW_VARIANCE)
        push[:, :, LAW] -= LAW_MEAN / LAW_VARIANCE
        level += 0.5 * (LAW_MEAN**2 / LAW_VARIANCE + np.log(LAW_VARIANCE)).sum()
    return Information(level, push, precision)


def _steepness_of_looks(
    mean: FloatArray, tangent: FloatArray, steepness: tuple[float, float]
) -> Information:
    """Prior of steepness over the coordinates of looks, linear about their means (N, K, D)."""
    median, sd = steepness
    if not np.isfinite(sd):
        return Information(np.zeros(mean.shape[:2]), 0 * mean, np.zeros((*mean.shape, 1)))
    row = np.zeros(mean.shape)
    row[..., [LOG_F, LOG_HEIGHT]] = 1.0
    middle = np.full(mean.shape[:2], np.log(0.5 * median))
    if mean.shape[2] == 5:
        law = mean[..., LAW]
        slopes = contrast_slopes(law, tangent[:, None])
        row[..., LAW] = -slopes
        middle += log_contrast(law, tangent[:, None]) - (slopes * law).sum(axis=-1)
    return Information(
        -0.5 * (middle / sd) ** 2 - np.log(sd),
        (middle / sd**2)[..., None] * row,
        row[..., :, None] * row[..., None, :] / sd**2,
    )


def _law_told(factor: Information, by_shape: FloatArray) -> LawTold:
    """Integrate f, contrast and azimuth out of looks."""
    rest = slice(0, LAW.start)
    inner = factor.precision[..., rest, rest]
    cross = factor.precision[..., rest, LAW]
    right = np.concatenate([cross, factor.push[..., rest, None]], axis=-1)
    solved = np.linalg.solve(inner, right)
    precision = factor.precision[..., LAW, LAW] - np.swapaxes(cross, -1, -2) @ solved[..., :-1]
    push = factor.push[..., LAW] - np.einsum("...ji,...j->...i", cross, solved[..., -1])
    level = factor.level - 0.5 * np.linalg.slogdet(inner)[1]
    level = level + 0.5 * (factor.push[..., rest] * solved[..., -1]).sum(axis=-1)
    return LawTold(level, push, precision, by_shape)


def _doubted(factor: Information, law: LawTold) -> tuple[Information, LawTold]:
    """Blur what looks tell of the law by the pulse's shape, and a little what contrast tells."""
    sd = np.maximum(law.by_shape[:, None] * SHIFT_SD, NONE)
    blurred = widened(Information(*law[:3]), sd[:, None, :])
    told = LawTold(*blurred, law.by_shape)
    push, precision = factor.push.copy(), factor.precision.copy()
    push[..., LAW] += told.push - law.push
    precision[..., LAW, LAW] += told.precision - law.precision
    some = np.isfinite(law.level)  # not what fills up
    level = factor.level + np.subtract(told.level, law.level, where=some, out=np.zeros(some.shape))
    error = np.full((len(sd), 1, 5), NONE)
    error[..., LOG_HEIGHT] = np.maximum(LOCAL_LAW * law.by_shape[:, None], NONE)
    return widened(Information(level, push, precision), error), told


def _by_shape(
    weight: FloatArray, mean: FloatArray, covariance: FloatArray, tangent: FloatArray
) -> FloatArray:
    """Tell which looks (N,) know the law by the pulse's shape alone.

    Where geometry tells A_H, contrast follows the law as contrast per slope does; where nothing
    does, contrast is known and does not follow the law.
    """
    centre = np.einsum("nk,nki->ni", weight, mean)
    apart = mean - centre[:, None]
    whole = np.einsum(
        "nk,nkij->nij", weight, covariance + apart[..., :, None] * apart[..., None, :]
    )
    precision = np.linalg.inv(whole)
    rest = slice(0, LAW.start)
    follows = -np.linalg.solve(precision[:, rest, rest], precision[:, rest, LAW])[:, LOG_HEIGHT]
    slopes = contrast_slopes(centre[:, LAW], tangent)
    share = (follows * slopes).sum(axis=-1) / (slopes**2).sum(axis=-1)
    return np.asarray(1 - np.clip((share - LEAST_KNOWN) / (MOST_KNOWN - LEAST_KNOWN), 0, 1))


def at_height(looks: Looks, shared: Shared, scatter: FloatArray) -> Information:
    """Likelihood of log f, log A_H, azimuth and the law of the cell.

    Parameters
    ----------
    looks : Looks
    shared : Shared
    scatter : ndarray (N, 3)
        Standard deviations by which a look strays from its cell: of log f, log A_H and azimuth.

    Returns
    -------
    Information (N, K)
        Over log f, log A_H, azimuth, n and c; without n and c where the law is fixed.
    """
    return strayed(placed(looks, shared), shared, scatter)


def placed(looks: Looks, shared: Shared) -> Information:
    """Return looks as functions of A_H by the survey's law and altitudes, without scatter.

    Parameters
    ----------
    looks : Looks
    shared : Shared

    Returns
    -------
    Information (N, K)
        As :func:`at_height`.
    """
    level, push, precision = looks.factor
    shift = looks.altitude_gain * shared.offset[looks.swath] / looks.altitude
    place = np.zeros(push.shape)
    place[:, :, LOG_HEIGHT] = -shift[:, None]
    if looks.law is None:
        return _moved(level, push, precision, place, None)
    gain, told = _shape_corrected(looks.law, shared)
    push = push.copy()
    push[..., LAW] += told - looks.law.push
    about = _law_of_looks(looks.law.precision, told, shared)
    slopes = contrast_slopes(about, looks.tangent[:, None])
    place[:, :, LOG_HEIGHT] += log_contrast(about, looks.tangent[:, None])
    place[:, :, LOG_HEIGHT] -= (slopes * about).sum(axis=-1)
    turn = np.broadcast_to(np.eye(5), precision.shape).copy()
    turn[:, :, LOG_HEIGHT, LAW] = slopes
    # log contrast and the rest are turn u + place
    return _moved(level + gain, push, precision, place, turn)


def strayed(factor: Information, shared: Shared, scatter: FloatArray) -> Information:
    """Blur looks by how far they stray from their cell, f, A_H, azimuth and law.

    Parameters
    ----------
    factor : Information (N, K)
    shared : Shared
    scatter : ndarray (N, 3)

    Returns
    -------
    Information (N, K)
    """
    wide = np.maximum(scatter, NONE)
    if factor.push.shape[-1] == 5:
        of_look = np.sqrt(shared.of_look) * shared.spread
        wide = np.concatenate([wide, np.broadcast_to(of_look, (len(wide), 2))], axis=1)
    return widened(factor, wide[:, None, :])


def evidence_of_law(law: LawTold, shared: Shared) -> FloatArray:
    """Log evidence of looks at cells that no other look sees (N,): of their law alone.

    Parameters
    ----------
    law : LawTold
    shared : Shared

    Returns
    -------
    ndarray (N,)
    """
    gain, told = _shape_corrected(law, shared)
    weight = shared.spread**-2.0
    both = law.precision + np.diag(weight)
    push = told + weight * shared.law
    determinant = both[..., 0, 0] * both[..., 1, 1] - both[..., 0, 1] * both[..., 1, 0]
    square = both[..., 1, 1] * push[..., 0] ** 2 + both[..., 0, 0] * push[..., 1] ** 2
    square = square - 2 * both[..., 0, 1] * push[..., 0] * push[..., 1]
    possible = (determinant > 0) & (both[..., 0, 0] > 0)
    determinant = np.where(possible, determinant, 1.0)
    level = law.level + gain + 0.5 * (square / determinant - np.log(determinant))
    level += 0.5 * (np.log(weight) - weight * shared.law**2).sum()
    return np.asarray(logsumexp(np.where(possible, level, LEAST_LEVEL), axis=1))


def _shape_corrected(law: LawTold, shared: Shared) -> tuple[FloatArray, FloatArray]:
    """Take the shift off what shape tells: change of the level (N, K), and new push (N, K, 2)."""
    shift = law.by_shape[:, None, None] * shared.shift
    pulled = np.einsum("nkij,nkj->nki", law.precision, shift)
    return (shift * (law.push - 0.5 * pulled)).sum(axis=-1), law.push - pulled


def _law_of_looks(precision: FloatArray, push: FloatArray, shared: Shared) -> FloatArray:
    """Mean law of each component (N, K, 2) under the survey's."""
    gain = np.diag(shared.spread**-2.0)
    return np.asarray(
        np.linalg.solve(precision + gain, (push + gain @ shared.law)[..., None])[..., 0]
    )


def _moved(
    level: FloatArray,
    push: FloatArray,
    precision: FloatArray,
    place: FloatArray,
    turn: FloatArray | None,
) -> Information:
    """Factor of v as one of u, where v = turn u + place."""
    pulled = np.einsum("nkij,nkj->nki", precision, place)
    level = level + ((push - 0.5 * pulled) * place).sum(axis=-1)
    push = push - pulled
    if turn is None:
        return Information(level, push, precision)
    back = np.swapaxes(turn, -1, -2)
    return Information(level, np.einsum("nkij,nkj->nki", back, push), back @ precision @ turn)


def widened(factor: Information, sd: FloatArray) -> Information:
    """Blur factors by independent Gaussians.

    Parameters
    ----------
    factor : Information (..., K)
    sd : ndarray (..., K, D)
        Above 0; broadcasts.

    Returns
    -------
    Information (..., K)
    """
    size = factor.push.shape[-1]
    least = np.broadcast_to(sd, factor.push.shape) ** -2.0
    both = factor.precision + least[..., :, None] * np.eye(size)
    right = np.concatenate([factor.precision, factor.push[..., None]], axis=-1)
    solved = np.linalg.solve(both, right)
    push = factor.push - np.einsum("...ij,...j->...i", factor.precision, solved[..., -1])
    precision = factor.precision - factor.precision @ solved[..., :-1]
    level = factor.level + 0.5 * (factor.push * solved[..., -1]).sum(axis=-1)
    level = level - 0.5 * (np.linalg.slogdet(both)[1] - np.log(least).sum(axis=-1))
    return Information(level, push, 0.5 * (precision + np.swapaxes(precision, -1, -2)))


def law_factor(shared: Shared, with_law: bool) -> Information:
    """Prior of a cell's law: the survey's, with its spread from cell to cell.

    Parameters
    ----------
    shared : Shared
    with_law : bool
        Whether the law is estimated.

    Returns
    -------
    Information ()
        Of one component.
    """
    size = 5 if with_law else 3
    push, precision, level = np.zeros((1, size)), np.zeros((1, size, size)), np.zeros(1)
    if with_law:
        variance = (1 - shared.of_look) * shared.spread**2
        push[0, LAW] = shared.law / variance
        precision[0, LAW, LAW] = np.diag(1 / variance)
        level[0] = -0.5 * (shared.law**2 / variance + np.log(variance)).sum()
    return Information(level, push, precision)


def steepness_factor(size: int, steepness: tuple[float, float]) -> Information:
    """Prior of natural steepness as a factor of log f and log A_H, which each look has had.

    Parameters
    ----------
    size : int
        Number of coordinates.
    steepness : tuple of float
        Median and log standard deviation of crest to trough over wavelength; infinite for none.

    Returns
    -------
    Information ()
        Of one component.
    """
    push, precision, level = np.zeros((1, size)), np.zeros((1, size, size)), np.zeros(1)
    median, sd = steepness
    if np.isfinite(sd):
        both = np.zeros(size)
        both[[LOG_F, LOG_HEIGHT]] = 1.0
        middle = np.log(0.5 * median)
        push[0] = middle * both / sd**2
        precision[0] = np.outer(both, both) / sd**2
        level[0] = -0.5 * (middle / sd) ** 2 - np.log(sd)
    return Information(level, push, precision)


def normalised(factor: Information) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log of the integral (...), mean (..., D) and covariance (..., D, D) of each component."""
    covariance: FloatArray = np.asarray(np.linalg.inv(factor.precision), float)
    mean: FloatArray = np.einsum("...ij,...j->...i", covariance, factor.push)
    sign, determinant = np.linalg.slogdet(factor.precision)
    level = factor.level + 0.5 * (factor.push * mean).sum(axis=-1) - 0.5 * determinant
    return np.where(sign > 0, level, -np.inf), mean, covariance


def multiplied(first: Information, second: Information) -> Information:
    """Multiply mixtures: every component of the one with every one of the other.

    Parameters
    ----------
    first, second : Information (..., K1) and (..., K2)

    Returns
    -------
    Information (..., K1 K2)
    """
    level = first.level[..., :, None] + second.level[..., None, :]
    push = first.push[..., :, None, :] + second.push[..., None, :, :]
    precision = first.precision[..., :, None, :, :] + second.precision[..., None, :, :, :]
    lead, size = level.shape[:-2], push.shape[-1]
    return Information(
        level.reshape(*lead, -1),
        push.reshape(*lead, -1, size),
        precision.reshape(*lead, -1, size, size),
    )


def heaviest(factor: Information, level: FloatArray, most: int) -> Information:
    """Keep the components of the largest `level` (..., K), at most so many."""
    if level.shape[-1] <= most:
        return factor
    kept = np.argsort(-level, axis=-1, kind="stable")[..., :most]
    return Information(
        np.take_along_axis(factor.level, kept, -1),
        np.take_along_axis(factor.push, kept[..., None], -2),
        np.take_along_axis(factor.precision, kept[..., None, None], -3),
    )
