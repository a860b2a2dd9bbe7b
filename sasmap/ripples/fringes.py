"""Gain that varies over range: bands along the track whose spacing follows the grazing angle.

Lobes of a vertical beam pattern and the fringes of multipath (Lloyd's mirror) are more or less
evenly spaced in angle: on the sea floor their spacing grows with the square of the range. Ripples
are evenly spaced in range. Over a clip from 30 to 45 m the spacing of bands doubles.
"""

from __future__ import annotations

import numpy as np

from sasmap.arrays import BoolArray, FloatArray
from sasmap.ripples.image import Image

# Largest angle between the normal of bands and the look, degrees: bands run along the track, and
# the direction of four waves is known to within a degree or two.
ALONG = 3.0
# Least correlation of the profiles of the two halves of the track, corrected for speckle: nine in
# ten simulated clips of bands have 0.8 and more, forked ripples that otherwise pass for bands 0.4
# and 0.5 (pipelines/ripples/lookalikes.py, also for the next).
ALIKE = 0.7
# Least share of the halves' covariance that one wave over the grazing angle explains, and largest
# share that one over range explains, relative to it. Bands whose spacing changes by half or more
# have a share of 0.87 and more, and a relative share of at most 0.4 in three of four clips; ripples
# with crests along the track have a relative share of 1.2 and more, with wavelengths that drift by
# 15 % one of 0.86 and more.
EXPLAINED, IN_RANGE = 0.8, 0.75
# Pixels per bin of range, and step of the number of waves (choices: a sixth of the shortest wave
# that is detected well, and a tenth of the width of a peak).
BIN, STEP = 4.0, 0.1
# Smallest and largest number of waves in a clip that is tried: fewer are trends, and bins are too
# wide for more.
FEWEST, MOST = 3.0, 15.0


def follows_grazing(image: Image, flat: FloatArray, normals: FloatArray) -> bool:
    """Whether waves are bands over range whose spacing follows the grazing angle.

    Parameters
    ----------
    image : Image
    flat : ndarray (rows, columns)
        Amplitude over its trend, minus 1; 0 where not valid.
    normals : ndarray (waves, 2)
        Wave vectors (east, north), cycles/m.

    Returns
    -------
    bool
        False where the clip spans too little range to decide.
    """
    cosine = np.abs(normals @ image.look) / np.hypot(normals[:, 0], normals[:, 1])
    if not np.all(cosine > np.cos(np.radians(ALONG))):
        return False
    known = image.valid & np.isfinite(image.ground_range) & np.isfinite(image.altitude)
    if not known.any():
        return False
    reach, profiles, pixels = _profiles(image, flat, known)
    weight = np.sqrt(pixels[0] * pixels[1])
    if np.count_nonzero(weight) < MOST:
        return False
    share = weight / weight.sum()
    apart = profiles - (profiles @ share)[:, None]
    speckle = float((flat[known] ** 2).mean()) / np.maximum(pixels, 1.0)
    if not _alike(apart, speckle, share):
        return False
    altitude = float(np.median(image.altitude[known]))
    by_angle = _explained(np.arctan2(reach, altitude), apart, share)
    return by_angle > EXPLAINED and _explained(reach, apart, share) < IN_RANGE * by_angle


def _alike(apart: FloatArray, speckle: FloatArray, share: FloatArray) -> bool:
    """Whether two profiles (2, bins) agree, given the variances that speckle adds to them."""
    own = (apart**2 - speckle) @ share
    common = float(share @ (apart[0] * apart[1]))
    return bool(own.min() > 0 and common > ALIKE * np.sqrt(own[0] * own[1]))


def _profiles(
    image: Image, flat: FloatArray, known: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean profiles over range of the two halves of the track.

    Returns ranges (bins,), m, and the profiles and numbers of pixels of both, (2, bins).
    """
    along = image.project(np.array([-image.look[1], image.look[0]]))
    first = along < np.median(along[known])
    near, step = float(image.ground_range[known].min()), BIN * image.pixel_size
    number = np.where(known, (image.ground_range - near) / step, 0.0).astype(np.int64)
    bins = int(number.max()) + 1
    halves = (known & first, known & ~first)
    pixels = np.array([np.bincount(number[h], minlength=bins) for h in halves], float)
    total = np.array([np.bincount(number[h], flat[h], bins) for h in halves])
    reach = np.asarray(near + step * (np.arange(bins) + 0.5))
    return reach, total / np.maximum(pixels, 1.0), pixels


def _explained(place: FloatArray, apart: FloatArray, share: FloatArray) -> float:
    """Share of the covariance of two profiles (2, bins) that one wave over `place` explains.

    `share` (bins,) weighs the bins. Speckle and crests that are not straight do not contribute to
    the covariance.
    """
    common = float(share @ (apart[0] * apart[1]))
    used = place[share > 0]
    scaled = (place - used.min()) / np.ptp(used)
    waves = np.exp(-2j * np.pi * np.arange(FEWEST, MOST, STEP)[:, None] * scaled)
    one, other = (waves @ (share * half) for half in apart)
    return float(2 * (one * other.conj()).real.max() / common)
