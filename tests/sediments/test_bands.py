"""Gain by range is no sediment until another look says so."""

import numpy as np
import pytest

from sasmap.sediments import k_distribution
from sasmap.sediments.bands import find_bands
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.floor import gather
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.trends import AmplitudeGrid, first_trends
from tests.sediments.test_segmentation import rand_index

SIZE = 512
Y, X = np.indices((SIZE, SIZE))


def banded(reach, depth):
    """Slow bands over range: a fixed function of it, amplitude."""
    phase = 2 * np.pi * np.log(reach / 20) / np.log(60 / 20)
    return 10 ** (depth / 20 * np.sin(2.3 * phase) * np.where(phase > 3, 1.0, 0.6))


def look(truth, reach, seed, depth=0.0, levels=(1.0, 2.2), altitude=5.0):
    amplitude = k_distribution.rvs(8.0, size=truth.shape, random_state=seed)
    amplitude = amplitude * np.sqrt(np.array(levels))[truth] * banded(reach, depth)
    return AmplitudeGrid(amplitude, reach / altitude)


def near(x):
    return 20 + 40.0 * x / SIZE


@pytest.mark.parametrize("depth", [1.5, 3.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_bands_of_one_look_are_gain(seed, depth):
    flat = np.zeros((SIZE, SIZE), int)
    classes = find_classes([look(flat, near(X), seed, depth)])
    assert len(classes.laws) == 1


def test_weak_bands_that_two_sides_do_not_share_are_gain():
    # strong ones would agree where the bands of both happen to meet
    flat = np.zeros((SIZE, SIZE), int)
    sides = [look(flat, near(X), 1, 1.5), look(flat, near(SIZE - X), 10, 1.5)]
    assert len(find_classes(sides).laws) == 1


def test_bands_are_those_of_the_gain():
    grid = look(np.zeros((SIZE, SIZE), int), near(X), 4, 3.0)
    blocks, _ = gather([grid], None)
    bands = find_bands(blocks, np.zeros((1, 3)))
    reach = np.linspace(22, 58, 50)
    off = bands.of(0, reach / 5) - np.log(banded(reach, 3.0))
    assert np.std(off) < 0.04


@pytest.mark.parametrize("depth", [0.0, 3.0])
@pytest.mark.parametrize(("slant", "level"), [(0.6, 2.2), (0.3, 1.5)])
def test_an_oblique_boundary_is_one_for_a_single_look(depth, slant, level):
    truth = (X + slant * Y > 256 * (1 + slant)).astype(int)
    looks = [look(truth, near(X), 3, depth, (1.0, level))]
    classes = find_classes(looks)
    assert len(classes.laws) == 2
    label = class_map(log_likelihoods(looks, classes)).label
    assert rand_index(truth, label.astype(int)) > 0.9


@pytest.mark.parametrize("place", [200, 256])
def test_a_boundary_along_the_track_needs_two_looks(place):
    truth = (place < X).astype(int)
    both = [look(truth, near(X), 5), look(truth, near(SIZE - X), 6)]
    assert len(find_classes(both[:1]).laws) == 1
    classes = find_classes(both)
    assert len(classes.laws) == 2
    label = class_map(log_likelihoods(both, classes)).label
    assert rand_index(truth, label.astype(int)) > 0.95


def test_a_repeated_line_confirms_nothing():
    flat = np.zeros((SIZE, SIZE), int)
    lines = [look(flat, near(X), seed, 3.0) for seed in (7, 8)]
    assert len(find_classes(lines).laws) == 1
    blocks, _ = gather(lines, None)
    assert find_bands(blocks, first_trends(blocks)).span > 0.3
