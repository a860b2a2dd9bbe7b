import numpy as np
import pytest

from sasmap.ripples import RippleSettings, estimate
from sasmap.ripples.passes import Summary, cell_quality, next_prior, summarise, used
from sasmap.ripples.posterior import LeftOut, Quality
from tests.helpers import zare_cobb_clip

SETTINGS = RippleSettings(shadow="crest")


def summary(quality, mean=(0.6, 0.07), sd=(1e-3, 2e-3)):
    return Summary(quality, LeftOut(0), mean=mean, sd=sd, correlation=0.4)


def test_without_an_earlier_look_the_prior_is_flat():
    for earlier in (
        [],
        [Summary(Quality.NO_RIPPLES, LeftOut(0))],
        [summary(Quality.NOT_CONVERGED)],
    ):
        prior = next_prior(earlier, SETTINGS)
        assert np.isinf(prior.sd).all()
        assert prior.bounds == (SETTINGS.frequency, SETTINGS.height)


def test_posterior_becomes_prior_and_never_narrower():
    prior = next_prior([summary(Quality.GOOD)], SETTINGS)
    assert prior.mean == (0.6, 0.07)
    assert prior.sd[0] > 1e-3
    assert prior.sd[1] > 2e-3
    assert 0 < prior.correlation < 0.4


def test_published_method_takes_its_hand_set_widths():
    settings = RippleSettings(method="zare-cobb", frequency=(0, 1), height=(0, 1))
    prior = next_prior([summary(Quality.NOT_CONVERGED)], settings)
    assert prior.sd == (0.003, 0.17)


def test_a_second_pass_narrows_both():
    first = summarise(estimate(zare_cobb_clip(12.2, 24.4, 0.6, 0.07), SETTINGS, rng=1))
    prior = next_prior([first], SETTINGS)
    clip = zare_cobb_clip(24.4, 36.6, 0.6, 0.07, seed=1)
    second = summarise(estimate(clip, SETTINGS, rng=2, prior=prior))
    alone = summarise(estimate(clip, SETTINGS, rng=2))
    assert second.sd[0] < 1.2 * alone.sd[0]
    assert second.sd[1] < 1.2 * alone.sd[1]
    assert abs(second.mean[0] - 0.6) < 5e-4
    assert abs(second.mean[1] - 0.07) < 5e-4


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


def test_last_trusted_look_is_used():
    looks = [summary(Quality.GOOD), summary(Quality.GOOD), summary(Quality.NO_RIPPLES)]
    assert used(looks, SETTINGS) == 1
    assert used(looks[2:], SETTINGS) is None
