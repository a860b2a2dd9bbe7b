"""Parameters that are integrated out have the posterior that they would have if sampled."""

import numpy as np
import pytest

from sasmap.ripples.errors import sharing, with_errors
from sasmap.ripples.nuisance import (
    integrated_coordinates,
    learned,
    with_drawn,
    with_integrated,
)
from sasmap.ripples.optimise import (
    ALTITUDE,
    BLUR,
    COORDINATES,
    HEIGHT,
    NOISE_SLOPE,
    OFFSET,
    PHASE,
    TREND,
    fisher_scoring,
    free_coordinates,
)
from sasmap.ripples.rendered import expected_at
from sasmap.ripples.rendering import (
    error_gain,
    log_posterior,
    log_posteriors,
    named_parameters,
)
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
    plain = fit_of(4, np.ones((4, BINS)), not field, height=0.08, altitude_sd=0.1, bent=field)
    plain, where = with_errors(plain), plain.geometry
    which = integrated_coordinates(plain)
    whole = with_integrated(plain, which).data
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
    which = np.array([OFFSET, PHASE, NOISE_SLOPE, BLUR, *TREND, ALTITUDE])
    where, whole = fit.geometry, with_integrated(fit, which)
    data = whole.data
    free = np.append(np.setdiff1d(free_coordinates(where), which), ALTITUDE)
    known = sampled(fit, free, sharing(data, data.errors[:-1], data.error_fitted[:-1], 1.0), rng)
    some = sampled(fit, free[:-1], data, rng)
    assert (some[..., ALTITUDE] == fit.z[ALTITUDE]).all()
    known, told = (np.concatenate(list(v)) for v in (known, with_drawn(some, whole, which, rng)))
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
    which = integrated_coordinates(fit)
    assert ALTITUDE in which
    whole = with_integrated(fit, which)
    narrow = whole._replace(geometry=fit.geometry._replace(height_most=1.02 * height))
    points = np.tile(fit.z, (4, 500, 1))
    drawn = with_drawn(points, narrow, which, np.random.default_rng(2))
    heights = named_parameters(drawn, narrow.geometry)["height"]
    assert heights.max() <= 1.02 * height
    assert 0.1 < np.mean(heights > height) < 0.5  # the others are as they were


@pytest.mark.parametrize("bent", [False, True])
def test_phase_and_wave_number_are_drawn(bent):
    fit = known_law(bent=bent)
    points = np.tile(fit.z, (2, 400, 1))
    which = integrated_coordinates(fit)
    assert {OFFSET, PHASE, NOISE_SLOPE, BLUR, ALTITUDE} <= set(which)
    drawn = with_drawn(points, with_integrated(fit, which), which, np.random.default_rng(3))
    moved = np.flatnonzero(np.ptp(drawn.reshape(-1, COORDINATES), axis=0))
    assert list(moved) == sorted(which)


def test_an_altitude_that_is_hardly_known_is_sampled():
    assert ALTITUDE not in integrated_coordinates(known_law(altitude_sd=0.5))


def test_heights_over_range_are_sampled_where_edges_of_shadow_tell_them():
    smooth = fit_of(6, np.ones((6, BINS)), height=0.02)
    assert set(TREND) <= set(integrated_coordinates(smooth))
    # few pixels, and the heights that they allow begin to cast shadow
    edge = fit_of(6, np.ones((6, BINS)), height=0.11)
    edge = edge._replace(peaks=[edge.peaks[0]._replace(covariance=4 * edge.peaks[0].covariance)])
    assert not set(TREND) & set(integrated_coordinates(edge))


def test_what_a_fit_contains_of_a_coordinate_has_paid_its_prior():
    plain = fit_of(6, np.ones((6, BINS)), height=0.05)
    z = plain.z.copy()
    z[TREND[0]] += 1.5
    seen = plain.data.pixel_count * expected_at(plain, z)[0]
    peak = plain.peaks[0]._replace(z=z)
    level = plain._replace(data=plain.data._replace(intensity_sum=seen), peaks=[peak])
    paid = with_integrated(level, np.array(TREND))
    fitted, gain = paid.data.error_fitted, error_gain(paid.data)
    np.testing.assert_allclose(fitted, z[list(TREND)])
    without, given = (log_posterior(z, f.data, f.geometry) for f in (level, paid))
    prior = 0.5 * (fitted @ gain @ fitted - fitted @ fitted)
    assert given - without == pytest.approx(prior, rel=0.02)
    assert prior < -0.5


def test_a_linear_function_is_learned_exactly():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(3, 250, COORDINATES))
    told = learned(points, lambda z: np.array([z[3] - 2 * z[5], 1.0 + z[2]]), np.array([2, 3, 5]))
    np.testing.assert_allclose(told[..., 0], points[..., 3] - 2 * points[..., 5], atol=1e-9)
    np.testing.assert_allclose(told[..., 1], 1 + points[..., 2], atol=1e-9)
