"""Gains of looks that no training marks."""

import numpy as np
import pytest

from sasmap.sediments.training import train_classes
from sasmap.sediments.trends import AmplitudeGrid

LEVELS = 1.0, 1.8


def floor(shape, share, seed):
    """Class of each pixel (0 or 1): a wavy boundary at a share of the columns."""
    column, row = np.arange(shape[1]), np.arange(shape[0])[:, None]
    return (column > shape[1] * share + 12 * np.sin(row / 30 + seed)).astype(int)


def amplitude(truth, gain, seed):
    rng = np.random.default_rng(seed)
    return gain * np.take(LEVELS, truth) * rng.rayleigh(size=truth.shape)


def looks_of(parts, size=256):
    """Lay floors below each other, one look each (truth, gain, rows beyond its own)."""
    shape = len(parts) * size, 512
    looks = []
    for k, (truth, gain) in enumerate(parts):
        seen = np.full(shape, np.nan)
        seen[k * size : (k + 1) * size] = amplitude(truth, gain, k)
        looks.append(AmplitudeGrid(seen, np.full(shape, 4.0)))
    return looks


@pytest.mark.parametrize("gain", [0.84, 1.0, 1.19])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_the_gain_of_a_look_without_marks_is_found_whatever_it_shows(share, gain):
    marked, other = floor((256, 512), 0.5, 0), floor((256, 512), share, 1)
    looks = looks_of([(marked, 1.0), (other, gain)])
    marks = np.zeros(looks[0].amplitude.shape, np.uint8)
    marks[:256] = marked + 1
    classes = train_classes(looks, marks, 2)
    found = classes.trends[1, 0] - classes.trends[0, 0]
    assert found == pytest.approx(np.log(gain), abs=0.03)


def test_one_sediment_alone_says_nothing_of_gain():
    marked = floor((256, 512), 0.5, 0)
    for k in (0, 1):
        looks = looks_of([(marked, 1.0), (np.full((256, 512), k), 1.0)])
        marks = np.zeros(looks[0].amplitude.shape, np.uint8)
        marks[:256] = marked + 1
        classes = train_classes(looks, marks, 2)
        assert classes.trends[1, 0] == pytest.approx(classes.trends[0, 0], abs=0.03)


def test_a_look_that_overlaps_one_without_marks_takes_its_gain():
    marked, other = floor((256, 512), 0.5, 0), floor((256, 512), 0.3, 1)
    looks = looks_of([(marked, 1.0), (other, 1.19)])
    again = np.full(looks[0].amplitude.shape, np.nan)
    again[400:] = amplitude(other[144:], 2.5, 7)  # far from any gain that classes would tell
    looks.append(AmplitudeGrid(again, looks[0].cotangent))
    marks = np.zeros(again.shape, np.uint8)
    marks[:256] = marked + 1
    gains = train_classes(looks, marks, 2).trends[:, 0]
    assert gains[1] - gains[0] == pytest.approx(np.log(1.19), abs=0.03)
    assert gains[2] - gains[0] == pytest.approx(np.log(2.5), abs=0.04)


def test_a_class_of_too_few_marks_leaves_gains_alone():
    marked, other = floor((256, 512), 0.5, 0), floor((256, 512), 0.3, 1)
    looks = looks_of([(marked, 1.0), (other, 1.19)])
    marks = np.zeros(looks[0].amplitude.shape, np.uint8)
    marks[:256] = marked + 1
    thin = np.zeros_like(marks)
    thin[:, ::4] = 1  # no block is marked whole
    marks[(marks == 2) & (thin == 0)] = 0
    trends = train_classes(looks, marks, 2).trends
    assert trends[1, 0] == 0
