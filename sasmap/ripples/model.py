"""The image that a posterior stands for, beside which the clip can be laid."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.clip import Clip
from sasmap.ripples.fit import Fit
from sasmap.ripples.fold import fold_plan
from sasmap.ripples.image import Image
from sasmap.ripples.kernel import pulses
from sasmap.ripples.pixels import spread_boxes, unfold_pixels

FloatArray = NDArray[np.float64]

DRAWS = 40
# Mean amplitude of speckle over the root of its mean intensity.
RAYLEIGH = float(np.sqrt(np.pi) / 2)


class Modelled(NamedTuple):
    """The image that a posterior stands for; (rows, columns), NaN where no ripple is.

    Attributes
    ----------
    amplitude : ndarray
        In the clip's units.
    relief : ndarray
        The same over that of flat sea floor there; 0 in shadow but for noise.
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
    mean, over = np.mean([_both(theta, fit) for theta in chosen], axis=0)
    phase = fit.phase
    whole = replace(phase, even=phase.both, odd=phase.both)
    geometry = np.isfinite(clip.ground_range) & (clip.ground_range > 0) & (clip.altitude > 0)
    known = geometry & phase.pixels(phase.spread_cover(), image.shape)
    plan, _, _ = fold_plan(image, whole, fit.reference)
    cycles = whole.cycles(image.shape)
    amplitude = unfold_pixels(known, cycles, plan, mean)
    relief[known] = unfold_pixels(known, cycles, plan, over)[known]
    trend = np.sqrt(spread_boxes(fit.trend, phase.box, image.shape))
    result[known] = RAYLEIGH * image.rms * amplitude[known] * trend[known]
    return Modelled(result, relief)


def _both(theta: FloatArray, fit: Fit) -> FloatArray:
    """Amplitude of blocks and bins, and that over flat sea floor's (2, blocks, bins)."""
    pulse, _, gain = pulses(theta, fit.data)
    flat = gain[:, None] * (fit.data.flat + np.exp(theta[4]))
    return np.asarray(np.sqrt(np.stack([pulse, pulse / np.maximum(flat, 1e-300)])))
