import warnings

import mpmath
import numpy as np
import pytest
from scipy import stats

from sasmap.ripples.clip import bin_clip
from sasmap.ripples.kernel import lit_fractions, log_likelihood, log_prior, relative_intensity
from sasmap.ripples.likelihood import Prior, log_truncated_normal, speckle_data
from sasmap.ripples.scattering import lit_amplitude, shadow_crest_rule, shadow_line_of_sight
from tests.helpers import clip_of, zare_cobb_clip

TRUTH = (0.6, 0.07)


def at_centre(clip, frequency):
    """Phase at the clip's centre of a wave whose phase is zero at the track."""
    return 2 * np.pi * frequency * (clip.ground_range.min() + clip.ground_range.max()) / 2


@pytest.mark.parametrize("near", [1.2, 12.2, 24.4, 36.6])
@pytest.mark.parametrize("shadow", ["none", "crest", "line-of-sight"])
def test_kernel_equals_the_reference_model(near, shadow):
    clip = zare_cobb_clip(near, near + 12.2, *TRUTH)
    data = speckle_data(bin_clip(clip).pooled(1.7), shadow)
    theta = np.array([*TRUTH, at_centre(clip, 0.6), np.log(1e-3)])
    shape, weight = np.empty((2, 500))
    relative_intensity(theta, data, 0, shape, weight)
    r = clip.ground_range[0]
    phase = 2 * np.pi * 0.6 * r
    lit = lit_amplitude(np.arctan2(4.83, r), np.cos(phase), 1.0, 2 * np.pi * 0.6 * 0.07)
    if shadow == "crest":
        lit = np.where(shadow_crest_rule(phase, r, 4.83, *TRUTH), 0, lit)
    elif shadow == "line-of-sight":
        fine = np.arange(max(r[0] - 1.8, 1e-3), r[-1] + 1e-3, 1e-3)
        rise = (0.07 * np.sin(2 * np.pi * 0.6 * fine) - 4.83) / fine
        highest = np.maximum.accumulate(rise)[np.searchsorted(fine, r) - 1]
        lit = np.where((0.07 * np.sin(phase) - 4.83) / r < highest, 0, lit)
    expected = lit**2 / np.mean(lit_amplitude(np.arctan2(4.83, r), 0, 1.0, 0.0) ** 2) + 1e-3
    off = ~np.isclose(shape, expected, rtol=1e-9)
    assert off.sum() <= 4  # pixels whose centre lies within rounding of a shadow's edge


def test_shadow_of_bins_filled_by_their_pixels_is_their_mean():
    clip = zare_cobb_clip(24.4, 36.6, *TRUTH, size=100)
    binned = bin_clip(clip).pooled(1.7)
    theta = np.array([*TRUTH, at_centre(clip, 0.6), np.log(1e-3)])
    full = speckle_data(binned, "line-of-sight")._replace(spread=1.0)
    lit = np.empty(100)
    lit_fractions(theta, full, 0, lit)
    r = 24.4 - 1.7 + np.arange((12.2 + 1.7) / 1e-3) * 1e-3
    hidden = shadow_line_of_sight(0.07 * np.sin(2 * np.pi * 0.6 * r), r, 4.83)[1700:]
    fraction = 1 - hidden.reshape(100, 122).mean(axis=1)
    np.testing.assert_allclose(lit, fraction, atol=0.03)
    assert abs(lit.mean() - fraction.mean()) < 2e-3


def test_integrating_the_gain_changes_nothing_but_a_constant():
    rng = np.random.default_rng(4)
    r = 30 + 0.05 * np.arange(60)
    clip = clip_of(rng.rayleigh(1.0, (40, 60)), r, 5.0, 0.05)
    data = speckle_data(bin_clip(clip).pooled(1.0), "line-of-sight")
    shape, weight = np.empty((2, 60))

    def integrated(theta):
        relative_intensity(theta, data, 0, shape, weight)
        n, total = data.pixels.sum(), (data.total[0] / shape).sum()
        logs = (data.pixels[0] * np.log(shape)).sum()
        with mpmath.workdps(40):
            # integral of G^-(n+1) exp(-total / G) over G
            value = mpmath.log(mpmath.gamma(n)) - n * mpmath.log(total) - logs
        return float(value)

    points = [np.array([1.0, h, b, np.log(0.02)]) for h in (0.01, 0.05) for b in (0.3, 2.0)]
    offsets = [log_likelihood(p, data) - integrated(p) for p in points]
    np.testing.assert_allclose(offsets, offsets[0], atol=1e-7)


def test_likelihood_ignores_the_scale_of_amplitudes_and_prefers_the_truth():
    clip = zare_cobb_clip(24.4, 36.6, *TRUTH)
    data = speckle_data(bin_clip(clip).pooled(1.7), "crest")
    best = np.array([*TRUTH, at_centre(clip, 0.6), np.log(1e-3)])
    level = log_likelihood(best, data)
    for change in (
        [0.01, 0, 0, 0],
        [0, 0.01, 0, 0],
        [0, -0.01, 0, 0],
        [0, 0, 0.3, 0],
        [0, 0, 0, 3],
    ):
        assert log_likelihood(best + change, data) < level - 100


@pytest.mark.parametrize(
    ("mean", "sd"), [(0.5, 0.1), (0.5, 1e6), (-30.0, 0.3), (40.0, 0.4), (0.5, 1e-6)]
)
def test_truncated_gaussian_far_outside_its_bounds(mean, sd):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        x = np.array([-0.1, 0.0, 0.3, 1.0, 1.1])
        got = log_truncated_normal(x, mean, sd, 0.0, 1.0)
    assert np.isneginf(got[[0, -1]]).all()
    with mpmath.workdps(60):
        low, high = ((mpmath.mpf(v) - mean) / sd for v in (0, 1))
        if mean > 0.5:  # mirrored, so that erfc does not cancel
            low, high = -high, -low
        mass = (mpmath.erfc(low / mpmath.sqrt(2)) - mpmath.erfc(high / mpmath.sqrt(2))) / 2
        for value, density in zip(x[1:-1], got[1:-1], strict=True):
            z = (mpmath.mpf(float(value)) - mean) / sd
            exact = -z * z / 2 - mpmath.log(sd * mpmath.sqrt(2 * mpmath.pi)) - mpmath.log(mass)
            assert abs(density - float(exact)) < 1e-9 * max(1, abs(float(exact)))


def test_compiled_prior_is_the_truncated_gaussian_with_correlation():
    prior = Prior((0.6, 0.1), (0.05, 0.02), ((0.1, 1.0), (0.0, 0.3)), 0.5)
    compiled = prior.compiled()
    joint = stats.multivariate_normal([0.6, 0.1], [[0.0025, 0.0005], [0.0005, 0.0004]])
    noise = np.log(0.01)
    points = [(0.6, 0.1), (0.55, 0.12), (0.7, 0.02)]
    got = [log_prior(np.array([f, h, 0.0, noise]), compiled) for f, h in points]
    expected = [joint.logpdf(p) for p in points]
    np.testing.assert_allclose(np.diff(got), np.diff(expected))
    assert log_prior(np.array([0.05, 0.1, 0.0, noise]), compiled) == -np.inf
    assert log_prior(np.array([0.6, -0.01, 0.0, noise]), compiled) == -np.inf
    flat = Prior.flat((0.1, 1.0), (0.0, 0.3)).compiled()
    assert log_prior(np.array([0.2, 0.0, 0.0, noise]), flat) == log_prior(
        np.array([0.9, 0.3, 5.0, noise]), flat
    )
