"""The modelled image of a posterior, for comparison with the clip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation, uniform_filter

from sasmap.arrays import BoolArray, FloatArray
from sasmap.ripples.clip import Clip
from sasmap.ripples.demodulation import RIM, closed
from sasmap.ripples.image import Image
from sasmap.ripples.pixels import paint_pixels, spread_boxes
from sasmap.ripples.rendered import Fit, expected_at

# Number of draws that are averaged.
DRAWS = 40
# Window, in pixels, over which the edge of a patch is found: length along crests, and largest
# length across them.
NARROW, WIDEST = 9, 201
# Least share of valid pixels in that window.
FEW = 0.1
# Mean amplitude of speckle over the root of its mean intensity.
RAYLEIGH = float(np.sqrt(np.pi) / 2)


def modelled(clip: Clip, image: Image, fit: Fit, points: FloatArray) -> FloatArray:
    """Posterior mean of a clip's amplitude.

    Parameters
    ----------
    clip : Clip
    image : Image
        Image of the clip.
    fit : Fit
    points : ndarray (chain, draw, COORDINATES)

    Returns
    -------
    ndarray (rows, columns)
        In the clip's units, also in holes of the clip where its geometry is known; NaN where there
        are no ripples or they cannot be modelled. All NaN if the clip is not on a straight lattice.
    """
    result = np.full(clip.amplitude.shape, np.nan)
    if image.shape != clip.amplitude.shape:
        return result
    every = points.reshape(-1, points.shape[-1])
    chosen = every[:: max(len(every) // DRAWS, 1)]
    mean = np.mean([np.sqrt(expected_at(fit, z)[0]) for z in chosen], axis=0)
    phase = fit.phase
    whole = replace(phase, even=phase.both, odd=phase.both)
    geometry = np.isfinite(clip.ground_range) & (clip.ground_range > 0) & (clip.altitude > 0)
    inside = closed(binary_dilation(phase.covered, iterations=RIM))
    known = geometry & phase.pixels(inside)
    cycles, per_pixel = whole.cycles, whole.per_pixel(image)

    reach = fit.data.ground_range
    amplitude = np.asarray(
        paint_pixels(known, clip.ground_range, cycles, per_pixel, reach, mean), float
    )
    trend = np.sqrt(spread_boxes(fit.trend, phase.box, image.shape))
    known &= _borne_out(image, trend, amplitude, known, image.per_pixel(phase.wave))
    result[known] = RAYLEIGH * image.rms * amplitude[known] * trend[known]
    return result


def _borne_out(
    image: Image, trend: FloatArray, above: FloatArray, known: BoolArray, cycles: FloatArray
) -> BoolArray:
    """Mask of pixels where ripples explain the image better than flat floor, within a wavelength.

    The boxes in which ripples were found are coarser than the edges of a rippled patch.
    """
    there = known & image.valid
    square = np.where(there, np.maximum(above, 1e-3) ** 2, 1.0)
    power = np.where(there, image.power / np.maximum(trend, 1e-9) ** 2, 0.0)
    along = int(np.argmax(np.abs(cycles)))  # 0 if the wave runs along rows, 1 along columns
    size = [NARROW, NARROW]
    size[1 - along] = int(np.clip(np.ceil(1 / np.abs(cycles[along])), NARROW, WIDEST))

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(uniform_filter(values, size, mode="constant"))

    seen = mean(there.astype(float))
    share = np.maximum(seen, 1e-9)
    flat = np.log(np.maximum(mean(power) / share, 1e-300))
    rippled = np.log(np.maximum(mean(power / square) / share, 1e-300))
    evidence = flat - rippled - mean(np.log(square)) / share
    return np.asarray((evidence > 0) | (seen < FEW))  # a hole is no evidence against ripples
