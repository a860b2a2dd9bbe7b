import numpy as np
import pytest
from scipy import stats

from sasmap.sediments import (
    choose,
    effective_samples,
    fit,
    generalized_k,
    grey_histogram,
    histogram,
    k_distribution,
)
from sasmap.sediments.distributions import frozen
from sasmap.sediments.fitting import FAMILIES
from sasmap.sediments.moments import fit_histogram, fit_log_moments, fit_moments


@pytest.mark.parametrize(("nu", "kappa"), [(0.3, 0.5), (3.0, 1.0), (30.0, 3.0)])
def test_maximum_likelihood_is_at_least_as_likely_as_the_truth(nu, kappa):
    sample = generalized_k.rvs(nu, kappa, scale=2.0, size=4096, random_state=1)
    law = fit(sample)
    gain = law.log_density(sample).sum() - generalized_k.logpdf(sample, nu, kappa, scale=2.0).sum()
    assert -0.05 < gain < 8
    assert law.p_value > 1e-3
    for value, truth, error in zip(
        (np.log(law.nu), np.log1p(law.kappa**2)),
        (np.log(nu), np.log1p(kappa**2)),
        law.errors[:2],
        strict=True,
    ):
        assert abs(value - truth) < 4 * error


def test_each_family_finds_itself():
    root = np.sqrt(0.5)
    made = {
        "rayleigh": stats.rayleigh(scale=root * 3),
        "k": k_distribution(1.2, scale=3),
        "rice": stats.rice(2.0, scale=3 * root),
        "weibull": stats.weibull_min(1.4, scale=3),
        "lognormal": stats.lognorm(0.6, scale=3),
        "generalized_k": generalized_k(0.8, 1.5, scale=3),
    }
    for family in FAMILIES:
        sample = made[family].rvs(size=100_000, random_state=2)
        law = fit(sample, family)
        assert law.scale == pytest.approx(3, rel=0.05)
        assert law.p_value > 1e-3
        x = np.quantile(sample, [0.05, 0.5, 0.95])
        np.testing.assert_allclose(law.log_density(x), made[family].logpdf(x), atol=0.03)
        np.testing.assert_allclose(frozen(law).logpdf(x), law.log_density(x), rtol=1e-9)


def test_the_simplest_law_that_is_not_rejected_is_chosen():
    rayleigh = choose(stats.rayleigh.rvs(size=20_000, random_state=1))
    assert rayleigh.law.family == "rayleigh"
    assert len(rayleigh.tried) == 1
    k = choose(k_distribution.rvs(1.5, size=20_000, random_state=1))
    assert k.law.family == "k"
    both = choose(generalized_k.rvs(2.0, 2.0, size=200_000, random_state=1))
    assert both.law.family == "generalized_k"
    assert both.tried[0].p_value < 1e-6


def test_grey_values_are_integrated_over():
    sample = generalized_k.rvs(0.3, 0.5, scale=20.0, size=250_000, random_state=2)
    grey = np.minimum(np.rint(sample), 255).astype(int)
    law = fit(grey_histogram(grey))
    assert abs(np.log(law.nu / 0.3)) < 3 * law.errors[0]
    assert abs(np.log1p(law.kappa**2) - np.log1p(0.25)) < 3 * law.errors[1]


def test_linear_bins_are_integrated_over():
    sample = generalized_k.rvs(0.3, 0.5, size=250_000, random_state=3)
    counts, edges = np.histogram(sample, 512)
    law = fit(histogram(edges, counts))
    assert abs(np.log(law.nu / 0.3)) < 3 * law.errors[0]
    assert abs(np.log1p(law.kappa**2) - np.log1p(0.25)) < 3 * law.errors[1]


def test_a_censored_tail_is_no_loss_of_truth():
    sample = k_distribution.rvs(2.0, size=50_000, random_state=4)
    edges = np.append(np.linspace(0, 1.5, 40), np.inf)
    law = fit(histogram(edges, np.histogram(sample, edges)[0]), "k")
    assert abs(np.log(law.nu / 2)) < 4 * law.errors[0]


def test_scale_and_weights():
    sample = generalized_k.rvs(2.0, 1.0, size=5000, random_state=5)
    law = fit(sample)
    for factor in (1e-30, 1e30):
        scaled = fit(factor * sample)
        assert scaled.scale == pytest.approx(factor * law.scale, rel=1e-4)
    twice = fit(sample, weights=np.full(5000, 2.0))
    assert twice.log_likelihood == pytest.approx(2 * law.log_likelihood, rel=1e-6)
    fewer = fit(sample, samples=1250)
    assert fewer.errors[2] == pytest.approx(2 * law.errors[2], rel=1e-3)


def test_correlated_pixels_count_as_fewer():
    rng = np.random.default_rng(6)
    noise = rng.normal(size=(2, 200, 200))
    assert effective_samples(np.hypot(*noise)) == pytest.approx(40_000, rel=0.1)
    same = np.repeat(np.repeat(np.hypot(*noise[:, ::2, ::2]), 2, axis=0), 2, axis=1)
    # blocks of 2 x 2 equal pixels
    assert effective_samples(same) == pytest.approx(10_000, rel=0.15)


def test_moments_and_histograms_come_near():
    sample = generalized_k.rvs(2.0, 1.0, size=300_000, random_state=7)
    square = (sample**2).mean()
    for law in (fit_moments(sample), fit_log_moments(sample)):
        assert law.mean_square == pytest.approx(square, rel=0.01)
        best = fit(sample).log_likelihood
        assert best - law.log_likelihood < 1e-3 * sample.size
    density, edges = np.histogram(sample + 0.2, 200, density=True)
    found = fit_histogram(edges, density, "generalized_k", offset=True)
    assert found.offset == pytest.approx(0.2, abs=0.05)
    assert found.misfit < fit_histogram(edges, density, "rayleigh", offset=True).misfit


@pytest.mark.parametrize("data", [[], [np.nan], [0.0, 0.0], [-1.0, 2.0], [1.0, np.inf]])
def test_what_are_no_amplitudes_is_refused(data):
    with pytest.raises(ValueError, match="expected"):
        fit(data)


def test_fit_of_the_distribution():
    sample = generalized_k.rvs(2.0, 1.0, scale=5.0, size=20_000, random_state=8)
    nu, kappa, loc, scale = generalized_k.fit(sample)
    assert loc == 0
    assert (
        generalized_k.logpdf(sample, nu, kappa, loc, scale).sum()
        > generalized_k.logpdf(sample, 2.0, 1.0, scale=5.0).sum() - 0.1
    )
    with pytest.raises(ValueError, match="floc"):
        generalized_k.fit(sample, floc=1.0)
    assert k_distribution.fit(sample)[1] == 0
