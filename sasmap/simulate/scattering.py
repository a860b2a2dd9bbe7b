"""Sonar amplitude of a rippled sea floor: cross section, slopes, shadow (ZC 1-4).

All functions take arrays that broadcast, angles in radians and lengths in metres.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from sasmap.arrays import BoolArray, FloatArray
from sasmap.ripples.published import SIGMA_VARIANCE

ProfileName = Literal["sine", "stokes", "peaked"]


def cross_section(grazing: ArrayLike) -> FloatArray:
    """Scattering cross section sigma_s: Gaussian density about normal incidence.

    Parameters
    ----------
    grazing : array_like
        Grazing angle, rad.

    Returns
    -------
    ndarray
        N(grazing; pi/2, pi/3), 1/rad (ZC 3.2.3).
    """
    offset = np.asarray(grazing, float) - np.pi / 2
    norm = np.sqrt(2 * np.pi * SIGMA_VARIANCE)
    return np.asarray(np.exp(-(offset**2) / (2 * SIGMA_VARIANCE)) / norm)


def profile_slope(phase: ArrayLike, steepness: ArrayLike, profile: ProfileName) -> FloatArray:
    """Return the phase derivative of the profile's :func:`~sasmap.simulate.profiles.crest`.

    Times 2 pi f A_H it is the slope.
    """
    phase = np.asarray(phase, float)
    cosine = np.cos(phase)
    if profile == "sine":
        return np.asarray(cosine)
    if profile == "stokes":
        return np.asarray(cosine + np.asarray(steepness) * np.sin(2 * phase))
    return np.asarray((1 + np.sin(phase)) * cosine)


def steepest(steepness: ArrayLike, profile: ProfileName) -> FloatArray:
    """Largest value of :func:`profile_slope` over a wavelength; the smallest is its negative."""
    steepness = np.asarray(steepness, float)
    if profile == "sine":
        return np.ones_like(steepness)
    if profile == "peaked":
        return np.full_like(steepness, 0.75 * np.sqrt(3.0))
    # cos p + e sin 2p is extreme where 4 e sin^2 p + sin p - 2 e = 0
    root = np.sqrt(1 + 32 * steepness**2)
    sine = 4 * steepness / (1 + root)
    return np.asarray(np.sqrt(1 - sine**2) * (1 + 2 * steepness * sine))


def lit_amplitude(
    grazing: ArrayLike,
    slope: ArrayLike,
    extreme: ArrayLike,
    steepness: ArrayLike,
) -> FloatArray:
    """Scattering amplitude a* of sea floor that is not in shadow.

    Parameters
    ----------
    grazing : array_like
        theta_0 = atan2(altitude, ground range), rad.
    slope : array_like
        :func:`profile_slope` at the point, signed along the look.
    extreme : array_like
        :func:`steepest` of the profile: the largest value of `slope`.
    steepness : array_like
        2 pi f A_H cos(alpha), at least 0: steepness of the profile along the look.

    Returns
    -------
    ndarray
        sigma_s(theta_0) + [sigma_s(theta_max) - sigma_s(theta_min)] g / (g_max - g_min)
        (ZC 3; the mean slope is zero for all three profiles).
    """
    extreme = np.asarray(extreme, float)
    slope_angle = np.arctan(np.asarray(steepness) * extreme)
    grazing = np.asarray(grazing, float)
    span = cross_section(grazing + slope_angle) - cross_section(grazing - slope_angle)
    return np.asarray(cross_section(grazing) + span * np.asarray(slope) / (2 * extreme))


def shadow_line_of_sight(
    height: ArrayLike, ground_range: ArrayLike, altitude: ArrayLike
) -> BoolArray:
    """Find the points that a ray from the sonar cannot reach: reference method for any profile.

    Parameters
    ----------
    height : array_like (..., n)
        Sea-floor height h, m, along the look, nearest point first.
    ground_range : array_like (..., n)
        Increasing along the last axis and above 0, m.
    altitude : array_like (..., n)
        Height of the sonar above h = 0, m.

    Returns
    -------
    ndarray of bool (..., n)
        True where an earlier point hides this one: (h - altitude) / range below its running
        maximum (docs/science.md). Start the arrays a wavelength before the first point of interest.
    """
    rise = (np.asarray(height, float) - altitude) / np.asarray(ground_range, float)
    return np.asarray(rise < np.maximum.accumulate(rise, axis=-1))


def shadow_crest_rule(
    phase: ArrayLike,
    ground_range: ArrayLike,
    altitude: ArrayLike,
    frequency: ArrayLike,
    height: ArrayLike,
) -> BoolArray:
    """Find shadow by the published rule: a straight ray over the preceding crest.

    Parameters
    ----------
    phase : array_like
        Ripple phase of the point along the look, rad.
    ground_range, altitude : array_like
        m.
    frequency : array_like
        Along the look, f cos(alpha), cycles/m, above 0.
    height : array_like
        A_H, m.

    Returns
    -------
    ndarray of bool
        ZC 4 with the distance to the preceding crest in place of its misprinted g. Shadow starts at
        about 1.38 times the range at which it does by line of sight.
    """
    phase = np.asarray(phase, float)
    ground_range = np.asarray(ground_range, float)
    distance = np.mod(phase - np.pi / 2, 2 * np.pi) / (2 * np.pi * np.asarray(frequency))
    behind = (distance > 0) & (distance < ground_range)
    gap = np.where(behind, ground_range - distance, np.inf)
    ray = np.asarray(height) - np.asarray(altitude) * distance / gap
    return np.asarray(behind & (ray >= np.asarray(height) * np.sin(phase)))
