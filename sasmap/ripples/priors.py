"""Priors of ripple parameters (Zare and Cobb 2013, equations 7 to 9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

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
