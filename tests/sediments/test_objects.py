import numpy as np
import pytest
from scipy.ndimage import label

from sasmap.sediments.objects import find_objects
from tests.sediments.test_texture import bed
from tests.sediments.test_waves import rippled, speckle

SIZE = 768
Y, X = np.indices((SIZE, SIZE))
COTANGENT = (20 + 0.05 * X) / 5
WHOLE = slice(0, SIZE), slice(0, SIZE)


def boulder(image, row, column, radius=9, cast=45, brighter=5.0):
    """Put a boulder that is brighter on its near side, with a shadow behind, range to the right."""
    round_ = np.hypot(Y - row, X - column) < radius
    image = np.where(round_, brighter * image, image)
    behind = (np.abs(Y - row) < 0.8 * radius) & (column + radius <= X)
    return np.where(behind & (column + radius + cast > X), 0.05 * image, image)


def wreck(image):
    """Lay ribs across a hull, planks of the floor's level between them, and a shadow behind."""
    for k in range(9):
        image = np.where((np.abs(Y - 320 - 22 * k) < 4) & (X > 300) & (X < 440), 4 * image, image)
    hull = ((np.abs(X - 300) < 4) | (np.abs(X - 440) < 5)) & (Y > 310) & (Y < 510)
    image = np.where(hull, 6 * image, image)
    return np.where((X > 446) & (X < 560) & (Y > 315) & (Y < 505), 0.05 * image, image)


def found(image, cotangent=COTANGENT, ripples=False):
    none = np.full((SIZE, SIZE), ripples)
    return find_objects(image.astype(np.float32), cotangent, none, WHOLE)


@pytest.mark.parametrize("seed", [1, 2])
def test_boulders_are_found_with_their_shadow(seed):
    image = speckle(seed, (SIZE, SIZE))
    places = [(100, 120), (400, 600), (650, 200)]
    for row, column in places:
        image = boulder(image, row, column)
    objects = found(image)
    assert label(objects.object)[1] == len(places)
    for row, column in places:
        assert objects.object[row, column]
        assert objects.shadow[row, column + 30]
    assert objects.object.sum() < 3 * len(places) * np.pi * 9**2
    assert not (objects.object & objects.shadow).any()


def test_what_has_its_dark_side_towards_the_sonar_is_no_object():
    image = boulder(speckle(3, (SIZE, SIZE)), 300, 300)
    assert found(image).object.any()
    assert not found(image, COTANGENT[:, ::-1]).object.any()
    without_shadow = boulder(speckle(3, (SIZE, SIZE)), 300, 300, cast=0)
    assert not found(without_shadow).object.any()


def test_a_wreck_is_one_object_with_what_is_in_it():
    objects = found(wreck(speckle(4, (SIZE, SIZE))))
    assert label(objects.object)[1] == 1
    inside = (X > 306) & (X < 434) & (Y > 322) & (Y < 494)
    assert objects.object[inside].mean() > 0.97
    behind = (X > 454) & (X < 550) & (Y > 325) & (Y < 495)
    assert objects.shadow[behind].mean() > 0.97
    away = (X < 285) | (X > 575) | (Y < 295) | (Y > 525)
    assert not (objects.object | objects.shadow)[away].any()


@pytest.mark.parametrize("kind", ["speckle", "bed 5", "bed 10", "edges", "field", "ripples"])
def test_what_the_floor_is_made_of_is_no_object(kind):
    image = speckle(5, (SIZE, SIZE))
    if kind.startswith("bed"):
        image = np.block([[bed(2 * i + j, int(kind[4:]), 1.0) for j in (0, 1)] for i in (0, 1)])
    elif kind == "edges":
        image *= np.where(400 + 30 * np.sin(Y / 40) < X, 3.5, 1) * np.where(Y > 300, 1, 0.5)
    elif kind == "field":
        rng = np.random.default_rng(6)
        for row, column in rng.uniform(40, SIZE - 80, (60, 2)):
            image = boulder(image, row, column)
    elif kind == "ripples":
        image = rippled(7, 60, 0.1, 0.95, (SIZE, SIZE))[0]
    objects = found(image, ripples=kind == "ripples")
    assert objects.object.mean() < 0.002
    assert objects.shadow.mean() < 0.002


def test_the_unit_of_amplitude_does_not_matter():
    image = boulder(speckle(8, (SIZE, SIZE)), 300, 300)
    for unit in (1e-6, 3e4):
        np.testing.assert_array_equal(found(image).object, found(unit * image).object)
