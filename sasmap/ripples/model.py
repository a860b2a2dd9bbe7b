"""The image that a posterior stands for, beside which the clip can be laid."""

from __future__ import annotations

from dataclasses import replace

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


def modelled_amplitude(clip: Clip, image: Image, fit: Fit, draws: FloatArray) -> FloatArray:
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
    ndarray (rows, columns)
        In the clip's units, also where the clip has holes but its geometry is known; NaN where no
        ripple is or none can be told. All NaN where the clip is not on a straight lattice.
    """
    result = np.full(clip.amplitude.shape, np.nan)
    if image.shape != clip.amplitude.shape:
        return result
    every = draws.reshape(-1, draws.shape[-1])
    chosen = every[:: max(len(every) // DRAWS, 1)]
    mean = np.mean([np.sqrt(pulses(theta, fit.data)[0]) for theta in chosen], axis=0)
    phase = fit.phase
    whole = replace(phase, even=phase.both, odd=phase.both)
    geometry = np.isfinite(clip.ground_range) & (clip.ground_range > 0) & (clip.altitude > 0)
    known = geometry & phase.pixels(phase.spread_cover(), image.shape)
    plan, _, _ = fold_plan(image, whole, fit.reference)
    amplitude = unfold_pixels(known, whole.cycles(image.shape), plan, mean)
    trend = np.sqrt(spread_boxes(fit.trend, phase.box, image.shape))
    result[known] = RAYLEIGH * image.rms * amplitude[known] * trend[known]
    return result
