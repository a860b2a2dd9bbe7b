"""What a pixel is worth, and f can be told to, where the model errs."""

import numpy as np
import pytest

from sasmap.ripples import errors
from sasmap.ripples.errors import (
    ERROR_CELLS,
    bin_weights,
    local_light,
    per_cycle,
    slope_error,
    turned_by_errors,
    with_errors,
    with_fitted_errors,
    without_local_light,
)
from sasmap.ripples.optimise import TREND, fisher_scoring, free_coordinates
from sasmap.ripples.rendered import expected_at, pulses_at
from sasmap.ripples.rendering import line_of_lags, parameters_at
from tests.ripples.engine import BINS, LAMBERT, fit_of, noiseless, ripple

PIXEL = 0.03


def weights(fit):
    return bin_weights(fit, fit.data, PIXEL)


def misfit(fit):
    """Relative error of the expected intensity that the model errors do not explain, rms."""
    means, data = with_fitted_errors(fit), fit.data
    beyond = data.intensity_sum / (data.pixel_count * means) - 1
    return float(np.sqrt(np.average(beyond**2, weights=np.minimum(means, 1) ** 2)))


def worth(fit):
    """Independent pixels that the clip is worth."""
    return float((weights(fit) * fit.data.pixel_count).sum())


def test_without_misfit_more_ranges_tell_more():
    few, many = (worth(fit_of(n, np.ones((n, BINS)))) for n in (4, 12))
    assert many > 1.7 * few  # what displaces the pulse is shared


def test_a_misfit_that_all_ranges_share_counts_once():
    wave = 1 + 0.2 * np.cos(2 * np.pi * 5 * (np.arange(BINS) + 0.5) / BINS)
    few, many = (worth(fit_of(n, np.tile(wave, (n, 1)))) for n in (4, 12))
    assert many < 1.3 * few
    assert many < 0.2 * worth(fit_of(12, np.ones((12, BINS))))


def test_a_misfit_of_each_range_averages_out():
    rng = np.random.default_rng(2)
    misfit = np.repeat(1 + 0.2 * rng.choice([-1.0, 1.0], (12, 16)), 3, axis=1)
    few, many = (worth(fit_of(n, misfit[:n])) for n in (4, 12))
    assert many > 2 * few


def test_edges_of_a_pulse_tell_less_where_crests_bend():
    straight, bent = (weights(fit_of(6, np.ones((6, BINS)), rigid)) for rigid in (True, False))
    assert (bent <= straight).all()
    assert bent.min() < 0.5 * bent.max()  # flanks less than crests


def test_the_edge_of_a_shadow_is_that_at_the_range_of_the_bins_own_pixels():
    plain = fit_of(4, np.ones((4, BINS)), height=0.18)
    shape = plain.data.pixel_count.shape
    near, far = (
        plain._replace(data=plain.data._replace(range_offset=np.full(shape, off)))
        for off in (-0.2, 0.2)
    )
    even = np.arange(BINS) % 2 == 0  # of straight crests neighbours may come from other waves
    offsets = np.where(even, 0.2, -0.2) * np.ones(shape)
    mixed = plain._replace(data=plain.data._replace(range_offset=offsets))
    expected = np.where(even, per_cycle(far), per_cycle(near))
    assert np.abs(expected).max() > 30
    assert per_cycle(mixed) == pytest.approx(expected, rel=0.02, abs=1.0)  # gains differ


def test_a_little_light_in_shadow_costs_nothing_elsewhere():
    deep = {"height": 0.18, "noise": 1e-4}
    plain = fit_of(4, np.ones((4, BINS)), **deep)
    means = expected_at(plain, plain.z)[0]
    dark = (means < 1e-3).all(axis=0)
    bright = (means > 0.3).any(axis=0)
    assert dark.sum() > 3
    lit = np.ones((4, BINS))
    lit[1, dark] = 10.0  # still less than a hundredth of the mean
    without, with_light = (weights(fit) for fit in (plain, fit_of(4, lit, **deep)))
    assert with_light[:, bright].sum() > 0.8 * without[:, bright].sum()
    assert without[:, dark].max() < 0.05 * without[:, bright].max()


def test_light_as_bright_as_the_clip_where_shadow_is_foretold_counts():
    deep = {"height": 0.18, "noise": 1e-4}
    plain = fit_of(4, np.ones((4, BINS)), **deep)
    means = expected_at(plain, plain.z)[0]
    dark = (means < 1e-3).all(axis=0)
    data = plain.data
    light = np.where(dark, 0.5 * data.pixel_count, 0.0)
    wrong = plain._replace(data=data._replace(intensity_sum=data.intensity_sum + light))
    assert worth(wrong) < 0.1 * worth(plain)


