"""One harness for the sampler, whatever the density; and samplers that are wrong must fail it."""

import warnings

import numpy as np
import pytest
from scipy import stats

from sasmap.numerics.gaussians import Mixture
from sasmap.ripples.diagnostics import ess_bulk, rhat
from sasmap.ripples.sampler import (
    Proposal,
    defended,
    effective_number,
    metropolis_hastings,
    mixture_of_peaks,
    population,
    refitted,
    resampled,
    sample,
    tempered,
)

COVARIANCE = 0.6 ** np.abs(np.subtract.outer(np.arange(6), np.arange(6)))
COVARIANCE *= np.outer(*[np.array([1.0, 0.1, 3.0, 1.0, 10.0, 0.5])] * 2)
CENTRE = np.array([1.0, -2.0, 0.0, 5.0, 20.0, 0.3])


def gaussian(points):
    offset = points - CENTRE
    return -0.5 * (offset * np.linalg.solve(COVARIANCE, offset.T).T).sum(axis=1)


def two_modes(points):
    near = -0.5 * ((points - 2.0) ** 2).sum(axis=1) / 0.25
    far = -0.5 * ((points + 2.0) ** 2).sum(axis=1)
    return np.logaddexp(near + np.log(0.3 / 0.25), far + np.log(0.7))  # 0.3 and 0.7 of the mass


def banana(points):
    bent = points[:, 1] - 0.5 * points[:, 0] ** 2
    return -0.5 * (points[:, 0] ** 2 + bent**2 / 0.25 + points[:, 2] ** 2)


def exact(name, n=400_000):
    """Independent draws."""
    rng = np.random.default_rng(99)
    if name == "gaussian":
        return rng.multivariate_normal(CENTRE, COVARIANCE, n)
    if name == "two modes":
        first = rng.random((n, 1)) < 0.3
        return np.where(first, 2 + 0.5 * rng.normal(size=(n, 2)), -2 + rng.normal(size=(n, 2)))
    x = rng.normal(size=(n, 3))
    x[:, 1] = 0.5 * x[:, 0] ** 2 + 0.5 * x[:, 1]
    return x


TARGETS = {"gaussian": gaussian, "two modes": two_modes, "banana": banana}
STARTS = {
    "gaussian": [(CENTRE, 2 * COVARIANCE, 0.0)],
    "two modes": [(np.full(2, 2.0), 0.4 * np.eye(2), 0.0), (np.full(2, -2.0), np.eye(2), 0.0)],
    "banana": [(np.zeros(3), np.diag([1.0, 1.0, 1.0]), 0.0)],
}


def sampled(name, log_density=None, seed=1, steps=4000, change=None):
    """Chains as an estimate runs them: population, burn-in, frozen proposal."""
    log_density = log_density or TARGETS[name]
    rng = np.random.default_rng(seed)
    particles, proposal = population(log_density, mixture_of_peaks(STARTS[name]), rng)
    burn_in = metropolis_hastings(log_density, proposal, particles, particles[:4], 300, rng).draws
    particles = burn_in[:, 75:].reshape(-1, particles.shape[1])
    proposal = defended(refitted(proposal, particles, 0.2 * len(particles)))
    if change:
        proposal = change(proposal)
    starts = burn_in[:, -1]
    return metropolis_hastings(log_density, proposal, particles, starts, steps, rng)


def deviations(name, draws):
    """Largest deviation of moments and quantiles from the truth's, in Monte Carlo errors."""
    truth = exact(name)
    worst = 0.0
    for k in range(truth.shape[1]):
        x, known = draws[..., k], truth[:, k]
        centre = known.mean()
        cuts = np.quantile(known, [0.05, 0.25, 0.5, 0.75, 0.95])
        for f in (
            lambda v, c=centre: v,
            lambda v, c=centre: (v - c) ** 2,
            *(lambda v, c=c: (v < c).astype(float) for c in cuts),
        ):
            seen, expected = f(x), f(known)
            error = expected.std() * np.sqrt(1 / ess_bulk(seen) + 1 / len(known))
            worst = max(worst, abs(seen.mean() - expected.mean()) / error)
        worst = max(worst, 0.0 if rhat(x) < 1.01 else np.inf)
    return worst


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", TARGETS)
def test_chains_draw_from_the_density(name, seed):
    chains = sampled(name, seed=seed)
    assert chains.draws.shape == (4, 4000, exact(name, 2).shape[1])
    assert deviations(name, chains.draws) < 4.2
    assert chains.accepted > 0.3


class Wrong(Proposal):
    """A proposal whose log density is not that of its draws."""

    def __init__(self, proposal, off):
        self.__dict__ = vars(proposal)
        self._off = off

    def log_density(self, points):
        return self._off(points, super().log_density(points))


