"""The image that a posterior stands for, beside which the clip can be laid."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, uniform_filter

from sasmap.ripples.clip import Clip
from sasmap.ripples.fit import Fit
from sasmap.ripples.fold import fold_plan
from sasmap.ripples.image import BoolArray, Image
from sasmap.ripples.kernel import pulses
from sasmap.ripples.pixels import spread_boxes, unfold_pixels

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


def modelled(clip: Clip, image: Image, fit: Fit, draws: FloatArray) -> Modelled:
    """Posterior mean of a clip's amplitude.

    Parameters
    ----------
    clip : Clip
    image : Image
        The clip's.
    fit : Fit
    draws : ndarray (chain, draw, SIZE)

    Returns
    -------
    Modelled
        Also where the clip has holes but its geometry is known; NaN where no ripple is or none can
        be told. All NaN where the clip is not on a straight lattice.
    """
    result, relief = (np.full(clip.amplitude.shape, np.nan) for _ in range(2))
    if image.shape != clip.amplitude.shape:
        return Modelled(result, relief)
    every = draws.reshape(-1, draws.shape[-1])
    chosen = every[:: max(len(every) // DRAWS, 1)]
    mean, over, lit = np.mean([_levels(theta, fit) for theta in chosen], axis=0)
    phase = fit.phase
    whole = replace(phase, even=phase.both, odd=phase.both)
    geometry = np.isfinite(clip.ground_range) & (clip.ground_range > 0) & (clip.altitude > 0)
    known = geometry & phase.pixels(phase.spread_cover(), image.shape)
    plan, _, _ = fold_plan(image, whole, fit.reference)
    cycles = whole.cycles(image.shape)
    amplitude = unfold_pixels(known, cycles, plan, mean)
    above = unfold_pixels(known, cycles, plan, over)
    trend = np.sqrt(spread_boxes(fit.trend, phase.box, image.shape))
    known &= _borne_out(image, trend, above, known, image.per_pixel(phase.wave))
    dark = unfold_pixels(known, cycles, plan, lit) < SHADOW
    if fit.reference is None:  # the phase is a field, known to an error
        dark = _as_far_as_it_may_be(dark, np.exp(chosen[:, 5].mean()), image.per_pixel(phase.wave))
    relief[known] = np.where(dark, 0.0, above)[known]
    result[known] = RAYLEIGH * image.rms * amplitude[known] * trend[known]
    return Modelled(result, relief)


def _levels(theta: FloatArray, fit: Fit) -> FloatArray:
    """Amplitude of blocks and bins, that over flat sea floor's, and that without noise.

    (3, blocks, bins)
    """
    pulse, _, gain = pulses(theta, fit.data)
    noise = np.exp(theta[4])
    over = pulse / np.maximum(gain[:, None] * (fit.data.flat + noise), 1e-300)
    lit = np.maximum(pulse / gain[:, None] - noise, 0.0) / np.maximum(fit.data.flat, 1e-300)
    return np.asarray(np.sqrt(np.stack([pulse, over, lit])))


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
