import pickle
import warnings

import mpmath as mp
import numpy as np
import pytest
from scipy import stats

from sasmap.sediments import generalized_k, k_distribution

mp.mp.dps = 40


def exact(x, nu, kappa):
    """Log density by its Bessel functions (G 5, corrected), 40 digits."""
    x, nu, kappa = mp.mpf(x), mp.mpf(nu), mp.mpf(kappa)
    b = 2 * mp.sqrt(nu + kappa**2)
    power = nu * mp.log(2 * nu * x / b) + mp.log(mp.besseli(0, 2 * kappa * x))
    return mp.log(2 * b) - mp.loggamma(nu) + power + mp.log(mp.besselk(nu - 1, b * x))


def integrated(x, nu, kappa):
    """Log density by the integral over texture about its saddle, 40 digits: for any arguments."""
    x, nu, kappa = mp.mpf(x), mp.mpf(nu), mp.mpf(kappa)
    total = nu + kappa**2
    root = mp.sqrt((nu - 1) ** 2 + 4 * total * x * x)
    z = (nu - 1 + root) / (2 * total) if nu > 1 else 2 * x * x / (root - (nu - 1))
    alpha, beta = x * x / z, total * z
    step = min(mp.mpf("0.3") / mp.sqrt(alpha + beta), mp.mpf("0.1"))

    def side(sign):
        value, k = mp.mpf(0), 1
        while True:
            t = sign * k * step
            term = mp.exp(-alpha * (mp.expm1(-t) + t) - beta * (mp.expm1(t) - t))
            if term < mp.mpf(10) ** -38:
                return value
            value, k = value + term, k + 1

    integral = step * (1 + side(1) + side(-1))
    y = 2 * kappa * x
    if y > 1e5:
        terms = [mp.rf(mp.mpf(1) / 2, m) ** 2 / (mp.factorial(m) * (2 * y) ** m) for m in range(12)]
        bessel = mp.log(sum(terms)) - mp.log(2 * mp.pi * y) / 2
    else:
        bessel = mp.log(mp.besseli(0, y)) - y
    drift = (x - kappa * z) ** 2 / z + nu * (z - 1 - mp.log(z)) + mp.log(z)
    return (
        mp.log(2 * x) + bessel + nu * mp.log(nu) - nu - mp.loggamma(nu) - drift + mp.log(integral)
    )


