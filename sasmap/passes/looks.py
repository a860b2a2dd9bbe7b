"""All looks of a survey at rippled cells as arrays: likelihoods of cells and of their law.

The posterior of a single look is a Gaussian mixture over log f, the log of the contrast that A_H
causes to first order, the azimuth, and the exponent n and concentration c of the scattering law. An
image determines the contrast; A_H follows from it through the law. Looks are represented as
likelihoods in information form (precision, and its product with the mean), the sampling prior
divided out, so that looks with a common cell or law are multiplied by adding.

A look informs the law in two ways. Where geometry (shadow) determines A_H, contrast gives the slope
of the law. Elsewhere only the shape of the echo over a wavelength, its harmonics, depends on the
law: on its curvature, which the family ties to n and c. A law outside the family biases all those
looks the same way; this bias is one of the survey's shared parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sasmap.arrays import FloatArray, IntArray
from sasmap.passes.information import Information
from sasmap.passes.summary import Summary, contrast_slopes, log_contrast
from sasmap.ripples.posterior import Quality
from sasmap.ripples.priors import NATURAL_STEEPNESS
from sasmap.ripples.rendering import CONCENTRATION, EXPONENT

# Sampling prior of the law: mean and variance of n and c.
LAW_MEAN = np.array([EXPONENT[0], CONCENTRATION[0]])
LAW_VARIANCE = np.array([EXPONENT[1], CONCENTRATION[1]]) ** 2
# Largest share of the variance of log contrast that is removed as the altitude's (a choice: it
# keeps the variance positive).
MOST_OF_ALTITUDE = 0.9
# Bias of n and c from the echo shape where the law is outside the family, standard deviations: n is
# biased by 0.1, 0.4, 0.1, -0.6 and 0.3 in five surveys (pipelines/ripples/surveys.py). It is part
# of a look's own error: at most this share of the variance (0.4 to 0.6 do equally well there).
SHIFT_SD, MOST_SHARED = np.array([0.4, 0.25]), 0.5
# Regression of log contrast on the law: below the first value the echo shape determines the law,
# above the second geometry does. Looks without shadow have 0.05 to 0.5, those with shadow 0.8 to
# 1.1 (pipelines/ripples/surveys.py).
LEAST_KNOWN, MOST_KNOWN = 0.5, 0.8
LOG_F, LOG_HEIGHT, AZIMUTH, LAW = 0, 1, 2, slice(3, 5)
# Least eigenvalue of a component's precision beyond that of the prior, in units of the component's
# own standard deviations: a component must be narrower than its prior.
LEAST_TOLD = 0.01
# Standard deviation in place of zero; log evidence in place of minus infinity.
NONE, LEAST_LEVEL = 1e-12, -1e9


class Shared(NamedTuple):
    """Shared parameters of a survey's looks.

    Attributes
    ----------
    law, spread : ndarray (2,)
        Mean of n and c, and their standard deviations from look to look.
    shift : ndarray (2,)
        Bias of n and c from the echo shape.
    offset : ndarray (swaths,)
        True altitude minus that of the navigation, m.
    scatter : ndarray (3,)
        Change and misregistration between passes: standard deviations of log f, log A_H and
        azimuth (degrees).
    of_look : float
        Share of the law's variance from look to look within a cell: a law outside the family
        resembles another member of it at every angle.
    odd : float
        Share of the cells whose passes differ.
    """

    law: FloatArray
    spread: FloatArray
    shift: FloatArray
    offset: FloatArray
    scatter: FloatArray
    of_look: float
    odd: float


class LawLikelihood(NamedTuple):
    """Likelihood of the law from each look, with f, contrast and azimuth integrated out.

    Attributes
    ----------
    level, linear, precision : ndarray (N, K), (N, K, 2), (N, K, 2, 2)
        As in :class:`Information`, over n and c.
    by_shape : ndarray (N,)
        Share of the survey's bias that the look has: 1 where the echo shape determines the law, 0
        where geometry determines A_H and so the law.
    """

    level: FloatArray
    linear: FloatArray
    precision: FloatArray
    by_shape: FloatArray


class Looks(NamedTuple):
    """N looks at cells, of K components each (padded with level minus infinity).

    Attributes
    ----------
    cell, swath : ndarray of int (N,)
    sediment : ndarray of int (N,)
        Number of the cell's sediment among those with a law of their own, from 1; 0 for others.
    factor : Information (N, K)
        Likelihood over log f, log contrast, azimuth (degrees), n and c; where the law is fixed,
        over log f, log A_H and azimuth.
    reach : ndarray (N, 2)
        Least and largest A_H, m.
    law : LawLikelihood or None
        None where the law is fixed.
    tangent, altitude : ndarray (N,)
        Tangent of the grazing angle, and altitude of the sonar, m, at the clip's middle.
    altitude_gain : ndarray (N,)
        Change of log A_H with log altitude.
    altitude_sd : ndarray (N,)
        Accuracy of the navigation's altitude, m.
    """

    cell: IntArray
    swath: IntArray
    sediment: IntArray
    factor: Information
    reach: FloatArray
    law: LawLikelihood | None
    tangent: FloatArray
    altitude: FloatArray
    altitude_gain: FloatArray
    altitude_sd: FloatArray

    @property
    def with_law(self) -> bool:
        """Whether the law is part of the looks' posteriors."""
        return self.law is not None

    def some(self, which: IntArray) -> Looks:
        """Select looks."""
        factor = Information(*(values[which] for values in self.factor))
        law = None if self.law is None else LawLikelihood(*(v[which] for v in self.law))
        rest = {n: getattr(self, n)[which] for n in self._fields if n not in ("factor", "law")}
        return Looks(factor=factor, law=law, **rest)


