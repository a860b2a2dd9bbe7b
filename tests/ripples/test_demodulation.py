"""A clip demodulated at its wave: the wave is found, the trend told apart from it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion

from sasmap.ripples.demodulation import (
    covered_boxes,
    demodulate,
    local_ratio,
    range_trend,
    refined_wave,
    rewaved,
    turned_back,
)
from sasmap.ripples.image import as_image
from tests.helpers import clip_of

STEP, SIZE = 0.05, 240
WAVE = np.array([0.71, 0.22])  # (east, north), cycles/m


def image_of(power=0.0, lag=lambda reach: 0.0, seed=1):
    """Speckle on a wave over a power of range."""
    reach = 12.0 + STEP * np.arange(SIZE)
    north = STEP * np.arange(SIZE)[::-1, None]
    phase = 2 * np.pi * (WAVE[0] * reach + WAVE[1] * north) - lag(reach)
    intensity = (1 + 0.6 * np.cos(phase)) * (reach / reach.mean()) ** power
    speckle = np.random.default_rng(seed).exponential(size=intensity.shape)
    return as_image(clip_of(np.sqrt(intensity * speckle), reach, 5.0, STEP))


def test_a_wave_is_refined_from_half_a_cycle_off():
    image = image_of()
    off = WAVE + np.array([0.4, -0.3]) / (SIZE * STEP)
    boxes = demodulate(image, off)
    found = refined_wave(image, boxes, boxes.count > 0)
    # the error of a sine's wave number in so many pixels of speckle
    sd = np.sqrt(6) / (np.pi * 0.6 * SIZE * SIZE * STEP) * np.sqrt(1 + 0.6**2 / 2)
    assert np.abs(found - WAVE).max() < 4 * sd
    assert np.abs(off - WAVE).min() > 40 * sd


def test_turning_boxes_is_demodulating_anew():
    image = image_of()
    near = WAVE + np.array([0.01, 0.01])
    turned, anew = rewaved(image, demodulate(image, near), WAVE), demodulate(image, WAVE)
    assert turned.turned.sum() == pytest.approx(anew.turned.sum(), rel=0.02)


@pytest.mark.parametrize("power", [-3.0, 2.0])
def test_the_trend_is_told_from_the_wave(power):
    image = image_of(power)
    boxes = demodulate(image, WAVE)
    reach = 12.0 + STEP * (boxes.size * (np.arange(boxes.count.shape[1]) + 0.5) - 0.5)
    truth = (reach / reach.mean()) ** power
    for trend, error in ((boxes.trend, 0.06), (range_trend(image, boxes.size), 0.12)):
        along = trend.mean(axis=0)[1:-1]
        assert along / along.mean() == pytest.approx(truth[1:-1] / truth[1:-1].mean(), rel=error)


def test_a_lag_over_range_is_taken_off():
    def lag(reach):
        return 0.15 * (reach - reach.mean())

    image = image_of(lag=lag)
    boxes = demodulate(image, WAVE)
    reach = 12.0 + STEP * np.arange(SIZE)
    upright = turned_back(image, boxes, (reach, lag(reach)))
    assert abs(upright.turned.sum()) > 1.05 * abs(boxes.turned.sum())
    found = refined_wave(image, upright, upright.count > 0)
    assert np.abs(found - WAVE).max() < 2e-3 < 0.15 / (2 * np.pi)


def bare(rows, columns):
    """The image's boxes that count as rippled, with a patch of flat floor; the patch's boxes."""
    image = image_of()
    flat = np.random.default_rng(2).exponential(size=image.power.shape) * image.power.mean()
    power = image.power.copy()
    power[rows, columns] = flat[rows, columns]
    boxes = demodulate(replace(image, power=power), WAVE)
    patch = np.zeros(boxes.count.shape, bool)
    size = boxes.size
    patch[rows.start // size : rows.stop // size, columns.start // size : columns.stop // size] = 1
    return covered_boxes(image, boxes), patch


def test_a_bare_patch_is_left_out_but_for_its_corners():
    covered, patch = bare(slice(60, 160), slice(80, 180))
    assert covered[patch].mean() < 0.3
    middle = binary_erosion(patch, iterations=6)
    assert middle.sum() > 100
    assert not covered[middle].any()
    assert covered[~binary_dilation(patch, iterations=6)].all()


def test_a_gap_as_small_as_that_of_a_fork_is_not():
    covered, _ = bare(slice(100, 130), slice(100, 130))
    assert covered.all()


def test_a_model_that_fits_leaves_no_trend():
    image = image_of(2.0)
    reach = 12.0 + STEP * np.arange(SIZE)
    boxes = demodulate(image, WAVE)
    north = STEP * np.arange(SIZE)[::-1, None]
    model = 1 + 0.6 * np.cos(2 * np.pi * (WAVE[0] * reach + WAVE[1] * north))
    trend = (reach / reach.mean()) ** 2
    model = model * trend / (model * trend).mean()
    left = local_ratio(image, WAVE, boxes.size, image.valid, model)
    assert left == pytest.approx(np.ones(left.shape), abs=0.2)
    assert left.mean() == pytest.approx(1.0, abs=0.02)