def test_log_density_is_exact_over_the_whole_range():
    rng = np.random.default_rng(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for i in range(160):
            nu = 10 ** rng.uniform(-3, 8)
            kappa = 0.0 if rng.random() < 0.2 else 10 ** rng.uniform(-3, 4)
            rms = np.sqrt(1 + kappa**2 * (1 + 1 / nu))
            x = rms * (10 ** rng.uniform(-12, 4) if i % 2 else abs(1 + 0.3 * rng.normal()))
            got = float(generalized_k.logpdf(x, nu, kappa))
            expected = float(integrated(x, nu, kappa))
            assert abs(got - expected) <= 1e-10 * max(1, abs(expected)), (x, nu, kappa)


@pytest.mark.parametrize(("nu", "kappa"), [(0.3, 0.5), (0.5, 0.0), (1.0, 2.0), (7.0, 0.1)])
def test_reference_by_quadrature_is_the_closed_form(nu, kappa):
    for x in (1e-6, 0.3, 2.0):
        assert abs(integrated(x, nu, kappa) - exact(x, nu, kappa)) < 1e-30


def test_limits_are_reached_smoothly():
    x = np.linspace(0.05, 4, 40)
    root = np.sqrt(0.5)
    rice = stats.rice.logpdf(x, 1.5 / root, scale=root)
    for nu in (1e4, 1e6, 1e8):
        off = np.abs(generalized_k.logpdf(x, nu, 1.5) - rice).max()
        assert off < 100 / nu
    rayleigh = stats.rayleigh.logpdf(x, scale=root)
    assert np.abs(generalized_k.logpdf(x, 1e8, 0.0) - rayleigh).max() < 1e-5
    np.testing.assert_allclose(
        generalized_k.logpdf(x, 2.0, 1e-9), k_distribution.logpdf(x, 2.0), rtol=1e-12
    )
    # a steady amplitude: Gamma(nu, mean delta)
    y = np.linspace(0.2, 3, 10)
    gamma = stats.gamma.logpdf(y, 3.0, scale=1 / 3)
    got = generalized_k.logpdf(y * 1e4, 3.0, 1e4) + np.log(1e4)
    np.testing.assert_allclose(got, gamma, atol=1e-4)


@pytest.mark.parametrize("nu", [1e-3, 0.1, 0.5, 3.0, 1e3, 1e8])
@pytest.mark.parametrize("kappa", [0.0, 1.0, 1e4])
def test_probability_is_one_and_tails_have_their_own_route(nu, kappa):
    law = generalized_k(nu, kappa)
    share = np.array([1e-9, 0.02, 0.5, 0.98])
    x = law.ppf(share)
    held = x > 1e-290  # of a very small nu most samples are less than numbers can be
    assert held.sum() >= 2
    np.testing.assert_allclose(law.cdf(x[held]), share[held], rtol=1e-8)
    np.testing.assert_allclose(law.cdf(x) + law.sf(x), 1, atol=1e-9)
    far = law.isf([1e-3, 1e-12, 1e-200])
    np.testing.assert_allclose(law.sf(far), [1e-3, 1e-12, 1e-200], rtol=1e-8)


def test_k_tail_is_its_closed_form():
    x = np.array([0.1, 1.0, 4.0, 12.0])
    for nu in (0.4, 2.0):
        y = [2 * mp.sqrt(nu) * v for v in x]
        exact_tail = [2 / mp.gamma(nu) * (v / 2) ** nu * mp.besselk(nu, v) for v in y]
        np.testing.assert_allclose(
            k_distribution.sf(x, nu), [float(t) for t in exact_tail], rtol=1e-9
        )


@pytest.mark.parametrize(("nu", "kappa"), [(0.3, 0.5), (3.0, 0.0), (20.0, 2.0)])
def test_samples_agree_with_the_distribution(nu, kappa):
    values = [
        stats.kstest(
            generalized_k.rvs(nu, kappa, size=3000, random_state=i),
            lambda v: generalized_k.cdf(v, nu, kappa),
        ).pvalue
        for i in range(12)
    ]
    assert stats.kstest(values, "uniform").pvalue > 1e-3
    wrong = generalized_k.rvs(1.15 * nu, kappa + 0.3, size=20000, random_state=1)
    assert stats.kstest(wrong, lambda v: generalized_k.cdf(v, nu, kappa)).pvalue < 1e-3


def test_moments():
    for nu, kappa in ((0.4, 0.0), (2.0, 1.3), (1e7, 0.5)):
        law = generalized_k(nu, kappa, scale=2.0)
        assert law.moment(2) == pytest.approx(4 * (1 + kappa**2 * (1 + 1 / nu)), rel=1e-9)
        sample = generalized_k.rvs(nu, kappa, scale=2.0, size=200_000, random_state=1)
        assert law.mean() == pytest.approx(sample.mean(), rel=0.02)
        assert law.moment(4) == pytest.approx((sample**4).mean(), rel=0.2)
    assert k_distribution.mean(1.7) == pytest.approx(generalized_k.mean(1.7, 0.0), rel=1e-10)


def test_it_is_a_distribution_of_scipy():
    law = generalized_k(nu=2.0, kappa=1.0, scale=3.0)
    copy = pickle.loads(pickle.dumps(law))
    assert copy.pdf(2.0) == law.pdf(2.0)
    low, high = law.interval(0.9)
    assert law.cdf(high) - law.cdf(low) == pytest.approx(0.9)
    assert np.isnan(generalized_k.pdf(1.0, -1.0, 0.0))
    np.testing.assert_array_equal(generalized_k.pdf([-1.0, np.inf], 2.0, 1.0), 0.0)
    assert np.isinf(generalized_k.pdf(0.0, 0.4, 1.0))
    assert generalized_k.pdf(0.0, 0.6, 1.0) == 0
    assert generalized_k.logpdf(np.ones((2, 1)), [1.0, 2.0, 3.0], 0.5).shape == (2, 3)


def total(law, x, *parameters):
    *shapes, loc, scale = parameters
    return float(law.logpdf(x, *shapes, loc=loc, scale=scale).sum())


@pytest.mark.parametrize(
    ("law", "shapes", "held"),
    [
        (generalized_k, (2.0, 1.0), {"f0": 2.0}),
        (generalized_k, (2.0, 1.0), {"fkappa": 1.0}),
        (generalized_k, (2.0, 1.0), {"fscale": 3.0, "floc": 0}),
        (generalized_k, (2.0, 1.0), {"fix_nu": 2.0, "f1": 1.0}),
        (k_distribution, (2.0,), {"f0": 2.0}),
        (k_distribution, (2.0,), {"fscale": 3.0}),
    ],
)
def test_a_held_parameter_is_held_and_the_others_are_the_likeliest(law, shapes, held):
    x = law.rvs(*shapes, scale=3.0, size=1500, random_state=4)
    found, free = law.fit(x, **held), law.fit(x)
    names = {"f0": 0, "fix_nu": 0, "f1": 1, "fkappa": 1, "fscale": len(found) - 1, "floc": -2}
    for name, value in held.items():
        assert found[names[name]] == value
    best = total(law, x, *found)
    assert total(law, x, *shapes, 0.0, 3.0) <= best + 1e-6  # the truth holds what is held as well
    assert best <= total(law, x, *free) + 1e-3
    loose = {k for k in range(len(found)) if k not in {names[n] % len(found) for n in held}}
    for k in loose - {len(found) - 2}:
        for step in (0.97, 1.03):
            moved = [v * step if j == k else v for j, v in enumerate(found)]
            assert total(law, x, *moved) < best


def test_a_keyword_that_is_not_known_is_refused():
    x = k_distribution.rvs(2.0, size=50, random_state=1)
    for options in ({"f1": 1.0}, {"fshape": 1.0}, {"scale": 2.0}, {"optimizer": None}):
        with pytest.raises(TypeError, match="unexpected keyword"):
            k_distribution.fit(x, **options)
    with pytest.raises(TypeError, match="starting values"):
        generalized_k.fit(x, 2.0, 1.0)
    with pytest.raises(TypeError, match="two values"):
        generalized_k.fit(x, f0=2.0, fnu=2.0)
    with pytest.raises(ValueError, match="nothing to fit"):
        k_distribution.fit(x, f0=2.0, fscale=1.0)
    with pytest.raises(ValueError, match="moments"):
        generalized_k.fit(x, method="MM", f0=2.0)
    with pytest.raises(ValueError, match="amplitudes begin there"):
        generalized_k.fit(x, floc=1.0)
