import numpy as np
import pytest
from scipy import stats

from sasmap.ripples.kernel import NOISE_BOUNDS, NOISE_MEAN, NOISE_SD
from sasmap.ripples.likelihood import Prior
from sasmap.ripples.sampler import learn_proposal, metropolis
from sasmap.ripples.starts import _next_power, _resample, parameters
from tests.helpers import zare_cobb_clip
from tests.ripples.test_likelihood import fitted

PRIOR = Prior((0.6, 0.1), (0.05, 0.04), ((0.5, 0.66), (0.0, 0.3)), 0.6, (92.0, 3.0))


@pytest.fixture(scope="module")
def draws():
    """Draws of a target that is the prior: a likelihood to the power of nearly nothing."""
    data = fitted(zare_cobb_clip(24.4, 36.6, 0.6, 0.07), "crest").data
    # as with a field, so that the prior of the phase is proper
    data = data._replace(power=1e-12, wave_precision=np.zeros(2), field=1)
    rng = np.random.default_rng(7)
    members = np.column_stack(
        [
            rng.normal(0.59, 0.04, 96),
            rng.normal(0.1, 0.04, 96),
            rng.normal(np.radians(92), 0.05, 96),
            rng.normal(0, 0.1, 96),
            rng.normal(-4, 2, 96),
            rng.normal(data.blur[0], 1 / np.sqrt(data.blur[1]), 96),
        ]
    )
    start = np.array([0.6, 0.1, np.radians(92), 0.0, -4.0, data.blur[0]])
    compiled = PRIOR.compiled(90.0)
    chain = metropolis(start, 200_000, learn_proposal(members), data, compiled, rng)
    assert 0.1 < chain.accepted / 200_000 < 0.9
    return parameters(chain.draws[1000::100])


def truth(n, seed=1):
    """Independent draws of the same prior, by rejection."""
    rng = np.random.default_rng(seed)
    (s, t), rho = PRIOR.sd, PRIOR.correlation
    covariance = [[s * s, rho * s * t], [rho * s * t, t * t]]
    points = rng.multivariate_normal(PRIOR.mean, covariance, 20 * n)
    (a, b), (c, d) = PRIOR.bounds
    inside = (points[:, 0] > a) & (points[:, 0] < b) & (points[:, 1] > c) & (points[:, 1] < d)
    return points[inside][:n]


def test_sampler_reaches_its_target(draws):
    reference = truth(5000)
    for i in (0, 1):
        assert stats.ks_2samp(draws[:, i], reference[:, i]).pvalue > 1e-3
    product = [np.prod(d[:, :2] - reference.mean(axis=0), axis=1) for d in (draws, reference)]
    assert stats.ks_2samp(*product).pvalue > 1e-3
    assert stats.kstest(np.degrees(draws[:, 2]), stats.norm(92, 3).cdf).pvalue > 1e-3
    low, high = ((v - NOISE_MEAN) / NOISE_SD for v in NOISE_BOUNDS)
    noise = stats.truncnorm(low, high, NOISE_MEAN, NOISE_SD)
    assert stats.kstest(draws[:, 4], noise.cdf).pvalue > 1e-3


def test_the_same_harness_refuses_a_wrong_target(draws):
    wrong = truth(5000) + np.array([0.01, 0.0])
    assert stats.ks_2samp(draws[:, 0], wrong[:, 0]).pvalue < 1e-3
    assert stats.ks_2samp(draws[:, 1], 1.2 * truth(5000)[:, 1]).pvalue < 1e-3


def test_next_power_leaves_the_share_asked_for():
    level = np.random.default_rng(1).normal(0, 1000, 400)
    power = _next_power(level, 0.0, 0.5)
    weight = np.exp(power * (level - level.max()))
    assert abs(weight.sum() ** 2 / (weight**2).sum() / 400 - 0.5) < 1e-6
    assert _next_power(np.zeros(10), 0.3, 0.5) == 1.0


def test_resampling_is_in_proportion():
    weight = np.array([1.0, 2.0, 0.0, 5.0])
    chosen = _resample(weight, 8000, np.random.default_rng(1))
    np.testing.assert_allclose(np.bincount(chosen, minlength=4), 1000 * weight, atol=1)
