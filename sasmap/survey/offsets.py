"""Offset between two images of the same sea floor, by masked correlation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from sasmap.arrays import FloatArray

# Correlation of two images of one sea floor, and share of it above which no offset is sought.
ALIKE, IN_PLACE = 0.6, 0.5
# Minimum number of pixels in common (1600 of correlated speckle are 400 independent samples: chance
# reaches 0.2), and offset that is interpolation, pixels.
LEAST, SLIGHT = 1600, 1


def offset_between(first: NDArray[np.floating], second: NDArray[np.floating]) -> FloatArray | None:
    """Find the offset of what two images show, where it is certain.

    Parameters
    ----------
    first, second : ndarray (rows, columns)
        Amplitudes on one lattice; NaN where unknown.

    Returns
    -------
    ndarray (2,) or None
        Rows and columns by which the second image shows the floor too far; None where the images
        agree, or where no offset makes them alike.

    Notes
    -----
    Normalised correlation over the pixels that both have at each offset (Padfield 2012).
    """
    both = np.isfinite(first) & np.isfinite(second)
    if both.sum() < LEAST:
        return None
    in_place = float(np.corrcoef(first[both], second[both])[0, 1])
    if not in_place < IN_PLACE * ALIKE:
        return None
    known = [np.isfinite(v) for v in (first, second)]
    a, b = (
        np.where(k, v - np.mean(v[k]), 0.0) for k, v in zip(known, (first, second), strict=True)
    )
    here, there = (k.astype(float) for k in known)

    def over_offsets(one: FloatArray, other: FloatArray) -> FloatArray:
        return np.asarray(correlate(one, other, method="fft"), float)

    count = np.maximum(np.rint(over_offsets(here, there)), 1.0)
    sums = over_offsets(a, there), over_offsets(here, b)
    spread = [
        np.maximum(s - v**2 / count, 0.0)
        for s, v in zip((over_offsets(a**2, there), over_offsets(here, b**2)), sums, strict=True)
    ]
    level = np.sqrt(spread[0] * spread[1])
    usable = (count >= LEAST) & (level > 1e-9 * level.max())
    like = np.where(usable, over_offsets(a, b) - sums[0] * sums[1] / count, 0.0)
    like = like / np.where(usable, level, 1.0)
    best = np.unravel_index(int(np.argmax(like)), like.shape)
    moved = np.array(second.shape) - 1.0 - np.array(best, float)
    if like[best] < ALIKE or np.abs(moved).max() <= SLIGHT:
        return None
    return np.asarray(moved)
