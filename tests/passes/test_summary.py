"""What is kept of a look: how its height follows the altitude."""

from types import SimpleNamespace

import numpy as np
import pytest

from sasmap.passes.summary import ALTITUDE_GAIN, _altitude_gain
from sasmap.ripples.posterior import dataset


def draws(slope, scale_sd, height_sd):
    rng = np.random.default_rng(3)
    scale = rng.normal(0, scale_sd, (4, 1000))
    height = slope * scale + rng.normal(0, height_sd, (4, 1000))
    told = {"altitude_scale": np.exp(scale), "height": 0.07 * np.exp(height)}
    return SimpleNamespace(draws=dataset(told))


@pytest.mark.parametrize("slope", [-1.0, 0.5, 1.0])
def test_gain_is_the_slope_where_the_draws_tell_it(slope):
    assert _altitude_gain(draws(slope, 0.05, 0.005)) == pytest.approx(slope, abs=0.01)


def test_gain_is_the_usual_one_where_they_do_not():
    gains = [_altitude_gain(draws(slope, 1e-3, 0.2)) for slope in (-1.0, 0.5, 1.0)]
    assert gains == pytest.approx([ALTITUDE_GAIN[0]] * 3, abs=0.05)


def test_no_gain_without_draws_of_the_altitude():
    assert _altitude_gain(draws(1.0, 0.0, 0.1)) == 0.0
