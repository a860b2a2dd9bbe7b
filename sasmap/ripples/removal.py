"""Amplitude of the sea floor with its ripples taken off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Modelled amplitude, over that of flat sea floor, below which there is shadow.
SHADOW = 0.25


def without_ripples(
    amplitude: NDArray[np.floating], relief: NDArray[np.floating] | None
) -> NDArray[np.floating]:
    """Take ripples off an amplitude; NaN in their shadow.

    Parameters
    ----------
    amplitude : ndarray (window, window)
    relief : ndarray (window, window) or None
        Modelled amplitude over that of flat sea floor; NaN where there are no ripples.

    Returns
    -------
    ndarray (window, window)
    """
    if relief is None:
        return amplitude
    known = np.where(np.isfinite(relief), relief, 1.0)
    return np.asarray(np.where(known < SHADOW, np.nan, amplitude / np.maximum(known, SHADOW)))
