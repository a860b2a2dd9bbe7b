"""Shadow edges that every row of pixels samples at the same places.

Where crests run along the rows or columns of pixels, an edge of shadow falls on the same part of a
pixel all along its crest: whether the image tells a pixel's middle or its mean, no number of rows
averages what that makes of the edge's place. Of crests that cross the lattice by a pixel or more it
averages out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.fit import Fit
from sasmap.ripples.image import Image
from sasmap.ripples.kernel import shadow_places

FloatArray = NDArray[np.float64]

# Standard deviation of an edge's place where all rows sample it alike, pixels: a uniform law's.
ALIKE = 0.29
# Relative change of A_H by which the length of shadow is told.
STEP = 0.02


def edge_errors(fit: Fit, image: Image, theta: FloatArray) -> tuple[float, float]:
    """How far the sampling of shadow's edges may put f and A_H off, relative.

    Parameters
    ----------
    fit : Fit
    image : Image
    theta : ndarray (SIZE,)
        Of the posterior's middle.

    Returns
    -------
    tuple of float
        Standard deviations of log f and log A_H; 0 without shadow or where crests bend.
    """
    if not fit.phase.rigid or fit.data.shadow == 0:
        return 0.0, 0.0
    cycles = np.abs(image.per_pixel(theta[0] * np.array([np.sin(theta[2]), np.cos(theta[2])])))
    across = int(np.argmax(cycles))  # of columns and rows, those that crests run across
    length, side = image.shape[1 - across], image.shape[across]
    swept = cycles[1 - across] / cycles[across] * side
    width = np.diff(shadow_places(theta, fit.data), axis=1)[:, 0]
    dark = width > 0
    waves = length * cycles[across] * dark.mean()
    if waves < 1:
        return 0.0, 0.0
    longer = theta.copy()
    longer[1] *= 1 + STEP
    grown = np.diff(shadow_places(longer, fit.data), axis=1)[:, 0]
    change = float(np.mean((grown - width)[dark])) / cycles[across] / STEP
    edge = ALIKE / max(swept, 1.0)
    height = edge * np.sqrt(2 / waves) / max(change, 1e-9)
    return edge * np.sqrt(6 / waves) / length, min(height, 1.0)
