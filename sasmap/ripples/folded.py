"""What the compiled code of :mod:`sasmap.ripples.kernel` reads.

Parameters theta, in this order: f (cycles/m), A_H (m), azimuth of the crest normal (rad), phase
(rad), log n0 (noise floor over the flat sea floor's intensity), and the blur.

Where crests are straight, the phase is the ripple's at the clip's centre, and the blur is how many
pixels behind its place the beginning of shadow is seen. With a phase field, whose phase is that of
the image's fundamental, the phase is what is left of it, and the blur the log of the field's error,
rad.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class FoldData(NamedTuple):
    """A folded clip: arrays (blocks, bins) of phase, (blocks,) or (strips,).

    Strips lie behind each other along the look; each has one geometry, and consists of as many
    blocks, side by side across the look, one after the other in the arrays.

    Attributes
    ----------
    known, total : ndarray (blocks, bins)
        Pixels in light that are not saturated, and sum of intensity over the clip's mean.
    cosine, sine : ndarray (blocks, bins)
        Of the mean phase of a bin's pixels at the reference (below).
    ahead, steeper, flat : ndarray (blocks, bins)
        Mean place along the look from the block's, m; tilt (below) beyond the strip's; flat sea
        floor's intensity over the clip's mean of it.
    dark : ndarray (blocks, 2)
        Pixels that are not saturated, and total intensity, of what lies in shadow.
    edges : ndarray (n, EDGE_PARTS)
        Pixels near an edge of shadow (:func:`sasmap.ripples.pixels.fold_pixels`), by blocks.
    edge_start : ndarray of int (blocks + 1,)
        Where each block's begin among them.
    edge_sd : float
        How far from its place an edge of shadow may be seen at a pixel, cycles.
    along, across : ndarray (blocks,)
        Mean place from the clip's centre along and across the look, m.
    reach, altitude, tilt, spread : ndarray (strips,)
        Ground range and altitude, m; pi/2 less the grazing angle, rad; half the width of the log of
        the ray's slope.
    group : ndarray of int (strips,)
        Strips, in order, that share a gain.
    lagging : ndarray (strips,)
        Weights with which a straight line is fitted to a strip's values, 1/m.
    zero : float
        Ripple phase, rad, at the first bin's beginning, at the reference.
    reference : ndarray (3,)
        Phase at the clip's centre, rad, and wave vector along and across the look, cycles/m, that
        pixels were folded by.
    wave, wave_precision : ndarray (2,)
        What a field's phases alone say about the wave vector, and its precision, (m/cycle)^2.
    look : float
        Azimuth of the look, rad.
    table : ndarray
        Of :func:`sasmap.ripples.shadow.shadow_table`.
    table_steepness : float
        Its largest steepness.
    blur, blur_bounds : ndarray (2,)
        Mean of the blur, and its precision; least and largest.
    pixel : float
        Wavelengths a pixel.
    power : float
        One over the noise factor.
    profile, shadow, field, fine : int
        Which profile; whether shadow falls (2 by the crest rule); whether there is a phase field;
        the how-manieth fold it is whose bins follow the edges of shadow, 0 where they do not.
    """

    known: FloatArray
    total: FloatArray
    cosine: FloatArray
    sine: FloatArray
    ahead: FloatArray
    steeper: FloatArray
    flat: FloatArray
    dark: FloatArray
    edges: FloatArray
    edge_start: NDArray[np.int64]
    edge_sd: float
    along: FloatArray
    across: FloatArray
    reach: FloatArray
    altitude: FloatArray
    tilt: FloatArray
    spread: FloatArray
    group: NDArray[np.int64]
    lagging: FloatArray
    zero: float
    reference: FloatArray
    wave: FloatArray
    wave_precision: FloatArray
    look: float
    table: FloatArray
    table_steepness: float
    blur: FloatArray
    blur_bounds: FloatArray
    pixel: float
    power: float
    profile: int
    shadow: int
    field: int
    fine: int


class PriorData(NamedTuple):
    """Truncated Gaussian of (f, A_H, azimuth), up to a steepness, as the compiled code reads it."""

    mean: FloatArray
    precision: FloatArray
    lower: FloatArray
    upper: FloatArray
    steepest: float


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
