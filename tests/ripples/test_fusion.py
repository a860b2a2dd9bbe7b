import numpy as np
import pytest

from sasmap.ripples import RippleSettings, estimate
from sasmap.ripples.fusion import UNKNOWN, cell_quality, fuse, next_prior
from sasmap.ripples.posterior import LeftOut, Quality
from sasmap.ripples.summary import Summary, summarise
from tests.ripples.engine import coherent

SETTINGS = RippleSettings(shadow="crest", scatter=(0, 0, 0))


def look(mean=(0.6, 0.07), sd=(1e-3, 2e-3), azimuth=(90.0, 0.5), quality=Quality.GOOD, also=None):
    """A look whose posterior is one Gaussian, or two of equal weight."""
    components = []
    for centre in [mean] if also is None else [mean, also]:
        covariance = np.diag([*sd, azimuth[1]]) ** 2
        share = 1.0 if also is None else 0.5
        components.append((share, *centre, azimuth[0], *covariance.ravel()))
    nothing = LeftOut(0)
    return Summary(
        quality,
        nothing,
        mean=mean,
        sd=sd,
        azimuth=azimuth,
        mixture=tuple(components),
        ess_bulk=(1,) * 3,
    )


def test_looks_count_by_their_precision():
    chain = fuse([look(sd=(1e-3, 2e-3)), look((0.603, 0.07), sd=(2e-3, 2e-3))], SETTINGS)
    assert chain.quality is Quality.GOOD
    assert chain.group == (0, 1)
    np.testing.assert_allclose(chain.final.mean, (0.6006, 0.07), rtol=1e-9)
    np.testing.assert_allclose(chain.final.sd, (1e-3 * np.sqrt(0.8), 2e-3 / np.sqrt(2)), rtol=1e-6)
    assert chain.posteriors[0].sd == (1e-3, 2e-3)
    assert chain.priors[1].sd == chain.posteriors[0].sd
    assert np.isinf(chain.priors[0].sd).all()


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
        np.testing.assert_allclose(other.final.mean, first.final.mean, rtol=1e-9)
        np.testing.assert_allclose(other.final.sd, first.final.sd, rtol=1e-6)
        assert sorted(order[k] for k in other.group) == [0, 1, 2, 3]


def test_a_look_of_two_modes_is_settled_by_the_next():
    chain = fuse([look((0.3, 0.05), also=(0.6, 0.07)), look()], SETTINGS)
    assert chain.quality is Quality.GOOD
    assert abs(chain.final.mean[0] - 0.6) < 1e-3


def test_broad_height_is_told_by_another_look_and_mass_at_a_bound_stays_inside():
    chain = fuse([look((0.6, 0.01), (1e-3, 0.2)), look((0.6, 0.07), (1e-2, 1e-3))], SETTINGS)
    np.testing.assert_allclose(chain.final.mean, (0.6, 0.07), rtol=0.01)
    assert chain.final.sd[0] < 1.01e-3
    assert chain.final.sd[1] < 1.01e-3
    broad = [look((0.6, 0.0), (1e-3, 0.1))] * 2
    final = fuse(broad, SETTINGS).final
    assert 0 <= final.q05[1] < final.mean[1] < final.q95[1] < 0.5
    assert final.mean[1] == pytest.approx(0.1 / np.sqrt(2) * np.sqrt(2 / np.pi), rel=1e-6)


def test_azimuths_are_axes():
    chain = fuse([look(azimuth=(179.5, 0.5)), look(azimuth=(0.5, 0.5))], SETTINGS)
    assert chain.quality is Quality.GOOD
    assert min(chain.final.azimuth[0], 180 - chain.final.azimuth[0]) < 1e-6
    assert chain.final.azimuth[1] == pytest.approx(0.5 / np.sqrt(2), rel=1e-6)


def test_a_look_that_contradicts_others_is_flagged_and_left_out():
    odd = look((0.72, 0.07))
    chain = fuse([look(), odd, look((0.601, 0.071))], SETTINGS)
    assert chain.quality is Quality.CONTRADICTION
    assert chain.group == (0, 2)
    assert chain.qualities == (Quality.GOOD, Quality.CONTRADICTION, Quality.GOOD)
    assert chain.disagreements[1] > 1000
    assert chain.disagreements[0] < 10
    assert abs(chain.final.mean[0] - 0.6005) < 1e-6
    two = fuse([look(sd=(1e-3, 1e-3)), odd], SETTINGS)
    assert two.qualities == (Quality.CONTRADICTION,) * 2
    assert two.final.mean == (0.6, 0.07)  # the surer one, not a mean


def test_scatter_limits_what_many_looks_tell():
    settings = SETTINGS.model_copy(update={"scatter": (0.01, 0.1, 1.0)})
    sd = [fuse([look()] * n, settings).final.sd[0] for n in (1, 4, 16)]
    assert sd[0] == 1e-3
    np.testing.assert_allclose(sd[1:], np.hypot(0.006, 1e-3) / np.sqrt([4, 16]), rtol=1e-6)


def test_looks_without_ripples_or_failed():
    nothing = Summary(Quality.NO_RIPPLES, LeftOut(0))
    chain = fuse([None, nothing, look()], SETTINGS)
    assert chain.group == (2,)
    assert chain.posteriors[1] is UNKNOWN
    assert fuse([nothing, None], SETTINGS).final is UNKNOWN
    doubtful = look(quality=Quality.NOT_CONVERGED)
    assert fuse([nothing, doubtful], SETTINGS).final.mean == (0.6, 0.07)
    failed = fuse([look(), Summary(Quality.FAILED, LeftOut(0))], SETTINGS)
    assert failed.final is UNKNOWN
    assert failed.quality is Quality.FAILED


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


def test_a_second_pass_narrows_both():
    settings = RippleSettings(scattering="lambert")
    cells = [coherent(k, near=near, height=0.07) for k, near in enumerate((10.0, 16.0))]
    first, second = (summarise(estimate(c.clip, settings, rng=1)) for c in cells)
    chain = fuse([first, second], settings)
    assert chain.quality is Quality.GOOD
    for i, truth in enumerate((0.62, 0.07)):
        assert chain.final.sd[i] < min(first.sd[i], second.sd[i]) * 1.05  # scatter adds to each
        assert abs(chain.final.mean[i] - truth) < 4 * chain.final.sd[i]
    assert fuse([second, first], settings).final.mean == pytest.approx(chain.final.mean)


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
