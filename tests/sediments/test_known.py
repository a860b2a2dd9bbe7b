import numpy as np
import pytest

from sasmap.sediments.carrying import carry_over
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.training import train_classes
from sasmap.sediments.trends import AmplitudeGrid
from tests.sediments.test_segmentation import LEVELS, looks_at, rand_index, regions


def marks_of(truth, share=0.04, seed=0):
    """A square of pixels of each class, numbered from the last to the first."""
    marks = np.zeros(truth.shape, np.uint8)
    count = truth.max() + 1
    for k in range(count):
        row, column = np.argwhere(truth == k)[len(np.argwhere(truth == k)) // 2]
        part = slice(max(row - 24, 0), row + 24), slice(max(column - 24, 0), column + 24)
        marks[part] = np.where(truth[part] == k, count - k, marks[part])
    return marks


@pytest.mark.parametrize("kind", ["wavy", "three", "four"])
def test_classes_learned_from_marks_map_the_rest(kind):
    truth = regions(kind)
    looks = looks_at(truth, 3)
    classes = train_classes(looks, marks_of(truth), truth.max() + 1)
    found = class_map(log_likelihoods(looks, classes))
    # numbered as marked, not by intensity
    wanted = truth.max() + 1 - truth
    assert (found.label == wanted).mean() > 0.97
    for k, law in enumerate(classes.laws):
        first = classes.laws[-1].mean_square
        expected = 10 * np.log10(LEVELS[truth.max() - k])
        assert 10 * np.log10(law.mean_square / first) == pytest.approx(expected, abs=1.0)


def test_too_few_marked_pixels_are_told():
    truth = regions("wavy")
    marks = marks_of(truth)
    marks[marks == 2] = 0
    marks[:3, :4] = 2
    with pytest.raises(ValueError, match="class 2: 24 known pixels are marked; expected at least"):
        train_classes(looks_at(truth, 3), marks, 2)


@pytest.mark.parametrize("gain", [0.8, 1.0, 1.3])
@pytest.mark.parametrize("kind", ["one", "wavy", "three"])
def test_classes_carried_over_find_the_gain(kind, gain):
    known = find_classes(looks_at(regions("three"), 1))
    truth = regions(kind)
    looks = [AmplitudeGrid(gain * look.amplitude, look.cotangent) for look in looks_at(truth, 8)]
    classes = carry_over(looks, known.laws, known.centre)
    order = np.argsort(LEVELS[:3])  # classes found are numbered by intensity
    wanted = np.argsort(order)[truth]
    found = class_map(log_likelihoods(looks, classes))
    if kind == "one":  # a gain and a sediment are one thing to a single class, within 3 dB
        assert (found.label == wanted + 1).mean() > 0.9
    else:
        assert rand_index(wanted, found.label.astype(int)) > 0.95
        assert (found.label == wanted + 1).mean() > 0.97
        assert classes.trends[0, 0] == pytest.approx(np.log(gain), abs=0.12)