def lit_shadows(ranges):
    """A fit to deep shadow that is lit in some of eight ranges, and its dark bins."""
    plain = fit_of(8, np.ones((8, BINS)), height=0.18, noise=0.01)
    cells = (expected_at(plain, plain.z)[0] < 0.05).all(axis=0).reshape(ERROR_CELLS, -1)
    dark = np.repeat(cells.all(axis=1), BINS // ERROR_CELLS)
    light = np.where(dark, 0.1 * plain.data.pixel_count, 0.0)
    light[~np.isin(plain.data.group, ranges)] = 0.0
    data = plain.data._replace(intensity_sum=plain.data.intensity_sum + light)
    return plain._replace(data=data), dark


def before_the_fit(fit):
    data = fit.data
    return without_local_light(data).pixel_count / data.pixel_count


@pytest.mark.parametrize(
    ("weigh", "ranges"), [(weights, [2]), (before_the_fit, [2]), (before_the_fit, [0, 2, 3, 5, 6])]
)
def test_shadows_that_are_lit_at_some_ranges_count_for_little_there_and_only_there(weigh, ranges):
    plain, dark = lit_shadows([])
    before, after = weigh(plain), weigh(lit_shadows(ranges)[0])
    here = np.isin(plain.data.group, ranges)
    assert after[here][:, dark].sum() < 0.05 * before[here][:, dark].sum()
    assert after[~here].sum() > 0.9 * before[~here].sum()
    # one error of all the dark pixels of a range
    assert (after * plain.data.pixel_count)[here][:, dark].sum() < 3 * len(ranges)


def test_light_in_the_shadows_of_all_ranges_is_no_local_error():
    lit, dark = lit_shadows(range(8))
    assert before_the_fit(lit)[:, dark].min() > 0.99
    expected = np.full((4, 3), 0.01)
    assert (local_light(np.ones((4, 3)), expected + 0.2, expected) == 0).all()


def test_what_the_errors_of_the_law_explain_is_no_misfit():
    exact = fit_of(6, np.ones((6, BINS)))
    law = exact.geometry._replace(law_error=np.array([0.0, 0.3, 0.3, -0.3, 0.0, 0.0]))
    seen = expected_at(exact._replace(geometry=law), exact.z)[0]
    other = exact.data._replace(intensity_sum=exact.data.pixel_count * seen)
    wrong = exact._replace(data=other)
    before = misfit(wrong)
    assert misfit(with_errors(wrong)) < 0.3 * before


def with_trend(fit, height, change):
    """The fit's histogram of ripples whose log height changes over range, block by block."""
    across = (fit.data.place - fit.data.place.min()) / np.ptp(fit.data.place)
    seen = np.empty_like(fit.data.pixel_count)
    for k, scale in enumerate(np.exp(change * np.cos(np.pi * across))):
        truth = ripple(height * scale, LAMBERT, blur=0.03, noise=0.01, noise_slope=1.0)
        seen[k] = noiseless(truth, fit.data, fit.geometry).intensity_sum[k]
    return fit._replace(data=fit.data._replace(intensity_sum=seen))


def climbed(fit, *held):
    """The fit at the peak of its histogram, some coordinates held."""
    free = np.setdiff1d(free_coordinates(fit.geometry), held)
    return fit._replace(peaks=[fisher_scoring(fit.z, fit.data, fit.geometry, free=free)])


def test_what_heights_that_change_over_range_explain_is_no_misfit():
    wrong = with_trend(fit_of(6, np.ones((6, BINS)), height=0.05), 0.05, 0.15)
    before = misfit(wrong)
    told = misfit(climbed(with_errors(wrong)))
    assert told < 0.35 * before
    # a law alone, or a profile, does not explain it
    assert told < 0.6 * misfit(climbed(with_errors(wrong), *TREND))


@pytest.mark.parametrize("change", [-0.07, 0.07])
def test_heights_in_shadow_that_change_over_range_keep_their_mean(change):
    height = 0.12
    fit = with_trend(fit_of(8, np.ones((8, BINS)), height=height), height, change)
    level, told = (parameters_at(f.z, f.geometry) for f in (climbed(fit, *TREND), climbed(fit)))
    assert told.trend_1 == pytest.approx(change, rel=0.5)
    level, told = (abs(np.log(p.height / height)) for p in (level, told))
    assert told < 0.02
    assert told < level


def test_tilt_is_the_scatter_of_the_wave_number_under_errors_of_each_range():
    rng = np.random.default_rng(6)
    plain = fit_of(8, np.ones((8, BINS)), height=0.05)
    data, pixels = plain.data, plain.data.pixel_count
    told = []
    for _ in range(60):
        cells = 1 + errors.MODEL_ERROR * rng.standard_normal((8, errors.ERROR_CELLS))
        cells = np.repeat(cells, BINS // errors.ERROR_CELLS, axis=1)[data.group]
        seen = data.intensity_sum * cells * rng.gamma(pixels, 1 / pixels)
        other = data._replace(intensity_sum=seen)
        told.append(fisher_scoring(plain.z, other, plain.geometry, free=np.array([0, 1])).z[0])
    assert 0.85 < slope_error(plain, data, 1e-6) / np.std(told) < 1.5


def test_more_range_tells_the_wave_number_better():
    few, many = (fit_of(n, np.ones((n, BINS)), height=0.05) for n in (4, 12))
    assert slope_error(many, many.data, PIXEL) < 0.3 * slope_error(few, few.data, PIXEL)


def test_errors_turn_the_phase_by_as_much_as_their_lags_do():
    steep = with_errors(fit_of(6, np.ones((6, BINS)), height=0.12, noise=1e-3))
    turned = turned_by_errors(steep)
    assert turned.shape == (len(steep.data.errors),)
    sd = errors.THIRD_HARMONIC[0]
    lags = [
        pulses_at(steep._replace(geometry=where), steep.z)[1]
        for where in (
            steep.geometry,
            steep.geometry._replace(third_harmonic=np.array([0.2 * sd, 0.0])),
        )
    ]
    slope = line_of_lags(lags[1] - lags[0], steep.data)[0] / (2 * np.pi)
    assert turned[0] == pytest.approx(slope / 0.2, rel=0.1)


def test_without_errors_nothing_turns():
    plain = fit_of(4, np.ones((4, BINS)))
    assert turned_by_errors(plain).size == 0
