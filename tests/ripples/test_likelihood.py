import warnings

import mpmath
import numpy as np
import pytest
from scipy import stats

from sasmap.ripples.clip import DYNAMIC_RANGE
from sasmap.ripples.fit import Task, fit_wave
from sasmap.ripples.image import as_image
from sasmap.ripples.kernel import log_likelihood, log_prior, pulses, shadow_places
from sasmap.ripples.likelihood import Prior, log_truncated_normal
from sasmap.ripples.pixels import EDGE_ACROSS, EDGE_ALONG, EDGE_BLOCK, EDGE_PAST, EDGE_POWER
from sasmap.ripples.scattering import lit_amplitude, shadow_crest_rule, shadow_line_of_sight
from sasmap.ripples.settings import RippleSettings
from tests.helpers import clip_of, zare_cobb_clip

TRUTH = (0.6, 0.07)
PRIOR = Prior.flat((0.05, 5.0), (0.0, 0.5))


def fitted(clip, shadow, frequency=0.6):
    """A clip's fold by straight crests square-on, and the point that was climbed to."""
    image = as_image(clip)
    task = Task(image, shadow, RippleSettings(profile="sine"), PRIOR, PRIOR.compiled(90.0))
    return fit_wave(task, frequency * image.look)


def true_intensity(ground_range, shadow, n=40):
    """Lit a*^2 over the flat sea floor's, on n points a pixel, phase zero at the track."""
    step = ground_range[1] - ground_range[0]
    start = max(ground_range[0] - 1.8, 1e-3)
    fine = np.arange(start, ground_range[-1] + step, step / n)
    phase = 2 * np.pi * TRUTH[0] * fine
    grazing = np.arctan2(4.83, fine)
    lit = lit_amplitude(grazing, np.cos(phase), 1.0, 2 * np.pi * TRUTH[0] * TRUTH[1])
    if shadow == "crest":
        hidden = shadow_crest_rule(phase, fine, 4.83, *TRUTH)
    elif shadow == "line-of-sight":
        hidden = shadow_line_of_sight(TRUTH[1] * np.sin(phase), fine, 4.83)
    else:
        hidden = np.zeros(fine.size, bool)
    value = np.where(hidden, 0, lit) ** 2
    floor = lit_amplitude(np.arctan2(4.83, ground_range), 0.0, 1.0, 0.0) ** 2
    return np.interp(ground_range, fine, value) / floor.mean()


@pytest.mark.parametrize("near", [12.2, 24.4, 36.6])
@pytest.mark.parametrize("shadow", [None, "crest", "line-of-sight"])
def test_pulses_at_the_truth_are_the_reference_model(near, shadow):
    step = 12.2 / 500
    r = near + step * (np.arange(500) + 0.5)
    truth = true_intensity(r, shadow)
    speckle = np.random.default_rng(1).rayleigh(1.0, (500, 500))
    fit = fitted(clip_of(np.sqrt(truth) * speckle, r, 4.83, step), shadow)
    data, centre = fit.data, (r[0] + r[-1]) / 2
    phase = 2 * np.pi * TRUTH[0] * centre
    theta = np.array([*TRUTH, data.look, phase, np.log(1e-5), 0.0])
    place = data.along[:, None] + data.ahead
    turn = phase - data.reference[0] + 2 * np.pi * (TRUTH[0] - data.reference[1]) * place
    angle = np.arctan2(data.sine, data.cosine) + turn
    grazing = np.arctan2(4.83, centre + place)
    expected = lit_amplitude(grazing, np.cos(angle), 1.0, 2 * np.pi * TRUTH[0] * TRUTH[1]) ** 2
    model, clear, _ = pulses(theta, data)
    sides = data.along.size // data.group.size
    used = clear & (data.known > 0)
    off = []
    for group in np.unique(data.group):  # each has its own gain
        here = used & np.repeat(data.group == group, sides)[:, None]
        gain = np.median(model[here] / expected[here])
        off.extend(np.abs(model[here] / gain - expected[here]) / expected[here].mean())
    assert np.quantile(off, 0.98) < 0.01
    assert np.median(off) < 0.002
    if (
        shadow and near > 20
    ):  # what counts as in shadow is dark: no more than the floor added to every pixel
        assert data.dark[:, 0].sum() > 1000
        assert data.dark[:, 1].sum() < 1.01 * DYNAMIC_RANGE * data.dark[:, 0].sum()