def collect(
    cells: Sequence[Sequence[Summary | None]],
    sediments: IntArray | None = None,
) -> Looks | None:
    """Collect the good looks at cells as arrays.

    Parameters
    ----------
    cells : sequence of sequence of Summary or None
        For each cell, one per swath.
    sediments : ndarray of int (cells,), optional
        Sediment of each cell, as in :attr:`Looks.sediment`; all 0 by default.

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
    raised = (gain * sd / altitude)[:, None] ** 2 / covariance[:, :, LOG_HEIGHT, LOG_HEIGHT]
    covariance = _without(covariance, LOG_HEIGHT, np.minimum(raised, MOST_OF_ALTITUDE))
    by_shape = np.zeros(n)
    if size == 5:
        by_shape, share = _by_shape(weight, mean, covariance, tangent)
        for i, place in enumerate(range(LAW.start, LAW.stop)):
            covariance = _without(covariance, place, share[:, i, None])
    factor = _likelihood(weight, mean, covariance, tangent)
    law = _law_likelihood(factor, by_shape) if size == 5 else None
    return Looks(
        cell,
        swath,
        np.zeros(n, np.int64) if sediments is None else sediments[cell],
        factor,
        np.array([s.reach for _, _, s, _ in good]),
        law,
        tangent,
        altitude,
        gain,
        sd,
    )


def _turn_to_one_axis(cell: IntArray, weight: FloatArray, mean: FloatArray) -> None:
    """Turn azimuths, which are axial, in place to within 90 degrees of their cell's mean."""
    twice = np.radians(2 * (weight * mean[:, :, AZIMUTH]).sum(axis=1))
    sines, cosines = (np.bincount(cell, v) for v in (np.sin(twice), np.cos(twice)))
    centre = 0.5 * np.degrees(np.arctan2(sines, cosines))
    offset = mean[:, :, AZIMUTH] - centre[cell][:, None]
    mean[:, :, AZIMUTH] -= 180 * np.rint(offset / 180)


