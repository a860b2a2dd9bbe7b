"""Wavelength and steepness of ripples, from joint draws of f and A_H.

The height from trough to crest is 2 A_H and needs no draws; quantiles of the wavelength 1/f follow
from those of f. The mean of 1/f and all statistics of the steepness 2 A_H f need joint draws.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sasmap.arrays import FloatArray

NAN = float("nan")


class Derived(NamedTuple):
    """Quantities derived from f and A_H jointly.

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
