"""The image that a posterior stands for, beside which the clip can be laid."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, uniform_filter

from sasmap.ripples.clip import Clip
from sasmap.ripples.fit import Fit, expected_at, pulses_at
from sasmap.ripples.image import BoolArray, Image
from sasmap.ripples.pixels import paint_pixels, spread_boxes
from sasmap.ripples.rendering import parameters_at

FloatArray = NDArray[np.float64]

DRAWS = 40
# Amplitude over that of flat sea floor, noise aside, below which there is shadow.
SHADOW = 0.3
# Pixels along crests, and across them at most, over which a patch's edge is told.
NARROW, WIDEST = 9, 201
# Share of pixels that have to be known there.
FEW = 0.1
# Mean amplitude of speckle over the root of its mean intensity.
RAYLEIGH = float(np.sqrt(np.pi) / 2)


class Modelled(NamedTuple):
    """The image that a posterior stands for; (rows, columns), NaN where no ripple is.

    Attributes
    ----------
    amplitude : ndarray
        In the clip's units.
    relief : ndarray
        The same over that of flat sea floor there; 0 in shadow.
    """

    amplitude: FloatArray
    relief: FloatArray


def modelled(clip: Clip, image: Image, fit: Fit, points: FloatArray) -> Modelled:
    """Posterior mean of a clip's amplitude.

    Parameters
    ----------
    clip : Clip
    image : Image
        The clip's.
    fit : Fit
    points : ndarray (chain, draw, COORDINATES)

    Returns
    -------
    Modelled
        Also where the clip has holes but its geometry is known; NaN where no ripple is or none can
        be told. All NaN where the clip is not on a straight lattice.
    """
    result, relief = (np.full(clip.amplitude.shape, np.nan) for _ in range(2))
    if image.shape != clip.amplitude.shape:
        return Modelled(result, relief)
    every = points.reshape(-1, points.shape[-1])
    chosen = every[:: max(len(every) // DRAWS, 1)]
    mean, over, lit = np.mean([_levels(z, fit) for z in chosen], axis=0)
    phase = fit.phase
    whole = replace(phase, even=phase.both, odd=phase.both)
    geometry = np.isfinite(clip.ground_range) & (clip.ground_range > 0) & (clip.altitude > 0)
    known = geometry & phase.pixels(phase.spread_cover(), image.shape)
    cycles, per_pixel = whole.cycles(image.shape), whole.per_pixel(image)

    def paint(pulses: FloatArray) -> FloatArray:
        reach = fit.data.ground_range
        args = known, clip.ground_range, cycles, per_pixel, reach, pulses
        return np.asarray(paint_pixels(*args))

    amplitude = paint(mean)
    trend = np.sqrt(spread_boxes(fit.trend, phase.box, image.shape))
    known &= _borne_out(image, trend, amplitude, known, image.per_pixel(phase.wave))
    dark = paint(lit) < SHADOW
    if not phase.rigid:  # the phase is a field, known to an error
        dark = _as_far_as_it_may_be(dark, phase.error, image.per_pixel(phase.wave))
    relief[known] = np.where(dark, 0.0, paint(over))[known]
    result[known] = RAYLEIGH * image.rms * amplitude[known] * trend[known]
    return Modelled(result, relief)


def _levels(z: FloatArray, fit: Fit) -> FloatArray:
    """Tell amplitude over the local mean's, over flat sea floor's, and without noise.

    (3, blocks, bins)
    """
    means, gains = expected_at(fit, z)
    ripple, geometry = parameters_at(z, fit.geometry), fit.geometry
    ratio = fit.data.ground_range / geometry.range_middle
    floor = (ripple.noise * ratio**ripple.noise_slope / fit.data.trend)[:, None]
    flat = (gains / np.maximum(pulses_at(fit, z)[2], 1e-3))[:, None]
    return np.asarray(np.sqrt([means, means / (flat + floor), np.maximum(means - floor, 0) / flat]))


def _as_far_as_it_may_be(dark: BoolArray, error: float, cycles: FloatArray) -> BoolArray:
    """Widen shadow, across the crests, by twice the error of the field of phases (rad)."""
    along = int(np.argmax(np.abs(cycles)))  # of columns and rows, those that crests run across
    pixels = error / (2 * np.pi * np.abs(cycles[along]))
    size = 2 * int(np.ceil(2 * pixels)) + 1
    return np.asarray(maximum_filter1d(dark, size, axis=1 - along, mode="nearest"))


def _borne_out(
    image: Image, trend: FloatArray, above: FloatArray, known: BoolArray, cycles: FloatArray
) -> BoolArray:
    """Where ripples tell the image better than flat sea floor does, over a wavelength around.

    The boxes in which ripples were found are coarser than the edges of a rippled patch.
    """
    there = known & image.valid
    square = np.where(there, np.maximum(above, 1e-3) ** 2, 1.0)
    power = np.where(there, image.power / np.maximum(trend, 1e-9) ** 2, 0.0)
    along = int(np.argmax(np.abs(cycles)))  # of columns and rows, those that crests run across
    size = [NARROW, NARROW]
    size[1 - along] = int(np.clip(np.ceil(1 / np.abs(cycles[along])), NARROW, WIDEST))

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(uniform_filter(values, size, mode="constant"))

    seen = mean(there.astype(float))
    share = np.maximum(seen, 1e-9)
    flat = np.log(np.maximum(mean(power) / share, 1e-300))
    rippled = np.log(np.maximum(mean(power / square) / share, 1e-300))
    evidence = flat - rippled - mean(np.log(square)) / share
    return np.asarray((evidence > 0) | (seen < FEW))  # a hole tells nothing against them
