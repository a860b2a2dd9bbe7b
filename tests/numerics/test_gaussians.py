import numpy as np
import pytest

from sasmap.numerics.gaussians import (
    Mixture,
    expectation_maximisation,
    fitted_mixture,
    log_densities,
)

TRUE = Mixture(
    np.array([0.3, 0.7]),
    np.array([[0.0, 0.0], [4.0, 1.0]]),
    np.array([[[1.0, 0.5], [0.5, 1.0]], [[0.5, 0.0], [0.0, 2.0]]]),
)


def drawn(n=20_000):
    rng = np.random.default_rng(1)
    which = rng.random(n) < TRUE.weight[0]
    parts = [rng.multivariate_normal(m, c, n) for m, c in zip(*TRUE[1:], strict=True)]
    return np.where(which[:, None], *parts), which


def test_a_mixture_is_recovered_and_its_likelihood_grows():
    points, which = drawn()
    rough = np.column_stack([points[:, 0] < 1, points[:, 0] >= 1]).astype(float)
    few = expectation_maximisation(points, rough, np.zeros(2), 1, 0.0)
    found, share, level = expectation_maximisation(points, rough, np.zeros(2), 200, 1e-9)
    assert level > few[2]
    np.testing.assert_allclose(found.weight, TRUE.weight, atol=0.02)
    np.testing.assert_allclose(found.mean, TRUE.mean, atol=0.06)
    np.testing.assert_allclose(found.covariance, TRUE.covariance, atol=0.1)
    assert np.mean((share[:, 0] > 0.5) == which) > 0.97


def test_the_floor_keeps_components_from_a_point():
    points = np.zeros((10, 2))
    found, _, level = expectation_maximisation(points, np.ones((10, 1)), np.full(2, 0.04), 5, 0.0)
    np.testing.assert_allclose(found.covariance[0], 0.04 * np.eye(2))
    np.testing.assert_allclose(level, log_densities(points, found)[0, 0])
    np.testing.assert_allclose(level, -np.log(2 * np.pi * 0.04))


@pytest.mark.parametrize("apart", [0.0, 6.0])
def test_a_mixture_has_as_many_components_as_the_points_need(apart):
    rng = np.random.default_rng(4)
    points = rng.normal(size=(2000, 3)) * [1.0, 1e-3, 1e3] + [5.0, 0.0, -1e4]
    points[:, 0] += apart * (rng.random(2000) < 0.3)
    found = fitted_mixture(points, 4, 400.0, 1e-4, 80, 1e-6)
    assert found.weight.size == (2 if apart else 1)
    spread = found.covariance + found.mean[:, :, None] * found.mean[:, None, :]
    mean = found.weight @ found.mean
    whole = np.einsum("k,kij->ij", found.weight, spread) - np.outer(mean, mean)
    np.testing.assert_allclose(mean, points.mean(axis=0), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(np.diag(whole), points.var(axis=0), rtol=0.01)


def test_a_coordinate_without_spread_is_kept():
    points = np.random.default_rng(5).normal(size=(500, 2))
    points[:, 1] = 3.0
    found = fitted_mixture(points, 3, 400.0, 1e-4, 80, 1e-6)
    np.testing.assert_allclose(found.mean[:, 1], 3.0)
    assert np.isfinite(found.covariance).all()
