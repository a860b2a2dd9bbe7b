from dataclasses import replace

import numpy as np
import pytest

from sasmap.passes.agreement import LIMIT
from sasmap.passes.cell_estimate import UNKNOWN
from sasmap.passes.fusion import cell_quality, fuse, fuse_cells, learn_survey, next_prior
from sasmap.passes.summary import Summary, summarise
from sasmap.ripples import RippleSettings, estimate
from sasmap.ripples.posterior import LeftOut, Quality
from tests.ripples.engine import coherent

SETTINGS = RippleSettings(shadow="crest", scatter=(0, 0, 0))


def look(mean=(0.6, 0.07), sd=(1e-3, 2e-3), azimuth=(90.0, 0.5), quality=Quality.GOOD, also=None):
    """A look whose posterior is one Gaussian of the logs, or two of equal weight."""
    components = []
    for centre in [mean] if also is None else [mean, also]:
        relative = np.array(sd) / centre
        covariance = np.diag([*relative, azimuth[1]]) ** 2
        share = 1.0 if also is None else 0.5
        components.append((share, *np.log(centre), azimuth[0], *covariance.ravel()))
    return Summary(
        quality,
        LeftOut(0),
        mean=mean,
        sd=sd,
        azimuth=azimuth,
        mixture=tuple(components),
        ess_bulk=(1,) * 3,
    )


def test_looks_count_by_their_precision():
    cell = fuse([look(sd=(1e-3, 2e-3)), look((0.603, 0.07), sd=(2e-3, 2e-3))], SETTINGS)
    assert cell.quality is Quality.GOOD
    assert cell.group == (0, 1)
    np.testing.assert_allclose(cell.final.mean, (0.6006, 0.07), rtol=2e-3)
    np.testing.assert_allclose(cell.final.sd, (1e-3 * np.sqrt(0.8), 2e-3 / np.sqrt(2)), rtol=5e-3)
    np.testing.assert_allclose(cell.posteriors[0].sd, (1e-3, 2e-3), rtol=2e-3)
    assert cell.priors[1].sd == cell.posteriors[0].sd
    assert np.isinf(cell.priors[0].sd).all()


def test_steepness_is_that_of_f_and_height_together():
    final = fuse([look()], SETTINGS).final
    relative = np.hypot(1e-3 / 0.6, 2e-3 / 0.07)
    mean, sd, q05, q95 = final.derived.steepness
    assert mean == pytest.approx(2 * 0.6 * 0.07, rel=1e-3)
    assert sd / mean == pytest.approx(relative, rel=1e-3)
    assert np.log(q95 / q05) == pytest.approx(2 * 1.6449 * relative, rel=1e-3)


def test_order_does_not_matter():
    rng = np.random.default_rng(1)
    looks = [
        look((0.6 + 1e-3 * rng.normal(), 0.07 + 2e-3 * rng.normal()), (1e-3, 2e-3), (a, 0.5))
        for a in (89.8, 90.1, 90.2)
    ]
    looks.append(look((0.6, 0.07), (1e-3, 2e-3), also=(0.64, 0.05)))
    first = fuse(looks, SETTINGS)
    for order in ([3, 2, 1, 0], [1, 3, 0, 2]):
        other = fuse([looks[i] for i in order], SETTINGS)
        np.testing.assert_allclose(other.final.mean, first.final.mean, rtol=1e-6)
        np.testing.assert_allclose(other.final.sd, first.final.sd, rtol=1e-4)
        assert sorted(order[k] for k in other.group) == [0, 1, 2, 3]


def test_a_look_of_two_modes_is_settled_by_the_next():
    cell = fuse([look((0.3, 0.05), also=(0.6, 0.07)), look()], SETTINGS)
    assert cell.quality is Quality.GOOD
    assert abs(cell.final.mean[0] - 0.6) < 1e-3


