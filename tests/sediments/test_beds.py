import numpy as np
import pytest

from sasmap.sediments.floor import Flat
from sasmap.sediments.grouping import pruned
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.separation import TOLD, _Bed, _sharpness, laws_of, united
from sasmap.sediments.trends import BLOCK, AmplitudeGrid

SIDE = 40 * BLOCK


def speckle(level, seed):
    return np.random.default_rng(seed).rayleigh(size=level.shape) * np.exp(level)


def looks(level, seed):
    amplitude = speckle(level, seed).astype(np.float32)
    return [AmplitudeGrid(amplitude, np.full(level.shape, 5.0, np.float32))]


def test_stripes_that_ripples_leave_are_one_bed_and_sediments_stay_two():
    y, x = np.indices((SIDE, SIDE))
    stripes = 0.35 * np.sin(2 * np.pi * (x + 0.2 * y) / 62)
    beds = np.ones((SIDE, SIDE), np.uint8)
    assert len(find_classes(looks(stripes, 1), rippled=beds).laws) == 1
    two = find_classes(looks(stripes + 0.5 * (y > SIDE // 2), 2), rippled=beds).laws
    assert len(two) == 2
    apart = np.log(two[1].mean_square / two[0].mean_square) / 2
    assert apart == pytest.approx(0.5, abs=0.12)


def test_a_group_among_ripples_is_as_wide_as_what_it_is_judged_by():
    labels = np.zeros((30, 30), np.int64)
    labels[10:20, 26:] = 1  # four blocks at the edge of the survey
    none, all_ = np.zeros(labels.shape, bool), np.ones(labels.shape, bool)
    assert pruned(labels, 1, rippled=none).max() == 1
    assert pruned(labels, 1, rippled=all_).max() == 0
    labels[10:22, 18:] = 1
    assert pruned(labels, 1, rippled=all_).max() == 1


@pytest.mark.parametrize(("step", "there"), [(0.15, 1), (0.35, 2)])
def test_rippled_and_flat_floor_that_differ_by_little_are_one_sediment(step, there):
    right = np.indices((SIDE, SIDE))[1] >= SIDE // 2
    flat = [Flat(v, np.zeros(3), 0.0) for v in looks(step * right, 3)]
    labels = right[::BLOCK, ::BLOCK].astype(np.int64)
    level = step * labels.astype(float)
    laws = laws_of(flat, labels, 1.0)

    def left(beds):
        return len(united(flat, labels, laws, level, 1.0, TOLD, beds)[1])

    assert left(labels > 0) == there
    assert left(np.ones(labels.shape, bool)) == 2  # two beds: a boundary is one
    assert left(None) == 2


@pytest.mark.parametrize(
    ("bed", "other", "one"),
    [
        ((0.0, 1.0), (0.05, 0.5), True),  # shadow makes the bed's mean log lower, not its power
        ((0.0, 1.0), (0.0, 0.0), True),
        ((0.0, 1.0), (0.3, 0.5), False),
        ((0.0, 1.0), (0.05, 0.9), False),  # a bed over two sediments
        ((0.0, 0.1), (0.05, 0.0), False),
    ],
)
def test_a_bed_and_flat_floor_of_one_power_are_one_sediment(bed, other, one):
    labels = np.zeros((40, 40), int)
    labels[:, 20:] = 1
    level = np.where(labels == 1, 0.5, 0.0)
    found = _sharpness(labels, level, (1, 0), 0.1, [_Bed(*bed), _Bed(*other)])
    assert found == (0.0 if one else 1.0)
