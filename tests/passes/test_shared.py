"""What looks share, learned from looks whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from sasmap.passes.agreement import agreeing, distances_of, together
from sasmap.passes.combination import reach_after_each
from sasmap.passes.evidence import with_prior
from sasmap.passes.fusion import fuse_cells, learn_survey
from sasmap.passes.heights import without_scatter
from sasmap.passes.information import Information, moments, products, widened
from sasmap.passes.looks import (
    LAW,
    LAW_MEAN,
    LAW_VARIANCE,
    Shared,
    _likelihood,
    _priors,
    collect,
    law_factor,
)
from sasmap.passes.shared import SurveyModel
from sasmap.passes.summary import Summary, contrast_slopes, log_contrast
from sasmap.ripples import RippleSettings
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.ripples.priors import NATURAL_STEEPNESS
from sasmap.ripples.rendering import contrast_per_slope

SETTINGS = RippleSettings()
ALTITUDE = 5.0
MEDIAN, SD = NATURAL_STEEPNESS


def told(mean, covariance, tangent, about, value, sd, of_f=False):
    """Condition a Gaussian on log A_H, or log of f A_H, linear about a law."""
    row = np.array([of_f, 1, 0, *-contrast_slopes(about, tangent)])
    expected = row @ mean - log_contrast(about, tangent) - row[3:] @ about
    gain = covariance @ row / (row @ covariance @ row + sd**2)
    return mean + gain * (value - expected), covariance - np.outer(gain, row @ covariance)


def seen(rng, f, height, law, grazing, with_shadow, altitude_error=0.0, shape=None):
    """Posterior of a look that tells contrast to 2 %, or to 10 % and by shadow A_H to 3 %."""
    tangent = np.tan(np.radians(grazing))
    contrast = np.log(height) + log_contrast(law, tangent)
    mean = np.array([np.log(f), contrast, 40.0, *LAW_MEAN])
    error = [1e-3, 0.1 if with_shadow else 0.02, 0.3]
    mean[:3] += rng.normal(0, error)
    mean[1] += altitude_error
    covariance = np.diag([*error, *np.sqrt(LAW_VARIANCE)]) ** 2
    if with_shadow:  # a measurement of log A_H, linear about the true law
        measured = np.log(height) + altitude_error + rng.normal(0, 0.03)
        mean, covariance = told(mean, covariance, tangent, law, measured, 0.03)
    elif shape is not None:  # n by the shape of the pulse, to 0.8, and wrong by so much
        precision = np.linalg.inv(covariance)
        push = precision @ mean
        precision[3, 3] += 0.8**-2
        push[3] += (law[0] + shape + rng.normal(0, 0.8)) * 0.8**-2
        covariance = np.linalg.inv(precision)
        mean = covariance @ push
    # the prior of natural steepness, linear about the law that comes out
    about = LAW_MEAN
    for _ in range(4):
        both = told(mean, covariance, tangent, about, np.log(0.5 * MEDIAN), SD, of_f=True)
        about = both[0][3:]
    mean, covariance = both
    return Summary(
        Quality.GOOD,
        LeftOut(0),
        mean=(f, height),
        sd=(1e-3 * f, 0.05 * height),
        azimuth=(40.0, 0.3),
        mixture=((1.0, *mean, *covariance.ravel()),),
        tangent=tangent,
        altitude=ALTITUDE,
        altitude_gain=1.0,
        altitude_sd=0.05,
        ess_bulk=(1,) * 3,
    )


def survey(
    seed, cells, shadowed, passes=1, law=(2.2, 0.1), spread=(0.15, 0.05), errors=None, shape=None
):
    """Cells of one survey and their true (f, A_H)."""
    rng = np.random.default_rng(seed)
    errors = np.zeros(passes) if errors is None else errors
    found, truth = [], []
    for i in range(cells):
        f = rng.uniform(0.4, 1.2)
        height = 0.045 / f * np.exp(rng.normal(0, 0.4))
        own = rng.normal(law, spread)
        found.append(
            [
                seen(rng, f, height, own, rng.uniform(8, 30), i < shadowed, error, shape)
                for error in errors
            ]
        )
        truth.append(height)
    return found, np.array(truth)


def heights(cells, model):
    fused = fuse_cells(cells, SETTINGS, model)
    low, high, mean = (
        np.array([getattr(c.final, name)[1] for c in fused]) for name in ("q05", "q95", "mean")
    )
    return low, mean, high, fused


def test_contrast_is_that_of_the_rendered_wavelength():
    for law in ([2.0, 0.0], [0.5, 1.2]):
        for tangent in (0.1, 0.6):
            expected = np.log(contrast_per_slope(*law, tangent))
            assert log_contrast(np.array(law), tangent) == pytest.approx(expected)
            step = 1e-6
            for i, slope in enumerate(contrast_slopes(np.array(law), tangent)):
                moved = np.array(law)
                moved[i] += step
                rise = (log_contrast(moved, tangent) - log_contrast(np.array(law), tangent)) / step
                assert slope == pytest.approx(rise, rel=1e-4)


def test_factors_multiply_and_blur_as_gaussians_do():
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(2, 3, 3))
    covariance = roots @ roots.transpose(0, 2, 1) + np.eye(3)
    mean = rng.normal(size=(2, 3))
    factors = []
    for m, c in zip(mean, covariance, strict=True):
        precision = np.linalg.inv(c)
        level = stats.multivariate_normal(m, c).logpdf(np.zeros(3))
        factors.append(
            Information(np.array([[level]]), (precision @ m)[None, None], precision[None, None])
        )
    sd = np.array([0.3, 1.0, 2.0])
    blurred = widened(factors[0], sd)
    level, centre, spread = moments(blurred)
    np.testing.assert_allclose(centre[0, 0], mean[0], rtol=1e-9)
    np.testing.assert_allclose(spread[0, 0], covariance[0] + np.diag(sd**2), rtol=1e-9)
    log_2pi = 1.5 * np.log(2 * np.pi)
    assert level[0, 0] + log_2pi == pytest.approx(0.0, abs=1e-9)
    looks = Information(*(np.concatenate(v) for v in zip(*factors, strict=True)))
    nothing = Information(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3, 3)))
    both = products(looks, np.array([2]), nothing, 1)
    expected = stats.multivariate_normal(mean[0], covariance.sum(axis=0)).logpdf(mean[1])
    assert both[0] + log_2pi == pytest.approx(expected)


def test_shadow_in_some_cells_tells_the_height_of_the_others():
    cells, truth = survey(2, 80, 20)
    model = learn_survey(cells, SETTINGS, 1)
    low, mean, high, _ = heights(cells, model)
    inside = (low < truth) & (truth < high)
    assert inside[:20].mean() >= 0.75
    assert inside[20:].mean() >= 0.8
    assert np.median(np.abs(mean / truth - 1)[20:]) < 0.1
    alone, _, wide, _ = heights(cells[20:], learn_survey(cells[20:], SETTINGS, 1))
    assert np.median((wide - alone) / (high - low)[20:]) > 4  # nothing breaks the tie
    assert abs(model.middle.law[0] - 2.2) < 0.4


def test_a_law_that_changes_from_cell_to_cell_is_not_taken_for_one():
    narrow = learn_survey(survey(3, 80, 40, spread=(0.05, 0.02))[0], SETTINGS, 1).middle.spread[0]
    cells, truth = survey(3, 80, 40, spread=(0.6, 0.05))
    model = learn_survey(cells, SETTINGS, 1)
    assert model.middle.spread[0] > 2 * narrow
    low, _, high, _ = heights(cells, model)
    assert ((low < truth) & (truth < high))[40:].mean() >= 0.8


def test_what_the_pulses_shape_tells_wrong_of_the_law_does_not_spoil_heights():
    cells, truth = survey(8, 80, 20, law=(2.8, 0.1), shape=-1.3)
    model = learn_survey(cells, SETTINGS, 1)
    low, mean, high, _ = heights(cells, model)
    assert model.quantiles()["shift"][2][0] < 0
    assert np.median((mean / truth)[20:]) < 1.1  # n as the shape tells it: 1.5
    assert ((low < truth) & (truth < high))[20:].mean() >= 0.8


def test_without_shadow_shape_does_not_fix_the_law():
    cells, truth = survey(9, 120, 0, law=(2.4, 0.1), shape=-0.6)
    low, _, high, _ = heights(cells, learn_survey(cells, SETTINGS, 1))
    assert ((low < truth) & (truth < high)).mean() >= 0.8
    assert np.median((high - low) / truth) > 0.6


@pytest.mark.parametrize("seed", [3, 5])
@pytest.mark.parametrize("shape", [0.0, None])
def test_a_survey_of_two_looks_is_hardly_wider_than_the_looks(seed, shape):
    # the bias of the echo shape is part of the look's own error of the law
    law = np.array([2.2, 0.1])
    look = seen(np.random.default_rng(seed), 0.8, 0.05, law, 20, shape is None, shape=shape)
    mean, covariance = (value[0] for value in look.density[1:])
    row = np.array([0, 1, 0, *-contrast_slopes(mean[3:], look.tangent)])
    estimate = fuse_cells([[look], [look]], SETTINGS)[0].final
    sd = np.sqrt(row @ covariance @ row)
    # of log A_H both: of a log-normal sd over mean is more than the sd of its log
    found = np.sqrt(np.log1p((estimate.sd[1] / estimate.mean[1]) ** 2))
    assert 0.9 * sd < found < 1.6 * sd


def test_heights_that_no_draw_of_a_look_has_are_not_possible_with_it():
    rng = np.random.default_rng(4)
    law = np.array([2.2, 0.1])
    looks = [seen(rng, 0.8, 0.05, law, 20, False) for _ in range(2)]
    bounded = [replace(looks[0], reach=(0.01, 0.06)), replace(looks[1], reach=(0.01, 0.055))]
    first, both = fuse_cells([bounded], SETTINGS)[0].posteriors
    assert 0.055 < first.q95[1] < 0.06
    assert 0.05 < both.q95[1] < 0.055
    assert both.mean[1] < both.q95[1]
    free = fuse_cells([looks], SETTINGS)[0].final
    assert free.q95[1] > 0.08  # nothing else tells law from height


@pytest.mark.parametrize("most", [0.04, 0.044])
def test_looks_whose_heights_hardly_overlap_do_not_make_a_narrow_interval(most):
    # a bed that changed: the ranges of draws exclude each other, or nearly so
    rng = np.random.default_rng(4)
    law = np.array([2.2, 0.1])
    looks = [seen(rng, 0.8, 0.05, law, 20, True) for _ in range(2)]
    free = fuse_cells([looks], SETTINGS)[0].final
    ranges = (0.01, most), (0.05, 0.2)
    for order in (ranges, ranges[::-1]):
        bounded = [replace(look, reach=r) for look, r in zip(looks, order, strict=True)]
        final = fuse_cells([bounded], SETTINGS)[0].final
        assert final.mean == pytest.approx(free.mean, rel=1e-9)
        assert final.sd == pytest.approx(free.sd, rel=1e-9)


def test_the_range_of_heights_moves_with_altitude_and_widens_with_change():
    rng = np.random.default_rng(4)
    law = np.array([2.2, 0.1])
    looks = [replace(seen(rng, 0.8, 0.05, law, 20, False), reach=(0.02, 0.06)) for _ in range(2)]

    def reach(cells, offset, scatter):
        known = Shared(
            law, np.full(2, 0.1), np.zeros(2), np.full(2, offset), np.full(3, scatter), 0.1, 0.03
        )
        return reach_after_each(collect(cells), SurveyModel((known,), True))

    np.testing.assert_allclose(reach([looks[:1]], 0.0, 0.3), [[0.02, 0.06]])
    # altitude 10 % too low, and A_H is proportional to it
    np.testing.assert_allclose(
        reach([looks[:1]], 0.1 * ALTITUDE, 0.0) / np.exp(0.1), [[0.02, 0.06]]
    )
    wide = reach([looks], 0.0, 0.3)
    assert (wide[:, 0] < 0.01).all()
    assert (wide[:, 1] > 0.12).all()


def test_two_sediments_of_unlike_laws_widen_the_spread():
    first, truth = survey(10, 60, 20, law=(1.8, 0.1))
    second, other = survey(11, 60, 20, law=(3.0, 0.1))
    truth = np.concatenate([truth, other])
    one = learn_survey(first, SETTINGS, 1).middle.spread[0]
    model = learn_survey(first + second, SETTINGS, 1)
    assert model.middle.spread[0] > 1.5 * one
    low, _, high, _ = heights(first + second, model)
    assert ((low < truth) & (truth < high)).mean() >= 0.8


def inside(fused, truth):
    return np.array(
        [c.final.q05[1] < t < c.final.q95[1] for c, t in zip(fused, truth, strict=True)]
    )


def two_sediments(shadowed=(15, 15)):
    first, truth = survey(10, 50, shadowed[0], law=(1.8, 0.1))
    second, other = survey(11, 50, shadowed[1], law=(3.0, 0.1))
    return first + second, np.concatenate([truth, other]), [1] * 50 + [2] * 50


def test_mapped_sediments_tell_which_law_a_cell_without_shadow_has():
    cells, truth, classes = two_sediments()
    model = learn_survey(cells, SETTINGS, 1, classes)
    assert model.apart
    assert model.sediments == (1, 2)
    tangent = np.tan(np.radians(18))
    for draws, n in zip(model.found, (1.8, 3.0), strict=True):
        found = [log_contrast(p.shared.law, tangent) for p in draws]
        assert np.mean(found) == pytest.approx(log_contrast(np.array([n, 0.1]), tangent), abs=0.1)
    widths = []
    for told in (classes, None):
        model = learn_survey(cells, SETTINGS, 1, told)
        fused = fuse_cells(cells, SETTINGS, model, told)
        assert inside(fused, truth).mean() >= 0.8
        width = np.array([c.final.q95[1] - c.final.q05[1] for c in fused]) / truth
        widths.append(np.median(width[np.r_[15:50, 65:100]]))
    assert widths[0] < 0.8 * widths[1]


def test_classes_that_have_one_law_and_cells_of_a_wrong_class_do_no_harm():
    cells, truth = survey(2, 80, 20)
    by_turns = [1 + i % 3 for i in range(80)]
    model = learn_survey(cells, SETTINGS, 1, by_turns)
    assert len(model.found) == 3
    fused = fuse_cells(cells, SETTINGS, model, by_turns)
    assert inside(fused, truth).mean() >= 0.8
    cells, truth, classes = two_sediments()
    wrong = [3 - c if i % 10 == 3 else c for i, c in enumerate(classes)]
    fused = fuse_cells(cells, SETTINGS, learn_survey(cells, SETTINGS, 1, wrong), wrong)
    assert inside(fused, truth).mean() >= 0.8


def test_a_sediment_without_shadow_does_not_take_over_the_law_of_another():
    cells, truth, classes = two_sediments((0, 15))
    fused = fuse_cells(cells, SETTINGS, learn_survey(cells, SETTINGS, 1))
    assert inside(fused, truth)[:50].mean() < 0.5  # the map is needed
    model = learn_survey(cells, SETTINGS, 1, classes)
    fused = fuse_cells(cells, SETTINGS, model, classes)
    assert inside(fused, truth).mean() >= 0.8


def test_one_mapped_sediment_and_few_cells_of_another_change_nothing():
    cells, _ = survey(2, 40, 10)
    told = [1] * 37 + [2] * 3
    model = learn_survey(cells, SETTINGS, 1, told)
    assert model.sediments == ()
    assert fuse_cells(cells, SETTINGS, model, told) == fuse_cells(cells, SETTINGS, model)


def test_a_wrong_altitude_of_one_pass_is_found():
    cells, truth = survey(4, 40, 40, passes=3, errors=np.array([0.0, 0.0, -0.03]))
    model = learn_survey(cells, SETTINGS, 1)
    offset = model.quantiles()["offset"]
    # heights 3 % too low: the sonar was 3 % higher than the navigation says
    assert offset[0][2] - offset[1][0] < 0.03 * ALTITUDE < offset[2][2] - offset[1][0] + 0.05
    assert abs(offset[1][2] - offset[1][0] - 0.03 * ALTITUDE) < 0.06
    low, _, high, fused = heights(cells, model)
    assert ((low < truth) & (truth < high)).mean() >= 0.75
    assert np.mean([c.quality is Quality.CONTRADICTION for c in fused]) <= 0.05


def test_honest_passes_agree_and_false_ones_do_not():
    cells, truth = survey(5, 40, 20, passes=4)
    model = learn_survey(cells, SETTINGS, 1)
    low, _, high, fused = heights(cells, model)
    assert sum(c.quality is Quality.CONTRADICTION for c in fused) <= 1
    assert ((low < truth) & (truth < high)).mean() >= 0.75
    reverse = learn_survey([c[::-1] for c in cells], SETTINGS, 1)
    again = fuse_cells([c[::-1] for c in cells], SETTINGS, reverse)
    moved = [
        abs(a.final.mean[1] - b.final.mean[1]) / a.final.sd[1]
        for a, b in zip(fused, again, strict=True)
    ]
    assert np.median(moved) < 0.1
    rng = np.random.default_rng(6)
    for row, height in zip(cells[:20], truth[:20], strict=True):
        row[1] = seen(rng, 1.2 * row[0].mean[0], height, np.array([2.2, 0.1]), 15, True)
    fused = fuse_cells(cells, SETTINGS, learn_survey(cells, SETTINGS, 1))
    assert all(c.qualities[1] is Quality.CONTRADICTION for c in fused[:20])


def test_many_passes_of_another_height_do_not_hide_themselves_in_the_scatter():
    cells, truth = survey(5, 40, 20, passes=4)
    rng = np.random.default_rng(7)
    for row, height in zip(cells[:20:2], truth[:20:2], strict=True):
        row[1] = seen(rng, row[0].mean[0], 1.3 * height, np.array([2.2, 0.1]), 15, True)
    model = learn_survey(cells, SETTINGS, 1)
    assert model.middle.scatter[1] < 0.03
    assert 0.1 < model.middle.odd < 0.5
    fused = fuse_cells(cells, SETTINGS, model)
    found = [c.quality is Quality.CONTRADICTION for c in fused]
    assert np.mean(found[:20:2]) >= 0.9
    assert sum(found[1:20:2] + found[20:]) <= 1


def test_a_look_is_compared_with_all_others_together():
    rng = np.random.default_rng(13)
    law = np.array([2.2, 0.1])
    known = Shared(
        law, np.array([0.1, 0.05]), np.zeros(2), np.zeros(4), np.full(3, 1e-3), 0.1, 0.03
    )
    model = SurveyModel((known,), True)
    honest = [[seen(rng, 0.8, 0.05, law, 15, False) for _ in range(4)] for _ in range(40)]
    false = [[seen(rng, 0.8, 0.055, law, 15, False), *looks[1:]] for looks in honest]
    for cells, lost in ((honest, 0.05), (false, 0.5)):
        looks = collect(cells)
        pairs = agreeing_pairs(looks, model, len(cells))
        groups = together(looks, model, pairs)
        named = np.mean([0 not in group for group in groups])
        assert (named <= lost) if cells is honest else (named >= lost)
    # by pairs alone fewer are found
    assert named > np.mean([0 not in group for group in pairs]) + 0.2


def agreeing_pairs(looks, model, cells):
    found = distances_of(looks, model, cells)
    return [agreeing(d, v) for d, v in zip(*found, strict=True)]


def test_a_cell_is_the_same_whatever_cells_are_combined_with_it():
    cells, _ = survey(12, 10, 4, passes=2)
    model = learn_survey(cells, SETTINGS, 1)
    whole = fuse_cells(cells, SETTINGS, model)
    cells[3] = [replace(s, mixture=((0.5, *s.mixture[0][1:]),) * 2) for s in cells[3]]
    # to the last digit, with other cells of more components and in another order
    for i in (0, 7):
        assert fuse_cells([cells[i]], SETTINGS, model)[0] == whole[i]
    back = fuse_cells(cells[::-1], SETTINGS, model)[::-1]
    assert [c.final for c in back[4:]] == [c.final for c in whole[4:]]


def test_a_look_in_parts_is_the_look():
    cells, _ = survey(14, 4, 2, passes=3)
    parts = [
        [replace(s, mixture=tuple((w, *s.mixture[0][1:]) for w in (0.6, 0.3, 0.1))) for s in c]
        for c in cells
    ]
    model = learn_survey(cells, SETTINGS, 1)
    for whole, split in zip(
        fuse_cells(cells, SETTINGS, model), fuse_cells(parts, SETTINGS, model), strict=True
    ):
        assert split.group == whole.group
        moved = np.subtract(split.final.mean, whole.final.mean) / whole.final.sd
        assert np.abs(moved).max() < 0.02
        np.testing.assert_allclose(split.final.sd, whole.final.sd, rtol=0.02)


def test_looks_in_height_are_those_in_contrast_under_the_law():
    cells, _ = survey(15, 3, 1)
    looks = collect(cells)
    law = np.array([1.7, 0.3])
    known = Shared(law, np.full(2, 1e-4), np.zeros(2), np.array([0.2]), np.full(3, 1e-9), 0.1, 0.03)
    prior = law_factor(known, True)
    _, mean, _ = moments(with_prior(without_scatter(looks, known), prior))
    _, contrast, _ = moments(with_prior(looks.factor, prior))
    raised = looks.altitude_gain * 0.2 / looks.altitude
    expected = contrast[:, 0, 1] - log_contrast(law, looks.tangent) + raised
    np.testing.assert_allclose(mean[:, 0, 1], expected, atol=1e-6)


def test_the_same_looks_give_the_same_model():
    cells, _ = survey(7, 12, 6)
    first, second = (learn_survey(cells, SETTINGS, 3) for _ in range(2))
    for a, b in zip(first.values, second.values, strict=True):
        for one, other in zip(a, b, strict=True):
            np.testing.assert_array_equal(one, other)


def test_no_look_knows_less_than_its_prior():
    # n and c wider than the sampling prior, in a direction too that neither axis shows
    wide = np.diag([1e-3, 0.05, 1.0, 3.0, 0.8]) ** 2
    wide[3, 4] = wide[4, 3] = -0.9 * 3.0 * 0.8
    narrow = np.diag([1e-3, 0.05, 1.0, 0.3, 0.2]) ** 2
    covariance = np.array([[wide], [narrow]])
    mean = np.tile([0.0, -1.0, 40.0, 1.2, 0.4], (2, 1, 1))
    told = _likelihood(np.ones((2, 1)), mean, covariance, np.full(2, 0.3))
    assert (np.linalg.eigvalsh(told.precision) > 0).all()
    free = np.linalg.inv(narrow)
    free[LAW, LAW] -= np.diag(1 / LAW_VARIANCE)
    assert told.precision[1, 0, 3, 3] <= free[3, 3]  # steepness was divided out as well
    assert told.precision[1, 0, 3, 3] > 0.8 * free[3, 3]


def test_a_stray_component_neither_sharpens_a_look_nor_outweighs_it():
    """Log contrast wider than the prior of steepness: narrowed, it once took a look over."""
    sure = np.diag([2e-3, 0.3, 1.0, 0.4, 0.3]) ** 2
    stray = np.diag([2e-3, 2.8, 1.0, 0.4, 0.3]) ** 2
    weight = np.array([[0.999, 0.001]])
    mean = np.array([[[-0.3, -1.0, 40.0, 1.2, 0.4], [-0.3, -5.0, 40.0, 1.2, 0.4]]])
    told = _likelihood(weight, mean, np.array([[sure, stray]]), np.full(1, 0.3))
    np.testing.assert_allclose(np.linalg.inv(told.precision)[0, :, 0, 0] ** 0.5, 2e-3, rtol=0.02)
    # times the prior that it was divided by, each component has the mass that it had
    prior = _priors(mean, np.full(1, 0.3))
    level, linear, precision = (a + b for a, b in zip(told, prior, strict=True))
    square = (linear * np.linalg.solve(precision, linear[..., None])[..., 0]).sum(axis=-1)
    mass = np.exp(level + 0.5 * (square - np.linalg.slogdet(precision)[1]))
    np.testing.assert_allclose(mass, weight, rtol=1e-6)
