"""Sampling by contrast or by height: the same points, the same densities."""

import numpy as np
import pytest

from sasmap.ripples.coordinates import Coordinates
from sasmap.ripples.optimise import COORDINATES, Peak
from sasmap.ripples.rendering import named_parameters
from tests.ripples.engine import geometry

HEIGHT, LAW = 2, 3
EVERY = np.arange(COORDINATES)


def peak(contrast_sd, with_law):
    """A peak at A_H of about 0.07 m; with_law, contrast goes with the law, height does not."""
    where = geometry(0.6, 20.0, 5.0)
    covariance = np.diag(np.full(COORDINATES, 0.01))
    covariance[HEIGHT, HEIGHT] = contrast_sd**2
    z = np.zeros(COORDINATES)
    z[HEIGHT] = np.log(0.4)
    if with_law:
        plain = Coordinates([Peak(z, 0.0, covariance)], where, EVERY)
        slope = np.zeros(COORDINATES)
        for i in (LAW, LAW + 1):
            beside = z.copy()
            beside[i] += 1e-4
            slope[i] = (plain._per_slope(beside) - plain._per_slope(z)) / 1e-4
        covariance[LAW, LAW] = covariance[LAW + 1, LAW + 1] = 0.5
        covariance[HEIGHT] += covariance @ slope
        covariance[:, HEIGHT] = covariance[HEIGHT]
        covariance[HEIGHT, HEIGHT] = 1e-4 + slope @ covariance @ slope
    return Peak(z, 0.0, covariance), where


def test_height_is_sampled_where_contrast_follows_from_it_and_the_law():
    told, where = peak(0.1, with_law=True)
    assert Coordinates([told], where, EVERY).by_height
    told, where = peak(0.01, with_law=False)
    assert not Coordinates([told], where, EVERY).by_height


def test_the_third_coordinate_is_log_height_to_first_order():
    told, where = peak(0.1, with_law=True)
    by = Coordinates([told], where, EVERY)
    rng = np.random.default_rng(1)
    points = np.zeros((50, COORDINATES))
    points[:, HEIGHT] = np.log(rng.uniform(0.02, 0.1, 50))
    points[:, LAW : LAW + 2] = rng.normal(0, 0.5, (50, 2))
    heights = named_parameters(by.from_sampling(points), where)["height"]
    np.testing.assert_allclose(heights, np.exp(points[:, HEIGHT]), rtol=1e-6)


@pytest.mark.parametrize("with_law", [True, False])
def test_there_and_back_and_no_change_of_volume(with_law):
    told, where = peak(0.02, with_law)
    by = Coordinates([told], where, EVERY)
    z = np.random.default_rng(2).normal(0, 0.4, (20, COORDINATES))
    np.testing.assert_allclose(by.from_sampling(by.to_sampling(z)), z, atol=1e-12)
    step = 1e-5
    turned = [
        (by.to_sampling(z[0] + step * e) - by.to_sampling(z[0])) / step for e in np.eye(COORDINATES)
    ]
    assert np.linalg.det(np.array(turned)) == pytest.approx(1.0, abs=1e-6)
    # a peak's Gaussian is carried with its points
    if by.by_height:
        draws = np.random.default_rng(3).multivariate_normal(told.z, 1e-4 * told.covariance, 4000)
        seen = np.cov(by.to_sampling(draws).T)
        np.testing.assert_allclose(seen, 1e-4 * by.peaks[0].covariance, atol=3e-6)


def test_a_fixed_law_leaves_contrast():
    told, where = peak(0.1, with_law=True)
    fixed = where._replace(fixed=np.array([2.0, 0.0, np.nan, np.nan]))
    assert not Coordinates([told], fixed, EVERY).by_height
