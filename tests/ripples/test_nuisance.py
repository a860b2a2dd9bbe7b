"""Parameters that are integrated out have the posterior that they would have if sampled."""

import numpy as np
import pytest

from sasmap.ripples.errors import sharing, with_errors
from sasmap.ripples.nuisance import learned, with_drawn, with_integrated
from sasmap.ripples.optimise import (
    ALTITUDE,
    BLUR,
    COORDINATES,
    HEIGHT,
    NOISE_SLOPE,
    OFFSET,
    PHASE,
    fisher_scoring,
    free_coordinates,
    integrated_coordinates,
    sampled_coordinates,
)
from sasmap.ripples.rendering import log_posterior, log_posteriors, named_parameters
from sasmap.ripples.sampler import mixture_of_peaks, sample
from tests.ripples.engine import BINS, LAMBERT, fit_of, fitted_cell

KNOWN_LAW = np.array([*LAMBERT, np.nan, np.nan])


def known_law(turn=0.0, **changes):
    """Fit to a coherent cell whose law is known."""
    fit = fitted_cell(3, turn)[2]
    where = fit.geometry._replace(fixed=KNOWN_LAW, **changes)
    fit = fit._replace(geometry=where, peaks=[fisher_scoring(fit.z, fit.data, where)])
    return with_errors(fit)


@pytest.mark.parametrize("field", [False, True])
def test_the_density_is_that_at_the_best_value_of_what_is_integrated_out(field):
    plain = fit_of(
        4, np.ones((4, BINS)), not field, height=0.08, altitude_sd=0.1, bent=field
    )
    plain, where = with_errors(plain), plain.geometry
    whole, which = with_integrated(plain).data, integrated_coordinates(where)
    free, given, fixed = [], [], []
    for step in (-0.005, 0.0, 0.005):
        z = plain.z.copy()
        z[HEIGHT] += step
        fixed.append(log_posterior(z, plain.data, where))
        given.append(log_posterior(z, whole, where))
        free.append(fisher_scoring(z, plain.data, where, free=which).level)
    free, given, fixed = (np.subtract(v[1], v)[[0, 2]] for v in (free, given, fixed))
    if not field:
        assert (fixed > 1.5 * free).all()
    np.testing.assert_allclose(given, free, rtol=0.2)


def sampled(fit, which, data, rng):
    """Draws (chain, draw, COORDINATES) of some coordinates, the others at the fit."""
    free = free_coordinates(fit.geometry)
    covariance = fit.peaks[0].covariance[np.ix_(*[np.isin(free, which)] * 2)]

    def whole(points):
        every = np.broadcast_to(fit.z, (*points.shape[:-1], COORDINATES)).copy()
        every[..., which] = points
        return every

    chains, _ = sample(
        lambda points: log_posteriors(whole(points), data, fit.geometry),
        mixture_of_peaks([(fit.z[which], covariance, 0.0)]),
        lambda draws: draws.shape[1] >= 2000,
        4,
        4000,
        rng,
    )
    return whole(chains.draws)


def test_an_altitude_that_is_drawn_has_the_posterior_of_one_that_is_sampled():
    fit, rng = known_law(altitude_sd=0.09), np.random.default_rng(1)
    where, whole = fit.geometry, with_integrated(fit)
    data = whole.data
    free = np.append(sampled_coordinates(where), ALTITUDE)
    known = sampled(fit, free, sharing(data, data.errors[:-1], data.error_fitted[:-1], 1.0), rng)
    some = sampled(fit, free[:-1], data, rng)
    assert (some[..., ALTITUDE] == fit.z[ALTITUDE]).all()
    known, told = (np.concatenate(list(v)) for v in (known, with_drawn(some, whole, rng)))
    mean, sd = known[:, free].mean(axis=0), known[:, free].std(axis=0)
    assert np.abs((told[:, free].mean(axis=0) - mean) / sd).max() < 0.15
    np.testing.assert_allclose(told[:, free].std(axis=0), sd, rtol=0.15)
    # height by shadow follows the altitude
    tied = []
    for points in (known, told):
        named = named_parameters(points, where)
        tied.append(np.corrcoef(named["height"], named["altitude_scale"])[0, 1])
    assert tied[0] > 0.3
    assert tied[1] == pytest.approx(tied[0], abs=0.1)


def test_draws_stay_within_the_bounds_of_height():
    fit = known_law(altitude_sd=0.09)
    height = float(named_parameters(fit.z[None], fit.geometry)["height"][0])
    whole = with_integrated(fit)
    narrow = whole._replace(geometry=fit.geometry._replace(height_most=1.02 * height))
    points = np.tile(fit.z, (4, 500, 1))
    drawn = with_drawn(points, narrow, np.random.default_rng(2))
    heights = named_parameters(drawn, narrow.geometry)["height"]
    assert heights.max() <= 1.02 * height
    assert 0.1 < np.mean(heights > height) < 0.5  # the others are as they were


@pytest.mark.parametrize("bent", [False, True])
def test_phase_and_wave_number_are_drawn(bent):
    fit = known_law(bent=bent)
    points = np.tile(fit.z, (2, 400, 1))
    drawn = with_drawn(points, with_integrated(fit), np.random.default_rng(3))
    moved = np.flatnonzero(np.ptp(drawn.reshape(-1, COORDINATES), axis=0))
    assert list(moved) == [OFFSET, PHASE, NOISE_SLOPE, BLUR, ALTITUDE]


def test_a_linear_function_is_learned_exactly():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(3, 250, COORDINATES))
    told = learned(points, lambda z: np.array([z[3] - 2 * z[5], 1.0 + z[2]]), np.array([2, 3, 5]))
    np.testing.assert_allclose(told[..., 0], points[..., 3] - 2 * points[..., 5], atol=1e-9)
    np.testing.assert_allclose(told[..., 1], 1 + points[..., 2], atol=1e-9)