WRONG = {
    "no Hastings correction": lambda points, level: np.zeros(len(points)),
    "half of it": lambda points, level: 0.5 * level,
}


@pytest.mark.parametrize("how", ["no Hastings correction", "half of it"])
def test_a_wrong_sampler_fails_the_same_harness(how):
    for name in ("gaussian", "banana"):
        chains = sampled(name, change=lambda p: Wrong(p, WRONG[how]))
        assert deviations(name, chains.draws) > 6


def test_a_wrong_target_fails_the_same_harness():
    chains = sampled("gaussian", lambda points: 1.1 * gaussian(points))  # 5 % narrower
    assert deviations("gaussian", chains.draws) > 5


def test_proposals_density_is_that_of_its_draws():
    mixture = Mixture(
        np.array([0.3, 0.7]),
        np.array([[0.0, 0.0], [3.0, -1.0]]),
        np.array([np.diag([1.0, 0.25]), [[2.0, 0.8], [0.8, 1.0]]]),
    )
    proposal = Proposal(mixture)
    axis = np.linspace(-40, 40, 1601)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    density = np.exp(proposal.log_density(grid.reshape(-1, 2))).reshape(1601, 1601) * 0.05**2
    assert density.sum() == pytest.approx(1.0, abs=2e-3)
    drawn = proposal.draw(20000, np.random.default_rng(1))
    for k in range(2):
        known = np.cumsum(density.sum(axis=1 - k))
        place = np.interp(drawn[:, k], axis + 0.025, known)
        assert stats.kstest(place, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("name", ["gaussian", "banana"])
def test_a_population_finds_its_way_from_three_sd_off(name):
    truth = exact(name, 20000)
    size = truth.shape[1]
    away = 3 * (-1) ** np.arange(size) / np.sqrt(size)  # along no axis
    off = truth.mean(axis=0) + np.linalg.cholesky(np.cov(truth.T)) @ away
    start = mixture_of_peaks([(off, np.cov(truth.T), 0.0)])
    particles, proposal = population(TARGETS[name], start, np.random.default_rng(3))
    assert np.isfinite(particles).all()
    shift = (particles.mean(axis=0) - truth.mean(axis=0)) / truth.std(axis=0)
    assert np.abs(shift).max() < 0.5
    np.testing.assert_allclose(particles.std(axis=0), truth.std(axis=0), rtol=0.35)
    fresh = proposal.draw(4000, np.random.default_rng(4))
    weight = TARGETS[name](fresh) - proposal.log_density(fresh)
    assert effective_number(weight) > 0.2 * len(fresh)


def test_a_second_mode_is_kept_where_both_are_known():
    particles, _ = population(
        two_modes, mixture_of_peaks(STARTS["two modes"]), np.random.default_rng(1)
    )
    assert abs((particles[:, 0] > 0.5).mean() - 0.3) < 0.1


def test_same_seed_same_draws():
    one, two, other = (sampled("banana", seed=s, steps=50).draws for s in (5, 5, 6))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


def test_weights():
    assert effective_number(np.full(50, 3.0)) == pytest.approx(50)
    assert effective_number(np.array([0.0, -1e3])) == pytest.approx(1)
    steep = -5.0 * np.arange(100.0)
    flat = tempered(steep, 20.0)
    assert flat.sum() == pytest.approx(1)
    assert 20.0 <= effective_number(np.log(flat)) < 40
    weight = np.array([0.5, 0.0, 0.3, 0.2])
    chosen = np.bincount(resampled(weight, 1000, np.random.default_rng(0)), minlength=4)
    np.testing.assert_allclose(chosen, 1000 * weight, atol=1.01)


def test_as_many_chains_as_are_asked_for():
    def told(draws):
        return True

    rng = np.random.default_rng(4)
    start = mixture_of_peaks(STARTS["banana"])
    chains, _ = sample(banana, start, told, chains=64, most=100, rng=rng)
    assert chains.draws.shape == (64, 100, 3)


@pytest.mark.parametrize("reach", [0.5, 0.8, 1.5])
def test_a_density_that_is_almost_nowhere_is_sampled_all_the_same(reach):
    """Bounds of a prior may leave no, or a few, points of the first population."""
    size = 9

    def almost_nowhere(points):
        inside = np.linalg.norm(points, axis=1) < reach
        return np.where(inside, -0.5 * (points**2).sum(axis=1), -np.inf)

    start = mixture_of_peaks([(np.zeros(size), np.eye(size), 0.0)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        chains, _ = sample(almost_nowhere, start, lambda d: False, 8, 400, np.random.default_rng(1))
    assert chains.draws.shape == (8, 400, size)
    assert (np.linalg.norm(chains.draws, axis=-1) < reach).all()
