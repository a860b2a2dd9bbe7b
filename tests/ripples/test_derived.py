import numpy as np
import pytest
from scipy import stats

from sasmap.numerics.gaussians import Mixture
from sasmap.ripples.derived import derived_of_draws, derived_of_mixture


def test_the_moments_of_a_product_of_correlated_gaussians():
    """Mean and variance of X Y in closed form, from means, standard deviations and c = cov."""
    mean = np.array([0.6, 0.07, 90.0])
    covariance = np.diag([0.02**2, 0.01**2, 1.0])
    c = covariance[0, 1] = covariance[1, 0] = -0.7 * 0.02 * 0.01
    mixture = Mixture(np.ones(1), mean[None], covariance[None])
    found = derived_of_mixture(mixture, (0.05, 5.0), (0.0, 0.5))
    x, y, sx, sy = 0.6, 0.07, 0.02, 0.01
    variance = x**2 * sy**2 + y**2 * sx**2 + 2 * x * y * c + sx**2 * sy**2 + c**2
    sd = 2 * np.sqrt(variance)
    assert found.steepness[0] == pytest.approx(2 * (x * y + c), abs=0.01 * sd)
    assert found.steepness[1] == pytest.approx(sd, rel=0.01)
    wide = 1 / 0.6 * (1 + (0.02 / 0.6) ** 2)
    assert found.wavelength[0] == pytest.approx(wide, abs=0.01 * found.wavelength[1])
    assert found.wavelength[1] == pytest.approx(0.02 / 0.36, rel=0.02)


def test_a_mixture_and_its_draws_say_the_same():
    rng = np.random.default_rng(3)
    weight = np.array([0.3, 0.7])
    mean = np.array([[0.5, 0.06, 0.0], [0.52, 0.10, 0.0]])
    covariance = np.array([np.diag([0.01, 0.01, 1.0]) ** 2, np.diag([0.02, 0.015, 1.0]) ** 2])
    which = rng.random(200_000) > weight[0]
    normal = rng.standard_normal((200_000, 2))
    scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[:, :2]
    points = mean[which.astype(int), :2] + scale[which.astype(int)] * normal
    drawn = derived_of_draws(points[:, 0], points[:, 1])
    found = derived_of_mixture(Mixture(weight, mean, covariance), (0.05, 5.0), (0.0, 0.5))
    sd = drawn.steepness[1]
    np.testing.assert_allclose(found.steepness, drawn.steepness, atol=0.02 * sd)
    np.testing.assert_allclose(found.wavelength, drawn.wavelength, rtol=2e-3)


def test_what_lies_outside_the_bounds_does_not_count():
    covariance = np.diag([1e-4, 0.05, 1.0]) ** 2
    mixture = Mixture(np.ones(1), np.array([[0.5, 0.0, 0.0]]), covariance[None])
    found = derived_of_mixture(mixture, (0.05, 5.0), (0.0, 0.5))
    half = stats.halfnorm(scale=0.05)
    assert found.steepness[0] == pytest.approx(half.mean(), rel=0.02)  # 2 f = 1
    assert found.steepness[3] == pytest.approx(half.ppf(0.95), rel=0.02)
    assert found.steepness[2] > 0
