import numpy as np
import pytest

from sasmap.ripples import RippleSettings, estimate
from sasmap.ripples.posterior import LeftOut, Quality
from tests.helpers import clip_of


def image(intensity, seed=0, looks=1):
    """A clip of speckle over an intensity (rows, columns)."""
    rng = np.random.default_rng(seed)
    speckle = rng.exponential(1.0, (looks, *intensity.shape)).mean(axis=0)
    reach = 30 + 0.05 * np.arange(intensity.shape[1])
    return clip_of(np.sqrt(intensity * speckle), reach, 6.0, 0.05)


def wave(turn, contrast, waves=8, size=300):
    row, column = np.indices((size, size))
    angle = 2 * np.pi * waves / size * (column * np.cos(turn) + row * np.sin(turn))
    return 1 + contrast * np.sin(angle)


@pytest.mark.parametrize("turn", [-1.2, -0.5, 0.0, 0.8])
def test_weak_ripples_are_found_whatever_their_direction(turn):
    posterior = estimate(image(wave(turn, 0.1)), RippleSettings(draws=100), rng=1)
    assert posterior.probability > 0.9
    assert posterior.sampled
    known = 8 / (300 * 0.05)
    assert abs(float(posterior.mean.frequency) / known - 1) < 0.05


def test_probability_grows_with_contrast():
    settings = RippleSettings(draws=100)
    found = [estimate(image(wave(0.3, c)), settings, rng=1).probability for c in (0, 0.02, 0.1)]
    assert found[0] < 0.1
    assert found[0] <= found[1] <= found[2]


def test_a_band_a_trend_and_lines_of_gain_are_no_ripples():
    row, column = np.indices((300, 300))
    band = np.where(np.abs(row - column) < 30, 3.0, 1.0)
    trend = np.exp(2 * column / 300)
    texture = np.exp(0.5 * np.sin(2 * np.pi * row / 300) * np.cos(2 * np.pi * column / 200))
    for floor in (band, trend, texture):
        posterior = estimate(image(floor), rng=1)
        assert posterior.quality is Quality.NO_RIPPLES
        assert LeftOut.SAMPLING in posterior.left_out


def test_ripples_seen_along_their_crests_are_not_identifiable_or_unseen():
    clip = image(wave(np.pi / 2, 0.5))
    assert estimate(clip, rng=1).quality is Quality.NOT_IDENTIFIABLE
