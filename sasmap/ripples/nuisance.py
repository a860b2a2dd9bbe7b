"""Parameters that are integrated out of the sampled density, and drawn given the others.

Blur, noise slope, an altitude that is known well, phase and wave number of the image, and in most
clips heights that change over range, change the expected intensity nearly linearly within their
posterior. They are integrated out about the fit, to second order, as the errors of the model are
(:mod:`sasmap.ripples.errors`), and drawn afterwards from their Gaussian given each draw of the
others. Heights of 80 coherent cells have the posterior that they have if these are sampled (90 %
intervals as wide within 10 % in nine of ten cells, medians within 0.08 of their width), for three
quarters of the densities; phase of straight crests and heights over range were sampled in both.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sasmap.arrays import FloatArray, IntArray
from sasmap.ripples.errors import fitted_amplitudes, sharing
from sasmap.ripples.optimise import (
    ALTITUDE,
    BLUR,
    COORDINATES,
    NOISE_SLOPE,
    OFFSET,
    PHASE,
    TREND,
    free_coordinates,
)
from sasmap.ripples.rendered import Fit, expected_at, log_slope
from sasmap.ripples.rendering import (
    Geometry,
    error_gain,
    log_posterior,
    log_priors,
)

# Error of the altitude over the altitude below which it is integrated out: of 40 coherent cells at
# altitudes of 3 to 10 m, with errors of 0.1 m A_H has intervals as wide as if it were sampled, with
# 0.25 and 0.5 m two and three cells with shadow have intervals of 0.2 to 0.7 of that width.
KNOWN_ALTITUDE = 0.02
# Largest difference of the log density a standard deviation from the fit from that of a Gaussian
# for heights that change over range to be integrated out (pipelines/ripples/calibration.py).
GAUSSIAN = 0.15
# Step of the finite difference, in standard deviations of the prior.
STEP = 0.1
# Trials of an altitude: more than one where the prior of A_H is narrow.
TRIALS = 8
# Number of draws from which a function that is nearly linear in the coordinates is learned.
SOME = 100


def integrated_coordinates(fit: Fit) -> IntArray:
    """Return the indices of the coordinates to integrate out.

    An altitude that is not known well moves the edges of shadow by more than is linear; so do some
    heights that change over range.
    """
    geometry = fit.geometry
    known = geometry.altitude_sd < KNOWN_ALTITUDE * geometry.altitude_middle
    level = TREND if not geometry.published and _gaussian(fit, TREND) else ()
    return np.array([OFFSET, PHASE, NOISE_SLOPE, BLUR, *([ALTITUDE] if known else []), *level])


def _gaussian(fit: Fit, which: tuple[int, ...]) -> bool:
    """Whether the density falls as a Gaussian's a standard deviation of some coordinates away.

    The other coordinates follow them.
    """
    peak, free = fit.peaks[0], free_coordinates(fit.geometry)
    here = log_posterior(peak.z, fit.data, fit.geometry)
    for i in np.flatnonzero(np.isin(free, which)):
        step = peak.covariance[i] / np.sqrt(peak.covariance[i, i])
        for side in (-step, step):
            z = peak.z.copy()
            z[free] += side
            if not abs(here - log_posterior(z, fit.data, fit.geometry) - 0.5) < GAUSSIAN:
                return False
    return True


def prior_sd(geometry: Geometry, which: IntArray) -> FloatArray:
    """Return the prior standard deviation of some coordinates."""
    sd = np.ones(COORDINATES)
    sd[[OFFSET, PHASE]] = geometry.wave_sd, geometry.phase_sd
    return np.asarray(sd[which])


def with_integrated(fit: Fit, which: IntArray) -> Fit:
    """Give a fit's histogram some coordinates as further errors, the last ones."""
    sd = prior_sd(fit.geometry, which)
    shapes = np.array([s * log_slope(fit, i, STEP * s) for i, s in zip(which, sd, strict=True)])
    fitted = np.concatenate([fit.data.error_fitted, fit.z[which] / sd])
    errors = np.concatenate([fit.data.errors, shapes])
    return fit._replace(data=sharing(fit.data, errors, fitted, fit.data.error_signal))


def with_drawn(
    points: FloatArray, fit: Fit, which: IntArray, rng: np.random.Generator
) -> FloatArray:
    """Draw the integrated coordinates given draws of the others.

    Parameters
    ----------
    points : ndarray (..., COORDINATES)
        The integrated coordinates are those of the fit.
    fit : Fit
        As :func:`with_integrated` returns it.
    which : ndarray of int
        Indices of the integrated coordinates.
    rng : Generator

    Returns
    -------
    ndarray (..., COORDINATES)
    """
    covariance = error_gain(fit.data)[-which.size :, -which.size :]

    def means(z: FloatArray) -> FloatArray:
        """Mean of each integrated coordinate less the fit's, in standard deviations."""
        return fitted_amplitudes(fit, expected_at(fit, z)[0])[-which.size :]

    every = points.reshape(-1, COORDINATES)
    middle = learned(every, means, np.setdiff1d(free_coordinates(fit.geometry), which))
    left, sd = np.linalg.cholesky(covariance), prior_sd(fit.geometry, which)

    def of_height(z: FloatArray) -> FloatArray:
        """Log prior of A_H, which follows the altitude: all but that of the coordinates drawn."""
        own = 0.5 * np.sum((z[:, which] / sd) ** 2, axis=1)
        return np.asarray(log_priors(z, fit.geometry) + own)

    drawn, level = every, of_height(every)
    for _ in range(TRIALS):
        other = every.copy()
        other[:, which] += sd * (middle + rng.standard_normal(middle.shape) @ left.T)
        reached = of_height(other)
        taken = np.log(rng.random(len(every))) < reached - level
        drawn, level = np.where(taken[:, None], other, drawn), np.where(taken, reached, level)
    return drawn.reshape(points.shape)


def learned(
    points: FloatArray, values: Callable[[FloatArray], FloatArray], used: IntArray
) -> FloatArray:
    """Evaluate at all draws a function that is nearly linear in some coordinates.

    Parameters
    ----------
    points : ndarray (..., COORDINATES)
    values : callable
        Coordinates (COORDINATES,) to values (n,).
    used : ndarray of int
        Indices of the coordinates.

    Returns
    -------
    ndarray (..., n)
        Least-squares regression on SOME of the points.
    """
    every = points.reshape(-1, COORDINATES)
    some = every[:: max(len(every) // SOME, 1)]
    told = np.array([values(z) for z in some])
    design = np.column_stack([some[:, used], np.ones(len(some))])
    line = np.linalg.lstsq(design, told, rcond=None)[0]
    result = every[:, used] @ line[:-1] + line[-1]
    return np.asarray(result.reshape(*points.shape[:-1], -1))
