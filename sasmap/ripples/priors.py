"""Priors of ripple parameters (Zare and Cobb 2013, equations 7 to 9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr, logsumexp

FloatArray = NDArray[np.float64]

# Crest to trough over wavelength of natural ripples: 0.03 to 0.2, typically about 0.1 (vortex
# ripples 0.1 to 0.2, worn ones less). Median and standard deviation of the log.
NATURAL_STEEPNESS = (0.09, 0.7)
ANY_STEEPNESS = (0.09, float("inf"))


@dataclass(frozen=True)
class Prior:
    """Truncated Gaussian prior of (f, A_H) (ZC 7-9), flat where a standard deviation is infinite.

    Attributes
    ----------
    mean, sd : tuple of float
        Of f (cycles/m) and A_H (m) before truncation.
    bounds : tuple of tuple of float
        Truncation bounds of f and of A_H.
    steepness : tuple of float
        Log-normal prior of crest to trough over wavelength: median and standard deviation of the
        log; infinite for none.
    """

    mean: tuple[float, float]
    sd: tuple[float, float]
    bounds: tuple[tuple[float, float], tuple[float, float]]
    steepness: tuple[float, float] = ANY_STEEPNESS

    @classmethod
    def natural(cls, frequency: tuple[float, float], height: tuple[float, float]) -> Self:
        """Return the prior of natural ripples, flat within the bounds but for their steepness."""
        middle = (sum(frequency) / 2, sum(height) / 2)
        return cls(middle, (np.inf, np.inf), (frequency, height), NATURAL_STEEPNESS)

    @classmethod
    def flat(cls, frequency: tuple[float, float], height: tuple[float, float]) -> Self:
        """Return the prior that knows the bounds alone."""
        middle = (sum(frequency) / 2, sum(height) / 2)
        return cls(middle, (np.inf, np.inf), (frequency, height))


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
