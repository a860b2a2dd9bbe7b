"""Priors, and a binned clip made ready for the compiled likelihood (SCIENCE 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr, logsumexp

from sasmap.ripples.clip import BinnedClip
from sasmap.ripples.kernel import PriorData, SpeckleData
from sasmap.ripples.scattering import cross_section

FloatArray = NDArray[np.float64]

SHADOWS = {"none": 0, "line-of-sight": 1, "crest": 2}
# A bin's pixels count as spread over at least this fraction of it.
MIN_SPREAD = 1e-3


@dataclass(frozen=True)
class Prior:
    """Truncated Gaussian prior of (f, A_H) (ZC 7-9), flat where a standard deviation is infinite.

    Attributes
    ----------
    mean, sd : tuple of float
        Of f (cycles/m) and A_H (m) before truncation.
    bounds : tuple of tuple of float
        Truncation bounds of f and of A_H.
    correlation : float
        Between f and A_H.
    """

    mean: tuple[float, float]
    sd: tuple[float, float]
    bounds: tuple[tuple[float, float], tuple[float, float]]
    correlation: float = 0.0

    @classmethod
    def flat(cls, frequency: tuple[float, float], height: tuple[float, float]) -> Self:
        """Return the prior that knows the bounds alone."""
        middle = (sum(frequency) / 2, sum(height) / 2)
        return cls(middle, (np.inf, np.inf), (frequency, height))

    def compiled(self) -> PriorData:
        """Return the arrays that the compiled code reads."""
        inverse = 1 / np.array(self.sd)
        rho = self.correlation
        shape = np.array([[1.0, -rho], [-rho, 1.0]]) / (1 - rho**2)
        lower, upper = np.array(self.bounds, float).T
        return PriorData(
            np.array(self.mean, float),
            inverse[:, None] * shape * inverse,
            lower.copy(),
            upper.copy(),
        )


def log_truncated_normal(
    x: ArrayLike, mean: float, sd: float, lower: float, upper: float
) -> FloatArray:
    """Log density of a Gaussian truncated to [lower, upper] (ZC 9), exact far outside its bulk.

    Parameters
    ----------
    x : array_like
    mean, sd : float
        Before truncation; sd above 0.
    lower, upper : float

    Returns
    -------
    ndarray
        Minus infinity outside the bounds.
    """
    x = np.asarray(x, float)
    a, b = (lower - mean) / sd, (upper - mean) / sd
    if a > 0:  # the same interval on the side where log_ndtr does not cancel
        a, b = -b, -a
    mass = logsumexp([log_ndtr(b), log_ndtr(a)], b=[1, -1])
    density = -0.5 * ((x - mean) / sd) ** 2 - np.log(sd) - 0.5 * np.log(2 * np.pi) - mass
    return np.asarray(np.where((x >= lower) & (x <= upper), density, -np.inf))


def speckle_data(binned: BinnedClip, shadow: str, variation: float = 0.0) -> SpeckleData:
    """Prepare a binned clip for the compiled likelihood.

    Parameters
    ----------
    binned : BinnedClip
    shadow : {"none", "line-of-sight", "crest"}
    variation : float
        Altitude's variation across all strips, over its mean; within a strip it smears the edges
        of shadows.

    Returns
    -------
    SpeckleData
    """
    u = binned.centres
    ground_range = binned.range0[:, None] + binned.range_slope[:, None] * u
    altitude = binned.altitude0[:, None] + binned.altitude_slope[:, None] * u
    grazing = np.arctan2(np.maximum(altitude, 1e-9), np.maximum(ground_range, 1e-9))
    flat = cross_section(grazing) ** 2
    smear = variation / len(binned.pixels)
    filled = binned.pixels > 0
    mean = np.where(filled, binned.total / np.where(filled, binned.pixels, 1.0), 1.0)
    return SpeckleData(
        binned.pixels,
        binned.total,
        np.log(mean),
        grazing - np.pi / 2,
        flat / np.average(flat, weights=binned.pixels),
        binned.start,
        binned.step,
        binned.range0,
        binned.range_slope,
        binned.altitude0,
        binned.altitude_slope,
        binned.shift,
        max(binned.spread, MIN_SPREAD),
        smear,
        SHADOWS[shadow],
    )
