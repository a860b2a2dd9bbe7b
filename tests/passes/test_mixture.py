import numpy as np
import pytest
from scipy import stats

from sasmap.numerics.gaussians import Mixture
from sasmap.passes.mixture import fit_mixture, marginals

ONE = Mixture(np.ones(1), np.array([[0.6, 0.07, 90.0]]), np.diag([1e-3, 2e-3, 0.5])[None] ** 2)


def draws(seed, n=1600):
    return np.random.default_rng(seed).multivariate_normal(ONE.mean[0], ONE.covariance[0], n)


def test_gaussian_draws_need_one_component():
    fitted = fit_mixture(draws(1))
    assert fitted.weight.size == 1
    np.testing.assert_allclose(fitted.mean, ONE.mean, rtol=1e-3)
    np.testing.assert_allclose(np.diag(fitted.covariance[0]), np.diag(ONE.covariance[0]), rtol=0.1)


def test_two_modes_are_kept():
    other = draws(2) + np.array([0.1, -0.02, 3.0])
    fitted = fit_mixture(np.concatenate([draws(1), other[:800]]))
    order = np.argsort(fitted.mean[:, 0])
    assert abs(fitted.weight[order[0]] - 2 / 3) < 0.02
    assert abs(fitted.mean[order[-1], 0] - 0.7) < 1e-3


def test_a_skewed_posterior_keeps_its_quantiles():
    points = draws(3, 4000)
    points[:, 1] = np.log(0.07) + 0.3 * np.random.default_rng(4).gumbel(size=4000)
    mixture = fit_mixture(points)
    sd = np.sqrt(mixture.covariance[:, 1, 1])
    found = marginals(mixture.weight[None], mixture.mean[None, :, 1], sd[None], np.array([-9, 0.0]))
    height = np.exp(points[:, 1])
    moments = [height.mean(), height.std()]
    np.testing.assert_allclose([found.mean[0], found.sd[0]], moments, rtol=0.1)
    np.testing.assert_allclose(
        [found.q05[0], found.q95[0]], np.quantile(height, [0.05, 0.95]), rtol=0.06
    )


def test_marginal_is_that_of_a_truncated_lognormal():
    bounds = np.log([0.01, 0.5])
    mean, sd = np.log(0.3), 0.6
    found = marginals(np.ones((1, 1)), np.full((1, 1), mean), np.full((1, 1), sd), bounds)
    law = stats.truncnorm(*((bounds - mean) / sd), mean, sd)
    x = np.exp(law.ppf((np.arange(20000) + 0.5) / 20000))
    np.testing.assert_allclose([found.mean[0], found.sd[0]], [x.mean(), x.std()], rtol=1e-3)
    np.testing.assert_allclose(
        [found.q05[0], found.q95[0]], np.exp(law.ppf([0.05, 0.95])), rtol=1e-9
    )


def test_what_lies_beyond_a_bound_is_at_it():
    found = marginals(
        np.ones((1, 1)), np.full((1, 1), 9.0), np.full((1, 1), 0.01), np.log([0.01, 0.5])
    )
    assert found.mean[0] == found.q05[0] == found.q95[0] == pytest.approx(0.5)