def test_a_broad_height_is_told_by_another_look_and_stays_within_the_bounds():
    cell = fuse([look((0.6, 0.04), (1e-3, 0.03)), look((0.6, 0.07), (1e-2, 1e-3))], SETTINGS)
    np.testing.assert_allclose(cell.final.mean, (0.6, 0.07), rtol=0.01)
    assert cell.final.sd[0] < 1.01e-3
    assert cell.final.sd[1] < 1.01e-3
    final = fuse([look((0.6, 0.45), (1e-3, 0.2))], SETTINGS).final
    assert final.q05[1] < final.mean[1] < final.q95[1] < 0.5


def test_the_prior_of_steepness_counts_once():
    vague = look((0.6, 0.04), (1e-3, 0.02))
    _, sd = (0.09, 0.7)
    single = (0.02 / 0.04) ** -2.0
    for n in (2, 4):
        final = fuse([vague] * n, SETTINGS).final
        expected = (n * single - (n - 1) / sd**2) ** -0.5
        spread = np.log(final.q95[1] / final.q05[1]) / (2 * 1.6449)
        assert spread == pytest.approx(expected, rel=0.02)


def test_azimuths_are_axes():
    cell = fuse([look(azimuth=(179.5, 0.5)), look(azimuth=(0.5, 0.5))], SETTINGS)
    assert cell.quality is Quality.GOOD
    assert min(cell.final.azimuth[0], 180 - cell.final.azimuth[0]) < 1e-6
    assert cell.final.azimuth[1] == pytest.approx(0.5 / np.sqrt(2), rel=1e-6)


@pytest.mark.parametrize("odd", [look((0.72, 0.07)), look((0.6, 0.091)), look(azimuth=(105, 0.5))])
def test_a_look_that_contradicts_others_is_flagged_and_left_out(odd):
    cell = fuse([look(), odd, look((0.601, 0.071))], SETTINGS)
    assert cell.quality is Quality.CONTRADICTION
    assert cell.group == (0, 2)
    assert cell.qualities == (Quality.GOOD, Quality.CONTRADICTION, Quality.GOOD)
    assert cell.disagreements[1] > LIMIT
    assert cell.disagreements[0] < 10
    assert abs(cell.final.mean[0] - 0.6005) < 1e-4
    two = fuse([look(sd=(1e-3, 1e-3)), odd], SETTINGS)
    assert two.qualities == (Quality.CONTRADICTION,) * 2
    np.testing.assert_allclose(two.final.mean, (0.6, 0.07), rtol=1e-3)  # the surer, not a mean


def test_scatter_limits_what_many_looks_tell():
    settings = SETTINGS.model_copy(update={"scatter": (0.01, 0.1, 1.0)})
    sd = [fuse([look()] * n, settings).final.sd[0] for n in (1, 4, 16)]
    assert sd[0] == pytest.approx(1e-3, rel=1e-3)
    np.testing.assert_allclose(sd[1:], np.hypot(0.006, 1e-3) / np.sqrt([4, 16]), rtol=1e-3)


def test_looks_without_ripples_or_failed():
    nothing = Summary(Quality.NO_RIPPLES, LeftOut(0))
    cell = fuse([None, nothing, look()], SETTINGS)
    assert cell.group == (2,)
    assert cell.posteriors[1] is UNKNOWN
    assert fuse([nothing, None], SETTINGS).final is UNKNOWN
    doubtful = look(quality=Quality.NOT_CONVERGED)
    assert fuse([nothing, doubtful], SETTINGS).final.mean == (0.6, 0.07)
    failed = fuse([look(), Summary(Quality.FAILED, LeftOut(0))], SETTINGS)
    assert failed.final is UNKNOWN
    assert failed.quality is Quality.FAILED


def test_crests_that_moved_between_passes_are_told_in_metres():
    f, moved = 0.6, 0.31
    normal = np.array([np.sin(np.radians(40)), np.cos(np.radians(40))])
    centres = (np.array([100.0, 200.0]), np.array([101.3, 199.2]))
    phases = (0.8, (0.8 + f * normal @ (centres[1] - centres[0]) - f * moved) % 1.0)
    looks = [
        replace(look(azimuth=(40.0, 0.05)), crest_phase=(phase, 0.004), centre=tuple(centre))
        for phase, centre in zip(phases, centres, strict=True)
    ]
    cell = fuse(looks, SETTINGS)
    assert cell.quality is Quality.GOOD
    assert cell.migration[0] == (0.0, 0.0)
    assert cell.migration[1][0] == pytest.approx(moved, abs=0.01)
    assert 0.004 / f < cell.migration[1][1] < 0.05
    back = fuse(looks[::-1], SETTINGS)
    assert back.migration[1][0] == pytest.approx(-moved, abs=0.01)


