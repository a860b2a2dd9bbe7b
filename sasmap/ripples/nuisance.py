"""Parameters that are integrated out of the sampled density, and drawn given the others.

Blur, noise slope, an altitude that is known well, and phase and wave number of the image change the
expected intensity nearly linearly within their posterior. They are integrated out about the fit, to second order, as the errors of the model are
(:mod:`sasmap.ripples.errors`), and drawn afterwards from their Gaussian given each draw of the
others. Heights of 80 coherent cells have the posterior that they have if these are sampled (90 %
intervals as wide within 10 % in nine of ten cells, medians within 0.08 of their width), for three
quarters of the densities.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sasmap.ripples.errors import fitted_amplitudes, sharing
from sasmap.ripples.optimise import (
    COORDINATES,
    OFFSET,
    PHASE,
    integrated_coordinates,
    sampled_coordinates,
)
from sasmap.ripples.rendered import Fit, expected_at, log_change
from sasmap.ripples.rendering import (
    Geometry,
    error_gain,
    log_priors,
)

FloatArray = NDArray[np.float64]

# Step of the finite difference, in standard deviations of the prior.
STEP = 0.1
# Trials of an altitude: more than one where the prior of A_H is narrow.
TRIALS = 8
# Number of draws from which a function that is nearly linear in the coordinates is learned.
SOME = 100


def prior_sd(geometry: Geometry) -> FloatArray:
    """Return the prior standard deviation of the integrated coordinates, (integrated,)."""
    sd = np.ones(COORDINATES)
    sd[[OFFSET, PHASE]] = geometry.wave_sd, geometry.phase_sd
    return np.asarray(sd[integrated_coordinates(geometry)])


def with_integrated(fit: Fit) -> Fit:
    """Give a fit's histogram the integrated coordinates as further errors, the last ones."""
    which, sd = integrated_coordinates(fit.geometry), prior_sd(fit.geometry)
    shapes = np.array([log_change(fit, i, STEP * s) / STEP for i, s in zip(which, sd, strict=True)])
    fitted = np.concatenate([fit.data.error_fitted, fit.z[which] / sd])
    errors = np.concatenate([fit.data.errors, shapes])
    return fit._replace(data=sharing(fit.data, errors, fitted, fit.data.error_signal))


def with_drawn(points: FloatArray, fit: Fit, rng: np.random.Generator) -> FloatArray:
    """Draw the integrated coordinates given draws of the others.

    Parameters
    ----------
    points : ndarray (..., COORDINATES)
        The integrated coordinates are those of the fit.
    fit : Fit
        As :func:`with_integrated` returns it.
    rng : Generator

    Returns
    -------
    ndarray (..., COORDINATES)
    """
    which = integrated_coordinates(fit.geometry)
    covariance = error_gain(fit.data)[-which.size :, -which.size :]

    def means(z: FloatArray) -> FloatArray:
        """Mean of each integrated coordinate less the fit's, in standard deviations."""
        return fitted_amplitudes(fit, expected_at(fit, z)[0])[-which.size :]

    every = points.reshape(-1, COORDINATES)
    middle = learned(every, means, sampled_coordinates(fit.geometry))
    left, sd = np.linalg.cholesky(covariance), prior_sd(fit.geometry)

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
    points: FloatArray, values: Callable[[FloatArray], FloatArray], used: NDArray[np.int64]
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
