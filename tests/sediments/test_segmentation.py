import numpy as np
import pytest
from scipy.spatial import cKDTree
from skimage.measure import label as measure_label

from sasmap.sediments import floor, k_distribution, mapping, segmentation
from sasmap.sediments.classmap import averaged, class_map, log_likelihoods, sieved
from sasmap.sediments.mapping import Line, paint, refine_map, traced
from sasmap.sediments.nodes import Boundary
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.separation import separation
from sasmap.sediments.trends import AmplitudeGrid

LEVELS, NUS = (1.0, 2.2, 0.4, 4.5), (50.0, 4.0, 20.0, 1.0)
SIZE = 320


def regions(kind):
    """Classes (0, 1, ...) of a scene."""
    y, x = np.indices((SIZE, SIZE))
    edge = SIZE / 2 + 15 * np.sin(y / 30)
    if kind == "one":
        return np.zeros((SIZE, SIZE), int)
    if kind == "wavy":
        return (x > edge).astype(int)
    if kind == "island":
        return (np.hypot(x - 160, y - 160) < 90).astype(int)
    if kind == "four":
        return (x > edge).astype(int) + 2 * (y > SIZE / 2 + 10 * np.sin(x / 25))
    return np.where(x < edge - 40, 0, np.where(y > 150 + 10 * np.sin(x / 25), 1, 2))


def looks_at(truth, seed, count=2, levels=LEVELS, nus=NUS):
    """Two looks from both sides, of other gains, each with a trend over range; or one from below.

    One look alone cannot tell a trend from a boundary that runs along the track.
    """
    rng = np.random.default_rng(seed)
    x = np.broadcast_to(np.arange(truth.shape[1]), truth.shape)
    x = x.T if count == 1 else x
    looks = []
    for k in range(count):
        amplitude = np.empty(truth.shape)
        for c in np.unique(truth):
            here = truth == c
            sample = k_distribution.rvs(nus[c], size=here.sum(), random_state=rng)
            amplitude[here] = np.sqrt(levels[c]) * sample
        reach = 20 + 0.05 * x if k == 0 else 45 - 0.05 * x
        looks.append(AmplitudeGrid((1.0, 1.7)[k] * amplitude * (reach / 30) ** -0.4, reach))
    return looks


def rand_index(first, second):
    """Adjusted Rand index."""
    table = np.zeros((first.max() + 1, second.max() + 1))
    np.add.at(table, (first.ravel(), second.ravel()), 1)

    def pairs(v):
        return (v * (v - 1) / 2).sum()

    both, rows, columns = pairs(table), pairs(table.sum(axis=1)), pairs(table.sum(axis=0))
    by_chance = rows * columns / (table.sum() * (table.sum() - 1) / 2)
    most = 0.5 * (rows + columns)
    return 1.0 if most == by_chance else (both - by_chance) / (most - by_chance)


@pytest.mark.parametrize(("kind", "count"), [("one", 1), ("wavy", 2), ("three", 3), ("four", 4)])
def test_classes_are_counted_and_mapped(kind, count):
    truth = regions(kind)
    for seed in range(3):
        looks = looks_at(truth, seed)
        classes = find_classes(looks)
        assert len(classes.laws) == count
        found = class_map(log_likelihoods(looks, classes))
        assert rand_index(truth, found.label.astype(int)) > 0.95
        assert np.nanmedian(found.probability) > 0.95


def test_classes_have_the_sediments_laws_and_looks_their_gains():
    classes = find_classes(looks_at(regions("wavy"), 1))
    first, second = classes.laws
    assert 10 * np.log10(second.mean_square / first.mean_square) == pytest.approx(3.4, abs=0.4)
    assert second.nu == pytest.approx(4.0, rel=0.4)
    assert classes.trends[1, 0] - classes.trends[0, 0] == pytest.approx(np.log(1.7), abs=0.05)
    assert classes.trends[0, 1] == pytest.approx(-0.4, abs=0.15)


def test_a_number_of_classes_can_be_asked_for():
    looks = looks_at(regions("four"), 2)
    assert len(find_classes(looks, 2).laws) == 2
    assert len(find_classes(looks, 1).laws) == 1


def test_nothing_seen_is_no_sediment():
    looks = looks_at(regions("wavy"), 3, count=1)
    looks[0].amplitude[100:140, 50:90] = np.nan
    found = class_map(log_likelihoods(looks, find_classes(looks)))
    assert (found.label[100:140, 50:90] == 0).all()
    assert np.isnan(found.probability[120, 70])
    assert (found.label[:90] > 0).all()
    empty = [AmplitudeGrid(np.full((64, 64), np.nan), np.full((64, 64), 20.0))]
    with pytest.raises(ValueError, match="known amplitudes"):
        find_classes(empty)


