import numpy as np
import pytest
from scipy import stats

from sasmap.numerics.gaussians import Mixture
from sasmap.ripples.mixture import disagreement, fit_mixture, marginal, product, widened

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
    points[:, 1] = 0.07 * np.exp(0.4 * np.random.default_rng(4).normal(size=4000))
    found = marginal(fit_mixture(points), 1, (0.0, 0.5))
    np.testing.assert_allclose(
        [found.mean, found.sd], [points[:, 1].mean(), points[:, 1].std()], rtol=0.02
    )
    np.testing.assert_allclose(
        [found.q05, found.q95], np.quantile(points[:, 1], [0.05, 0.95]), rtol=0.06
    )


def test_product_is_that_of_the_densities():
    rng = np.random.default_rng(5)
    parts = []
    for _ in range(2):
        root = rng.normal(size=(2, 3, 3))
        parts.append(
            Mixture(np.array([0.3, 0.7]), rng.normal(size=(2, 3)), root @ root.transpose(0, 2, 1))
        )
    together = product(*parts)

    def density(m, x):
        return sum(w * stats.multivariate_normal.pdf(x, a, c) for w, a, c in zip(*m, strict=True))

    points = rng.normal(size=(20, 3))
    ratio = [density(together, x) / (density(parts[0], x) * density(parts[1], x)) for x in points]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
    assert together.weight.sum() == pytest.approx(1)


def test_truncated_marginal_is_the_truncated_gaussian():
    for low, high in ((0.05, 0.09), (0.075, 0.5), (0.0, 0.065)):
        a, b = (low - 0.07) / 2e-3, (high - 0.07) / 2e-3
        law = stats.truncnorm(a, b, 0.07, 2e-3)
        expected = [law.mean(), law.std(), law.ppf(0.05), law.ppf(0.95)]
        np.testing.assert_allclose(marginal(ONE, 1, (low, high)), expected, rtol=1e-6)


def test_far_outside_its_bounds_what_is_nearest_remains():
    found = marginal(ONE, 1, (0.2, 0.5))
    assert 0.2 <= found.q05 <= found.mean <= found.q95 < 0.21
    assert np.isfinite(found).all()


def test_disagreement_is_chi_squared_by_chance():
    rng = np.random.default_rng(6)
    wide = widened(ONE, np.array([1e-3, 0.0, 0.0]))
    assert wide.covariance[0, 0, 0] == pytest.approx(2e-6)
    values = []
    for _ in range(2000):
        places = rng.multivariate_normal(ONE.mean[0], ONE.covariance[0], 2)
        values.append(disagreement(*(ONE._replace(mean=p[None]) for p in places)))
    assert stats.kstest(values, stats.chi2(3).cdf).pvalue > 1e-3