def _without(covariance: FloatArray, place: int, share: FloatArray) -> FloatArray:
    """Remove from a coordinate's variance the share (n, K or 1) of an error that looks share."""
    # covariances are scaled as well, so that the matrix stays positive definite
    scale = np.ones(covariance.shape[:3])
    scale[:, :, place] = np.sqrt(1 - share)
    return np.asarray(covariance * scale[..., :, None] * scale[..., None, :])


def _likelihood(
    weight: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    tangent: FloatArray,
) -> Information:
    """Posterior components divided by the priors of law and steepness.

    A component fitted to draws may be wider than the priors in some direction. Its likelihood would
    grow without bound there, and its mean would be far away in all directions. Such a component
    constrains next to nothing in that direction: its precision is set to a small value there, and
    its mass under the priors to its weight.
    """
    prior = _priors(mean, tangent)
    precision: FloatArray = np.asarray(np.linalg.inv(covariance), float)
    linear = np.einsum("nkij,nkj->nki", precision, mean)
    with np.errstate(divide="ignore"):
        mass = np.log(weight)
    level = mass - 0.5 * (np.linalg.slogdet(covariance)[1] + (linear * mean).sum(axis=-1))
    posterior = Information(level, linear, precision)
    told = Information(*(a - b for a, b in zip(posterior, prior, strict=True)))
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    values, axes = np.linalg.eigh(told.precision * scale[..., :, None] * scale[..., None, :])
    wide = values < LEAST_TOLD
    if not wide.any():
        return told
    # along the axes, in units of the component's standard deviations
    values = np.maximum(values, LEAST_TOLD)
    along = np.einsum("nkij,nki->nkj", axes, scale * told.linear)
    there = np.einsum("nkij,nki->nkj", axes, mean / scale)
    along = np.where(wide, values * there, along)
    back = axes / scale[..., None]
    linear = np.einsum("nkij,nkj->nki", back, along)
    precision = np.einsum("nkij,nkj,nklj->nkil", back, values, back)
    both = precision + prior.precision
    right = linear + prior.linear
    square = (right * np.linalg.solve(both, right[..., None])[..., 0]).sum(axis=-1)
    level = mass - prior.level - 0.5 * (square - np.linalg.slogdet(both)[1])
    clipped = np.asarray(wide.any(axis=-1))
    kept = (clipped, clipped[..., None], clipped[..., None, None])
    mended = zip(kept, (level, linear, precision), told, strict=True)
    return Information(*(np.where(here, new, old) for here, new, old in mended))


def _priors(mean: FloatArray, tangent: FloatArray) -> Information:
    """Priors of steepness and law in the looks' coordinates, linearised at component means."""
    level, linear, precision = _steepness_of_looks(mean, tangent)
    if mean.shape[2] == 5:
        precision[:, :, LAW, LAW] += np.diag(1 / LAW_VARIANCE)
        linear[:, :, LAW] += LAW_MEAN / LAW_VARIANCE
        level = level - 0.5 * (LAW_MEAN**2 / LAW_VARIANCE + np.log(LAW_VARIANCE)).sum()
    return Information(level, linear, precision)


def _steepness_of_looks(mean: FloatArray, tangent: FloatArray) -> Information:
    """Prior of steepness in the looks' coordinates, linearised at their means (N, K, D)."""
    median, sd = NATURAL_STEEPNESS
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


def _law_likelihood(factor: Information, by_shape: FloatArray) -> LawLikelihood:
    """Integrate f, contrast and azimuth out of looks."""
    rest = slice(0, LAW.start)
    inner = factor.precision[..., rest, rest]
    cross = factor.precision[..., rest, LAW]
    right = np.concatenate([cross, factor.linear[..., rest, None]], axis=-1)
    solved = np.linalg.solve(inner, right)
    precision = factor.precision[..., LAW, LAW] - np.swapaxes(cross, -1, -2) @ solved[..., :-1]
    linear = factor.linear[..., LAW] - np.einsum("...ji,...j->...i", cross, solved[..., -1])
    level = factor.level - 0.5 * np.linalg.slogdet(inner)[1]
    level = level + 0.5 * (factor.linear[..., rest] * solved[..., -1]).sum(axis=-1)
    return LawLikelihood(level, linear, precision, by_shape)


