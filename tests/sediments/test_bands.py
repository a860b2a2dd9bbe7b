"""Gain by range is no sediment until another look says so."""

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter

from sasmap.sediments import k_distribution
from sasmap.sediments.bands import find_bands
from sasmap.sediments.carrying import carry_over
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.floor import gather
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.training import train_classes
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


def sloping(by_range, seed, truth=0, levels=(1.0,)):
    """Bands that go by slant range, or by grazing angle, while the altitude falls."""
    altitude = np.broadcast_to(11.0 - 7.0 * Y / SIZE, X.shape)
    reach = np.hypot(near(X), altitude)
    place = reach if by_range else 5 * near(X) / altitude
    amplitude = k_distribution.rvs(8.0, size=X.shape, random_state=seed)
    amplitude = amplitude * np.sqrt(np.array(levels))[np.full(X.shape, truth)]
    gain = 10 ** (2 / 20 * np.sin(2 * np.pi * 3 * np.log(place / 20)))
    return AmplitudeGrid(amplitude * gain, near(X) / altitude, altitude)


@pytest.mark.parametrize("by_range", [False, True])
def test_gain_goes_by_angle_or_range_as_the_data_say(by_range):
    line = sloping(by_range, 11)
    blocks, _ = gather([line], None)
    bands = find_bands(blocks, first_trends(blocks))
    assert bands.ranged == by_range
    classes = find_classes([line])
    assert len(classes.laws) == 1
    assert classes.ranged == by_range
    # without altitudes there is the angle alone
    assert not find_bands(gather([line._replace(altitude=None)], None)[0], np.zeros((1, 3))).ranged


def test_angles_at_which_nothing_returns_are_the_water_column():
    cotangent = X / 40
    dark = np.where(cotangent < 2, 0.05, 1.0)
    bands = np.exp(0.35 * np.sin(np.log(np.maximum(cotangent, 0.1)) * 6))
    amplitude = k_distribution.rvs(8.0, size=X.shape, random_state=12) * dark * bands
    line = [AmplitudeGrid(amplitude, cotangent)]
    classes = find_classes(line)
    assert len(classes.laws) == 1
    label = class_map(log_likelihoods(line, classes), 1).label
    assert (label[:, cotangent[0] < 1.7] == 0).mean() > 0.95
    assert (label[:, cotangent[0] > 2.3] == 1).all()


@pytest.mark.parametrize("count", [2, None])
def test_a_number_that_is_asked_for_is_found_without_bands(count):
    truth = (X + 0.6 * Y > 410).astype(int)
    looks = [look(truth, near(X), 13, 3.0)]
    classes = find_classes(looks, count)
    assert classes.bands is not None
    label = class_map(log_likelihoods(looks, classes)).label
    assert rand_index(truth, label.astype(int)) > 0.9


def test_training_confirms_bands_or_sediments():
    marks = np.zeros((SIZE, SIZE), np.uint8)
    flat = [look(np.zeros((SIZE, SIZE), int), near(X), 14, 3.0)]
    marks[40:470, 20:490] = 1
    assert train_classes(flat, marks, 1).bands is not None
    # sediments beyond each other along the whole line, as marked
    truth = (X > 256).astype(int)
    shown = np.where(np.abs(X - 256) > 40, truth + 1, 0).astype(np.uint8)
    line = [look(truth, near(X), 15)]
    classes = train_classes(line, shown, 2)
    assert classes.bands is None
    label = class_map(log_likelihoods(line, classes), 2).label
    assert (label == truth + 1).mean() > 0.95


def test_classes_are_carried_over_to_a_line_with_bands():
    truth = (X + 0.6 * Y > 410).astype(int)
    first = [look(truth, near(X), 16, 3.0)]
    classes = find_classes(first)
    again = carry_over([look(truth, near(X), 17, 3.0)], classes.laws, classes.centre)
    assert again.bands is not None
    plain = carry_over([look(truth, near(X), 18)], classes.laws, classes.centre)
    assert plain.bands is None


def test_drift_makes_no_classes_and_an_edge_does():
    y, x = np.indices((1536, 256))
    reach = 20 + 40.0 * x / 256
    floor = look(np.zeros(y.shape, int), reach, 19)
    drift = np.exp(0.25 * np.sin(2 * np.pi * y / 1536))
    assert len(find_classes([floor._replace(amplitude=floor.amplitude * drift)]).laws) == 1
    jump = np.where(y > 700, np.exp(0.25), 1.0)
    assert len(find_classes([floor._replace(amplitude=floor.amplitude * jump)]).laws) == 2


def test_grainy_sediments_with_rough_boundaries_are_no_gain():
    rng = np.random.default_rng(5)
    shape = 800, 1000
    down, across = np.meshgrid(*(np.fft.fftfreq(n) for n in shape), indexing="ij")
    number = np.hypot(down, across)
    number[0, 0] = np.inf
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal(shape)) * number**-1.7).real
    field = (field - field.mean()) / field.std()
    truth = (field > -0.4).astype(int) + (field > 0.7)
    speckle = gaussian_filter(rng.standard_normal((2, *shape)), (0, 0.6, 0.6))
    grain = gaussian_filter(rng.standard_normal(shape), 3)
    rock = np.sqrt(stats.gamma.ppf(stats.norm.cdf(grain / grain.std()), 1.5) / 1.5)
    level = 10 ** (np.array([-0.8, -0.3, 0.2])[truth])
    amplitude = np.hypot(*speckle) * np.where(truth == 2, rock, 1.0) * level
    reach = 15 + 0.05 * np.broadcast_to(np.arange(shape[1]), shape)
    grid = AmplitudeGrid(amplitude, reach / 6.0)
    classes = find_classes([grid])
    assert len(classes.laws) == 3
    assert classes.bands is None  # it was 5 dB
    label = class_map(log_likelihoods([grid], classes)).label
    assert rand_index(truth, label.astype(int)) > 0.85
