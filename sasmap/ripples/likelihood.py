"""Priors of ripple parameters (ZC 7-9; SCIENCE 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr, logsumexp

from sasmap.ripples.folded import PriorData

FloatArray = NDArray[np.float64]

# Sand stands no steeper than its angle of repose, 30 to 35 degrees; ripples of no sea floor are
# steeper than 45.
STEEPEST = 1.0


@dataclass(frozen=True)
class Prior:
    """Truncated Gaussian prior of (f, A_H) (ZC 7-9), flat where a standard deviation is infinite.

    The azimuth is axial: its Gaussian is wrapped at 180 degrees.

    Attributes
    ----------
    mean, sd : tuple of float
        Of f (cycles/m) and A_H (m) before truncation.
    bounds : tuple of tuple of float
        Truncation bounds of f and of A_H.
    correlation : float
        Between f and A_H.
    azimuth : tuple of float
        Mean and standard deviation of the crest normal's azimuth, degrees; flat where infinite.
    steepest : float
        Largest steepness 2 pi f A_H.
    """

    mean: tuple[float, float]
    sd: tuple[float, float]
    bounds: tuple[tuple[float, float], tuple[float, float]]
    correlation: float = 0.0
    azimuth: tuple[float, float] = (0.0, float("inf"))
    steepest: float = float("inf")

    @classmethod
    def flat(cls, frequency: tuple[float, float], height: tuple[float, float]) -> Self:
        """Return the prior that knows the bounds alone, and that sand does not stand upright."""
        middle = (sum(frequency) / 2, sum(height) / 2)
        return cls(middle, (np.inf, np.inf), (frequency, height), steepest=STEEPEST)

    def compiled(self, look: float) -> PriorData:
        """Return the arrays that the compiled code reads, for a look azimuth in degrees."""
        inverse = np.array([1 / self.sd[0], 1 / self.sd[1], 1 / np.radians(self.azimuth[1])])
        shape = np.eye(3)
        shape[:2, :2] = np.array([[1.0, -self.correlation], [-self.correlation, 1.0]])
        shape[:2, :2] /= 1 - self.correlation**2
        # of the two directions of the normal, the one that the sonar looks along
        turn = (self.azimuth[0] - look + 90.0) % 180.0 - 90.0
        (f_low, f_high), (h_low, h_high) = self.bounds
        return PriorData(
            np.array([*self.mean, np.radians(look + turn)]),
            inverse[:, None] * shape * inverse,
            np.array([f_low, h_low, -np.inf]),
            np.array([f_high, h_high, np.inf]),
            self.steepest,
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
