"""What a wave looks like in a clip: how far it extends, and whether it is a thing on the floor."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sasmap.ripples.places import extents, grain_of, objectness, undertone

SIZE, WAVELENGTH = 300, 20
WAVE = np.array([1 / WAVELENGTH, 0.0])


def speckled(level, seed=0):
    rng = np.random.default_rng(seed)
    return level * rng.rayleigh(1.0, level.shape)


def over_mean(amplitude):
    return amplitude / amplitude.mean() - 1


def test_waves_that_fill_a_clip_extend_alike_both_ways():
    column = np.arange(SIZE) + np.zeros((SIZE, 1))
    flat = over_mean(speckled(1 + 0.4 * np.sin(2 * np.pi * column / WAVELENGTH)))
    found = extents(flat, np.ones(flat.shape, bool), WAVE)
    assert found.normal == pytest.approx(SIZE / WAVELENGTH, rel=0.1)
    assert found.crests == pytest.approx(SIZE / WAVELENGTH, rel=0.15)
    narrow = extents(flat[:, :100].copy(), np.ones((SIZE, 100), bool), WAVE)
    assert narrow.room == pytest.approx(1 / 3, rel=0.2)


def test_a_few_lines_from_edge_to_edge_extend_along_themselves_only():
    column = np.arange(SIZE) + np.zeros((SIZE, 1))
    lines = sum(np.exp(-0.5 * ((column - k) / 4) ** 2) for k in (100, 120, 143, 161))
    found = extents(over_mean(speckled(1 + lines)), np.ones((SIZE, SIZE), bool), WAVE)
    assert found.normal < 5
    assert found.normal < 0.5 * found.crests


def places_of(level, seed=0):
    """Extents of the wave in a speckled image of an amplitude."""
    return extents(over_mean(speckled(level, seed)), np.ones(level.shape, bool), WAVE)


def rippled(forks=0):
    """Amplitude of ripples, with forks at random places."""
    row, column = np.indices((SIZE, SIZE), float)
    phase = 2 * np.pi * column / WAVELENGTH
    rng = np.random.default_rng(4)
    for sign in np.resize([1, -1], forks):
        y, x = rng.uniform(0, SIZE, 2)
        phase += sign * np.arctan2(row - y, column - x)
    return np.sqrt(1 + 0.6 * np.sin(phase))


@pytest.mark.parametrize("forks", [0, 20, 80])
def test_a_fork_disturbs_step_along_crests_as_much_as_across(forks):
    assert abs(places_of(rippled(forks)).out_of_step) < 0.15


def test_ripples_a_third_longer_at_one_side_keep_step():
    column = np.arange(SIZE) + np.zeros((SIZE, 1))
    phase = 2 * np.pi * (column + 0.07 * (column - SIZE / 2) ** 2 / SIZE) / WAVELENGTH
    assert abs(places_of(np.sqrt(1 + 0.6 * np.sin(phase))).out_of_step) < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_straight_lines_at_unrelated_places_are_out_of_step(seed):
    column = np.arange(SIZE) + np.zeros((SIZE, 1))
    middles = np.arange(100, 200, WAVELENGTH) + np.array([0, 9, -8, 10, 1])
    lines = sum(np.exp(-0.5 * ((column - k) / 3) ** 2) for k in middles)
    assert places_of(1 + 0.5 * lines, seed).out_of_step > 0.25


def test_speckle_alone_is_neither():
    assert abs(places_of(np.ones((SIZE, SIZE))).out_of_step) < 0.25


@pytest.mark.parametrize("size", [0.8, 2.0])
def test_grain_is_measured_beside_ripples(size):
    column = np.arange(SIZE)
    field = gaussian_filter(np.random.default_rng(2).normal(size=(2, SIZE, SIZE)), (0, size, size))
    grainy = np.hypot(*field) * (1 + 0.2 * np.sin(2 * np.pi * column / WAVELENGTH))
    found = grain_of(over_mean(grainy), np.ones((SIZE, SIZE), bool))
    assert found == pytest.approx(size, rel=0.2)


def likeness(flat):
    valid = np.ones((SIZE, SIZE), bool)
    return objectness(flat, valid, WAVE, extents(flat, valid, WAVE))


def hull():
    """Ribs every wavelength in a small hull, and its shadow."""
    row, column = np.indices((SIZE, SIZE))
    inside = (np.abs(row - 150) < 25) & (np.abs(column - 130) < 70)
    level = np.where(inside, np.where(column % WAVELENGTH < 8, 2.0, 0.6), 1.0)
    return np.where(np.roll(inside, 45, axis=0) & ~inside, 0.3, level)


@pytest.mark.parametrize("power", [1.0, 0.6, 0.4])
def test_a_thing_is_one_however_the_image_was_scaled(power):
    assert likeness(over_mean(speckled(hull()) ** power)) > 1.3


def test_ribs_across_a_narrow_hull_resemble_an_object_more_than_ripples_in_a_round_patch():
    row, column = np.indices((SIZE, SIZE)) - SIZE / 2
    stripes = 1 + 0.7 * np.sin(2 * np.pi * column / WAVELENGTH)
    narrow = (np.abs(row) < 22) & (np.abs(column) < 90)
    round_ = np.hypot(row, column) < 50
    hull, patch = (likeness(over_mean(speckled(np.where(v, stripes, 1)))) for v in (narrow, round_))
    assert hull > patch + 0.4


@pytest.mark.parametrize("power", [1.0, 0.6, 0.4])
def test_a_patch_of_ripples_is_none(power):
    row, column = np.indices((SIZE, SIZE))
    inside = np.hypot(row - 150, column - 130) < 60
    level = 1 + 0.5 * inside * np.sin(2 * np.pi * column / WAVELENGTH)
    assert likeness(over_mean(speckled(np.sqrt(level)) ** power)) < 0.4


def test_blotches_have_more_power_at_half_the_wave_number_and_ripples_less():
    column = np.arange(SIZE) + np.zeros((SIZE, 1))
    every = np.ones((SIZE, SIZE), bool)
    ripples = speckled(1 + 0.2 * np.sin(2 * np.pi * column / WAVELENGTH))
    # a trend is long, but not of the wave's undertone
    assert undertone(ripples * (1 + column / SIZE), every, WAVE) < 0.05
    rng = np.random.default_rng(0)
    blotches = gaussian_filter(rng.normal(size=(SIZE, SIZE)), (14, 6), mode="wrap")
    level = np.sqrt(np.clip(1 + 0.9 * blotches / blotches.std(), 0.03, None))
    assert undertone(speckled(level), every, WAVE) > 1
