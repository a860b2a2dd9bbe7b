"""Fisher scoring to the likeliest parameters: histograms of known truth, without noise."""

import numpy as np
import pytest

from sasmap.ripples.optimise import (
    COORDINATES,
    TREND,
    Peak,
    distinct,
    fisher_scoring,
    free_coordinates,
    rivals,
    search,
    slope_at,
)
from sasmap.ripples.rendering import (
    ASYMMETRY,
    CONCENTRATION,
    EXPONENT,
    PEAKEDNESS,
    contrast_per_slope,
    log_posterior,
    log_prior,
    parameters_at,
)
from tests.ripples.engine import GAUSSIAN, LAMBERT, empty, geometry, noiseless, ripple

FIXED = np.array([2.0, 0.0, np.nan, np.nan])


def scene(height=0.07, law=LAMBERT, ranges=(8.0, 18.0), fixed=None, **changes):
    reach = np.arange(*ranges, 0.5)
    where = geometry(0.6, float(reach.mean()), 5.0, expected_blur=0.03)
    if fixed is not None:
        where = where._replace(fixed=np.array(fixed))
    truth = ripple(height, law, blur=0.03, noise=0.01, noise_slope=1.0, **changes)
    group = (np.arange(reach.size) // 4).astype(np.int64)
    data = noiseless(truth, empty(reach, 5.0, bins=48, count=300.0, group=group), where)
    return truth, data, where


def point_at(truth, where):
    """Sampling coordinates of parameters."""
    z = np.zeros(COORDINATES)
    z[0], z[1] = truth.wave_offset, truth.phase
    z[3] = (truth.exponent - EXPONENT[0]) / EXPONENT[1]
    z[4] = (truth.concentration - CONCENTRATION[0]) / CONCENTRATION[1]
    z[5] = (truth.peakedness - PEAKEDNESS[0]) / PEAKEDNESS[1]
    z[6] = (truth.asymmetry - ASYMMETRY[0]) / ASYMMETRY[1]
    tangent = where.altitude_middle / where.range_middle
    per_slope = contrast_per_slope(truth.exponent, truth.concentration, tangent)
    z[2] = np.log(truth.height * per_slope)
    return z


def test_coordinates_are_those_of_the_parameters():
    truth, _, where = scene(peakedness=0.1, asymmetry=-0.05, phase=0.3, wave_offset=0.01)
    found = parameters_at(point_at(truth, where), where)
    for name in truth._fields:
        if name not in ("noise", "noise_slope", "blur"):
            assert getattr(found, name) == pytest.approx(getattr(truth, name)), name
    # where the altitude is higher, the same contrast is of another height
    z = point_at(truth, where)
    z[10] = 1.0
    tilted = parameters_at(z, where)
    assert tilted.altitude_scale == pytest.approx(1 + np.hypot(0.02, 0.07 / 2**0.5) / 5, rel=1e-6)
    assert tilted.height > 0.07


@pytest.mark.parametrize(
    ("law", "height", "ranges"),
    [
        (LAMBERT, 0.07, (8.0, 18.0)),
        (GAUSSIAN, 0.08, (14.0, 24.0)),
        ((1.0, 0.3), 0.05, (12.0, 22.0)),
    ],
)
def test_climb_finds_what_made_the_histogram(law, height, ranges):
    truth, data, where = scene(height, law, ranges, peakedness=0.06)
    best = fisher_scoring(rivals(search(data, where), data, where)[0].z, data, where)
    at_truth = log_posterior(point_at(truth, where), data, where)
    assert best.level > at_truth - 4.0  # edges of shadow make the likelihood rough
    found = parameters_at(best.z, where)
    assert found.height == pytest.approx(height, rel=0.03)
    sd = np.sqrt(np.diag(best.covariance))
    assert abs(found.exponent - law[0]) < 3 * sd[3] * EXPONENT[1] + 0.05
    assert abs(found.wave_offset) < 2e-3
    assert abs(found.phase) < 0.03


@pytest.mark.parametrize(
    ("height", "ranges", "asymmetry"),
    [(0.08, (30.0, 42.0), -0.2), (0.12, (20.0, 30.0), -0.2), (0.16, (30.0, 42.0), 0.2)],
)
def test_search_finds_the_peak_in_deep_shadow(height, ranges, asymmetry):
    truth, data, where = scene(height, (1.2, 0.6), ranges, peakedness=0.06, asymmetry=asymmetry)
    share = 0.03  # as many pixels as a model error of some per cent leaves
    data = data._replace(
        pixel_count=share * data.pixel_count, intensity_sum=share * data.intensity_sum
    )
    found = rivals(search(data, where), data, where)
    best = fisher_scoring(point_at(truth, where), data, where)
    assert found[0].level > best.level - 1.0
    assert parameters_at(found[0].z, where).height == pytest.approx(height, rel=0.15)


def test_rivals_reach_what_climbs_from_the_scan_do_not():
    gained = 0.0
    for height, ranges in ((0.2, (20.0, 32.0)), (0.2, (30.0, 42.0)), (0.25, (20.0, 32.0))):
        _, data, where = scene(height, (1.2, 0.6), ranges, peakedness=0.06, asymmetry=0.2)
        known = search(data, where)
        found = rivals(known, data, where)
        assert found[0].level >= known[0].level
        gained += found[0].level - known[0].level
    assert gained > 10.0


def test_without_shadow_no_rivals_are_looked_for():
    _, data, where = scene(0.02, LAMBERT, (8.0, 14.0))
    known = search(data, where)
    assert rivals(known, data, where) is known


@pytest.mark.parametrize("away", [(0.3, 0.2, 1.0), (-0.25, -0.2, -1.0), (0.0, 0.4, -0.5)])
def test_climb_returns_from_around_the_peak(away):
    truth, data, where = scene(0.06, fixed=FIXED, peakedness=0.06)
    start = point_at(truth, where)
    start[2], start[1], start[5] = start[2] + away[0], start[1] + away[1], start[5] + away[2]
    peak = fisher_scoring(start, data, where, 60)
    assert peak.level >= log_posterior(start, data, where)
    assert parameters_at(peak.z, where).height == pytest.approx(0.06, rel=0.02)
    assert peak.z[[3, 4]] == pytest.approx(start[[3, 4]])  # what is fixed stays
    assert parameters_at(peak.z, where).exponent == 2.0


def test_gradient_agrees_with_finite_differences():
    truth, data, where = scene(0.05, ranges=(8.0, 14.0))  # no shadow
    rng = np.random.default_rng(3)
    data = data._replace(intensity_sum=data.intensity_sum * rng.gamma(300, 1 / 300, (12, 48)))
    z = point_at(truth, where)
    z += np.array([0.004, 0.05, 0.1, 0.2, -0.2, 0.3, 0.2, 0.4, 0.1, 0.1, 0.2, 0.1, -0.2, 0.2])
    free = free_coordinates(where)
    gradient, information = slope_at(z, data, where, free)
    for k, i in enumerate(free):
        step = 1e-3 * (0.1 if i == 0 else 1.0)
        ahead, behind = z.copy(), z.copy()
        ahead[i] += step
        behind[i] -= step
        known = log_posterior(ahead, data, where) - log_posterior(behind, data, where)
        # the gains' own information is left out of the gradient
        slack = 0.03 * abs(gradient[k]) + 0.1 * np.sqrt(information[k, k])
        assert abs(gradient[k] - known / (2 * step)) < slack, i
    np.testing.assert_allclose(information, information.T, rtol=1e-9)
    assert np.linalg.eigvalsh(information).min() > 0


def test_slopes_at_the_edge_of_the_prior_are_those_within():
    truth, data, where = scene(0.05, ranges=(8.0, 14.0))
    z = point_at(truth, where)
    free = free_coordinates(where)
    k = list(free).index(2)
    _, within = slope_at(z, data, where, free)
    for edge in ({"height_most": 0.0500001}, {"height_least": 0.0499999}):
        _, at_edge = slope_at(z, data, where._replace(**edge), free)
        assert at_edge[k, k] == pytest.approx(within[k, k], rel=0.05)
    _, beyond = slope_at(z, data, where._replace(height_most=0.04), free)
    assert beyond[k, k] == pytest.approx(0, abs=1e-5)  # a ripple there may be none at all


def test_gradient_with_errors_of_the_model():
    truth, data, where = scene(0.05, ranges=(8.0, 14.0))
    rng = np.random.default_rng(3)
    data = data._replace(intensity_sum=data.intensity_sum * rng.gamma(300, 1 / 300, (12, 48)))
    angle = 2 * np.pi * (np.arange(48) + 0.5) / 48
    errors = 0.05 * np.stack([np.broadcast_to(f(2 * angle), (12, 48)) for f in (np.cos, np.sin)])
    flat = errors.reshape(2, -1)
    size, axes = np.linalg.eigh((flat * data.pixel_count.ravel()) @ flat.T)
    z = point_at(truth, where) + 0.05
    free = free_coordinates(where)
    given = {
        "errors": errors.copy(),
        "error_axes": axes,
        "error_information": size,
        "error_fitted": np.array([0.4, -0.2]),
    }
    wide = data._replace(**given)
    plain, with_errors = (slope_at(z, d, where, free) for d in (data, wide))
    # a misfit of that shape is forgiven
    assert log_posterior(z, wide, where) > log_posterior(z, data, where) + 10
    k = list(free).index(2)
    step = np.eye(COORDINATES)[2] * 1e-3
    known = log_posterior(z + step, wide, where) - log_posterior(z - step, wide, where)
    assert with_errors[0][k] == pytest.approx(known / 2e-3, rel=0.1)
    # what may be an error of the model tells less
    assert (np.diag(with_errors[1]) <= np.diag(plain[1]) * (1 + 1e-9)).all()
    assert with_errors[1][k, k] < plain[1][k, k]


def test_free_coordinates():
    where = geometry(0.6, 15.0, 5.0)
    assert list(free_coordinates(where)) == list(range(COORDINATES))
    law = where._replace(fixed=FIXED)
    assert list(free_coordinates(law)) == [0, 1, 2, 5, 6, 7, 8, 9, 10, *TREND]
    published = where._replace(fixed=np.array([np.nan, np.nan, 0.0, 0.0]), published=True)
    assert list(free_coordinates(published)) == [0, 1, 2, 3, 4, 7, 8, 9, 10]
    everything = where._replace(fixed=np.array([2.0, 0.0, 0.0, 0.0]))
    assert list(free_coordinates(everything)) == [0, 1, 2, 7, 8, 9, 10, *TREND]
    assert parameters_at(np.ones(COORDINATES), everything)[3:7] == (2.0, 0.0, 0.0, 0.0)


def test_prior_holds_its_bounds():
    where = geometry(0.6, 15.0, 5.0)
    z = np.zeros(COORDINATES)
    z[2] = np.log(0.05 * contrast_per_slope(EXPONENT[0], CONCENTRATION[0], 1 / 3))

    def level(at, **changes):
        there = where._replace(**changes)
        return log_prior(at, parameters_at(at, there), there)

    assert np.isfinite(level(z))
    assert level(z, height_most=0.04) == level(z, height_least=0.06) == -np.inf
    steep = z.copy()
    steep[2] += 2.0  # beyond a slope of 1
    assert level(steep) == -np.inf
    for k, far in ((3, 4.0), (3, -3.0), (5, 4.0), (6, 4.1), (6, -4.1)):
        off = z.copy()
        off[k] = far
        assert level(off) == -np.inf
    # truncated Gaussian of A_H, by what one standard deviation costs
    flat, narrow = (dict(height_mean=0.05, height_sd=s) for s in (np.inf, 0.01))
    up = z.copy()
    up[2] += np.log(0.06 / 0.05)
    cost = level(up, **narrow) - level(z, **narrow) - level(up, **flat) + level(z, **flat)
    assert cost == pytest.approx(-0.5, abs=1e-6)
    for k in range(3, COORDINATES):
        one = z.copy()
        one[k] = 0.5
        heights = [np.log(parameters_at(p, where).height) for p in (one, z)]
        steepness = [(h + np.log(2 * 0.6 / where.steepness_middle)) ** 2 for h in heights]
        expected = -0.125 - 0.5 * np.diff(steepness[::-1])[0] / where.steepness_sd**2
        assert level(one) - level(z) == pytest.approx(expected, abs=1e-9)


def test_distinct_keeps_each_peak_once():
    def peak(place, level):
        return Peak(np.full(COORDINATES, place), level, np.eye(COORDINATES))

    kept = distinct([peak(0.0, 1.0), peak(0.1, 2.0), peak(1.0, 0.0), peak(2.0, -1.0)], 2)
    assert [p.level for p in kept] == [2.0, 0.0]
