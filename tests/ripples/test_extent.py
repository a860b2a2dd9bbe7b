import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, gaussian_filter
from skimage.measure import find_contours

from sasmap.ripples.demodulation import windings
from sasmap.ripples.extent import ripple_extent
from sasmap.ripples.image import as_image
from tests.helpers import clip_of

SIZE, PIXEL = 400, 0.05


def patch(inside, wavelength, contrast, seed=0, forks=()):
    """Image of ripples where `inside` is true, and their wave vector, cycles/m."""
    rng = np.random.default_rng(seed)
    row, column = np.indices(inside.shape) - np.array(inside.shape)[:, None, None] / 2
    turn = 0.4
    phase = 2 * np.pi / wavelength * (column * np.cos(turn) + row * np.sin(turn))
    bend = gaussian_filter(rng.normal(size=inside.shape), 2 * wavelength, mode="wrap")
    phase = phase + bend / bend.std()
    for sign, (down, right) in zip((1, -1) * len(forks), forks, strict=False):
        phase = phase + sign * np.arctan2(row - down, column - right)
    level = 1 + contrast * inside * np.sin(phase)
    amplitude = np.sqrt(level * rng.exponential(1.0, inside.shape))
    clip = clip_of(amplitude, 30 + PIXEL * np.arange(inside.shape[1]), 6.0, PIXEL)
    # rows of the clip run southwards
    vector = np.array([np.cos(turn), -np.sin(turn)]) / (wavelength * PIXEL)
    return as_image(clip), vector


def shape_of(kind):
    row, column = np.indices((SIZE, SIZE))
    if kind == "circle":
        return (row - 190) ** 2 + (column - 215) ** 2 < 120**2
    if kind == "half":
        return 0.8 * row + 0.6 * column < 270
    field = gaussian_filter(np.random.default_rng(4).normal(size=(SIZE, SIZE)), 50, mode="wrap")
    return field > 0.3 * field.std()


@pytest.mark.parametrize("kind", ["circle", "half", "wandering"])
@pytest.mark.parametrize(("wavelength", "contrast"), [(12, 0.6), (24, 0.4), (40, 0.7)])
def test_outlines_are_within_half_a_wavelength_and_areas_within_five_per_cent(
    kind, wavelength, contrast
):
    inside = shape_of(kind)
    image, vector = patch(inside, wavelength, contrast)
    found = ripple_extent(image, vector)
    edge = np.abs(distance_transform_edt(inside) - distance_transform_edt(~inside))
    places = np.rint(np.concatenate(find_contours(found.probability, 0.5))).astype(int)
    within = ((places > 8) & (places < SIZE - 9)).all(axis=1)  # the clip's own edge is no outline
    distance = edge[tuple(places[within].T)]
    assert distance.mean() < 0.5 * wavelength
    assert abs((found.probability > 0.5).sum() / inside.sum() - 1) < 0.05
    assert abs(found.fraction - inside.mean()) < 0.05


def test_a_field_of_ripples_is_rippled_throughout_forks_and_all():
    everywhere = np.ones((SIZE, SIZE), bool)
    image, vector = patch(everywhere, 20, 0.6, forks=[(-80, -60), (40, 90), (100, -100)])
    found = ripple_extent(image, vector)
    assert found.fraction > 0.98


def test_the_next_cell_is_told_by_the_ripples_of_this_one():
    image, vector = patch(np.ones((SIZE, SIZE), bool), 20, 0.6)
    own = ripple_extent(image, vector).own
    flat, _ = patch(np.zeros((SIZE, SIZE), bool), 20, 0.6, seed=1)
    assert ripple_extent(flat, vector, own).fraction < 0.01
    half = np.indices((SIZE, SIZE))[1] < 150
    beside, _ = patch(half, 20, 0.6, seed=2)
    assert abs(ripple_extent(beside, vector, own).fraction - half.mean()) < 0.03


def test_terminations_are_counted():
    rng = np.random.default_rng(5)
    counted = known = 0
    for seed in range(4):
        forks = [(r + rng.uniform(-15, 15), c + rng.uniform(-15, 15))
                 for r in (-120, -40, 40, 120) for c in (-120, -40, 40, 120)]  # fmt: skip
        image, vector = patch(np.ones((SIZE, SIZE), bool), 20, 0.7, seed=seed, forks=forks)
        found = ripple_extent(image, vector)
        counted, known = counted + found.defects, known + len(forks)
        assert abs(found.area / (SIZE * PIXEL) ** 2 - 1) < 0.05
        assert found.defect_density == found.defects / found.area
    assert abs(counted / known - 1) < 0.1


def test_windings_are_where_the_phase_turns():
    row, column = np.indices((20, 30)) - np.array([9.5, 14.5])[:, None, None]
    one = np.exp(1j * np.arctan2(row, column))
    assert windings(one).sum() == 1
    assert windings(one)[9, 14] == 1
    assert windings(np.conj(one)).sum() == -1
    assert not windings(np.ones((5, 5), complex)).any()
