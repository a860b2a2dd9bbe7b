"""The cases of pipelines/ripples/extremes.py, one by one."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
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


@pytest.mark.parametrize("place", [(2, 177), (150, 150), (80, 220)])
def test_a_glaring_pixel_widens_the_interval_and_does_no_more(place):
    clip = CASES["one pixel of 1e6 times the rest"][0]
    amplitude = np.where(clip.amplitude == clip.amplitude.max(), 0.5, clip.amplitude)
    amplitude[place] = clip.amplitude.max()
    # the law that simulated it
    bright = estimate(
        replace(clip, amplitude=amplitude), RippleSettings(scattering="zare-cobb"), rng=1
    )
    for name, truth, share in (("frequency", 0.6, 0.016), ("height", 0.07, 0.06)):
        off = abs(float(bright.mean[name]) - truth)
        assert off < 3 * float(bright.sd[name])
        assert off < share * truth