@pytest.mark.parametrize("off", [25.0, -40.0])
def test_the_phase_of_crests_is_that_of_the_map(off):
    for seed, phase in ((1, 0.5), (2, 4.0)):
        made = coherent(seed, height=0.05, phase=phase, azimuth_off_look=off)
        found = summarise(estimate(made.clip, rng=1))
        apart = (2 * np.pi * found.crest_phase[0] - phase + np.pi) % (2 * np.pi) - np.pi
        assert abs(apart) < 0.1


def test_cells_together_are_as_each_alone():
    cells = [[look()], [None, look((0.7, 0.05))], [look(), look((0.601, 0.07))], [None, None]]
    survey = learn_survey(cells, SETTINGS)
    together = fuse_cells(cells, SETTINGS, survey)
    for summaries, found in zip(cells, together, strict=True):
        alone = fuse(summaries, SETTINGS, survey)
        assert alone.group == found.group
        np.testing.assert_allclose(found.final.mean, alone.final.mean, rtol=1e-12)


def test_published_method_takes_its_hand_set_widths():
    settings = RippleSettings(method="zare-cobb", frequency=(0, 1), height=(0, 1))
    first = look(quality=Quality.NOT_CONVERGED)
    assert next_prior([first], settings).sd == (0.003, 0.17)
    assert np.isinf(next_prior([], settings).sd).all()
    assert np.isinf(next_prior([look()], SETTINGS).sd).all()
    second = look((0.61, 0.08), quality=Quality.NOT_CONVERGED)
    chain = fuse([first, second], settings)
    assert chain.final.mean == (0.61, 0.08)
    assert chain.priors[1].mean == (0.6, 0.07)


def test_the_only_look_of_a_survey_is_its_estimate():
    summary = summarise(estimate(coherent(3).clip, rng=1))
    cell = fuse([None, summary], RippleSettings())
    assert (cell.final.mean, cell.final.sd) == (summary.mean, summary.sd)
    assert (cell.final.q05, cell.final.q95) == (summary.q05, summary.q95)
    assert cell.group == (1,)
    # with others it takes part in their law
    other = summarise(estimate(coherent(4).clip, rng=1))
    both = fuse_cells([[summary], [other]], RippleSettings())
    assert both[0].final.mean != summary.mean
    assert both[0].final.mean == pytest.approx(summary.mean, rel=0.1)


def test_a_second_pass_narrows_both():
    settings = RippleSettings(scattering="lambert", scatter=(0, 0, 0))
    cells = [coherent(k, near=near, height=0.07) for k, near in enumerate((10.0, 16.0))]
    first, second = (summarise(estimate(c.clip, settings, rng=1)) for c in cells)
    chain = fuse([first, second], settings)
    assert chain.quality is Quality.GOOD
    for i, truth in enumerate((0.62, 0.07)):
        assert chain.final.sd[i] < min(first.sd[i], second.sd[i])
        assert abs(chain.final.mean[i] - truth) < 4 * chain.final.sd[i]
    other = fuse([second, first], settings).final
    for i in range(2):  # what the survey shares is sampled anew
        assert abs(other.mean[i] - chain.final.mean[i]) < 0.1 * chain.final.sd[i]


@pytest.mark.parametrize(
    ("qualities", "expected"),
    [
        ([], Quality.NO_DATA),
        ([Quality.NO_RIPPLES, Quality.GOOD], Quality.GOOD),
        ([Quality.TOO_FEW_PIXELS, Quality.NO_RIPPLES], Quality.NO_RIPPLES),
        ([Quality.GOOD, Quality.FAILED], Quality.FAILED),
        ([Quality.NO_DATA], Quality.NO_DATA),
    ],
)
def test_cell_quality(qualities, expected):
    assert cell_quality(qualities) is expected
    assert cell_quality(qualities[::-1]) is expected