def _by_shape(
    weight: FloatArray, mean: FloatArray, covariance: FloatArray, tangent: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Share (N,) that looks have of the survey's bias of the law, and its share of their variance.

    The latter is (N, 2), of n and of c. Where geometry determines A_H, contrast varies with the law
    as contrast per slope does; elsewhere contrast is known and does not depend on the law. The bias
    is at most a part of the look's own error.
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
    by_shape = 1 - np.clip((share - LEAST_KNOWN) / (MOST_KNOWN - LEAST_KNOWN), 0, 1)
    variance = np.diagonal(whole, axis1=1, axis2=2)[:, LAW]
    told = np.maximum(1 / variance - 1 / LAW_VARIANCE, NONE)  # without the prior
    most = np.sqrt(MOST_SHARED / told) / SHIFT_SD
    by_shape = np.minimum(by_shape, most.min(axis=1))
    left = 1 / told - (by_shape[:, None] * SHIFT_SD) ** 2
    return by_shape, np.maximum(1 - 1 / (1 / left + 1 / LAW_VARIANCE) / variance, 0.0)


def evidence_of_law(law: LawLikelihood, shared: Shared) -> FloatArray:
    """Log evidence (N,) of looks that are alone at their cells, which depends only on their law.

    Parameters
    ----------
    law : LawLikelihood
    shared : Shared

    Returns
    -------
    ndarray (N,)
    """
    gain, told = _shape_corrected(law, shared)
    weight = shared.spread**-2.0
    both = law.precision + np.diag(weight)
    linear = told + weight * shared.law
    determinant = both[..., 0, 0] * both[..., 1, 1] - both[..., 0, 1] * both[..., 1, 0]
    square = both[..., 1, 1] * linear[..., 0] ** 2 + both[..., 0, 0] * linear[..., 1] ** 2
    square = square - 2 * both[..., 0, 1] * linear[..., 0] * linear[..., 1]
    possible = (determinant > 0) & (both[..., 0, 0] > 0)
    determinant = np.where(possible, determinant, 1.0)
    level = law.level + gain + 0.5 * (square / determinant - np.log(determinant))
    level += 0.5 * (np.log(weight) - weight * shared.law**2).sum()
    level = np.where(possible, level, LEAST_LEVEL)
    return np.asarray(np.logaddexp.reduce(level, axis=1))


def _shape_corrected(law: LawLikelihood, shared: Shared) -> tuple[FloatArray, FloatArray]:
    """Correct the bias of the echo shape: change of level (N, K), and new linear term (N, K, 2)."""
    shift = law.by_shape[:, None, None] * shared.shift
    pulled = np.einsum("nkij,nkj->nki", law.precision, shift)
    return (shift * (law.linear - 0.5 * pulled)).sum(axis=-1), law.linear - pulled


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
        With one component.
    """
    size = 5 if with_law else 3
    linear, precision, level = np.zeros((1, size)), np.zeros((1, size, size)), np.zeros(1)
    if with_law:
        variance = (1 - shared.of_look) * shared.spread**2
        linear[0, LAW] = shared.law / variance
        precision[0, LAW, LAW] = np.diag(1 / variance)
        level[0] = -0.5 * (shared.law**2 / variance + np.log(variance)).sum()
    return Information(level, linear, precision)


def steepness_factor(size: int) -> Information:
    """Prior of natural steepness as a factor of log f and log A_H, of one component.

    `size` is the number of coordinates.
    """
    median, sd = NATURAL_STEEPNESS
    both = np.zeros(size)
    both[[LOG_F, LOG_HEIGHT]] = 1.0
    middle = np.log(0.5 * median)
    return Information(
        np.array([-0.5 * (middle / sd) ** 2 - np.log(sd)]),
        (middle * both / sd**2)[None],
        (np.outer(both, both) / sd**2)[None],
    )