def true_edges(truth):
    across = np.argwhere(truth[:, 1:] != truth[:, :-1]) + np.array([0, 0.5])
    down = np.argwhere(truth[1:] != truth[:-1]) + np.array([0.5, 0])
    return cKDTree(np.vstack([across, down]))


@pytest.mark.parametrize("kind", ["wavy", "island", "three"])
def test_refined_boundaries_are_nearer_the_truth_and_know_how_near(kind):
    # 0.12 to 0.17 nats a pixel
    levels, nus = (1.0, 1.75, 3.1), (50.0,) * 3
    before, after, inside = [], [], []
    truth = regions(kind)
    tree = true_edges(truth)
    for seed in range(4):
        # the three classes' boundaries run along both axes: one look could not tell its trend
        looks = looks_at(truth, seed, 2 if kind == "three" else 1, levels, nus)
        likelihood = log_likelihoods(looks, find_classes(looks))
        found = class_map(likelihood)
        refined = refine_map(found.label, likelihood)
        points = np.vstack([line.boundary.points for line in refined.lines])
        sd = np.concatenate([line.boundary.sd for line in refined.lines])
        away = tree.query(points)[0]
        before.append(tree.query(np.vstack([p for _, _, p, _ in traced(found.label)]))[0].mean())
        after.append(away.mean())
        inside.append(np.mean(away < 1.96 * sd + 0.25))
        assert rand_index(truth, refined.label.astype(int)) > 0.97
    assert np.mean(after) < min(1.5, np.mean(before))
    assert np.mean(inside) > 0.85


