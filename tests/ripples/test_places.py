"""What a wave looks like in a clip: how far it extends, and whether it is a thing on the floor."""

import numpy as np
import pytest

from sasmap.ripples.places import extents, objectness

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


def hull():
    """Ribs every wavelength in a small hull, and its shadow."""
    row, column = np.indices((SIZE, SIZE))
    inside = (np.abs(row - 150) < 25) & (np.abs(column - 130) < 70)
    level = np.where(inside, np.where(column % WAVELENGTH < 8, 2.0, 0.6), 1.0)
    return np.where(np.roll(inside, 45, axis=0) & ~inside, 0.3, level)


@pytest.mark.parametrize("power", [1.0, 0.6, 0.4])
def test_a_thing_is_one_however_the_image_was_scaled(power):
    valid = np.ones((SIZE, SIZE), bool)
    assert objectness(over_mean(speckled(hull()) ** power), valid, WAVE) > 1.3


@pytest.mark.parametrize("power", [1.0, 0.6, 0.4])
def test_a_patch_of_ripples_is_none(power):
    row, column = np.indices((SIZE, SIZE))
    inside = np.hypot(row - 150, column - 130) < 60
    level = 1 + 0.5 * inside * np.sin(2 * np.pi * column / WAVELENGTH)
    flat = over_mean(speckled(np.sqrt(level)) ** power)
    assert objectness(flat, np.ones((SIZE, SIZE), bool), WAVE) < 0.4
