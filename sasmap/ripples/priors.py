"""Priors of ripple parameters (Zare and Cobb 2013, equations 7 to 9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from sasmap.arrays import FloatArray

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
        log, which is infinite for no prior.
    """

    mean: tuple[float, float]
    sd: tuple[float, float]
    bounds: tuple[tuple[float, float], tuple[float, float]]
    steepness: tuple[float, float] = ANY_STEEPNESS

    @classmethod
    def natural(cls, frequency: tuple[float, float], height: tuple[float, float]) -> Self:
        """Return the prior of natural ripples, flat within the bounds except for steepness."""
        middle = (sum(frequency) / 2, sum(height) / 2)
        return cls(middle, (np.inf, np.inf), (frequency, height), NATURAL_STEEPNESS)

    def weigh_frequency(self, draws: FloatArray) -> FloatArray:
        """Transform draws of f under a flat prior to draws under this one (ZC 8).

        The image constrains f through the phase of its crests, with a nearly Gaussian likelihood
        that does not depend on the height: its product with the prior is Gaussian again.

        Parameters
        ----------
        draws : ndarray
            Draws of f, cycles/m.

        Returns
        -------
        ndarray
            The same draws, shifted and scaled.
        """
        if np.isinf(self.sd[0]):
            return draws
        mean, variance = float(draws.mean()), float(draws.var())
        kept = self.sd[0] ** 2 / (self.sd[0] ** 2 + variance)
        middle = self.mean[0] + kept * (mean - self.mean[0])
        return np.asarray(middle + np.sqrt(kept) * (draws - mean))

    @classmethod
    def flat(cls, frequency: tuple[float, float], height: tuple[float, float]) -> Self:
        """Return the prior that is flat within the bounds."""
        middle = (sum(frequency) / 2, sum(height) / 2)
        return cls(middle, (np.inf, np.inf), (frequency, height))