def test_lines_are_traced_once_and_know_their_sides():
    label = np.ones((60, 80), np.uint8)
    label[:, 40:] = 2
    label[30:, 40:] = 3
    lines = list(traced(label))
    assert sorted((min(a, b), max(a, b)) for a, b, _, _ in lines) == [(1, 2), (1, 3), (2, 3)]
    for left, right, points, closed in lines:
        assert not closed
        middle = points[len(points) // 2]
        way = points[len(points) // 2 + 1] - middle
        across = np.array([way[1], -way[0]]) / np.hypot(*way)
        row, column = np.rint(middle + across).astype(int)
        assert label[row, column] == right
        row, column = np.rint(middle - across).astype(int)
        assert label[row, column] == left
    island = np.ones((60, 60), np.uint8)
    island[20:40, 20:40] = 2
    ((_, _, _, closed),) = traced(island)
    assert closed
    assert list(traced(np.ones((40, 40), np.uint8))) == []


@pytest.mark.parametrize("kind", ["one", "three"])
def test_shadow_is_no_sediment(kind):
    truth = regions(kind)
    looks = looks_at(truth, 6)
    shadow = np.zeros(truth.shape, bool)
    shadow[100:190, 30:110] = True
    dark = [
        AmplitudeGrid(np.where(shadow, 0.07 * v.amplitude, v.amplitude), v.cotangent) for v in looks
    ]
    classes = find_classes(dark)
    assert len(classes.laws) == truth.max() + 1
    assert classes.dark.mean_square < 0.1 * classes.laws[0].mean_square
    found = class_map(log_likelihoods(dark, classes), len(classes.laws))
    assert (found.label[shadow] == 0).mean() > 0.97
    assert (found.label[~shadow] > 0).mean() > 0.99
    assert find_classes(looks).dark is None


def test_rippled_floor_is_classed_by_its_average():
    x = np.indices((80, 80))[1]
    stripes = np.where(x % 20 < 8, -1.0, 1.0).astype(np.float32)
    likelihood = np.stack([stripes, np.zeros_like(stripes)])
    likelihood[:, 0, 0] = np.nan
    mask = x < 60
    found = averaged(likelihood, mask, 41)
    assert (found[0][:, 20:40] > 0).all()  # stripes have both signs
    np.testing.assert_array_equal(found[:, ~mask], likelihood[:, ~mask])
    assert np.isnan(found[:, 0, 0]).all()
    assert averaged(likelihood, mask & False, 41) is likelihood


def test_small_patches_go_where_they_are_asked_about():
    label = np.ones((60, 60), np.uint8)
    label[10:20, 10:20], label[40:50, 40:50], label[0:8, 30:38] = 2, 3, 0
    left = np.indices(label.shape)[1] < 30
    found = sieved(label, 200, among=left)
    assert (found[10:20, 10:20] == 1).all()
    np.testing.assert_array_equal(found[:, 30:], label[:, 30:])
    assert (sieved(label, 200) < 2).all()


def test_small_patches_go_to_the_nearest_that_stays():
    rng = np.random.default_rng(4)
    label = np.kron(rng.integers(1, 4, (12, 12)), np.ones((8, 8))).astype(np.uint8)
    label[rng.random(label.shape) < 0.02] = 3
    label[30:50, 20:60] = 0
    found = sieved(label, 100)
    parts = measure_label(label, background=0, connectivity=1)
    small = (np.bincount(parts.ravel()) < 100)[parts] & (label > 0)
    stays = np.argwhere((label > 0) & ~small)
    assert small.sum() > 500
    np.testing.assert_array_equal(found[~small], label[~small])
    for place in np.argwhere(small):
        away = np.hypot(*(stays - place).T)
        alike = label[tuple(stays.T)] == found[tuple(place)]
        assert away[alike].min() == away.min()


def test_painting_does_not_depend_on_blocks(monkeypatch):
    label = regions("three").astype(np.uint8) + 1
    at = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    ring = np.column_stack([160 + 70 * np.sin(at), 150 + 90 * np.cos(at)])
    way = np.column_stack([np.linspace(319, -1, 80), 150 + 8 * np.sin(np.arange(80))])
    lines = [
        Line(1, 2, Boundary(way, np.full(80, 1.0), False, 1)),
        Line(2, 3, Boundary(ring, np.full(120, 1.0), True, 1)),
    ]
    whole = label.copy()
    paint(label, lines, whole)
    monkeypatch.setattr(mapping, "STRIPE", 64)
    parts = label.copy()
    paint(label, lines, parts, 2)
    assert (whole != label).sum() > 500
    np.testing.assert_array_equal(parts, whole)


def test_painting_changes_no_third_class():
    label = np.ones((40, 60), np.uint8)
    label[:, 30:] = 2
    label[:10] = 3
    way = np.column_stack([np.linspace(39, -1, 11), np.full(11, 25.0)])
    result = label.copy()
    paint(label, [Line(1, 2, Boundary(way, np.full(11, 1.0), False, 1))], result)
    assert (result[:10] == 3).all()
    assert (result[14:36, 26:40] == 2).all()
    assert (result[14:36, :25] == 1).all()


def test_outlines_do_not_depend_on_stripes(monkeypatch):
    label = regions("three").astype(np.uint8) + 1
    label[40:70, 20:60] = 3
    label[200:210, 250:] = 0
    whole = list(traced(label))
    monkeypatch.setattr(mapping, "STRIPE", 37)
    parts = list(traced(label))
    assert len(whole) == len(parts) > 3

    def lines(found):
        return sorted((left, right, sorted(map(tuple, points))) for left, right, points, _ in found)

    assert lines(whole) == lines(parts)


def test_map_reads_only_slices():
    class Slices:
        """An array of which only small slices may be read."""

        def __init__(self, values):
            self.values, self.shape = values, values.shape

        def __getitem__(self, part):
            assert isinstance(part[0], slice)
            assert self.values[part].size < self.values.size
            return self.values[part]

    looks = looks_at(regions("wavy"), 5)
    likelihood = log_likelihoods(looks, find_classes(looks))
    found = class_map(likelihood)
    whole = refine_map(found.label, likelihood)
    read = refine_map(found.label, [Slices(layer) for layer in likelihood])
    np.testing.assert_array_equal(whole.label, read.label)


def test_separation_of_laws():
    looks = looks_at(regions("wavy"), 4, 1, (1.0, 1.75), (1e6, 1e6))
    first, second = find_classes(looks).laws
    # of exponential intensities: the smaller of log r + 1 / r - 1 and r - 1 - log r
    ratio = second.mean_square / first.mean_square
    expected = min(np.log(ratio) + 1 / ratio - 1, ratio - 1 - np.log(ratio))
    assert separation(first, second) == pytest.approx(expected, rel=0.1)


def scattered(seed, size=768):
    """Three sediments in small wavy patches all over."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((size, size))
    x, y = x + 12 * np.sin(y / 37), y + 12 * np.sin(x / 41)
    away = [(x - a) ** 2 + (y - b) ** 2 for a, b in rng.uniform(0, size, (9, 2))]
    return np.argmin(away, axis=0) % 3


def mapped(looks):
    classes = find_classes(looks)
    return classes, class_map(log_likelihoods(looks, classes)).label.astype(int)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_sample_finds_what_the_whole_survey_shows(seed, monkeypatch):
    truth = scattered(seed)
    looks = looks_at(truth, seed)
    whole, label = mapped(looks)
    # four tiles of 256 pixels of nine
    for limit in ("DESCRIBED", "SAMPLE"):
        monkeypatch.setattr(segmentation, limit, 500_000)
    monkeypatch.setattr(floor, "SAMPLED_BLOCKS", 100)
    sampled, again = mapped(looks)
    assert len(sampled.laws) == len(whole.laws) == 3
    assert rand_index(truth, label) > 0.97
    assert rand_index(truth, again) > rand_index(truth, label) - 0.005
    np.testing.assert_array_equal(sampled.trends, whole.trends)
