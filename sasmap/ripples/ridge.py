"""The ridge of a clip's posterior along the exponent of the scattering law.

Law and height trade off against each other: the posterior is a curved ridge along which the
information changes by orders of magnitude, so that a Gaussian about its peak approximates it
poorly. Given the exponent, it is nearly Gaussian. The ridge is therefore followed in steps, with a
Gaussian at each (as in integrated nested Laplace approximations: Rue, Martino and Chopin 2009);
their mixture is the initial proposal of the sampler.
"""

from __future__ import annotations

import numpy as np

from sasmap.arrays import FloatArray, IntArray
from sasmap.ripples.optimise import (
    LAW,
    Peak,
    covariance_of,
    fisher_scoring,
    slope_at,
)
from sasmap.ripples.rendering import Geometry, Histogram, log_posterior

# Difference of log posterior below the best peak at which another peak is negligible.
NEGLIGIBLE = 15.0
# Step along the ridge, in local standard deviations; its least and largest length in sampling
# coordinates; most steps to either side, and rounds of Fisher scoring in each.
STEP, SHORTEST, LONGEST, STEPS, ROUNDS = 1.0, 0.08, 0.8, 14, 4
# Difference of log mass below the ridge's best place at which a walk ends, and at which a place is
# negligible.
END, NOTHING = 7.0, 9.0
# Width of a place along the ridge over the step to the next, and its largest variance over the
# local one.
OVERLAP, WIDEST = 0.7, 1.5


class _Place:
    """A place on the ridge: the peak at an exponent, and a Gaussian about it."""

    def __init__(self, z: FloatArray, data: Histogram, geometry: Geometry, free: IntArray) -> None:
        other = free != LAW
        peak = fisher_scoring(z, data, geometry, ROUNDS, free[other])
        self.z = peak.z
        information = slope_at(peak.z, data, geometry, free)[1]
        covariance = covariance_of(information)
        self.law = int(np.flatnonzero(~other)[0])
        self.variance = float(covariance[self.law, self.law])
        self.tangent = covariance[:, self.law] / self.variance
        self.given = np.zeros_like(covariance)
        self.given[np.ix_(other, other)] = covariance_of(information[np.ix_(other, other)])
        inner = self.given[np.ix_(other, other)]
        self.mass = peak.level + 0.5 * float(np.linalg.slogdet(2 * np.pi * inner)[1])

    def beside(self, step: float, free: IntArray) -> FloatArray:
        """Return the coordinates one step along the tangent."""
        z = self.z.copy()
        z[free] += step * self.tangent
        return z


def along_ridges(
    peaks: list[Peak], data: Histogram, geometry: Geometry, free: IntArray
) -> list[Peak]:
    """Follow the ridge of each peak to both sides.

    Parameters
    ----------
    peaks : list of Peak
        The likeliest first, with the covariance of `free`.
    data : Histogram
    geometry : Geometry
    free : ndarray of int
        Indices of the coordinates that are sampled.

    Returns
    -------
    list of Peak
        Places on the ridges with a Gaussian about each; `level` is the log of its mass over the
        largest. Where the law is fixed, the peaks themselves.
    """
    known = [p for p in peaks if p.level > peaks[0].level - NEGLIGIBLE]
    if not np.isnan(geometry.fixed[0]):
        return [p._replace(level=p.level - peaks[0].level) for p in known]
    found: list[Peak] = []
    for peak in known:
        if not any(_holds(place, peak.z[free] - place.z[free]) for place in found):
            found += _walked(peak, data, geometry, free)
    most = max(p.level for p in found)
    return [p._replace(level=p.level - most) for p in found if p.level > most - NOTHING]


def _holds(place: Peak, offset: FloatArray) -> bool:
    """Whether a point at an offset from a place on a ridge lies within the place's Gaussian."""
    return bool(offset @ np.linalg.solve(place.covariance, offset) < offset.size)


def _walked(peak: Peak, data: Histogram, geometry: Geometry, free: IntArray) -> list[Peak]:
    """Places along the ridge of one peak, sorted by exponent."""
    start = _Place(peak.z, data, geometry, free)
    most = start.mass
    ridge = [start]
    for sign in (-1.0, 1.0):
        place = start
        for _ in range(STEPS):
            step = sign * float(np.clip(STEP * np.sqrt(place.variance), SHORTEST, LONGEST))
            while abs(step) > 0.1 * SHORTEST:
                if np.isfinite(log_posterior(place.beside(step, free), data, geometry)):
                    break
                step /= 2
            else:
                break
            place = _Place(place.beside(step, free), data, geometry, free)
            ridge.append(place)
            most = max(most, place.mass)
            if place.mass < most - END:
                break
    ridge.sort(key=lambda p: float(p.z[LAW]))
    return _spread(ridge)


def _spread(ridge: list[_Place]) -> list[Peak]:
    """Give each place a width along the ridge that overlaps with the next."""
    exponents = np.array([p.z[LAW] for p in ridge])
    peaks = []
    for k, place in enumerate(ridge):
        around = np.abs(exponents[max(k - 1, 0) : k + 2] - exponents[k])
        step = float(around.max()) or LONGEST
        width = min((OVERLAP * step) ** 2, WIDEST * place.variance)
        covariance = place.given + width * np.outer(place.tangent, place.tangent)
        peaks.append(Peak(place.z, place.mass + float(np.log(step)), covariance))
    return peaks
