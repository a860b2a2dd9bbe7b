"""Wavelength and steepness of ripples, from joint draws of f and A_H.

Height from trough to crest is 2 A_H and needs no draws; quantiles of the wavelength 1/f follow from
those of f. The means of 1/f and everything of the steepness 2 A_H f do not.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import qmc

from sasmap.numerics.gaussians import Mixture

FloatArray = NDArray[np.float64]
NAN = float("nan")

# Points of a Sobol' sequence that stand for a mixture, a power of two: quantiles to about a
# hundredth of a standard deviation, which the tests hold it to.
POWER = 12
# Points within the bounds under which the others are moved to the bounds instead of left out.
LEAST = 200


class Derived(NamedTuple):
    """What follows from f and A_H together.

    Attributes
    ----------
    wavelength : tuple of float
        Mean and standard deviation of 1/f, m.
    steepness : tuple of float
        Mean, standard deviation, 5 and 95 % quantile of 2 A_H f.
    """

    wavelength: tuple[float, float] = (NAN, NAN)
    steepness: tuple[float, float, float, float] = (NAN, NAN, NAN, NAN)


UNKNOWN = Derived()


def derived_of_draws(frequency: FloatArray, height: FloatArray) -> Derived:
    """Summarise wavelength and steepness over draws.

    Parameters
    ----------
    frequency : ndarray
        f, cycles/m.
    height : ndarray
        A_H, m; of the same shape.

    Returns
    -------
    Derived
    """
    wavelength = 1 / np.maximum(frequency, 1e-9)
    steepness = 2 * height * frequency
    q05, q95 = np.quantile(steepness, (0.05, 0.95))
    return Derived(
        (float(wavelength.mean()), float(wavelength.std(ddof=1))),
        (float(steepness.mean()), float(steepness.std(ddof=1)), float(q05), float(q95)),
    )


def derived_of_mixture(
    mixture: Mixture, frequency: tuple[float, float], height: tuple[float, float]
) -> Derived:
    """Summarise wavelength and steepness of a mixture of (f, A_H, ...) truncated to bounds.

    Parameters
    ----------
    mixture : Mixture
    frequency, height : tuple of float
        Bounds of f (cycles/m) and A_H (m).

    Returns
    -------
    Derived
    """
    uniform = _points()
    which = np.searchsorted(np.cumsum(mixture.weight)[:-1], uniform[:, 0], side="right")
    factor = np.linalg.cholesky(mixture.covariance[:, :2, :2])
    normal = ndtri(uniform[:, 1:])
    points = mixture.mean[which, :2] + np.einsum("nij,nj->ni", factor[which], normal)
    low, high = np.array([frequency, height]).T
    inside = ((points >= low) & (points <= high)).all(axis=1)
    points = points[inside] if inside.sum() >= LEAST else np.clip(points, low, high)
    return derived_of_draws(points[:, 0], points[:, 1])


@lru_cache(maxsize=1)
def _points() -> FloatArray:
    """Points (n, 3) in the unit cube, the same always."""
    sobol = qmc.Sobol(3, scramble=False).random_base2(POWER)
    return np.asarray(sobol + 0.5 / 2**POWER)  # the first lies in the corner
