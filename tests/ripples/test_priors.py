"""The prior of f, which multiplies what the image tells."""

import numpy as np
import pytest

from sasmap.ripples.priors import Prior

BOUNDS = ((0.05, 5.0), (0.0, 0.5))


@pytest.mark.parametrize("sharper", [1e-6, 0.5, 1.0, 3.0, 1e6])
def test_two_gaussians_multiply(sharper):
    draws = np.random.default_rng(1).normal(0.6, 0.01, (4, 5000))
    mean, sd = draws.mean(), draws.std()
    prior = Prior((0.63, 0.1), (sd / sharper, np.inf), BOUNDS)
    weighed = prior.weigh_frequency(draws)
    information = np.array([1 / sd**2, (sharper / sd) ** 2])
    assert weighed.mean() == pytest.approx(information @ (mean, 0.63) / information.sum(), rel=1e-6)
    assert weighed.std() == pytest.approx(information.sum() ** -0.5, rel=1e-6)
    assert np.corrcoef(weighed.ravel(), draws.ravel())[0, 1] == pytest.approx(1)


def test_a_prior_that_knows_the_bounds_alone_leaves_draws_as_they_are():
    draws = np.random.default_rng(1).normal(0.6, 0.01, (4, 50))
    assert Prior.natural(*BOUNDS).weigh_frequency(draws) is draws


def test_draws_that_are_all_the_same_stay():
    prior = Prior((0.5, 0.1), (0.01, np.inf), BOUNDS)
    assert (prior.weigh_frequency(np.full((2, 3), 0.6)) == 0.6).all()
