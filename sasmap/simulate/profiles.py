"""Crest profiles of simulated ripples; the height from crest to trough is 2 A_H in each."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from sasmap.arrays import FloatArray

CrestProfile = Literal["sine", "stokes", "peaked", "asymmetric"]
# Profiles that the published physics can render.
PUBLISHED_PROFILES = ("sine", "stokes", "peaked")


def crest(
    phase: ArrayLike, steepness: ArrayLike, profile: CrestProfile, asymmetry: float = 0.0
) -> FloatArray:
    """Sea-floor height relative to A_H.

    Parameters
    ----------
    phase : array_like
        Ripple phase, rad; the crest is at pi/2 (asymmetric: where phase + a sin(phase) is).
    steepness : array_like
        2 pi f A_H, on which the Stokes profile depends.
    profile : {"sine", "stokes", "peaked", "asymmetric"}
        sin p; second-order Stokes, sin p - pi f A_H cos 2p; 2 ((1 + sin p) / 2)^2 - 1 with narrow
        crests; sin(p + a sin p), which rises more steeply along the crest normal than it falls.
    asymmetry : float
        a of the asymmetric profile, below 1.

    Returns
    -------
    ndarray
        h / A_H.
    """
    phase = np.asarray(phase, float)
    sine = np.sin(phase)
    if profile == "sine":
        return np.asarray(sine)
    if profile == "stokes":
        return np.asarray(sine - 0.5 * np.asarray(steepness) * np.cos(2 * phase))
    if profile == "asymmetric":
        return np.asarray(np.sin(phase + asymmetry * sine))
    return np.asarray(0.5 * (1 + sine) ** 2 - 1)
