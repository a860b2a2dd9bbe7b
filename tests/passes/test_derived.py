import numpy as np
import pytest

from sasmap.passes.cell_estimate import estimates
from sasmap.passes.derived import derived_of_draws
from sasmap.ripples import RippleSettings

ANY = np.array([[0.0, np.inf]])  # no bound by the looks


def test_a_mixture_and_its_draws_say_the_same():
    rng = np.random.default_rng(3)
    weight = np.array([0.3, 0.7])
    mean = np.log([[0.5, 0.06], [0.52, 0.10]])
    root = np.array([[0.02, 0.0], [-0.1, 0.12]])
    which = (rng.random(200_000) > weight[0]).astype(int)
    logs = mean[which] + rng.standard_normal((200_000, 2)) @ root.T
    drawn = derived_of_draws(*np.exp(logs).T)
    wide = np.pad(mean, ((0, 0), (0, 1)))
    covariance = np.zeros((2, 3, 3))
    covariance[:, :2, :2], covariance[:, 2, 2] = root @ root.T, 1.0
    (found,) = estimates(weight[None], wide[None], covariance[None], RippleSettings(), ANY)
    sd = drawn.steepness[1]
    np.testing.assert_allclose(found.derived.steepness, drawn.steepness, atol=0.02 * sd)
    np.testing.assert_allclose(found.derived.wavelength, drawn.wavelength, rtol=0.01)


def test_the_moments_of_a_product_of_correlated_gaussians():
    """Mean and variance of X Y in closed form, from means, standard deviations and c = cov."""
    rng = np.random.default_rng(4)
    c = -0.7 * 0.02 * 0.01
    covariance = [[0.02**2, c], [c, 0.01**2]]
    f, height = rng.multivariate_normal([0.6, 0.07], covariance, 100_000).T
    found = derived_of_draws(f, height)
    variance = 0.6**2 * 0.01**2 + 0.07**2 * 0.02**2 + 2 * 0.6 * 0.07 * c + (0.02 * 0.01) ** 2 + c**2
    sd = 2 * np.sqrt(variance)
    assert found.steepness[0] == pytest.approx(2 * (0.6 * 0.07 + c), abs=0.02 * sd)
    assert found.steepness[1] == pytest.approx(sd, rel=0.02)
    assert found.wavelength[1] == pytest.approx(0.02 / 0.36, rel=0.02)


def test_a_steepness_knows_the_bounds_of_the_height():
    """A log A_H that is hardly known, cut at the bounds: the steepness is 2 f A_H all the same."""
    mean = np.array([[[np.log(0.6), np.log(0.03), 90.0]], [[np.log(1.2), np.log(0.3), 90.0]]])
    covariance = np.tile(np.diag([1e-6, 4.0, 1.0]), (2, 1, 1, 1))
    found = estimates(np.ones((2, 1)), mean, covariance, RippleSettings(), ANY)
    for estimate, f in zip(found, (0.6, 1.2), strict=True):
        heights = [getattr(estimate, name)[1] for name in ("mean", "sd", "q05", "q95")]
        np.testing.assert_allclose(estimate.derived.steepness, 2 * f * np.array(heights), rtol=0.01)
        assert estimate.derived.steepness[3] < 2 * f * 0.5