def test_edges_of_shadow_lie_where_pixels_turn_dark():
    clip = zare_cobb_clip(24.4, 36.6, *TRUTH, rule="line-of-sight")
    fit = fitted(clip, "line-of-sight")
    data, centre = fit.data, float(clip.ground_range.mean())
    theta = np.array([*TRUTH, data.look, 2 * np.pi * TRUTH[0] * centre, np.log(1e-5), 0.0])
    places = shadow_places(theta, data)
    begin, end = places[data.edges[:, EDGE_BLOCK].astype(int)].T
    turn = (theta[3] - data.reference[0]) / (2 * np.pi)
    turn += (TRUTH[0] - data.reference[1]) * data.edges[:, EDGE_ALONG]
    turn -= data.reference[2] * data.edges[:, EDGE_ACROSS]
    past = data.edges[:, EDGE_PAST] + turn
    inside = 0.5 * (end - begin) - np.abs((past - 0.5 * (begin + end) + 0.5) % 1 - 0.5)
    dark = data.edges[:, EDGE_POWER] < 2 * DYNAMIC_RANGE
    far = np.abs(inside[dark != (inside > 0)]) > 0.2 * data.pixel
    assert 100 < dark.sum() < 0.9 * dark.size
    assert far.sum() < 0.01 * dark.size


def test_integrating_the_gain_changes_nothing_but_a_constant():
    rng = np.random.default_rng(4)
    r = 30 + 0.05 * np.arange(60)
    ripples = 1 + 0.3 * np.cos(2 * np.pi * 2 * r)
    data = fitted(clip_of(ripples * rng.rayleigh(1.0, (40, 60)), r, 5.0, 0.05), None, 2.0).data
    assert not data.field
    data = data._replace(power=1.0)
    sides = data.along.size // data.group.size

    def integrated(theta):
        shape, _, _ = pulses(theta, data)
        value = 0.0
        for group in np.unique(data.group):
            rows = np.repeat(data.group == group, sides)
            n, s = data.known[rows], shape[rows]
            total = (data.total[rows] / s).sum()
            # integral over G of G^-(n+1) prod s^-n exp(-total / G), at any scale of s
            count = n.sum()
            with mpmath.workdps(40):
                value += mpmath.loggamma(count) - count * mpmath.log(total)
            value -= float((n * np.log(s)).sum())
        return float(value)

    points = [
        np.array([2.0, h, data.look, b, np.log(0.02), 0.0])
        for h in (0.005, 0.02)
        for b in (0.3, 2.0)
    ]
    offsets = [log_likelihood(p, data) - integrated(p) for p in points]
    np.testing.assert_allclose(offsets, offsets[0], atol=1e-6)


def test_likelihood_prefers_the_truth():
    clip = zare_cobb_clip(24.4, 36.6, *TRUTH)
    fit = fitted(clip, "crest")
    np.testing.assert_allclose(fit.theta[:2], TRUTH, rtol=0.01)
    for i, change in ((0, 0.01), (1, 0.01), (1, -0.01), (2, 0.02), (3, 0.3), (4, 3.0)):
        moved = fit.theta.copy()
        moved[i] += change
        assert log_likelihood(moved, fit.data) < log_likelihood(fit.theta, fit.data) - 20


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
    data = fitted(zare_cobb_clip(24.4, 36.6, *TRUTH), "crest").data
    prior = Prior((0.6, 0.1), (0.05, 0.02), ((0.1, 1.0), (0.0, 0.3)), 0.5, (275.0, 10.0))
    compiled = prior.compiled(90.0)
    joint = stats.multivariate_normal([0.6, 0.1], [[0.0025, 0.0005], [0.0005, 0.0004]])

    def at(f, h, turn, prior=compiled):
        return log_prior(
            np.array([f, h, data.look + np.radians(turn), 1.0, -4.0, 0.0]), data, prior
        )

    points = [(0.6, 0.1, 5.0), (0.55, 0.12, -7.0), (0.7, 0.02, 30.0)]
    # an axis of 275 degrees is one of 95, 5 right of the look
    expected = [joint.logpdf(p[:2]) - 0.5 * ((p[2] - 5) / 10) ** 2 for p in points]
    np.testing.assert_allclose(np.diff([at(*p) for p in points]), np.diff(expected))
    assert at(0.05, 0.1, 0.0) == at(0.6, -0.01, 0.0) == at(0.6, 0.1, 91.0) == -np.inf
    flat = Prior.flat((0.1, 1.0), (0.0, 0.3)).compiled(90.0)
    assert at(0.2, 0.0, -60.0, flat) == at(0.9, 0.15, 80.0, flat)
    assert at(0.9, 0.3, 80.0, flat) == -np.inf  # steeper than sand stands
