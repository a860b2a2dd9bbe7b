"""The cases of pipelines/ripples/extremes.py, one by one."""

import runpy
from pathlib import Path

import pytest

from sasmap.ripples import RippleSettings, estimate

EXTREMES = runpy.run_path(
    str(Path(__file__).resolve().parents[2] / "pipelines" / "ripples" / "extremes.py")
)
CASES = EXTREMES["cases"]()


@pytest.mark.parametrize("name", CASES)
def test_finite_estimate_or_the_right_code(name):
    posterior = EXTREMES["outcome"](CASES[name])
    assert posterior.quality in CASES[name][2]
    assert EXTREMES["finite"](posterior)


@pytest.mark.parametrize(
    "name", ["prior 100 sd above its bounds", "prior of f 100 sd below its bounds"]
)
def test_where_prior_and_image_disagree_the_draws_are_the_same_again(name):
    """The search goes far from what the image shows, where a read beyond an array would differ."""
    once, again = (EXTREMES["outcome"](CASES[name]) for _ in range(2))
    assert once.draws.identical(again.draws)


def test_a_glaring_pixel_widens_the_interval_and_does_no_more():
    clip = CASES["one pixel of 1e6 times the rest"][0]
    bright = estimate(clip, RippleSettings(scattering="zare-cobb"), rng=1)  # what simulated it
    for name, truth in (("frequency", 0.6), ("height", 0.07)):
        assert abs(float(bright.mean[name]) - truth) < float(bright.sd[name])
    assert abs(float(bright.mean.frequency) - 0.6) < 0.01
