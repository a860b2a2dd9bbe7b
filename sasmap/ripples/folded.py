"""What the compiled code of :mod:`sasmap.ripples.kernel` reads.

Parameters theta, in this order: f (cycles/m), A_H (m), azimuth of the crest normal (rad), phase,
log n0 (noise floor over the flat sea floor's intensity), log of the blur (rad). The phase is the
ripple's at the clip's centre, relative to that of the fold (rad); with a phase field, whose phase
is that of the image's fundamental, what is left of it. The blur is by how much crests stray from
the fold's phase: with a field its error, else what little straight crests stray.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class FoldData(NamedTuple):
    """What the compiled likelihood reads: arrays (blocks, bins) of phase or (blocks,).

    Attributes
    ----------
    pixels, total : ndarray (blocks, bins)
        Pixels that are not saturated, and sum of intensity over the clip's mean.
    log_mean : ndarray (blocks, bins)
        Log of total over pixels: bins that weigh less than others must be compared with a perfect
        model of themselves.
    phase, half : ndarray (blocks, bins)
        Mean phase of a bin's pixels and half the width over which they lie, rad.
    cosine, sine : ndarray (blocks, bins)
        Of that phase.
    ahead : ndarray (blocks, bins)
        Mean place along the look from the block's, m.
    farther, steeper, flat : ndarray (blocks, bins)
        Relative to the block: log of the ray's slope, tilt (below), and flat sea floor's intensity.
    dither : ndarray (blocks, bins)
        Weight of a bin that a shadow's edge crosses.
    leak : float
        Share of a bin's pixels that lie beyond its width on each side.
    guard : float
        Phase beyond a shadow's edge over which that weight grows to 1, rad.
    reach, altitude, tilt : ndarray (blocks,)
        Ground range and altitude, m, and pi/2 less the grazing angle, rad.
    spread : ndarray (blocks,)
        Half the width of log slope within a block at one phase.
    along, across : ndarray (blocks,)
        Mean place from the clip's centre along and across the look, m.
    group : ndarray of int (blocks,)
        Blocks, in order, that share a gain.
    lagging : ndarray (blocks,)
        Weights with which a straight line is fitted to a block's values, 1/m.
    base : ndarray (2,)
        Wave vector of the fold along and across the look, cycles/m.
    wave, wave_precision : ndarray (2,)
        What the phases alone say about that wave vector, and its precision, (m/cycle)^2.
    look : float
        Azimuth of the look, rad.
    table : ndarray
        Of :func:`sasmap.ripples.shadow.shadow_table`.
    table_steepness : float
        Its largest steepness.
    blur, blur_bounds : ndarray (2,)
        Mean of the log of the blur, and its precision; least and largest.
    power : float
        One over the noise factor.
    profile, shadow, field : int
        Which profile; whether shadow falls (2 by the crest rule); whether there is a phase field.
    """

    pixels: FloatArray
    total: FloatArray
    log_mean: FloatArray
    phase: FloatArray
    half: FloatArray
    cosine: FloatArray
    sine: FloatArray
    ahead: FloatArray
    farther: FloatArray
    steeper: FloatArray
    flat: FloatArray
    dither: FloatArray
    leak: float
    guard: float
    reach: FloatArray
    altitude: FloatArray
    tilt: FloatArray
    spread: FloatArray
    along: FloatArray
    across: FloatArray
    group: NDArray[np.int64]
    lagging: FloatArray
    base: FloatArray
    wave: FloatArray
    wave_precision: FloatArray
    look: float
    table: FloatArray
    table_steepness: float
    blur: FloatArray
    blur_bounds: FloatArray
    power: float
    profile: int
    shadow: int
    field: int


class PriorData(NamedTuple):
    """Truncated Gaussian of (f, A_H, azimuth) as the compiled code reads it."""

    mean: FloatArray
    precision: FloatArray
    lower: FloatArray
    upper: FloatArray


class Proposal(NamedTuple):
    """A frozen proposal: the density of a burn-in population, and steps between its members.

    Attributes
    ----------
    members : ndarray (n, SIZE)
        The population.
    white : ndarray (n, SIZE)
        Centres of the kernels: the same, less `centre`, in units of `factor`, and drawn together
        so that kernels do not widen the whole.
    centre : ndarray (SIZE,)
    factor : ndarray (SIZE, SIZE)
        Lower Cholesky factor of the population's covariance.
    width : float
        Of the kernel that each member is spread by, in units of `factor`.
    """

    members: FloatArray
    white: FloatArray
    centre: FloatArray
    factor: FloatArray
    width: float
