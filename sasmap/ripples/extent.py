"""Extent of the ripples in a clip, pixel by pixel, and the defects of their crests.

The clip is demodulated at its wave and smoothed over half a wavelength, or more in speckle.
Smoothing halves the amplitude at the edge of a patch, whatever lies beyond: a pixel lies on rippled
floor where the local amplitude exceeds half of that of the ripples. Contrast grows towards low
grazing angles, so amplitudes are divided by the angle from the vertical, as in
`sasmap.ripples.demodulation`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import grey_closing, grey_opening, label
from scipy.special import ndtr

from sasmap.arrays import ComplexArray, FloatArray
from sasmap.ripples.demodulation import (
    SURE,
    BoxSums,
    angles_from_vertical,
    demodulate,
    local_amplitudes,
    windings,
)
from sasmap.ripples.image import Image
from sasmap.ripples.pixels import spread_boxes

# Standard deviations, in wavelengths, of the Gaussians that smooth the amplitude; the smallest is
# used at which the error from speckle is below SURE times the ripples' amplitude.
SMOOTHING = (0.45, 0.65, 0.95, 1.4, 2.0)
# Smoothed amplitude at a straight edge over that of the ripples.
EDGE = 0.5
# Relative standard deviation of the ripples' amplitude from place to place (a choice).
UNEVEN = 0.15
# Smallest area of a gap or a patch, in squared wavelengths (the gap at a fork is smaller).
SPECK = 1.5
# Iterations in which the ripples' amplitude is estimated from the rippled places, enough to
# converge.
ROUNDS = 4


class Extent(NamedTuple):
    """Extent of a clip's ripples.

    Attributes
    ----------
    probability : ndarray (rows, columns)
        Probability that a pixel lies on rippled floor; NaN at invalid pixels.
    fraction : float
        Rippled share of the valid area.
    defects : int
        Number of phase singularities on rippled floor, where crests split or end.
    area : float
        Searched area, m2.
    own : float
        Amplitude of the ripples over the angle from the vertical.
    """

    probability: FloatArray
    fraction: float
    defects: int
    area: float
    own: float

    @property
    def defect_density(self) -> float:
        """Defects per square metre; NaN where no area was searched."""
        return self.defects / self.area if self.area > 0 else float("nan")


def ripple_extent(image: Image, wave: FloatArray, own: float | None = None) -> Extent:
    """Find the extent of the ripples of a wave.

    Parameters
    ----------
    image : Image
    wave : ndarray (2,)
        Wave vector (east, north), cycles/m.
    own : float, optional
        `Extent.own` of the cell in which the ripples were found, if that is another cell.
    """
    boxes = demodulate(image, wave)
    field, probability, own = _local(image, boxes, own)
    probability = _without_specks(probability, boxes.wavelength)
    pixels = np.where(image.valid, spread_boxes(probability, boxes.size, image.shape), np.nan)
    inside = (probability > 0.5) & (boxes.count > 0)
    rippled = pixels[image.valid] > 0.5
    box = (boxes.size * image.pixel_size) ** 2
    corners = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:] & inside[1:, 1:]
    return Extent(
        pixels,
        float(rippled.mean()) if rippled.size else 0.0,
        int((np.abs(windings(field)) & corners).sum()),
        float(corners.sum()) * box,
        own,
    )


def _without_specks(probability: FloatArray, wavelength: float) -> FloatArray:
    """Fill gaps that forks leave, and remove small patches."""
    size = 2 * int(np.ceil(0.5 * wavelength)) + 1
    for morphology, side in ((grey_closing, probability <= 0.5), (grey_opening, None)):
        areas, _ = label(probability > 0.5 if side is None else side)
        small = np.bincount(areas.ravel()) < SPECK * wavelength**2
        small[0] = False
        probability = np.where(small[areas], morphology(probability, (size, size)), probability)
    return probability


def _local(
    image: Image, boxes: BoxSums, given: float | None
) -> tuple[ComplexArray, FloatArray, float]:
    """Smoothed complex amplitude of boxes, probability of ripples, and the ripples' amplitude."""
    filled = boxes.count > 0
    angle = angles_from_vertical(image, boxes.size)
    for sd in SMOOTHING:
        field, level, noise = local_amplitudes(boxes, sd, angle)
        error = np.sqrt(0.5) * noise  # of one component of the amplitude
        own = _own_level(level, boxes.count * filled) if given is None else given
        if float(np.median(error[filled])) < SURE * own:
            break
    spread = np.hypot(error, UNEVEN * EDGE * max(own, 1e-12))
    return field, np.where(filled, ndtr((level - EDGE * own) / spread), 0.0), own


def _own_level(level: FloatArray, weight: FloatArray) -> float:
    """Amplitude of the rippled part: the mean over boxes where it exceeds 0.7 of that mean."""
    energy = weight * level**2
    own = float((energy * level).sum() / max(float(energy.sum()), 1e-300))
    for _ in range(ROUNDS):
        # only boxes away from edges
        inside = weight * (level > 0.7 * own)
        own = float((inside * level).sum() / max(float(inside.sum()), 1e-300))
    return own
